"""Resolution across and along the axis, predicted from the PSF alone (Kuo 2020, secs. 3.2, 4.4, 6.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from recon.analysis.correlation import (
    INNER_PRODUCT,
    RESOLUTION_LEVEL,
    autocorrelation_cut,
    centre_of_light,
    correlate,
    critical_scales,
    half_width,
    similarity,
)
from recon.arrays import Array, Float64Array
from recon.errors import InputError

CUT_PX = 40
"""Pixels on either side of the peak that are kept of a correlation's cut."""


@dataclass(frozen=True)
class DepthSimilarity:
    """PSFs of different depths compared."""

    z_um: Float64Array
    """(n_z,): ascending."""
    middle_um: float
    """Depth of the PSF that the others are compared with."""
    to_middle: Float64Array
    """(n_z,): inner product with the middle PSF, both on the axis (Fig. A.3b)."""
    near_cut: Float64Array
    far_cut: Float64Array
    cross_cut: Float64Array
    """``near_cut``, ``far_cut`` and ``cross_cut``: (2 CUT_PX + 1,): cuts along the columns through the peaks
    of both autocorrelations and of the cross-correlation of the nearest and the farthest PSF (Fig. A.3a)."""


def across_depth(depths_um: Float64Array, planes: Array) -> DepthSimilarity:
    """Compare the central PSFs (n_z, height, width) of ascending depths."""
    middle = int(np.argmin(np.abs(1 / depths_um - np.mean(1 / depths_um[[0, -1]]))))
    return DepthSimilarity(
        depths_um,
        float(depths_um[middle]),
        np.array([similarity(plane, planes[middle]) for plane in planes]),
        _cut(autocorrelation_cut(planes[0], 1)),
        _cut(autocorrelation_cut(planes[-1], 1)),
        _cut(correlate(planes[0], planes[-1]).profile(1)),
    )


def _cut(cut: Float64Array) -> Float64Array:
    peak = int(np.argmax(cut))
    index = np.arange(peak - CUT_PX, peak + CUT_PX + 1)
    inside = (index >= 0) & (index < len(cut))
    return np.where(inside, cut[np.clip(index, 0, len(cut) - 1)], 0.0)


SPECTRUM_LEVEL = 0.01
"""Share of the fall-off's spectrum at which it is taken to end. With it the microscope of Ch. 6 (sigma 13
degrees, nearest objects at 1.7 mm) needs a PSF every 0.4 mm, as the dissertation says."""
MOST_PLANES = 512


def lateral_spacing_um(response: Callable[[Float64Array], Float64Array], z_um: float) -> float:
    """Spacing of calibration points that samples the angular fall-off at Nyquist's rate (Eqs. 5.8, 5.9).

    The registered fall-off is ``f(atan(x / z))``; its spectrum is computed numerically and cut where it is
    below :data:`SPECTRUM_LEVEL` of its value at zero from there on.

    Parameters
    ----------
    response : callable
        ``f`` of angles in radians, 0 on the axis, even.
    z_um : float
        Depth; the nearest one asks for the densest points.
    """
    if not z_um > 0:
        raise InputError(f"The depth is above 0, not {z_um:g} um.")
    n = 1 << 15
    tangents = np.linspace(-40.0, 40.0, n, endpoint=False)
    step = tangents[1] - tangents[0]
    values = np.asarray(response(np.arctan(np.abs(tangents))), np.float64)
    # A response that does not vanish sideways has a constant part, which needs no sampling.
    values = values - float(response(np.array([np.pi / 2]))[0])
    spectrum = np.abs(np.fft.rfft(values))
    if spectrum[0] <= 0:
        return float("inf")
    above = np.flatnonzero(spectrum > SPECTRUM_LEVEL * spectrum[0])
    highest = (int(above[-1]) + 1) / (n * step)
    return float(z_um / (2 * highest))


def gaussian_response(sigma_deg: float) -> Callable[[Float64Array], Float64Array]:
    """Return a Gaussian angular response (Fig. 5.3a: 13 degrees)."""
    return lambda angles: np.asarray(np.exp(-0.5 * (angles / np.deg2rad(sigma_deg)) ** 2))


def axial_spacing_per_um(lenslet_um: float, wavelength_um: float) -> float:
    """Difference in 1/z between calibration planes of a microlens diffuser: ``4 lambda / p^2`` (Eq. 5.10)."""
    if min(lenslet_um, wavelength_um) <= 0:
        raise InputError("Lenslet and wavelength are positive.")
    return 4 * wavelength_um / lenslet_um**2


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """A grid that samples the resolution twice: fine where the camera is sharp, coarse where it is not."""

    binning: int
    """Sensor pixels to bin so that two binned pixels are one resolved step, at least 1."""
    lateral_px: float
    """Voxel size on the sensor, in the calibration's pixels (equal to ``binning``)."""
    z_um: tuple[float, ...]
    """Depth planes, nearest first: evenly spaced in 1/z (Eq. 4.7)."""
    lateral_um: tuple[float, ...]
    """Voxel size at each plane, in the object."""
    complete: bool = True
    """False where more than :data:`MOST_PLANES` would be needed and the list was cut."""


def voxel_grid(
    *,
    resolution_px: float,
    step_per_um: float,
    z_range_um: tuple[float, float],
    pitch_um: float,
    distance_um: float,
) -> VoxelGrid:
    """Recommend voxels that sample lateral and axial resolution at Nyquist's rate (sec. 4.4, Fig. 4.3d).

    Parameters
    ----------
    resolution_px : float
        Lateral two-point resolution on the sensor.
    step_per_um : float
        Axial two-point resolution, ``c`` of Eq. 4.7.
    z_range_um : (float, float)
        Nearest and farthest depth wanted.
    """
    near, far = z_range_um
    if not 0 < near <= far:
        raise InputError(f"Depths run from near to far, above 0, not from {near:g} to {far:g} um.")
    binning = max(1, int(resolution_px / 2))
    # Beyond the hyperfocal distance 1/step one more plane would tell nothing new.
    span = 1 / near - 1 / far
    needed = 1 + int(np.ceil(span / (step_per_um / 2) - 1e-9)) if np.isfinite(step_per_um) else 1
    count = min(max(needed, 1), MOST_PLANES)
    inverse = np.linspace(1 / near, 1 / near - (count - 1) * min(step_per_um / 2, span), count)
    if needed <= MOST_PLANES:
        inverse = np.linspace(1 / near, 1 / far, count)
    depths = tuple(float(1 / v) for v in inverse)
    voxel_um = binning * pitch_um / distance_um
    return VoxelGrid(binning, float(binning), depths, tuple(voxel_um * z for z in depths), needed == count)


@dataclass(frozen=True, slots=True)
class LateralResolution:
    """The smallest lateral step that changes the PSF enough, from its autocorrelation."""

    level: float
    """Autocorrelation taken for resolved: 0.7 (sec. 3.2) or 0.8 (sec. 6.4)."""
    half_width_px: tuple[float, float]
    """Shift on the sensor along rows (y) and columns (x)."""

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

    @classmethod
    def of(cls, cuts: Sequence[Float64Array], level: float) -> LateralResolution:
        """Measure the cuts of an autocorrelation along rows and columns."""
        y, x = (half_width(cut, level) for cut in cuts)
        return cls(level, (y, x))


def lateral_resolution(psf: Array, level: float = RESOLUTION_LEVEL) -> LateralResolution:
    """Measure the autocorrelation's half width of a PSF (height, width)."""
    return LateralResolution.of([autocorrelation_cut(psf, axis) for axis in (0, 1)], level)


@dataclass(frozen=True, slots=True)
class AxialResolution:
    """The smallest step in depth that changes the PSF enough: even in 1/z (Eq. 4.7).

    Two depths are told apart when the pattern of one is so much larger that its inner product with the other
    is down to ``level``. The scale between them is ``(1 + d/z1) / (1 + d/z2)``, so they differ by a constant
    ``c = 1/z1 - 1/z2 = (scale - 1) (1 + d/z) / d`` where ``scale`` was found on a PSF taken at ``z``.
    """

    level: float
    scale: float
    """Enlargement at which the PSF is only ``level`` similar to itself."""
    step_per_um: float
    """The constant ``c`` of Eq. 4.7, per micrometre."""

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
    return axial_resolutions(psf, z_um, distance_um, level)[0]


def axial_resolutions(
    psf: Array, z_um: float, distance_um: float, *levels: float
) -> tuple[AxialResolution, ...]:
    """Return :func:`axial_resolution` at several levels."""
    return tuple(
        AxialResolution(level, scale, (scale - 1) * (1 + distance_um / z_um) / distance_um)
        for level, scale in zip(levels, critical_scales(psf, *levels), strict=True)
    )


def support_extent_px(psf: Array) -> tuple[float, float]:
    """Return height and width of the box about the centre of light that holds 99 % of it each way."""
    light = np.maximum(np.asarray(psf, np.float64), 0)
    # What is below a thousandth of the brightest blocks is noise and stray light, not pattern.
    light[light < 1e-3 * np.quantile(light, 0.999)] = 0
    sizes = []
    for axis, centre in enumerate(centre_of_light(light)):
        profile = light.sum(axis=1 - axis)
        distance = np.abs(np.arange(len(profile)) - centre)
        order = np.argsort(distance)
        reached = np.searchsorted(np.cumsum(profile[order]), 0.99 * profile.sum())
        sizes.append(2 * float(distance[order[min(int(reached), len(order) - 1)]]) + 1)
    return sizes[0], sizes[1]
