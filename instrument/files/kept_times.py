"""How long steps took on this machine: what tells of no progress is expected to take as long as last time.

Steps of a simulated bench that compute light say something the first time, too: by a machine with two cores.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

MOST = 300
"""Steps that are remembered; beyond, the oldest are forgotten."""
WORTH_S = 0.5
"""Shorter ones need not be foretold."""
_LARGEST = 1e9  # thirty years; frames, too
_FIRST_S_PER_MEGAPIXEL = {
    "Looking for hot pixels": 0.3,
    "Finding the scene's exposure": 1.3,
    "finding the scene's exposure": 1.3,
    "finding exposures": 1.2,
    "photographing bead slides": 1.6,
}
"""Steps that compute light on a simulated bench, on two cores of 2026 with little else to do."""
_of = ""
_simulated_megapixels = 0.0
_window = False


class Expected(NamedTuple):
    """How long a step will take, and by what: words after "as" or "longer than"."""

    seconds: float
    by: str


def about(what: str, *, simulated_megapixels: float = 0.0) -> None:
    """Say what the following steps belong to: a command, and then its bench, with its sensor if simulated."""
    global _of, _simulated_megapixels
    _of, _simulated_megapixels = what, simulated_megapixels


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


def expected(what: str) -> Expected | None:
    """Return how long a step took last time, or takes elsewhere the first time; None: not known, or quick."""
    try:
        return Expected(sane(recall(_key(what))), "last time")
    except (LookupError, TypeError, ValueError):
        first_s = _FIRST_S_PER_MEGAPIXEL.get(what, 0.0) * _simulated_megapixels
        return Expected(first_s, "on another machine") if first_s > WORTH_S else None


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
