"""How well a calibration and transformed copies of it explain a photograph, in little time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from recon.analysis.resolution import lateral_resolution
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.base.checks import SATURATED_LIGHT, saturated_light, saturated_share
from recon.base.threads import linear_algebra_on_one_thread
from recon.camera.camera_model import CAMERAS, ModelName
from recon.camera.registration import likeness
from recon.camera.transformed import Transformation, transformed
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.pilot import FINE_PX, fine_structure, pilot, tile_means
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reduction import on_blocks, reduced_calibration
from recon.types import Calibration
from recon.verdict.calibration_check import (
    BETWEEN,
    FAR,
    GIVEN,
    NEARLY,
    CalibrationCheck,
    Fit,
    Score,
    as_given,
    check_of,
    is_ahead,
    is_told,
    near_decoys,
)
from recon.verdict.coded import SPEAKS, STRAIGHTER, coded

QUICK, THOROUGH = (100, 10), (160, 20)
"""Longest side, about, pixels, and iterations (half as many of volumes). Most right ones are far ahead of
all decoys in the quick way already: only the others are looked at again."""
MOST_ERASED, ALL_ERASED = 0.75, 0.95
"""Shares of the blocks of pixels: with more of them erased blocks are smaller; beyond, clipped ones are not
erased as well."""
CLIPPED_BLOCK, MOST_CLIPPED = 0.1, 0.5
"""Shares of pixels at full scale: of a block's, from which it is erased, and of all used, from which nobody
is called foreign: what is left is what was dark."""
CONTRADICTIONS = ((Fit.OFF, Fit.FITS), (Fit.FITS, Fit.FOREIGN), (Fit.UNTOLD, Fit.FOREIGN))
"""What the quick and the thorough way may say: then the photograph does not tell."""
STRUCTURED = 0.1
"""Mean square of a photograph's fine structure beyond noise from which it tells anything of a calibration: a
white wall and mere noise have up to 0.08, of 25 scenes under stresses 24 have 0.2 and more."""
MOST_PLANES = 6
"""Depths that take part, evenly spaced."""
WEIGHT = 1.0
"""Of total variation: as large as the noise that the adjoint of a PSF of unit energy passes on."""
FAR_ABOVE = 3.0
"""Times the noise that the calibration leaves of a photograph's fine structure, from which its errors and not
noise set the prior's weight: too small a one lets every pattern explain the photograph."""
HALF_AS_MANY = 1.5
"""How many times as much is left by half of the iterations that tell whether it is coded: of the measured
hand 1.35. Its 0.051 of the contrast is not asked about, which took 7 % of its time."""
HEAVIER = {Fit.UNTOLD: (Fit.FITS, Fit.OFF), Fit.FOREIGN: (Fit.OFF,)}
"""What may then be said where the other was."""
MOVED_DEG, MOVED_SCALE = 6.0, 0.05
"""Turn, such as can be fitted, and change of size up to which a calibration is taken for the own one that
moved: another diffuser's is "8 % smaller" or 11 by chance."""
MOST_DECOYS = 12
"""With farther ones on the side of a near one that is better, each twice as far: to some eight degrees or per
cent. Usually there are eight."""
FARTHEST_DEG, FARTHEST_SCALE = 20.0, 0.3
"""Turn, and change of size (of its logarithm), beyond which none is tried: where few decoys differ, as of
smooth PSFs, they went on to patterns so small that nothing was left of them."""
TRIES, NEARLY_ALL = 60, 0.95
"""Of the quick way, about as many as it takes where they do not clear the calibration; and the share of it
that is told where it takes more."""
AMONG = "judging: the calibration among its decoys"
"""The stage of a check that has found nothing yet."""
ALIKE = 0.7
"""Likeness from which a far decoy tells nothing, as of regular lenslets, which are their own mirror image."""
PART = 0.5
"""Of a near decoy's step, from which the minimum between it and the given one is tried as well: less is no
other calibration."""
VARIED = 0.35
"""Difference of a field's PSFs from the central one, relative to it, beyond which that one explains little
more than any other pattern: then all of them are tried, or, where one was chosen, nobody is accused."""


@linear_algebra_on_one_thread()
def check_calibration(problem: Problem, *, on_stage: Stage | None = None) -> CalibrationCheck | None:
    """Let a problem's calibration compete with its decoys on the channel that has most signal.

    One convolution a depth by the central PSFs, on as few pixels as still tell one per cent of size; of PSFs
    that vary over the field only whether they are the photograph's at all, and where they vary much by all of
    them, turned too. None where the light is patterned, the camera model comes from outside, one PSF was
    chosen of a field that varies much, or no decoy differs: nothing is known of such.
    """
    if problem.patterned or problem.model in CAMERAS:
        return None
    check = _checked(problem, on_stage)
    if check is None or (check.wrong and check.better in FAR):
        return check
    if check.wrong:
        return replace(check, cause=_cause(problem, check.better))
    # Coded ones may well be explained by their own calibration better than by any other.
    cause = _coded(problem) if problem.n_planes == 1 and not _is_explained(check, problem) else None
    return check if cause is None else replace(check, fit=Fit.OFF, better=None, cause=cause)


@linear_algebra_on_one_thread()
def fitting_depth(problem: Problem, now: int) -> int:
    """Return which of a problem's depths explains it better than all others, each taken alone.

    ``now``, counted from 0, unless another one does so certainly: a scene that has depth, noise or a white
    wall speak for none.
    """
    small = _small(problem, QUICK[0], most=problem.n_depths)
    if problem.n_depths < 2 or small.varies or small.fine() < STRUCTURED:
        return now
    psfs, places = small.calibration.psfs, small.calibration.source_positions_um
    scores = []
    for depth in range(problem.n_depths):
        alone = replace(
            small.calibration, psfs=psfs[depth : depth + 1], source_positions_um=places[depth : depth + 1]
        )
        one = replace(small, calibration=alone)
        scores.append(one.score(GIVEN, iterations=QUICK[1], background=problem.smooth))
    best = int(np.argmin([score.objective for score in scores]))
    return best if is_ahead(scores[best], (scores[now],), small.pixels, NEARLY) else now


def _checked(problem: Problem, on_stage: Stage | None) -> CalibrationCheck | None:
    done, words = 0, AMONG

    def scoring(
        small: _Small, iterations: int, *, lit: bool, weight: float = WEIGHT
    ) -> Callable[[Transformation], Score]:
        @cache
        def scored(how: Transformation) -> Score:
            nonlocal done
            if on_stage is not None:
                on_stage(min(done / TRIES, NEARLY_ALL), words)
            done += iterations // quick
            return small.score(how, iterations=iterations, background=lit, weight=weight)

        return scored

    (few_px, quick), (more_px, thorough) = QUICK, THOROUGH
    few, lit = _small(problem, few_px), problem.smooth or problem.n_planes > 1
    if not few.decoys():
        return None
    if few.fine() < STRUCTURED:
        return CalibrationCheck(Fit.UNTOLD, {}, 0)
    check = _competition(few, scoring(few, quick, lit=lit))
    if check.sure:
        return check
    if check.better is not None:
        words = f"judging: so far its PSF explains the photograph better {check.better}"
    many = few if lit else _small(problem, more_px)
    again = _competition(many, scoring(many, thorough, lit=lit))
    if (check.fit, again.fit) in CONTRADICTIONS:
        return replace(again, fit=Fit.UNTOLD, better=None)
    # A faint photograph's large pixels may tell what small ones do not; on the same ones more iterations do.
    same = check.fit is Fit.FOREIGN and many.pixels == few.pixels
    check, small = (again, many) if same or again.fit is not Fit.UNTOLD else (check, few)
    in_light = scoring(small, thorough, lit=True)
    if check.wrong and not lit and not _stands(check, in_light):
        again = _competition(small, in_light)
        own, cleared, stands = as_given(again.scores), again.fit is Fit.FITS, True
        if check.better is not None:  # which this competition may not have come to
            accuser = again.scores.get(check.better) or in_light(check.better)
            cleared = cleared and is_told(own, accuser, small.pixels)
            stands = not _is_near(check.better) or is_ahead(accuser, (own,), small.pixels, NEARLY)
        check = again if cleared else check if stands else replace(again, fit=Fit.UNTOLD, better=None)
    left = float(np.mean(as_given(again.scores).fine)) ** 0.5
    if check.fit in HEAVIER and left > FAR_ABOVE:
        again = _competition(small, scoring(small, thorough, lit=lit, weight=left))
        check = again if again.fit in HEAVIER[check.fit] and _is_certain(again) else check
    if check.wrong and small.clipped > MOST_CLIPPED:
        return replace(check, fit=Fit.UNTOLD, better=None)
    given = _given(problem).depths
    one = given.varies and not problem.depths.varies and given.field_error > VARIED
    return None if one and check.fit in (Fit.FOREIGN, Fit.UNTOLD) else check


def _stands(check: CalibrationCheck, in_light: Callable[[Transformation], Score]) -> bool:
    """Whether a far decoy is better whatever stray light there is, or light from beyond the field.

    ``in_light`` scores with a background. No other decoy has to be asked where the calibration itself is not
    ahead of that one.
    """
    if check.better not in FAR:
        return False
    own = as_given({how: in_light(how) for how in (GIVEN, BETWEEN)})
    return not is_told(own, in_light(check.better), check.pixels)


@dataclass(frozen=True, slots=True)
class _Small:
    """A channel of a photograph on few pixels, and its calibration there: one PSF a depth, or a field's."""

    photograph: Measurement
    calibration: Calibration
    varies: bool
    """Whether there are other PSFs over the field; near decoys of one of them then tell nothing."""
    model: ModelName
    clipped: float
    """Share of the photograph's pixels that were at full scale."""

    @property
    def pixels(self) -> int:
        """That are not erased."""
        erasures = self.photograph.erasures
        return int(np.size(self.photograph.image) - (0 if erasures is None else np.count_nonzero(erasures)))

    def seen(self, *, background: bool) -> Problem:
        """Return the problem through its own calibration."""
        return self._problem(self.calibration, background=background)

    def structure(self) -> float:
        """Return how much of :meth:`fine` the PSFs resolve: all or nothing."""
        problem = self._problem(self.calibration, background=False)
        finest = lateral_resolution(problem.depths.central[problem.n_depths // 2, 0]).mean_px
        return self.fine() if finest <= FINE_PX else 0.0

    def fine(self) -> float:
        """Return the mean square of the photograph's fine structure beyond noise."""
        problem = self._problem(self.calibration, background=False)
        valid = problem.valid[0]
        return float(np.mean(fine_structure(problem.data[0].astype(np.float64), valid)[valid] ** 2)) - 1

    def unexplained(self, *, background: bool) -> float:
        """Return the share of the photograph's contrast beyond noise that its calibration leaves."""
        problem = self._problem(self.calibration, background=background)
        left, valid = pilot(problem, THOROUGH[1], weight=WEIGHT).left[0], problem.valid[0]
        beyond = max(float(np.mean(left[valid].astype(np.float64) ** 2)) - 1, 0.0)
        contrast = float(np.std(problem.data[0][valid], dtype=np.float64))
        return float(np.sqrt(beyond)) / max(contrast, 1e-30)

    def otherwise(self, how: Transformation) -> _Small:
        """Return the same photograph with transformed PSFs."""
        psfs = transformed(self.calibration.psfs, how)
        return replace(self, calibration=replace(self.calibration, psfs=psfs))

    def decoys(self) -> tuple[Transformation, ...]:
        """Return those that differ from the PSFs: near ones unless one of many serves, then far ones."""
        psfs = self.calibration.psfs
        middle = psfs[len(psfs) // 2, 0]
        far = [how for how in FAR if likeness(transformed(middle, how), middle) < ALIKE]
        field = self.model == "local"
        if self.varies and not field:
            return tuple(far)
        return (*near_decoys(psfs.shape[2:], sizes=len(psfs) == 1 and not field), *far)

    def score(
        self, how: Transformation, *, iterations: int, background: bool, weight: float = WEIGHT
    ) -> Score:
        """Reconstruct through transformed PSFs in few iterations."""
        positions = self.calibration.source_positions_um.copy()
        positions[:, 1::-1] = positions[:, 1::-1] @ how.matrix.T  # (x, y) is (column, row)
        copies = replace(
            self.calibration, psfs=transformed(self.calibration.psfs, how), source_positions_um=positions
        )
        problem = self._problem(copies, background=background)
        return _score(problem, iterations if problem.n_planes == 1 else -(-iterations // 2), weight)

    def _problem(self, calibration: Calibration, *, background: bool) -> Problem:
        options = ReconstructionOptions(
            prior="tv", model=self.model, estimate_background=background, drop_empty=False
        )
        return Problem.of(self.photograph, calibration, options)


def _is_near(how: Transformation) -> bool:
    """Whether a decoy is the calibration itself, a little turned or enlarged."""
    return how not in FAR and abs(how.rotation_deg) <= MOVED_DEG and abs(how.scale - 1) <= MOVED_SCALE


def _is_certain(check: CalibrationCheck) -> bool:
    """Whether what explains a photograph better certainly does, and is no larger turn than can be fitted."""
    if check.better is None:
        return True
    near = check.better in FAR or abs(check.better.rotation_deg) <= MOVED_DEG
    return near and is_ahead(check.scores[check.better], (as_given(check.scores),), check.pixels)


def _competition(small: _Small, scored: Callable[[Transformation], Score]) -> CalibrationCheck:
    """Score a calibration, its decoys, and farther ones on the side of a near one that is better."""
    decoys = small.decoys()
    scores = {how: scored(how) for how in (GIVEN, *decoys)}
    check = check_of(scores, small.pixels)
    if check.sure:
        return check
    structure = small.structure()
    scores[BETWEEN] = scored(BETWEEN)
    near = [how for how in decoys if how not in FAR]
    for how in _minima(scores, near, small.pixels):
        scores[how] = scored(how)
    before, best = GIVEN, min((GIVEN, *near), key=lambda how: scores[how].objective)
    while scores[best].objective < scores[before].objective and len(scores) < MOST_DECOYS:
        before, best = best, Transformation(scale=best.scale**2, rotation_deg=2 * best.rotation_deg)
        if abs(best.rotation_deg) > FARTHEST_DEG or abs(np.log(best.scale)) > FARTHEST_SCALE:
            break
        scores[best] = scored(best)
    return check_of(scores, small.pixels, structure)


def _minima(
    scores: Mapping[Transformation, Score], near: Sequence[Transformation], pixels: int
) -> Iterator[Transformation]:
    """Yield where the objective of turns and of sizes is least between given and near ones, by a parabola."""
    given = as_given(scores).objective
    for one, other in zip(near[::2], near[1::2], strict=True):
        up, down = scores[one].objective - given, scores[other].objective - given
        if up + down <= 0:
            continue
        at, gain = (down - up) / (2 * (up + down)), (down - up) ** 2 / (8 * (up + down))
        if PART <= abs(at) <= 1 - PART / 2 and gain * pixels / 2 > NEARLY.nats:
            yield Transformation(scale=one.scale**at, rotation_deg=at * one.rotation_deg)


def _small(problem: Problem, longest_px: int, most: int = MOST_PLANES) -> _Small:
    """Return the channel that has most signal on blocks of pixels, as large ones as erasures allow.

    ``most``: of its depths.
    """
    channel = int(np.argmax([d[v].std() for d, v in zip(problem.data, problem.valid, strict=True)]))
    own = slice(channel, channel + 1)
    factor = max(1, round(max(problem.sensor_shape) / longest_px))
    counts, valid = problem.measurement.channels()[own], problem.valid[own]
    while True:
        photograph = on_blocks(problem.data[own], valid, 1.0, factor, flat=True)
        erased = photograph.erasures
        if factor == 1 or erased is None or np.asarray(erased).mean() < MOST_ERASED:
            break
        factor //= 2
    if clipped := saturated_share(counts[valid]):  # a clipped pattern is no pattern's own
        top = (counts == counts[valid].max()).astype(np.float32)
        over = block_mean(top, factor, about_axis=True)[0] > CLIPPED_BLOCK
        over = over if erased is None else over | np.asarray(erased)
        if over.mean() < ALL_ERASED:
            photograph = replace(photograph, erasures=over)
    depths = problem.depths
    planes = np.unique(np.linspace(0, problem.n_depths - 1, most).round().astype(int))
    if local := depths.varies and depths.field_error > VARIED:
        calibration = reduced_calibration(problem.calibration, 1, tuple(planes.tolist()))
    else:  # depths by number: they only have to differ
        places = np.column_stack([np.zeros((len(planes), 2)), 1.0 + np.arange(len(planes))])
        calibration = Calibration(depths.central[planes], places)
    psfs = calibration.psfs[:, own if calibration.psfs.shape[1] > 1 else slice(0, 1)]
    calibration = replace(calibration, psfs=_on_sensor(psfs, problem.sensor_shape), background=None)
    calibration = reduced_calibration(calibration, factor, None)
    varies = _given(problem).depths.varies
    # Erased ones, too, which a reduced problem has forgotten.
    clipped = max(clipped, *(saturated_share(c) for c in _given(problem).measurement.channels()))
    return _Small(photograph, calibration, varies, "local" if local else "convolution", clipped)


def _cause(problem: Problem, better: Transformation | None) -> tuple[str, str] | None:
    """Return what keeps a calibration from fitting and is no other calibration, in words, and what to do."""
    light = max(saturated_light(psf) for depth in _given(problem).depths.central for psf in depth)
    if light > SATURATED_LIGHT:
        return "its PSF is saturated", "Take the PSF again with a shorter exposure"
    return _coded(problem, better, asked=True)


def _is_explained(check: CalibrationCheck, problem: Problem) -> bool:
    """Whether a calibration left so little, in few iterations without a background, that nothing is coded."""
    if problem.smooth or not check.scores:
        return not problem.smooth
    small = _small(problem, QUICK[0])
    if small.pixels != check.pixels:  # both in units of the noise, which larger pixels have less of
        small = _small(problem, THOROUGH[0])
    seen = small.seen(background=False)
    contrast = float(np.std(seen.data[seen.valid], dtype=np.float64))
    beyond = max(as_given(check.scores).misfit - 1, 0.0)
    return bool(beyond**0.5 < HALF_AS_MANY * SPEAKS * contrast)


def _coded(
    problem: Problem, better: Transformation | None = None, *, asked: bool = False
) -> tuple[str, str] | None:
    """Return that something is coded for the eye, in words, and what to do; None where nothing is.

    A photograph of few bright points is explained better by anything once it is raised to a power. What was
    coded is explained clearly worse then by the calibration that was ``better`` (None: by a mirrored one)
    and as it is by a background, where one is estimated: a power takes light and dark levels, too.
    """
    small, lit = _small(problem, QUICK[0]), problem.n_planes > 1
    if small.model == "local":
        return None

    def tried(photograph: Float32Array, psfs: Float32Array) -> _Small:
        raw = photograph is small.photograph.image
        seen = small.photograph if raw else replace(small.photograph, image=photograph, noise=None)
        return replace(small, photograph=seen, calibration=replace(small.calibration, psfs=psfs))

    def left(photograph: Float32Array, psfs: Float32Array) -> float:
        return tried(photograph, psfs).unexplained(background=lit)

    both = np.asarray(small.photograph.image), small.calibration.psfs
    how = coded(*both, left, asked=asked)
    if how is None:
        return None
    straightened = tried(*how.straightened(*both))
    other = straightened.otherwise(better or FAR[0]).unexplained(background=lit)
    if problem.smooth:
        other = min(other, small.unexplained(background=True))
    if straightened.unexplained(background=lit) >= STRAIGHTER * other:
        return None
    return (
        f"its PSF explains it better where {how.words} gamma-coded",
        "Take raw frames, or files in proportion to the light (JPEG files and webcams' are not). What is "
        f"sRGB is straightened by --srgb {how.option}",
    )


def _given(problem: Problem) -> Problem:
    """Return a problem as it was before it was reduced."""
    return problem if problem.reduction is None else problem.reduction.given


def _on_sensor(psfs: Float32Array, shape: tuple[int, int]) -> Float32Array:
    """Return PSFs that were cut to a central window on the sensor's pixels."""
    whole = np.zeros((*psfs.shape[:2], *shape), np.float32)
    top, left = (n // 2 - m // 2 for n, m in zip(shape, psfs.shape[2:], strict=True))
    whole[..., top : top + psfs.shape[2], left : left + psfs.shape[3]] = psfs
    return whole


def _score(problem: Problem, iterations: int, weight: float) -> Score:
    """Reconstruct a problem of one channel and score it."""
    found = pilot(problem, iterations, weight=weight)
    valid, last = problem.valid[0], found.outcome.history[-1]
    prior = last.objective - 0.5 * last.data_residual**2
    left = found.left[0].astype(np.float64)
    misfit = float(np.mean(left[valid] ** 2))
    square = fine_structure(left, valid) ** 2
    fine = tile_means(square, valid)
    mean = float(np.mean(fine))
    asked = 2 * prior / np.count_nonzero(valid)
    # Total variation is where the picture's steps are; beyond the field they count at its edge.
    steps = sum(np.abs(np.diff(found.solution[0], axis=a, append=0)).sum(axis=0) for a in (1, 2))
    rows, columns = (
        np.clip(np.arange(n) - within.start, 0, within.stop - within.start - 1)
        for n, within in zip(steps.shape, problem.window, strict=True)
    )
    share = np.zeros(valid.shape)
    np.add.at(share, (rows[:, None], columns), steps)
    tiles = fine + asked * tile_means(share, valid) / max(float(share[valid].mean()), 1e-30)
    return Score(misfit, mean + asked, tuple(fine.tolist()), tuple(tiles.tolist()))
