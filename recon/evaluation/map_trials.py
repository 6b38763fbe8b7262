"""Trials of maps that are not one scene's: solvers by themselves, points, videos, holograms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from recon.analysis.gram import WindowProblem, condition_number
from recon.analysis.point_noise import Noise
from recon.analysis.points import DIP, PointGrid, try_points
from recon.arrays import Array, Float32Array
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.evaluation.lenslets import LensletCamera, build_camera
from recon.evaluation.scene import SceneSpec, TestScene, shared
from recon.evaluation.scene_trial import PIXELS, judge_image, scene_of, spec_at
from recon.holography import Display, Target, random_mask
from recon.holography.pose import PlacedHologram, Pose
from recon.priors import L1, NonNegativity, TotalVariation
from recon.priors.base import Prior
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers import StoppingRules
from recon.solvers.admm import Admm, Penalties
from recon.solvers.base import Outcome, Solver
from recon.solvers.douglas_rachford import DouglasRachford
from recon.solvers.fista import Fista
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.splitting import Tuning
from recon.solvers.tv_admm_volume import volume_solver
from recon.streams.joint import OverTimeName, solve_together
from recon.streams.video import stream_problem
from recon.verdict.cases import OF_VOLUMES
from recon.verdict.map import (
    PRECISION,
    PSNR_DB,
    Failure,
    Size,
    Trial,
    bounded,
    convergence_severity,
    relative_error,
)

# Solvers by themselves --------------------------------------------------------------------------------
STEPS = 100
TOLERANCE = 2e-3
VOLUME_DEPTHS = 4


@lru_cache(maxsize=2)
def _part(pixels: int, seed: int) -> Part:
    return _part_of(scene_of(SceneSpec("sparse-picture", size=pixels, seed=1000 + seed, photons=1000.0)))


def _part_of(scene: TestScene) -> Part:
    options = ReconstructionOptions(model="convolution")
    return Part(Problem.of(scene.measurement, scene.calibration, options), slice(0, 1))


def precision(method: str, x: float, y: float, seed: int, _size: Size) -> Trial:
    """Compare both precisions after ``x`` iterations of a picture of ``y`` pixels."""
    part = _part(int(y), seed)
    psf = part.problem.depths.central[0]
    solutions = []
    for dtype in (np.float32, np.float64):
        camera = Convolution(psf / np.linalg.norm(psf), part.problem.sensor_shape, dtype=dtype)
        prior = TotalVariation(1.0) + NonNegativity()
        rules = StoppingRules(iterations=int(x), tolerance=0)
        solver = (Admm if method == "admm tv" else Fista)(camera, part.data.astype(dtype), prior)
        solutions.append(solver.run(rules).solution.astype(np.float64))
    norm = float(np.linalg.norm(solutions[1]))
    difference = float(np.linalg.norm(solutions[0] - solutions[1])) / max(norm, 1e-30)
    return Trial(difference, {Failure.PRECISION: bounded(difference / PRECISION)})


def penalties(base: SceneSpec, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    """Solve with ``x`` times the penalty or step, and ``y`` times the prior's weight."""
    if method.endswith(OF_VOLUMES):
        return _volume_penalties(method, x, y, seed, size)
    scene = scene_of(spec_at(base, size, seed, photons=1000.0))
    part = _part_of(scene)
    with np.errstate(over="ignore", invalid="ignore"):  # too long a step diverges: that is what is asked
        solver = _picture_solver(method, part, x, TotalVariation(y) + NonNegativity())
        outcome = solver.run(StoppingRules(iterations=STEPS, tolerance=TOLERANCE))
    found = part.problem.measured(part.lifted(outcome.solution), part.channels)
    return _settled(scene, found, outcome, TOLERANCE)


def _settled(scene: TestScene, found: Array, outcome: Outcome, tolerance: float) -> Trial:
    """Judge a volume (n_z, height, width), and whether its solver had settled."""
    error, severities = judge_image(scene, found, scene.truth.reshape(found.shape))
    settled = convergence_severity(outcome.history, outcome.stop_reason, tolerance)
    return Trial(error, {**severities, Failure.CONVERGENCE: settled})


class _OffBalance(SensorAdmm):
    """ADMM on the sensor whose penalties are a factor off those that it guesses and balances by itself."""

    def __init__(self, operator: LinearOperator, data: Array, prior: Prior, factor: float) -> None:
        self._factor = factor  # asked for while the solver is being built
        super().__init__(operator, data, prior)

    def _first_penalties(self) -> Array:
        return super()._first_penalties() * self._factor

    def _balanced_penalties(self) -> Array:
        return super()._balanced_penalties() * self._factor


def _picture_solver(method: str, part: Part, factor: float, prior: Prior) -> Solver:
    """Return a solver whose penalty or step is so many times its default."""
    operator = part.picture_operator
    if method == "fista tv":
        return Fista(operator, part.data, prior, step=factor / operator.norm_bound**2)
    if method == "admm-sensor tv":
        return _OffBalance(operator, part.data, prior, factor)
    default = Penalties()
    penalties = Penalties(data=default.data * factor, separable=default.separable * factor)
    return Admm(operator, part.data, prior, penalties=penalties)


def _volume_penalties(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    scene = scene_of(spec_at(SceneSpec("beads", depths=VOLUME_DEPTHS, photons=1000.0), size, seed))
    psfs = scene.calibration.psfs
    energy = float(np.sqrt(np.mean(np.sum(psfs.astype(np.float64) ** 2, axis=(2, 3)))))
    noise = float(np.sqrt(np.mean(np.maximum(scene.measurement, 0)) + scene.spec.read_noise_e**2))
    data = (scene.measurement / noise).astype(np.float32)[None]
    camera = Convolution(psfs / np.float32(energy), data.shape[1:])
    prior: Prior = L1(1.5 * y) + NonNegativity()
    if method.startswith("admm tv"):
        prior = TotalVariation.of_volume(y) + NonNegativity()
    default = volume_solver(camera, data, prior)
    first = default.gamma if isinstance(default, DouglasRachford) else default.penalty
    solver = volume_solver(camera, data, prior, tuning=Tuning(first=x * first))
    outcome = solver.run(StoppingRules(iterations=STEPS, tolerance=1e-3))
    height, width = data.shape[1:]
    top, left = camera.centre[0] - height // 2, camera.centre[1] - width // 2
    found = outcome.solution[0][:, top : top + height, left : left + width]
    return _settled(scene, found, outcome, 1e-3)


# Points -----------------------------------------------------------------------------------------------
CAMERA_PX = 96
CAMERA_DEPTH = 6.0
"""Depth of the points relative to the distance from diffuser to sensor."""


@lru_cache(maxsize=2)
def _camera(seed: int) -> LensletCamera:
    return build_camera(CAMERA_PX, optics="smooth", seed=seed, focus=CAMERA_DEPTH)


def point_image(camera: LensletCamera, columns: float) -> Float32Array:
    """Return the image of a point ``columns`` pixels from the axis at the tests' depth."""
    z_um = CAMERA_DEPTH * camera.distance_um
    return camera.light([[-columns * camera.pitch_um * z_um / camera.distance_um, 0.0, z_um, 1.0]])


def neighbours(_method: str, x: float, y: float, seed: int, _size: Size) -> Trial:
    """Look for ``y`` points in a row, ``x`` pixels apart."""
    camera, count = _camera(seed), int(y)
    problem = WindowProblem(point_image(camera, 0.0)[None], (2, 3 + int(np.ceil(count * x / 2)) + 2))
    trial = try_points(
        problem,
        lambda columns, _s: point_image(camera, columns),
        PointGrid(count, separation_px=x),
        Noise(10_000.0, 2.0),
        seed=seed,
        trials=2,
    )
    return Trial(local_condition(camera, count, x), {Failure.DIP: bounded(DIP / max(trial.dip, 1e-3))})


def local_condition(camera: LensletCamera, count: int, separation_px: float) -> float:
    """Return the condition number of points in a row at any separation (Kuo 2020, Fig. 4.5)."""
    places = (np.arange(count) - (count - 1) / 2) * separation_px
    images = np.stack([point_image(camera, float(p)).ravel() for p in places]).astype(np.float64)
    return condition_number(images @ images.T)


# Priors over time -------------------------------------------------------------------------------------
OVER_TIME: dict[str, OverTimeName] = {"temporal tv": "tv", "low rank + sparse": "lowrank"}
FRAMES: dict[Size, int] = {"quick": 8, "full": 16}
VIDEO_ITERATIONS: dict[Size, int] = {"quick": 30, "full": 60}
POINTS = 14
READ_NOISE_E = 2.0
FLASH = 1.0
"""What a flash adds, relative to a point's light at rest."""
SHARE_ACTIVE = 0.1
"""Share of points that flash in a frame where motion is the stress."""
FLASHES = f"{POINTS} points, {FRAMES['full']} frames, flashes of {FLASH} in {SHARE_ACTIVE}"


@dataclass(frozen=True)
class Video:
    """Frames of points that drift and flash."""

    psf: Array
    """(height, width)."""
    frames: Array
    """float32, (n_frames, height, width): photo-electrons."""
    truth: Array
    """(n_frames, height, width): the points' light, blurred by one pixel."""


@lru_cache(maxsize=2)
def video_of(pixels: int, n_frames: int, motion_px: float, active: float, photons: float, seed: int) -> Video:
    """Cast a video, point by point at continuous places: no grid, no convolution."""
    rng = np.random.default_rng([seed, 12])
    camera = build_camera(pixels, seed=1 + seed)
    places = rng.uniform(-0.35, 0.35, (POINTS, 2)) * pixels
    flashes = rng.random((POINTS, n_frames)) < active
    light = rng.uniform(0.5, 1.5, (POINTS, 1)) * (1 + FLASH * flashes)
    way = motion_px * (np.arange(n_frames) - (n_frames - 1) / 2)
    seen = [places + np.array([0.0, w]) for w in way]
    clean = np.stack([_cast(camera, at, light[:, t]) for t, at in enumerate(seen)])
    counts = rng.poisson(clean * (photons / clean.max())) + rng.normal(0, READ_NOISE_E, clean.shape)
    truth = np.stack([_picture(pixels, at, light[:, t]) for t, at in enumerate(seen)])
    return Video(_cast(camera, np.zeros((1, 2)), np.ones(1)), counts.astype(np.float32), truth)


def _cast(camera: LensletCamera, places: Array, light: Array) -> Array:
    scale = camera.pitch_um * camera.focus_um / camera.distance_um
    depth = np.full(len(places), camera.focus_um)
    return camera.light(np.column_stack([-places[:, 1] * scale, -places[:, 0] * scale, depth, light]))


def _picture(pixels: int, places: Array, light: Array) -> Array:
    """Return points as a picture, each shared by its four nearest pixels, blurred by one pixel."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(shared((pixels, pixels), places + pixels // 2, light), 1.0))


@lru_cache(maxsize=2)
def _alone(key: tuple[int, int, float, float, float, int], iterations: int) -> float:
    """Return the error of frames that know nothing of one another, by the same solver."""
    return _error(video_of(*key), "tv", 0.0, iterations)


def _error(video: Video, name: OverTimeName, weight: float, iterations: int) -> float:
    from scipy.ndimage import gaussian_filter

    problem = stream_problem(video.frames[0], video.psf, choosing=False)
    pictures = solve_together(problem, video.frames, name, weight=weight, iterations=iterations)
    assert pictures is not None  # nothing ends it before
    return relative_error(gaussian_filter(pictures, (0, 1, 1)), video.truth)


def over_time(what: str, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    """Solve a video with a prior over time: ``x`` of its motion or activity, ``y`` electrons."""
    motion_px, active = (x, SHARE_ACTIVE) if what == "motion" else (0.0, x)
    key = (PIXELS[size], FRAMES[size], motion_px, active, y, seed)
    ratio = _error(video_of(*key), OVER_TIME[method], 1.0, VIDEO_ITERATIONS[size]) / _alone(
        key, VIDEO_ITERATIONS[size]
    )
    return Trial(100 * (ratio - 1), {Failure.ALONE: bounded(ratio)})


# Holograms --------------------------------------------------------------------------------------------
SLM = (48, 64)
HOLOGRAM_ITERATIONS = {"quick": 30, "full": 60}
HOLOGRAMS = {"4 mask pixels an SLM pixel": 2, "16 mask pixels an SLM pixel": 4}


@lru_cache(maxsize=4)
def _hologram(factor: int, seed: int, iterations: int) -> PlacedHologram:
    shape = (SLM[0] * factor, SLM[1] * factor)
    display = Display(SLM, random_mask(shape, seed=3 + seed), mask_fill=1.0, focal_mm=35.0)
    y, x = np.mgrid[:96, :96]
    disc = (y - 40) ** 2 + (x - 52) ** 2 < 500
    bars = (abs(y - 76) < 8) & (x // 6 % 2 == 0)
    target = Target(np.where(disc, 1.0, np.where(bars, 0.8, 0.3)), white=1.0)
    return PlacedHologram(display, target, Pose(), iterations=iterations)


def misplaced(kind: str, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    """Look at a hologram through a mask that was moved, or that is out of focus and distorted."""
    factor = HOLOGRAMS[method]
    hologram = _hologram(factor, seed, HOLOGRAM_ITERATIONS[size])
    half = 0.5 * SLM[1] * factor
    pose = Pose(shift_x=x, roll_mrad=1e3 * y / half) if kind == "moved" else Pose(z_um=x, cubic=y)
    psnr_db = hologram.psnr_db(pose)
    return Trial(psnr_db, {Failure.PICTURE: bounded(10 ** ((PSNR_DB - psnr_db) / 20))})
