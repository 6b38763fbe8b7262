"""The camera of one depth: convolve with the PSF, crop to the sensor (Kuo 2020, Eqs. 3.4 and 3.8).

Centring, the one convention of the project: **the centre pixel of any image of n pixels is pixel n // 2.**
A source on the axis casts the PSF image as it was calibrated: its centre pixel falls on the sensor's centre
pixel. A source one object pixel further along the columns shifts the pattern by one sensor pixel that way.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.camera.base import Array, LinearOperator


class PadCropConvolution(LinearOperator):
    """Linear convolution of an object larger than the sensor with a PSF, cropped to the sensor.

    ``A = C F^-1 diag(F P h) F`` (Eq. 3.4). The object lives on the whole FFT grid. Every object pixel that
    can reach the sensor is simulated, without wrap-around; the grid's pixels beyond those (it is rounded up
    to a fast FFT length) do not reach the sensor at all.

    Parameters
    ----------
    psfs : ndarray, (n_channels or 1, psf_height, psf_width)
        One PSF a channel, or one for all. The PSF need not have the sensor's size.
    sensor_shape : (int, int)
        ``(height, width)`` of the data.
    n_channels : int, optional
        Number of channels of object and data when one PSF serves all; default as many as there are PSFs.
    grid_shape : (int, int), optional
        FFT grid, at least ``sensor + psf - 1``; default the next fast one.
    dtype : dtype
        float32 or float64.

    Attributes
    ----------
    grid_shape : (int, int)
        FFT grid.
    field_shape : (int, int)
        Part of the grid, from its first pixel, that can reach the sensor: ``sensor + psf - 1``.
    centre : (int, int)
        Object pixel on the axis.
    corner : (int, int)
        Grid position of the sensor's first pixel in ``circular(x)``.
    spectrum : ndarray, complex, (n_channels or 1, grid_height, grid_width // 2 + 1)
        Transfer function.
    """

    def __init__(
        self,
        psfs: Array,
        sensor_shape: tuple[int, int],
        *,
        n_channels: int | None = None,
        grid_shape: tuple[int, int] | None = None,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        if psfs.ndim != 3:
            raise ValueError(f"psfs must be (n_channels, height, width), not {psfs.shape}.")
        n_channels = len(psfs) if n_channels is None else n_channels
        if len(psfs) not in (1, n_channels):
            raise ValueError(f"{len(psfs)} PSFs do not serve {n_channels} channels: give 1 or {n_channels}.")
        psf_shape = psfs.shape[1:]
        self.sensor_shape = (int(sensor_shape[0]), int(sensor_shape[1]))
        self.field_shape = tuple(s + p - 1 for s, p in zip(self.sensor_shape, psf_shape, strict=True))
        self.grid_shape = fft.fast_shape(self.field_shape) if grid_shape is None else tuple(grid_shape)
        if any(g < f for g, f in zip(self.grid_shape, self.field_shape, strict=True)):
            raise ValueError(f"A grid of {self.grid_shape} does not hold the field {self.field_shape}.")
        # With the PSF in the grid's first corner, sensor pixel i is grid pixel i + psf - 1 ("valid" part).
        self.corner = (psf_shape[0] - 1, psf_shape[1] - 1)
        self.centre = (
            self.sensor_shape[0] // 2 + psf_shape[0] - 1 - psf_shape[0] // 2,
            self.sensor_shape[1] // 2 + psf_shape[1] - 1 - psf_shape[1] // 2,
        )
        super().__init__((n_channels, *self.grid_shape), (n_channels, *self.sensor_shape), dtype)
        fft.ensure_compiled(self.dtype)
        padded = np.zeros((len(psfs), *self.grid_shape), self.dtype)
        padded[:, : psf_shape[0], : psf_shape[1]] = psfs
        self.spectrum = fft.rfft(padded)
        # Only the rows of the grid that hold the sensor are ever transformed to or from real space.
        self._rows = np.empty((n_channels, self.sensor_shape[0], self.grid_shape[1]), self.dtype)
        self._spectrum_work = np.empty(fft.spectrum_shape(self.domain_shape), fft.complex_dtype(self.dtype))
        self._norm_bound = float(np.sqrt(np.max(self.power)))

    @property
    def power(self) -> Array:
        """``|H|^2``, the eigenvalues of the circular convolution's normal operator."""
        power: Array = self.spectrum.real**2 + self.spectrum.imag**2
        return power

    @property
    def sensor_window(self) -> tuple[slice, slice, slice]:
        """Where the sensor lies in ``circular(x)``."""
        (top, left), (height, width) = self.corner, self.sensor_shape
        return (slice(None), slice(top, top + height), slice(left, left + width))

    def circular(self, x: Array, out: Array | None = None) -> Array:
        """Circular convolution on the grid: what a sensor as large as the grid would see."""
        X = fft.rfft(x, out=self._spectrum_work)
        fft.multiply(X, self.spectrum)
        return fft.irfft(X, self.grid_shape[1], out=out)

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of the object ``x``."""
        X = fft.rfft(x, out=self._spectrum_work)
        fft.multiply(X, self.spectrum)
        rows = fft.irfft_strip(X, self.corner[0], self._rows)
        cropped = rows[self._columns]
        if out is None:
            return cropped.copy()
        out[...] = cropped
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Correlate sensor data ``y`` with the PSF (Eq. 3.8)."""
        self._rows[...] = 0
        self._rows[self._columns] = y
        X = fft.rfft_strip(self._rows, self.corner[0], self._spectrum_work)
        fft.multiply(X, self.spectrum, conjugate=True)
        return fft.irfft(X, self.grid_shape[1], out=out)

    @property
    def _columns(self) -> tuple[slice, slice, slice]:
        return (slice(None), slice(None), self.sensor_window[2])

    @property
    def norm_bound(self) -> float:
        """``max |H|``: cropping can only lessen the norm of the circular convolution."""
        return self._norm_bound
