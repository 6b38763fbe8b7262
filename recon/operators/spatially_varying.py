"""Cameras whose PSF changes over the field: weighted objects, convolved and summed (Kuo 2020, Eqs. 5.4-5.7).

``A x = C sum_i h_i * (w_i x)``: **mask first, then convolve** (Eq. 5.5). With ``w_i`` the interpolation
weights of measured PSFs this is the local convolution model, with ``w_i`` the interpolated scores of
principal components the low-rank model. The work is cut into :class:`Group`s: PSFs that see the same window
of the object share one small FFT grid, one inverse transform and one place on the sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon import fft
from recon.errors import InputError
from recon.operators.base import Array, LinearOperator, estimate_norm
from recon.threads import in_blocks

Window = tuple[slice, slice]


@dataclass(frozen=True)
class Group:
    """PSFs that share a window of the object at one depth.

    Attributes
    ----------
    z : int
    window : (slice, slice)
        On the object's grid.
    weights : ndarray, (n, window height, window width)
    psfs : ndarray, (n_channels or 1, n, psf height, psf width)
        Cut to their support.
    origin : (int, int)
        Sensor position of the first pixel of the full convolution of window and PSF.
    """

    z: int
    window: Window
    weights: Array
    psfs: Array
    origin: tuple[int, int]


class _Placed:
    """A group on its FFT grid: spectra, and which part of the grid goes where on the sensor."""

    def __init__(self, group: Group, sensor_shape: tuple[int, int], dtype: npt.DTypeLike) -> None:
        self.z, self.window = group.z, group.window
        self.weights = np.ascontiguousarray(group.weights, dtype)
        sizes, self.sensor, self.local = [], [], []
        for axis in (0, 1):
            patch, psf = group.weights.shape[1 + axis], group.psfs.shape[2 + axis]
            start, stop = group.origin[axis], group.origin[axis] + patch + psf - 1
            first, last = max(start, 0), min(stop, sensor_shape[axis])
            # Only what falls on the sensor must be free of wrap-around: a full convolution's first
            # ``first - start`` and last ``stop - last`` pixels may be wrapped onto.
            self.sensor.append(slice(first, max(last, first)))
            self.local.append(slice(first - start, max(last, first) - start))
            needed = max(patch + psf - 1 - min(first - start, stop - last), last - start, patch, psf)
            sizes.append(max(needed, 1))
        self.shape = fft.fast_shape(sizes)
        padded = np.zeros((*group.psfs.shape[:2], *self.shape), dtype)
        padded[..., : group.psfs.shape[2], : group.psfs.shape[3]] = group.psfs
        self.spectra = fft.rfft(padded)

    @property
    def empty(self) -> bool:
        """Whether nothing of it reaches the sensor."""
        return any(s.stop <= s.start for s in self.sensor)

    def forward(self, x: Array, channel: int) -> Array:
        """Return what falls on ``sensor`` of the object ``x`` (its window)."""
        from recon.operators import _plane_kernels as kernels

        H = self.spectra[channel if len(self.spectra) > 1 else 0]
        patch = np.zeros(self.shape, x.dtype)
        total = np.zeros(H.shape[1:], H.dtype)
        scratch = np.empty_like(total)
        rows, columns = x.shape
        for weights, h in zip(self.weights, H, strict=True):
            np.multiply(weights, x, out=patch[:rows, :columns])
            kernels.to_spectrum(patch, scratch)
            kernels.add_product(total, h, scratch)
        kernels.from_spectrum(total, patch)
        result: Array = patch[self.local[0], self.local[1]]
        return result

    def adjoint(self, y: Array, channel: int) -> Array:
        """Return the window's part of the object from the sensor's part ``y``."""
        from recon.operators import _plane_kernels as kernels

        H = self.spectra[channel if len(self.spectra) > 1 else 0]
        patch = np.zeros(self.shape, y.dtype)
        patch[self.local[0], self.local[1]] = y
        data = np.empty(H.shape[1:], H.dtype)
        kernels.to_spectrum(patch, data)
        scratch = np.empty_like(data)
        _, rows, columns = self.weights.shape
        total = np.zeros((rows, columns), y.dtype)
        for weights, h in zip(self.weights, H, strict=True):
            kernels.conjugate_product(h, data, scratch)
            kernels.from_spectrum(scratch, patch)
            total += weights * patch[:rows, :columns]
        return total


class SpatiallyVarying(LinearOperator):
    """Sum over groups of masked convolutions, cropped to the sensor.

    Parameters
    ----------
    groups : sequence of Group
    field_shape : (int, int)
        Lateral shape of the object.
    sensor_shape : (int, int)
    n_z, n_channels : int
    dtype : dtype

    Attributes
    ----------
    domain_shape : (n_channels, n_z, field height, field width)
    range_shape : (n_channels, sensor height, sensor width)
    """

    def __init__(
        self,
        groups: list[Group],
        field_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
        *,
        n_z: int = 1,
        n_channels: int = 1,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        super().__init__((n_channels, n_z, *field_shape), (n_channels, *sensor_shape), dtype)
        for group in groups:
            if group.psfs.shape[0] not in (1, n_channels):
                raise InputError(
                    f"PSFs of {group.psfs.shape[0]} channels do not serve {n_channels}: give 1 or as many."
                )
        placed = [_Placed(g, sensor_shape, dtype) for g in groups]
        self._placed = [p for p in placed if not p.empty]
        self._non_negative = all((g.weights >= 0).all() and (g.psfs >= 0).all() for g in groups)
        self._norm: float | None = None

    @property
    def fft_pixels(self) -> int:
        """Pixels transformed in one forward and adjoint: the cost, to compare models by."""
        return sum(2 * int(np.prod(p.shape)) * (len(p.weights) + 1) for p in self._placed)

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of ``x``."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        out[...] = 0
        for channel in range(self.domain_shape[0]):

            def part(p: _Placed, channel: int = channel) -> Array:
                return p.forward(x[channel, p.z][p.window], channel)

            for p, seen in self._in_turn(part):
                out[channel, p.sensor[0], p.sensor[1]] += seen
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return the exact transpose: correlate with each PSF, then mask."""
        out = np.empty(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        for channel in range(self.domain_shape[0]):

            def part(p: _Placed, channel: int = channel) -> Array:
                return p.adjoint(y[channel, p.sensor[0], p.sensor[1]], channel)

            for p, back in self._in_turn(part):
                out[channel, p.z][p.window] += back
        return out

    def _in_turn(self, part: Callable[[_Placed], Array]) -> list[tuple[_Placed, Array]]:
        """Compute every group's part on all workers; the caller sums them in this fixed order."""
        found: dict[int, Array] = {}

        def job(start: int, stop: int) -> None:
            for i in range(start, stop):
                found[i] = part(self._placed[i])

        in_blocks(job, len(self._placed))
        return [(p, found[i]) for i, p in enumerate(self._placed)]

    @property
    def norm_bound(self) -> float:
        """Upper bound of the spectral norm.

        Non-negative weights and PSFs: ``sqrt(max row sum * max column sum)``, which is rigorous and close, as
        the mean of the PSFs carries the norm. Else (principal components) 50 steps of power iteration, which
        comes within a few per cent from below, and a tenth more.
        """
        if self._norm is None:
            if self._non_negative:
                rows = self.forward(np.ones(self.domain_shape, self.dtype)).max()
                columns = self.adjoint(np.ones(self.range_shape, self.dtype)).max()
                self._norm = float(np.sqrt(max(float(rows), 0.0) * max(float(columns), 0.0))) * (1 + 1e-5)
            else:
                self._norm = 1.1 * estimate_norm(self)
        return self._norm
