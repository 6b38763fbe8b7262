"""What the data and the PSFs tell before the work, measured in little time."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np

from recon.analysis.correlation import autocorrelate
from recon.arrays import Array, Float64Array
from recon.camera.camera_model import Depths, ModelName
from recon.camera.spatially_varying import SpatiallyVarying
from recon.reconstruction.part import Part
from recon.reconstruction.pilot import Begun, held_out, pilot
from recon.reconstruction.problem import Problem

COARSE_PX = 96
"""Longest side that the coarse pass works on, pixels, about. Depths are told apart by a pixel's shift at the
pattern's edge: on fewer pixels all depths look alike."""
COARSE_ITERATIONS, WITHIN_ITERATIONS = 40, (20, 40, 60, 120)
"""The second until the passes have settled: after 20 of them held-out pixels asked for objects that are shut
in where that cost 7 dB under weak stray light; after 120 they asked against it, and on films as before. What
they ask against on the way they ask against at the end (docs/decisions/0244-asked-against-early.md)."""
ACCEPTED = 0.005
"""Brightness, relative to the axis, below which the sensor counts as accepting nothing."""
LIGHT_LOST = 2e-4
"""Share of a PSF's light that may lie outside the window it is cut to, along each axis."""


@dataclass(frozen=True)
class CoarsePass:
    """A quick reconstruction with l1, one convolution a depth and a background: it sees where light is.

    Attributes
    ----------
    light : ndarray, (n_channels, n_z)
        Share of every plane in the channel's light.
    smooth_share : float
        Mean of the smooth background relative to that of the data.
    """

    light: Float64Array
    smooth_share: float


def coarse_passes(channels: list[Problem]) -> CoarsePass:
    """Reconstruct every channel in few iterations; the share is their mean."""
    passes = [_coarse_pass(coarse_copy(c, "convolution", "l1", background=True)) for c in channels]
    return CoarsePass(np.stack([p[0] for p in passes]), float(np.mean([p[1] for p in passes])))


def coarse_copy(problem: Problem, model: ModelName, prior: str, *, background: bool) -> Problem:
    """Return a coarse copy with another model and prior; TV of planes as far apart as their pixels."""
    weights = None if problem.n_planes == 1 else (1.0, 1.0, 1.0)
    options = replace(problem.options, prior=prior, axis_weights=weights, drop_empty=False)
    return replace(problem, options=options, model=model, smooth=background)


def _coarse_pass(problem: Problem) -> tuple[Float64Array, float]:
    """Return the planes' shares of the light of a problem of one channel, and the background's."""
    found = pilot(problem, COARSE_ITERATIONS)
    assert found.background is not None
    psfs = problem.levelled[0].central
    per_plane = found.solution[0].sum(axis=(1, 2), dtype=np.float64) * psfs[:, 0].sum(
        axis=(1, 2), dtype=np.float64
    )
    valid = problem.valid[0]
    mean = float(problem.data[0][valid].mean(dtype=np.float64))
    share = per_plane / max(float(per_plane.sum()), 1e-30)
    return share, 0.0 if mean <= 0 else float(found.background[0][valid].mean()) / mean


MARGIN = 0.05
"""Of the distance between the outermost PSFs: so far beyond them these are still taken for known."""


FALL = 0.03
"""Share by which the mean square error of held-out pixels must fall for the object to be shut in between the
outermost PSFs. Of 71 scenes nine had more and changed by -0.1 to +1.5 dB; up to 1.1 % cost as much as 0.9."""


@dataclass(frozen=True)
class Within:
    """Held-out errors of coarse copies whose object lies anywhere, and only where PSFs were measured."""

    anywhere: float
    spanned: float

    @property
    def asks(self) -> bool:
        """Whether held-out pixels ask for an object that lies only there."""
        return self.spanned**2 <= (1 - FALL) * self.anywhere**2


def within_of(channels: list[Problem]) -> Within:
    """Try coarse problems of one channel each, until they ask against; errors are their root mean square."""
    with ExitStack() as opened:
        passes = []
        for channel in channels:
            seen, error = held_out(channel)
            anywhere = opened.enter_context(Begun(seen, solver="admm"))
            spanned = replace(seen, extent=replace(seen.extent, margin=MARGIN))
            there = opened.enter_context(Begun(spanned, weight=anywhere.weight, solver="admm"))
            passes.append((error, anywhere, there))
        for iterations in WITHIN_ITERATIONS:
            errors = [[error(one.to(iterations).left) for one in both] for error, *both in passes]
            found = Within(*np.sqrt(np.mean(np.square(errors), axis=0)).tolist())
            if not found.asks:
                break
        return found


def camera_cost(problem: Problem, model: ModelName) -> int:
    """Return the pixels that the coarse copy's camera transforms; 0 for one convolution."""
    part = Part(coarse_copy(problem, model, "nonnegative", background=False), slice(0, 1))
    try:
        camera = part.camera
        return camera.fft_pixels if isinstance(camera, SpatiallyVarying) else 0
    finally:
        part.close()


def resolution_px(psf: Array) -> float:
    """Full width of a PSF's autocorrelation half way down to the base that it stands on, pixels."""
    correlation = autocorrelate(psf)
    widths = []
    for axis in (0, 1):
        profile = correlation.profile(axis)
        quarter = len(profile) // 4
        # Farther out the images hardly overlap.
        base = float(np.median(profile[quarter : len(profile) - quarter]))
        widths.append(2 * correlation.half_width(axis, 0.5 * (1 + base)))
    return float(np.sqrt(widths[0] * widths[1]))


def psf_window(depths: Depths) -> tuple[int, int]:
    """Height and width of the central window that holds the light of all PSFs."""
    light: Array = np.zeros(depths.central.shape[2:])
    for field in depths.fields:
        light = np.maximum(light, field.psfs.max(axis=(0, 1)))
    light = np.where(light > 0.02 * light.max(), light, 0)
    sizes = []
    for axis, n in enumerate(light.shape):
        profile = light.sum(axis=1 - axis)
        half = 1
        inside = np.abs(np.arange(n) - n // 2)
        while half < n // 2 and profile[inside > half].sum() > LIGHT_LOST * profile.sum():
            half += 1
        sizes.append(min(2 * half + 1, n))
    return sizes[0], sizes[1]


def acceptance_px(depths: Depths) -> float | None:
    """Distance from the axis, pixels, at which PSFs are down to :data:`ACCEPTED` of the central one's light.

    From a Gaussian fitted to the light of the registered PSFs at the places they were calibrated at; None
    where they do not fall off within reach.
    """
    places, ratios = [], []
    for central, field in zip(depths.central, depths.fields, strict=True):
        unit = float(central.sum())
        for psf, point in zip(field.psfs, field.points, strict=True):
            if unit > 0 and np.hypot(*point) > 1:
                places.append(float(point[0] ** 2 + point[1] ** 2))
                ratios.append(float(np.clip(psf.sum() / unit, 1e-3, 2.0)))
    if len(places) < 4:
        return None
    r2, fall = np.asarray(places), -np.log(np.asarray(ratios))
    slope = float(r2 @ fall) / float(r2 @ r2)
    if slope <= 0:
        return None
    return float(np.sqrt(-np.log(ACCEPTED) / slope))
