"""Scores of a reconstruction: by its truth where there is one, and by pixels that were held out.

5 % of the pixels are erased, reconstructed from the rest and predicted, in blocks of the coarsest binning, so
that the error is of the same light and in the same units whatever a setting's binning is. What the prediction
may be wrong in without the picture being so is taken out first, fitted to the pixels that were used: its
brightness, and slow waves over the frame (a PSF's own background, stray light). With that the score ranks as
the true error does far better: runs that are not bright yet, and models without a background, are no worse
for it (docs/benchmarks/charts.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.base import metrics
from recon.base.blocks import block_mean, blocks_about_axis, enlarged
from recon.camera.factors import BackgroundRemoval
from recon.errors import InputError
from recon.evaluation.scored import Point
from recon.evaluation.trial import Setting
from recon.reconstruction.measurement import Measurement, channel_noise
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import BACKGROUND_FREQUENCIES, Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.reduction import reduced_calibration
from recon.reconstruction.result import window_of
from recon.types import Calibration

if TYPE_CHECKING:
    from recon.evaluation.chart_reconstruction import ChartProblem


HELD_SHARE = 0.05
PARTS = 12
"""Of the held-out pixels, scored apart: how much they differ tells how much the score scatters."""
_PIXELS_A_WAVE = 4
"""Blocks along an axis for each slow wave that is fitted, at least."""
VOLUME_BLUR_PX = 1.0
"""Volumes are compared through a blur of this deviation in every direction: a bead at a voxel's border is not
wrong by being in its neighbour."""


@dataclass(frozen=True, slots=True)
class Score:
    """Errors against the truth, after the one factor that fits the result to it best."""

    psnr_db: float
    ssim: float
    nrmse: float


def score(found: Array, truth: Array, *, volume: bool | None = None) -> Score:
    """Judge a reconstruction.

    Raises InputError when the shapes differ.

    Parameters
    ----------
    found, truth : ndarray
        Pictures (height, width[, n_channels]), or volumes (n_z, height, width[, n_channels]) of one shape.
    volume : bool, optional
        Whether the first axis is depth; default: 3 axes of which the last is longer than 4, or 4 axes.
    """
    if found.shape != truth.shape:
        raise InputError(f"The reconstruction is {found.shape} and the truth {truth.shape}.")
    if volume is None:
        volume = truth.ndim == 4 or (truth.ndim == 3 and truth.shape[2] > 4)
    a, b = np.asarray(found, np.float64), np.asarray(truth, np.float64)
    if volume:
        from scipy.ndimage import gaussian_filter

        sigma = (VOLUME_BLUR_PX,) * 3 + (0.0,) * (b.ndim - 3)
        # Planes side by side make one picture: one scale and one peak for all of the volume.
        a, b = (gaussian_filter(v, sigma, mode="constant").reshape(-1, *v.shape[2:]) for v in (a, b))
    return Score(*(of(a, b, fit_scale=True) for of in (metrics.psnr, metrics.ssim, metrics.nrmse)))


class Judge:
    """Holds pixels out, and scores what was found from the rest."""

    def __init__(self, problem: ChartProblem, setting: Setting, seed: int) -> None:
        self.problem, self.setting = problem, setting
        factor = setting.binning
        shape = problem.measurement.shape
        kept = np.ones(shape, bool) if problem.erasures is None else ~problem.erasures
        # Blocks of the coarsest binning, on its grid, so that every setting predicts the same light.
        binnings = problem.binnings
        block = binnings[-1]
        self._together = block // factor
        spans = [_common_blocks(n, binnings) for n in shape]
        chosen = np.random.default_rng(seed).random([count for _, count in spans]) < HELD_SHARE
        held = np.zeros(shape, bool)
        held[tuple(slice(first, first + count * block) for first, count in spans)] = np.repeat(
            np.repeat(chosen, block, 0), block, 1
        )
        self.measurement = block_mean(problem.measurement, factor, about_axis=True)
        self.calibration = reduced_calibration(problem.calibration, factor, None)
        self.held = block_mean((held & kept).astype(np.float32), factor, about_axis=True) > 0.5
        self.kept = block_mean(kept.astype(np.float32), factor, about_axis=True) > 1 - 1e-6
        self.erasures = self.held | ~self.kept
        pixel_noise = channel_noise(problem.measurement, kept, problem.noise)
        self.noise = pixel_noise / factor
        self._block_noise = pixel_noise / block
        starts = [
            blocks_about_axis(n, self._together)[1] // 2 - (whole // 2 - first) // block
            for n, whole, (first, _) in zip(self.held.shape, shape, spans, strict=True)
        ]
        self._common = tuple(
            slice(start, start + count) for start, (_, count) in zip(starts, spans, strict=True)
        )
        self._scored = self._blocks(self.held & self.kept) > 0.5
        used = self._blocks(~self.erasures) > 1 - 1e-6
        self._waves, self._block_waves = _slow_waves(~self.erasures), _slow_waves(used)

    def _blocks(self, image: Array) -> Array:
        """Average over the coarsest binning's blocks, those that every binning has."""
        return np.asarray(
            block_mean(np.asarray(image, np.float32), self._together, about_axis=True)[self._common]
        )

    @property
    def used(self) -> Calibration:
        """What the setting reconstructs with: of a picture with one PSF the one nearest to the axis alone."""
        if self.problem.volume or not self.setting.is_plain:
            return self.calibration
        return self.calibration.part([self.calibration.nearest_to_axis()])

    def point(self, found: Array, iterations: int, seconds: float) -> Point:
        """Score a picture or volume of the full field."""
        planes = found[None] if found.ndim == 2 else found
        predicted = self._predict(planes)
        fine = _misfit(self.measurement, predicted, self._waves) / self.noise
        used, held = fine[~self.erasures], fine[self.held & self.kept]
        seen, shown = self._blocks(self.measurement), self._blocks(predicted)
        error = _misfit(seen, shown, self._block_waves)[self._scored] / self._block_noise
        count = min(PARTS, held.size)
        marks: dict[str, Any] = {}
        if self.problem.truth is not None:
            shown = enlarged(self._on_sensor(planes), self.setting.binning, self.problem.measurement.shape)
            volume = self.problem.volume
            marks = asdict(score(shown if volume else shown[0], self.problem.truth, volume=volume))
        return Point(
            self.setting.name,
            iterations,
            seconds,
            float(np.sqrt(np.mean(used**2))),
            float(np.sqrt(np.mean(error**2))) if error.size else float("nan"),
            family=self.setting.family,
            binning=self.setting.binning,
            held_out_parts=tuple(float(np.mean(held[k::count] ** 2)) for k in range(count)),
            **marks,
        )

    def _on_sensor(self, planes: Array) -> Array:
        height, width = self.measurement.shape
        psf = self.calibration.psfs.shape
        (rows, columns), _ = window_of("sensor", (height, width), (psf[2], psf[3]))
        return planes[:, rows, columns]

    def _predict(self, planes: Array) -> Array:
        """Return the measurement that the setting's own model makes of what was found."""
        part = self._part
        placed = np.zeros(part.camera.domain_shape, part.dtype)
        placed[0, :, : planes.shape[1], : planes.shape[2]] = planes / part.problem.image_scale[0, 0]
        predicted: Array = part.camera.forward(placed)[0]
        if self.setting.background:
            predicted = predicted + part.background(placed)[0]
        return predicted * np.float32(self.noise)

    @cached_property
    def _part(self) -> Part:
        options = ReconstructionOptions(
            model=self.setting.model,  # type: ignore[arg-type]
            estimate_background=self.setting.background,
            prior="nonnegative",
        )
        measured = Measurement(self.measurement, self.noise, erasures=self.erasures)
        return Part(Problem.of(measured, self.used, options), slice(0, 1))


def _slow_waves(used: BoolArray) -> BackgroundRemoval:
    """Return what takes slow waves out of an image (height, width), fitted where it was used."""
    rows, columns = (
        max(1, min(most, count // _PIXELS_A_WAVE))
        for most, count in zip(BACKGROUND_FREQUENCIES, used.shape, strict=True)
    )
    return BackgroundRemoval((1, *used.shape), (rows, columns), used, dtype=np.float64)


def _misfit(seen: Array, shown: Array, waves: BackgroundRemoval) -> Float64Array:
    """Return what a prediction misses at its best brightness, slow waves aside."""
    image, prediction = (np.asarray(a, np.float64)[None] for a in (seen, shown))
    shape = waves.forward(prediction)
    power = float(np.vdot(shape, shape))
    # A prediction that is nothing but slow waves has no brightness of its own to be fitted.
    tells = power > 1e-12 * float(np.vdot(prediction, prediction))
    gain = max(float(np.vdot(shape, waves.forward(image))) / power, 0.0) if tells else 1.0
    rest = image - gain * prediction
    return np.asarray((rest - waves.background(rest))[0])


def _common_blocks(n: int, binnings: Sequence[int]) -> tuple[int, int]:
    """First pixel and number of the coarsest binning's blocks that all binnings have when binned on."""
    block = binnings[-1]
    before, behind = n, n
    for factor in binnings:
        _, count = blocks_about_axis(blocks_about_axis(n, factor)[1], block // factor)
        before, behind = min(before, count // 2), min(behind, count - count // 2)
    return n // 2 - before * block, before + behind
