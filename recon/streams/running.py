"""The solvers of a problem, kept while one frame after the other is put to them."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.errors import InputError
from recon.reconstruction.measurement import Floats
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.problem import Problem
from recon.solvers.base import Solver, StoppingRules
from recon.solvers.sensor_admm import SensorAdmm


class Running:
    """Solves frame after frame of one camera; for one thread.

    Whatever camera, background, erasures and depths the problem has, each frame goes on from the one before,
    with all that an iteration builds on (object, dual variables, penalties). The exact-data ADMM of a picture
    takes new data in the memory that it has; other solvers are made anew for each frame, which costs what
    their making costs.

    Parameters
    ----------
    problem : Problem
        Of a first frame, which settles noise, scales and the prior's weight; its model is not ``"auto"``.

    Raises
    ------
    InputError
        When the solver has no iterations, or no way for the problem.
    """

    def __init__(self, problem: Problem) -> None:
        self._offered = problem.solver
        if self._offered.one_step:
            raise InputError(f"{self._offered.name} has no iterations to go on with: take another solver.")
        self.problem = problem
        self.parts = [Part(problem, channels) for channels in parts_of(problem)]
        for part in self.parts:
            part.weigh(problem.options.tau)
        self.solvers: list[Any] = [self._made(part, None) for part in self.parts]

    @property
    def weights(self) -> list[float]:
        """The prior's weight in the scaled problem, one a part."""
        return [part.weight for part in self.parts]

    def begin(self, problem: Problem) -> None:
        """Take a frame (:meth:`Problem.with_data`) and begin from zero."""
        self._take(problem, cold=True)

    def go_on(self, problem: Problem) -> None:
        """Take a frame and go on from where the one before ended."""
        self._take(problem, cold=False)

    def advance(self) -> float:
        """Do one iteration of every part; return the largest change."""
        return max(float(solver.advance().change) for solver in self.solvers)

    def iterate(self, count: int, settled: float) -> int:
        """Iterate at most so many times, until the change stays below ``settled``; return how often.

        Solvers that are made anew may not move at all in their first iteration: theirs must be calm for
        several in a row.
        """
        kept = all(isinstance(solver, SensorAdmm) for solver in self.solvers)
        patience, calm = 1 if kept else StoppingRules().patience, 0
        for done in range(1, count + 1):
            calm = calm + 1 if self.advance() < settled else 0
            if calm >= patience:
                return done
        return count

    def volume(self) -> Floats:
        """Return the present reconstruction, (n_z, height, width[, n_channels]), in measurement units."""
        return self.problem.whole(
            [
                self.problem.measured(part.lifted(solver.solution), part.channels)
                for part, solver in zip(self.parts, self.solvers, strict=True)
            ]
        )

    def _take(self, problem: Problem, *, cold: bool) -> None:
        self.problem = problem
        for place, (part, solver) in enumerate(zip(self.parts, self.solvers, strict=True)):
            part.set_data(problem)
            if isinstance(solver, SensorAdmm):
                (solver.restart if cold else solver.set_data)(part.data)
            else:
                self.solvers[place] = self._made(part, None) if cold else self._gone_on(part, solver)

    def _gone_on(self, part: Part, before: Any) -> Any:
        """Return a solver of a part's new data that knows what another one knew."""
        if isinstance(before, Solver) and before.state_names:
            state = before.checkpoint()
            solver = self._made(part, None)
            solver.restore(state)
            return solver
        return self._made(part, np.array(part.lifted(before.solution)))

    def _made(self, part: Part, start: Any) -> Any:
        solver = self._offered.make(part, start)
        if isinstance(solver, Solver):
            solver.compile()
        return solver
