"""Where things are: the point source for each position of its stage, and the optics as devices know them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from drivers.camera import Camera
from drivers.device import SharedPart
from drivers.stage import Stage
from instrument.bench.config import GeometryTable
from instrument.files.errors import BenchError
from recon.types import Geometry


@runtime_checkable
class KnownOptics(Protocol):
    """A shared part that knows the optics between scene and sensor: the simulated world."""

    distance_um: float
    """From the diffuser to the sensor."""
    aperture_mm: tuple[float, float]
    """``(height, width)``."""


def known_geometry(table: GeometryTable, camera: Camera, shared: Iterable[SharedPart]) -> Geometry:
    """Return the geometry for the camera's present binning; what nobody knows stays None."""
    known = next((part for part in shared if isinstance(part, KnownOptics)), None)
    distance_mm, aperture_mm = (known.distance_um / 1e3, known.aperture_mm) if known else (None, None)
    return Geometry(
        pixel_pitch_um=(table.pixel_pitch_um or camera.pixel_pitch_um) * camera.binning,
        diffuser_distance_mm=table.diffuser_distance_mm or distance_mm,
        aperture_mm=table.aperture_mm or aperture_mm,
        wavelength_nm=table.wavelength_nm,
    )


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
