"""Hold a plan against what a bench can do, and estimate it, without touching a device."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.stage import OVER, StageAxis, approached
from instrument.files.atomic import SPARE_BYTES
from instrument.files.errors import FileError, count, duration, ranges, size
from instrument.files.slm_image import read_slm_levels
from instrument.plan.led_shapes import LedPlaces
from instrument.plan.model import Part, Plan, PlanError, Step
from instrument.plan.positions import SourcePosition

_SHOWN_S = 0.1
BYTES_A_FRAME_BESIDE_THE_IMAGE = 6_000
"""Log line, folders and part-filled disk blocks of one stored frame."""


@dataclass(frozen=True)
class BenchAbilities:
    """What a plan is checked against: the bench's limits as they were read once."""

    frame_shape: tuple[int, ...]
    """``(height, width)`` or ``(height, width, 3)`` of the camera's frames."""
    frame_dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
    exposure_ms: float
    exposure_limits_ms: tuple[float, float]
    gain_limits: tuple[float, float]
    """The camera's present exposure and its limits."""
    stage_axes: tuple[StageAxis, ...] = ()
    """Empty without a stage."""
    stage_position: Mapping[str, float] | None = None
    """Where the stage is now."""
    stage_homed: bool = True
    """Whether the stage's positions refer to a known reference."""
    stage_target: Callable[[SourcePosition], Mapping[str, float]] | None = None
    """The stage position that puts the point source at ``(x, y, z)`` micrometres; None without a source that
    can be placed."""
    play: Mapping[str, float] = field(default_factory=dict)
    """Of the stage's axes: the source comes to its places from below (:func:`drivers.stage.approached`)."""
    can_switch_source: bool = True
    can_switch_scene: bool = True
    """Whether source and scene can be lit and darkened, by a device or by asking the operator."""
    no_source: str = ""
    """Why the LEDs light no point source; empty where they do."""
    n_leds: int = 0
    """0 without an LED array."""
    led_array: LedPlaces | None = None
    """Where its LEDs are, for patterns by name."""
    slm_shape: tuple[int, int] | None = None
    slm_settle_ms: float = 0.0
    has_trigger_wire: bool = False
    """Whether a wire of ``[trigger]`` lets hardware time the frames."""
    trigger_lines: tuple[str, ...] = ()
    trigger_edges: tuple[str, ...] = ()
    """What the camera's hardware trigger offers."""
    time_scale: float = 1.0
    """Real seconds that a second of exposures and motion takes: of a simulated bench, which may not wait."""
    free_bytes: int | None = None
    """Free space where the run will be kept; None leaves the disk unchecked."""

    def target(self, step: Step) -> Mapping[str, float]:
        """Return where a step puts the stage; empty where it stays."""
        if step.source_um is not None and self.stage_target is not None:
            return self.stage_target(step.source_um)
        return step.stage


@dataclass(frozen=True, slots=True)
class PlanEstimate:
    """What a plan will cost."""

    frames: int
    """Frames stored."""
    exposures: int
    """Frames taken, averaged ones counted singly."""
    moves: int
    approaches: int
    """Moves among them that go below a place first, because of an axis' play."""
    approach_seconds: float
    """What those cost."""
    total_bytes: int
    """Everything the run will write, metadata included."""
    seconds: float
    """Exposures, moves, settling and waiting; read-out and disk are not known beforehand."""
    waited_s: float
    """What of them goes by on the clock: a simulated bench's time may run faster, or not at all."""

    @property
    def time(self) -> str:
        """The seconds in words, and what of them goes by on the clock where that is another time."""
        return self._time("")

    @property
    def time_of_motion(self) -> str:
        """The same with what they are of: "23.0 s of exposure and motion"."""
        return self._time(" of exposure and motion")

    def _time(self, noun: str) -> str:
        words = f"{_shown(self.seconds)}{noun}"
        if self.waited_s == self.seconds:
            return words
        return f"{words} (simulated: {_shown(self.waited_s)} by the clock)"


def _shown(seconds: float) -> str:
    return duration(seconds) if seconds >= _SHOWN_S else f"less than {duration(_SHOWN_S)}"


def estimate(
    plan: Plan,
    abilities: BenchAbilities,
    *,
    todo: Collection[int] | None = None,
    start: Step | None = None,
) -> PlanEstimate:
    """Return what a plan, or the steps of it that are ``todo``, will cost on a bench."""
    steps = _steps(plan, todo, start)
    bytes_a_pixel = 4 if plan.averages else abilities.frame_dtype.itemsize  # a mean is float32
    frame_bytes = math.prod(abilities.frame_shape) * bytes_a_pixel
    speeds = {axis.name: axis.speed_per_s for axis in abilities.stage_axes}
    position = dict(abilities.stage_position or {})
    seconds, waited_s, begun, part, moves = 0.0, 0.0, (0.0, 0.0), -1, 0
    approaches, approach_seconds, seated = 0, 0.0, set[str]()
    slm_image, exposure_ms = None, abilities.exposure_ms
    for step in steps:
        if step.part != part:
            part, begun = step.part, (seconds - step.start_after_s, waited_s - step.start_after_s)
        seconds, waited_s = (
            max(now_s, part_s + step.start_after_s)
            for now_s, part_s in zip((seconds, waited_s), begun, strict=True)
        )
        took_s = 0.0
        target = abilities.target(step)
        if any(position.get(axis) != value for axis, value in target.items()):
            direct_s = _move_s(position, target, speeds)
            play = abilities.play if step.source_um is not None else {}
            path = approached(position, target, play, seated)
            way_s = 0.0
            for place in path:
                way_s += _move_s(position, place, speeds)
                position.update(place)
            moves += len(path)
            took_s += way_s
            approaches += len(path) - 1
            approach_seconds += way_s - direct_s
            seated |= target.keys()
        if step.slm_image is not None and step.slm_image != slm_image:
            slm_image = step.slm_image
            took_s += abilities.slm_settle_ms / 1e3
        exposure_ms = step.exposure_ms if step.exposure_ms is not None else exposure_ms
        took_s += step.average * exposure_ms / 1e3
        seconds, waited_s = seconds + took_s, waited_s + abilities.time_scale * took_s
    n = len(steps)
    return PlanEstimate(
        frames=n,
        exposures=sum(step.average for step in steps),
        moves=moves,
        approaches=approaches,
        approach_seconds=approach_seconds,
        total_bytes=n * (frame_bytes + BYTES_A_FRAME_BESIDE_THE_IMAGE),
        seconds=seconds,
        waited_s=waited_s,
    )


def _move_s(here: Mapping[str, float], target: Mapping[str, float], speeds: Mapping[str, float]) -> float:
    return max((abs(v - here.get(a, v)) / speeds.get(a, math.inf) for a, v in target.items()), default=0.0)


def _steps(plan: Plan, todo: Collection[int] | None, start: Step | None) -> list[Step]:
    if todo is None:
        return list(plan.steps())
    wanted = frozenset(todo)
    return [step for step in plan.whole_steps(start) if step.index in wanted]


def check(
    plan: Plan,
    abilities: BenchAbilities,
    *,
    todo: Collection[int] | None = None,
    start: Step | None = None,
) -> None:
    """Refuse a plan that the bench cannot carry out.

    Only the steps that are ``todo`` (None: all) are looked at; ``start`` is the bench's state before the
    first, for what the plan leaves as it is.

    Raises PlanError naming every reason with the steps it concerns.
    """
    found: dict[str, list[int]] = {}
    steps = _steps(plan, todo, start)
    for step in steps:
        for problem in _step_problems(step, abilities):
            found.setdefault(problem, []).append(step.index)
    problems = [
        f"step{'s' if len(steps) > 1 else ''} {ranges(steps)}: {problem}" for problem, steps in found.items()
    ]
    for number in sorted({step.part for step in steps}):
        problems.extend(_trigger_problems(plan.parts[number], abilities))
    for path in sorted({step.slm_image for step in steps if step.slm_image is not None}):
        problems.extend(_slm_image_problems(path, abilities))
    need = estimate(plan, abilities, todo=todo, start=start).total_bytes
    if abilities.free_bytes is not None and need + SPARE_BYTES > abilities.free_bytes:
        problems.append(
            f"{count(len(steps), 'frame')} need {size(need)} and {size(SPARE_BYTES)} to spare, but only "
            f"{size(abilities.free_bytes)} are free on the disk. Free some, or choose another folder."
        )
    if problems:
        raise PlanError(plan.label, problems)


def _step_problems(step: Step, abilities: BenchAbilities) -> Iterable[str]:
    yield from _position_problems(step, abilities)
    is_pattern = step.light.kind == "pattern" or step.light.is_named
    if is_pattern:
        if abilities.n_leds == 0:
            yield f'light "{step.light}", but the bench has no LED array.'
        elif beyond := [led[0] for led in step.light.leds if led[0] >= abilities.n_leds]:
            yield f"LED {beyond[0]} does not exist; the array has LEDs 0 to {abilities.n_leds - 1}."
        elif abilities.led_array is not None and step.light.on(abilities.led_array).kind == "off":
            yield f'light "{step.light}" lights no LED of this array.'
    if not is_pattern and not abilities.can_switch_source:
        yield f'light "{step.light}", but the bench has no LED array and nobody can be asked to see to it.'
    elif step.light.kind == "source" and abilities.no_source:
        yield f'light "{step.light}": {abilities.no_source}'
    if not abilities.can_switch_scene:
        yield (
            f"the scene must be {'lit' if step.scene_lit else 'dark'}, but nothing switches it and nobody "
            "can be asked to. Run it in a terminal, or see [scene] in bench.toml."
        )
    low, high = abilities.exposure_limits_ms
    if step.exposure_ms is not None and not low <= step.exposure_ms <= high:
        yield f"exposure {step.exposure_ms:g} ms is outside the camera's {low:g} to {high:g} ms."
    low, high = abilities.gain_limits
    if step.gain is not None and not low <= step.gain <= high:
        yield f"gain {step.gain:g} is outside the camera's {low:g} to {high:g}."
    if step.slm_image is not None and abilities.slm_shape is None:
        yield f"SLM image {step.slm_image}, but the bench has no SLM."


def _trigger_problems(part: Part, abilities: BenchAbilities) -> Iterable[str]:
    if part.timing == "stepped":
        return
    if part.timing == "hardware" and not abilities.has_trigger_wire:
        yield (
            f'part {part.label}: timing = "hardware", but the bench has no trigger wire: '
            "see [trigger] in bench.toml."
        )
    for what, asked, offered in (
        ("line", part.trigger_line, abilities.trigger_lines),
        ("edge", part.trigger_edge, abilities.trigger_edges),
    ):
        if asked is not None and asked not in offered:
            yield (
                f"part {part.label}: trigger_{what} {asked!r}, but the camera's are "
                f"{', '.join(offered) or 'none that can be chosen'}."
            )


def _position_problems(step: Step, abilities: BenchAbilities) -> Iterable[str]:
    if step.source_um is not None and abilities.stage_target is None:
        yield "a source position, but the bench has no stage that places its source."
        return
    axes = {axis.name: axis for axis in abilities.stage_axes}
    if not abilities.stage_homed and abilities.target(step):
        yield "a position, but the stage is not homed. Home it first."
    for name, value in abilities.target(step).items():
        if name not in axes:
            yield f"stage axis {name!r} does not exist; the stage has {', '.join(axes) or 'none'}."
        elif not axes[name].lower_limit <= value <= axes[name].upper_limit:
            yield (
                f"{name} = {value:g} is outside the stage's limits "
                f"{axes[name].lower_limit:g} to {axes[name].upper_limit:g}."
            )
        elif step.source_um is not None and _beneath(value, name, abilities) < axes[name].lower_limit:
            yield (
                f"{name} = {value:g} cannot be approached from below: the stage begins at "
                f"{axes[name].lower_limit:g}, and {OVER:g} times the axis' play of {abilities.play[name]:g} "
                "([stage] play) are needed. Choose a place farther up."
            )


def _beneath(value: float, name: str, abilities: BenchAbilities) -> float:
    return value - OVER * abilities.play.get(name, 0.0)


def _slm_image_problems(path: Path, abilities: BenchAbilities) -> Iterable[str]:
    if abilities.slm_shape is None:
        return
    try:
        shape = read_slm_levels(path).shape
    except FileError as error:
        yield str(error)
        return
    if shape != abilities.slm_shape:
        yield f"SLM image {path} is {shape}, but the SLM has {abilities.slm_shape} pixels."
