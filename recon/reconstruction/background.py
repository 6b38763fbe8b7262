"""Whether a smooth background is estimated as well, by pixels that no pass has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Array
from recon.errors import InputError
from recon.reconstruction.choice import Decision
from recon.reconstruction.options import Overrides
from recon.reconstruction.part import expects_background
from recon.reconstruction.pilot import held_out, pilot
from recon.reconstruction.problem import Problem
from recon.reconstruction.weights import kind_of

ITERATIONS, PLAIN_ITERATIONS = 20, 120
"""Of a trial's passes. The splitting of one convolution without a background begins far from the data, in a
twentieth of the others' time an iteration: with 25 it had the measured hand ask for a background."""
GAIN = 4.0
"""By how much the mean square error of the held-out pixels must fall, in units of noise and usual error.

On the measured USAF target it fell by 20 to 80, with total variation, l1 and non-negativity; on the measured
hand, which a background spoils, by 0.5; on 24 scenes without stray light by 1.4 at most."""
MOST = 0.5
"""And by this share, where the background is no light: of a model that misses by far anything takes so many
units. On the USAF target it fell by 96 %; on the film of an animal (5.5 without, 5.1 with) by 14 %, at -43 %
of the light, which left every other cell's course lost in haze."""
NO_LIGHT = 0.95
"""And by so much in pictures, where it lies below zero: what a smooth negative background explains there is
what a wrong PSF lacks, as a rule, and it takes much of the object along. The hand's PSF cut to 70 % or to a
circle, or 6 % larger: it fell by 59 to 92 %, and 2 to 8 dB were lost; a measured pair less a tenth of its
mean 86 % and 3.4 dB, one by its mirrored PSF 52 % and 1.4 dB. A PSF over light that grows across it: 98.8 to
99.5 %, and 8 to 10 dB were gained; in a circle of 0.3 of the height 95.0 and 96.4 %, and 1.6 dB. Set on
these."""
BELOW_ZERO = 0.15
"""How far a background of a picture that is taken for light may lie below zero, relative to the data's mean.
Two measured pairs less a tenth of their mean have 0.20 and 0.29; light that falls off 0.08 (a measured pair),
0.07 to 0.13 (simulated scenes, where an offset instead was -1.0 to +1.0 dB); simulated stray light 0."""
LIGHT = 0.08
"""Stray light is weak beside noise and hides in dark objects: a background that is light, this share of the
data's or more, is taken where the mean square error falls by ``Taken.fall``. Beads under stray light: 0.26
and 0.73, and 4.5 dB gained, under a fifth as much light as theirs 0.09 to 0.12, and up to 2.4 gained; of
scenes without any a background came to 0.07 at most, mostly below zero, of many beads to 0.13."""
SURE = 0.5
"""Share of ``GAIN`` that the pass without a background is brought down to, where it stops early: what is left
of three channels is their mean."""
BLACK, BRIGHTEST = 0.2, 99.5
"""A pixel is dark below this share of the brightest (percentile)."""


@dataclass(frozen=True, slots=True)
class Taken:
    """When a background is taken that does not explain what nothing else does.

    Attributes
    ----------
    fall : float
        Share by which the mean square error of held-out pixels must fall where the background is light.
    dark, light : float
        Or so much of the picture that is left is dark, and the background is this share of the light: what is
        even is then no object (docs/decisions/0126-stray-light-over-dark-scenes.md).
    """

    fall: float
    dark: float = 2.0
    light: float = 0.0


VOLUME, LIT_PICTURE, POINTS = Taken(0.1), Taken(0.3, 0.68, 0.18), Taken(0.1, 0.93, 0.32)
"""Volumes but by l1, pictures by priors that do not mind an even object, and what l1 shows. The second's
background is light by what it is expected to be: dense pictures and textures without stray light fell by
11 to 23 % and lost 2.6 to 4.6 dB with one; text and gradients under stray light of twice theirs fell by 32
and 37 %. Text, threads, lights and strokes come out 0.66 dark and more, leaves and textures at most 0.65.
With l1 these come to 0.92, and text loses by a background as well: points, strokes and most threads come
to 0.93 and more. Of volumes those by l1 are points (0239): dark for 0.97 and more, without stray light up
to 0.29 of the light."""
FLOOR, FLOOR_PERCENTILE = 0.08, 10
"""Of a picture through one PSF, where nothing else is chosen: a trial is made where this percentile of its
block means has this share of the mean (the measured hand 0.07, under half as much stray light 0.25 and
more). A darker tenth leaves no room for stray light that is worth a trial."""
DARKEST, DARKEST_PERCENTILE = 0.05, 1
"""There, where this percentile has less of the mean, held-out pixels prove nothing of stray light: of a
measured photograph whose darkest hundredth has 0.02 the error fell by 31 to 49 %, and 4.2 dB were lost."""


def floor(data: Array, percentile: float = FLOOR_PERCENTILE) -> float:
    """Return the darkest part of some block means relative to their mean."""
    mean = float(data.mean(dtype=np.float64))
    return float(np.percentile(data, percentile)) / mean if mean > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """A coarse reconstruction without a background and with one, judged by pixels held out.

    Attributes
    ----------
    without, lit : float
        Root mean square error there, in units of noise and usual error of the model; without a background
        at most, where the pass ended as soon as it was small enough.
    light : float
        Mean of the background relative to that of the data.
    dark : float
        Share of the picture that is dark where a background is taken out; ``taken`` says what it proves.
    taken : Taken
    dim : bool
        Whether the darkest pixels leave hardly any room for stray light.
    least : float
        Least of the background where it is expected to be light (0 where it is not, or nowhere negative),
        relative to the mean of the data: what pulls it below zero is the object.
    picture : bool
        Whether it is of one plane.
    """

    without: float
    lit: float
    light: float
    dark: float
    taken: Taken
    dim: bool = False
    least: float = 0.0
    picture: bool = False

    def asks(self, share: float = 1.0) -> bool:
        """Whether held-out pixels ask for a background: it explains (``share`` of it asked), or is light."""
        fall = self.without**2 - self.lit**2
        is_light = not self.dim and self.least >= 0 and self.light >= LIGHT
        return self._explains(share) or (is_light and fall >= self.taken.fall * self.without**2)

    def _explains(self, share: float) -> bool:
        fall = self.without**2 - self.lit**2
        below = self.picture and (self.light < 0 or self.least < -BELOW_ZERO)
        most = NO_LIGHT if below else MOST
        return fall > share * GAIN and fall >= share * most * self.without**2

    @property
    def explains(self) -> bool:
        """Whether a background explains what nothing else does."""
        return self._explains(1.0)

    @property
    def helps(self) -> bool:
        """Whether a background explains what nothing else does, is light, or lies over a dark scene."""
        is_light = self.least >= 0 and self.light >= self.taken.light
        return self.asks() or (self.dark >= self.taken.dark and is_light)


def trial_of(channels: Sequence[Problem], *, whole: bool = False) -> Trial:
    """Try coarse problems of one channel each; errors are their root mean square.

    The pass without a background of a single channel ends where what it explains leaves nothing to one,
    unless it is to be compared with others: ``whole``. Several channels are judged together: the bound of
    one that ended early would count against the others (two measured colour pairs lost 1.2 and 2.3 dB).
    """
    tried = [_tried(channel, whole=whole or len(channels) > 1) for channel in channels]
    without, lit = (
        float(np.sqrt(np.mean([getattr(t, side) ** 2 for t in tried]))) for side in ("without", "lit")
    )
    light, dark, least = (
        float(np.mean([getattr(t, side) for t in tried])) for side in ("light", "dark", "least")
    )
    return Trial(without, lit, light, dark, tried[0].taken, least=least, picture=tried[0].picture)


def _tried(problem: Problem, *, whole: bool) -> Trial:
    coarse, error = held_out(problem)
    valid, mean = (
        problem.valid[0],
        float(problem.data[0][problem.valid[0]].mean()) * float(problem.noise[0] / coarse.noise[0]),
    )
    lit = pilot(replace(coarse, smooth=True), ITERATIONS, solver="admm")
    assert lit.background is not None
    light = float(lit.background[0][valid].mean()) / max(mean, 1e-30)
    rows, columns = problem.window
    picture = lit.solution[0, :, rows, columns]
    dark = float(np.mean(picture < BLACK * np.percentile(picture, BRIGHTEST)))
    taken = LIT_PICTURE if expects_background(problem) else POINTS
    if problem.n_planes > 1 and kind_of(problem.prior_name) != "l1":
        taken = VOLUME
    expected = taken is LIT_PICTURE
    least = min(0.0, float(lit.background[0][valid].min()) / max(mean, 1e-30)) if expected else 0.0
    one = problem.n_planes == 1
    trial = Trial(np.inf, error(lit.left), light, dark, taken, least=least, picture=one)
    plain = replace(coarse, smooth=False)
    # One prior for both: less light has less of it.
    found = pilot(
        plain,
        PLAIN_ITERATIONS if plain.is_plain else ITERATIONS,
        weight=lit.weight,
        solver="admm",
        enough=None if whole else lambda left: not replace(trial, without=error(left)).asks(SURE),
    )
    return replace(trial, without=error(found.left))


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
        f"held-out pixels are missed by {trial.without:.1f} times the error to expect, with planes beyond "
        f"the farthest depth by {again.without:.1f} times{'' if helps else ': too little for them'}"
    )
    numbers = {"held_out_without": trial.without, "held_out_with": again.without}
    up, down = (None, "none") if helps else ("planes", None)
    return Decision("beyond", "planes" if helps else "none", why, up, down, numbers=numbers)


def background_of(trial: Trial | None, overrides: Overrides, *, given: bool) -> Decision:
    """Decide whether a smooth background is estimated as well; ``trial`` None: nobody looked."""
    asked = overrides.background is not None
    if trial is None:
        value = "estimated" if overrides.background else "none"
        why = "a background was given" if given else "the darkest tenth leaves no room for stray light"
        return Decision("background", value, "" if asked else why, overruled=asked, open=False)
    why = (
        f"held-out pixels are missed by {trial.without:.1f} times the error to expect, with a background of "
        f"{trial.light:.0%} of the light by {trial.lit:.1f} times"
    )
    if not trial.helps and replace(trial, least=0.0).helps:
        why += ", which falls below zero: no light"
    elif not trial.helps:
        why += ": too little for one"
    elif not trial.asks():
        why += f", and {trial.dark:.0%} of the picture would be dark under it"
    numbers = {
        "held_out_without": trial.without,
        "held_out_with": trial.lit,
        "light": trial.light,
        "dark": trial.dark,
        "least": trial.least,
    }
    if trial.helps:
        return Decision("background", "estimated", why, down="none", numbers=numbers)
    return Decision("background", "none", why, up="estimated", numbers=numbers)
