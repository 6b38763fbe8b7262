"""What every iterative solver has in common: one step, a history, when it ends."""

from __future__ import annotations

import enum
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.arguments import require_argument, require_numbers
from recon.base.brief import brief
from recon.base.namespace import Namespace, namespace_of, to_host
from recon.base.threads import linear_algebra_on_one_thread
from recon.camera.base import LinearOperator
from recon.errors import InputError
from recon.priors.base import Prior, refuse_lookalike
from recon.types import plain_number


class StopReason(enum.StrEnum):
    """Why a solver stopped."""

    NOISE_LEVEL = "the residual is down to the expected noise"
    CONVERGED = "the change per iteration fell below the tolerance"
    TIME = "the time budget is spent"
    ITERATIONS = "the number of iterations is reached"
    CANCELLED = "cancelled"
    ONE_STEP = "solved in one step"
    NOT_FINITE = "the iterate is no longer finite; the starting point is returned"


@dataclass(frozen=True, slots=True)
class IterationRecord:
    """What one iteration reached. NaN stands for what the solver does not know at this iteration."""

    iteration: int
    """Counted from 1."""
    seconds: float
    """Wall time since the run began, without callbacks."""
    objective: float = np.nan
    """``1/2 ||A x - b||^2 + prior(x)``."""
    data_residual: float = np.nan
    """``||A x - b||``; compare with the expected noise norm."""
    primal_residual: float = np.nan
    """How far the split variables disagree, relative to their size (splitting methods)."""
    dual_residual: float = np.nan
    """How far the optimality condition is missed, relative to its terms (splitting methods)."""
    change: float = np.nan
    """``||x - x_previous|| / ||x||``; every solver knows it, and one that is not finite ends the run."""

    @property
    def unrest(self) -> float:
        """What is compared with the tolerance: the change, or the residuals over ``RESIDUAL_FACTOR``."""
        residual = float(np.nanmax([self.primal_residual, self.dual_residual, 0.0]))
        return max(self.change, residual / RESIDUAL_FACTOR)


RESIDUAL_FACTOR = 10.0
"""Primal and dual residuals may be so much larger than the tolerance: pictures were seen to settle to 0.1 dB
while these were ten times the change an iteration."""


@dataclass(frozen=True, slots=True)
class StoppingRules:
    """The rules; whichever fires first ends the run.

    Attributes
    ----------
    iterations : int or None
        At most so many.
    time_s : float or None
        Wall time budget, seconds; the iteration that runs out of it is completed.
    tolerance : float
        Stop when the change per iteration has been below this for ``patience`` iterations in a row and,
        where the solver knows them, primal and dual residual below ``RESIDUAL_FACTOR`` times this;
        0 disables.
    noise_norm : float or None
        Expected ``||noise||`` over the valid data; stop when the residual norm is down to it.
    patience : int
    """

    iterations: int | None = 1000
    time_s: float | None = None
    tolerance: float = 1e-4
    noise_norm: float | None = None
    patience: int = 3

    def __post_init__(self) -> None:
        settled = {
            "iterations": require_argument("iterations", self.iterations, int | None, least=1),
            "time_s": require_argument("time_s", self.time_s, float | None, above=0),
            "tolerance": require_argument("tolerance", self.tolerance, float, least=0),
            "noise_norm": plain_number(self.noise_norm),
            "patience": require_argument("patience", self.patience, int),
        }
        for name, value in settled.items():
            object.__setattr__(self, name, value)
        if self.iterations is None and self.time_s is None and self.tolerance <= 0:
            raise InputError("A run needs an end: give iterations, time_s or a tolerance above 0.")


@dataclass(slots=True)
class StopCheck:
    """Applies :class:`StoppingRules` to a run as it goes."""

    rules: StoppingRules
    _calm: int = field(default=0, init=False)

    def __call__(
        self, record: IterationRecord, confirm: Callable[[], bool] = lambda: True
    ) -> StopReason | None:
        """Return the reason to stop after this iteration, or None.

        ``confirm`` is asked where the run looks converged; what it denies leaves the other rules in force.
        """
        rules = self.rules
        if not np.isfinite(record.change) or np.isinf([record.data_residual, record.objective]).any():
            return StopReason.NOT_FINITE
        if rules.noise_norm is not None and record.data_residual <= rules.noise_norm:
            return StopReason.NOISE_LEVEL
        self._calm = self._calm + 1 if record.unrest < rules.tolerance else 0
        if rules.tolerance > 0 and self._calm >= rules.patience and confirm():
            return StopReason.CONVERGED
        if rules.time_s is not None and record.seconds >= rules.time_s:
            return StopReason.TIME
        if rules.iterations is not None and record.iteration >= rules.iterations:
            return StopReason.ITERATIONS
        return None


Callback = Callable[["Solver", IterationRecord], object]


def require_parts(operator: object, data: npt.ArrayLike, prior: object) -> Array:
    """Return the data as an array; raises InputError where they are not what the operator gives.

    So it does where operator or prior is none.
    """
    require_argument("operator", operator, LinearOperator)
    refuse_lookalike(prior)
    require_argument("prior", prior, Prior, "db.PRIORS names them, db.L1(weight) is one.")
    assert isinstance(operator, LinearOperator)
    expected = f"what the operator gives, an array of shape {operator.range_shape}"
    found = require_numbers("data", data, f"{expected} of real numbers")
    if found.shape != operator.range_shape:
        raise InputError(f"data must be {expected}, not an array of shape {found.shape}.")
    return found


def starting_point(operator: LinearOperator, initial: npt.ArrayLike | None) -> Array:
    """Return an iterate to begin with on the operator's domain, default zeros; InputError for others."""
    start = np.zeros(operator.domain_shape, operator.dtype)
    if initial is not None:
        expected = f"an array of shape {start.shape}"
        given = require_numbers("initial", initial, f"{expected} of real numbers", least_axes=0)
        try:
            start[...] = given
        except ValueError as error:
            raise InputError(f"initial must be {expected}, not of shape {given.shape}.") from error
    return start


@dataclass(frozen=True)
class Outcome:
    """What a run reached: the object on the operator's domain, how, and why it ended."""

    solution: Array
    history: tuple[IterationRecord, ...]
    stop_reason: StopReason
    seconds: float
    tau: float | None = None
    """The regularisation that a solver settled for itself."""

    __repr__ = brief


class Keeper(Protocol):
    """Keeps the state of a run outside the program, so that it can be gone on with another day.

    A run of several solvers, one after the other, tells them apart by ``part``.
    """

    def resume(self, part: str, solver: Solver) -> tuple[IterationRecord, ...]:
        """Restore what was kept of a part, if anything, and return its history so far."""
        ...

    def keep(self, part: str, solver: Solver, history: Sequence[IterationRecord], *, ended: bool) -> None:
        """Look at a solver after an iteration, and once more when its run has ended."""
        ...


class KeptPart(Protocol):
    """A part of a solver with a state of its own: a prior that was split off."""

    kept: ClassVar[tuple[str, ...]]
    """Names of the state's entries."""

    def checkpoint(self) -> dict[str, Any]:
        """Return the state."""
        ...

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        ...


class Solver(ABC):
    """An iterative solver of ``min_x 1/2 ||A x - b||^2 + prior(x)``.

    A subclass implements :meth:`step` and :attr:`solution`, and names in ``state_names`` the attributes that
    make up its state ("part.name" for those of a part); that is enough for :meth:`checkpoint` and
    :meth:`restore`, which see to what priors keep as well.

    Attributes
    ----------
    xp : module
        Whose arrays its own are: ``numpy`` or ``cupy``.
    prior : Prior or None
        A prior whose prox the solver itself takes.
    splits : sequence of KeptPart
        Priors that were split off.
    """

    state_names: ClassVar[tuple[str, ...]] = ()
    xp: Namespace = np
    prior: Prior | None = None
    splits: Sequence[KeptPart] = ()

    def __init__(self) -> None:
        self.iteration = 0

    @abstractmethod
    def step(self) -> IterationRecord:
        """Do one iteration and return what is known of it; :meth:`run` fills in its number and time."""

    @property
    @abstractmethod
    def solution(self) -> Array:
        """The present iterate on the operator's domain. A view or copy: not to be written to."""

    @linear_algebra_on_one_thread()
    def advance(self) -> IterationRecord:
        """Do one iteration and count it, for those who decide after each whether to go on; untimed."""
        known = self.step()
        self.iteration += 1
        return replace(known, iteration=self.iteration)

    def compile(self) -> None:  # noqa: B027 (a solver without compiled code has nothing to do)
        """Have compiled code ready: its first use on a machine takes seconds that are no iteration's."""

    @linear_algebra_on_one_thread()
    def run(
        self,
        rules: StoppingRules | None = None,
        *,
        callback: Callback | None = None,
        cancel: threading.Event | None = None,
        keeper: Keeper | None = None,
        part: str = "",
    ) -> Outcome:
        """Iterate until a rule fires.

        Parameters
        ----------
        rules : StoppingRules, optional
        callback : callable, optional
            ``callback(solver, record)`` after each iteration; its time is not counted.
        cancel : threading.Event, optional
            Set from any thread (or from the callback) to end the run after the iteration in progress.
        keeper : Keeper, optional
            Who keeps the state. What it has of an earlier run is gone on with, and counts for all rules.
        part : str
            This run's name with the keeper.
        """
        self.compile()
        check = StopCheck(rules or StoppingRules())
        start = self._start()
        history = [] if keeper is None else list(keeper.resume(part, self))
        reason: StopReason | None = None
        for record in history:
            reason = check(record, self.confirm if record is history[-1] else lambda: True)
        seconds = history[-1].seconds if history else 0.0
        while reason is None:
            began = time.perf_counter()
            known = self.step()
            self.iteration += 1
            seconds += time.perf_counter() - began
            record = replace(known, iteration=self.iteration, seconds=seconds)
            history.append(record)
            reason = check(record, self.confirm)
            if callback is not None:
                callback(self, record)
            if keeper is not None:
                keeper.keep(part, self, history, ended=False)
            if reason is None and cancel is not None and cancel.is_set():
                reason = StopReason.CANCELLED
        if keeper is not None:
            keeper.keep(part, self, history, ended=True)
        solution = self._end()
        # One number is enough to find a NaN or an infinity, and takes no second array.
        if not np.isfinite(np.sum(solution, dtype=np.float64)):
            reason, solution = StopReason.NOT_FINITE, np.zeros_like(solution) if start is None else start
        return Outcome(solution, tuple(history), reason, seconds)

    def move(self, rows: float, columns: float) -> None:  # noqa: B027 (without a way, it stays where it is)
        """Go on as if the object had moved by so many pixels, to be given data of it where it is now."""

    def confirm(self) -> bool:
        """Tell whether the solver, too, takes itself to be converged, now that a rule says so.

        A solver that leaves part of the problem out puts back here what turns out to be needed, and goes on.
        """
        return True

    def _start(self) -> Array | None:
        """Return what to fall back on if the iterate is lost; None (zeros) where memory is dear."""
        return self.solution.copy()

    def _end(self) -> Array:
        """Return the result, which is the caller's from then on."""
        return self.solution.copy()

    def checkpoint(self, *, copy: bool = True) -> dict[str, Any]:
        """Return the state, in the host's memory: arrays and numbers by name, to be given to :meth:`restore`.

        Without ``copy`` the arrays are the solver's own, to be read before its next step.
        """
        state = {name: attrgetter(name)(self) for name in ("iteration", *self.state_names)}
        if self.prior is not None:
            state["prior"] = np.zeros(0) if self.prior.memory is None else self.prior.memory
        for i, split in enumerate(self.splits):
            state |= {f"prior_{i}_{name}": value for name, value in split.checkpoint().items()}
        state = {name: to_host(v) if hasattr(v, "shape") else v for name, v in state.items()}
        return {name: v.copy() if copy and isinstance(v, np.ndarray) else v for name, v in state.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint of a solver of the same problem, whichever device it was taken on.

        Raises KeyError with the name of what the checkpoint does not have: another solver's, or another
        version's.
        """
        for name in ("iteration", *self.state_names):
            value, present = state[name], attrgetter(name)(self)
            if isinstance(present, np.ndarray) and namespace_of(present) is np:
                present[...] = value
                continue
            owner, _, attribute = name.rpartition(".")
            value = self.xp.asarray(value) if isinstance(value, np.ndarray) else value
            setattr(attrgetter(owner)(self) if owner else self, attribute, value)
        if self.prior is not None:
            memory = state["prior"]
            self.prior.memory = self.xp.array(memory) if memory.size else None
        for i, split in enumerate(self.splits):
            split.restore({name: state[f"prior_{i}_{name}"] for name in split.kept})
