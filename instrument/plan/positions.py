"""Where a plan puts the point source or the stage: points, grids, depths evenly spaced in 1/z."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, model_validator

SourcePosition = tuple[float, float, float]
Spacing = Literal["linear", "dioptric"]


class PlanData(BaseModel):
    """Frozen, checked plan data; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Span(PlanData):
    """Evenly spaced values along one axis, both ends included.

    ``spacing = "dioptric"`` spaces them evenly in 1/value, as the planes of an axial calibration should be:
    a PSF's scale on the sensor goes with 1/z (Kuo 2020, Eq. 3.2 and Sec. 4.3).
    """

    start: FiniteFloat
    stop: FiniteFloat
    number: int = Field(ge=1, le=1_000_000)
    spacing: Spacing = "linear"

    @model_validator(mode="after")
    def _dioptric_needs_one_sign(self) -> Span:
        if self.spacing == "dioptric" and self.start * self.stop <= 0:
            raise ValueError("dioptric spacing needs start and stop of one sign, neither of them zero")
        if self.number == 1 and self.start != self.stop:
            raise ValueError("one value from start to stop: give start = stop, or number of at least 2")
        return self

    def values(self) -> tuple[float, ...]:
        """Return the values, in order from ``start`` to ``stop``."""
        if self.spacing == "linear":
            values = np.linspace(self.start, self.stop, self.number)
        else:
            values = 1.0 / np.linspace(1.0 / self.start, 1.0 / self.stop, self.number)
            values[0], values[-1] = self.start, self.stop
        return tuple(float(value) for value in values)


def _wrap_number(value: Any) -> Any:
    return (value,) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


Values = Annotated[Span | tuple[FiniteFloat, ...], BeforeValidator(_wrap_number)]
"""A number, a list of numbers, or a span."""


def _values(values: Span | tuple[float, ...]) -> tuple[float, ...]:
    return values.values() if isinstance(values, Span) else values


class SourcePoints(PlanData):
    """The point source at listed positions ``(x, y, z)``, micrometres from the aperture's centre."""

    kind: Literal["points"] = "points"
    points_um: tuple[tuple[FiniteFloat, FiniteFloat, FiniteFloat], ...] = Field(min_length=1)

    def sources(self) -> Iterator[SourcePosition]:
        """Yield the positions in order."""
        yield from self.points_um

    def __len__(self) -> int:
        return len(self.points_um)


class SourceGrid(PlanData):
    """The point source on a grid; the last axis named in ``order`` moves fastest.

    ``serpentine`` runs every other line backwards, which saves the stage the long way back.
    """

    kind: Literal["grid"] = "grid"
    x_um: Values = (0.0,)
    y_um: Values = (0.0,)
    z_um: Values
    order: Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"] = "zyx"
    serpentine: bool = False

    @model_validator(mode="after")
    def _no_axis_is_empty(self) -> SourceGrid:
        for axis in ("x_um", "y_um", "z_um"):
            if not _values(getattr(self, axis)):
                raise ValueError(f"{axis} has no values")
        return self

    def sources(self) -> Iterator[SourcePosition]:
        """Yield the positions in order."""
        axes = [_values(getattr(self, f"{axis}_um")) for axis in self.order]
        slots = ["xyz".index(axis) for axis in self.order]
        for indices in _walk(tuple(len(axis) for axis in axes), self.serpentine):
            position = [0.0, 0.0, 0.0]
            for slot, axis, index in zip(slots, axes, indices, strict=True):
                position[slot] = axis[index]
            yield (position[0], position[1], position[2])

    def __len__(self) -> int:
        return math.prod(len(_values(getattr(self, axis))) for axis in ("x_um", "y_um", "z_um"))


class StagePoints(PlanData):
    """The stage at listed positions, by the names of its axes (``x_um``, ``roll_mrad`` ...)."""

    kind: Literal["stage"] = "stage"
    points: tuple[dict[str, FiniteFloat], ...] = Field(min_length=1)

    def __len__(self) -> int:
        return len(self.points)


Positions = Annotated[SourcePoints | SourceGrid | StagePoints, Field(discriminator="kind")]


def _walk(shape: tuple[int, ...], serpentine: bool) -> Iterator[tuple[int, ...]]:
    """Yield the indices of an array of ``shape``, last axis fastest; serpentine: each step a neighbour's."""
    if not serpentine:
        yield from product(*map(range, shape))
        return
    for flat in product(*map(range, shape)):
        walked: list[int] = []
        for size, index in zip(shape, flat, strict=True):
            # A digit runs backwards when the walked digits before it sum to an odd number (reflected code).
            walked.append(size - 1 - index if sum(walked) % 2 else index)
        yield tuple(walked)
