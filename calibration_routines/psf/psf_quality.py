"""Is a point spread function good enough to reconstruct with? Each plane alone, then the sweep as a whole.

Per plane: saturation, signal to noise, and whether the sensor's edge cuts the pattern. Over the sweep: a
lateral step of the pattern between neighbours (stage or source slipped), and the size of its support against
the paraxial law. A ray from a source at ``z`` through the diffuser's point ``xi`` lands at ``xi (1 + d / z)``
plus the diffuser's deflection, so the support scales as ``1 + d / z`` (Kuo 2020, Eq. 5.2) and its centroid
runs linearly in ``1 / z``, wherever source, aperture and sensor sit laterally.

Findings are sentences: what was found, what was expected, what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.fft import dctn, idctn

from recon.arrays import BoolArray, Float32Array
from recon.base.blocks import block_mean


def remove_low_frequencies(
    image: npt.NDArray[np.floating], order: int = 10
) -> tuple[Float32Array, Float32Array]:
    """Set the ``order x order`` lowest DCT coefficients to zero, then negative values to zero.

    The dissertation's microscope does so with ``order=10`` against autofluorescence and unfiltered excitation
    light. It also removes the slowly varying part of the PSF itself: right for a few sharp spots on a large
    sensor, wrong for a caustic that fills a good part of it (docs/decisions/0004-psf-background.md).

    Parameters
    ----------
    image : ndarray, (..., height, width)
        Dark frame already subtracted; any number of leading axes.
    order : int
        Coefficients along each axis; 0 removes nothing but negative values.

    Returns
    -------
    cleaned : ndarray, float32, shape of ``image``, non-negative
    background : ndarray, float32, shape of ``image``
        What the removed coefficients stand for; may be negative where the PSF's own low frequencies were cut.

    Raises ValueError when ``order`` is negative or larger than the image.
    """
    height, width = image.shape[-2:]
    if not 0 <= order <= min(height, width):
        raise ValueError(f"order must lie between 0 and {min(height, width)} for this image, not {order}.")
    values = np.asarray(image, np.float32)
    if order == 0:
        return np.maximum(values, 0.0), np.zeros_like(values)
    coefficients = dctn(values, axes=(-2, -1), norm="ortho", workers=-1)
    low = np.zeros_like(coefficients)
    low[..., :order, :order] = coefficients[..., :order, :order]
    background = idctn(low, axes=(-2, -1), norm="ortho", workers=-1)
    return np.maximum(values - background, 0.0), background


MIN_SNR = 10.0
"""Signal to noise per pixel, inside the support, below which a PSF is called noisy."""
MAX_CLIPPED = 0.02
"""Fraction of the sensor's edge inside the support above which the support is called clipped."""
MAX_STEP_PX = 2.0
"""Departure of the centroid from its line in 1/z that is called a step, pixels."""
MAX_SCALE_ERROR = 0.03
"""Relative departure of the support's size from the paraxial law that is called wrong."""
_BLOCKS = 48  # the coarse image, in which the support is found, has about this many blocks on its short side


@dataclass(frozen=True, slots=True)
class PsfQuality:
    """Figures of merit of one PSF; lengths in pixels of the PSF image."""

    z_um: float
    saturated_pixels: int
    """Pixels at full scale in any of the frames averaged, hot pixels excepted."""
    signal: float
    """Mean counts above background inside the support."""
    snr: float
    """``signal`` over the noise of one pixel of the averaged image."""
    centroid_px: tuple[float, float]
    """Row and column of the pattern's centroid, from the image's centre."""
    radius_px: float
    """Root-mean-square radius of the pattern."""
    clipped: float
    """Fraction of the sensor's edge that lies inside the support."""
    scale_error: float = 0.0
    """Size of the support over what the paraxial law expects from the whole sweep, minus one."""
    step_px: float = 0.0
    """Distance of the pattern from where the sweep's other PSFs, or the stage, say it is."""
    findings: tuple[str, ...] = ()
    """What is wrong, in words; empty when the PSF is good."""
    retake: bool = False
    """Whether taking the plane again (with a shorter exposure if it saturates) can help."""
    x_um: float = 0.0
    y_um: float = 0.0
    """Where the source stood laterally."""
    similarity: float | None = None
    """Inner product with the central PSF of its depth once registered; None where that is itself."""
    flicker: float = 0.0
    motion_px: float = 0.0
    """Standard deviations from frame to frame beyond noise: of brightness, relative, and of the place, pixels
    of the camera."""

    @property
    def source_um(self) -> tuple[float, float, float]:
        """Where the stage said the source was."""
        return self.x_um, self.y_um, self.z_um


def measure_psf(
    image: npt.NDArray[np.floating],
    *,
    z_um: float,
    noise: float,
    saturated_pixels: int = 0,
    may_be_clipped: bool = False,
) -> PsfQuality:
    """Measure one PSF and judge what can be judged without its neighbours.

    Parameters
    ----------
    image : ndarray, (n_channels, height, width)
        Averaged frame minus dark frame, in counts, negative values kept (they balance the noise).
    z_um : float
        Distance of the source from the diffuser.
    noise : float
        Standard deviation of one pixel of ``image`` inside the support, counts.
    saturated_pixels : int
        Pixels at full scale in the frames that were averaged.
    may_be_clipped : bool
        The source stands so far off the axis that the sensor's edge is expected to cut its pattern.

    Returns
    -------
    PsfQuality
        ``scale_error`` and ``step_px`` are zero until :func:`judge_sweep` has seen the neighbours.
    """
    grey = image.sum(axis=0, dtype=np.float32)
    factor = max(1, min(grey.shape) // _BLOCKS)
    coarse = block_mean(grey, factor)
    support = _support(coarse)
    findings: list[str] = []
    if saturated_pixels:
        findings.append(
            f"{saturated_pixels} pixels saturate, none may: take the plane again with a shorter exposure."
        )
    if not support.any():
        findings.append("no light was found: check that the source is on and in front of the aperture.")
        return PsfQuality(
            z_um, saturated_pixels, 0.0, 0.0, (0.0, 0.0), 0.0, 0.0, findings=tuple(findings), retake=True
        )
    weights = np.where(support, np.maximum(coarse, 0.0), 0.0)
    rows, columns = ((np.arange(n) + 0.5 - 0.5 * n) * factor for n in coarse.shape)
    total = weights.sum()
    row = float((weights.sum(axis=1) @ rows) / total)
    column = float((weights.sum(axis=0) @ columns) / total)
    squares = (rows[:, None] - row) ** 2 + (columns[None, :] - column) ** 2
    edge = np.concatenate([support[0], support[-1], support[:, 0], support[:, -1]])
    clipped = float(edge.mean())
    signal = float(coarse[support].mean())
    snr = signal / noise if noise > 0 else float("inf")
    if snr < MIN_SNR:
        findings.append(
            f"the signal is only {snr:.1f} times the noise ({MIN_SNR:.0f} expected): average more frames, "
            "brighten the source or lengthen the exposure."
        )
    if clipped > MAX_CLIPPED and not may_be_clipped:
        findings.append(
            f"the pattern reaches over {clipped:.0%} of the sensor's edge: part of it is lost. "
            "Move the source farther away or centre it, or make the aperture smaller."
        )
    return PsfQuality(
        z_um=z_um,
        saturated_pixels=saturated_pixels,
        signal=signal,
        snr=snr,
        centroid_px=(row, column),
        radius_px=float(np.sqrt((weights * squares).sum() / total)),
        clipped=clipped,
        findings=tuple(findings),
        retake=saturated_pixels > 0,
    )


def judge_sweep(planes: Sequence[PsfQuality], diffuser_distance_um: float | None) -> tuple[PsfQuality, ...]:
    """Judge each plane of an axial sweep, in any order of depth, against the others.

    Returns the same planes with ``scale_error``, ``step_px`` and the findings that follow from them. Steps
    need at least four planes, a scale at least two; with fewer there is nothing to compare with. Where the
    distance from diffuser to sensor is None, the paraxial law stays unchecked, monotony is still checked.
    """
    judged = list(planes)
    lit = [i for i, plane in enumerate(planes) if plane.radius_px > 0]
    if len(lit) >= 4:
        there = [planes[i] for i in lit]
        for index, step in zip(lit, _centroid_steps(there, there), strict=True):
            judged[index] = replace(judged[index], step_px=step)
            judged[index] = _with_step(judged[index], step)
    if len(lit) >= 2:
        errors = _scale_errors([planes[i] for i in lit], diffuser_distance_um)
        for index, error in zip(lit, errors, strict=True):
            judged[index] = _with_scale_error(judged[index], error)
    return tuple(judged)


def judge_next(
    before: Sequence[PsfQuality], plane: PsfQuality, diffuser_distance_um: float | None
) -> PsfQuality:
    """Judge a plane of an axial sweep, just taken, against the good ones taken before it.

    Its place is held against the line through at least three of them, its support's size against at least
    two: with fewer, a wrong one could be any of them. The distance is as in :func:`judge_sweep`.
    """
    if not plane.radius_px > 0:
        return plane
    if len({one.z_um for one in before}) >= 3:
        unsure = _unsureness([one.z_um for one in before], plane.z_um)
        plane = _with_step(plane, _centroid_steps(before, [plane])[0], MAX_STEP_PX * unsure)
    if len(before) >= 2:
        plane = _with_scale_error(plane, _scale_errors([*before, plane], diffuser_distance_um)[-1])
    return plane


def _unsureness(depths_um: Sequence[float], z_um: float) -> float:
    """Return how much less sure a line through depths is of a depth than each of them is of its own place."""
    inverse = 1 / np.array(depths_um)
    apart = float(((1 / z_um - inverse.mean()) ** 2) / ((inverse - inverse.mean()) ** 2).sum())
    return float(np.sqrt(1 + 1 / len(inverse) + apart))


def _with_step(plane: PsfQuality, step_px: float, most_px: float = MAX_STEP_PX) -> PsfQuality:
    plane = replace(plane, step_px=step_px)
    if step_px <= most_px:
        return plane
    return with_finding(
        plane,
        f"the pattern lies {step_px:.1f} pixels beside the line through the other planes (up to "
        f"{most_px:.2g} expected): the stage or the source slipped. Take the plane again.",
        retake=True,
    )


def _with_scale_error(plane: PsfQuality, error: float) -> PsfQuality:
    plane = replace(plane, scale_error=error)
    if abs(error) <= MAX_SCALE_ERROR or plane.clipped > MAX_CLIPPED:
        return plane
    return with_finding(
        plane,
        f"the support is {abs(error):.1%} too {'large' if error > 0 else 'small'} for 1 + d/z (up to "
        f"{MAX_SCALE_ERROR:.0%} expected): check the source's distance from the diffuser and d.",
        retake=False,
    )


def temporal_noise(frames: npt.NDArray[np.floating] | npt.NDArray[np.unsignedinteger]) -> float:
    """Estimate the noise of one pixel of the average of ``frames``, (n_frames, ...), counts.

    They are at least two, of the same, unchanged light. It is the root of the mean variance over the
    brightest tenth of the pixels (the PSF), over ``n_frames``.
    """
    if len(frames) < 2:
        raise ValueError("Noise needs at least two frames of the same light.")
    values = np.asarray(frames, np.float32)
    mean = values.mean(axis=0)
    bright = mean >= np.quantile(mean, 0.9)
    return float(np.sqrt(values[:, bright].var(axis=0, ddof=1).mean() / len(values)))


def _support(coarse: Float32Array) -> BoolArray:
    """Blocks with light: above a sixth of the pattern's own mean level and above the noise between blocks."""
    positive = np.maximum(coarse, 0.0)
    if not positive.any():
        return np.zeros(coarse.shape, bool)
    typical = float((positive**2).sum() / positive.sum())  # weighted by light: right for sparse spots too
    median = float(np.median(coarse))
    dark_side = coarse[coarse <= median]
    noise = 1.4826 * float(np.median(np.abs(dark_side - np.median(dark_side))))
    support: BoolArray = coarse > max(typical / 6.0, 10.0 * noise)
    return support


def _centroid_steps(planes: Sequence[PsfQuality], judged: Sequence[PsfQuality]) -> list[float]:
    """Return the distance of each judged centroid from a robust straight line through the planes', in 1/z."""
    from scipy.stats import theilslopes  # late: commands that calibrate otherwise start sooner

    inverse_z = np.array([1.0 / plane.z_um for plane in planes])
    centroids = np.array([plane.centroid_px for plane in planes])
    at = np.array([1.0 / plane.z_um for plane in judged])
    residuals = np.array([plane.centroid_px for plane in judged], np.float64)
    for axis in (0, 1):
        slope, intercept, *_ = theilslopes(centroids[:, axis], inverse_z)
        residuals[:, axis] -= slope * at + intercept
    return [float(step) for step in np.hypot(residuals[:, 0], residuals[:, 1])]


def _scale_errors(planes: Sequence[PsfQuality], diffuser_distance_um: float | None) -> list[float]:
    """Return the relative departure of each radius from the paraxial law scaled to the sweep's median."""
    radii = np.array([plane.radius_px for plane in planes])
    z = np.array([plane.z_um for plane in planes])
    if diffuser_distance_um is None:  # without d only the order is known: the support shrinks with distance
        order = np.argsort(z)
        expected = np.empty_like(radii)
        expected[order] = np.minimum.accumulate(radii[order])
        return [float(error) for error in radii / expected - 1.0]
    law = 1.0 + diffuser_distance_um / z
    return [float(error) for error in radii / (law * np.median(radii / law)) - 1.0]


def with_finding(plane: PsfQuality, finding: str, *, retake: bool) -> PsfQuality:
    """Return a PSF's quality with one more finding."""
    return replace(plane, findings=(*plane.findings, finding), retake=plane.retake or retake)


def place_of(quality: PsfQuality) -> str:
    """Return where a PSF's source stood, in words; x and y only off the axis."""
    x_mm, y_mm, z_mm = (1e-3 * v for v in quality.source_um)
    across = f"x = {x_mm:.4g}, y = {y_mm:.4g}, " if x_mm or y_mm else ""
    return f"{across}z = {z_mm:.4g} mm"
