"""A holographic display as it is: SLM, relay, misplaced mask, Fourier lens, camera; forward physics only.

The SLM's image falls onto a scattering mask (scale 1, a relay whose distortion moves the image), the mask's
far field onto a camera in the focal plane of a lens (Kuo 2020, Fig. 7.5). The field is sampled several times
per mask pixel in the mask's own frame, SLM pixels are weighted by area at any sub-pixel place, free space
between SLM image and mask is propagated, the intensity is sampled at twice the aperture's resolution and
integrated over camera pixels. No hologram is computed here and no optimiser shares this code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from recon.optics.jit import compiled

Complex = npt.NDArray[np.complex64]
Image = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class MaskPose:
    """Where the mask is relative to the SLM's image; zero is the place that holograms are computed for.

    ``shift_*`` along columns and rows, ``z_um`` downstream of the SLM's image, ``roll`` about the optical
    axis, ``pitch`` about x (so that z grows with y), ``yaw`` about y (z grows with x).
    """

    shift_x_um: float = 0.0
    shift_y_um: float = 0.0
    z_um: float = 0.0
    roll_mrad: float = 0.0
    pitch_mrad: float = 0.0
    yaw_mrad: float = 0.0


@dataclass(frozen=True, slots=True)
class DisplaySpec:
    """What stays the same while the mask moves.

    Attributes
    ----------
    slm_pitch_um, mask_pitch_um, wavelength_nm, focal_mm : float
    magnification : float
        Of the relay from mask to SLM coordinates, less one.
    relay_distortion_um : float
        Radial (third order) displacement of the SLM's image at the mask's corners.
    relay_centre_um : (float, float)
        ``(x, y)`` of the relay's axis, which its distortion is centred on.
    dc_power, dc_phase_rad : float
        Share of the light that the SLM's surface reflects unmodulated.
    fill : float
        Modulating part of an SLM pixel's area; the rest reflects like the DC term.
    oversampling : int
        Samples per mask pixel along each axis.
    sensor_shape : (int, int)
    sensor_pitch_um : float
    sensor_offset_um : (float, float)
        ``(y, x)`` of the sensor's centre from the axis.
    sensor_roll_mrad : float
    lens_distortion : float
        Radial (third order) distortion of the Fourier lens, relative, at the middle of the field's border.
    """

    slm_pitch_um: float = 8.0
    mask_pitch_um: float = 4.0
    wavelength_nm: float = 660.0
    focal_mm: float = 35.0
    magnification: float = 0.0
    relay_distortion_um: float = 0.0
    relay_centre_um: tuple[float, float] = (0.0, 0.0)
    dc_power: float = 0.0
    dc_phase_rad: float = 0.0
    fill: float = 1.0
    oversampling: int = 2
    sensor_shape: tuple[int, int] = (1088, 1088)
    sensor_pitch_um: float = 5.5
    sensor_offset_um: tuple[float, float] = (0.0, 0.0)
    sensor_roll_mrad: float = 0.0
    lens_distortion: float = 0.0

    @property
    def field_um(self) -> float:
        """Width of the field of view on the sensor, ``lambda f / mask pitch``."""
        return self.wavelength_nm * 1e-3 * self.focal_mm * 1e3 / self.mask_pitch_um


class ScatteringDisplay:
    """Takes SLM phases and a pose to the light on the camera's pixels.

    Parameters
    ----------
    spec : DisplaySpec
    mask_phase_rad : ndarray, real, (height, width)
        Phase of every mask pixel.
    threads : int
        For the Fourier transforms.
    """

    def __init__(
        self, spec: DisplaySpec, mask_phase_rad: npt.NDArray[np.floating], *, threads: int = 1
    ) -> None:
        self.spec = spec
        self.threads = threads
        n = spec.oversampling
        mask = np.exp(1j * np.asarray(mask_phase_rad)).astype(np.complex64)
        self._mask = np.repeat(np.repeat(mask, n, axis=0), n, axis=1)
        self._coarse = mask.shape
        pitch_mm = spec.mask_pitch_um * 1e-3 / n
        fy, fx = (scipy.fft.fftfreq(m, pitch_mm).astype(np.float32) for m in self._mask.shape)
        self._f2 = tuple(f**2 * np.float32(np.pi * spec.wavelength_nm * 1e-6) for f in (fy, fx))

    def irradiance(self, phase_rad: npt.NDArray[np.floating], pose: MaskPose) -> Image:
        """Return the light on the camera's pixels, float32 (height, width).

        In units of the mean over the field of view that an ideal SLM without losses would give.

        Parameters
        ----------
        phase_rad : ndarray, real, (height, width)
            Phase at every SLM pixel, errors of the SLM included.
        pose : MaskPose
        """
        field = self._on_mask(phase_rad, pose)
        field *= self._mask
        return self._on_sensor(field, pose.roll_mrad)

    def _on_mask(self, phase_rad: npt.NDArray[np.floating], pose: MaskPose) -> Complex:
        """Return the field that reaches the mask, in the mask's frame."""
        spec = self.spec
        stray = np.sqrt(spec.dc_power) * np.exp(1j * spec.dc_phase_rad)
        modulated = np.sqrt(1 - spec.dc_power) * (
            spec.fill * np.exp(1j * phase_rad) + (1 - spec.fill) * np.exp(1j * spec.dc_phase_rad)
        )
        field = np.empty(self._mask.shape, np.complex64)
        corner_um = 0.5 * spec.mask_pitch_um * np.hypot(*self._coarse)
        _resample(
            (modulated + stray).astype(np.complex64),
            field,
            (spec.mask_pitch_um / spec.oversampling, spec.slm_pitch_um),
            (pose.shift_x_um, pose.shift_y_um),
            (
                (1 + spec.magnification) * np.cos(pose.roll_mrad * 1e-3),
                (1 + spec.magnification) * np.sin(pose.roll_mrad * 1e-3),
            ),
            spec.relay_distortion_um / corner_um**3,
            spec.relay_centre_um,
        )
        tilted = pose.pitch_mrad != 0 or pose.yaw_mrad != 0
        if pose.z_um == 0 and not tilted:
            return field
        spectrum = scipy.fft.fft2(field, overwrite_x=True, workers=self.threads)
        down, across = (np.exp(np.complex64(-1j * pose.z_um * 1e-3) * f2) for f2 in self._f2)
        slope = np.empty_like(spectrum) if tilted else None
        _propagate(spectrum, down, across)
        if slope is not None:
            _slope(spectrum, slope, *self._f2)
        field = scipy.fft.ifft2(spectrum, overwrite_x=True, workers=self.threads)
        if slope is not None:
            # The tilt moves the mask by some ten micrometres at its border: first order in z is enough.
            height, width = field.shape
            pitch_mm = spec.mask_pitch_um * 1e-3 / spec.oversampling
            y, x = ((np.arange(m, dtype=np.float32) - (m - 1) / 2) * pitch_mm for m in (height, width))
            depth_mm = (1e-3 * (pose.pitch_mrad * y[:, None] + pose.yaw_mrad * x)).astype(np.float32)
            field += depth_mm * scipy.fft.ifft2(slope, overwrite_x=True, workers=self.threads)
        return np.asarray(field, np.complex64)

    def _on_sensor(self, field: Complex, mask_roll_mrad: float) -> Image:
        """Fourier transform by the lens, stop at the field of view, integrate over camera pixels.

        The far field turns with the mask, the camera stays.
        """
        spec, n = self.spec, self.spec.oversampling
        height, width = self._coarse
        far = scipy.fft.fft2(field, overwrite_x=True, workers=self.threads)
        # Only the field of view is kept, twice as finely sampled, with the sampled cells' own envelope.
        rows = scipy.fft.fftfreq(height, 1 / height).astype(int)
        columns = scipy.fft.fftfreq(width, 1 / width).astype(int)
        ey, ex = (np.sinc(scipy.fft.fftfreq(m)).astype(np.complex64) for m in far.shape)
        inside = far[np.ix_(rows, columns)]
        _propagate(inside, ey[rows], ex[columns])
        inside = scipy.fft.ifft2(inside, overwrite_x=True, workers=self.threads)
        fine = scipy.fft.fft2(inside, (2 * height, 2 * width), workers=self.threads)
        scale = 1.0 / (n**4 * height * width)
        sums = np.zeros((fine.shape[0] + 1, fine.shape[1] + 1))
        _add_up(fine, sums)
        sensor = np.empty(spec.sensor_shape, np.float32)
        _integrate(
            sums,
            sensor,
            spec.sensor_pitch_um / spec.field_um,
            spec.sensor_offset_um[0] / spec.field_um,
            spec.sensor_offset_um[1] / spec.field_um,
            (spec.sensor_roll_mrad - mask_roll_mrad) * 1e-3,
            4 * spec.lens_distortion,
            scale,
        )
        return sensor


@compiled
def _resample(
    slm: Complex,
    field: Complex,
    pitches_um: tuple[float, float],
    shift_um: tuple[float, float],
    turn: tuple[float, float],
    cubic: float,
    centre_um: tuple[float, float],
) -> None:
    """Average the SLM's image over every cell of the mask's frame; dark outside the SLM.

    Pitches are of the cells and of the SLM; ``turn`` is cosine and sine, times the scale.
    """
    height, width = field.shape
    (pitch_um, slm_pitch_um), (cosine, sine) = pitches_um, turn
    (shift_x_um, shift_y_um), (centre_x_um, centre_y_um) = shift_um, centre_um
    part = pitch_um / slm_pitch_um
    for i in range(height):
        y_mask = (i - 0.5 * (height - 1)) * pitch_um
        for j in range(width):
            x_mask = (j - 0.5 * (width - 1)) * pitch_um
            x = cosine * x_mask - sine * y_mask + shift_x_um
            y = sine * x_mask + cosine * y_mask + shift_y_um
            across, down = x - centre_x_um, y - centre_y_um
            stretch = cubic * (across * across + down * down)
            u = (x + stretch * across) / slm_pitch_um + 0.5 * slm.shape[1] - 0.5 * part
            v = (y + stretch * down) / slm_pitch_um + 0.5 * slm.shape[0] - 0.5 * part
            column, row = int(np.floor(u)), int(np.floor(v))
            right = max(0.0, u + part - (column + 1)) / part
            below = max(0.0, v + part - (row + 1)) / part
            total = 0j
            for r in range(2):
                weight_y = below if r else 1.0 - below
                if weight_y == 0.0 or not 0 <= row + r < slm.shape[0]:
                    continue
                for c in range(2):
                    weight = weight_y * (right if c else 1.0 - right)
                    if weight > 0.0 and 0 <= column + c < slm.shape[1]:
                        total += weight * slm[row + r, column + c]
            field[i, j] = total


@compiled
def _propagate(spectrum: Complex, down: Complex, across: Complex) -> None:
    """Multiply by a column times a row, in place."""
    for i in range(spectrum.shape[0]):
        for j in range(spectrum.shape[1]):
            spectrum[i, j] *= down[i] * across[j]


@compiled
def _slope(spectrum: Complex, slope: Complex, fy2: Image, fx2: Image) -> None:
    """Write the derivative of a spectrum with respect to distance."""
    for i in range(spectrum.shape[0]):
        for j in range(spectrum.shape[1]):
            value = spectrum[i, j] * (fy2[i] + fx2[j])
            slope[i, j] = complex(value.imag, -value.real)


@compiled
def _add_up(field: Complex, sums: npt.NDArray[np.float64]) -> None:
    """Write ``sums[i, j]``: intensity above row ``i`` and left of column ``j``, the axis in the middle."""
    height, width = field.shape
    for i in range(height):
        row = field[(i + height - height // 2) % height]
        total = 0.0
        for j in range(width):
            value = row[(j + width - width // 2) % width]
            total += value.real * value.real + value.imag * value.imag
            sums[i + 1, j + 1] = sums[i, j + 1] + total


@compiled
def _sum_up_to(sums: npt.NDArray[np.float64], y: float, x: float) -> float:
    """Integral of the intensity from the corner to a point between samples."""
    y = min(max(y, 0.0), sums.shape[0] - 1.0)
    x = min(max(x, 0.0), sums.shape[1] - 1.0)
    i, j = min(int(y), sums.shape[0] - 2), min(int(x), sums.shape[1] - 2)
    y, x = y - i, x - j
    above = sums[i, j] * (1 - x) + sums[i, j + 1] * x
    below = sums[i + 1, j] * (1 - x) + sums[i + 1, j + 1] * x
    between: float = above * (1 - y) + below * y
    return between


@compiled
def _integrate(
    sums: npt.NDArray[np.float64],
    sensor: Image,
    pixel: float,
    offset_y: float,
    offset_x: float,
    roll: float,
    cubic: float,
    scale: float,
) -> None:
    """Mean intensity over every camera pixel; lengths in units of the field of view."""
    height, width = sums.shape[0] - 1, sums.shape[1] - 1
    for i in range(sensor.shape[0]):
        for j in range(sensor.shape[1]):
            a = (i - 0.5 * (sensor.shape[0] - 1)) * pixel + offset_y
            b = (j - 0.5 * (sensor.shape[1] - 1)) * pixel + offset_x
            y, x = a + roll * b, b - roll * a
            # The lens moves the image point at r to r (1 + cubic r^2); here its inverse, to first order.
            shrink = 1.0 / (1.0 + cubic * (x * x + y * y))
            y, x = y * shrink, x * shrink
            # Sample k of n lies at (k - n / 2) / n and stands for the light half a step around it.
            top, left = (y + 0.5 - pixel / 2) * height + 0.5, (x + 0.5 - pixel / 2) * width + 0.5
            down, right = top + pixel * height, left + pixel * width
            total = (
                _sum_up_to(sums, down, right)
                - _sum_up_to(sums, top, right)
                - _sum_up_to(sums, down, left)
                + _sum_up_to(sums, top, left)
            )
            sensor[i, j] = total * scale / ((down - top) * (right - left))
