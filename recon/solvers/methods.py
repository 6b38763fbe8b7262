"""The methods that :func:`recon.reconstruct` offers by name.

A method takes a :class:`Problem` and returns an :class:`~recon.solvers.Outcome`. New ones register with
:func:`register`. Each solver looks for the structure that it needs in operator and prior, and refuses others
with a sentence.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from recon.camera.base import Array, LinearOperator
from recon.priors.base import Prior
from recon.priors.simple import Separable
from recon.solvers.admm import Admm
from recon.solvers.base import Callback, Keeper, Outcome
from recon.solvers.fista import Fista
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.stopping import StoppingRules
from recon.solvers.wiener import wiener


@dataclass(frozen=True)
class Problem:
    """``min_x 1/2 ||A x - b||^2 + prior(x)`` with a start, rules to stop and whom to tell.

    Data is scaled so that its noise has deviation 1, the operator so that a PSF has unit energy.
    """

    operator: LinearOperator
    data: Array
    prior: Prior
    tau: float | None
    """The prior's relative weight as the caller gave it; None for the default that ``prior`` already has."""
    initial: Array | None
    rules: StoppingRules
    callback: Callback | None
    cancel: threading.Event | None
    keeper: Keeper | None = None


Solve = Callable[[Problem], Outcome]


@dataclass(frozen=True, slots=True)
class Method:
    """A way to solve a problem, and the tolerance at which its pictures were seen to have settled."""

    solve: Solve
    tolerance: float


_methods: dict[str, Method] = {}


def register(name: str, solve: Solve, *, tolerance: float = 2e-3) -> None:
    """Offer a method under a name."""
    _methods[name] = Method(solve, tolerance)


def method_names() -> tuple[str, ...]:
    """Names of the methods on offer."""
    return tuple(_methods)


def method_named(name: str) -> Method:
    """Return a method by its name; raises KeyError for an unknown one."""
    return _methods[name]


def _admm(p: Problem) -> Outcome:
    solver = Admm(p.operator, p.data, p.prior, initial=p.initial)
    return solver.run(p.rules, callback=p.callback, cancel=p.cancel, keeper=p.keeper)


def _sensor_admm(p: Problem) -> Outcome:
    solver = SensorAdmm(p.operator, p.data, p.prior, initial=p.initial)
    return solver.run(p.rules, callback=p.callback, cancel=p.cancel, keeper=p.keeper)


def _gpu(p: Problem) -> Outcome:
    from recon.base.namespace import array_namespace
    from recon.solvers.gpu_picture import picture_solver

    solver = picture_solver(array_namespace("gpu"), p.operator, p.data, p.prior, p.initial)
    return solver.run(p.rules, callback=p.callback, cancel=p.cancel, keeper=p.keeper)


def _fista(p: Problem) -> Outcome:
    solver = Fista(p.operator, p.data, p.prior, initial=p.initial)
    return solver.run(p.rules, callback=p.callback, cancel=p.cancel, keeper=p.keeper)


def _wiener(p: Problem) -> Outcome:
    """Wiener's penalty takes the place of the prior; only the prior's bounds are kept, by clipping."""
    outcome = wiener(p.operator, p.data, p.tau)
    for term in p.prior.terms():
        if isinstance(term, Separable):
            outcome = replace(outcome, solution=term.prox(outcome.solution, 0.0))
    return outcome


register("admm", _admm)
register("admm-sensor", _sensor_admm)
register("admm-gpu", _gpu)
register("fista", _fista, tolerance=5e-4)
register("wiener", _wiener)
