"""What an axial sweep measures: its planes, and how many are needed.

A camera behind a diffuser is calibrated by moving a point source along its axis and keeping one PSF a depth
(Kuo 2020, Sec. 4.3). The planes are evenly spaced in 1/z, because that is how the size of the pattern changes
(Eq. 4.7). One plane alone is the calibration of a photographic camera (Sec. 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration_routines.psf.sweep_plan import Position, settings_problems
from instrument.files.errors import BenchError, SettingsError
from instrument.plan import Span
from recon.types import Geometry


@dataclass(frozen=True, slots=True)
class AxialSweep:
    """What to measure.

    Attributes
    ----------
    z_min_um, z_max_um : float
        Nearest and farthest plane, from the diffuser. Equal for a single PSF.
    planes : int
    x_um, y_um : float
        Where the source stands laterally.
    average : int
        Frames a plane; all are stored, their mean is the PSF (Kuo 2020, Sec. 6.4: 4).
    dark_frames : int
        Frames without light, at the shortest and at the longest exposure each.
    target : float
        Fraction of full scale for the 99.9th percentile of each PSF.
    dct_order : int
        Lowest DCT coefficients removed along each axis, against stray light; 0 removes none.
    binning : int
        Software binning of the PSFs, on top of the camera's.
    retakes : int
        How often planes that saturate or slipped are taken again.
    by_hand : bool
        One plane only: the source stands where it was put by hand, nothing moves.
    reference_every : int
        Planes between two visits to the middle plane, which tell whether the source drifts; 0: none.
    """

    z_min_um: float
    z_max_um: float
    planes: int = 1
    x_um: float = 0.0
    y_um: float = 0.0
    average: int = 4
    dark_frames: int = 4
    target: float = 0.7
    dct_order: int = 0
    binning: int = 1
    retakes: int = 1
    by_hand: bool = False
    reference_every: int = 16

    kind: ClassVar[str] = "axial"

    def __post_init__(self) -> None:
        problems: list[tuple[str, str]] = []
        if not 0 < self.z_min_um <= self.z_max_um < np.inf:
            words = (
                f"planes must lie in front of the diffuser, nearest first: 0 < z min <= z max, "
                f"not {self.z_min_um / 1e3:g} and {self.z_max_um / 1e3:g} mm"
            )
            problems.append(("z_max_um" if 0 < self.z_min_um < np.inf else "z_min_um", words))
        elif self.planes < 1 or (self.planes == 1) != (self.z_min_um == self.z_max_um):
            words = (
                f"the number of planes is {self.planes}: one plane needs z min = z max, "
                "more need z min < z max"
            )
            problems.append(("planes", words))
        if not np.isfinite((self.x_um, self.y_um)).all():
            words = f"x and y must be finite numbers, not {self.x_um / 1e3:g} and {self.y_um / 1e3:g} mm"
            problems.append(("y_um" if np.isfinite(self.x_um) else "x_um", words))
        if self.by_hand and self.planes > 1:
            words = f"{self.planes} planes need a stage; by hand one PSF is taken at a time"
            problems.append(("by_hand", words))
        problems += settings_problems(self)
        if problems:
            raise SettingsError(problems)

    @property
    def z_um(self) -> tuple[float, ...]:
        """Depths of the planes, nearest first, evenly spaced in 1/z (Kuo 2020, Eq. 4.7)."""
        return Span(start=self.z_min_um, stop=self.z_max_um, number=self.planes, spacing="dioptric").values()

    @property
    def points_um(self) -> tuple[Position, ...]:
        """Where the source stands, nearest plane first."""
        return tuple((self.x_um, self.y_um, z_um) for z_um in self.z_um)


def planes_needed(z_min_um: float, z_max_um: float, geometry: Geometry, feature_px: float = 2.0) -> int:
    """Return how many planes leave no depth between them unsampled.

    From plane to plane the edge of the aperture's shadow moves on the sensor by ``w / 2 * d * (1/z1 - 1/z2)``
    (from the scaling ``1 + d/z``), which may be one feature of the PSF at most: the constant of Kuo 2020,
    Eq. 4.7. The PSF's smallest features are about two pixels (Sec. 4.3).

    Raises
    ------
    BenchError
        When the geometry lacks the aperture, the distance d or the pixel pitch.
    """
    if (
        geometry.aperture_mm is None
        or geometry.diffuser_distance_mm is None
        or geometry.pixel_pitch_um is None
    ):
        raise BenchError(
            "How many planes are needed follows from aperture_mm, diffuser_distance_mm and pixel_pitch_um: "
            "give them in [geometry] of bench.toml, or give the number of planes."
        )
    edge_um2 = 1e6 * max(geometry.aperture_mm) / 2 * geometry.diffuser_distance_mm
    travel_px = edge_um2 * (1 / z_min_um - 1 / z_max_um) / geometry.pixel_pitch_um
    return 1 + int(np.ceil(travel_px / feature_px - 1e-9))
