"""Where the point source is for each position of the stage that carries it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.stage import Stage
from instrument.files.errors import BenchError

Position = tuple[float, float, float]
AXES = ("x_um", "y_um", "z_um")


@dataclass(frozen=True, slots=True)
class SourceMount:
    """The point source on its stage.

    Attributes
    ----------
    stage : Stage
    offset_um : tuple of float
        Where the source is, from the diffuser's centre, when every axis reads zero.
    """

    stage: Stage
    offset_um: Position

    @property
    def position_um(self) -> Position:
        """Where the source is now, as the stage reads."""
        reading = self.stage.position()
        x, y, z = (reading.get(axis, 0.0) + offset for axis, offset in zip(AXES, self.offset_um, strict=True))
        return (x, y, z)

    def target(self, x_um: float | None, y_um: float | None, z_um: float | None) -> dict[str, float]:
        """Return the stage position that brings the source to a place; None leaves a coordinate as it is.

        Raises
        ------
        BenchError
            When the stage lacks the axis that would have to move.
        """
        axes = {axis.name for axis in self.stage.axes}
        target = {}
        for axis, value, offset in zip(AXES, (x_um, y_um, z_um), self.offset_um, strict=True):
            if value is None:
                continue
            if axis in axes:
                target[axis] = value - offset
            elif abs(value - offset) > 1e-6:
                raise BenchError(
                    f"{self.stage.name} has no axis {axis}, so the source stays at {axis} = {offset:g}; "
                    f"it cannot go to {value:g}. Axes: {', '.join(sorted(axes))}."
                )
        return target
