"""A transparent sample in a microscope lit by an LED array: partially coherent imaging, wave by wave.

Every LED is a point far away and incoherent with the others. It sends a plane wave through the sample, whose
spectrum the objective's pupil cuts; the image is the sum of all LEDs' intensities. Nothing is assumed about
how strong or how slow the sample's phase is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import fft

Floats = npt.NDArray[np.float64]


def led_image(
    phase: npt.NDArray[np.floating],
    pitch_um: float,
    sines: Floats,
    weights: Floats,
    *,
    wavelength_nm: float,
    na: float,
    defocus_um: float = 0.0,
    workers: int = 2,
) -> npt.NDArray[np.float32]:
    """Image of a thin phase sample, relative to no sample and all the LEDs' light through the pupil.

    Parameters
    ----------
    phase : ndarray, (height, width)
        Radians. Taken as periodic: give a rim that is not looked at.
    pitch_um : float
        Of the samples, in the object.
    sines : ndarray, (n_leds, 2)
        Of each LED's direction as seen from the sample, x and y; its light travels the other way.
    weights : ndarray, (n_leds,)
        Light of each LED; they add up.
    wavelength_nm, na : float
        Of the light; of the objective.
    defocus_um : float
        Distance of the focal plane from the sample.

    Returns
    -------
    ndarray, float32, (height, width)
    """
    spectrum = fft.fft2(np.exp(1j * np.asarray(phase, np.float64)).astype(np.complex64), workers=workers)
    height, width = phase.shape
    qy, qx = fft.fftfreq(height, pitch_um)[:, None], fft.fftfreq(width, pitch_um)
    wavelength_um = 1e-3 * wavelength_nm
    total = np.zeros(phase.shape, np.float32)
    for (sine_x, sine_y), weight in zip(sines, weights, strict=True):
        y, x = qy - sine_y / wavelength_um, qx - sine_x / wavelength_um
        squared = y**2 + x**2
        passed = squared <= (na / wavelength_um) ** 2
        if not passed.any():
            continue
        field = np.where(passed, spectrum, 0)
        if defocus_um:
            along = np.sqrt(np.maximum(wavelength_um**-2 - squared, 0.0))
            field = field * np.exp(2j * np.pi * defocus_um * along)
        amplitude = fft.ifft2(field.astype(np.complex64), workers=workers)
        total += np.float32(weight) * (amplitude.real**2 + amplitude.imag**2)
    return total
