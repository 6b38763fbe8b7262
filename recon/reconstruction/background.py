"""Whether a smooth background is estimated as well: what it gains on pixels that no pass has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError
from recon.reconstruction.choice import Decision
from recon.reconstruction.options import Overrides
from recon.reconstruction.part import expects_background
from recon.reconstruction.pilot import Pilot, pilot
from recon.reconstruction.problem import Problem

MODEL_ERROR = 0.02
"""What a calibrated camera leaves unexplained as a rule, relative to the standard deviation of the data: 0.01
on the measured hand, whose picture is good. Noise and this together are the unit of a trial."""
HELD_OUT = 0.1
"""Share of the pixels that judge."""
ITERATIONS, PLAIN_ITERATIONS = 20, 120
"""Of a trial's passes. The splitting of one convolution without a background begins far from the data, in a
twentieth of the others' time an iteration: with 25 it had the measured hand ask for a background."""
GAIN = 4.0
"""By how much the mean square error of the held-out pixels must fall, in units of noise and usual error.

On the measured USAF target it fell by 20 to 80, with total variation, l1 and non-negativity; on the measured
hand, which a background spoils, by 0.5; on 24 scenes without stray light by 1.4 at most."""
LIGHT, LIGHT_GAIN = 0.11, 0.1
"""Stray light is weak beside noise and hides in dark objects: a background that is light, this share of the
data's or more, is taken where the mean square error falls by this share. Beads under stray light: 0.26 and
0.73, and 4.5 dB gained; of 24 scenes without any a background came to 0.07 at most, mostly below zero."""
EVEN_GAIN = 0.3
"""Instead of ``LIGHT_GAIN``, of pictures by a prior that does not mind an even object: their background is
light by what it is expected to be. Dense pictures and textures without stray light fell by 11 to 23 % and
lost 2.6 to 4.6 dB with a background; text and gradients under stray light of twice theirs by 32 and 37 %."""
FLOOR = 0.05
"""Of a picture through one PSF, where nothing else is chosen: a trial is made where its darkest pixels have
this share of the mean. Darker ones leave no room for stray light that is worth one."""


def floor(data: npt.NDArray[Any]) -> float:
    """Return the darkest hundredth of some pixels relative to their mean."""
    mean = float(data.mean(dtype=np.float64))
    return float(np.percentile(data, 1)) / mean if mean > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """A coarse reconstruction without a background and with one, judged by pixels held out.

    Attributes
    ----------
    without, lit : float
        Root mean square error there, in units of noise and usual error of the model.
    light : float
        Mean of the background relative to that of the data.
    """

    without: float
    lit: float
    light: float
    light_gain: float
    """Share by which the square must fall for a background that is light."""

    @property
    def explains(self) -> bool:
        """Whether a background explains what nothing else does."""
        return self.without**2 - self.lit**2 > GAIN

    @property
    def helps(self) -> bool:
        """Whether a background explains what nothing else does, or is light."""
        fall = self.without**2 - self.lit**2
        return self.explains or (self.light >= LIGHT and fall >= self.light_gain * self.without**2)


def trial_of(channels: Sequence[Problem]) -> Trial:
    """Try coarse problems of one channel each; errors are their root mean square."""
    tried = [_tried(channel) for channel in channels]
    without, lit = (
        float(np.sqrt(np.mean([getattr(t, side) ** 2 for t in tried]))) for side in ("without", "lit")
    )
    return Trial(without, lit, float(np.mean([t.light for t in tried])), tried[0].light_gain)


def _tried(problem: Problem) -> Trial:
    data, valid = problem.data[0], problem.valid[0]
    spread2 = max(float(data[valid].var(dtype=np.float64)) - 1, 0.0)
    unit = np.float32(np.sqrt(1 + MODEL_ERROR**2 * spread2))
    unseen = valid & (np.random.default_rng(0).random(valid.shape) < HELD_OUT)
    if not unseen.any():
        unseen = valid
    seen = valid & ~unseen if (valid & ~unseen).any() else valid
    data = data / unit
    coarse = replace(
        problem, data=np.where(seen, data, 0)[None], valid=seen[None], noise=problem.noise * unit
    )

    def tried(smooth: bool, weight: float | None) -> tuple[Pilot, float]:
        own = replace(coarse, smooth=smooth)
        count = PLAIN_ITERATIONS if own.is_plain else ITERATIONS
        found = pilot(own, count, weight=weight, solver="admm")
        left = found.left[0] + np.where(seen, 0, data)  # what was not seen is to be predicted
        error = float(np.sqrt(np.mean(left[unseen].astype(np.float64) ** 2)))
        return found, error

    lit, with_it = tried(True, None)
    _, without = tried(False, lit.weight)  # one prior for both: less light has less of it
    assert lit.background is not None
    light = float(lit.background[0][valid].mean()) / max(float(data[valid].mean()), 1e-30)
    return Trial(without, with_it, light, EVEN_GAIN if expects_background(problem) else LIGHT_GAIN)


def beyond_of(
    trial: Trial | None, again: Trial | None, overrides: Overrides, prevented: str | None
) -> Decision:
    """Decide whether planes beyond the farthest depth take part, where nothing but a background explains.

    Parameters
    ----------
    trial, again : Trial or None
        Without such planes and with them; None where nobody looked.
    overrides : Overrides
        Of the caller, whose wish counts.
    prevented : str or None
        Why there can be none.

    Raises InputError where they are wished for and cannot be had.
    """
    asked = overrides.beyond is not None
    if overrides.beyond and prevented:
        raise InputError(f"Planes cannot be added beyond the depths (beyond=on): {prevented}.")
    if asked or trial is None or again is None:
        why = prevented or ("" if asked else "what the depths leave unexplained asks for none")
        value = "planes" if overrides.beyond else "none"
        return Decision("beyond", value, why, overruled=asked, open=False)
    helps = trial.without**2 - again.without**2 > GAIN
    why = (
        f"on pixels held out a coarse pass misses by {trial.without:.1f} times noise and usual error of the "
        f"model, with planes beyond the farthest depth by {again.without:.1f} times (the square must fall by "
        f"{GAIN:g})"
    )
    numbers = {"held_out_without": trial.without, "held_out_with": again.without}
    up, down = (None, "none") if helps else ("planes", None)
    return Decision("beyond", "planes" if helps else "none", why, up, down, numbers=numbers)


def background_of(trial: Trial | None, overrides: Overrides, *, given: bool) -> Decision:
    """Decide whether a smooth background is estimated as well; ``trial`` None: nobody looked."""
    asked = overrides.background is not None
    if trial is None:
        value = "estimated" if overrides.background else "none"
        why = "a background was given" if given else "the darkest pixels leave no room for stray light"
        return Decision("background", value, "" if asked else why, overruled=asked, open=False)
    why = (
        f"on pixels held out a coarse pass misses by {trial.without:.1f} times noise and usual error of the "
        f"model, with a background by {trial.lit:.1f} times, {trial.light:.0%} of the light (the square must "
        f"fall by {GAIN:g}, or by {trial.light_gain:.0%} where it is {LIGHT:.0%} of the light)"
    )
    numbers = {"held_out_without": trial.without, "held_out_with": trial.lit, "light": trial.light}
    if trial.helps:
        return Decision("background", "estimated", why, down="none", numbers=numbers)
    return Decision("background", "none", why, up="estimated", numbers=numbers)
