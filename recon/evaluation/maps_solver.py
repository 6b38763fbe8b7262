"""Maps of the solvers themselves: precision, and penalties and steps away from their defaults."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.evaluation.maps_light import PICTURE
from recon.evaluation.scene import SceneSpec, TestScene
from recon.evaluation.scene_trial import judge_image, scene_of, spec_at
from recon.priors import L1, NonNegativity, TotalVariation
from recon.priors.base import Prior
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers import StoppingRules
from recon.solvers.admm import Admm, Penalties
from recon.solvers.base import Outcome
from recon.solvers.douglas_rachford import DouglasRachford
from recon.solvers.fista import Fista
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.splitting import Tuning
from recon.solvers.tv_admm_volume import volume_solver
from recon.verdict.failure import PRECISION, Failure, bounded, convergence_severity
from recon.verdict.map import Axis, Size, StressMap, Trial

Array = npt.NDArray[Any]

ITERATIONS = Axis("iterations", "iterations", "", (30, 100, 300, 1000), (30, 100), logarithmic=True)
PIXELS = Axis("pixels", "size of the picture", "pixels", (32, 64, 128, 256), (32, 64), logarithmic=True)
PENALTY = Axis(
    "penalty", "penalty or step", "of the default", (0.1, 0.3, 1, 3, 10), (0.1, 1, 10), logarithmic=True
)
WEIGHT = Axis("weight", "weight of the prior", "of the default", (0.1, 0.3, 1, 3, 10), (0.1, 1, 10), True)

STEPS = 100
TOLERANCE = 2e-3
VOLUME_DEPTHS = 4


@lru_cache(maxsize=2)
def _part(pixels: int, seed: int) -> Part:
    return _part_of(scene_of(SceneSpec("sparse-picture", size=pixels, seed=1000 + seed, photons=1000.0)))


def _part_of(scene: TestScene) -> Part:
    options = ReconstructionOptions(model="convolution")
    return Part(Problem.of(scene.measurement, scene.calibration, options), slice(0, 1))


def _precision(method: str, x: float, y: float, seed: int, _size: Size) -> Trial:
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


def _penalties(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    if method.startswith("volume"):
        return _volume_penalties(method, x, y, seed, size)
    spec = spec_at(PICTURE, size, seed, photons=1000.0)
    scene = scene_of(spec)
    part = _part_of(scene)
    outcome = _PICTURE_SOLVERS[method](part, x, y)
    found = part.problem.measured(part.lifted(outcome.solution), part.channels)
    error, severities = judge_image(scene, found, scene.truth[None])
    settled = convergence_severity(outcome.history, outcome.stop_reason, TOLERANCE)
    return Trial(error, {**severities, Failure.CONVERGENCE: settled})


def _rules() -> StoppingRules:
    return StoppingRules(iterations=STEPS, tolerance=TOLERANCE)


def _admm(part: Part, penalty: float, weight: float) -> Outcome:
    prior = TotalVariation(weight) + NonNegativity()
    default = Penalties()
    penalties = Penalties(data=default.data * penalty, separable=default.separable * penalty)
    return Admm(part.picture_operator, part.data, prior, penalties=penalties).run(_rules())


def _fista(part: Part, step: float, weight: float) -> Outcome:
    prior = TotalVariation(weight) + NonNegativity()
    length = step / part.picture_operator.norm_bound**2
    with np.errstate(over="ignore", invalid="ignore"):  # too long a step diverges: that is what is asked
        return Fista(part.picture_operator, part.data, prior, step=length).run(_rules())


class _OffBalance(SensorAdmm):
    """ADMM on the sensor whose penalties are a factor off those that it guesses and balances by itself."""

    def __init__(self, operator: LinearOperator, data: Array, prior: Prior, factor: float) -> None:
        self._factor = factor  # asked for while the solver is being built
        super().__init__(operator, data, prior)

    def _first_penalties(self) -> Array:
        return super()._first_penalties() * self._factor

    def _balanced_penalties(self) -> Array:
        return super()._balanced_penalties() * self._factor


def _sensor_admm(part: Part, penalty: float, weight: float) -> Outcome:
    prior = TotalVariation(weight) + NonNegativity()
    return _OffBalance(part.picture_operator, part.data, prior, penalty).run(_rules())


_PICTURE_SOLVERS: dict[str, Callable[[Part, float, float], Outcome]] = {
    "admm tv": _admm,
    "admm-sensor tv": _sensor_admm,
    "fista tv": _fista,
}


def _volume_penalties(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    scene = scene_of(spec_at(SceneSpec("beads", depths=VOLUME_DEPTHS, photons=1000.0), size, seed))
    psfs = scene.calibration.psfs
    energy = float(np.sqrt(np.mean(np.sum(psfs.astype(np.float64) ** 2, axis=(2, 3)))))
    noise = float(np.sqrt(np.mean(np.maximum(scene.measurement, 0)) + scene.spec.read_noise_e**2))
    data = (scene.measurement / noise).astype(np.float32)[None]
    camera = Convolution(psfs / np.float32(energy), data.shape[1:])
    prior: Prior = L1(1.5 * y) + NonNegativity()
    if method == "volume tv":
        prior = TotalVariation.of_volume(y) + NonNegativity()
    default = volume_solver(camera, data, prior)
    first = default.gamma if isinstance(default, DouglasRachford) else default.penalty
    solver = volume_solver(camera, data, prior, tuning=Tuning(first=x * first))
    outcome = solver.run(StoppingRules(iterations=STEPS, tolerance=1e-3))
    height, width = data.shape[1:]
    top, left = camera.centre[0] - height // 2, camera.centre[1] - width // 2
    found = outcome.solution[0][:, top : top + height, left : left + width]
    error, severities = judge_image(scene, found, scene.truth)
    settled = convergence_severity(outcome.history, outcome.stop_reason, 1e-3)
    return Trial(error, {**severities, Failure.CONVERGENCE: settled})


MAPS = (
    StressMap(
        "precision",
        "float32 against float64: size and iterations",
        "Is single precision enough for large pictures and long runs?",
        ITERATIONS,
        PIXELS,
        ("admm tv", "fista tv"),
        _precision,
        error="difference",
    ),
    StressMap(
        "parameters",
        "Penalties and steps, and the prior's weight",
        "What happens when a solver's penalty or step, or the prior's weight, is wrong?"
        f" After {STEPS} iterations.",
        PENALTY,
        WEIGHT,
        ("admm tv", "admm-sensor tv", "fista tv", "volume tv", "volume l1"),
        _penalties,
    ),
)
