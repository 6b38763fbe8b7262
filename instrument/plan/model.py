"""The plan of an acquisition, as data: ordered parts, each a product of a few loops, iterated into steps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    SerializerFunctionWrapHandler,
    StringConstraints,
    ValidationError,
    model_serializer,
    model_validator,
)

from drivers.led_array import LedPattern
from instrument.plan.errors import PlanError, plan_problems
from instrument.plan.led_shapes import WHITE, LedPlaces, LedShape
from instrument.plan.patterns import LED_PATTERNS, led_shape, shape_from_text, shape_text
from instrument.plan.positions import PlanData, Positions, SourcePosition, StagePoints
from recon.base.declare import changed

Label = Annotated[str, StringConstraints(min_length=1, max_length=80, pattern=r"^[^/\x00-\x1f]+$")]
Loop = Literal["repeat", "position", "light", "slm", "exposure"]
LOOPS: tuple[Loop, ...] = ("repeat", "position", "slm", "light", "exposure")
Level = Annotated[int, Field(ge=0, le=255)]
_WITHOUT_SHAPE = ("off", "source", "pattern")
"""Kinds of light that are no patterns by name."""


class Light(PlanData):
    """What the LED array shows during a step.

    ``off``: dark. ``source``: the bench's point source, as ``bench.toml`` describes it. ``pattern``: the
    listed LEDs, ``leds`` as ``[index, red, green, blue]`` with levels 0 to 255. Any other kind is a pattern
    of :mod:`instrument.plan.patterns` by name, its options beside it, in the colour ``rgb`` (white); the LEDs
    are found by :meth:`on` when the array is known.
    """

    kind: str
    description: str = ""
    leds: tuple[tuple[Annotated[int, Field(ge=0)], Level, Level, Level], ...] = ()
    rgb: tuple[Level, Level, Level] | None = None
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _options_beside(cls, data: Any) -> Any:
        """Take the options of a named pattern from beside its kind, or from a kind with options behind it."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        kind = data.get("kind")
        if isinstance(kind, str) and len(kind.split()) > 1:
            data["kind"], written = shape_from_text(kind)
            data = {**written, **data}
        if data.get("kind") not in _WITHOUT_SHAPE:
            given = dict(data.get("options", {}))
            given |= {name: data.pop(name) for name in list(data) if name not in cls.model_fields}
            data["options"] = given
        return data

    @model_validator(mode="after")
    def _kind_and_the_rest_agree(self) -> Light:
        if (self.kind == "pattern") != bool(self.leds):
            raise ValueError('leds belong to kind = "pattern", which needs at least one')
        if self.kind in _WITHOUT_SHAPE and (self.options or self.rgb is not None):
            raise ValueError(f'kind = "{self.kind}" has no options and no rgb')
        if self.is_named and self.kind not in LED_PATTERNS:
            known = ", ".join((*_WITHOUT_SHAPE, *LED_PATTERNS))
            raise ValueError(f"light {self.kind!r} is not known; there are {known}")
        if self.is_named:
            led_shape(self.kind, self.options)
        return self

    @model_serializer(mode="wrap")
    def _with_options_beside(self, dumped: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = dumped(self)
        options = data.pop("options", {})
        if self.rgb is None:
            data.pop("rgb", None)
        return {**data, **options}

    @classmethod
    def of(cls, pattern: LedPattern) -> Light:
        """Return the light of a pattern that was composed for an LED array."""
        leds = tuple((index, *rgb) for index, rgb in pattern.levels)
        if not leds:
            return OFF
        return cls(kind="pattern", description=pattern.description, leds=leds)

    @classmethod
    def named(cls, shape: LedShape, rgb: tuple[int, int, int] | None = None) -> Light:
        """Return the light of a named pattern."""
        options = {option.name: value for option, value in changed(shape)}
        return cls(kind=shape.name, rgb=rgb, options=options)

    @property
    def is_named(self) -> bool:
        """Whether it is a pattern by name, whose LEDs :meth:`on` finds."""
        return self.kind not in _WITHOUT_SHAPE

    def on(self, array: LedPlaces) -> Light:
        """Return the light with its LEDs listed, for an array; itself where it is no pattern by name."""
        if not self.is_named:
            return self
        return Light.of(led_shape(self.kind, self.options).on(array, self.rgb or WHITE))

    def pattern(self) -> LedPattern:
        """Return the LED pattern of a light of kind ``pattern``."""
        name = self.description or f"LEDs {', '.join(str(led[0]) for led in self.leds)}"
        return LedPattern(name, tuple((led[0], (led[1], led[2], led[3])) for led in self.leds))

    def __str__(self) -> str:
        if self.is_named:
            colour = "" if self.rgb is None else f" rgb {self.rgb}"
            return shape_text(led_shape(self.kind, self.options)) + colour
        return self.kind if self.kind != "pattern" else self.pattern().description


OFF = Light(kind="off")
SOURCE = Light(kind="source")


class Part(PlanData):
    """One part of a plan: the product of its loops, the first in ``order`` slowest.

    Attributes
    ----------
    label : str
        What the frames are, for whoever analyses them: ``"dark"``, ``"psf"``, ``"scene"`` ...
    positions
        Where the source or the stage goes; None leaves it where it is.
    light, slm_images, exposures_ms, gains
        What the other loops run over. An empty tuple leaves the device as it is; SLM images are files
        (8-bit grey levels), relative paths seen from the plan's file. Exposure and gain run together when
        both have the same number of values; one gain serves all exposures.
    scene_lit : bool
        Whether the scene (screen, sample) glows.
    average : int
        Frames averaged into the one that is stored.
    repeats : int
        How often all of it is done again; ``interval_s`` is the time from start to start of a repeat
        (0: at once).
    """

    label: Label
    positions: Positions | None = None
    light: tuple[Light, ...] = (OFF,)
    slm_images: tuple[Path, ...] = ()
    exposures_ms: tuple[PositiveFloat, ...] = ()
    gains: tuple[PositiveFloat, ...] = ()
    scene_lit: bool = False
    average: int = Field(default=1, ge=1, le=65_536)
    repeats: int = Field(default=1, ge=1)
    interval_s: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
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

    A plan is data: it can be counted, checked (:mod:`instrument.plan.limits`), written to JSON and read from
    TOML or JSON without any device.
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

        Raises
        ------
        PlanError
            Naming every mistake but unknown keys.
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

        Raises
        ------
        PlanError
            Naming every mistake, when the data describe none.
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
