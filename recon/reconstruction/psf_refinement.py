"""Self-calibration: how large the PSFs are and how they are turned, fitted from the photograph itself.

Between calibration and photograph a diffuser is bumped, a sensor warms up, a scene stands at another depth.
A copy of the PSFs is right when it predicts pixels that the reconstruction has not seen. So a share of the
pixels is erased, reconstructed from the rest through scaled and turned copies on binned pixels, and what is
left there is made as small as it gets; other pixels, which no fit has seen, then say whether it helped.

Only fine structure counts: what is left less its own local mean, so that no background need be fitted (with
one, stray light of three times the scene's gives the same to 0.01 %). Slow waves are most of a residual on
measured data and pull the scale by half a percent; without them forty iterations say what four hundred do, to
0.06 %.

Of a picture of one depth of several that were calibrated, the size tells the depth (Kuo 2020, Eq. 5.2). Where
another calibrated one is nearer to that, its PSF is in focus there as the enlarged one is not: it is fitted
as well, and the one of the two is taken that leaves less.

A photograph cannot tell where a PSF lies nor how bright it is: a PSF that is moved or brighter makes a
picture that is moved or darker, and fits as well.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product
from typing import Any

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.base.blocks import block_sum
from recon.base.declare import settled
from recon.camera.camera_model import CAMERAS, Depths, choose_model, one_depth
from recon.camera.depth_mixture import central_psfs, paraxial_scale
from recon.camera.grid import FAR_UM
from recon.camera.transformed import Transformation, transformed
from recon.camera.varying_psfs import FieldOfPsfs
from recon.errors import InputError
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.pilot import fine_structure, pilot, tile_means
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reduction import reduced_calibration
from recon.reconstruction.weights import kind_of
from recon.types import Calibration

SEARCH_PX, SEARCH_ITERATIONS = 100, 30
"""Longest side, about, and iterations of the reconstructions that a first guess is searched with."""
FIT_PX, FIT_ITERATIONS = 200, 100
"""The same of those that it is fitted with."""
LARGE = 3
"""So many fewer iterations of volumes and of PSFs that vary, whose iterations cost most."""
HELD_SHARE = 0.1
"""Of the pixels, for the fit, and as many again for the judgement."""
BETWEEN_PX = 0.37
"""By how much all copies are displaced."""
SEARCH_STEP_PX = 1.0
"""Steps of the search, binned pixels at the pattern's root mean square radius."""
LEAST_RADIUS_PX = 20.0
"""Of a pattern, by which the steps go: size and turn of a smaller one hardly matter, and are not overdone."""
LARGEST = 0.1
"""Change of size, and turn in radians, that are searched."""
FIT_STEPS_PX = (0.5, 0.3)
"""The same of the two fits, one after the other."""
LEAST = 1e-12
"""Mean square of what is left, below which tiles do not differ."""
TOLD_DEG, TOLD_SCALE = 1.0, 0.02
"""Standard deviations of turn and scale from which the photograph tells nothing."""
STRUCTURE = 0.1
"""Of the noise, left on held-out pixels: a photograph with less is flat, and what fits it is rounding."""
CERTAIN = 3.0
"""Standard errors by which held-out pixels, and the parameters, must differ for a copy to be the better."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """How the PSFs of a calibration fit a photograph best.

    Attributes
    ----------
    transformation : Transformation
        What makes of the given PSFs those that fit best.
    scale_error, rotation_error_deg : float
        Standard deviations of its scale (None in a volume, where it is not fitted) and rotation.
    given, found : float
        Fine structure that is left on pixels held out of all fits, in units of the noise: by the PSFs as
        given, and by the copy.
    certainty : float
        By how many standard errors the copy is better there.
    significance : float
        How far the transformation is from none, in its own standard errors.
    seconds : float
        Wall time.
    of_z_um : float or None
        The calibrated depth whose PSFs these are, where it is not the one that was asked for.
    z_um, z_error_um : float or None
        The scene's depth by the size that was found, and its standard deviation; None where only one depth
        was calibrated, or the distance from diffuser to sensor is not known.
    """

    transformation: Transformation
    scale_error: float | None
    rotation_error_deg: float
    given: float
    found: float
    certainty: float
    significance: float
    seconds: float
    of_z_um: float | None = None
    z_um: float | None = None
    z_error_um: float | None = None

    @property
    def helps(self) -> bool:
        """Whether the copy is certainly better."""
        return self.told and bool(min(self.certainty, self.significance) >= CERTAIN)

    @property
    def told(self) -> bool:
        """Whether the photograph tells size and turn: else errors of the model alone may look like a fit."""
        return (
            self.given > STRUCTURE
            and 0 < self.rotation_error_deg <= TOLD_DEG
            and (self.scale_error or 0.0) <= TOLD_SCALE
        )

    def of(self, calibration: Calibration) -> Calibration:
        """Return the calibration with the copy, and its sources where they then are; as given if no help."""
        if not self.helps:
            return calibration
        return as_refined(calibration, self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Return all of it for a file."""
        how = self.transformation
        return {
            "scale": how.scale,
            "scale_error": self.scale_error,
            "rotation_deg": how.rotation_deg,
            "rotation_error_deg": self.rotation_error_deg,
            "of_z_um": self.of_z_um,
            "z_um": self.z_um,
            "z_error_um": self.z_error_um,
            "held_out_given": self.given,
            "held_out_found": self.found,
            "standard_errors": self.certainty,
            "used": self.helps,
            "words": str(self),
        }

    def __str__(self) -> str:
        """Say it in words."""
        how = self.transformation
        copy = f"turned by {how.rotation_deg:+.2f} +- {self.rotation_error_deg:.2f} degrees"
        if self.scale_error is not None:
            copy += f", {100 * (how.scale - 1):+.2f} +- {100 * self.scale_error:.2f} % larger"
        if self.of_z_um is not None:
            copy = f"of the depth of {self.of_z_um / 1e3:.4g} mm, {copy}"
        if self.z_um is not None and self.z_error_um is not None:
            copy += f", as from {self.z_um / 1e3:.4g} +- {self.z_error_um / 1e3:.2g} mm"
        left = f"{self.given:.3g} to {self.found:.3g} times the noise"
        if self.helps:
            return f"fits better {copy}: fine structure left on held-out pixels falls from {left}"
        if not self.told:
            return "taken as it is: this photograph does not tell how its PSF is turned and how large it is"
        return f"taken as it is: {copy} it fits no better for certain ({left} on held-out pixels)"


def as_refined(calibration: Calibration, refinement: Mapping[str, Any]) -> Calibration:
    """Return a calibration with its PSFs as they fitted a photograph, and its sources where they then are.

    Parameters
    ----------
    calibration : Calibration
    refinement : mapping
        As :meth:`Refinement.to_json` has it: ``scale``, ``rotation_deg`` and ``of_z_um`` count.

    Raises InputError when these are no numbers that PSFs can be turned and enlarged by.
    """
    try:
        how = Transformation(scale=refinement["scale"], rotation_deg=refinement["rotation_deg"])
    except (KeyError, TypeError) as error:
        raise InputError(f"A refinement of PSFs has scale and rotation_deg, not {refinement}.") from error
    if refinement.get("of_z_um") is not None:
        calibration = one_depth(calibration, refinement["of_z_um"])
    positions = calibration.source_positions_um.copy()
    # A pattern that is turned or enlarged is that of a source elsewhere: (x, y) is (column, row).
    positions[:, 1::-1] = positions[:, 1::-1] @ how.matrix.T
    return replace(
        calibration,
        psfs=transformed(calibration.psfs, how),
        source_positions_um=positions,
        provenance={**calibration.provenance, "psf_refined": dict(refinement)},
    )


def refined(
    problem: Problem, *, on_stage: Stage | None = None, cancel: threading.Event | None = None
) -> tuple[Problem, Refinement | None]:
    """Return a problem with the PSFs that fit its photograph, and how they came of the given ones.

    The same problem where that is no certain help; None where it was cancelled.

    Parameters
    ----------
    problem : Problem
        Not reduced yet (before ``choose``).
    on_stage : callable, optional
        ``on_stage(share, what)`` as it goes on.
    cancel : threading.Event, optional

    Raises InputError when the photograph was taken under patterns of light.
    """
    try:
        refinement = refine_psf(problem, on_stage=on_stage, cancel=cancel)
    except _CancelledError:
        return problem, None
    if not refinement.helps:
        return problem, refinement
    if refinement.of_z_um is None:
        calibration, options = refinement.of(problem.calibration), problem.options
    else:
        calibration = refinement.of(_stack(problem))
        options = settled(problem.options, z_um=refinement.of_z_um)
    return Problem.of(problem.measurement, calibration, options), refinement


class _CancelledError(Exception):
    """It was cancelled."""


def refine_psf(
    problem: Problem, *, on_stage: Stage | None = None, cancel: threading.Event | None = None
) -> Refinement:
    """Fit size and rotation of a problem's PSFs, about the sensor's centre, to its photograph.

    In a volume rotation alone: larger PSFs are nearly those of nearer planes, and a wrong size finds a scene
    at other depths that fits as well (2 % on simulated beads).
    Of several channels the one with most contrast over its noise counts. Parameters and errors as
    :func:`refined`.
    """
    if problem.patterned:
        raise InputError("refine_psf is for photographs in one light, not for frames under patterns.")
    began = time.perf_counter()
    tell = on_stage or (lambda *_: None)

    def count(share: float) -> None:
        """Tell how much is done; end where it is cancelled."""
        if cancel is not None and cancel.is_set():
            raise _CancelledError
        tell(share, "fitting the PSF")

    start = _searched(_Trials(problem, SEARCH_PX, SEARCH_ITERATIONS), count)
    trials = _Trials(problem, FIT_PX, FIT_ITERATIONS)
    fit = _fitted(trials, start, FIT_STEPS_PX[0] / trials.radius_px, lambda done: count(0.3 + 0.2 * done))
    fit = _fitted(trials, fit.place, FIT_STEPS_PX[1] / trials.radius_px, lambda done: count(0.5 + 0.2 * done))
    given, found, of_z_um = trials.judged(0 * fit.place), trials.judged(fit.place), None
    z_um = _depth_um(problem, fit.place)
    if z_um is not None and (other := _nearer(problem, z_um)) is not None:
        own = float(other.depths.z_um[0])
        place = fit.place - [0.0, np.log(_growth(problem, own))]
        trials_there = _Trials(other, FIT_PX, FIT_ITERATIONS)
        step = FIT_STEPS_PX[1] / trials_there.radius_px
        there = _fitted(trials_there, place, step, lambda done: count(0.7 + 0.3 * done))
        if trials_there.fitted(there.place).mean() < trials.fitted(fit.place).mean():
            fit, found, of_z_um = there, trials_there.judged(there.place), own
            z_um = _depth_um(other, fit.place)
    how, errors = _transformation(fit.place), np.sqrt(np.diag(fit.covariance))
    ratio = np.log(np.maximum(given, LEAST) / np.maximum(found, LEAST))
    scatter = float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    count(1.0)
    return Refinement(
        how,
        how.scale * float(errors[1]) if trials.n_numbers > 1 else None,
        float(np.rad2deg(errors[0])),
        float(np.sqrt(given.mean())),
        float(np.sqrt(found.mean())),
        float(np.mean(ratio)) / max(scatter, 1e-12),
        np.inf
        if of_z_um is not None
        else float(np.sqrt(fit.place @ np.linalg.pinv(fit.covariance, hermitian=True) @ fit.place)),
        time.perf_counter() - began,
        of_z_um,
        z_um,
        None if z_um is None else float(errors[1]) * z_um**2 * (1 / _distance_um(problem) + 1 / z_um),
    )


def _stack(problem: Problem) -> Calibration:
    """Return all that was calibrated."""
    return problem.calibration if problem.stack is None else problem.stack


def _distance_um(problem: Problem) -> float:
    """Return the distance from diffuser to sensor; NaN where it is not known."""
    distance_mm = problem.calibration.geometry.diffuser_distance_mm
    return float("nan") if distance_mm is None else 1e3 * distance_mm


def _growth(problem: Problem, z_um: float) -> float:
    """Return how much larger a pattern is from a depth than from that of a problem's PSF."""
    return paraxial_scale(float(problem.depths.z_um[0]), z_um, _distance_um(problem))


def _depth_um(problem: Problem, place: Float64Array) -> float | None:
    """Return the depth from which a problem's pattern is so large; None where no other was calibrated."""
    d, stack = _distance_um(problem), problem.stack
    if (
        stack is None
        or len(place) < 2
        or not np.isfinite(d)
        or not (stack.source_positions_um[:, 2] > 0).all()
    ):
        return None
    if len(central_psfs(stack)[0]) < 2:
        return None
    return 1 / max(((1 + d / float(problem.depths.z_um[0])) * float(np.exp(place[1])) - 1) / d, 1 / FAR_UM)


def _nearer(problem: Problem, z_um: float) -> Problem | None:
    """Return the problem with the PSFs of the calibrated depth nearest to another, where these are others."""
    nearest = one_depth(_stack(problem), z_um)
    own = float(nearest.source_positions_um[nearest.nearest_to_axis(), 2])
    other = Problem.of(problem.measurement, nearest, settled(problem.options, z_um=own))
    same = other.depths.z_um[0] == problem.depths.z_um[0]
    return None if same else replace(other, stack=_stack(problem))


def _transformation(place: Float64Array) -> Transformation:
    """Return the transformation of a place: rotation in radians, logarithm of the scale where fitted."""
    scale = float(np.exp(place[1])) if len(place) > 1 else 1.0
    return Transformation(scale=scale, rotation_deg=float(np.rad2deg(place[0])))


class _Trials:
    """Reconstructions through copies of the PSFs on binned pixels, each done once."""

    def __init__(self, problem: Problem, side_px: int, iterations: int) -> None:
        factor = max(1, -(-max(problem.sensor_shape) // side_px))
        contrast = [
            float(d[v].std(dtype=np.float64)) for d, v in zip(problem.data, problem.valid, strict=True)
        ]
        channel = int(np.argmax(contrast))
        image, known = _binned(problem.data[channel], problem.valid[channel], factor)
        calibration = problem.calibration
        if calibration.psfs.shape[1] > 1:
            calibration = replace(calibration, psfs=calibration.psfs[:, channel : channel + 1])
        calibration = reduced_calibration(replace(calibration, background=None), factor, None)
        several = problem.n_planes > 1
        self.n_numbers = 1 if several else 2
        options = ReconstructionOptions(
            prior=kind_of(problem.prior_name),
            axis_weights=(1.0, 1.0, 1.0) if several else None,
            estimate_background=several,
            drop_empty=False,
        )
        draw = np.random.default_rng(0).random(image.shape)
        self._fit, self._judge = known & (draw < HELD_SHARE), known & (draw > 1 - HELD_SHARE)
        held = Measurement(image, erasures=~known | self._fit | self._judge)
        self._problem = Problem.of(held, calibration, options)
        model = problem.model
        if model not in CAMERAS and model != "convolution":
            varies = choose_model(self._problem.depths, "auto")[0] != "convolution"
            model = "local" if varies else "convolution"
        self._problem = replace(self._problem, model=model)
        self._data = image / self._problem.noise[0]
        self._known = known
        self._iterations = iterations if self._problem.is_plain else iterations // LARGE
        self._done: dict[tuple[float, ...], tuple[Float64Array, Float64Array]] = {}
        self.radius_px = _radius_px(self._problem.depths.central)

    def fitted(self, place: Float64Array) -> Float64Array:
        """Return the mean square of what is left on the fit's pixels, one a tile."""
        return self._at(place)[0]

    def judged(self, place: Float64Array) -> Float64Array:
        """Return the same on the pixels that no fit has seen."""
        return self._at(place)[1]

    def _at(self, place: Float64Array) -> tuple[Float64Array, Float64Array]:
        key = tuple(np.round(place, 9))
        if key not in self._done:
            square = self._left(_transformation(place)) ** 2
            self._done[key] = tile_means(square, self._fit), tile_means(square, self._judge)
        return self._done[key]

    def _left(self, how: Transformation) -> Array:
        """Return the fine structure that a copy of the PSFs leaves of the photograph, (height, width)."""
        problem = replace(self._problem, depths=_copied(self._problem.depths, how))
        found = pilot(problem, self._iterations)
        left = found.left[0] + np.where(problem.valid[0], 0, self._data)  # what is erased is to be predicted
        return fine_structure(left, self._known)


def _binned(image: Array, valid: Array, factor: int) -> tuple[Array, BoolArray]:
    """Average what is known of each block of pixels; return it, and where anything is."""
    known = block_sum(valid.astype(np.float32), factor, about_axis=True)
    light = block_sum(np.where(valid, image, 0), factor, about_axis=True)
    return light / np.maximum(known, 1), known > 0


def _radius_px(psfs: Array) -> float:
    """Return the root mean square distance of the PSFs' light from the centre, pixels."""
    light = np.maximum(psfs, 0).sum(axis=(0, 1), dtype=np.float64)
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in light.shape)
    square = rows[:, None] ** 2 + columns**2
    return max(float(np.sqrt((light * square).sum() / max(light.sum(), 1e-30))), LEAST_RADIUS_PX)


def _copied(depths: Depths, how: Transformation) -> Depths:
    """Return depths whose PSFs are transformed, with the places that they were registered from.

    All are displaced by part of a pixel, which displaces the picture alone: else the PSFs as given would be
    the only ones that are not interpolated.
    """
    how = replace(how, rows=BETWEEN_PX, columns=BETWEEN_PX)
    fields = [FieldOfPsfs(transformed(f.psfs, how), f.points @ how.matrix.T) for f in depths.fields]
    return replace(depths, central=transformed(depths.central, how), fields=fields)


def _searched(trials: _Trials, count: Callable[[float], object]) -> Float64Array:
    """Return the best place of a lattice that its neighbours lead to, from none."""
    step = SEARCH_STEP_PX / trials.radius_px
    reach = max(int(LARGEST / step), 1)
    at, rounds, moved = np.zeros(trials.n_numbers, int), 0, True
    while moved:
        near = [at + np.array(by) for by in product((-1, 0, 1), repeat=len(at))]
        left = {}
        for place in near:
            if np.abs(place).max() <= reach:
                left[tuple(place)] = float(trials.fitted(place * step).mean())
                count(0.3 * (1 - 0.6**rounds))
        best = np.array(min(left, key=lambda place: left[place]))
        moved, at, rounds = bool((best != at).any()), best, rounds + 1
    return at * step


@dataclass(frozen=True)
class _Fit:
    """Where a paraboloid through trials is least, and how sure the place is."""

    place: Float64Array
    covariance: Float64Array


MOVES = 3
"""Times that the trials are centred anew where the least lies beyond them."""


def _fitted(trials: _Trials, centre: Float64Array, step: float, count: Callable[[float], object]) -> _Fit:
    """Fit a paraboloid to trials about a place.

    Every tile has its own, and the scatter of their slopes at the least tells how sure it is (a sandwich
    estimate): it makes no difference whether noise or errors of the model make them scatter.
    """
    n = len(centre)
    each = np.eye(n)
    pairs = list(combinations_with_replacement(range(n), 2))
    offsets = np.array([0 * each[0], *each, *-each, *(each[i] + each[j] for i, j in pairs if i != j)])
    squares = [offsets[:, i] * offsets[:, j] / (2 if i == j else 1) for i, j in pairs]
    table = np.stack([np.ones(len(offsets)), *offsets.T, *squares], axis=1)
    for number in range(MOVES):
        seen = []
        for k, offset in enumerate(offsets):
            seen.append(trials.fitted(centre + step * offset))
            count((number + (k + 1) / len(offsets)) / MOVES)
        terms = np.linalg.solve(table, np.stack(seen))
        slopes, mean = terms[1 : n + 1], terms.mean(axis=1)
        bend = np.zeros((n, n))
        for (i, j), value in zip(pairs, mean[n + 1 :], strict=True):
            bend[i, j] = bend[j, i] = value
        values, axes = np.linalg.eigh(bend)
        values = np.maximum(values, 1e-3 * max(float(values.max()), 1e-12))
        inverse = axes @ np.diag(1 / values) @ axes.T
        move = -inverse @ mean[1 : n + 1]
        scatter = slopes - slopes.mean(axis=1, keepdims=True)
        tiles = slopes.shape[1]
        covariance = inverse @ (scatter @ scatter.T / (tiles * (tiles - 1))) @ inverse * step**2
        beyond = float(np.abs(move).max())
        centre = centre + step * move * min(1.0, 2.0 / max(beyond, 1e-12))
        if beyond <= 1.5:
            break
    return _Fit(centre, covariance)
