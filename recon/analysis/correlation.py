"""How alike point spread functions are: over shift and scale, and across the field.

Kuo 2020, Eqs. 3.11, 3.12 and 4.6, Figs. 3.4, 5.1 and A.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from recon.arrays import Array, Float64Array
from recon.base import fft
from recon.camera.camera_model import members_of_depths
from recon.camera.registration import register
from recon.errors import InputError
from recon.types import Calibration

RESOLUTION_LEVEL = 0.7
"""Autocorrelation at which two directions are told apart by most sensors (Kuo 2020, sec. 3.2)."""
INNER_PRODUCT = 0.8
"""Inner product below which two points were told apart in the microscope (sec. 6.4)."""
SAMPLES = 400_000
"""Pixels that tell how similar a PSF is to itself, enlarged: to a hundredth of the enlargement."""
HOLDS = 1.1
"""Spot size relative to the axis up to which the convolution model is said to hold: Fig. 5.1e is flat to
within this up to 15 degrees, where the dissertation draws the line."""


def similarity(first: Array, second: Array) -> float:
    """Return the inner product of two images of one shape, each divided by its norm (Eq. 3.11)."""
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


@dataclass(frozen=True)
class Correlation:
    """Inner products of two images at every shift in whole pixels."""

    values: Float64Array
    """(2 height - 1, 2 width - 1): divided by both norms: 1 is identity. The middle is no shift."""

    @property
    def peak(self) -> tuple[int, int]:
        """Rows and columns by which the second image must be shifted to be most like the first."""
        row, column = np.unravel_index(int(np.argmax(self.values)), self.values.shape)
        height, width = self.values.shape
        return int(row) - height // 2, int(column) - width // 2

    @property
    def maximum(self) -> float:
        """The largest inner product at any shift."""
        return float(self.values.max())

    def profile(self, axis: int) -> Float64Array:
        """Cut through the peak along ``axis`` (0: rows, 1: columns)."""
        row, column = (p + n // 2 for p, n in zip(self.peak, self.values.shape, strict=True))
        return self.values[:, column] if axis == 0 else self.values[row]

    def half_width(self, axis: int, level: float) -> float:
        """Return :func:`half_width` of a cut (:meth:`profile`)."""
        return half_width(self.profile(axis), level)

    @property
    def spot_px(self) -> float:
        """Geometric mean of both half widths at :data:`RESOLUTION_LEVEL`: the size of a spot."""
        return float(np.sqrt(self.half_width(0, RESOLUTION_LEVEL) * self.half_width(1, RESOLUTION_LEVEL)))


def correlate(first: Array, second: Array) -> Correlation:
    """Correlate two images (height, width) of one shape, without wrap-around."""
    if first.shape != second.shape or first.ndim != 2:
        raise InputError(f"Two images of one shape are correlated, not {first.shape} and {second.shape}.")
    shape = fft.fast_shape([2 * n - 1 for n in first.shape])
    single = first.dtype == second.dtype == np.float32
    spectra, norm = [], 1.0
    for image in (first, second):
        padded = np.zeros(shape, np.float32 if single else np.float64)
        padded[: image.shape[0], : image.shape[1]] = image
        norm *= float(np.linalg.norm(np.asarray(image, np.float64)))
        spectra.append(fft.rfft(padded))
    circular = fft.irfft(spectra[0] * np.conj(spectra[1]), shape[1])
    height, width = first.shape
    rows, columns = np.arange(1 - height, height), np.arange(1 - width, width)
    return Correlation(circular[np.ix_(rows, columns)] / (norm or 1.0))


def autocorrelate(psf: Array) -> Correlation:
    """Correlate a PSF (height, width) with itself: 1 in the middle (Kuo 2020, Fig. 3.4a)."""
    return correlate(psf, psf)


def autocorrelation_cut(psf: Array, axis: int) -> Float64Array:
    """Return what ``autocorrelate(psf).profile(axis)`` does, from transforms of single lines."""
    lines = np.asarray(psf if axis == 1 else psf.T, np.float64)
    length = lines.shape[1]
    padded = np.zeros((len(lines), fft.fast_length(2 * length - 1, real=True)))
    padded[:, :length] = lines
    spectrum = np.zeros(padded.shape[1] // 2 + 1)
    for some in np.array_split(padded, max(1, padded.size >> 21)):
        transformed = fft.rfft(some, axes=1)
        spectrum += np.einsum("ij,ij->j", transformed, transformed.conj()).real
    cut = fft.irfft(spectrum.astype(np.complex128), padded.shape[1], axes=1)
    return np.asarray(cut[np.arange(1 - length, length)] / (cut[0] or 1.0))


def half_width(cut: Float64Array, level: float) -> float:
    """Return how far from its peak a cut through a correlation falls to ``level`` of it, pixels.

    Linear between pixels, mean of both sides; infinite where it never falls so low.
    """
    middle = int(np.argmax(cut))
    bar = level * float(cut[middle])
    return float(np.mean([_crossing(side, bar) for side in (cut[middle:], cut[middle::-1])]))


def spot_px(psf: Array) -> float:
    """Return the size of the spot that a PSF (height, width) makes (:attr:`Correlation.spot_px`)."""
    widths = [half_width(autocorrelation_cut(psf, axis), RESOLUTION_LEVEL) for axis in (0, 1)]
    return float(np.sqrt(widths[0] * widths[1]))


def critical_scales(psf: Array, *levels: float) -> tuple[float, ...]:
    """Return the enlargements at which a PSF is only so similar to itself; infinite beyond 2.

    Doubled from a tenth of a pixel at the PSF's edge until it is less similar, then bisected twice; linear
    between what is left. Of large PSFs :data:`SAMPLES` pixels, taken at random, are compared.
    """
    from scipy import ndimage

    light = cut_to_light(psf)
    centre = np.array(centre_of_light(light))[:, None]
    values = light.ravel()
    places = np.arange(values.size)
    if values.size > SAMPLES:
        places = np.sort(np.random.default_rng(0).choice(values.size, SAMPLES, replace=False))
        values = values[places]
    off_centre = np.array(np.unravel_index(places, light.shape)) - centre
    spline = ndimage.spline_filter(light, order=3)

    @cache
    def seen(by: float) -> float:
        nearer = centre + off_centre / (1.0 + by)
        enlarged = ndimage.map_coordinates(spline, nearer, order=3, prefilter=False)
        return similarity(values, np.maximum(enlarged, min(float(light.min()), 0.0)))

    def scale(level: float) -> float:
        low, high = 0.0, 0.1 / (0.5 * max(light.shape))
        while seen(high) > level:
            low, high = high, 2 * high
            if high > 1:
                return float("inf")
        for _ in range(2):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if seen(middle) > level else (low, middle)
        at_low, at_high = (seen(by) if by else 1.0 for by in (low, high))
        return float(1.0 + low + (high - low) * (at_low - level) / (at_low - at_high))

    return tuple(scale(level) for level in levels)


def cut_to_light(image: Array) -> Array:
    """Cut an image (height, width) to its light, eight pixels around it kept as far as there are any."""
    rows, columns = (slice(max(first - 8, 0), last + 9) for first, last in lit_extent(image))
    return image[rows, columns]


def lit_extent(image: Array) -> list[tuple[int, int]]:
    """Return the first and last row, and column, with light: above a hundredth of the peak."""
    extent = []
    for axis in (1, 0):
        profile = image.max(axis=axis)
        used = np.flatnonzero(profile > 0.01 * float(profile.max()))
        if not used.size:
            raise InputError("The PSF holds no light.")
        extent.append((int(used[0]), int(used[-1])))
    return extent


def centre_of_light(psf: Array) -> tuple[float, float]:
    """Return the centroid ``(row, column)`` of an image (height, width), in pixels from its first pixel."""
    light = np.maximum(np.asarray(psf, np.float64), 0)
    total = float(light.sum())
    if total <= 0:
        raise InputError("The PSF holds no light.")
    row, column = (float(light.sum(axis=1 - a) @ np.arange(n)) / total for a, n in enumerate(light.shape))
    return row, column


def _crossing(cut: Float64Array, level: float) -> float:
    below = np.flatnonzero(cut < level)
    if not below.size:
        return float("inf")
    k = int(below[0])
    if k == 0:
        return 0.0
    return float(k - 1 + (cut[k - 1] - level) / (cut[k - 1] - cut[k]))


# Across the field -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class FieldOfView:
    """Half the angle of view along one axis, degrees, and what limits it."""

    half_deg: float
    """``beta + min(alpha_c, atan((l + w) / d))``."""
    geometric_deg: float
    """``atan((l + w) / d)``: beyond it no light reaches the sensor."""
    cutoff_deg: float | None
    """``alpha_c``: the pixels' response is down to 20 %; None where it was not measured."""

    @property
    def limited_by(self) -> str:
        """``"the pixels' angular response"`` or ``"the sensor's and the aperture's size"``."""
        by_pixels = self.cutoff_deg is not None and self.cutoff_deg < self.geometric_deg
        return "the pixels' angular response" if by_pixels else "the sensor's and the aperture's size"


def half_light_deg(
    psf: Array,
    sensor_shape: tuple[int, int],
    tangent_per_px: float,
    response: Callable[[Array, Array], Array],
) -> tuple[float, float]:
    """Return the angles along y and x at which half of the light of the axis is left.

    Parameters
    ----------
    psf : ndarray, (height, width)
        On the axis, its middle the sensor's.
    sensor_shape : (int, int)
        Of the whole sensor, on which the pattern moves.
    tangent_per_px : float
        By which the source moves off the axis while its pattern moves by a pixel.
    response : callable
        Of the pixels, by the tangents along y and x. The aperture's obliquity, the cube of the cosine for its
        area and the distance, is added.
    """
    angles = []
    for axis in (0, 1):
        profile = np.maximum(psf, 0).sum(axis=1 - axis, dtype=np.float64)
        edge = (sensor_shape[axis] - len(profile)) // 2
        shifts = np.arange(edge + len(profile))
        # Towards one end; patterns are cut alike at the other, but for their shape.
        share = profile / profile.sum()
        ends = [np.concatenate([np.ones(edge + 1), 1 - np.cumsum(p)]) for p in (share, share[::-1])]
        seen = np.mean([end[: len(shifts)] for end in ends], axis=0)
        tangents = shifts * tangent_per_px
        y, x = (tangents * (axis == n) for n in (0, 1))
        light = seen * response(y, x) * (1 + tangents**2) ** -1.5
        below = np.flatnonzero(light < 0.5 * light[0])
        last = tangents[below[0]] if below.size else tangents[-1]
        angles.append(float(np.rad2deg(np.arctan(last))))
    return angles[0], angles[1]


def field_of_view(
    sensor_um: float,
    support_um: float,
    distance_um: float,
    *,
    deflection_deg: float,
    cutoff_deg: float | None = None,
) -> FieldOfView:
    """Half the angle of view along one axis (Eq. 3.12, which with full widths is Eq. 4.6).

    Parameters
    ----------
    sensor_um, support_um : float
        Full extent of the sensor, ``2 l``, and of the PSF's support, ``2 w``.
    distance_um : float
        From the diffuser to the sensor.
    deflection_deg : float
        Largest deflection by the diffuser, ``beta``.
    cutoff_deg : float, optional
        Angle at which the sensor's response is down to 20 %, ``alpha_c``.
    """
    if min(sensor_um, support_um, distance_um) <= 0:
        raise InputError(
            f"Sensor, support and distance are positive, not {sensor_um:g}, {support_um:g}, {distance_um:g}."
        )
    geometric = float(np.rad2deg(np.arctan((sensor_um + support_um) / (2 * distance_um))))
    limit = geometric if cutoff_deg is None else min(cutoff_deg, geometric)
    return FieldOfView(deflection_deg + limit, geometric, cutoff_deg)


@dataclass(frozen=True, slots=True)
class FieldPoint:
    """One PSF of the field compared with the central one of its depth (Figs. 5.1d and 5.1e)."""

    x_um: float
    y_um: float
    z_um: float
    angle_deg: float
    """Between the directions of both sources."""
    similarity: float
    """Inner product after registration between pixels, over those that both show."""
    spot: float
    """Width of the cross-correlation over that of the central PSF's autocorrelation: the size of the spot
    that the convolution model makes of a point there."""


def across_field(calibration: Calibration) -> tuple[FieldPoint, ...]:
    """Compare every PSF of the depth calibrated at most places with the one nearest to the axis.

    The nearest directions come first.
    """
    positions = calibration.source_positions_um
    if not np.isfinite(positions).all():
        return ()
    members = max(members_of_depths(positions), key=len)
    centre = calibration.nearest_to_axis(members)
    reference = calibration.psfs[centre].mean(axis=0)
    width = spot_px(reference)
    points = []
    for k in members:
        likeness = spot = 1.0
        if k != centre:
            psf = calibration.psfs[k].mean(axis=0)
            # Off the axis the sensor's edge cuts the pattern: only pixels that both show are compared.
            likeness = register(psf, reference).similarity
            spot = correlate(reference, psf).spot_px / width
        angle_deg = _angle_between_deg(positions[k], positions[centre])
        x, y, z = map(float, positions[k])
        points.append(FieldPoint(x, y, z, angle_deg, likeness, spot))
    return tuple(sorted(points, key=lambda p: p.angle_deg))


def convolution_holds_deg(points: tuple[FieldPoint, ...]) -> float | None:
    """Return the largest calibrated angle up to which every spot is at most :data:`HOLDS` wide.

    None where only one place was calibrated: then nobody knows.
    """
    if len(points) < 2:
        return None
    first = min((p.angle_deg for p in points if p.spot > HOLDS), default=np.inf)
    # Points of a ring are at one angle but for the stage's error.
    return max((p.angle_deg for p in points if p.angle_deg < first - 0.1), default=0.0)


def _angle_between_deg(first: Array, second: Array) -> float:
    cosine = float(first @ second / (np.linalg.norm(first) * np.linalg.norm(second)))
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
