"""What frames take beside exposure and motion: what they took in the newest run like it on the bench."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from zlib import crc32

from drivers.errors import DeviceError
from instrument.files import kept_times
from instrument.files.errors import BenchError, duration
from instrument.plan.abilities import BenchAbilities, estimate
from instrument.plan.model import Plan
from instrument.runs.inspection import run_paths
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_files import BENCH_TOML

LOOKED_AT = 12
"""So many of the newest runs are looked through."""


@dataclass(frozen=True, slots=True)
class Pace:
    """What a frame takes beside exposure and motion: read-out, writing, settling; computing, where simulated.

    Attributes
    ----------
    frame_s : float
    run : str
        The run in which it was measured.
    """

    frame_s: float
    run: str

    def words(self, plan: Plan, abilities: BenchAbilities) -> str:
        """Say how long a plan will take with it."""
        cost = estimate(plan, abilities)
        whole_s = cost.waited_s + cost.frames * self.frame_s
        return f"Its frames, with read-out and writing as in {self.run}: about {duration(whole_s)}."


def pace_of(plan: Plan, abilities: BenchAbilities, folder: Path, toml: str) -> Pace | None:
    """Return the pace of the newest completed run in ``folder`` that is like a plan, on the same bench.

    Like it is a run whose plan has the same label; else any. Where none tells, what was kept of the newest on
    that bench, wherever it lies. None without one.
    """
    others: list[Pace] = []
    for path in islice(reversed(run_paths(folder)), LOOKED_AT):
        try:
            run = Run.open(path)
            found = _measured(run, abilities, toml)
        except (BenchError, DeviceError, OSError, LookupError, ValueError):
            continue
        if found is not None and run.plan is not None and run.plan.label == plan.label:
            return found
        others += [] if found is None else [found]
    return others[0] if others else _kept(toml)


def keep_pace(path: Path, abilities: Callable[[], BenchAbilities], toml: str) -> None:
    """Keep the pace of a run that has just ended, unless nobody sees what is foretold or it tells none.

    A device that fails when its ``abilities`` are asked for spoils nothing: the run is over.
    """
    if not kept_times.seen():
        return
    try:
        found = _measured(Run.open(path), abilities(), toml)
    except (BenchError, DeviceError, OSError, LookupError, ValueError):
        return
    if found is not None:
        kept_times.remember(_key(toml), [round(found.frame_s, 4), found.run])


def _kept(toml: str) -> Pace | None:
    try:
        frame_s, run = kept_times.recall(_key(toml))
        return Pace(kept_times.sane(frame_s), str(run))
    except (LookupError, TypeError, ValueError):
        return None


def _key(toml: str) -> str:
    return f"a frame of {crc32(toml.encode()):08x}"


def _measured(run: Run, abilities: BenchAbilities, toml: str) -> Pace | None:
    """Return the pace of a run that went through at one go."""
    kinds = [event.get("kind") for event in run.events]
    once = kinds.count("started") == 1 and "paused" not in kinds
    if run.plan is None or run.condition is not RunCondition.COMPLETED or not once or len(run.records) < 3:
        return None
    if run.files.text(BENCH_TOML) != toml:
        return None
    first, last = (run.records[index].metadata for index in (min(run.records), max(run.records)))
    took_s = 1e-9 * (last.host_time_ns - first.host_time_ns)
    if took_s <= 0:  # it went on after the computer was started anew
        return None
    begun = replace(abilities, stage_position=abilities.target(next(iter(run.plan.steps()))))
    further = sorted(run.records)[1:]
    cost = estimate(run.plan, begun, todo=further, start=run.start)
    return Pace(max(took_s - cost.waited_s, 0.0) / len(further), run.path.name)
