"""One way to reconstruct, and which ways there are for a problem: charts and maps try them.

Solvers and priors are asked, not listed: what is registered takes part where its solver accepts the problem
(:data:`recon.reconstruction.solvers.SOLVERS`, :data:`recon.priors.PRIORS`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any

from recon.base.namespace import Device, array_namespace
from recon.camera.camera_model import CAMERAS, MODELS, ModelName, members_of_depths
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.priors import PRIORS
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.overrides import PRECISIONS, Precision
from recon.reconstruction.problem import Problem
from recon.reconstruction.solvers import SOLVERS

if TYPE_CHECKING:
    from recon.evaluation.chart_reconstruction import ChartProblem

VOLUME = "volume"
"""How maps of volumes call the solver of volumes, the first of the registered ones."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to reconstruct.

    Attributes
    ----------
    solver : str
        A name of :data:`recon.reconstruction.solvers.SOLVERS`.
    model, prior : str
    binning : int
    background : bool
        Whether a smooth one is estimated as well.
    precision : str
        Of the arithmetic.
    device : str
    """

    solver: str
    model: ModelName
    prior: str
    binning: int = 1
    background: bool = False
    precision: Precision = "float32"
    device: Device = "cpu"

    @classmethod
    def named(cls, method: str, model: ModelName = "convolution") -> Setting:
        """Return what a map's method is: a solver and a prior, "admm tv", or a solver alone.

        Raises
        ------
        InputError
            When there is no such solver or prior.
        """
        solver, _, prior = method.partition(" ")
        offered = SOLVERS.named(next(iter(SOLVERS)) if solver == VOLUME else solver)
        return cls(offered.name, model, PRIORS.named(prior or offered.prior).name)

    @property
    def name(self) -> str:
        """Say it briefly."""
        parts = [self.solver, self.model, self.prior]
        if self.background:
            parts.append("background")
        if self.binning > 1:
            parts.append(f"bin {self.binning}")
        if self.precision != "float32":
            parts.append(self.precision)
        if self.device != "cpu":
            parts.append(self.device)
        return " ".join(parts)

    @property
    def family(self) -> str:
        """Solver and model."""
        return f"{self.solver} {self.model}"

    @property
    def is_plain(self) -> bool:
        """Whether it has one PSF a depth and estimates no background."""
        return self.model == "convolution" and not self.background

    @property
    def one_step(self) -> bool:
        """Whether its solver has no iterations."""
        return SOLVERS.named(self.solver).one_step

    def options(self, *, iterations: int | None = None, **more: Any) -> ReconstructionOptions:
        """Return the options that reconstruct so; limits do not apply to a solver without iterations."""
        if self.one_step:
            more |= {"time_s": None, "tolerance": None}
        return ReconstructionOptions(
            solver=self.solver,
            model=self.model,
            prior=self.prior,
            device=self.device,
            precision=self.precision,
            estimate_background=self.background,
            iterations=None if self.one_step else iterations,
            **more,
        )

    def refusal(self, problem: Problem) -> str | None:
        """Say why its solver does not take a problem (of any model and options); None: it does."""
        asked = replace(problem, options=self.options(), model=self.model, smooth=self.background)
        return SOLVERS.named(self.solver).accepts(asked)

    def cost(self, *, volume: bool) -> float:
        """Rough order of time, and of how much there is to learn."""
        slow = {"convolution": 1.0, "lowrank": 20.0, "local": 30.0}.get(self.model, 30.0)
        # What differs from the usual way by little comes after what differs by much.
        usual = self.prior in ("tv", "l1") or self.one_step
        rank = (1 if usual else 4) * (1 if self.precision == "float32" else 8)
        more = 3.0 if volume or not self.is_plain else 1.0 if self.device == "cpu" else 2.0
        return slow * more * SOLVERS.named(self.solver).cost / self.binning**2 * rank


def settings_for(problem: ChartProblem) -> tuple[Setting, ...]:
    """Return every applicable setting, the quick ones first.

    Which are not applicable, and why: :func:`left_out`.
    """
    scaled = _problem(problem)
    found = [s for s in _all(problem) if s.refusal(scaled) is None]
    return tuple(sorted(found, key=lambda s: s.cost(volume=problem.volume)))


def left_out(problem: ChartProblem) -> tuple[str, ...]:
    """Say which settings are not applicable to a problem, and why."""
    scaled = _problem(problem)
    refused: dict[tuple[str, str], list[str]] = {}
    for solver, prior in product(SOLVERS, PRIORS):
        if (reason := Setting(solver, "convolution", prior).refusal(scaled)) is not None:
            refused.setdefault((solver, reason), []).append(prior)
    found = [
        solver + ("" if len(priors) == len(PRIORS) else " with " + ", ".join(priors)) + f": {reason}"
        for (solver, reason), priors in refused.items()
    ]
    if not _varies(problem):
        found.append("the local and low-rank models: the calibration has one PSF a depth")
    if binnings_of(problem) == [1]:
        small = problem.erasures is None
        found.append(
            f"binning: {'too few pixels would be left' if small else 'erased pixels cannot be averaged'}"
        )
    if not _has_gpu():
        found.append("the gpu: there is none that CuPy can use")
    return tuple(found)


def require_applicable(problem: ChartProblem, setting: Setting) -> None:
    """Raise InputError for a setting that does not apply: it would be run as another one, or not at all."""
    if setting not in _all(problem) or setting.refusal(_problem(problem)) is not None:
        raise InputError(f"The setting '{setting.name}' does not apply to this problem.")


def binnings_of(problem: ChartProblem) -> list[int]:
    """Return the binnings that leave enough pixels; erased ones cannot be averaged with others."""
    largest = max(problem.measurement.shape)
    return [1, *(b for b in (2, 4) if largest // b >= 24 and problem.erasures is None)]


def own_methods(*, volume: bool) -> tuple[str, ...]:
    """Return the methods, for pictures or volumes, that others' packages or this program have registered."""
    priors = [name for name in PRIORS if not PRIORS.is_own(name)]
    solvers = [name for name in SOLVERS if not SOLVERS.is_own(name)]
    if not priors and not solvers:
        return ()
    scene = make_scene("beads", size=16, depths=2) if volume else make_scene("sparse-picture", size=16)
    problem = Problem.of(
        scene.measurement, scene.calibration, ReconstructionOptions(model="convolution", judged=False)
    )
    found = [f"{name} {SOLVERS[name].prior}" for name in solvers]
    for prior in priors:
        ways = (f"{name} {prior}" for name in SOLVERS)
        found += [way for way in ways if Setting.named(way).refusal(problem) is None][:1]
    return tuple(method for method in found if Setting.named(method).refusal(problem) is None)


def _all(problem: ChartProblem) -> Iterator[Setting]:
    own = [m for m in MODELS if m != "auto" and (_varies(problem) or m == "convolution")]
    models: list[ModelName] = [*own, *CAMERAS]  # type: ignore[list-item]
    devices: list[Device] = ["cpu", "gpu"] if _has_gpu() else ["cpu"]
    for solver, model, prior, binning, background, precision, device in product(
        SOLVERS, models, PRIORS, binnings_of(problem), (False, True), PRECISIONS, devices
    ):
        yield Setting(solver, model, prior, binning, background, precision, device)


def _problem(problem: ChartProblem) -> Problem:
    """Return the problem that solvers are asked about."""
    calibration = problem.calibration
    if not problem.volume:
        first = members_of_depths(calibration.source_positions_um)[0][:1]
        calibration = replace(
            calibration,
            psfs=calibration.psfs[first],
            source_positions_um=calibration.source_positions_um[first],
        )
    measurement = Measurement(problem.measurement, erasures=problem.erasures, noise=problem.noise)
    return Problem.of(measurement, calibration, ReconstructionOptions(model="convolution"))


def _varies(problem: ChartProblem) -> bool:
    positions = problem.calibration.source_positions_um
    return len(positions) > len(members_of_depths(positions))


@cache
def _has_gpu() -> bool:
    try:
        array_namespace("gpu")
    except InputError:
        return False
    return True
