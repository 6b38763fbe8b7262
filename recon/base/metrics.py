"""How close two images are: NRMSE, PSNR, SSIM.

Conventions: ``image`` is judged against ``truth``, both (height, width) or (height, width, n_channels), any
real dtype, computed in float64. The scale of a reconstruction is often arbitrary; with ``fit_scale`` it is
first multiplied by the one number (over all pixels and channels) that fits it to the truth best in least
squares. No offset is ever fitted. ``data_range`` is the truth's peak value (its maximum) unless given.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Array
from recon.base.arguments import require_numbers
from recon.errors import InputError


def scale_to(image: Array, truth: Array) -> float:
    """Return the factor that fits ``image`` to ``truth`` in least squares (0 for an empty image)."""
    a, b = _pair(image, truth)
    power = float(np.vdot(a, a))
    return float(np.vdot(a, b)) / power if power > 0 else 0.0


def nrmse(image: Array, truth: Array, *, fit_scale: bool = False) -> float:
    """Return ``||image - truth|| / ||truth||``: 0 is perfect, 1 is as bad as an empty image."""
    a, b = _pair(image, truth, fit_scale)
    norm = float(np.linalg.norm(b))
    if norm == 0:
        raise ValueError("NRMSE is not defined for a truth that is zero everywhere.")
    return float(np.linalg.norm(a - b)) / norm


def psnr(image: Array, truth: Array, *, data_range: float | None = None, fit_scale: bool = False) -> float:
    """Return ``10 log10(data_range^2 / mean squared error)`` in dB; infinite for equal images."""
    a, b = _pair(image, truth, fit_scale)
    peak = _peak(b, data_range)
    error = float(np.mean((a - b) ** 2))
    return float("inf") if error == 0 else float(10 * np.log10(peak**2 / error))


def ssim(image: Array, truth: Array, *, data_range: float | None = None, fit_scale: bool = False) -> float:
    """Return the mean structural similarity of Wang et al. 2004: 1 for equal images.

    Gaussian window of sigma 1.5 pixels cut at 11 x 11, K1 = 0.01, K2 = 0.03, population covariances, mean
    over the part of the image where the window fits; channels are averaged.
    """
    a, b = _pair(image, truth, fit_scale)
    if min(a.shape[:2]) < 11:
        raise ValueError(f"SSIM needs at least 11 x 11 pixels, not {a.shape[0]} x {a.shape[1]}.")
    peak = _peak(b, data_range)
    if a.ndim == 2:
        a, b = a[..., None], b[..., None]
    return float(np.mean([_ssim_2d(a[..., c], b[..., c], peak) for c in range(a.shape[2])]))


def _ssim_2d(a: Array, b: Array, peak: float) -> float:
    from scipy.ndimage import correlate1d

    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def local_mean(image: Array) -> Array:
        blurred = correlate1d(correlate1d(image, taps, axis=0), taps, axis=1)
        inner: Array = blurred[5:-5, 5:-5]
        return inner

    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mean_a, mean_b = local_mean(a), local_mean(b)
    var_a = local_mean(a * a) - mean_a**2
    var_b = local_mean(b * b) - mean_b**2
    covariance = local_mean(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    similarity /= (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    return float(np.mean(similarity))


def _peak(truth: Array, data_range: float | None) -> float:
    peak = float(truth.max()) if data_range is None else float(data_range)
    if not peak > 0:
        raise ValueError(f"The data range must be above 0, not {peak:g}; give data_range.")
    return peak


def _pair(image: Array, truth: Array, fit_scale: bool = False) -> tuple[Array, Array]:
    expected = "an array (height, width[, n_channels]) of real numbers"
    one, other = require_numbers("The image", image, expected), require_numbers("The truth", truth, expected)
    if one.shape != other.shape or one.ndim not in (2, 3):
        raise InputError(
            "Both images must be (height, width) or (height, width, n_channels) and of one shape, "
            f"not {one.shape} and {other.shape}."
        )
    a, b = one.astype(np.float64), other.astype(np.float64)
    return (a * scale_to(a, b) if fit_scale else a), b
