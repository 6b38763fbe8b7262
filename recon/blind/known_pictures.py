"""A camera's PSF from photographs of known pictures: a monitor instead of a pinhole.

What photograph ``i`` shows in channel ``c`` is ``b_ic = C (h_c * (a_i x_ic + l_ic)) + o_ic``: the picture
``x`` and the light ``l`` that is not in it (beyond its edges, and what it lost where it is saturated),
through the PSF ``h``, cropped to the sensor (Kuo 2020, Eq. 3.4), with a brightness ``a`` a photograph and an
even offset ``o`` (stray light, black level). The PSF and the unknown light are solved in turn, each by
non-negative least squares (FISTA), first on binned images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base.blocks import block_mean, enlarged
from recon.base.fft import fast_shape
from recon.blind.psf_step import BeadMixer
from recon.camera.base import Composition, Projection, estimate_norm
from recon.camera.convolution import Convolution, field_of
from recon.camera.factors import Erasures
from recon.camera.varying_psfs import bounding_window
from recon.errors import InputError
from recon.priors import NonNegativity
from recon.solvers import Fista, StoppingRules
from recon.solvers.base import IterationRecord, Solver

Progress = Callable[[str, float], object]

_COARSE_PX = 64  # rows of the coarsest images
_OF_A_ROUND = 0.7  # of its work is the PSF's, where light beyond the pictures is solved after it
_NORM_MARGIN, _NORM_ITERATIONS = 1.1, 15  # the power iteration's norm is a lower bound
_WORTH = 0.1  # of the misfit, that another exponent than 1 has to take away
_LARGEST_STEP, _GAMMAS = 0.3, (0.3, 4.0)  # of the exponent
_FOREIGN, _FEW = 0.03, 3.0
"""Part of the others' misfit that goes with a photograph that does not show its picture: at least, and over
the square of their number, as a PSF from few fits them better than that from one more, anyway."""
_FOREIGN_PX, _FOREIGN_ITERATIONS = 32, 60  # rows of images that this is told from, and iterations of the PSF
_FLATTEST = 1e-3  # relative deviation of a photograph or picture that shows something


@dataclass(frozen=True, slots=True)
class PictureSettings:
    """How the photographs are solved.

    Attributes
    ----------
    one_psf : bool
        One PSF for all channels, which differ in brightness: a diffuser hardly disperses. Else one a channel.
    beyond : float
        How far beyond the pictures' field there may be light, in parts of the sensor's height; 0: nowhere.
        What is black at the edges of all pictures counts as beyond.
    saturated : float or None
        Part of the pictures' peak from which on a pixel is known to be at least so bright, as in photographs
        through a lens. None: pictures say all, as those that were drawn.
    gamma : float or None
        Exponent that makes a picture's values light; None: 1, or what is found where that explains clearly
        more.
    foreign : bool
        Leave out photographs that do not show their pictures, told by how much better the others fit without
        them; of three or more.
    rounds : int
        How often PSF and unknown light are solved in turn, at each scale; half as often at the finest.
    psf_iterations, light_iterations : int
        Of each half-step. PSFs of many iterations fare better on left-out pictures; at the finest scale,
        where the start is good and they cost most, three fifths are done.
    """

    one_psf: bool = True
    beyond: float = 0.18
    saturated: float | None = 0.97
    gamma: float | None = 1.0
    foreign: bool = True
    rounds: int = 4
    psf_iterations: int = 200
    light_iterations: int = 30


@dataclass(frozen=True)
class PicturePsf:
    """What photographs of known pictures tell of a camera.

    Attributes
    ----------
    psf : ndarray, float32, (n_channels, height, width)
        On the sensor's pixels; a source on the pictures' centre pixel casts it. Not negative.
    gains : ndarray, float64, (n_channels,)
        Light of each channel's PSF.
    brightness : ndarray, float64, (n_photographs,)
        Of each photograph relative to its picture; mean 1.
    stray : ndarray, float32, (n_photographs, n_channels)
        Even light that no picture accounts for, in the photographs' unit.
    light : ndarray, float32, (n_photographs, n_channels, field height, field width)
        Light that was not in the pictures, relative to their peak, where it can reach the sensor.
    gamma : float
        Exponent that makes a picture's values light.
    misfit : float
        What is left of the photographs' standard deviation.
    foreign : tuple of int
        Photographs, from 0, that do not show their pictures and were left out; their brightness and stray
        light are NaN.
    """

    psf: Float32Array
    gains: Float64Array
    brightness: Float64Array
    stray: Float32Array
    light: Float32Array
    gamma: float
    misfit: float
    foreign: tuple[int, ...] = ()


def psf_from_pictures(
    photographs: Array,
    pictures: Array,
    settings: PictureSettings | None = None,
    *,
    on_progress: Progress | None = None,
) -> PicturePsf:
    """Estimate the PSF from photographs of known pictures.

    Parameters
    ----------
    photographs : ndarray, (n, n_channels, height, width)
        Linear in the light, dark frame subtracted, any scale.
    pictures : ndarray, the same shape
        What was shown, on the sensor's pixels: one object pixel further moves the pattern by one sensor
        pixel. Values are light, or light to the power of 1 / gamma.
    settings : PictureSettings, optional
    on_progress : callable, optional
        Called with what is being done and the share done.

    Raises InputError when shapes differ, there are fewer than two pairs, values are not finite or negative
    pictures are given, or a picture or photograph shows nothing.
    """
    settings = settings or PictureSettings()
    data, known = (np.asarray(images, np.float32) for images in (photographs, pictures))
    _check(data, known, settings)
    report = on_progress or (lambda _what, _share: None)
    known = known / known.max()
    foreign = foreign_photographs(data, known, settings) if settings.foreign else ()
    kept = np.setdiff1d(np.arange(len(data)), foreign)
    data, known = data[kept], known[kept]
    costs = np.array([one.iterations / one.factor**2 for one in scales(data.shape[2], settings)])
    found: _Estimate | None = None
    for number, (factor, rounds, psf_iterations) in enumerate(scales(data.shape[2], settings)):
        begin, part = costs[:number].sum() / costs.sum(), costs[number] / costs.sum()
        taken, shown = (block_mean(stack, factor, about_axis=True) for stack in (data, known))

        def share(what: str, done: float, begin: float = begin, part: float = part) -> None:
            report(what, begin + part * done)

        if found is None and settings.gamma is None:
            settings = replace(settings, gamma=_gamma_worth_having(taken, shown, settings))
        scale = _Estimate(taken, shown, settings)
        if found is not None:
            scale.start_from(found)
            scale.settings = replace(settings, rounds=rounds, psf_iterations=psf_iterations)
        scale.solve(share)
        found = scale
    assert found is not None
    result = found.result()
    if not foreign:
        return result
    brightness = np.full(len(kept) + len(foreign), np.nan)
    stray, light = (
        np.full((len(brightness), *values.shape[1:]), np.nan, np.float32)
        for values in (result.stray, result.light)
    )
    for every, own in ((brightness, result.brightness), (stray, result.stray), (light, result.light)):
        every[kept] = own
    return replace(result, brightness=brightness, stray=stray, light=light, foreign=foreign)


class Scale(NamedTuple):
    """Images of a size that are solved: by how much they are binned, how often, how long each time."""

    factor: int
    rounds: int
    psf_iterations: int

    @property
    def iterations(self) -> int:
        """Of the PSF, of all rounds."""
        return self.rounds * self.psf_iterations


def scales(rows: int, settings: PictureSettings) -> list[Scale]:
    """Return what is solved one after the other, from coarse to fine, for photographs of so many rows."""
    found = [Scale(1, settings.rounds, settings.psf_iterations)]
    if rows // 2 >= _COARSE_PX:  # at the finest, with a good start
        iterations = 1 + settings.psf_iterations * 3 // 5
        found = [Scale(1, (settings.rounds + 1) // 2, iterations)]
    while rows // (2 * found[-1].factor) >= _COARSE_PX:
        found.append(Scale(2 * found[-1].factor, settings.rounds, settings.psf_iterations))
    return found[::-1]


def psf_work(shape: tuple[int, int, int, int], settings: PictureSettings) -> float:
    """Return what solving for the PSF computes, in transforms of 1024 x 1024 there and back.

    Parameters
    ----------
    shape : (int, int, int, int)
        Photographs, channels, height, width.
    settings : PictureSettings
        Of pictures that say all: without light beyond them, exponent and foreign ones.
    """
    count, channels, *sensor = shape
    work = 0.0
    for factor, rounds, psf_iterations in scales(sensor[0], settings):
        rows, columns = fast_shape([2 * (n // factor) for n in sensor])
        passes = rounds * (psf_iterations + _NORM_ITERATIONS)
        work += passes * count * channels * rows * columns / 1024**2
    return work


def foreign_photographs(
    data: Float32Array, known: Float32Array, settings: PictureSettings
) -> tuple[int, ...]:
    """Return which photographs do not show their pictures: without them the others are explained far better.

    Parameters
    ----------
    data, known : ndarray, float32, (n, n_channels, height, width)
        Photographs and pictures, these with a peak of 1.
    settings : PictureSettings
    """
    factor = max(1, data.shape[2] // _FOREIGN_PX)
    data, known = (block_mean(stack, factor, about_axis=True) for stack in (data, known))
    quick = replace(settings, gamma=settings.gamma or 1.0, psf_iterations=_FOREIGN_ITERATIONS)

    def left(numbers: Sequence[int]) -> Float64Array:
        """Return what is left of each photograph's energy with the PSF from some of them."""
        estimate = _Estimate(data[numbers], known[numbers], quick)
        estimate.solve(lambda _what, _share: None)
        return estimate.left

    kept = list(range(len(data)))
    while len(kept) > 2:
        whole = left(kept)
        gone = [left([*kept[:k], *kept[k + 1 :]]).sum() / np.delete(whole, k).sum() for k in range(len(kept))]
        worst = int(np.argmin(gone))
        if 1 - np.sqrt(gone[worst]) < max(_FOREIGN, _FEW / len(kept) ** 2):
            break
        del kept[worst]
    return tuple(sorted(set(range(len(data))) - set(kept)))


def _gamma_worth_having(data: Float32Array, known: Float32Array, settings: PictureSettings) -> float:
    """Return the pictures' exponent: 1, unless the one found explains clearly more."""
    linear, bent = (_Estimate(data, known, replace(settings, gamma=g)) for g in (1.0, None))
    for estimate in (linear, bent):
        estimate.solve(lambda _what, _share: None)
    return bent.gamma if bent.misfit < (1 - _WORTH) * linear.misfit else 1.0


class _Estimate:
    """The unknowns at one scale, and what improves each."""

    def __init__(self, data: Float32Array, known: Float32Array, settings: PictureSettings) -> None:
        self.settings = settings
        count, self.channels, *sensor = data.shape
        self.sensor = (sensor[0], sensor[1])
        self.field, centre = field_of(self.sensor, self.sensor)
        self.window = tuple(
            slice(c - n // 2, c - n // 2 + n) for c, n in zip(centre, self.sensor, strict=True)
        )
        self.data = data
        self.pictures = known
        self.gamma = 1.0 if settings.gamma is None else settings.gamma
        self.known = self._as_light(known**self.gamma)
        self.unknown = self._where_unknown(known)
        self.light = np.zeros_like(self.known)
        self.brightness = np.ones(count)
        self.psf = np.zeros((1 if settings.one_psf else self.channels, *self.sensor), np.float32)
        self.gains = np.ones(self.channels)
        self.left = np.full(count, np.inf)

    @property
    def misfit(self) -> float:
        """What is left of the photographs' standard deviation."""
        return float(np.sqrt(self.left.sum()) / np.linalg.norm(self._even_removed(self.data)))

    def _where_unknown(self, known: Float32Array) -> BoolArray:
        """Return where there may be light that the pictures do not tell of: beyond them, where saturated.

        Black rows and columns at the edges of all pictures are beyond them.
        """
        reach = round(self.settings.beyond * self.sensor[0])
        around = np.zeros(self.field, bool)
        around[tuple(slice(max(w.start - reach, 0), w.stop + reach) for w in self.window)] = True
        lit = known.max(axis=(0, 1)) > _FLATTEST
        around[self.window] = False
        if reach:
            around[self.window] = True
            around[self.window][bounding_window(lit)] = False
        unknown = np.broadcast_to(around, self.known.shape).copy()
        if self.settings.saturated is not None:
            unknown[:, :, *self.window] |= known >= self.settings.saturated
        return unknown

    def _as_light(self, pictures: Array) -> Float32Array:
        light = np.zeros((len(self.data), self.channels, *self.field), np.float32)
        light[:, :, *self.window] = pictures
        return light

    def start_from(self, coarse: _Estimate) -> None:
        """Take over what binned images gave."""
        factor = round(self.sensor[0] / coarse.sensor[0])
        self.psf = np.maximum(enlarged(coarse.psf, factor, self.sensor), 0)
        self.light = enlarged(coarse.light, factor, self.field) * np.float32(factor**2) * self.unknown
        self.brightness, self.gains, self.gamma = coarse.brightness, coarse.gains, coarse.gamma
        self.known = self._as_light(self.pictures**self.gamma)

    def solve(self, report: Progress) -> None:
        """Solve PSF, brightness and unknown light in turn; ends with the PSF."""
        rounds = self.settings.rounds
        for number in range(rounds):
            light_too = number < rounds - 1 and bool(self.unknown.any())
            part = _OF_A_ROUND if light_too else 1.0

            def share(done: float, number: int = number, part: float = part) -> None:
                report("PSF", (number + part * done) / rounds)

            share(0.0)
            self.solve_psf(share)
            self.solve_brightness()
            if self.settings.gamma is None:
                self.solve_gamma()
            if light_too:
                report("light beyond the pictures", (number + part) / rounds)
                self.solve_light()

    def scene(self) -> Float32Array:
        """Return all light in the photographs' unit but for the PSF: (n, n_channels, field)."""
        lit = self.brightness[:, None, None, None].astype(np.float32) * self.known + self.light
        return np.asarray(lit * self.gains[:, None, None].astype(np.float32), np.float32)

    def solve_psf(self, share: Callable[[float], object]) -> None:
        """Solve for the PSF by the present brightness and light; ``share`` gets how much of it is done."""
        scene, iterations = self.scene(), self.settings.psf_iterations
        for k in range(len(self.psf)):
            part = slice(None) if len(self.psf) == 1 else slice(k, k + 1)
            light = scene[:, part].reshape(-1, *self.field)
            seen = BeadMixer(np.ones((1, *self.field), np.float32), light, self.sensor, self.sensor)
            camera = Composition(EvenRemoved(seen.range_shape, seen.range_shape, np.float32), seen)
            target = camera.outer.forward(self.data[:, part].reshape(seen.range_shape))
            step = 1 / (_NORM_MARGIN * estimate_norm(camera, _NORM_ITERATIONS)) ** 2
            solver = Fista(camera, target, NonNegativity(), initial=self.psf[k : k + 1], step=step)

            def iterated(_solver: Solver, record: IterationRecord, k: int = k) -> None:
                share((k + record.iteration / iterations) / len(self.psf))

            self.psf[k] = solver.run(StoppingRules(iterations=iterations), callback=iterated).solution[0]

    def solve_brightness(self) -> None:
        """Fit each channel's and each photograph's brightness to the data, in turn."""
        data = self._even_removed(self.data)
        for axes in ((0, 2, 3), (1, 2, 3)):
            model = self._even_removed(self.seen(self.scene()))
            power = np.einsum("nchw,nchw->nc", model, model, dtype=np.float64)
            match = np.einsum("nchw,nchw->nc", model, data, dtype=np.float64)
            ratio = match.sum(axis=axes[0]) / np.maximum(power.sum(axis=axes[0]), 1e-30)
            if axes[0] == 0:
                self.gains = self.gains * ratio
            else:
                self.brightness = self.brightness * ratio / ratio.mean()
                self.light *= (ratio / ratio.mean())[:, None, None, None].astype(np.float32)
        model = self._even_removed(self.seen(self.scene()))
        self.left = ((model - data) ** 2).sum(axis=(1, 2, 3), dtype=np.float64)

    def solve_gamma(self) -> None:
        """Fit the pictures' exponent: a Gauss-Newton step, each photograph's brightness free."""
        with np.errstate(divide="ignore"):
            slope = np.where(self.pictures > 0, np.log(self.pictures), 0) * self.pictures**self.gamma
        lit = self.brightness[:, None, None, None] * self._as_light(slope) * self.gains[:, None, None]
        change = self._even_removed(self.seen(np.asarray(lit, np.float32)))
        model = self._even_removed(self.seen(self.scene()))
        left = self._even_removed(self.data) - model
        for image, seen in zip(change, model, strict=True):
            image -= seen * np.float32(np.vdot(seen, image) / max(float(np.vdot(seen, seen)), 1e-30))
        step = float(np.vdot(change, left)) / max(float(np.vdot(change, change)), 1e-30)
        self.gamma = float(np.clip(self.gamma + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP), *_GAMMAS))
        self.known = self._as_light(self.pictures**self.gamma)

    def solve_light(self) -> None:
        """Solve what is not in the pictures, channel by channel, not negative."""
        for c in range(self.channels):
            psf = self.psf[c if len(self.psf) > 1 else 0] * np.float32(self.gains[c])
            camera = Convolution(psf[None], self.sensor, n_channels=len(self.data))
            lit = self.brightness[:, None, None].astype(np.float32) * self.known[:, c]
            even = EvenRemoved(camera.range_shape, camera.range_shape, np.float32)
            where = self._on_grid(self.unknown[:, c], camera).astype(bool)
            seen = Composition(even, Composition(camera, Erasures(where, camera.domain_shape)))
            target = even.forward(self.data[:, c] - camera.forward(self._on_grid(lit, camera)))
            solver = Fista(seen, target, NonNegativity(), initial=self._on_grid(self.light[:, c], camera))
            found = solver.run(StoppingRules(iterations=self.settings.light_iterations)).solution
            self.light[:, c] = (found * where)[:, : self.field[0], : self.field[1]]

    def seen(self, scene: Float32Array) -> Float32Array:
        """Return what the sensor sees of scenes (n, n_channels, field)."""
        camera = Convolution(self.psf, self.sensor, n_channels=self.channels)
        return np.stack([camera.forward(self._on_grid(one, camera)) for one in scene])

    def _on_grid(self, images: Array, camera: Convolution) -> Float32Array:
        padded = np.zeros((*images.shape[:-2], *camera.grid_shape), np.float32)
        padded[..., : self.field[0], : self.field[1]] = images
        return padded

    @staticmethod
    def _even_removed(images: Float32Array) -> Float32Array:
        return np.asarray(images - images.mean(axis=(2, 3), keepdims=True), np.float32)

    def result(self) -> PicturePsf:
        """Return what was found."""
        stray = (self.data - self.seen(self.scene())).mean(axis=(2, 3))
        psf = self.psf * self.gains[:, None, None].astype(np.float32)
        return PicturePsf(
            psf=psf,
            gains=psf.sum(axis=(1, 2), dtype=np.float64),
            brightness=self.brightness,
            stray=stray,
            light=self.light,
            gamma=self.gamma,
            misfit=self.misfit,
        )


class EvenRemoved(Projection):
    """Images (n, height, width) less their means: an even light is nobody's business."""

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Subtract each image's mean."""
        means = x.mean(axis=(1, 2), keepdims=True, dtype=np.float64).astype(self.dtype)
        left: Array = np.subtract(x, means, out=out)
        return left


def _check(data: Float32Array, known: Float32Array, settings: PictureSettings) -> None:
    if data.ndim != 4 or data.shape != known.shape or len(data) < 2:
        raise InputError(
            "Two or more photographs (n, n_channels, height, width) and pictures of the same shape are "
            f"needed, not {data.shape} and {known.shape}."
        )
    if not (np.isfinite(data).all() and np.isfinite(known).all()):
        raise InputError("A photograph or picture holds values that are not finite numbers.")
    if known.min() < 0:
        raise InputError(f"Pictures are light and not negative; the least value is {known.min():g}.")
    for what, images in (("Photograph", data), ("Picture", known)):
        for number, image in enumerate(images):
            if not image.std() > _FLATTEST * abs(image).max():
                raise InputError(f"{what} {number + 1} shows nothing: all its pixels are alike.")
    if settings.rounds < 1 or min(settings.psf_iterations, settings.light_iterations) < 1:
        raise InputError("Rounds and iterations are at least 1.")
    if not 0 <= settings.beyond <= 1:
        raise InputError(f"Light beyond the pictures is looked for within 0 to 1, not {settings.beyond:g}.")
