"""How long steps took on this machine: what tells of no progress is expected to take as long as last time.

What takes over two seconds on the default bench says something the first time, too, by how quick transforms
are here: the tables below, measured by ``benchmarks/silences.py --steps``.
Light that is kept from then on is not waited for again: with it a step is another one.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from drivers.common.cache import cache_folder

MOST = 300
"""Steps that are remembered; beyond, the oldest are forgotten."""
WORTH_S = 0.5
"""Shorter ones need not be foretold."""
_LARGEST = 1e9  # thirty years; frames, too
_TRANSFORMS_PER_MEGAPIXEL = {
    "looking for hot pixels": (10.0, 10.0),
    "finding the scene's exposure": (120.0, 10.0),
    "finding the source's exposure": (20.0, 20.0),
    "frames": (110.0, 0.0),
    "seconds": (110.0, 0.0),
    "finding exposures": (48.0, 48.0),
    "photographing bead slides": (120.0, 120.0),
    "rehearsing all of it on a simulated bench of its own": (110.0, 110.0),
    "rehearsing on a simulated bench of its own": (110.0, 110.0),
}
"""Steps that compute light on a simulated bench: their time of the processor, in that of a picture of
1024 x 1024 which is transformed and back; where light has to be computed first, and where it is there."""
_ANALYSED = {"analysing": 45.0}
"""The same of steps that look at pictures of any bench, simulated or not."""
_TRANSFORMS = {
    "drawing": 140.0,
    "optics": 3300.0,
    "analyze": 950.0,
    "comparing": 19.0,
    "table 7.1": 75.0,
    "hologram": 23.0,
    "stability": 36.0,
    "analysing the surface": 280.0,
    "finding the screen": 1000.0,
    "aligning the mask": 14600.0,
    "aligning the demo's mask": 4800.0,
    "render the animal's light": 6500.0,
    "learning": 28000.0,
    "expose without saturating": 120.0,
    "dark frames and axial sweep": 510.0,
    "response over the field": 160.0,
    "photograph the scene in three colours": 650.0,
    "photograph lights in a volume": 280.0,
    "reconstruct the picture": 380.0,
    "reconstruct the volume": 200.0,
    "chart methods": 270.0,
    "write the pictures": 160.0,
    "testing cameras": 950.0,
    "testing solvers": 160.0,
    "testing bench": 250.0,
}
"""Transforms that steps take the first time, of any sensor; each of those that they count. Drawing is a page
with its library and the list of fonts; the others are by default options, and those of the demos."""
_COUNTED = {"blind deconvolution"}
"""Steps whose work goes with much that only their routine knows: :func:`counted`."""
_ALONE_IN_IT = "drawing"
"""Keeps to one thread."""
_FEW, _TRIED_S = 50.0, 0.05
"""Transforms that are not worth a try, and seconds of the processor that it takes."""
_ALONE = 1.2
"""Times as long as if all of it were shared among the threads."""
_of = ""
_megapixels = 0.0
_counted = 0.0
_is_simulated = False
_awaits_light: Callable[[], bool] = bool
_window = False


class Expected(NamedTuple):
    """How long a step will take, and by what: words after "as" or "longer than"."""

    seconds: float
    by: str


def about(
    what: str,
    *,
    megapixels: float = 0.0,
    simulated: bool = False,
    awaits_light: Callable[[], bool] = bool,
) -> None:
    """Say what the following steps belong to: a command, and then its bench, with its sensor.

    ``awaits_light`` says whether a simulated frame would have its light computed first.
    """
    global _of, _megapixels, _is_simulated, _awaits_light
    _of, _megapixels, _is_simulated, _awaits_light = what, megapixels, simulated, awaits_light


def counted(transforms: float) -> None:
    """Say what the following step computes, in transforms, where its routine has counted that."""
    global _counted
    _counted = transforms


def photographed_by(step: str, megapixels: float) -> float:
    """Return what a simulated bench computes in a step whose light is not there yet, in transforms."""
    return _TRANSFORMS_PER_MEGAPIXEL[step][0] * megapixels


def place() -> Path:
    """Return the file, in the user's cache; it may be removed at any time."""
    return cache_folder() / "times.json"


def seen() -> bool:
    """Whether somebody sees what is foretold: at a terminal, or in the window."""
    return _window or sys.stderr.isatty()


def in_a_window() -> None:
    """Say that the program has a window: what is done there is remembered too."""
    global _window
    _window = True


def expected(what: str, count: float = 1.0) -> Expected | None:
    """Return how long a step took last time, or takes elsewhere the first time; None: not known, or quick.

    ``count``: of how many it is, where it counts them.
    """
    try:
        return Expected(sane(recall(_key(what))), "last time")
    except (LookupError, TypeError, ValueError):
        step = what.casefold()
        transforms = _TRANSFORMS.get(step, 0.0) * count + _ANALYSED.get(step, 0.0) * _megapixels
        transforms += _counted if step in _COUNTED else 0.0
        if _is_simulated:
            awaited, here = _TRANSFORMS_PER_MEGAPIXEL.get(step, (0.0, 0.0))
            transforms += (awaited if _computes_light() else here) * _megapixels
        shared = step != _ALONE_IN_IT
        if transforms < _FEW or not seen():
            return None
        return Expected(computing_s(transforms, shared=shared), "a first guess")


def computing_s(transforms: float, *, shared: bool = True) -> float:
    """Return how long so many transforms take by the clock, as quick and as busy as this machine is now.

    ``shared``: among the threads.
    """
    return transforms * transform_s() * _waiting(shared=shared)


def transform_s() -> float:
    """Try how much of the processor's time it takes here to transform a picture of 1024 x 1024 and back."""
    import numpy as np
    from scipy import fft

    picture = np.zeros((1024, 1024), np.float32)
    fft.irfft2(fft.rfft2(picture))  # tables are made
    began_s, count = time.process_time(), 0
    while time.process_time() - began_s < _TRIED_S:
        fft.irfft2(fft.rfft2(picture))
        count += 1
    return (time.process_time() - began_s) / count


def _waiting(*, shared: bool) -> float:
    """Return how many times as long by the clock, as busy as the machine was during the last minute."""
    from recon.base.threads import get_threads

    threads, cores = get_threads() if shared else 1, len(os.sched_getaffinity(0))
    try:
        load = os.getloadavg()[0]
    except OSError:
        load = 0.0
    return (_ALONE if shared else 1.0) / min(threads, cores) * max((load + threads) / cores, 1.0)


@contextmanager
def kept(what: str) -> Iterator[None]:
    """Remember how long the block takes, unless it fails or nobody sees it."""
    key, began_s = _key(what), time.monotonic()
    yield
    took_s = time.monotonic() - began_s
    if took_s >= WORTH_S:
        remember(key, round(took_s, 2))


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


def _computes_light() -> bool:
    try:
        return seen() and bool(_awaits_light())
    except Exception:  # noqa: BLE001 - a device that fails says so in the step itself
        return False


def _key(what: str) -> str:
    computed = " with its light" if what.casefold() in _TRANSFORMS_PER_MEGAPIXEL and _computes_light() else ""
    return f"{_of}: {what}{computed}"


def _read() -> dict[str, Any]:
    try:
        found = json.loads(place().read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
