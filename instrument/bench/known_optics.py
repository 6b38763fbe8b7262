"""The optics of a bench: as configured, else as its devices know them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from drivers.camera import Camera
from drivers.device import SharedPart
from instrument.bench.config import GeometryTable
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
