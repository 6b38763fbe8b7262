"""How far a reconstruction may be off its scene, pixel by pixel: errors of pictures whose truth is known.

A repetition with other noise tells less than half: the larger part of a picture's error is what the prior and
the camera's resolution keep from it, and a picture that has lost its detail already loses little more when it
is photographed and reconstructed again. Shrunk by as much as the camera resolves, however, a picture has
detail as fine as its scene, for scenes look alike at many scales. So the picture, shrunk and laid side by
side and mirrored over the field, is put through the same camera, with what the first reconstruction left of
its data as noise (turned, mirrored, moved), and reconstructed in the same way: how far that is off what was
put in, at each place of the picture, is the error to expect there: the equivariant bootstrap (Tachella and
Pereyra 2024, AISTATS) in the group of scales. How much detail the data's spectrum has that the picture lacks
tells of the error's size as well; all deviations go by both (:data:`BY_SPECTRUM`).

What neither the picture nor the data's spectrum shows cannot be known: detail far below the camera's
resolution, and points of light. The result says so (``docs/benchmarks/uncertainty.md``).
"""

from __future__ import annotations

import threading
import time
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist

import numpy as np

from recon.analysis.resolution import lateral_resolution
from recon.arrays import Array, Float32Array
from recon.base.blocks import block_mean
from recon.base.declare import settled
from recon.errors import InputError
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.point_errors import PointErrors, points_of, points_problem
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import solve

REPEATS = 6
"""Each has a place of the picture four times or more."""
SHRINKS = (2, 4)
"""The least and the most."""
RINGS = 12
"""Of frequencies, from none to half of one a pixel; those in the corners are one more."""
FALLS = (-4.0, -1.5)
"""How steeply a scene's power can fall with frequency: between smooth shades and lights on black."""
TELLS = 0.5
"""A ring tells of the scene's power where chance moves it by less than this share."""
SMOOTH_PX = 1.0
"""Variances are averaged over neighbours: 24 errors alone would scatter by 15 %."""
BY_SPECTRUM, TIMES = 0.8, 1.55
"""Power of the error that the data's spectrum shows in the deviations, the repetitions' having the rest, and
how many times as large they are then: fitted to 95 % intervals of 72 scenes (seeds 12 and 13)."""
SPECTRUM = (0.2, 3.5)
"""Error by the spectrum beside that of the repetitions, at least and at most."""
POINTS = 1.4
"""Mean slope of a picture, relative to its mean, from which it is nothing but points."""
EXPLAINED = 2.0
"""Residual over noise up to which intervals held what they promise (``benchmarks/uncertainty.py``)."""


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How far a reconstruction may be off.

    Attributes
    ----------
    deviation : ndarray, float32, shaped as the volume
        Standard deviation of ``volume - truth``, bias by the prior included, in the volume's units.
    repeats : int
        Reconstructions that it was made from.
    misfit : float
        Residual over noise of the reconstruction.
    seconds : float
    finest_px : float
        Half a period of the finest detail that the data tell of: pixels.
    resolved_px : float
        What the camera resolves: width of its PSF's autocorrelation.
    steepness : float
        Mean slope of the picture relative to its mean, 1 / pixel.
    points : PointErrors or None
        Of grey pictures by a prior that counts light (l1): their points, with error bars.
    wrong_calibration : bool
        Whether the verdict found that the calibration does not fit the photograph.
    """

    deviation: Float32Array
    repeats: int
    misfit: float
    seconds: float
    finest_px: float
    resolved_px: float
    steepness: float
    points: PointErrors | None = None
    wrong_calibration: bool = False

    @property
    def trusted(self) -> bool:
        """Whether intervals are known to hold what they promise for such pictures."""
        return not self.doubt

    @property
    def sentences(self) -> tuple[str, ...]:
        """What it is."""
        said = f"deviation from {self.repeats} pictures of known truth, bias by the prior included; 95 %"
        said = f"{said} intervals are the picture plus and minus 1.96 deviations"
        said = (
            f"{said}. The data tell of detail down to {self.finest_px:.2g} pixels; finer may be off by more."
        )
        return (said,) if self.points is None else (said, f"{self.points.words}.")

    @property
    def doubt(self) -> tuple[str, ...]:
        """Why not to trust it; empty where it can be."""
        said = []
        if self.wrong_calibration:
            said.append("the calibration does not fit this photograph, which they take for right")
        if self.misfit > EXPLAINED:
            said.append(
                f"the data are off the model by {self.misfit:.1f} times the noise, so that the picture is "
                "wrong in ways that they do not know of. Find a calibration, camera model or background that "
                "explains the data first"
            )
        if not self.resolved_px <= SHRINKS[1] - 1:
            said.append(
                f"the camera resolves {self.resolved_px:.1f} pixels, and what finer detail is off by nobody "
                f"can tell. Bin the images, so that it is {SHRINKS[1] - 1} pixels or less"
            )
        if self.steepness > POINTS:
            said.append(
                "the picture is nothing but points of light. Reconstruct it by the prior l1, and read the "
                "points' error bars"
            )
        return tuple(f"The deviations are not to be trusted: {why}." for why in said)

    def interval(self, volume: Array, level: float = 0.95) -> tuple[Float32Array, Float32Array]:
        """Return the lower and upper ends, shaped as the volume, that hold the truth with some probability.

        Raises InputError when ``level`` is no probability.
        """
        if not 0 < level < 1:
            raise InputError(f"The level of an interval is between 0 and 1, not {level:g}.")
        reach = np.float32(NormalDist().inv_cdf((1 + level) / 2)) * self.deviation
        return np.maximum(volume - reach, np.minimum(volume, 0)), volume + reach


def uncertain(
    result: Reconstruction,
    problem: Problem,
    *,
    on_stage: Stage | None = None,
    cancel: threading.Event | None = None,
) -> Reconstruction:
    """Return the result with its uncertainty, at the cost of :data:`REPEATS` further reconstructions.

    Parameters
    ----------
    result : Reconstruction
        As :func:`~recon.reconstruction.solve.solve` returned it.
    problem : Problem
        That was solved.
    on_stage : callable, optional
        ``on_stage(share, what)`` after each repetition.
    cancel : threading.Event, optional
        Set it to leave the uncertainty out; the result then says so.
    """
    began = time.monotonic()
    solved, small = result.basis or (problem, result)
    interrupted = "No uncertainty: it was interrupted before the repetitions were done."
    with closing(Replicas(solved, small)) as replicas:
        total = np.zeros(small.volume.shape)
        for number in range(REPEATS):
            total += replicas.squared_error(number, replicas.shrink, cancel)
            if cancel is not None and cancel.is_set():
                return replace(result, warnings=(*result.warnings, interrupted))
            if on_stage is not None:
                done = number + 1
                on_stage(done / REPEATS, f"uncertainty: repetition {done} of {REPEATS}")
    deviation = replicas.deviation(total / REPEATS)
    binning = 1 if solved.choice is None else solved.choice.binning
    if solved.reduction is not None:
        deviation = solved.reduction.volume(deviation)
    fitted = points_problem(solved)
    points = None if fitted is None else points_of(result, fitted, cancel)
    if cancel is not None and cancel.is_set():
        return replace(result, warnings=(*result.warnings, interrupted))
    found = Uncertainty(
        deviation,
        REPEATS,
        replicas.misfit,
        time.monotonic() - began,
        replicas.finest_px * binning,
        replicas.resolved_px,
        replicas.steepness,
        points,
    )
    return replace(result, uncertainty=found, warnings=(*result.warnings, *found.doubt))


def refused(problem: Problem) -> str | None:
    """Say why there is no uncertainty of a problem; None where there is."""
    if problem.n_planes > 1:
        return "uncertainty is for pictures: leave it out, or give one depth by --z-mm"
    return "uncertainty is for photographs in one light: leave it out" if problem.patterned else None


class Replicas:
    """Measurements of scenes that look like a result, reconstructed in the same way.

    Parameters
    ----------
    problem : Problem
        That was solved.
    result : Reconstruction
        Its own.

    Attributes
    ----------
    misfit : float
        Residual over noise of the result, of the channel where it is largest.
    """

    def __init__(self, problem: Problem, result: Reconstruction) -> None:
        count = max(map(len, result.histories))
        options = settled(
            problem.options, iterations=count or None, time_s=None, judged=False, stop_at_noise=False
        )
        self._problem = replace(
            problem,
            options=options,
            extent=replace(problem.extent, left_out=None),
            reduction=None,
            choice=None,
        )
        self._result = result
        self._parts = [Part(self._problem, channels) for channels in parts_of(problem)]
        self._objects = [self._placed(part, result) for part in self._parts]
        fits = [self._fit(part, object_) for part, object_ in zip(self._parts, self._objects, strict=True)]
        self._background = np.concatenate([smooth for smooth, _ in fits])
        rest = np.concatenate([left for _, left in fits])
        self._explained = problem.data - rest
        size = np.sqrt((rest**2).sum(axis=(1, 2)) / np.count_nonzero(problem.valid, axis=(1, 2)))
        self.misfit = float(size.max())
        # A fit takes some of the noise along. Erased pixels have as much: turned, they fall on others.
        self._rest = rest * np.maximum(1, 1 / size)[:, None, None]
        # Noise grows where a shade was divided by: what falls elsewhere is to grow there.
        shade = problem.shade
        self._grown = np.float32(1) if shade is None else 1 / shade
        self._rest = self._rest / self._grown
        rng = np.random.default_rng(0)
        for left, valid in zip(self._rest, problem.valid, strict=True):
            left[~valid] = rng.choice(left[valid], np.count_nonzero(~valid))

    def close(self) -> None:
        """Remove what the parts kept on disk."""
        for part in self._parts:
            part.close()

    def _placed(self, part: Part, like: Reconstruction) -> Array:
        shape = part.camera.domain_shape
        return self._problem.start(like, part.channels, (shape[2], shape[3]))

    def _fit(self, part: Part, object_: Array) -> tuple[Array, Array]:
        """Return smooth background and residual of the result."""
        smooth = part.background(object_) if self._problem.smooth else np.zeros_like(part.data)
        return smooth, part.residual(object_, smooth)

    @property
    def resolved_px(self) -> float:
        """What the camera resolves, the width of its PSF's autocorrelation: pixels of the problem."""
        return float(lateral_resolution(self._problem.depths.central[0].mean(axis=0)).mean_px)

    @property
    def shrink(self) -> int:
        """How much smaller scenes are than what the camera resolves."""
        px = self.resolved_px
        return int(np.clip(1 + np.ceil(px), *SHRINKS)) if np.isfinite(px) else SHRINKS[1]

    @property
    def steepness(self) -> float:
        """Mean slope of the picture relative to its mean, 1 / pixel."""
        pictures = np.maximum(_channels_first(self._result.volume), 0)
        slope = np.hypot(*np.gradient(pictures, axis=(1, 2)))
        return float(slope.mean() / max(float(pictures.mean()), 1e-30))

    def squared_error(self, seed: int, times: int, cancel: threading.Event | None = None) -> Array:
        """Reconstruct one such scene; return the squared error at the places of the result, shaped as it."""
        rng = np.random.default_rng(seed)
        mosaic = Mosaic.drawn(rng, self._result.grid.shape[1:], times)
        truth = _channels_last(mosaic.laid(_channels_first(self._result.volume)), self._result.volume)
        data = self._photograph(truth, rng)
        found = solve(replace(self._problem, data=data), cancel=cancel).volume
        error = np.asarray(found, np.float64) - truth
        return _channels_last(mosaic.gathered(_channels_first(error**2)), error)

    def deviation(self, squared_error: Array) -> Float32Array:
        """Return standard deviations from a mean squared error, smooth, and as the spectrum has it."""
        variance = smoothed(squared_error)
        channels = np.maximum(_channels_first(variance).mean(axis=(1, 2)), np.finfo(float).tiny)
        by_spectrum = np.clip(np.sqrt(self.missing() / channels), *SPECTRUM) ** BY_SPECTRUM
        return np.asarray(TIMES * by_spectrum * np.sqrt(variance), np.float32)

    def missing(self) -> Array:
        """Return the mean square of the detail that the data have and the result lacks, a channel.

        Both data and what the result explains of them have a spectrum. Ring by ring of frequencies, the ratio
        of their powers, the noise taken off, is how much more power the scene has than the result, though no
        single frequency of it stands out of the noise. Beyond the last ring that tells, the scene's power is
        taken to go on as it falls up to there, and the ratio not to fall.
        """
        pictures = _channels_first(self._result.volume)
        return np.array([_missing(*s, p) for s, p in zip(self._spectra, pictures, strict=True)])

    @property
    def finest_px(self) -> float:
        """Half a period of the last ring of frequencies that the data tell of, in any channel: pixels."""
        return RINGS / max(last + 0.5 for _, last in self._spectra)

    @cached_property
    def _spectra(self) -> list[tuple[Array, int]]:
        """Return by channel what :func:`_power_ratio` finds."""
        taper = np.multiply.outer(*(np.hanning(n + 2)[1:-1] for n in self._rest.shape[1:]))
        both = zip(self._problem.data, self._explained, strict=True)
        return [_power_ratio(_rings(data * taper), _rings(fit * taper)) for data, fit in both]

    def _photograph(self, scene: Array, rng: np.random.Generator) -> Float32Array:
        """Return data of a scene in the window; what lies beyond it stays as it was found."""
        like = replace(self._result, volume=scene.astype(np.float32), state=None)
        rows, columns = self._problem.window
        seen = []
        for part, object_ in zip(self._parts, self._objects, strict=True):
            other = object_.copy()
            other[:, :, rows, columns] = self._placed(part, like)[:, :, rows, columns]
            seen.append(part.camera.forward(other))
        turns = rng.choice([-1, 1], 3)
        by = [int(rng.integers(n)) for n in self._rest.shape[1:]]
        noise = turns[0] * np.roll(self._rest[:, :: turns[1], :: turns[2]], by, axis=(1, 2))
        data = np.concatenate(seen) + self._background + noise * self._grown
        return np.where(self._problem.valid, data, 0).astype(np.float32)


def _rings(image: Array) -> tuple[Array, Array]:
    """Return the power of an image in rings of frequencies from 0 outwards, and how many are in each."""
    height, width = image.shape
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)
    ring = np.minimum((np.hypot(rows, columns) * 2 * RINGS).astype(int), RINGS).ravel()
    twice = np.full((height, columns.size), 2.0)  # what a real image's half of a spectrum leaves out
    twice[:, 0] = 1
    if width % 2 == 0:
        twice[:, -1] = 1
    twice[0, 0] = 0
    power = twice * np.abs(np.fft.rfft2(image)) ** 2
    counts = np.bincount(ring, twice.ravel(), RINGS + 1)
    return np.bincount(ring, power.ravel(), RINGS + 1), counts


def _power_ratio(data: tuple[Array, Array], explained: tuple[Array, Array]) -> tuple[Array, int]:
    """Return ring by ring how much more power the scene has than the result, and the last that tells."""
    (seen, counts), (fit, _) = data, explained
    each = seen / np.maximum(counts, 1)
    noise = each.min()
    fit = np.maximum(fit, 1e-12 * (fit.max() or seen.max() or 1))  # an empty picture explains nothing
    ratio = np.maximum((each - noise) * counts / fit, 1)
    told = np.sqrt(2 / np.maximum(counts, 1)) * seen / fit < TELLS
    told[0] = True  # a few frequencies: chance moves it, whatever the noise
    last = RINGS if told.all() else int(np.argmin(told)) - 1
    ratio[last + 1 :] = ratio[last]
    return ratio, last


def _missing(ratio: Array, last: int, picture: Array) -> float:
    """Return the mean square of what a picture lacks where the scene's power is so many times its own."""
    power, counts = _rings(picture)
    each = np.maximum(ratio * power / np.maximum(counts, 1), 1e-30)
    if last < RINGS:
        told = np.arange(min(1, last), last + 1)
        frequency, density = np.log(np.arange(RINGS + 1) + 0.5), np.log(each[told])
        fall = -3.0
        if last > 1:
            fall = float(np.polyfit(frequency[told], density, 1, w=np.sqrt(counts[told]))[0])
        fall = float(np.clip(fall, *FALLS))
        level = float(np.mean(density - fall * frequency[told]))
        each[last + 1 :] = np.maximum(each[last + 1 :], np.exp(level + fall * frequency[last + 1 :]))
    return max(float(np.sum(each * counts - power)), 0.0) / picture.size**2


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A picture several times smaller, side by side and mirrored.

    Attributes
    ----------
    shape : (int, int)
        Of the picture.
    times : int
        How much smaller; 1 for the picture itself.
    first : (int, int)
        Pixels by which it is moved (around its borders) before blocks are averaged.
    mirrored : (int, int)
        Whether the first tile is, along rows and columns; its neighbours are the other way.
    """

    shape: tuple[int, int]
    times: int
    first: tuple[int, int]
    mirrored: tuple[int, int]

    @classmethod
    def drawn(cls, rng: np.random.Generator, shape: tuple[int, int], times: int) -> Mosaic:
        """Draw one."""
        first, mirrored = rng.integers(0, times, 2), rng.integers(0, 2, 2)
        return cls(shape, times, (int(first[0]), int(first[1])), (int(mirrored[0]), int(mirrored[1])))

    @property
    def _tile(self) -> tuple[int, int]:
        return self.shape[0] // self.times, self.shape[1] // self.times

    def _tiles(self) -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
        """Return where each tile lies, and how it is turned."""
        height, width = self._tile
        turned = (slice(None), slice(None, None, -1))
        return [
            (
                (slice(i * height, (i + 1) * height), slice(j * width, (j + 1) * width)),
                (turned[(i + self.mirrored[0]) % 2], turned[(j + self.mirrored[1]) % 2]),
            )
            for i in range(self.times)
            for j in range(self.times)
        ]

    def laid(self, picture: Array) -> Float32Array:
        """Return the mosaic of a picture (n, height, width); a rest of a row or column stays dark."""
        moved = np.roll(picture, (-self.first[0], -self.first[1]), axis=(1, 2))
        small = block_mean(moved, self.times)
        whole = np.zeros(picture.shape, np.float32)
        for (rows, columns), (down, across) in self._tiles():
            whole[:, rows, columns] = small[:, down, across]
        return whole

    def gathered(self, mosaic: Array) -> Array:
        """Return the mean of the tiles (n, height, width) at the places of the picture."""
        height, width = self._tile
        small = np.mean(
            [mosaic[:, rows, cols][:, down, across] for (rows, cols), (down, across) in self._tiles()], axis=0
        )
        whole = np.repeat(np.repeat(small, self.times, axis=1), self.times, axis=2)
        rest = [(0, 0), *((0, n - self.times * m) for n, m in zip(self.shape, (height, width), strict=True))]
        return np.roll(np.pad(whole, rest, mode="edge"), self.first, axis=(1, 2))


def _channels_first(volume: Array) -> Array:
    """Return a volume of one plane as images (n_channels, height, width)."""
    return volume if volume.ndim == 3 else np.moveaxis(volume[0], -1, 0)


def _channels_last(images: Array, like: Array) -> Array:
    """Return such images as a volume, shaped as another."""
    return images if like.ndim == 3 else np.moveaxis(images, 0, -1)[None]


def smoothed(variance: Array) -> Array:
    """Average a variance (n_z, height, width[, n_channels]) over its neighbours."""
    from scipy.ndimage import gaussian_filter

    across = (0.0, SMOOTH_PX, SMOOTH_PX, 0.0)[: variance.ndim]
    smooth: Array = gaussian_filter(variance, across, mode="nearest")
    return smooth
