"""The plan of an acquisition, as data: ordered parts, each a product of a few loops, iterated into steps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    StringConstraints,
    ValidationError,
    model_validator,
)

from instrument.files.atomic import protect, write_text
from instrument.files.errors import BenchError, FileError, mistake_in_words
from instrument.files.reading import parse_json, parse_toml, read_bytes
from instrument.plan.led_shapes import LedPlaces
from instrument.plan.patterns import OFF, Light
from instrument.plan.positions import PlanData, Positions, SourcePosition, StagePoints

Label = Annotated[str, StringConstraints(min_length=1, max_length=80, pattern=r"^[^/\x00-\x1f]+$")]
Loop = Literal["repeat", "position", "light", "slm", "exposure"]
Timing = Literal["auto", "stepped", "hardware"]
LOOPS: tuple[Loop, ...] = ("repeat", "position", "slm", "light", "exposure")


class Part(PlanData):
    """One part of a plan: the product of its loops, the first in ``order`` slowest."""

    label: Label
    """What the frames are, for whoever analyses them: ``"dark"``, ``"psf"``, ``"scene"`` ..."""
    positions: Positions | None = None
    """Where the source or the stage goes; None leaves it where it is."""
    light: tuple[Light, ...] = (OFF,)
    slm_images: tuple[Path, ...] = ()
    exposures_ms: tuple[PositiveFloat, ...] = ()
    gains: tuple[PositiveFloat, ...] = ()
    """As light, SLM images and exposures, what loops run over; empty: the device stays as it is. Images are
    files (8-bit grey levels), relative paths seen from the plan's file. Exposure and gain run together when
    both have the same number of values; one gain serves all exposures."""
    scene_lit: bool = False
    """Whether the scene (screen, sample) glows."""
    average: int = Field(default=1, ge=1, le=65_536)
    """Frames averaged into the one that is stored."""
    repeats: int = Field(default=1, ge=1, le=1_000_000)
    """How often all of it is done again; ``interval_s`` is the time from start to start of a repeat (0: at
    once)."""
    interval_s: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    timing: Timing = "auto"
    """What times the frames: ``"hardware"``: the LED array or SLM plays its patterns as a sequence, and a
    trigger wire (``[trigger]`` of ``bench.toml``) has the camera expose; ``"stepped"``: one frame after the
    other by the program; ``"auto"``: by hardware where there is a wire and the part allows it."""
    trigger_line: str | None = None
    trigger_edge: Literal["rising", "falling"] | None = None
    """Of the camera's hardware trigger; None: as ``[camera]`` has them."""
    order: tuple[Loop, ...] = LOOPS

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, data: Any) -> Any:
        """Let files say ``light = "source"``, ``exposure_ms = 20``, ``gain = 2``, ``slm_image = "a.png"``."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        for short, long in (("exposure_ms", "exposures_ms"), ("gain", "gains"), ("slm_image", "slm_images")):
            if short in data:
                if long in data:
                    raise ValueError(f"give {short} or {long}, not both")
                data[long] = (data.pop(short),)
        light = data.get("light")
        if isinstance(light, (str, Light, Mapping)):
            light = (light,)
        if isinstance(light, (list, tuple)):
            data["light"] = tuple({"kind": item} if isinstance(item, str) else item for item in light)
        return data

    @model_validator(mode="after")
    def _loops_make_sense(self) -> Part:
        if sorted(self.order) != sorted(LOOPS):
            raise ValueError(f"order must name each of {', '.join(LOOPS)} once, not {', '.join(self.order)}")
        if len(self.gains) > 1 and len(self.gains) != len(self.exposures_ms):
            raise ValueError("several gains need as many exposures_ms (they are set together)")
        if not self.light:
            raise ValueError('light is empty; say "off" for darkness')
        return self

    def __len__(self) -> int:
        return (
            self.repeats
            * (len(self.positions) if self.positions is not None else 1)
            * len(self.light)
            * max(1, len(self.slm_images))
            * max(1, len(self.exposures_ms))
        )

    def steps(self, first_index: int = 0, part: int = 0) -> Iterator[Step]:
        """Yield the part's steps in order."""
        positions: tuple[tuple[SourcePosition | None, dict[str, float]], ...] = ((None, {}),)
        if isinstance(self.positions, StagePoints):
            positions = tuple((None, point) for point in self.positions.points)
        elif self.positions is not None:
            positions = tuple((source, {}) for source in self.positions.sources())
        loops: dict[Loop, tuple[Any, ...]] = {
            "repeat": tuple(range(self.repeats)),
            "position": positions,
            "light": self.light,
            "slm": self.slm_images or (None,),
            "exposure": self._exposures(),
        }
        for offset, values in enumerate(product(*(loops[name] for name in self.order))):
            at = dict(zip(self.order, values, strict=True))
            source_um, stage = at["position"]
            exposure_ms, gain = at["exposure"]
            yield Step(
                index=first_index + offset,
                part=part,
                repeat=at["repeat"],
                label=self.label,
                source_um=source_um,
                stage=stage,
                light=at["light"],
                scene_lit=self.scene_lit,
                slm_image=at["slm"],
                exposure_ms=exposure_ms,
                gain=gain,
                average=self.average,
                start_after_s=at["repeat"] * self.interval_s,
            )

    def _exposures(self) -> tuple[tuple[float | None, float | None], ...]:
        exposures: tuple[float | None, ...] = self.exposures_ms or (None,)
        gains: tuple[float | None, ...] = self.gains or (None,)
        if len(gains) == 1:
            gains *= len(exposures)
        return tuple(zip(exposures, gains, strict=True))


class Step(PlanData):
    """One stored frame of a plan: what to set, and how to take it. None leaves a device as it is."""

    index: int
    """Place in the plan, from 0; also the place of its frame in the run's image array."""
    part: int
    repeat: int
    label: str
    source_um: SourcePosition | None = None
    stage: dict[str, float] = Field(default_factory=dict)
    """Stage axis to position, where the plan addresses the stage itself."""
    light: Light = OFF
    scene_lit: bool = False
    slm_image: Path | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    average: int = 1
    start_after_s: float = 0.0
    """Seconds after the part's first step before which this one must not begin."""

    def after(self, before: Step | None) -> Step:
        """Return this step with what it leaves as it is filled in from the step before."""
        if before is None:
            return self
        filled: dict[str, Any] = {}
        if self.source_um is None and not self.stage:
            filled["source_um"], filled["stage"] = before.source_um, before.stage
        for name in ("slm_image", "exposure_ms", "gain"):
            if getattr(self, name) is None:
                filled[name] = getattr(before, name)
        return self.model_copy(update=filled)

    def __str__(self) -> str:
        words = [f"step {self.index} ({self.label})", f"light {self.light}"]
        if self.source_um is not None:
            words.append("source at ({:g}, {:g}, {:g}) um".format(*self.source_um))
        if self.stage:
            words.append("stage at " + ", ".join(f"{axis} {value:g}" for axis, value in self.stage.items()))
        if self.exposure_ms is not None:
            words.append(f"{self.exposure_ms:g} ms")
        return ", ".join(words)


class Plan(PlanData):
    """What will be acquired: parts done one after the other, each step storing one frame.

    A plan is data: it can be counted, checked (:mod:`instrument.plan.abilities`), written to JSON and read
    from TOML or JSON without any device.
    """

    label: Label
    parts: tuple[Part, ...] = Field(min_length=1)

    def __len__(self) -> int:
        """Return the number of steps, which is the number of frames stored."""
        return sum(len(part) for part in self.parts)

    def steps(self) -> Iterator[Step]:
        """Yield every step in order."""
        first = 0
        for number, part in enumerate(self.parts):
            yield from part.steps(first, number)
            first += len(part)

    def whole_steps(self, start: Step | None = None) -> Iterator[Step]:
        """Yield every step with what it leaves as it is filled in from the steps before it.

        ``start`` stands for the bench's state before the first step.
        """
        before = start
        for step in self.steps():
            before = step.after(before)
            yield before

    @property
    def exposures(self) -> int:
        """Number of exposures, averaged frames counted singly."""
        return sum(len(part) * part.average for part in self.parts)

    @property
    def averages(self) -> bool:
        """Whether any stored frame is an average, so that frames are stored as float32."""
        return any(part.average > 1 for part in self.parts)

    @property
    def slm_images(self) -> tuple[Path, ...]:
        """The SLM images that the plan names, each once."""
        return tuple(dict.fromkeys(path for part in self.parts for path in part.slm_images))

    def with_slm_images(self, place: Callable[[Path], Path]) -> Plan:
        """Return the plan with every SLM image at the path that ``place`` gives for it."""
        parts = (
            part.model_copy(update={"slm_images": tuple(map(place, part.slm_images))}) for part in self.parts
        )
        return self.model_copy(update={"parts": tuple(parts)})

    def on(self, array: LedPlaces | None) -> Plan:
        """Return the plan with the LEDs of every named pattern listed, as an array lights them.

        What a run keeps: it does not change when a pattern is described otherwise one day.
        """
        if array is None or not any(light.is_named for part in self.parts for light in part.light):
            return self
        parts = (
            part.model_copy(update={"light": tuple(light.on(array) for light in part.light)})
            for part in self.parts
        )
        return self.model_copy(update={"parts": tuple(parts)})

    def to_json(self) -> str:
        """Return the plan as JSON; :meth:`from_json` gives it back equal."""
        return self.model_dump_json(indent=1)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Return the plan that :meth:`to_json` wrote."""
        return cls.model_validate_json(text)

    @classmethod
    def with_unknown(cls, data: Any, name: Path | str = "plan") -> tuple[Plan, tuple[str, ...]]:
        """Return the plan that plain data describe, and the keys that a newer program may have added.

        Raises PlanError naming every mistake but unknown keys.
        """
        try:
            return cls.model_validate(data), ()
        except ValidationError as error:
            extra = [e["loc"] for e in error.errors(include_url=False) if e["type"] == "extra_forbidden"]
        data = json.loads(json.dumps(data))
        for location in extra:
            _leave_out(data, location)
        return cls.checked(data, name), tuple(".".join(map(str, location)) for location in extra)

    @property
    def digest(self) -> str:
        """SHA-256 of the plan's JSON: equal for equal plans."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    @classmethod
    def checked(cls, data: Any, name: Path | str = "plan") -> Plan:
        """Return the plan that plain data describe.

        Raises PlanError naming every mistake, when the data describe none.
        """
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise PlanError(name, plan_problems(error)) from None


def _leave_out(data: Any, location: Sequence[int | str]) -> None:
    """Take a key out of nested data; the names of a union's members, which are no keys, are passed over."""
    *way, last = location
    for step in way:
        if isinstance(step, int) or step in data:
            data = data[step]
    data.pop(last, None)


class PlanError(BenchError):
    """A plan that cannot be carried out: every reason at once. Nothing has moved."""

    def __init__(self, name: Path | str, problems: Sequence[str]) -> None:
        self.name = name
        self.problems = tuple(problems)
        count = len(self.problems)
        head = f"{name}: {count} problem{'s' if count != 1 else ''} in the plan. Nothing has moved."
        super().__init__("\n  ".join((head, *self.problems)))


def plan_problems(error: ValidationError) -> tuple[str, ...]:
    """Return a validation's findings as sentences that name the place."""
    mistakes = error.errors(include_url=False)
    places = [found["loc"] for found in mistakes]
    return tuple(
        f"{_place(found['loc'])}: {mistake_in_words(found)}"
        + (f" (found {found['input']!r:.80})" if not isinstance(found["input"], Mapping) else "")
        for found in mistakes
        # A list whose every item is wrong counts as empty too; its items' own mistakes say it better.
        if found["type"] != "too_short"
        or not any(place[: len(found["loc"])] == found["loc"] != place for place in places)
    )


def _place(location: tuple[int | str, ...]) -> str:
    return (
        "".join(f"[{item}]" if isinstance(item, int) else f".{item}" for item in location).lstrip(".")
        or "plan"
    )


def load_plan(path: Path | str) -> Plan:
    """Read a plan from a TOML or JSON file. Relative paths of SLM images are seen from the file's folder.

    Raises FileError when there is no such file, or its name ends neither in .toml nor in .json; PlanError
    naming every mistake in it.
    """
    path = Path(path)
    reader = _reader(path)
    if path.is_dir():
        raise FileError(path, "is a folder; a plan is a file.")
    try:
        data = reader(read_bytes(path).decode())
    except FileNotFoundError:
        raise FileError(path, "no such plan file.") from None
    except UnicodeDecodeError:
        raise FileError(path, "is no text file.", "A plan is a TOML or JSON file.") from None
    except ValueError as error:  # of tomllib and json alike; both name the line
        raise PlanError(path, [str(error)]) from None
    plan = Plan.checked(data, path).with_slm_images(lambda image: path.parent / image)
    protect(path, *plan.slm_images)
    return plan


def save_plan(plan: Plan, path: Path | str) -> None:
    """Write a plan as TOML or JSON, by the file's suffix; :func:`load_plan` reads it back equal."""
    path = Path(path)
    is_toml = _reader(path) is parse_toml
    write_text(path, plan_toml(plan) if is_toml else plan.to_json() + "\n")


def plan_toml(plan: Plan) -> str:
    """Return a plan as TOML, without what is as by default."""
    data = plan.model_dump(mode="json", exclude_defaults=True)
    for part, model in zip(data["parts"], plan.parts, strict=True):
        if model.positions is not None:
            part["positions"] = {"kind": model.positions.kind, **part["positions"]}
    lines = [f"label = {_toml(data['label'])}"]
    for part in data["parts"]:
        lines += ["", "[[parts]]", *(f"{key} = {_toml(value)}" for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _reader(path: Path) -> Any:
    readers: Mapping[str, Any] = {".toml": parse_toml, ".json": partial(parse_json, by_hand=True)}
    if path.suffix.lower() not in readers:
        raise FileError(path, f"a plan's name ends in {' or '.join(readers)}.")
    return readers[path.suffix.lower()]


def _toml(value: Any) -> str:
    """Return a JSON value in TOML's notation, inline."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    # Strings, numbers and booleans are written alike in both; a TOML basic string takes JSON's escapes.
    return json.dumps(value, ensure_ascii=False)
