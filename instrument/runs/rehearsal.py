"""What the frames of a plan take on a simulated bench before any run on it: some are taken on one like it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from instrument.bench.bench import Bench, open_bench
from instrument.bench.config import BenchConfig, SharedConfig
from instrument.plan import Plan
from instrument.runs.acquire import record_of
from instrument.runs.pace import Pace
from instrument.runs.runner import Runner, RunStatus
from instrument.runs.writer import RunWriter

OF_EACH = 3
"""So many frames of a kind are taken: the first of a kind may load and compute what later ones find."""


@dataclass(slots=True)
class _Kind:
    """Frames that take equally long: under the same light, at a new place, a known one, or the last one."""

    steps: list[int]
    seconds: list[float]

    @property
    def all_s(self) -> float:
        """What all of them take: the first, the others as those after it."""
        first, *others = self.seconds
        later = sum(others) / len(others) if others else first
        return first + (len(self.steps) - 1) * later


def rehearse(
    plan: Plan, bench: Bench, on_progress: Callable[[int, int], object] | None = None
) -> Pace | None:
    """Take some frames of every kind that a plan has, on a simulated bench like an open one.

    That bench waits for nothing, and all it writes is removed: nothing of the open bench is asked to move or
    to light. ``on_progress`` gets frames taken and to take. None where a device is not simulated, or there is
    no plan for it to say about. Exceptions are those of a run.
    """
    kinds = _kinds(plan)
    todo = sorted(index for kind in kinds for index in kind.steps[:OF_EACH])
    ends: list[float] = []

    def taken(status: RunStatus) -> None:
        if status.done_here > len(ends):
            ends.append(time.perf_counter())
            if on_progress is not None:
                on_progress(len(ends), len(todo))

    with twin_of(bench) as made:
        if made is None:
            return None
        twin, folder = made
        if twin.stage is not None:
            twin.stage.home()
        rehearsed = plan.model_copy(
            update={"parts": tuple(p.model_copy(update={"interval_s": 0.0}) for p in plan.parts)}
        ).on(twin.led_array)
        writer = RunWriter.create(folder, label=plan.label, bench=record_of(twin), plan=rehearsed)
        begun = time.perf_counter()
        Runner(twin, rehearsed, writer, todo=todo, on_progress=taken).execute()
    took = dict(
        zip(todo, (after - before for before, after in zip([begun, *ends], ends, strict=False)), strict=True)
    )
    for kind in kinds:
        kind.seconds.extend(took[index] for index in kind.steps[:OF_EACH])
    frames = sum(len(kind.steps) for kind in kinds)
    return Pace(sum(kind.all_s for kind in kinds) / frames, f"a rehearsal of {len(todo)} of them")


@contextmanager
def twin_of(bench: Bench) -> Iterator[tuple[Bench, Path] | None]:
    """Open a simulated bench like an open one that waits for nothing, with a folder that goes at the end.

    None where a device is not simulated. Exceptions are those of opening a bench.
    """
    config = _at_once(bench.config)
    if config is None or len(bench.simulated_kinds) < len(bench.devices):
        yield None
        return
    with TemporaryDirectory(prefix="diffuserbench-rehearsal-") as folder, open_bench(config) as twin:
        try:
            yield twin, Path(folder)
        except BaseException as error:  # its notes tell of frames that are kept: these go with the folder
            error.__notes__ = [note for note in getattr(error, "__notes__", ()) if folder not in note]
            raise


def not_waited_s(twin: Bench) -> float:
    """Return the simulated seconds that a bench of :func:`twin_of` did not wait for."""
    clocks = (getattr(part, "clock", None) for part in twin.shared.values())
    return max((float(getattr(clock, "now_s", 0.0)) for clock in clocks), default=0.0)


def rehearsed(plan: Plan) -> int:
    """Return how many frames of a plan :func:`rehearse` takes."""
    return sum(len(kind.steps[:OF_EACH]) for kind in _kinds(plan))


def _at_once(config: BenchConfig) -> BenchConfig | None:
    """Return a bench whose simulated worlds wait for nothing; None without such a world."""
    shared = {
        name: SharedConfig(each.part, each.options.model_copy(update={"time_scale": 0.0}))
        for name, each in config.shared.items()
        if "time_scale" in type(each.options).model_fields
    }
    return replace(config, shared={**config.shared, **shared}) if shared else None


def _kinds(plan: Plan) -> list[_Kind]:
    """Sort a plan's steps by what takes equally long."""
    found: dict[tuple[Any, ...], _Kind] = {}
    seen: set[str] = set()
    before: str | None = None
    for step in plan.whole_steps(None):
        place = f"{step.source_um} {step.stage}"
        way = "stays" if place == before else "comes back" if place in seen else "goes on"
        decade = round(math.log2(step.average))
        key = (str(step.light), step.scene_lit, way, step.slm_image is not None, decade)
        found.setdefault(key, _Kind([], [])).steps.append(step.index)
        seen.add(place)
        before = place
    return list(found.values())
