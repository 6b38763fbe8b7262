"""A holographic display as it is: SLM, relay, misplaced mask, Fourier lens, camera; forward physics only.

The SLM's image falls onto a scattering mask (scale 1, a relay whose distortion moves the image), the mask's
far field onto a camera in the focal plane of a lens (Kuo 2020, Fig. 7.5). The field is sampled several times
per mask pixel in the mask's own frame, SLM pixels are weighted by area at any sub-pixel place, free space
between SLM image and mask is propagated, the far field's intensity is integrated over camera pixels without
an approximation. No hologram is computed here and no optimiser shares this code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import ndimage

from recon.arrays import Float32Array
from recon.optics.jit import compiled

_BEYOND = 16
"""Samples kept on every side beyond the field of view, so that its border is interpolated from both sides."""
_TAPS, _STEPS = 8, 512
"""Samples that an interpolated one is made of, and places between two that have weights of their own."""

Complex = npt.NDArray[np.complex64]


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
    crosstalk_px : float
        Width (standard deviation) of what smooths the SLM's phase across its pixels' borders, SLM pixels.
    beam_mm : float
        Radius at which the light on the SLM has fallen to ``exp(-2)`` of its peak; 0 is even light.
    beam_centre_um : (float, float)
        ``(x, y)`` of that peak.
    wavefront_rad : float
        Root mean square of the Fourier lens' aberrations over the mask: Zernike-like polynomials of second to
        fourth order, at random.
    wavefront_seed : int
    vignetting : float
        Part of the light that the lens and the camera lose at the middle of the field's border.
    source_mrad : float
        Angular size (standard deviation) of the light source seen from the SLM: its points shine without a
        fixed phase, and each shows the picture elsewhere. 0 is fully coherent.
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
    crosstalk_px: float = 0.0
    beam_mm: float = 0.0
    beam_centre_um: tuple[float, float] = (0.0, 0.0)
    wavefront_rad: float = 0.0
    wavefront_seed: int = 0
    vignetting: float = 0.0
    source_mrad: float = 0.0

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
    """

    def __init__(self, spec: DisplaySpec, mask_phase_rad: npt.NDArray[np.floating]) -> None:
        self.spec = spec
        n = spec.oversampling
        error = spec.wavefront_rad * _wavefront(mask_phase_rad.shape, spec.wavefront_seed)
        mask = np.exp(1j * (np.asarray(mask_phase_rad) + error)).astype(np.complex64)
        self._mask = np.repeat(np.repeat(mask, n, axis=0), n, axis=1)
        self._coarse = mask.shape
        pitch_mm = spec.mask_pitch_um * 1e-3 / n
        fy, fx = (scipy.fft.fftfreq(m, pitch_mm).astype(np.float32) for m in self._mask.shape)
        self._f2 = tuple(f**2 * np.float32(np.pi * spec.wavelength_nm * 1e-6) for f in (fy, fx))

    def irradiance(
        self,
        phase_rad: npt.NDArray[np.floating],
        pose: MaskPose,
        amplitude: npt.NDArray[np.floating] | None = None,
    ) -> Float32Array:
        """Return the light on the camera's pixels, float32 (height, width).

        In units of the mean over the field of view that an ideal SLM without losses would give.

        Parameters
        ----------
        phase_rad : ndarray, real, (height, width)
            Phase at every SLM pixel, errors of the SLM included.
        pose : MaskPose
        amplitude : ndarray, real, (height, width), optional
            At every SLM pixel; 1 by default.
        """
        field = self._on_mask(phase_rad, pose, amplitude)
        field *= self._mask
        return self._on_sensor(field, pose.roll_mrad)

    def _on_mask(
        self,
        phase_rad: npt.NDArray[np.floating],
        pose: MaskPose,
        amplitude: npt.NDArray[np.floating] | None = None,
    ) -> Complex:
        """Return the field that reaches the mask, in the mask's frame."""
        spec = self.spec
        stray = np.sqrt(spec.dc_power) * np.exp(1j * spec.dc_phase_rad)
        parts = 1
        if spec.crosstalk_px > 0:
            # The phase changes within a pixel: as many samples as there are of the field, at most.
            parts = max(int(spec.slm_pitch_um * spec.oversampling / spec.mask_pitch_um), 1)
            phase_rad = _finer(phase_rad, parts)
            phase_rad = ndimage.gaussian_filter(phase_rad, spec.crosstalk_px * parts, mode="nearest")
            amplitude = None if amplitude is None else _finer(amplitude, parts)
        shown = np.exp(1j * phase_rad) if amplitude is None else amplitude * np.exp(1j * phase_rad)
        modulated = np.sqrt(1 - spec.dc_power) * (
            spec.fill * shown + (1 - spec.fill) * np.exp(1j * spec.dc_phase_rad)
        )
        light = modulated + stray
        if spec.beam_mm > 0:
            pitch_mm = spec.slm_pitch_um / parts * 1e-3
            x0, y0 = (1e-3 * at for at in spec.beam_centre_um)
            down, across = (
                np.exp(-((((np.arange(m) - (m - 1) / 2) * pitch_mm - at) / spec.beam_mm) ** 2))
                for m, at in zip(light.shape, (y0, x0), strict=True)
            )
            light *= (down / np.sqrt((down**2).mean()))[:, None] * (across / np.sqrt((across**2).mean()))
        field = np.empty(self._mask.shape, np.complex64)
        corner_um = 0.5 * spec.mask_pitch_um * np.hypot(*self._coarse)
        _resample(
            light.astype(np.complex64),
            field,
            (spec.mask_pitch_um / spec.oversampling, spec.slm_pitch_um / parts),
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
        spectrum = scipy.fft.fft2(field, overwrite_x=True)
        down, across = (np.exp(np.complex64(-1j * pose.z_um * 1e-3) * f2) for f2 in self._f2)
        slope = np.empty_like(spectrum) if tilted else None
        _propagate(spectrum, down, across)
        if slope is not None:
            _slope(spectrum, slope, *self._f2)
        field = scipy.fft.ifft2(spectrum, overwrite_x=True)
        if slope is not None:
            # The tilt moves the mask by some ten micrometres at its border: first order in z is enough.
            height, width = field.shape
            pitch_mm = spec.mask_pitch_um * 1e-3 / spec.oversampling
            y, x = ((np.arange(m, dtype=np.float32) - (m - 1) / 2) * pitch_mm for m in (height, width))
            depth_mm = (1e-3 * (pose.pitch_mrad * y[:, None] + pose.yaw_mrad * x)).astype(np.float32)
            field += depth_mm * scipy.fft.ifft2(slope, overwrite_x=True)
        return np.asarray(field, np.complex64)

    def _on_sensor(self, field: Complex, mask_roll_mrad: float) -> Float32Array:
        """Fourier transform by the lens, stop at the field of view, integrate over camera pixels.

        The far field turns with the mask, the camera stays. Its intensity has the aperture's auto-correlation
        for a spectrum, so two samples a step of the aperture's resolution hold all of it: a camera pixel's
        integral is a product there, and what lies between samples is interpolated.
        """
        spec, n = self.spec, self.spec.oversampling
        kept, far = [], field
        for axis, cells in ((1, self._coarse[1]), (0, self._coarse[0])):
            side = 2 * scipy.fft.next_fast_len(cells + _BEYOND, real=True)
            at = np.arange(side) - side // 2
            padded = scipy.fft.fft(far, 2 * n * cells, axis=axis)
            far = padded.take(at % (2 * n * cells), axis=axis)
            kept.append(np.sinc(at / (2 * n * cells)).astype(np.complex64))  # the sampled cells' own envelope
        _propagate(far, kept[1], kept[0])
        light = far.real**2 + far.imag**2
        spectrum = scipy.fft.rfft2(light, overwrite_x=True)
        pixel = spec.sensor_pitch_um / spec.field_um
        source = spec.source_mrad * spec.focal_mm / spec.field_um
        lags = scipy.fft.fftfreq(light.shape[0]), scipy.fft.rfftfreq(light.shape[1])
        periods = [lag * 2 * cells for lag, cells in zip(lags, self._coarse, strict=True)]
        down, across = (
            (np.sinc(f * pixel) * np.exp(-2 * (np.pi * f * source) ** 2)).astype(np.complex64)
            for f in periods
        )
        _propagate(spectrum, down, across)
        # Three samples a step: eight of them then make any place between, to a part in a thousand.
        half, fine = light.shape[0] // 2, (light.shape[0] * 3 // 2, light.shape[1] * 3 // 2)
        padded = np.zeros((fine[0], spectrum.shape[1]), np.complex64)
        padded[:half], padded[-half:] = spectrum[:half], spectrum[half:]
        light = scipy.fft.irfft2(padded, fine, overwrite_x=True)
        light *= np.float32(2.25 / (n**4 * self._coarse[0] * self._coarse[1]))
        sensor = np.empty(spec.sensor_shape, np.float32)
        _read(
            light,
            _taps(),
            sensor,
            self._coarse,
            pixel,
            (spec.sensor_offset_um[0] / spec.field_um, spec.sensor_offset_um[1] / spec.field_um),
            (spec.sensor_roll_mrad - mask_roll_mrad) * 1e-3,
            (4 * spec.lens_distortion, 4 * spec.vignetting),
        )
        return sensor


def _finer(values: npt.NDArray[np.floating], parts: int) -> npt.NDArray[np.floating]:
    return np.repeat(np.repeat(values, parts, axis=0), parts, axis=1)


def _wavefront(shape: tuple[int, ...], seed: int) -> Float32Array:
    """Return random aberrations of second to fourth order over an aperture, mean 0, rms 1."""
    rng = np.random.default_rng(seed)
    y, x = (np.linspace(-1, 1, n) * n / max(shape) for n in shape)
    total = np.zeros(shape)
    for order in (2, 3, 4):
        for i in range(order + 1):
            term = np.multiply.outer(y**i, x ** (order - i))
            total += rng.normal() / order * (term - term.mean()) / term.std()
    total -= total.mean()
    return np.asarray(total / total.std(), np.float32)


def _taps() -> Float32Array:
    """Return the weights of ``_TAPS`` samples for every ``1 / _STEPS`` between two of them, sum 1."""
    away = np.arange(_TAPS) - (_TAPS // 2 - 1) - np.arange(_STEPS + 1)[:, None] / _STEPS
    taper = np.i0(6.0 * np.sqrt(np.clip(1 - (2 * away / _TAPS) ** 2, 0, None)))
    weights = np.sinc(away) * taper
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)


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
def _slope(spectrum: Complex, slope: Complex, fy2: Float32Array, fx2: Float32Array) -> None:
    """Write the derivative of a spectrum with respect to distance."""
    for i in range(spectrum.shape[0]):
        for j in range(spectrum.shape[1]):
            value = spectrum[i, j] * (fy2[i] + fx2[j])
            slope[i, j] = complex(value.imag, -value.real)


@compiled
def _read(
    light: Float32Array,
    taps: Float32Array,
    sensor: Float32Array,
    cells: tuple[int, int],
    pixel: float,
    offset: tuple[float, float],
    roll: float,
    radial: tuple[float, float],
) -> None:
    """Interpolate pixel means to every camera pixel's place; lengths in units of the field of view.

    ``radial`` is the distortion and the light lost, at a distance of 1. Beyond the field it is
    dark; a pixel on its border has the part that is inside.
    """
    cubic, lost = radial
    cos, sin = np.cos(roll), np.sin(roll)
    for i in range(sensor.shape[0]):
        for j in range(sensor.shape[1]):
            a = (i - 0.5 * (sensor.shape[0] - 1)) * pixel + offset[0]
            b = (j - 0.5 * (sensor.shape[1] - 1)) * pixel + offset[1]
            y, x = cos * a + sin * b, cos * b - sin * a
            # The lens moves the image point at r to r (1 + cubic r^2); here its inverse, to first order.
            shrink = 1.0 / (1.0 + cubic * (x * x + y * y))
            y, x = y * shrink, x * shrink
            part_y = min(max((0.5 - abs(y)) / pixel + 0.5, 0.0), 1.0)
            part_x = min(max((0.5 - abs(x)) / pixel + 0.5, 0.0), 1.0)
            if part_y == 0.0 or part_x == 0.0:
                sensor[i, j] = 0.0
                continue
            v = 3 * y * cells[0] + 0.5 * light.shape[0]
            u = 3 * x * cells[1] + 0.5 * light.shape[1]
            row, column = int(np.floor(v)), int(np.floor(u))
            down = taps[int((v - row) * _STEPS + 0.5)]
            across = taps[int((u - column) * _STEPS + 0.5)]
            total = 0.0
            for r in range(_TAPS):
                line = light[(row + r - _TAPS // 2 + 1) % light.shape[0]]
                inner = 0.0
                for c in range(_TAPS):
                    inner += across[c] * line[(column + c - _TAPS // 2 + 1) % light.shape[1]]
                total += down[r] * inner
            passed = max(1.0 - lost * (y * y + x * x), 0.0)
            sensor[i, j] = max(total, 0.0) * part_y * part_x * passed
