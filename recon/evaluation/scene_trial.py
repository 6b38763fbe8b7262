"""Trials of one scene: rendered, photographed under stress, reconstructed and judged.

Points lost or made up: whether the peaks of a reconstruction are where the true points are.

Points on their own are judged one by one: each has a peak within reach or is lost, and a peak far from every
point is made up. Where points are crowded too few are on their own for a share of a tenth to be told, and
peaks so many that one lies within reach of any place. There three things differ:

* A point is asked for where its neighbours are farther than the nominal resolution, and where the truth
  itself, put through the same search for peaks, shows it: no method separates what is nearer, and no method
  shows on this grid what the truth on it does not.
* Of the places that are as far from all points as those that are asked for are from the others, a share ``c``
  has a peak within reach. Were a share ``q`` of the points truly lost, a point would have no peak with the
  probability ``q (1 - c)``: the share without one is divided by ``1 - c``. So a reconstruction that has
  nothing to do with the points loses all of them, however many of its peaks lie near one.
* Likewise with peaks that are near no point: a share ``v`` of all places is, so the share of peaks there is
  divided by ``v``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from recon.analysis.correlation import RESOLUTION_LEVEL
from recon.analysis.resolution import axial_resolution, lateral_resolution
from recon.arrays import Array, BoolArray, Float64Array
from recon.camera.camera_model import ModelName
from recon.camera.depth_mixture import central_psfs
from recon.errors import InputError
from recon.evaluation.scene import SceneSpec, TestScene, make_scene
from recon.evaluation.trial import Setting
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solvers import SOLVERS
from recon.verdict.cases import OF_VOLUMES
from recon.verdict.evidence import SMOOTH_PX
from recon.verdict.map import (
    WORST,
    Failure,
    Severities,
    Size,
    Trial,
    bounded,
    convergence_severity,
    relative_error,
    resolution_severity,
    trivial_error,
)

Chosen = BoolArray

PIXELS: Mapping[Size, int] = {"quick": 48, "full": 64}
LEAST_RESOLVED_PX = 2.0
"""No grid of pixels tells neighbours apart that are nearer: there must be a darker pixel between them."""
LOST_SHARE = 0.1
REACH_PX = 1.5
APART_PX = 5.0
"""Nearer points need not be told apart to be found, where enough others are on their own."""
ENOUGH = round(1 / LOST_SHARE)
"""With fewer points a single one that is lost exceeds the share. Half of all are enough, too: a scene of few
points has no others."""
PEAK_SHARE = 0.25
"""A peak counts from this share of the median height at the true points."""
ITERATIONS = {"quick": 150, "full": 200}
LEFT_OUT, SUBTRACTED = ", left out", ", subtracted"
"""Behind a method's name: that saturated pixels are left out, that the true background is subtracted."""


@dataclass(frozen=True)
class Options:
    """What the reconstruction is told besides the method."""

    model: ModelName | None = None
    """Default: local convolution where there are several PSFs a depth, one convolution where there is one. A
    map shows what one model does, so it leaves no choice to ``"auto"`` unless it says so."""
    leave_out_saturated: bool = False
    subtract_background: bool = True
    """Give the true background, as a user who photographed it would."""
    estimate_background: bool | None = False
    """Of a volume; None as the model says."""


@lru_cache(maxsize=4)
def scene_of(spec: SceneSpec) -> TestScene:
    """Render a scene; the methods of a cell share it."""
    return make_scene(spec)


def run_scene(spec: SceneSpec, method: str, options: Options, size: Size) -> Trial:
    """Photograph, reconstruct, judge; a method's name may end in what is done with the data before."""
    scene = scene_of(spec)
    if method.endswith(LEFT_OUT):
        method, options = method.removesuffix(LEFT_OUT), replace(options, leave_out_saturated=True)
    if method.endswith(SUBTRACTED):
        method, options = method.removesuffix(SUBTRACTED), replace(options, subtract_background=True)
    try:
        result = solve(scene, method, options, ITERATIONS[size])
    except InputError:
        # Stressed so much that the input is refused (an image without light): that is a failure, too.
        return Trial(1.0, {Failure.TRIVIAL: WORST})
    return judge(scene, result)


def of_another_colour(base: SceneSpec, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    """Run a scene in light that the diffuser deflects by ``x`` percent more, ``y`` electrons at its peak."""
    name, _, optics = method.partition(", ")
    spec = spec_at(replace(base, optics=optics.split()[0]), size, seed, photons=y)  # type: ignore[arg-type]
    scene = scene_of(spec)
    rng = np.random.default_rng([seed, 5])
    camera = replace(scene.camera, dispersion=x / 100)
    light = camera.light(scene.points, 2)
    counts = rng.poisson(light * (y / float(light.max()))) + rng.normal(0, spec.read_noise_e, light.shape)
    other = replace(scene, measurement=counts.astype(np.float32), camera=camera)
    return judge(other, solve(other, name, Options(), None))


def solve(scene: TestScene, method: str, options: Options, iterations: int | None) -> Reconstruction:
    """Reconstruct a scene as a user would."""
    erasures = scene.erasures
    if options.leave_out_saturated:
        clipped = scene.measurement >= float(scene.measurement.max())
        erasures = clipped if erasures is None else erasures | clipped
    background = scene.background if options.subtract_background and scene.background.any() else None
    varies = len(scene.calibration.psfs) > len(scene.z_um)
    setting = Setting.named(method, options.model or ("local" if varies else "convolution"))
    measurement = Measurement(scene.measurement, background=background, erasures=erasures)
    asked = setting.options(iterations=iterations)
    if options.model is None and varies:
        problem = Problem.of(measurement, scene.calibration, asked)
        if setting.refusal(problem) is not None:  # it is for one PSF
            asked = replace(asked, model="convolution")
    background_too = options.estimate_background if method.endswith(OF_VOLUMES) else None
    return reconstruct(measurement, scene.calibration, replace(asked, estimate_background=background_too))


def judge(scene: TestScene, result: Reconstruction) -> Trial:
    """Judge a reconstruction against the truth."""
    found = result.volume
    truth = scene.truth.reshape(found.shape)
    error, severities = judge_image(scene, np.asarray(found), truth)
    evidence = {} if result.verdict is None else result.verdict.evidence
    return Trial(error, {**severities, Failure.CONVERGENCE: _convergence(result)}, evidence)


def _convergence(result: Reconstruction) -> float:
    offered, plain = SOLVERS[result.solver], result.is_picture and result.model == "convolution"
    tolerance = offered.tolerance if isinstance(offered.tolerance, float) else 2e-3 if plain else 1e-3
    return max(
        convergence_severity(h, r, tolerance)
        for h, r in zip(result.histories, result.stop_reasons, strict=True)
    )


def judge_image(scene: TestScene, found: Array, truth: Array) -> tuple[float, Severities]:
    """Return error and severities of a picture or volume (n_z, height, width)."""
    from scipy.ndimage import gaussian_filter

    psf = central_psfs(scene.calibration)[1].mean(axis=1)
    resolved_px = lateral_resolution(psf[len(psf) // 2]).mean_px
    # What lies within the optics' own spot cannot be asked for.
    blur = (0.7 if len(found) > 1 else 0.0, 0.5 * resolved_px, 0.5 * resolved_px)
    seen, wanted, back = (
        gaussian_filter(np.asarray(v, np.float64), blur) for v in (found, truth, back_projection(scene, psf))
    )
    error = relative_error(seen, wanted) if found.any() else 1.0
    severities = {Failure.TRIVIAL: error / max(trivial_error(back, wanted), 1e-6)}
    nominal_px = max(resolved_px, LEAST_RESOLVED_PX)
    if scene.spec.family == "beads":
        places, reach = _places(scene, len(found)), _depth_reach(scene, psf)
        spots = spot_severity(found, truth, places, resolved_px=nominal_px, reach_planes=reach)
        severities[Failure.SPOTS] = bounded(spots)
    elif len(found) == 1:
        severities[Failure.RESOLUTION] = resolution_severity(seen[0], wanted[0], nominal_px)
    return error, severities


def back_projection(scene: TestScene, psf: Array) -> Array:
    """Return ``A^H b``, (n_z, height, width): the measurement correlated with each depth's PSF."""
    from scipy.signal import fftconvolve

    data = scene.measurement - scene.background
    if scene.erasures is not None:
        data = np.where(scene.erasures, 0, data)
    height, width = data.shape
    top, left = height - 1 - height // 2, width - 1 - width // 2
    full = [fftconvolve(data, p[::-1, ::-1]) for p in psf]
    return np.stack([f[top : top + height, left : left + width] for f in full])


def _depth_reach(scene: TestScene, psf: Array) -> float:
    """Return the axial resolution in planes, at least the lateral reach."""
    if len(psf) < 2:
        return REACH_PX
    middle = len(psf) // 2
    step = axial_resolution(
        psf[middle], float(scene.z_um[middle]), scene.camera.distance_um, RESOLUTION_LEVEL
    ).step_per_um
    spacing = float(np.abs(np.diff(1 / scene.z_um)).mean())
    return max(REACH_PX, step / spacing) if np.isfinite(step) else REACH_PX


def _places(scene: TestScene, n_z: int) -> Float64Array:
    """Plane, row and column of every point."""
    camera, points = scene.camera, scene.points
    inverse = 1 / scene.z_um
    plane = (
        np.interp(-1 / points[:, 2], -inverse, np.arange(n_z, dtype=float))
        if n_z > 1
        else np.zeros(len(points))
    )
    to_pixels = -camera.distance_um / points[:, 2] / camera.pitch_um
    height, width = camera.shape
    return np.stack(
        [plane, points[:, 1] * to_pixels + height // 2, points[:, 0] * to_pixels + width // 2], axis=1
    )


def spec_at(base: SceneSpec, size: Size, seed: int, **changes: Any) -> SceneSpec:
    """Return a map's scene at a size, with another seed and some numbers changed."""
    return replace(base, size=PIXELS[size], seed=base.seed + 1000 + seed, **changes)


# Points lost or made up -----------------------------------------------------------------------------
def spot_severity(
    found: Array,
    truth: Array,
    places: Float64Array,
    *,
    resolved_px: float,
    reach_planes: float = REACH_PX,
) -> float:
    """Return the larger share of points lost and of peaks made up, over :data:`LOST_SHARE`; not bounded.

    Parameters
    ----------
    found, truth : ndarray, (n_z, height, width)
        The truth on the same grid is looked at where points are crowded.
    places : ndarray, (n, 3)
        True points: plane, row, column. Those off the grid do not count.
    resolved_px : float
        Nominal resolution across, pixels.
    reach_planes : float
        Planes by which a peak may be off: the axial resolution, where that is more than the lateral reach.

    Returns
    -------
    float
        0 also where no point can be asked for.
    """
    # In depth as across: a reach is a reach.
    scale = np.array([REACH_PX / reach_planes, 1.0, 1.0])
    inside = ((places > -0.5) & (places < np.array(found.shape) - 0.5)).all(axis=1)
    peaks, heights = _peaks(found)
    if not len(peaks):
        return 1 / LOST_SHARE
    alone = inside & _apart(places, APART_PX, np.inf)
    if alone.sum() >= min(ENOUGH, inside.sum() / 2):
        return _wrong(peaks * scale, heights, places * scale, alone) if alone.any() else 0.0
    asked = inside & _apart(places, resolved_px, reach_planes)
    at, height = _peaks(truth)
    nearest = _highest_within_reach(at * scale, height, places * scale)
    asked &= (nearest > 0) & (nearest >= _least(nearest, asked))
    if not asked.any():
        return 0.0
    field = _field(places[inside])
    nominal = np.array([resolved_px / reach_planes, 1.0, 1.0])
    clear = _distance(field * nominal, places * nominal) > resolved_px
    return _wrong(peaks * scale, heights, places * scale, asked, (field * scale, clear))


def _wrong(
    peaks: Float64Array,
    heights: Float64Array,
    places: Float64Array,
    asked: Chosen,
    crowded: tuple[Float64Array, Chosen] | None = None,
) -> float:
    """Return the severity of points on their own, or of ``crowded`` ones less what chance would give.

    Those come with all places, and which among them could have been asked for a point.
    """
    nearest = _highest_within_reach(peaks, heights, places)
    least = _least(nearest, asked)
    high = peaks[heights >= least]
    if least <= 0 or not len(high):
        return 1 / LOST_SHARE
    lost = float(np.mean(nearest[asked] < least))
    away = _distance(high, places)
    if crowded is None:
        return max(lost, float(np.mean(away > 2 * REACH_PX))) / LOST_SHARE
    field, clear = crowded
    by_chance = float(np.mean(_distance(field[clear] if clear.any() else field, high) <= REACH_PX))
    empty = float(np.mean(_distance(field, places) > REACH_PX))
    made_up = float(np.mean(away > REACH_PX))
    # Where peaks are everywhere it proves nothing that points have one.
    lost = lost / (1 - by_chance) if by_chance < 1 else 1.0
    return max(lost, made_up / empty if empty > 0 else 0.0) / LOST_SHARE


def _peaks(image: Array) -> tuple[Float64Array, Float64Array]:
    """Return places (n, 3) and heights of the local maxima."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    smooth = gaussian_filter(np.asarray(image, np.float64), SMOOTH_PX)
    at = np.argwhere((smooth == maximum_filter(smooth, 3)) & (smooth > 0))
    return at.astype(np.float64), smooth[tuple(at.T)]


def _highest_within_reach(peaks: Float64Array, heights: Float64Array, places: Float64Array) -> Float64Array:
    """Return the height of every place's highest peak within reach; 0 for none."""
    distance = np.abs(places[:, None, :] - peaks[None]).max(axis=2)
    return np.asarray(np.where(distance <= REACH_PX, heights[None], 0).max(axis=1))


def _least(nearest: Float64Array, asked: Chosen) -> float:
    """Return the height from which a peak counts; 0 where most points have none."""
    return PEAK_SHARE * float(np.median(nearest[asked])) if asked.any() else 0.0


def _distance(places: Float64Array, others: Float64Array) -> Float64Array:
    """Return the distance of every place from the nearest of the others, the largest along any axis."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(others).query(places, p=np.inf)
    return np.asarray(distance)


def _field(places: Float64Array) -> Float64Array:
    """Return the voxels, (n, 3), of the box that holds all points."""
    low, high = np.floor(places.min(axis=0)), np.ceil(places.max(axis=0))
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _apart(places: Float64Array, across_px: float, planes: float) -> Chosen:
    """Points without another one nearer than both distances."""
    if len(places) < 2:
        return np.ones(len(places), bool)
    between = np.abs(places[:, None] - places[None])
    across = between[..., 1:].max(axis=2)
    np.fill_diagonal(across, np.inf)
    return np.asarray(~((across <= across_px) & (between[..., 0] <= planes)).any(axis=1))
