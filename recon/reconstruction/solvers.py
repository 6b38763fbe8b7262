"""The solvers on offer: what each takes, where it stops by itself, and how it is made for a problem's part.

Each answers for itself; terminal, window, chart, maps and model selection ask :data:`SOLVERS`. One of a
user's own is registered with ``SOLVERS.register``, or as an entry point of the group
``diffuserbench.solvers``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.arrays import Array
from recon.base.registry import Registry
from recon.camera.base import LinearOperator
from recon.camera.camera_model import CAMERAS
from recon.errors import InputError
from recon.priors import PRIORS, Prior, Sum
from recon.solvers.base import IterationRecord, Outcome, Solver, StoppingRules, StopReason

if TYPE_CHECKING:
    from recon.reconstruction.part import Part
    from recon.reconstruction.problem import Problem


@dataclass(frozen=True, kw_only=True)
class OfferedSolver:
    """A solver as it is registered.

    Attributes
    ----------
    name, help : str
    make : callable
        ``make(part, start)`` returns what solves a :class:`~recon.reconstruction.part.Part` from a start on
        its camera's domain, or from zero where that is None. Its solution has as many values as that domain.
    refuses : callable, optional
        ``refuses(problem)`` returns why it has no way for a problem, in a sentence; None where it has.
    tolerance : float or callable
        Change an iteration at which pictures were seen to have settled; a callable is given the problem.
    prior : str
        The prior that it takes where none is asked for.
    one_step : bool
        Whether it has no iterations: limits do not apply to it.
    cost : float
        Rough time that a picture takes, relative to the first solver's.
    flat : bool
        Whether it takes pictures through one PSF alone: its camera is of one plane.
    suits : callable
        ``suits(problem)`` tells whether it is to be preferred to those before it where it takes a problem.
    """

    name: str
    help: str
    make: Callable[[Part, Array | None], Solver]
    refuses: Callable[[Problem], str | None] = lambda _: None
    tolerance: float | Callable[[Problem], float] = 2e-3
    prior: str = "tv"
    one_step: bool = False
    cost: float = 1.5
    flat: bool = False
    suits: Callable[[Problem], bool] = lambda _: False

    def accepts(self, problem: Problem) -> str | None:
        """Say why it cannot solve a problem; None where it can."""
        return self.refuses(problem)

    def tolerance_for(self, problem: Problem) -> float:
        """Return the change an iteration at which it stops by itself."""
        return self.tolerance(problem) if callable(self.tolerance) else self.tolerance


def splitting_priors() -> tuple[str, ...]:
    """Return the priors by name that splittings have a way for: those whose prox is exact."""
    return tuple(name for name, prior in PRIORS.items() if prior.exact)


def volume_priors() -> tuple[str, ...]:
    """Return those of volumes, of PSFs that vary over the field, with a background, and on a GPU."""
    return tuple(name for name in splitting_priors() if not PRIORS[name].pictures_only)


MANY_PIXELS = 20_000
"""Pixels of a sensor from which ``admm-sensor`` is as good as ``admm`` in less time
(docs/benchmarks/weights.md): with fewer, what an iteration costs beside its pixels outweighs that it takes a
third of the iterations."""
_ONE_LIGHT = "it is for photographs in one light (fista takes patterns)"


def _plain_only(problem: Problem) -> str | None:
    if problem.patterned:
        return _ONE_LIGHT
    if problem.n_planes > 1:
        return "it is for one depth"
    if problem.varies:
        return f"it is for one convolution: for the {problem.model} model take admm"
    if problem.smooth:
        return "it estimates no background"
    return "it runs on the cpu only" if problem.options.device != "cpu" else None


def _by_name(problem: Problem, priors: Iterable[str], where: str = "") -> str | None:
    """Refuse a prior by name that is not among these, and any whose prox is inexact."""
    prior = problem.prior
    if not isinstance(prior, Prior):
        refused = f"{where} it takes the priors {', '.join(priors)}, not {prior!r}".strip()
        return None if prior in priors else refused
    inexact = [type(term).__name__ for term in prior.terms() if not term.exact]
    return f"the prox of {inexact[0]} is inexact: a splitting would settle elsewhere" if inexact else None


def _admm_refuses(problem: Problem) -> str | None:
    if problem.patterned:
        return _ONE_LIGHT
    if problem.options.device != "cpu" and problem.model in CAMERAS:
        return f"The model {problem.model} runs on the cpu only"
    if problem.together:
        return _by_name(problem, splitting_priors())
    return _by_name(problem, volume_priors(), "for volumes, varying PSFs, backgrounds and a GPU")


def _admm(part: Part, start: Array | None) -> Solver:
    from recon.camera.convolution import Convolution
    from recon.solvers.admm import Admm
    from recon.solvers.splitting import Room, Tuning
    from recon.solvers.tv_admm_volume import volume_solver

    problem, camera = part.problem, part.camera
    if problem.together:
        return Admm(part.picture_operator, part.data, part.prior, initial=_of_picture(start))
    if not isinstance(camera, Convolution):
        return _varying_admm(part, camera, start)
    prior = part.prior_on(problem.axis_weights, (False, True, True))
    tuning = Tuning(drop_empty=problem.options.drop_empty)
    room = Room(part.namespace, part.storage, keep_state=False)
    return volume_solver(camera, part.sensor_data, prior, initial=start, tuning=tuning, room=room)


def _of_picture(start: Array | None) -> Array | None:
    return None if start is None else start[:, 0]


def _varying_admm(part: Part, camera: LinearOperator, start: Array | None) -> Solver:
    from recon.solvers.operator_admm import OperatorAdmm
    from recon.solvers.splitting import Room

    prior = part.prior_on(part.mean_axis_weights, (False,) * 3)
    shown = part.problem.window
    room = Room(part.namespace)
    return OperatorAdmm(camera, part.central, part.sensor_data, prior, initial=start, room=room, shown=shown)


def _sensor_admm(part: Part, start: Array | None) -> Solver:
    from recon.solvers.sensor_admm import SensorAdmm

    operator, initial = part.picture_camera, _of_picture(start)
    return SensorAdmm(operator, part.data, part.prior, initial=initial, background=part.removal)


def _sensor_refuses(problem: Problem) -> str | None:
    if problem.smooth and not problem.valid.all():
        return "it estimates no background where pixels are erased"
    return _plain_only(replace(problem, smooth=False)) or _by_name(problem, splitting_priors())


def _fista(part: Part, start: Array | None) -> Solver:
    from recon.solvers.fista import Fista

    return Fista(part.picture_operator, part.solved_data, part.prior, initial=_of_picture(start))


def _fista_refuses(problem: Problem) -> str | None:
    if problem.options.device != "cpu":
        return "it runs on the cpu only"
    if problem.n_planes > 1:
        return "it is for one depth"
    prior = PRIORS[problem.prior](1.0) if isinstance(problem.prior, str) else problem.prior
    sums = isinstance(prior, Sum)
    return f"the prior {problem.prior_name} is a sum without a common prox: take admm" if sums else None


class OneStep(Solver):
    """A solver without iterations: nothing is told, kept or cancelled on the way."""

    def __init__(self, solve: Callable[[], Outcome]) -> None:
        super().__init__()
        self._solve = solve
        self._outcome = Outcome(np.zeros(0), (), StopReason.ONE_STEP, 0.0)

    @property
    def solution(self) -> Array:
        """The result, once it has run."""
        return self._outcome.solution

    def step(self) -> IterationRecord:
        """Solve."""
        self._outcome = self._solve()
        return IterationRecord(1, self._outcome.seconds)

    def run(self, rules: StoppingRules | None = None, **_: Any) -> Outcome:
        """Solve, whatever the rules."""
        self.step()
        return self._outcome


def _wiener(part: Part, _: Array | None) -> Solver:
    """Wiener's penalty takes the place of a prior; bounds are kept by clipping."""
    from recon.priors.base import Separable
    from recon.solvers.wiener_filter import wiener

    def solve() -> Outcome:
        outcome = wiener(part.picture_operator, part.data, part.problem.options.tau)
        for term in part.prior.terms():
            if isinstance(term, Separable):
                outcome = replace(outcome, solution=term.prox(outcome.solution, 0.0))
        return outcome

    return OneStep(solve)


def _wiener_refuses(problem: Problem) -> str | None:
    return _plain_only(problem) or (
        None
        if problem.prior in ("none", "nonnegative")
        else "it evaluates no prior: it takes none, or nonnegative for its bounds"
    )


def _offered() -> tuple[OfferedSolver, ...]:
    return (
        OfferedSolver(
            name="admm",
            help="Splitting; for pictures and volumes, any camera model, background and device.",
            make=_admm,
            refuses=_admm_refuses,
            tolerance=lambda problem: 2e-3 if problem.is_plain else 1e-3,
            cost=1.0,
        ),
        OfferedSolver(
            name="admm-sensor",
            help="Splitting with the data term solved on the sensor, for dense pictures of many pixels.",
            make=_sensor_admm,
            refuses=_sensor_refuses,
            cost=2.0,
            flat=True,
            suits=lambda problem: problem.smooth or problem.data[0].size >= MANY_PIXELS,
        ),
        OfferedSolver(
            name="fista",
            help="Accelerated proximal gradient, for pictures with any prior of one prox.",
            make=_fista,
            refuses=_fista_refuses,
            tolerance=lambda problem: 2e-4 if problem.patterned else 5e-4,
        ),
        OfferedSolver(
            name="wiener",
            help="Deconvolution in one step, without a prior, for previews.",
            make=_wiener,
            refuses=_wiener_refuses,
            prior="none",
            one_step=True,
            cost=0.01,
        ),
    )


SOLVERS: Registry[OfferedSolver] = Registry("solver", "diffuserbench.solvers", _offered)
"""The solvers, the usual one first."""

REPLACED = {
    "admm-gpu": "The solver admm-gpu is now the device: leave the solver out, or take admm, and device='gpu' "
    "(--device gpu), for pictures and volumes alike."
}
"""Solvers that are no more, and what replaces them."""


def require_solver(name: str) -> None:
    """Raise InputError for what is not the name of a solver."""
    if name in REPLACED:
        raise InputError(REPLACED[name])
    if name != "auto":
        SOLVERS.named(name)


def solver_for(problem: Problem) -> OfferedSolver:
    """Return the solver that was asked for, or the first that suits a problem, or else that takes it.

    Raises InputError when it has no way for the problem, with the reason.
    """
    asked = problem.options.solver
    require_solver(asked)
    if asked == "auto":
        reasons = []
        for name, offered in sorted(SOLVERS.items(), key=lambda item: not item[1].suits(problem)):
            if (reason := offered.accepts(problem)) is None:
                return offered
            reasons.append(f"{name}: {reason}")
        raise InputError("; ".join(reasons) + ".")
    offered = SOLVERS.named(asked)
    if (reason := offered.accepts(problem)) is not None:
        raise InputError(f"The solver {asked} does not take this: {reason}.")
    return offered
