"""Where things are kept that may be removed at any time: they are made again."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return the program's folder in the user's cache; it need not be there."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser() / "diffuserbench"
