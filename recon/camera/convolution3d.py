"""The camera of many depths: every plane with its own PSF, summed on the sensor (Kuo 2020, Eq. 4.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.camera.base import Array, LinearOperator
from recon.camera.planes import PlaneGroups
from recon.errors import InputError


class Convolution3D(LinearOperator):
    """Sum over depth of two-dimensional convolutions, cropped to the sensor.

    ``A x = C F^-1 sum_z diag(H_z) F x_z``: n_z + 1 two-dimensional transforms, and no three-dimensional array
    besides object and transfer functions. (The dissertation writes the same sum as one slice of a circular
    three-dimensional convolution, Eq. A.5.) Centring and grid are those of
    :class:`~recon.camera.convolution.PadCropConvolution`.

    Parameters
    ----------
    psfs : ndarray, (n_z, n_channels or 1, psf_height, psf_width)
        One PSF a depth, as in :class:`recon.types.Calibration`; one a channel or one for all channels.
    sensor_shape : (int, int)
        ``(height, width)`` of the data.
    n_channels : int, optional
        Number of channels of object and data when one PSF serves all; default as many as ``psfs`` has.
    dtype : dtype
        float32 or float64.
    allocate : callable
        ``allocate(shape, dtype)`` returns an array for the transfer functions, e.g. one on disk.

    Attributes
    ----------
    domain_shape : (n_channels, n_z, grid_height, grid_width)
    range_shape : (n_channels, height, width)
    field_shape, grid_shape, centre, corner
        As in ``PadCropConvolution``.
    spectrum : ndarray, complex, (n_channels or 1, n_z, grid_height, grid_width // 2 + 1)
        Transfer functions; a volume of memory, taken when they are first needed.
    """

    def __init__(
        self,
        psfs: Array,
        sensor_shape: tuple[int, int],
        *,
        n_channels: int | None = None,
        dtype: npt.DTypeLike = np.float32,
        allocate: Callable[[tuple[int, ...], npt.DTypeLike], Array] = np.empty,
    ) -> None:
        if psfs.ndim != 4:
            raise InputError(f"psfs must be (n_z, n_channels, height, width), not {psfs.shape}.")
        if len(psfs) == 0:
            raise InputError("The list of depths is empty: a volume needs at least one PSF.")
        n_channels = psfs.shape[1] if n_channels is None else n_channels
        if psfs.shape[1] not in (1, n_channels):
            raise InputError(
                f"PSFs of {psfs.shape[1]} channels do not serve {n_channels}: give 1 or {n_channels}."
            )
        psf_shape = psfs.shape[2:]
        self.sensor_shape = (int(sensor_shape[0]), int(sensor_shape[1]))
        self.field_shape = tuple(s + p - 1 for s, p in zip(self.sensor_shape, psf_shape, strict=True))
        height, width = fft.fast_shape(self.field_shape)
        self.grid_shape = (height, width)
        self.corner = (psf_shape[0] - 1, psf_shape[1] - 1)
        self.centre = (
            self.sensor_shape[0] // 2 + psf_shape[0] - 1 - psf_shape[0] // 2,
            self.sensor_shape[1] // 2 + psf_shape[1] - 1 - psf_shape[1] // 2,
        )
        n_z = len(psfs)
        super().__init__((n_channels, n_z, *self.grid_shape), (n_channels, *self.sensor_shape), dtype)
        self._psfs = psfs
        self._allocate = allocate
        self.groups = PlaneGroups(n_z)
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

    def power(self, channel: int = 0, planes: Iterable[int] | None = None) -> Array:
        """``sum_z |H_z|^2`` of one channel (of some planes): eigenvalues of ``A A^H`` before the crop."""
        total = np.zeros(fft.spectrum_shape(self.grid_shape), self.dtype)
        known = self.__dict__.get("spectrum")
        for z in range(self.domain_shape[1]) if planes is None else planes:
            H = self.transfer_plane(z, channel) if known is None else known[channel, z]
            total += H.real**2 + H.imag**2
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
        """Return what the sensor sees of the volume ``x``."""
        from recon.camera import _kernels as kernels

        if out is None:
            out = np.empty(self.range_shape, self.dtype)
        x = np.ascontiguousarray(x, self.dtype).reshape(self.domain_shape)
        plane = fft.spectrum_shape(self.grid_shape)
        for channel, volume in enumerate(x):
            H = self.channel_spectrum(channel)
            sums = np.zeros((self.groups.count, *plane), H.dtype)

            def job(
                group: int, z0: int, z1: int, volume: Array = volume, H: Array = H, sums: Array = sums
            ) -> None:
                kernels.forward_planes(volume, H, sums[group], np.empty(plane, H.dtype), z0, z1)

            self.groups.run(job)
            total = sums[0]
            for other in sums[1:]:
                total += other
            out[channel] = fft.irfft(total, self.grid_shape[1], out=self._work)[self.sensor_window]
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Correlate sensor data with every depth's PSF."""
        from recon.camera import _kernels as kernels

        if out is None:
            out = np.empty(self.domain_shape, self.dtype)
        E = np.empty(fft.spectrum_shape(self.grid_shape), fft.complex_dtype(self.dtype))
        for channel in range(self.domain_shape[0]):
            H = self.channel_spectrum(channel)
            self._work[...] = 0
            self._work[self.sensor_window] = y[channel]
            fft.rfft(self._work, out=E)
            volume = out[channel]

            def job(_: int, z0: int, z1: int, volume: Array = volume, H: Array = H) -> None:
                kernels.adjoint_planes(E, H, volume, np.empty_like(E), z0, z1)

            self.groups.run(job)
        return out

    def adjoint_planes(self, y: Array, channel: int = 0) -> Iterator[Array]:
        """Yield the adjoint of one channel's data plane by plane, without a volume in memory."""
        self._work[...] = 0
        self._work[self.sensor_window] = y[channel]
        E = fft.rfft(self._work)
        for z in range(self.domain_shape[1]):
            H = self.transfer_plane(z, channel if self._psfs.shape[1] > 1 else 0)
            yield fft.irfft(np.conj(H) * E, self.grid_shape[1])

    @cached_property
    def norm_bound(self) -> float:
        """``sqrt(max sum_z |H_z|^2)``: cropping can only lessen the norm of the circular sum."""
        return float(np.sqrt(max(float(self.power(c).max()) for c in range(self._psfs.shape[1]))))
