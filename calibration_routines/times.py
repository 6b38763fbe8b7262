"""How long a procedure takes in all: by what it took on this bench last time.

A plan's estimate has exposures and motion. What comes on top (homing, looking for exposures, computing, and
routines whose next picture depends on the last one, which have no plan) is only known from having done it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from zlib import crc32

from instrument.files import kept_times
from instrument.files.errors import duration
from instrument.files.record import plain

if TYPE_CHECKING:
    from calibration_routines.procedure import Outlook, Procedure
    from instrument.bench.bench import Bench

IN_ALL = "In all, "
"""What a sentence begins with that tells the time of a whole procedure."""
_NO_MATTER = ("out", "overwrite")


def took_before(procedure: Procedure, bench: Bench, outlook: Outlook) -> tuple[str, ...]:
    """Return in words how long it will take in all, by how long it took; nothing where that is not known."""
    try:
        known = kept_times.recall(_key(procedure, bench, outlook))
        frames, took_s, planned_s = (kept_times.sane(number) for number in known)
        now_s = 0.0 if outlook.cost is None else outlook.cost.waited_s
        if took_s >= planned_s:  # what came on top of exposures and motion goes with the frames
            expected_s = now_s + (took_s - planned_s) * _frames(outlook) / frames
        else:  # quicker than planned: a simulated bench whose time runs faster
            expected_s = took_s * now_s / planned_s
    except (LookupError, TypeError, ValueError, ZeroDivisionError):
        return ()
    return (f"{IN_ALL}by what it took last time: about {duration(expected_s)}.",)


def first_guess(bench: Bench, outlook: Outlook) -> tuple[str, ...]:
    """Say how long it takes by its exposures and by what it computes; nothing where that is not known.

    Nor on a simulated bench, whose light is computed, too: that is rehearsed.
    """
    planned_s = 0.0 if outlook.cost is None else outlook.cost.waited_s
    waiting_s = planned_s + outlook.beside_s
    if not outlook.work or not waiting_s or bench.simulated_kinds:
        return ()
    computing_s = kept_times.computing_s(sum(transforms for _, transforms in outlook.work))
    return (
        f"{IN_ALL}by a first guess: about {duration(waiting_s + computing_s)}, {duration(waiting_s)} of it "
        "frames at the present exposure, the rest computing.",
    )


def took(procedure: Procedure, bench: Bench, outlook: Outlook, seconds: float) -> None:
    """Remember how long all of it took, and what was planned, unless nobody sees what is foretold."""
    planned_s = 0.0 if outlook.cost is None else outlook.cost.waited_s
    known = [_frames(outlook), round(seconds, 2), round(planned_s, 2)]
    kept_times.remember(_key(procedure, bench, outlook), known)


def _frames(outlook: Outlook) -> int:
    """Return the frames of the plan, which time goes with; 1 without a plan."""
    return 1 if outlook.cost is None else max(outlook.cost.frames, 1)


def _key(procedure: Procedure, bench: Bench, outlook: Outlook) -> str:
    """Return what it is known by: without a plan its options, too, but for where the result goes."""
    what = f"{type(procedure).__name__} {bench.config.label} {crc32(bench.config.text.encode()):08x}"
    if outlook.plan is not None:
        return f"{what} {outlook.plan.label}"
    return f"{what} {crc32(repr(_asked(plain(procedure))).encode()):08x}"


def _asked(options: Any) -> Any:
    if not isinstance(options, dict):
        return options
    return {name: _asked(value) for name, value in options.items() if name not in _NO_MATTER}
