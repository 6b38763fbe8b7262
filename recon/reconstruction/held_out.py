"""How well a reconstruction foretells pixels that it has not seen: worth something without any known case."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.reconstruction.background import HELD_OUT
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import rules_of
from recon.reconstruction.solvers import SOLVERS

SHARE, LEAST = 3, 20
"""Of the iterations of the result a third are run, and so many at least."""


def held_out_error(result: Reconstruction, problem: Problem) -> float:
    """Return the root mean square error of a tenth of the pixels by a shorter run without them.

    Parameters
    ----------
    result : Reconstruction
    problem : Problem
        That was solved; of several channels that are solved one by one the one with most signal counts.

    Returns
    -------
    float
        In units of the noise, which it holds itself: 1 is as good as can be.
    """
    unseen = problem.valid & (np.random.default_rng(0).random(problem.valid.shape) < HELD_OUT)
    spread = [float(d[v].std()) for d, v in zip(problem.data, problem.valid, strict=True)]
    channels = next(c for c in parts_of(problem) if c.start <= int(np.argmax(spread)) < c.stop)
    seen = replace(problem, data=np.where(unseen, 0, problem.data), valid=problem.valid & ~unseen)
    offered = SOLVERS.named(result.solver)
    if offered.accepts(seen) is not None:
        offered = SOLVERS.named("admm")
    rules = rules_of(seen, offered)
    if not offered.one_step:
        rules = replace(rules, iterations=max(len(result.history) // SHARE, LEAST))
    part = Part(seen, channels)
    try:
        part.weigh(result.tau)
        solution = part.lifted(offered.make(part, None).run(rules).solution)
        told = part.camera.forward(solution)
        if part.removal is not None:
            told = told + part.background(solution)
    finally:
        part.close()
    missed = (problem.data[channels] - told)[unseen[channels]].astype(np.float64)
    return float(np.sqrt(np.mean(missed**2)))
