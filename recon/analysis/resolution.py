"""Resolution across and along the axis, predicted from the PSF alone (Kuo 2020, secs. 3.2, 4.4, 6.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.correlation import (
    INNER_PRODUCT,
    RESOLUTION_LEVEL,
    autocorrelate,
    centre_of_light,
    critical_scale,
)

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class LateralResolution:
    """The smallest lateral step that changes the PSF enough, from its autocorrelation.

    Attributes
    ----------
    level : float
        Autocorrelation taken for resolved: 0.7 (sec. 3.2) or 0.8 (sec. 6.4).
    half_width_px : (float, float)
        Shift on the sensor along rows (y) and columns (x).
    """

    level: float
    half_width_px: tuple[float, float]

    @property
    def mean_px(self) -> float:
        """Geometric mean of both directions."""
        return float(np.sqrt(self.half_width_px[0] * self.half_width_px[1]))

    def angle_deg(self, pitch_um: float, distance_um: float) -> float:
        """Return the step as an angle at the diffuser: ``atan(pitch n / d)`` (Fig. 3.4a)."""
        return float(np.rad2deg(np.arctan(self.mean_px * pitch_um / distance_um)))

    def object_um(self, pitch_um: float, distance_um: float, z_um: float) -> float:
        """Return the step in the object's plane at a depth (Eq. 3.1)."""
        return self.mean_px * pitch_um * z_um / distance_um


def lateral_resolution(psf: Array, level: float = RESOLUTION_LEVEL) -> LateralResolution:
    """Measure the autocorrelation's half width of a PSF (height, width)."""
    correlation = autocorrelate(psf)
    return LateralResolution(level, (correlation.half_width(0, level), correlation.half_width(1, level)))


@dataclass(frozen=True, slots=True)
class AxialResolution:
    """The smallest step in depth that changes the PSF enough: even in 1/z (Eq. 4.7).

    Two depths are told apart when the pattern of one is so much larger that its inner product with the other
    is down to ``level``. The scale between them is ``(1 + d/z1) / (1 + d/z2)``, so they differ by a constant
    ``c = 1/z1 - 1/z2 = (scale - 1) (1 + d/z) / d`` where ``scale`` was found on a PSF taken at ``z``.

    Attributes
    ----------
    level : float
    scale : float
        Enlargement at which the PSF is only ``level`` similar to itself.
    step_per_um : float
        The constant ``c`` of Eq. 4.7, per micrometre.
    """

    level: float
    scale: float
    step_per_um: float

    @property
    def hyperfocal_um(self) -> float:
        """Depth beyond which nothing tells depths apart: ``1/z - 1/infinity = c``."""
        return 1.0 / self.step_per_um if self.step_per_um > 0 else float("inf")

    def depth_of_field_um(self, z_um: float) -> tuple[float, float]:
        """Return how far towards and away from the camera a depth is indistinguishable from ``z_um``."""
        inverse = 1.0 / z_um
        far = inverse - self.step_per_um
        return (
            z_um - 1.0 / (inverse + self.step_per_um),
            (1.0 / far - z_um) if far > 0 else float("inf"),
        )


def axial_resolution(
    psf: Array, z_um: float, distance_um: float, level: float = INNER_PRODUCT
) -> AxialResolution:
    """Find how much a PSF (height, width) taken at ``z_um`` must grow to look different (sec. 3.2)."""
    scale = critical_scale(psf, level)
    return AxialResolution(level, scale, (scale - 1) * (1 + distance_um / z_um) / distance_um)


def support_extent_px(psf: Array, share: float = 0.99) -> tuple[float, float]:
    """Return height and width of the box about the centre of light that holds ``share`` of it each way."""
    light = np.maximum(np.asarray(psf, np.float64), 0)
    # What is below a thousandth of the brightest blocks is noise and stray light, not pattern.
    light[light < 1e-3 * np.quantile(light, 0.999)] = 0
    sizes = []
    for axis, centre in enumerate(centre_of_light(light)):
        profile = light.sum(axis=1 - axis)
        distance = np.abs(np.arange(len(profile)) - centre)
        order = np.argsort(distance)
        reached = np.searchsorted(np.cumsum(profile[order]), share * profile.sum())
        sizes.append(2 * float(distance[order[min(int(reached), len(order) - 1)]]) + 1)
    return sizes[0], sizes[1]
