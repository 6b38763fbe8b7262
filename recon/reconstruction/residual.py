"""What the residual says of a run that is over: how far above the noise it ended, whether it rose, why."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array
from recon.reconstruction.pilot import MODEL_ERROR
from recon.reconstruction.problem import Problem
from recon.solvers.base import Outcome, StopReason

FAR = 2.0
"""Residual at the end, in units of the noise, from which on something is said."""
RISEN, FEW = 1.5, 5
"""To how much of its least value a residual must have risen, and for how many iterations: the measured hand's
rises to 1.3 as the prior takes hold, the USAF target's without a background to 2.4 and more. Below the noise
is where splittings of exact data begin, and all may rise to the usual error of a model."""
FALLING, EARLIER = 0.98, 10
"""Of so many iterations earlier: a last residual below it had not come to its end."""
HELD = 3.0
"""How many times what noise asks for a weight must be to be named among the causes."""
NEGATIVE = 0.25
"""Share of the data's mean below zero from which on a background is said to be negative."""


def background_in_words(
    problem: Problem, background: Array | None, channels: slice = slice(None)
) -> list[str]:
    """Return a warning where a background (shaped as the channels' data, units of the noise) is no light."""
    if background is None:
        return []
    share = _share(problem, background, channels)
    if not is_below_zero(share):
        return []
    return [
        f"The background came out negative ({share:.2f} of the data's light), which no light is: the PSFs "
        "may stand on an offset, or lack light at their edges, and the object has as much more. See whether "
        "their dark frame is right; --positive-background keeps it above zero."
    ]


def is_below_zero(share: float) -> bool:
    """Whether a background's share of the light is no light."""
    return share <= -NEGATIVE


def _share(problem: Problem, light: Array, channels: slice) -> float:
    """Return some light's mean relative to that of the data of its channels."""
    mean = float(problem.data[channels][problem.valid[channels]].mean())
    return float(light.mean()) / max(abs(mean), 1e-30)


def beyond_in_words(problem: Problem, beyond: Array, channels: slice = slice(None)) -> list[str]:
    """Say how much of the light was taken for light from beyond the depths (shaped as the channels' data)."""
    share = _share(problem, beyond, channels)
    return [
        f"{share:.0%} of the light on the sensor is taken for light from beyond the farthest calibrated "
        "depth: it is part of the background, not of the volume (--choose beyond=off: none is)."
    ]


def residual_in_words(
    problem: Problem, outcome: Outcome, residual: float, noise: float, held: tuple[float, float] = (0.0, 1.0)
) -> list[str]:
    """Return a warning where a run of one part ended far from its data, or went away from them.

    Parameters
    ----------
    problem : Problem
    outcome : Outcome
        Of the run; its solution is not looked at.
    residual : float
        Its norm at the end, in units of the noise.
    noise : float
        Its expected norm.
    held : (float, float)
        The prior's weight relative to ``max |A^H b|``, and how many times what noise asks for it is.
    """
    times = residual / noise
    norms = [record.data_residual for record in outcome.history]
    if len(norms) <= FEW or not np.isfinite(times):  # so few say nothing
        return []
    contrast = float(np.std(problem.data[problem.valid], dtype=np.float64))
    share = float(np.sqrt(max(times**2 - 1, 0.0))) / max(contrast, 1e-30)
    least = int(np.argmin(norms))
    risen = residual > RISEN * max(norms[least], noise) and share > MODEL_ERROR
    rose = risen and len(norms) - 1 - least > FEW
    if times <= FAR and not rose:
        return []
    said = f"What is left of the data is {times:.1f} times their noise ({share:.1%} of their contrast)"
    if rose:
        after = "1 iteration" if least == 0 else f"{least + 1} iterations"
        said += f", and it rose, from {norms[least] / noise:.1f} times after {after}"
    falling = norms[-1] < FALLING * norms[-1 - min(EARLIER, len(norms) - 1)]
    cause = _cause(problem, share, outcome.stop_reason if falling else None)
    tau, over = held
    if over > HELD and not falling:
        cause = (
            f"the weight of the prior keeps some of it, {over:.0f} times what noise asks for: no less by "
            f"default, for errors of the camera model. Where the PSFs are good, a smaller one explains more "
            f"(--tau {tau / min(np.sqrt(over), 10):.1g}). Or {cause}"
        )
    return [f"{said}: {cause}"]


def _cause(problem: Problem, share: float, stopped: StopReason | None) -> str:
    """Say what keeps a residual up; ``stopped``: why a run ended whose residual was still falling."""
    if stopped is StopReason.CONVERGED:
        return "it was still falling slowly. A smaller tolerance (--tolerance) goes on for longer."
    if stopped is not None:
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
