"""Trials of one scene: rendered, photographed under stress, reconstructed and judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.resolution import axial_resolution, lateral_resolution
from recon.camera.camera_model import ModelName
from recon.errors import InputError
from recon.evaluation.scene import SceneSpec, TestScene, make_scene
from recon.evaluation.stability_spots import REACH_PX, spot_severity
from recon.evaluation.trial import VOLUME, Setting
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solvers import SOLVERS
from recon.verdict.failure import (
    WORST,
    Failure,
    Severities,
    bounded,
    convergence_severity,
    relative_error,
    resolution_severity,
    trivial_error,
)
from recon.verdict.map import Size, Trial

Image = npt.NDArray[Any]

PIXELS: Mapping[Size, int] = {"quick": 48, "full": 64}
LEVEL = 0.7
"""Autocorrelation taken for resolved (Kuo 2020, sec. 3.2)."""
LEAST_RESOLVED_PX = 2.0
"""No grid of pixels tells neighbours apart that are nearer: there must be a darker pixel between them."""
ITERATIONS = {"quick": 150, "full": 200}


@dataclass(frozen=True)
class Options:
    """What the reconstruction is told besides the method.

    Attributes
    ----------
    model : str, optional
        Default: local convolution where there are several PSFs a depth, one convolution where there is one. A
        map shows what one model does, so it leaves no choice to ``"auto"`` unless it says so.
    leave_out_saturated : bool
    subtract_background : bool
        Give the true background, as a user who photographed it would.
    estimate_background : bool or None
        Of a volume; None as the model says.
    """

    model: ModelName | None = None
    leave_out_saturated: bool = False
    subtract_background: bool = True
    estimate_background: bool | None = False


@lru_cache(maxsize=4)
def scene_of(spec: SceneSpec) -> TestScene:
    """Render a scene; the methods of a cell share it."""
    return make_scene(spec)


def run_scene(spec: SceneSpec, method: str, options: Options, size: Size) -> Trial:
    """Photograph, reconstruct, judge."""
    scene = scene_of(spec)
    try:
        result = solve(scene, method, options, ITERATIONS[size])
    except InputError:
        # Stressed so much that the input is refused (an image without light): that is a failure, too.
        return Trial(1.0, {Failure.TRIVIAL: WORST})
    return judge(scene, result)


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
    background_too = options.estimate_background if method.startswith(VOLUME) else None
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


def judge_image(scene: TestScene, found: Image, truth: Image) -> tuple[float, Severities]:
    """Return error and severities of a picture or volume (n_z, height, width)."""
    from scipy.ndimage import gaussian_filter

    psf = central_psfs(scene)
    resolved_px = lateral_resolution(psf[len(psf) // 2], LEVEL).mean_px
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


def central_psfs(scene: TestScene) -> Image:
    """Return the PSF nearest to the axis at each depth, the nearest depth first, (n_z, height, width)."""
    positions = scene.calibration.source_positions_um
    planes = []
    for z in scene.z_um:
        members = np.flatnonzero(positions[:, 2] == z)
        nearest = members[np.argmin(np.hypot(*positions[members, :2].T))]
        planes.append(scene.calibration.psfs[nearest].mean(axis=0))
    return np.stack(planes)


def back_projection(scene: TestScene, psf: Image) -> Image:
    """Return ``A^H b``, (n_z, height, width): the measurement correlated with each depth's PSF."""
    from scipy.signal import fftconvolve

    data = scene.measurement - scene.background
    if scene.erasures is not None:
        data = np.where(scene.erasures, 0, data)
    height, width = data.shape
    top, left = height - 1 - height // 2, width - 1 - width // 2
    full = [fftconvolve(data, p[::-1, ::-1]) for p in psf]
    return np.stack([f[top : top + height, left : left + width] for f in full])


def _depth_reach(scene: TestScene, psf: Image) -> float:
    """Return the axial resolution in planes, at least the lateral reach."""
    if len(psf) < 2:
        return REACH_PX
    middle = len(psf) // 2
    step = axial_resolution(
        psf[middle], float(scene.z_um[middle]), scene.camera.distance_um, LEVEL
    ).step_per_um
    spacing = float(np.abs(np.diff(1 / scene.z_um)).mean())
    return max(REACH_PX, step / spacing) if np.isfinite(step) else REACH_PX


def _places(scene: TestScene, n_z: int) -> npt.NDArray[np.float64]:
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
