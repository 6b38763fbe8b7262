"""How heavy a picture's prior is where nobody says: from a first look at the picture.

The weight of a prior is the noise's variance over the scale of what it counts (the maximum a posteriori of a
Laplacian prior), so it follows the picture: little for edges far above the noise, and for light on black,
which non-negativity holds by itself; more where nothing is black, where the picture is faint, and where the
model leaves more than noise, as with a PSF that is not quite right. A few iterations with a light total
variation tell these apart.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from recon.camera.camera_model import CAMERAS
from recon.priors import Prior
from recon.reconstruction.pilot import pilot
from recon.reconstruction.problem import Problem
from recon.reconstruction.weights import is_weighted, kind_of

ITERATIONS = 12
"""A quarter of what a picture takes: steepness and light are then within 5 % of what 20 give."""
MOST_TIMES = 4
"""So many times as many where pixels are erased, which take longer to be found: the inverse of the valid
share, and at most this."""
WEIGHT = 0.25
"""Of total variation in the look, in units of the noise."""
STEEPEST = 2.5
"""Steepness up to which the laws were fitted, in units of what is left where that is more than the noise:
beyond, smaller weights would take ever more iterations."""
NEARLY_NOISE = ((1.3, 2.0), (1.0, 2.0))
"""What is left, and the unit of steepness by it: near the noise it is the noise, as far as that is known."""
UNLIKE = 7.5
"""Where PSFs vary: what the central one may leave of the data for its picture to tell anything, in units of
the noise (7.3 at most on the scenes of the law)."""
LIT = 0.1
"""A pixel is lit from this share of the brightest (99.9th percentile)."""


@dataclass(frozen=True)
class Law:
    """A weight as a function of what a first look found (docs/decisions/0071-misfit-of-the-first-look.md).

    Attributes
    ----------
    factor : float
        In units of the noise: of a few lights in the dark, with steps as large as the noise.
    steepness : float
        Power of the steepness.
    lit : float
        Doublings from a picture that is black to one that is lit everywhere.
    misfit : float
        Power of the misfit where it exceeds the noise,
    most_misfit : float
        up to this much.
    most : float
        Largest weight.
    """

    factor: float
    steepness: float
    lit: float
    misfit: float
    most_misfit: float
    most: float


LAWS: Mapping[Literal["tv", "l1", "tv, varying"], Law] = {
    "tv": Law(0.083, -0.95, 3.1, 1.2, 12.0, 8.0),
    "l1": Law(1.4, -0.75, 3.6, 2.1, 3.0, 256.0),
    "tv, varying": Law(0.2, -0.55, 1.24, 0.0, 12.0, 8.0),
}
"""By what the prior counts; fitted on the scenes of `benchmarks/weights.py --tuning` and on the pairs. That
of total variation is nearly the maximum a posteriori: what is left of the data over the steps' scale. Where
PSFs vary over the field what one of them leaves is no misfit of theirs, and it takes no part."""


@dataclass(frozen=True)
class FirstLook:
    """What a first look at a picture found.

    Attributes
    ----------
    steepness : float
        Mean absolute difference along rows and columns together, in units of the noise passed on.
    lit : float
        Share of the pixels that are lit.
    misfit : float
        What its picture leaves of the data, in units of the noise.
    seconds : float
        That it took.
    passed_on : float
        Noise that the adjoint passes on, in units of the noise: less than 1 where pixels are erased, which
        is as if there were less light, not more noise.
    varying : bool
        Whether the picture is then solved with PSFs that vary over the field.
    """

    steepness: float
    lit: float
    misfit: float
    seconds: float
    passed_on: float = 1.0
    varying: bool = False

    def weight(self, prior: str) -> float:
        """Return the weight of a prior by name, in units of the noise."""
        law = LAWS["tv, varying" if self.varying else kind_of(prior)]
        misfit = min(max(self.misfit, 1.0), law.most_misfit)
        unit = misfit if misfit > 2 else float(np.interp(misfit, *NEARLY_NOISE))
        steepness = float(np.clip(self.steepness, 1e-6, STEEPEST * unit))
        factor = law.factor * 2 ** (law.lit * self.lit)
        weight = factor * steepness**law.steepness * misfit**law.misfit
        return float(min(weight, law.most)) * self.passed_on

    def in_words(self, prior: str) -> str:
        """Say what the weight is, and why."""
        return (
            f"{self.weight(prior):.2g} times the noise: a first look found {self.lit:.0%} of the picture "
            f"lit, steps of {self.steepness:.2g} times the noise between pixels, misfit {self.misfit:.2g}"
        )


def look_at(problem: Problem, cancel: threading.Event | None = None) -> FirstLook | None:
    """Look at a picture through one PSF; None where a weight is given or not asked for, or it tells nothing.

    Where PSFs vary over the field it is the central one, and a background that is estimated as well takes
    no part: neither changes much of the picture's steps. Where that PSF tells nothing of the picture, as of a
    close scene far off the axis, the table's weight holds, as without a look. With l1 light then counts as
    much as it is seen, and the law does not hold.

    Parameters
    ----------
    problem : Problem
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    """
    options = problem.options
    named = not isinstance(problem.prior, Prior) and is_weighted(problem.prior_name)
    if options.tau is not None or not named or problem.solver.one_step:
        return None
    varying = problem.varies and problem.model not in CAMERAS
    if kind_of(problem.prior_name) == "tv":
        problem = replace(problem, smooth=False, model="convolution" if varying else problem.model)
    if not problem.is_plain or problem.patterned:
        return None
    # Whatever device and precision the picture is solved with, the weight is the same.
    light = replace(options, prior="tv", axis_weights=None, device="cpu", precision="float32")
    passed_on = float(np.sqrt(problem.valid.mean()))
    own = replace(problem, options=light, precision="float32")
    most = round(ITERATIONS * min(passed_on**-2, MOST_TIMES))
    found = pilot(own, most, weight=WEIGHT * passed_on, cancel=cancel)
    rows, columns = problem.window
    picture = found.solution[:, 0, rows, columns].astype(np.float64)
    steps = [np.abs(np.diff(picture, axis=axis)).mean() for axis in (1, 2) if picture.shape[axis] > 1]
    brightest = np.percentile(picture, 99.9)
    misfit = float(np.sqrt(np.mean(found.left[problem.valid].astype(np.float64) ** 2)))
    if varying and misfit > UNLIKE:
        return None
    return FirstLook(
        float(sum(steps)) * passed_on,
        float(np.mean(picture > LIT * brightest)),
        misfit,
        found.outcome.seconds,
        passed_on,
        varying,
    )
