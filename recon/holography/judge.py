"""Judge a hologram by itself: what an eye would see, computed plainly and without aliasing.

Deliberately shares no code with the optimiser's model: double precision, NumPy's FFT, the whole intensity on
a grid of at least twice the aperture (which holds its whole bandwidth), the untruncated filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.metrics import psnr, ssim
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.target import Target

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Scores:
    """How close the seen image is to the target, both low-passed (Eq. 7.18) and of equal mean.

    Peak is the target's white. The crop is the middle quarter of the field (Table 7.1, "partial FoV").
    """

    psnr_db: float
    ssim: float
    crop_psnr_db: float
    crop_ssim: float


def intensity(slm: Array, display: Display, *, z_mm: float = 0.0, padding: int = 2) -> Array:
    """Return the mean intensity of SLM frames, float64, on ``padding`` times the mask's grid in FFT order.

    Parameters
    ----------
    slm : ndarray, complex, (n_frames, height, width)
    display : Display
        Without displacement.
    z_mm : float
    padding : int
        1 is the dissertation's grid, which aliases; from 2 on the result is exact.
    """
    if display.displacement is not None:
        raise InputError("The plain judge knows no displacement; give the display without it.")
    k = display.factor
    hy, hx = display.defocus(z_mm)
    mask = display.mask.field(display.wavelength_nm) * hy[:, None] * hx
    shape = (padding * mask.shape[0], padding * mask.shape[1])
    total = np.zeros(shape)
    for frame in slm:
        field = display.dc.modulated * frame + display.dc.amplitude
        field = np.repeat(np.repeat(field, k, axis=0), k, axis=1) * mask
        total += np.abs(np.fft.fft2(field, shape)) ** 2
    ey, ex = display.envelope(shape)
    return total * ey[:, None] * ex / (mask.size * len(slm))


def low_pass(image: Array, slm_shape: tuple[int, int]) -> Array:
    """Apply Eq. 7.18 to an image over the whole field, FFT order; any sampling."""
    from recon.holography.lowpass import ORDER, cutoff_radius

    y, x = (np.fft.fftfreq(n) * n for n in image.shape)
    response = 1 / (1 + ((y[:, None] ** 2 + x**2) / cutoff_radius(slm_shape) ** 2) ** ORDER)
    return np.fft.ifft2(np.fft.fft2(image) * response).real


def seen_image(slm: Array, display: Display, *, z_mm: float = 0.0, padding: int = 2) -> Array:
    """Return the low-passed image at the points of the mask's grid, the field's centre in the middle."""
    image = low_pass(intensity(slm, display, z_mm=z_mm, padding=padding), display.slm_shape)
    return np.fft.fftshift(image[::padding, ::padding])


def judge(slm: Array, display: Display, target: Target, *, padding: int = 2) -> Scores:
    """Compare what is seen with the target, which must be given on the mask's grid."""
    if target.image.shape != display.mask.shape:
        raise InputError(
            f"The judge needs the target on the mask's grid {display.mask.shape}, not {target.image.shape}."
        )
    image, peak = target.scaled(display)
    wanted = np.fft.fftshift(low_pass(image, display.slm_shape))
    return compare(seen_image(slm, display, z_mm=target.z_mm, padding=padding), wanted, peak)


def compare(seen: Array, wanted: Array, peak: float) -> Scores:
    """Score an image against the wanted one after scaling it to the same mean."""
    scaled = seen * (wanted.mean() / seen.mean())
    y, x = (slice(n // 4, n - n // 4) for n in wanted.shape)
    crop = scaled[y, x], wanted[y, x]
    return Scores(
        psnr(scaled, wanted, data_range=peak),
        ssim(scaled, wanted, data_range=peak),
        psnr(*crop, data_range=peak),
        ssim(*crop, data_range=peak),
    )
