"""What the residual says of a run that is over: how far above the noise it ended, whether it rose, why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.reconstruction.background import MODEL_ERROR
from recon.reconstruction.problem import Problem
from recon.solvers.base import IterationRecord

FAR = 2.0
"""Residual at the end, in units of the noise, from which on something is said."""
RISEN, FEW = 1.5, 5
"""To how much of its least value a residual must have risen, and for how many iterations: the measured hand's
rises to 1.3 as the prior takes hold, the USAF target's without a background to 2.4 and more."""
FALLING = 0.98
"""Of the one before: a last residual below it had not come to its end."""


def residual_in_words(
    problem: Problem, history: Sequence[IterationRecord], residual: float, noise: float
) -> list[str]:
    """Return a warning where a run of one part ended far from its data, or went away from them.

    Parameters
    ----------
    problem : Problem
    history : sequence of IterationRecord
    residual : float
        Its norm at the end, in units of the noise.
    noise : float
        Its expected norm.
    """
    times = residual / noise
    if len(history) <= FEW or not np.isfinite(times):  # so few say nothing
        return []
    norms = [record.data_residual for record in history]
    least = int(np.argmin(norms))
    rose = len(norms) - 1 - least > FEW and residual > RISEN * norms[least] and times > 1
    if times <= FAR and not rose:
        return []
    contrast = float(np.std(problem.data[problem.valid], dtype=np.float64))
    share = float(np.sqrt(max(times**2 - 1, 0.0))) / max(contrast, 1e-30)
    said = f"What is left of the data is {times:.1f} times their noise ({share:.1%} of their contrast)"
    if rose:
        said += f", and it rose, from {norms[least] / noise:.1f} times after {least + 1} iterations"
    falling = len(norms) > 1 and norms[-1] < FALLING * norms[-2]
    return [f"{said}: {_cause(problem, share, falling=falling)}"]


def _cause(problem: Problem, share: float, *, falling: bool) -> str:
    if falling:
        return "it was still falling. More iterations or more time would help."
    if share <= MODEL_ERROR:
        return "errors of the PSF and the camera model are of that size as a rule."
    if problem.smooth or problem.measurement.background is not None:
        return (
            "the PSF may be of another state of the camera (moved, another depth, colour or binning), pixels "
            "may be saturated, or the prior too strong."
        )
    return (
        "there may be light that the PSF does not describe, or the PSF is of another state of the camera "
        "(moved, another depth or colour). See whether a smooth background explains it (--background)."
    )
