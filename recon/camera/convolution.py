"""The camera of one or many depths: convolve with each PSF, sum, crop to the sensor (Kuo 2020, Eq. 4.4).

Centring, the one convention of the project: **the centre pixel of any image of n pixels is pixel n // 2.**
A source on the axis casts the PSF image as it was calibrated: its centre pixel falls on the sensor's centre
pixel. A source one object pixel further along the columns shifts the pattern by one sensor pixel that way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base import fft
from recon.base.arguments import require_numbers, require_shape
from recon.base.checks import require_finite
from recon.base.threads import in_blocks
from recon.camera.base import LinearOperator
from recon.errors import InputError

GROUPS = 8
"""Partial sums a stack is summed in: the largest number of workers that a sum over depth can use."""


class PlaneGroups:
    """A fixed partition of ``n_planes`` depth planes into at most ``GROUPS`` runs.

    Sums over depth are taken within each run, plane after plane, and then over the runs in order: the result
    is the same to the last bit for any number of threads.
    """

    def __init__(self, n_planes: int) -> None:
        self.n_planes = n_planes
        self.count = min(GROUPS, n_planes)
        self.edges: npt.NDArray[np.int64] = np.arange(self.count + 1) * n_planes // max(self.count, 1)
        self.of_plane = np.repeat(np.arange(self.count), np.diff(self.edges))

    def run(self, job: Callable[[int, int, int], object]) -> None:
        """Call ``job(group, first_plane, last_plane + 1)`` for every group, on as many workers as allowed."""

        def block(start: int, stop: int) -> None:
            for group in range(start, stop):
                job(group, int(self.edges[group]), int(self.edges[group + 1]))

        if self.count:
            in_blocks(block, self.count)


def field_of(
    sensor_shape: tuple[int, ...], psf_shape: tuple[int, ...]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return shape and axis of the field that can reach the sensor, both (row, column)."""
    height, width = (s + p - 1 for s, p in zip(sensor_shape, psf_shape, strict=True))
    row, column = (s // 2 + p - 1 - p // 2 for s, p in zip(sensor_shape, psf_shape, strict=True))
    return (height, width), (row, column)


class Convolution(LinearOperator):
    """Linear convolution of an object larger than the sensor with a PSF a depth, cropped to the sensor.

    ``A x = C F^-1 sum_z diag(H_z) F x_z`` (Eq. 3.4 for one depth): n_z + 1 two-dimensional transforms, and no
    three-dimensional array besides object and transfer functions. (The dissertation writes the same sum as
    one slice of a circular three-dimensional convolution, Eq. A.5.) The object lives on the whole FFT grid.
    Every object pixel that can reach the sensor is simulated, without wrap-around; the grid's pixels beyond
    those (it is rounded up to a fast FFT length) do not reach the sensor at all.

    Parameters
    ----------
    psfs : ndarray, (n_z, n_channels or 1, psf_height, psf_width) or (n_channels or 1, psf_height, psf_width)
        One PSF a depth and channel, or one for all channels; without depths the camera of a picture, whose
        object has none either. The PSF need not have the sensor's size.
    sensor_shape : (int, int), optional
        ``(height, width)`` of the data; default the PSFs' own.
    n_channels : int, optional
        Number of channels of object and data when one PSF serves all; default as many as ``psfs`` has.
    grid_shape : (int, int), optional
        FFT grid, at least ``sensor + psf - 1``; default the next fast one.
    dtype : dtype
        float32 or float64.
    allocate : callable
        ``allocate(shape, dtype)`` returns an array for the transfer functions, e.g. one on disk.

    Attributes
    ----------
    domain_shape : (n_channels, n_z, grid_height, grid_width)
        Without n_z for a picture.
    range_shape : (n_channels, height, width)
    n_z : int
    grid_shape : (int, int)
        FFT grid.
    field_shape : (int, int)
        Part of the grid, from its first pixel, that can reach the sensor: ``sensor + psf - 1``.
    centre : (int, int)
        Object pixel on the axis.
    corner : (int, int)
        Grid position of the sensor's first pixel.
    spectrum : ndarray, complex, (n_channels or 1, n_z, grid_height, grid_width // 2 + 1)
        Transfer functions; a volume of memory, taken when they are first needed.
    """

    def __init__(
        self,
        psfs: Array,
        sensor_shape: tuple[int, int] | None = None,
        *,
        n_channels: int | None = None,
        grid_shape: tuple[int, int] | None = None,
        dtype: npt.DTypeLike = np.float32,
        allocate: Callable[[tuple[int, ...], npt.DTypeLike], Array] = np.empty,
    ) -> None:
        if getattr(psfs, "ndim", 0) == 0 or psfs.dtype.kind not in "uifb":
            expected = "an array ([n_z, ]n_channels, height, width) of real numbers"
            psfs = require_numbers("psfs", psfs, expected)
        if psfs.ndim not in (3, 4):
            grey = " A grey one is psf[None]." if psfs.ndim == 2 else ""
            raise InputError(f"psfs must be ([n_z, ]n_channels, height, width), not {psfs.shape}.{grey}")
        if len(psfs) == 0:
            raise InputError("The list of depths is empty: a volume needs at least one PSF.")
        if not np.isfinite(float(psfs.sum(dtype=np.float64))):
            require_finite(psfs, "PSF")
        self.is_picture = psfs.ndim == 3
        self._psfs = psfs[None] if self.is_picture else psfs
        self.n_z, own_channels, *psf_shape = self._psfs.shape
        n_channels = own_channels if n_channels is None else n_channels
        if own_channels not in (1, n_channels):
            raise InputError(
                f"PSFs of {own_channels} channels do not serve {n_channels}: give 1 or {n_channels}."
            )
        given = psf_shape if sensor_shape is None else sensor_shape
        self.sensor_shape = require_shape("sensor_shape", given)
        self.field_shape, self.centre = field_of(self.sensor_shape, tuple(psf_shape))
        height, width = fft.fast_shape(self.field_shape) if grid_shape is None else grid_shape
        self.grid_shape = (height, width)
        if any(g < f for g, f in zip(self.grid_shape, self.field_shape, strict=True)):
            raise InputError(f"A grid of {self.grid_shape} does not hold the field {self.field_shape}.")
        # With the PSF in the grid's first corner, sensor pixel i is grid pixel i + psf - 1 ("valid" part).
        self.corner = (psf_shape[0] - 1, psf_shape[1] - 1)
        depths = () if self.is_picture else (self.n_z,)
        super().__init__((n_channels, *depths, *self.grid_shape), (n_channels, *self.sensor_shape), dtype)
        fft.ensure_compiled(self.dtype)
        self._allocate = allocate
        self.groups = PlaneGroups(self.n_z)
        self._work = np.empty(self.grid_shape, self.dtype)

    def transfer_plane(self, z: int, channel: int = 0, out: Array | None = None) -> Array:
        """Return the transfer function of one depth, computed from its PSF."""
        psf = self._psfs[z, channel]
        self._work[...] = 0
        self._work[: psf.shape[0], : psf.shape[1]] = psf
        return fft.rfft(self._work, out=out)

    @cached_property
    def spectrum(self) -> Array:
        """Transfer functions of all depths; computed when first needed and then kept."""
        n_z, channels = self._psfs.shape[:2]
        spectrum = self._allocate(
            (channels, n_z, *fft.spectrum_shape(self.grid_shape)), fft.complex_dtype(self.dtype)
        )
        for channel in range(channels):
            for z in range(n_z):
                self.transfer_plane(z, channel, spectrum[channel, z])
        return spectrum

    def power(self, planes: Iterable[int] | None = None) -> Array:
        """``sum_z |H_z|^2`` (of some planes): eigenvalues of ``A A^H`` before the crop.

        Returns
        -------
        ndarray, (n_channels or 1, grid_height, grid_width // 2 + 1)
        """
        if self.n_z == 1:
            H = self.spectrum[:, 0]
            power: Array = H.real**2 + H.imag**2
            return power
        channels = self._psfs.shape[1]
        total = np.zeros((channels, *fft.spectrum_shape(self.grid_shape)), self.dtype)
        known = self.__dict__.get("spectrum")
        for z in range(self.n_z) if planes is None else planes:
            for channel in range(channels):
                H = self.transfer_plane(z, channel) if known is None else known[channel, z]
                total[channel] += H.real**2 + H.imag**2
        return total

    @property
    def sensor_window(self) -> tuple[slice, slice]:
        """Where the sensor lies on the grid."""
        (top, left), (height, width) = self.corner, self.sensor_shape
        return (slice(top, top + height), slice(left, left + width))

    def channel_spectrum(self, channel: int) -> Array:
        """Return the transfer functions that serve ``channel``: (n_z, grid_height, grid_width // 2 + 1)."""
        spectrum: Array = self.spectrum[channel if len(self.spectrum) > 1 else 0]
        return spectrum

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of the object ``x``."""
        if out is None:
            out = np.empty(self.range_shape, self.dtype)
        x = np.ascontiguousarray(x, self.dtype).reshape(-1, self.n_z, *self.grid_shape)
        if self.n_z == 1:
            rows, X, columns = self._strip
            fft.rfft(x[:, 0], out=X)
            fft.multiply(X, self.spectrum[:, 0])
            out[...] = fft.irfft_strip(X, self.corner[0], rows)[columns]
            return out
        from recon.camera import _kernels

        plane = fft.spectrum_shape(self.grid_shape)
        for channel, volume in enumerate(x):
            H = self.channel_spectrum(channel)
            sums = np.zeros((self.groups.count, *plane), H.dtype)

            def job(
                group: int, z0: int, z1: int, volume: Array = volume, H: Array = H, sums: Array = sums
            ) -> None:
                _kernels.forward_planes(volume, H, sums[group], np.empty(plane, H.dtype), z0, z1)

            self.groups.run(job)
            total = sums[0]
            for other in sums[1:]:
                total += other
            out[channel] = fft.irfft(total, self.grid_shape[1], out=self._work)[self.sensor_window]
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Correlate sensor data ``y`` with every depth's PSF (Eq. 3.8)."""
        if out is None:
            out = np.empty(self.domain_shape, self.dtype)
        if self.n_z == 1:
            rows, X, columns = self._strip
            rows[...] = 0
            rows[columns] = y
            fft.rfft_strip(rows, self.corner[0], X)
            fft.multiply(X, self.spectrum[:, 0], conjugate=True)
            fft.irfft(X, self.grid_shape[1], out=out if self.is_picture else out[:, 0])
            return out
        from recon.camera import _kernels

        E = np.empty(fft.spectrum_shape(self.grid_shape), fft.complex_dtype(self.dtype))
        for channel, volume in enumerate(out):
            H = self.channel_spectrum(channel)
            self._spectrum_of(y[channel], E)

            def job(_: int, z0: int, z1: int, volume: Array = volume, H: Array = H) -> None:
                _kernels.adjoint_planes(E, H, volume, np.empty_like(E), z0, z1)

            self.groups.run(job)
        return out

    def adjoint_planes(self, y: Array, channel: int = 0) -> Iterator[Array]:
        """Yield the adjoint of one channel's data plane by plane, without a volume in memory."""
        E = self._spectrum_of(y[channel])
        for z in range(self.n_z):
            H = self.transfer_plane(z, channel if self._psfs.shape[1] > 1 else 0)
            yield fft.irfft(np.conj(H) * E, self.grid_shape[1])

    def _spectrum_of(self, image: Array, out: Array | None = None) -> Array:
        """Return the spectrum of a sensor image on the grid."""
        self._work[...] = 0
        self._work[self.sensor_window] = image
        return fft.rfft(self._work, out=out)

    @cached_property
    def _strip(self) -> tuple[Array, Array, tuple[slice, slice, slice]]:
        """Work arrays of one plane: the grid's rows that hold the sensor, a spectrum; the sensor's columns.

        No other rows are ever transformed to or from real space.
        """
        channels = self.domain_shape[0]
        rows = np.empty((channels, self.sensor_shape[0], self.grid_shape[1]), self.dtype)
        X = np.empty((channels, *fft.spectrum_shape(self.grid_shape)), fft.complex_dtype(self.dtype))
        return rows, X, (slice(None), slice(None), self.sensor_window[1])

    @cached_property
    def norm_bound(self) -> float:
        """``sqrt(max sum_z |H_z|^2)``: cropping can only lessen the norm of the circular sum."""
        return float(np.sqrt(np.max(self.power())))
