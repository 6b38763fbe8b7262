"""Whether a smooth background is estimated as well, by pixels that no pass has seen, or light given back.

Photographs may be darker than any light through their PSF. The first iterations explain them with light below
zero; as that is driven out, the residual rises, and the picture takes the error. A smooth background explains
them as well, and much of the picture with it. What they lack is looked for where it may have gone, in few
numbers: light that falls off towards the edges, which the PSF's did not (docs/decisions/0283), else an even
offset, as of too large a dark level (docs/decisions/0276), the least that explains the photograph as far as
calibrated cameras do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.blocks import whole_blocks
from recon.camera.camera_model import CAMERAS
from recon.camera.vignetting import DEEPEST, least_squares, shade_of
from recon.errors import InputError
from recon.priors import Prior
from recon.reconstruction.choice import Decision
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.part import expects_background
from recon.reconstruction.pilot import MODEL_ERROR, held_out, pilot
from recon.reconstruction.problem import Problem
from recon.reconstruction.reduction import on_blocks, reduced_calibration
from recon.reconstruction.solvers import SOLVERS
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


LONGEST_PX, LOOKED = 64, 120
"""Pixels and iterations of the copies that an offset is looked for on: it has no details. With 25 iterations
light below zero is still there."""
MOST_OFFSET = 0.6
"""Largest offset, relative to the photograph's mean: anything is light with more."""
EXPLAINS = 2.0
"""Residual in units of the noise, with the largest offset, up to which an offset is what was lacking: 1.2 to
1.4 of photographs with too much taken off or light falling off, 3.9 where the PSF stands on uneven light."""
HALVINGS = 5
"""Of the range in which the least offset lies: to a fiftieth of the mean."""
SHADE_ITERATIONS = 60
"""Of each reconstruction of a small copy. With 30 light below zero is still there, and shades are deeper."""
SHADE_HALVINGS = 4
"""Of a shade's numbers."""
TELLING = 1.1
"""By how much what is left falls, in units of what calibrated cameras leave, a unit of the logarithm of the
darkest corner, from which a shade is what lacked. Photographs that were shaded: 1.5 to 2.7 (six measured
pairs), 4.9 and 5.7 (the hand). Three pairs with a tenth too much taken off 0.66 to 0.69; the hand and another
pair are explained by no shade. A deep one explains nearly anything."""
PEDESTAL = 0.1
"""Darkest hundredth of a PSF, relative to its mean, from which it may stand on an even offset: that casts
light which falls off, where the photograph's does not. The hand's, the USAF target's and the pairs' have
0.00, with an offset of a fiftieth of their peak 0.15 to 0.36."""
LEAST_OFFSET = 0.03
"""Offset, relative to the photograph's mean, from which one is added: two channels of the seven measured
pairs come to 0.02."""


def with_light_restored(problem: Problem, *, offset: bool = True) -> Problem:
    """Return a problem of a picture whose data were given what they lack, where few numbers tell that.

    The problem itself where nothing is missing, and where somebody said what the background is or how light
    falls off, the light is patterned, PSFs vary over the field, or the prior or solver takes light below
    zero; and where erased pixels all over it leave no small copy: on the whole sensor that would take long.

    Parameters
    ----------
    problem : Problem
    offset : bool
        Whether an even offset may be what lacks: not where a smooth background which is light explains it.
    """
    options, measurement = problem.options, problem.measurement
    found = measurement.found
    said = options.estimate_background is not None or measurement.background is not None
    said = said or (options.choose is not None and options.choose.background is not None)
    said = said or measurement.vignetting is not None
    if said or options.positive_background or problem.patterned or problem.n_planes > 1:
        return problem
    if problem.depths.varies or problem.model in CAMERAS:
        return problem
    one_step = options.solver != "auto" and SOLVERS.named(options.solver).one_step
    if isinstance(problem.prior, Prior) or one_step:
        return problem
    most = max(1, -(-max(problem.sensor_shape) // LONGEST_PX))
    factor = whole_blocks(problem.valid, most)
    if factor < most // 2:
        return problem
    small = _Small([_small(problem, c, factor) for c in range(problem.n_channels)])
    if small.mean <= 0 or not small.lacks(given := small.left2(0.0)):
        return problem
    explained = small.left2(MOST_OFFSET)
    if not small.lacks(given, explained):
        return problem
    if (numbers := _shade_of(small, given)) is not None:
        shade = shade_of(numbers, problem.sensor_shape)
        return _restored(
            problem,
            replace(measurement, vignetting=shade, found={**found, "shade": numbers.tolist()}),
            f"The photograph's light falls off (to {float(shade.min()):.0%} in its darkest corner), and its "
            "PSF's does not: it was divided by the fall-off that was fitted to it. As a rule a lens or an "
            "aperture casts the shade.",
        )
    share = _offset_of(small, explained) if offset else 0.0
    if not share:
        return problem
    counts = share * small.mean
    return _restored(
        problem,
        replace(measurement, background=-counts, found={**found, "added_counts": counts}),
        f"The photograph is darker than light through its PSF can be: {counts:.3g} counts ({share:.0%} of "
        "its mean) were added. As a rule too much was taken off as its dark level (--dark), or its light "
        "falls off as the PSF's does not.",
    )


def _restored(problem: Problem, measurement: Measurement, words: str) -> Problem:
    restored = Problem.of(measurement, problem.calibration, problem.options, extent=problem.extent)
    told = f"{words} --no-background leaves it as it is."
    return replace(restored, warnings=(*problem.warnings, told))


class _Small:
    """The channels on few pixels, what usual errors leave of them, and what they leave by themselves."""

    def __init__(self, channels: Sequence[Problem]) -> None:
        self.channels = channels
        self.noise = np.array([c.noise[0] for c in channels], np.float64)
        used = [c.data[c.valid].astype(np.float64) for c in channels]
        self.mean = float(np.mean(self.noise * [u.mean() for u in used]))
        """Counts."""
        self.usual2 = np.array([MODEL_ERROR**2 * max(u.var() - 1, 0.0) for u in used])
        """Besides noise, in its units."""

    def left2(self, share: float) -> Float64Array:
        """Return the mean squares that they leave with an offset, relative to their mean."""
        each = zip(self.channels, self.noise, strict=True)
        return np.array([_left2(c, share * self.mean / n) for c, n in each])

    def beyond(self, left2: Float64Array, least: Float64Array | float = 0.0) -> float:
        """Return mean squares beyond the least in units of what calibrated cameras leave."""
        return float(np.mean((left2 - least) / (1 + self.usual2)))

    def lacks(self, left2: Float64Array, least: Float64Array | float = 0.0) -> bool:
        """Whether that is more than they leave."""
        return self.beyond(left2, least) > 1


def _shade_of(small: _Small, given: Float64Array) -> Float64Array | None:
    """Return the numbers of the least shade by which the channels are explained as a rule; None: none is.

    None where the PSF stands on an offset, too: what that lacks looks like a shade. One for all, fitted to
    the channel that has most contrast. More shade is explained as well as a rule, by an object that is
    brighter towards its edges; and where something else lacks, only by a deep one.

    Parameters
    ----------
    small : _Small
    given : ndarray
        Mean squares that the channels leave as they are.
    """
    most = int(np.argmax(small.usual2))
    shape = small.channels[most].sensor_shape
    if floor(small.channels[most].calibration.psfs, DARKEST_PERCENTILE) > PEDESTAL:
        return None
    numbers = _shade_fitted(small.channels[most], 1 + float(small.usual2[most]))
    if numbers is None:
        return None

    def left2(share: float) -> Float64Array:
        shade = shade_of(share * numbers, shape)
        each = [np.mean(_shade_left(c, shade, LOOKED)[c.valid[0]] ** 2) for c in small.channels]
        return np.array(each, np.float64)

    explained = left2(1.0)
    if small.lacks(explained) and float(np.mean(explained)) > EXPLAINS**2:
        return None
    spared = explained if small.lacks(explained) else 0.0
    share = _least(lambda share: small.lacks(left2(share), spared), 1.0, SHADE_HALVINGS)
    fallen = small.beyond(given) ** 0.5 - max(small.beyond(explained), 1.0) ** 0.5
    least = shade_of(share * numbers, shape).min()
    return share * numbers if fallen > -TELLING * float(np.log(least)) else None


def _shade_fitted(channel: Problem, usual2: float) -> Float64Array | None:
    """Return the numbers of the shade through which a small copy's PSF explains it best (:func:`shade_of`).

    None where it would be as deep as can be: so is what stray light is taken for.

    Parameters
    ----------
    channel : Problem
        One channel on few pixels, a picture through one PSF.
    usual2 : float
        Mean square that a calibrated camera leaves of it as a rule, noise included, in units of the noise.
    """

    def left(numbers: Float64Array) -> Float64Array:
        shade = shade_of(numbers, channel.sensor_shape)
        return _shade_left(channel, shade, SHADE_ITERATIONS).ravel() / float(usual2**0.5)

    def is_deepest(numbers: Float64Array) -> bool:
        return bool(shade_of(numbers, channel.sensor_shape).min() <= np.float32(DEEPEST))

    return least_squares(left, is_deepest)


def _shade_left(channel: Problem, shade: Float32Array, iterations: int) -> Float64Array:
    """Return what a channel under a shade leaves of its data, (height, width), in units of the noise."""
    found = pilot(replace(channel, data=channel.data / shade), iterations)
    left: Float64Array = np.where(channel.valid[0], found.left[0].astype(np.float64) * shade, 0)
    return left


def _least(lacks: Callable[[float], bool], most: float, halvings: int) -> float:
    """Return the least number, up to one that serves, with which nothing lacks."""
    low, high = 0.0, most
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (middle, high) if lacks(middle) else (low, middle)
    return high


def _offset_of(small: _Small, explained: Float64Array) -> float:
    """Return the least offset by which the channels leave what the largest leaves, relative to their mean.

    One number for all: a dark level is the camera's. 0 where the largest explains nothing.
    """
    if float(np.mean(explained)) > EXPLAINS**2:
        return 0.0
    least = _least(lambda share: small.lacks(small.left2(share), explained), MOST_OFFSET, HALVINGS)
    return least if least >= LEAST_OFFSET else 0.0


def _left2(channel: Problem, offset: float) -> float:
    """Return the mean square that a channel leaves with an offset, both in units of its noise."""
    data = np.where(channel.valid, channel.data + np.float32(offset), 0)
    left = pilot(replace(channel, data=data), LOOKED).left[channel.valid]
    return float(np.mean(left.astype(np.float64) ** 2))


def _small(problem: Problem, channel: int, factor: int) -> Problem:
    """Return a channel on blocks of so many pixels a side."""
    own = slice(channel, channel + 1)
    calibration = replace(problem.calibration, background=None)
    if calibration.psfs.shape[1] > 1:
        calibration = replace(calibration, psfs=calibration.psfs[:, own])
    counts = problem.data[own] * problem.noise[channel]
    return Problem.of(
        on_blocks(counts, problem.valid[own], None, factor, flat=True),
        reduced_calibration(calibration, factor, None),
        ReconstructionOptions(model="convolution", estimate_background=False),
    )
