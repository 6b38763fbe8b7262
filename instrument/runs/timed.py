"""Steps of a plan that hardware times: which go into one sequence, and their photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from drivers.frame import Frame
from drivers.led_array import OFF, LedArray, LedPattern
from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.bench.sequence import Wire, take_sequence
from instrument.files.errors import BenchError
from instrument.files.slm_image import read_slm_levels
from instrument.plan import Plan, Step

_ALIKE = ("exposure_ms", "gain", "source_um", "stage", "scene_lit", "start_after_s")
"""Fields of the steps of one sequence that are the same."""

Group = tuple[Wire | None, list[Step]]
"""Steps that are taken by one sequence over a wire; one step without a wire is taken by the program."""


class TimedSteps:
    """Puts successive steps that differ in the light alone (or the SLM image alone) into sequences."""

    def __init__(self, bench: Bench, plan: Plan) -> None:
        self._bench = bench
        self._plan = plan

    def groups(self, steps: Iterable[Step]) -> Iterator[Group]:
        """Yield the steps in order, those of one sequence together.

        Raises BenchError when a part with ``timing = "hardware"`` has a step that no sequence can have.
        """
        wire: Wire | None = None
        group: list[Step] = []
        for step in steps:
            own = self._wire(step)
            if group and own == wire and own is not None and self._joins(own, group, step):
                group.append(step)
                continue
            if group:
                yield self._settled(wire, group)
            wire, group = own, [step]
        if group:
            yield self._settled(wire, group)

    def _wire(self, step: Step) -> Wire | None:
        """Return the wire that a step can be taken over."""
        part = self._plan.parts[step.part]
        source = self._bench.trigger_source
        if part.timing == "stepped" or source is None:
            return None
        wire = Wire(self._bench, part.trigger_line, part.trigger_edge)
        shows = isinstance(source, LedArray) or step.slm_image is not None
        if shows and step.average <= wire.most:
            return wire
        if part.timing == "hardware":
            why = "has no SLM image" if not shows else f"has more frames than one sequence ({wire.most})"
            raise BenchError(f'{step}: timing = "hardware", but it {why}.')
        return None

    def _joins(self, wire: Wire, group: Sequence[Step], step: Step) -> bool:
        first = group[0]
        other = "slm_image" if isinstance(wire.source, LedArray) else "light"
        alike = all(getattr(step, name) == getattr(first, name) for name in (*_ALIKE, other))
        return alike and sum(one.average for one in group) + step.average <= wire.most

    def _settled(self, wire: Wire | None, group: list[Step]) -> Group:
        """Leave a single exposure to the program, unless its part asks for hardware."""
        one = len(group) == 1 and group[0].average == 1
        asks = self._plan.parts[group[0].part].timing == "hardware"
        return (None if one and not asks else wire, group)

    def words(self) -> str:
        """Return how many frames hardware would time, in a sentence."""
        sequences = [steps for wire, steps in self.groups(self._plan.steps()) if wire is not None]
        timed = sum(map(len, sequences))
        line = f" on {self._bench.camera.trigger_line}" if self._bench.camera.trigger_line else ""
        return (
            f"{timed} of {len(self._plan)} frames are timed by hardware, in "
            f"{len(sequences)} sequence{'' if len(sequences) == 1 else 's'}; the camera's pulses come{line}, "
            f"{self._bench.camera.trigger_edge} edge."
        )

    def may_step(self, steps: Sequence[Step]) -> bool:
        """Whether steps may be taken by the program where their sequence is refused."""
        return all(self._plan.parts[step.part].timing == "auto" for step in steps)


def left_to(wire: Wire) -> str:
    """Return the field of a step that a wire's source sets by itself."""
    return "light" if isinstance(wire.source, LedArray) else "slm_image"


def take_steps(
    wire: Wire, steps: Sequence[Step], on_frame: Callable[[Frame], object]
) -> tuple[list[Snapshot], tuple[str, ...]]:
    """Take the photographs of steps by one sequence; returns them and what went wrong before, in words.

    Raises as :func:`instrument.bench.sequence.take_sequence`.
    """
    shown: list[Any] = [_shown(wire, step) for step in steps for _ in range(step.average)]
    taken = take_sequence(wire, shown, on_frame=on_frame)
    frames = iter(taken.frames)
    return [Snapshot.of([next(frames) for _ in range(step.average)]) for step in steps], taken.troubles


def _shown(wire: Wire, step: Step) -> Any:
    """Return what the source shows for a step."""
    if not isinstance(wire.source, LedArray):
        assert step.slm_image is not None
        return read_slm_levels(step.slm_image)
    return light_pattern(wire.bench, step)


def light_pattern(bench: Bench, step: Step) -> LedPattern:
    """Return the LED pattern of a step's light."""
    if step.light.kind == "source":
        return bench.source_pattern
    return OFF if step.light.kind == "off" else step.light.pattern()
