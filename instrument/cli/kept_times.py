"""How long steps took on this machine: what tells of no progress is expected to take as long as last time."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MOST = 300
"""Steps that are remembered; beyond, the oldest are forgotten."""
WORTH_S = 0.5
"""Shorter ones need not be foretold."""
_of = ""


def about(what: str) -> None:
    """Say what the following steps belong to: a command, and then its bench."""
    global _of
    _of = what


def place() -> Path:
    """Return the file, in the user's cache; it may be removed at any time."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser() / "diffuserbench" / "times.json"


def expected_s(what: str, size: float = 1.0) -> float | None:
    """Return how long a step will take by what it took last time, in proportion to its size.

    None where it was never done, or was quick.
    """
    try:
        last_size, last_s = _read()[_key(what)]
        return float(last_s) * size / float(last_size)
    except (LookupError, TypeError, ValueError, ZeroDivisionError):
        return None


@contextmanager
def kept(what: str, size: float = 1.0) -> Iterator[None]:
    """Remember how long the block takes, unless it fails."""
    began_s = time.monotonic()
    yield
    took_s = time.monotonic() - began_s
    if took_s < WORTH_S:
        return
    times = _read()
    times.pop(_key(what), None)
    times[_key(what)] = [size, round(took_s, 2)]
    path = place()
    with suppress(OSError):  # a home that may not be written to: nothing is foretold
        path.parent.mkdir(parents=True, exist_ok=True)
        new = path.with_name(f"{path.name}.{os.getpid()}")
        new.write_text(json.dumps(dict(list(times.items())[-MOST:])), encoding="utf-8")
        new.replace(path)


def _key(what: str) -> str:
    return f"{_of}: {what}"


def _read() -> dict[str, list[float]]:
    try:
        found = json.loads(place().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
