"""Pilots: a few iterations of a problem, to decide by, and the fine structure that they leave."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord, Outcome, Solver, StoppingRules

FINE_PX = 3.0
"""Deviation of the Gaussian whose mean is taken off what is left, pixels: slow waves are left by unfinished
iterations and stray light, and prefer smaller PSFs."""
LOOKED_AT = 2
"""Iterations between looks at whether it is enough: each costs one of several forward passes an iteration."""
TILES = 4
"""Along each axis of the photograph, judged apart: how much they differ tells how sure the whole is."""


@dataclass(frozen=True)
class Pilot:
    """What a few iterations found, in units of the noise.

    Attributes
    ----------
    solution : ndarray, (n_channels, n_z, grid height, grid width)
        At least 0.
    background : ndarray or None, (n_channels, height, width)
        Where the problem has a smooth one.
    left : ndarray, (n_channels, height, width)
        The data less what both say of them. Erased data are 0: there it is what both say, negative.
    weight : float
        Of the prior.
    outcome : Outcome
    """

    solution: Array
    background: Array | None
    left: Array
    weight: float
    outcome: Outcome


class Begun:
    """A pilot that goes on from where it is; close it, or use it as a context manager.

    Parameters
    ----------
    problem : Problem
    weight : float, optional
        Of the prior, in units of the noise; else the table's.
    solver : str
        ADMM where that one refuses the problem.
    """

    def __init__(self, problem: Problem, *, weight: float | None = None, solver: str = "admm-sensor") -> None:
        offered = SOLVERS.named(solver)
        self._offered = offered if offered.accepts(problem) is None else SOLVERS.named("admm")
        own = replace(problem, options=replace(problem.options, solver=self._offered.name))
        self._part = Part(own, slice(0, problem.n_channels))
        self._solver: Any = None
        try:
            self._part.weigh(None, weight)
            self._solver = self._offered.make(self._part, None)
        except BaseException:
            self.close()
            raise

    @property
    def weight(self) -> float:
        """Of the prior."""
        return self._part.weight

    def to(
        self,
        iterations: int,
        *,
        cancel: threading.Event | None = None,
        enough: Callable[[Array], bool] | None = None,
    ) -> Pilot:
        """Go on until so many iterations are done in all; parameters as of :func:`pilot`."""
        rules, ended, part = (
            StoppingRules(iterations=iterations, tolerance=0.0),
            threading.Event(),
            self._part,
        )

        def look(solver: Solver, record: IterationRecord) -> None:
            stopped = cancel is not None and cancel.is_set()
            if enough is not None and record.iteration % LOOKED_AT == 0:
                stopped = stopped or enough(_said(part, solver.solution)[2])
            if stopped:
                ended.set()

        outcome = self._solver.run(rules, callback=look, cancel=ended)
        solution, background, left = _said(part, outcome.solution)
        return Pilot(solution, background, left, part.weight, outcome)

    def close(self) -> None:
        """Remove what it kept on disk."""
        self._solver = None
        self._part.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def pilot(
    problem: Problem,
    iterations: int,
    *,
    weight: float | None = None,
    solver: str = "admm-sensor",
    cancel: threading.Event | None = None,
    enough: Callable[[Array], bool] | None = None,
) -> Pilot:
    """Reconstruct a problem in few iterations; its channels together, or its only one.

    Parameters
    ----------
    problem : Problem
    iterations : int
    weight, solver
        As of :class:`Begun`.
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    enough : callable, optional
        ``enough(left)`` with what an iterate leaves of the data, at every :data:`LOOKED_AT`-th: True ends it.
    """
    with Begun(problem, weight=weight, solver=solver) as begun:
        return begun.to(iterations, cancel=cancel, enough=enough)


MODEL_ERROR = 0.02
"""What a calibrated camera leaves unexplained as a rule, relative to the standard deviation of the data: 0.01
on the measured hand, whose picture is good. Noise and this together are the unit of held-out errors."""
HELD_OUT = 0.1
"""Share of the pixels that judge."""


def held_out(problem: Problem) -> tuple[Problem, Callable[[Array], float]]:
    """Return a problem of one channel without some of its pixels, and what judges a pilot of it by them.

    That takes what the pilot left, and returns its root mean square there, in units of noise and usual error.
    """
    data, valid = problem.data[0], problem.valid[0]
    spread2 = max(float(data[valid].var(dtype=np.float64)) - 1, 0.0)
    unit = np.float32(np.sqrt(1 + MODEL_ERROR**2 * spread2))
    unseen = valid & (np.random.default_rng(0).random(valid.shape) < HELD_OUT)
    if not unseen.any():
        unseen = valid
    seen = valid & ~unseen if (valid & ~unseen).any() else valid
    data = data / unit
    predicted = np.where(seen, 0, data)[unseen]  # what was not seen is to be predicted

    def error(left: Array) -> float:
        return float(np.sqrt(np.mean((left[0][unseen] + predicted).astype(np.float64) ** 2)))

    data = np.where(seen, data, 0)[None]
    return replace(problem, data=data, valid=seen[None], noise=problem.noise * unit), error


def _said(part: Part, iterate: Array) -> tuple[Array, Array | None, Array]:
    """Return a solver's iterate as an object, the background that goes with it, and what both leave."""
    solution = np.maximum(part.lifted(iterate), 0)
    background = None if part.removal is None else part.background(solution)
    # Of the data as measured: a background holds what was expected of it.
    left = part.problem.data.astype(part.dtype, copy=False) - part.camera.forward(solution)
    if background is not None:
        left -= background
    return solution, background, left


def fine_structure(rest: Array, known: BoolArray) -> Array:
    """Return what is left less its own local mean, (height, width); 0 where nothing is known."""
    from scipy.ndimage import gaussian_filter

    share, rest = known.astype(rest.dtype), np.where(known, rest, 0)
    local = gaussian_filter(rest, FINE_PX) / np.maximum(gaussian_filter(share, FINE_PX), 1e-3)
    return np.where(known, rest - local, 0)


def tile_means(image: Array, where: BoolArray) -> Float64Array:
    """Return the mean over the chosen pixels of each tile that has any."""
    rows, columns = (np.arange(n) * TILES // n for n in image.shape)
    tile = (rows[:, None] * TILES + columns)[where]
    count, total = np.bincount(tile), np.bincount(tile, image[where])
    means: Float64Array = total[count > 0] / count[count > 0]
    return means
