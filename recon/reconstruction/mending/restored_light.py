"""Photographs that light through their PSF cannot explain: light is given back, or a few places left out.

They may be darker than any light through their PSF. The first iterations explain them with light below zero;
as that is driven out, the residual rises, and the picture takes the error. A smooth background explains them
as well, and much of the picture with it. What they lack is looked for where it may have gone, in few numbers:
places that nothing explains (docs/decisions/0294), light that falls off towards the edges, which the PSF's
did not (docs/decisions/0283), else an even offset, as of too large a dark level (docs/decisions/0276), the
least that explains the photograph as far as calibrated cameras do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from recon.arrays import BoolArray, Float32Array, Float64Array
from recon.base.blocks import whole_blocks
from recon.camera.camera_model import CAMERAS
from recon.camera.vignetting import DEEPEST, least_squares, shade_of
from recon.priors import Prior
from recon.reconstruction.background import DARKEST_PERCENTILE, floor
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.mending import odd_places
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.pilot import MODEL_ERROR, pilot
from recon.reconstruction.problem import Problem
from recon.reconstruction.reduction import on_blocks, reduced_calibration
from recon.reconstruction.solvers import SOLVERS

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
    small, _ = _on_blocks(problem, LONGEST_PX)
    if small is None or small.mean <= 0 or not small.lacks(given := small.left2(0.0)):
        return problem
    finer, factor = _on_blocks(problem, odd_places.LONGEST_PX)
    if finer is not None:
        odd = odd_places.odd_places(finer.channels, 1 + finer.usual2, LOOKED)
        if odd is not None:
            return _without(problem, odd_places.on_pixels(odd, factor, problem.sensor_shape))
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


def _on_blocks(problem: Problem, longest_px: int) -> tuple[_Small | None, int]:
    """Return the channels on blocks of pixels, and their side; None where erased pixels leave too few."""
    most = max(1, -(-max(problem.sensor_shape) // longest_px))
    factor = whole_blocks(problem.valid, most)
    if factor < most // 2:
        return None, factor
    return _Small([_small(problem, c, factor) for c in range(problem.n_channels)]), factor


def _without(problem: Problem, odd: BoolArray) -> Problem:
    """Return a problem without some of its pixels, which is told."""
    measurement, erased = problem.measurement, ~problem.valid | odd
    share = float(np.mean(erased & problem.valid))
    return _restored(
        problem,
        replace(
            measurement,
            erasures=erased[0] if problem.flat else np.moveaxis(erased, 0, -1),
            found={**measurement.found, "left_out": share},
        ),
        f"{share:.1%} of the photograph's pixels are left out: no light through the PSF explains them, and "
        "all others are explained without them. As a rule they are dust on the sensor, a reflection or "
        "light from beside the diffuser.",
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
