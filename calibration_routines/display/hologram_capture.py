"""Photograph what a hologram shows, bring it to the field of view, judge it as an eye would see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench
from recon.holography import Display, Scores, Target
from recon.holography.camera_map import CameraMap, register_camera
from recon.holography.judge import compare, low_pass
from recon.holography.lowpass import make_band

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Capture:
    """A photographed hologram.

    Attributes
    ----------
    seen : ndarray, float64, (height, width)
        Low-passed picture over the field of view, the axis in the middle, in units of the target's white.
    wanted : ndarray, float64
        The target on the same grid, low-passed.
    scores : Scores
    saturated_fraction : float
        Of the photograph's pixels.
    """

    seen: npt.NDArray[np.float64]
    wanted: npt.NDArray[np.float64]
    scores: Scores
    saturated_fraction: float


def capture_hologram(
    io: DisplayBench,
    fields: Sequence[Array],
    display: Display,
    target: Target,
    camera: CameraMap,
    *,
    mean_per_ms: float,
    average: int = 1,
) -> Capture:
    """Show SLM fields one after the other, add their photographs, and compare with the target.

    Parameters
    ----------
    io : DisplayBench
    fields : sequence of ndarray, complex, (height, width)
        Time-multiplexed frames.
    display : Display
    target : Target
    camera : CameraMap
    mean_per_ms : float
        Counts a millisecond of the mean intensity, from the registration.
    average : int
        Photographs of each frame.
    """
    full = (1 << io.bench.camera.significant_bits) - 1
    exposure_ms = full / (12 * mean_per_ms)
    total = np.zeros(io.bench.camera.image_shape)
    for field in fields:
        io.show(field)
        for _ in range(average):
            total += io.photograph(exposure_ms)
    ceiling = 0.98 * full / io.bench.camera.exposure_ms * len(fields) * average
    shape = make_band(display.slm_shape, display.factor, "alias_free").seen_shape
    picture = np.fft.ifftshift(camera.resample(total, shape))
    seen = np.fft.fftshift(low_pass(picture, display.slm_shape))
    wanted, peak = wanted_picture(target, display)
    scaled = seen * (wanted.mean() / seen.mean())
    return Capture(
        scaled / peak, wanted / peak, compare(scaled, wanted, peak), float((total >= ceiling).mean())
    )


def wanted_picture(target: Target, display: Display) -> tuple[npt.NDArray[np.float64], float]:
    """Return the low-passed target on the smallest grid that holds it, and its peak."""
    band = make_band(display.slm_shape, display.factor, "alias_free")
    spectrum, peak = target.spectrum(display, band)
    height, width = band.seen_shape
    half = np.zeros((height, width // 2 + 1), complex)
    rows = np.r_[0 : band.top, height - (band.kept[0] - band.top) : height]
    half[rows, : band.kept[1]] = spectrum
    image = np.fft.irfft2(half, (height, width)) * (height * width)
    return np.fft.fftshift(low_pass(image, display.slm_shape)), peak


def find_camera(io: DisplayBench, display: Display) -> tuple[CameraMap, float]:
    """Blank the SLM, register the camera by the mask's speckle, and learn how bright the mean intensity is.

    Returns
    -------
    CameraMap
    float
        Counts a millisecond of the mean intensity.

    Raises
    ------
    InputError
        When the speckle is not recognised.
    """
    camera = io.bench.camera
    pitch_um = camera.pixel_pitch_um * camera.binning
    across = display.wavelength_nm * display.focal_mm / display.mask_pitch_um / pitch_um
    io.show(np.ones(display.slm_shape, complex))
    frame = io.photograph(camera.exposure_ms)
    found = register_camera(frame, display, across)
    return found, _inner_mean(frame, found)


def random_brightness(io: DisplayBench, display: Display, camera: CameraMap, mean_per_ms: float) -> float:
    """Return counts a millisecond of the mean intensity of random phases.

    A blank SLM adds up with light that is not modulated, so that its picture is brighter or darker than that
    of any hologram; ``mean_per_ms``, from :func:`find_camera`, only sets the exposure.
    """
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, display.slm_shape)
    io.show(np.exp(1j * phases))
    full = (1 << io.bench.camera.significant_bits) - 1
    return _inner_mean(io.photograph(full / (12 * mean_per_ms)), camera)


def _inner_mean(frame: Array, camera: CameraMap) -> float:
    """Return the mean over the inner field of view, the mask pixels' envelope divided out."""
    rows, columns = camera.pixels(np.array([-0.3, 0.3]), np.array([-0.3, 0.3]))
    inner = frame[round(rows[0]) : round(rows[1]), round(columns[0]) : round(columns[1])]
    envelope = (np.sinc(np.linspace(-0.3, 0.3, 101)) ** 2).mean() ** 2
    return float(inner.mean() / envelope)
