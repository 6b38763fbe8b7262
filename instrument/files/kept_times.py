"""How long steps took on this machine: what tells of no progress is expected to take as long as last time."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

MOST = 300
"""Steps that are remembered; beyond, the oldest are forgotten."""
WORTH_S = 0.5
"""Shorter ones need not be foretold."""
_LARGEST = 1e9  # thirty years; frames, too
_of = ""
_window = False


def about(what: str) -> None:
    """Say what the following steps belong to: a command, and then its bench."""
    global _of
    _of = what


def place() -> Path:
    """Return the file, in the user's cache; it may be removed at any time."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser() / "diffuserbench" / "times.json"


def seen() -> bool:
    """Whether somebody sees what is foretold: at a terminal, or in the window."""
    return _window or sys.stderr.isatty()


def in_a_window() -> None:
    """Say that the program has a window: what is done there is remembered too."""
    global _window
    _window = True


def expected_s(what: str) -> float | None:
    """Return how long a step took last time; None where it was never done, or was quick."""
    try:
        return sane(recall(_key(what)))
    except (LookupError, TypeError, ValueError):
        return None


@contextmanager
def kept(what: str) -> Iterator[None]:
    """Remember how long the block takes, unless it fails or nobody sees it."""
    began_s = time.monotonic()
    yield
    took_s = time.monotonic() - began_s
    if took_s >= WORTH_S:
        remember(_key(what), round(took_s, 2))


def sane(number: Any) -> float:
    """Return a number that was remembered; TypeError, ValueError where it is none: a damaged file."""
    if isinstance(number, str | bool) or not 0 <= number < _LARGEST:
        raise ValueError("This is no time and no number of frames.")
    return float(number)


def recall(key: str) -> Any:
    """Return what was remembered last under a key, as JSON has it; LookupError where nothing was."""
    return _read()[key]


def remember(key: str, value: Any) -> None:
    """Remember something by a key, where somebody sees it; the oldest is forgotten."""
    if not seen():
        return
    from instrument.files.atomic import write_json
    from instrument.files.errors import BenchError

    times = _read()
    times.pop(key, None)
    times[key] = value
    path = place()
    with suppress(OSError, BenchError):  # a home that may not be written to: nothing is foretold
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, dict(list(times.items())[-MOST:]))


def _key(what: str) -> str:
    return f"{_of}: {what}"


def _read() -> dict[str, Any]:
    try:
        found = json.loads(place().read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
