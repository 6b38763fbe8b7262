"""How well a calibration and transformed copies of it explain a photograph, in little time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from recon.base.blocks import block_mean
from recon.base.checks import saturated_share
from recon.camera.camera_model import CAMERAS
from recon.camera.registration import likeness
from recon.camera.transformed import Transformation, transformed
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.pilot import fine_structure, pilot, tile_means
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reduction import on_blocks
from recon.types import Calibration
from recon.verdict.calibration_check import (
    BETWEEN,
    FAR,
    GIVEN,
    CalibrationCheck,
    Fit,
    Score,
    check_of,
    is_told,
    near_decoys,
)

Floats = npt.NDArray[np.float32]

LONGEST_PX = 160
"""Longest side that decoys are tried on, pixels, about: one per cent of it is a caustic's width."""
MOST_ERASED, MOST_CLIPPED = 0.75, 0.5
"""Shares of the blocks of pixels: with more of them erased blocks are smaller; with more of them clipped
these are not erased, as a few pixels of a dim photograph share its largest count as well."""
MOST_PLANES = 6
"""Depths that take part, evenly spaced."""
ITERATIONS, OF_VOLUMES = 20, 10
"""Of pictures and volumes: a right PSF is far ahead long before they have settled."""
WEIGHT = 1.0
"""Of total variation: as large as the noise that the adjoint of a PSF of unit energy passes on."""
MOST_DECOYS = 12
"""With farther ones on the side of a near one that is better, each twice as far: to some eight degrees or per
cent."""
ALIKE = 0.7
"""Likeness from which a far decoy tells nothing, as of regular lenslets, which are their own mirror image."""
VARIED = 0.35
"""Difference of a field's PSFs from the central one, relative to it, beyond which that one explains little
more than any other pattern: with a background right calibrations looked foreign from 0.4 on."""


def check_calibration(problem: Problem, *, on_stage: Stage | None = None) -> CalibrationCheck | None:
    """Let a problem's calibration compete with its decoys on the channel that has most signal.

    One convolution a depth by the central PSFs, as few pixels as still tell one per cent of size; of PSFs
    that vary over the field only whether they are the photograph's at all. None where the light is patterned,
    the camera model comes from outside, or the PSFs vary too much: nothing is known of such.
    """
    if problem.patterned or problem.model in CAMERAS:
        return None
    channel = int(np.argmax([d[v].std() for d, v in zip(problem.data, problem.valid, strict=True)]))
    own = slice(channel, channel + 1)
    psfs = problem.depths.central
    planes = np.unique(np.linspace(0, len(psfs) - 1, MOST_PLANES).round().astype(int))
    psfs = _on_sensor(psfs[planes][:, own if psfs.shape[1] > 1 else slice(0, 1)], problem.sensor_shape)
    factor, photograph = _small(problem, own)
    psfs = block_mean(psfs, factor, about_axis=True)
    volume, lit = len(psfs) > 1, problem.smooth or problem.n_planes > 1
    done = 0

    def scored(how: Transformation, *, background: bool) -> Score:
        nonlocal done
        if on_stage is not None:
            on_stage(done / (2 + len(decoys)), "judging: the calibration among its decoys")
        done += 1
        copies = Calibration(transformed(psfs, how), np.full((len(psfs), 3), np.nan))
        if volume:  # depths by number: they only have to differ
            copies.source_positions_um[:] = [(0.0, 0.0, 1.0 + z) for z in range(len(psfs))]
        options = ReconstructionOptions(
            prior="tv", model="convolution", estimate_background=background, drop_empty=False
        )
        return _score(Problem.of(photograph, copies, options))

    middle = psfs[len(psfs) // 2, 0]
    far = [how for how in FAR if likeness(transformed(middle, how), middle) < ALIKE]
    given = problem.reduction.given if problem.reduction is not None else problem
    near = () if given.depths.varies else near_decoys(psfs.shape[2:], volume=volume)
    erased = 0 if photograph.erasures is None else np.count_nonzero(photograph.erasures)
    decoys, pixels = (*near, *far), int(np.asarray(photograph.image).size - erased)
    check = _competition(decoys, pixels, partial(scored, background=lit))
    if check.fit is not Fit.FITS and not lit:
        # Stray light, or light from beyond the field, which any PSF but the right one may explain better.
        winner = check.better or GIVEN
        if is_told(scored(winner, background=True), check.scores[winner], pixels):
            check = _competition(decoys, pixels, partial(scored, background=True))
    too_varied = given.depths.varies and given.depths.field_error > VARIED
    return None if too_varied and check.fit in (Fit.FOREIGN, Fit.UNTOLD) else check


def _competition(
    decoys: Sequence[Transformation], pixels: int, scored: Callable[[Transformation], Score]
) -> CalibrationCheck:
    """Score a calibration, its decoys, and farther ones on the side of a near one that is better."""
    scores = {how: scored(how) for how in (GIVEN, BETWEEN, *decoys)}
    near = [how for how in decoys if how not in FAR]
    before, best = GIVEN, min((GIVEN, *near), key=lambda how: scores[how].objective)
    while scores[best].objective < scores[before].objective and len(scores) < MOST_DECOYS:
        before, best = best, Transformation(scale=best.scale**2, rotation_deg=2 * best.rotation_deg)
        scores[best] = scored(best)
    return check_of(scores, pixels)


def _small(problem: Problem, own: slice) -> tuple[int, Measurement]:
    """Return a channel on blocks of pixels, as large ones as erasures and clipped pixels allow."""
    factor = max(1, round(max(problem.sensor_shape) / LONGEST_PX))
    counts, valid = problem.measurement.channels()[own], problem.valid[own]
    if 0 < saturated_share(counts[valid]) * factor**2 < MOST_CLIPPED:
        valid = valid & (counts < counts[valid].max())
    while True:
        photograph = on_blocks(problem.data[own], valid, 1.0, factor, flat=True)
        if factor == 1 or photograph.erasures is None or np.asarray(photograph.erasures).mean() < MOST_ERASED:
            return factor, photograph
        factor //= 2


def _on_sensor(psfs: Floats, shape: tuple[int, int]) -> Floats:
    """Return PSFs that were cut to a central window on the sensor's pixels."""
    whole = np.zeros((*psfs.shape[:2], *shape), np.float32)
    top, left = (n // 2 - m // 2 for n, m in zip(shape, psfs.shape[2:], strict=True))
    whole[..., top : top + psfs.shape[2], left : left + psfs.shape[3]] = psfs
    return whole


def _score(problem: Problem) -> Score:
    """Reconstruct a problem of one channel in few iterations."""
    found = pilot(problem, ITERATIONS if problem.n_planes == 1 else OF_VOLUMES, weight=WEIGHT)
    valid, last = problem.valid[0], found.outcome.history[-1]
    prior = last.objective - 0.5 * last.data_residual**2
    left = found.left[0].astype(np.float64)
    misfit = float(np.mean(left[valid] ** 2))
    fine = tile_means(fine_structure(left, valid) ** 2, valid)
    return Score(misfit, misfit + 2 * prior / np.count_nonzero(valid), tuple(fine.tolist()))
