"""Refuse or warn of input that cannot give a good picture, and of options, before any work is begun."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.base.noise import NoiseModel, estimate_deviation
from recon.errors import InputError
from recon.types import Calibration, plain_array, real_array

SATURATED_SHARE = 1e-5
"""Share of pixels at exactly the maximum above which an image is taken for saturated."""
_FEW = 4
"""Fewer saturated pixels are none, of a small image, too: the sensor's own hot ones."""

SATURATED_LIGHT = 0.01
"""Share of a PSF's light in saturated pixels from which the picture suffers."""

SAME = 1 - 1e-6
"""Correlation of two images that are one: of two of the same scene the noise differs."""
SAME_PX = 250_000
"""On so many pixels, about, of each depth."""
SHARPER = 3.0
"""How many times as strong a photograph's details may be: measured ones have 0.16 times the PSF's at most."""
DETAIL_PX = 200
"""Longest side that details are looked for on, pixels, about."""
DARKEST = 1.0
"""Percentile of the pixels that is black."""
NEIGHBOURS = "Put the mean of their neighbours there."
"""What helps where a pixel is no finite number, and is not erased."""
LEAST_PX = 32
"""Sides of images so small tell nothing of frequencies."""
DETAILS = ((0.1, 0.25), (0.02, 0.06))
"""Spatial frequencies of details and of coarser structure, cycles a pixel."""


def as_channels(
    image: npt.ArrayLike, name: str, remedy: str = NEIGHBOURS, of_infinities: str = ""
) -> Float32Array:
    """Return an image (height, width[, n_channels]) of any numeric dtype as float32, channels first.

    Raises InputError when it has another number of axes, is empty, is no array of real numbers of float32,
    or is not finite; the last with a remedy, as :func:`require_finite`.
    """
    single = real_array(plain_array(image), f"The {name}")
    if single.ndim not in (2, 3):
        raise InputError(
            f"The {name} must be (height, width) or (height, width, n_channels); it is {single.shape}."
        )
    if min(single.shape) == 0:
        raise InputError(f"The {name} is empty: its shape is {single.shape}.")
    require_finite(single, name, remedy, of_infinities)
    return np.ascontiguousarray(single[None] if single.ndim == 2 else np.moveaxis(single, 2, 0))


def require_finite(array: Array, name: str, remedy: str = NEIGHBOURS, of_infinities: str = "") -> None:
    """Raise InputError when there are NaN or infinite values, saying how many and where the first is.

    ``remedy`` is what helps, ``of_infinities`` what does where none is NaN, if that is something else.
    """
    wrong = ~np.isfinite(array)
    count = int(np.count_nonzero(wrong))
    if count:
        first = tuple(int(i) for i in np.argwhere(wrong)[0])
        if of_infinities and not np.isnan(array).any():
            remedy = of_infinities
        if count == array.size:
            remedy = "There is nothing else in it."
        raise InputError(
            f"The {name} holds {count} values that are not finite numbers, the first at {first} "
            f"(of shape {array.shape}). {remedy}"
        )


def check_psf(psfs: Float32Array) -> tuple[str, ...]:
    """Check PSF images (n_channels, height, width); returns warnings.

    Raises InputError when a PSF is not finite, empty, constant or negative on the whole.
    """
    require_finite(psfs, "PSF")
    warnings: list[str] = []
    for channel, psf in enumerate(psfs):
        where = f"The PSF's channel {channel}" if len(psfs) > 1 else "The PSF"
        low, high = float(psf.min()), float(psf.max())
        if high == 0 and low == 0:
            raise InputError(f"{where} is zero everywhere: the point source was not seen. Measure it again.")
        if low == high:
            raise InputError(
                f"{where} is constant ({high:g} everywhere), so it holds no pattern to decode. "
                "Check the exposure (too long?) and that this is the right file."
            )
        total = float(np.sum(psf, dtype=np.float64))
        if total <= 0:
            raise InputError(
                f"{where} sums to a negative number: too much background was subtracted. "
                "Check the dark frame."
            )
        light = saturated_light(psf)
        if light > SATURATED_LIGHT:
            warnings.append(
                f"{where} looks saturated: {saturated_share(psf):.2%} of its pixels, with {light:.0%} of its "
                f"light, are at exactly its maximum {high:g}. "
                "The picture will be blurred; calibrate again with a shorter exposure."
            )
        below = float(np.sum(psf[psf < 0], dtype=np.float64)) if low < 0 else 0.0
        negative = -below / (total - 2 * below)
        if negative > 0.1:
            warnings.append(
                f"{where} is negative in {negative:.0%} of its absolute sum: check the background subtracted."
            )
    return tuple(warnings)


def require_photograph(data: Float32Array, psfs: Float32Array, valid: BoolArray) -> None:
    """Refuse what no scene gives: the PSF itself for a photograph, and the two swapped.

    A photograph is the PSF's pattern many times over, ``|B(f)| / B(0) <= |H(f)| / H(0)`` for light that is
    nowhere negative: its details are fainter beside its light than the PSF's, at best, of a single point, as
    strong.

    Parameters
    ----------
    data : ndarray, (n_channels, height, width)
        Background removed.
    psfs : ndarray, (n_z, 1 or n_channels, height, width)
        Of each depth, background removed.
    valid : ndarray of bool, as ``data``
        Pixels that are not erased.

    Raises InputError when they are the same image or swapped.
    """
    if min(data.shape[1:]) < LEAST_PX:
        return
    step = max(1, round((data[0].size / SAME_PX) ** 0.5))
    few, known = data[:, ::step, ::step], valid[:, ::step, ::step]
    for plane in psfs:
        psf = np.broadcast_to(plane[:, ::step, ::step], few.shape)
        lit = known & (psf > np.median(psf))  # background may have been cut off at zero
        one, other = few[lit], psf[lit]
        if lit.any() and np.ptp(one) > 0 and np.ptp(other) > 0 and np.corrcoef(one, other)[0, 1] > SAME:
            raise InputError(
                "PSF and photograph are the same image: give the photograph of the scene, and the one of a "
                "point source as the PSF."
            )
    seen = np.where(valid, data, [[[np.median(d[v])]] for d, v in zip(data, valid, strict=True)])
    middle = psfs[len(psfs) // 2]
    (of_data, fine_data), (of_psf, fine_psf) = (_details(image.mean(axis=0)) for image in (seen, middle))
    # A PSF whose details are no more than its noise tells nothing.
    if of_psf > 0 and of_data > SHARPER * of_psf and fine_data > 0.5 * fine_psf:
        raise InputError(
            "PSF and photograph seem to be swapped: beside its light the photograph's details are "
            f"{of_data / of_psf:.3g} times as strong as the PSF's, and no scene makes them stronger. "
            "Exchange the two."
        )


def _details(image: Float32Array) -> tuple[float, float]:
    """Return how strong details of four to ten pixels are beside the light, and beside coarser ones.

    Light is what exceeds the darkest pixels: a black level that was not subtracted is none.
    """
    small = block_mean(image, max(1, max(image.shape) // DETAIL_PX))
    noise = estimate_deviation(image, np.ones(image.shape, bool)) ** 2 * small.size**2 / image.size
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in small.shape))
    level = float(np.sum(small * window) / np.sum(window))
    power = np.abs(np.fft.rfft2((small - level) * window)) ** 2 / np.mean(window**2)
    frequency = np.hypot(np.fft.fftfreq(small.shape[0])[:, None], np.fft.rfftfreq(small.shape[1]))
    fine, coarse = (
        max(float(np.mean(power[(low < frequency) & (frequency < high)])) - noise, 0.0)
        for low, high in DETAILS
    )
    light = level - float(np.percentile(small, DARKEST))
    return fine**0.5 / max(light * small.size, 1e-30), fine / max(coarse, 1e-30)


def require_calibration(given: object) -> None:
    """Raise InputError for what is no calibration: a folder's name, an array, a result."""
    if not isinstance(given, Calibration):
        raise InputError(
            f"A Calibration is expected, not {type(given).__name__}: in Python db.calibration(folder) reads "
            "one."
        )


def many_saturated(share: float, n_pixels: int) -> bool:
    """Whether such a share of an image's pixels at its maximum are enough to take it for saturated."""
    return share > SATURATED_SHARE and round(share * n_pixels) >= _FEW


def saturated_share(image: Array) -> float:
    """Return the share of pixels at exactly the maximum when it is suspicious, else 0.

    Clipped pixels are more than those just below; counts of a few photons become fewer towards the brightest.
    """
    top = image.max()
    at_top = int(np.count_nonzero(image == top))
    share = at_top / image.size
    if not many_saturated(share, image.size):
        return 0.0
    below = image[image < top]
    return share if not below.size or at_top > np.count_nonzero(below == below.max()) else 0.0


def saturated_light(psf: Array) -> float:
    """Return the share of a PSF's light in pixels at exactly the maximum when it is suspicious, else 0."""
    total = float(np.sum(psf, dtype=np.float64))
    return saturated_share(psf) * psf.size * float(psf.max()) / total if total > 0 else 0.0


def select_psf(calibration: Calibration, z_um: float | None) -> tuple[Float32Array, float | None]:
    """Return the PSF (n_channels, height, width) for depth ``z_um`` and the depth it was taken at.

    The nearest calibrated plane in 1/z, along which PSFs change evenly (Kuo 2020, sec. 4.7); among equal
    depths the source nearest to the axis.

    Raises InputError when there are several PSFs and no depth is asked for, or the depths are unknown.
    """
    n = len(calibration.psfs)
    if n == 0:
        raise InputError("The calibration holds no PSF.")
    positions = calibration.source_positions_um
    z = positions[:, 2]
    if n == 1:
        return calibration.psfs[0], float(z[0]) if np.isfinite(z[0]) else None
    if z_um is None:
        depths = ", ".join(f"{v:g}" for v in np.unique(z))
        raise InputError(
            f"The calibration holds {n} PSFs (z_um: {depths}): say which depth with "
            "--z-mm (z_um in Python); --volume makes a volume of all."
        )
    if not np.isfinite(z).all():
        raise InputError(
            f"The depths of the calibration's {n} PSFs are not known, so z_um cannot choose one."
        )
    if not z_um > 0:
        raise InputError(f"z_um must be above 0, not {z_um:g}.")
    miss = np.abs(1 / z - 1 / z_um)
    off_axis = np.nan_to_num(np.hypot(positions[:, 0], positions[:, 1]))
    best = int(np.lexsort((off_axis, miss))[0])
    return calibration.psfs[best], float(z[best])


def require_noise(noise: object) -> None:
    """Raise InputError for what is no noise model, and no standard deviation in counts; None is allowed."""
    number = isinstance(noise, Real) and not isinstance(noise, bool)
    if noise is None or isinstance(noise, NoiseModel) or (number and 0 <= noise < math.inf):  # type: ignore[operator]
        return
    raise InputError(
        f"noise must be a NoiseModel, or a standard deviation in counts, 0 or more, not {noise!r}."
    )
