"""Refuse or warn of input that cannot give a good picture, and of options, before any work is begun."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.errors import InputError
from recon.types import Calibration

SATURATED_SHARE = 1e-5
"""Share of pixels at exactly the maximum above which an image is taken for saturated."""

SATURATED_LIGHT = 0.01
"""Share of a PSF's light in saturated pixels from which the picture suffers."""


def as_channels(image: npt.ArrayLike, name: str) -> npt.NDArray[np.float32]:
    """Return an image (height, width[, n_channels]) of any numeric dtype as float32, channels first.

    Raises InputError when it has another number of axes, is empty, is no array of real numbers, or is not
    finite.
    """
    array = np.asarray(image)
    if array.dtype.kind not in "uifb":
        raise InputError(f"The {name} must hold real numbers, not {array.dtype}.")
    if array.ndim not in (2, 3):
        raise InputError(
            f"The {name} must be (height, width) or (height, width, n_channels); it is {array.shape}."
        )
    if min(array.shape) == 0:
        raise InputError(f"The {name} is empty: its shape is {array.shape}.")
    channels = array[None] if array.ndim == 2 else np.moveaxis(array, 2, 0)
    result = np.ascontiguousarray(channels, np.float32)
    require_finite(result, name)
    return result


def require_finite(array: npt.NDArray[Any], name: str) -> None:
    """Raise InputError when there are NaN or infinite values, saying how many and where the first is."""
    wrong = ~np.isfinite(array)
    count = int(np.count_nonzero(wrong))
    if count:
        first = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"The {name} holds {count} values that are not finite numbers, the first at {first} "
            f"(of shape {array.shape}). Mark bad pixels with erasures and set them to 0."
        )


def check_psf(psfs: npt.NDArray[np.float32]) -> tuple[str, ...]:
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
        share = saturated_share(psf)
        light = share * psf.size * high / total
        if light > SATURATED_LIGHT:
            warnings.append(
                f"{where} looks saturated: {share:.2%} of its pixels, with {light:.0%} of its light, are at "
                f"exactly its maximum {high:g}. "
                "The picture will be blurred; calibrate again with a shorter exposure."
            )
        below = float(np.sum(psf[psf < 0], dtype=np.float64)) if low < 0 else 0.0
        negative = -below / (total - 2 * below)
        if negative > 0.1:
            warnings.append(
                f"{where} is negative in {negative:.0%} of its absolute sum: check the background subtracted."
            )
    return tuple(warnings)


def saturated_share(image: npt.NDArray[Any]) -> float:
    """Return the share of pixels at exactly the maximum when it is suspicious, else 0."""
    at_top = int(np.count_nonzero(image == image.max()))
    share = at_top / image.size
    return share if at_top >= 4 and share > SATURATED_SHARE else 0.0


def select_psf(calibration: Calibration, z_um: float | None) -> tuple[npt.NDArray[np.float32], float | None]:
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
            f"The calibration holds {n} PSFs (z_um: {depths}): say which depth with z_um "
            "(--z-mm on the command line)."
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
