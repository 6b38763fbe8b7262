"""A camera whose PSF changes over the field, on a GPU's arrays: each part of a strip transformed whole.

The same sum as :class:`recon.camera.spatially_varying.SpatiallyVarying` without its compiled passes, which
save transforms that a processor waits for and a GPU does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base import fft
from recon.base.namespace import Namespace, namespace_of, to_host
from recon.camera.base import LinearOperator, estimate_norm
from recon.camera.spatially_varying import Axis, Strip


@dataclass(frozen=True)
class _Placed:
    """A part of a strip: where it takes its object from, and where on the sensor it goes.

    ``masks`` (n, rows, columns) and ``spectra`` (n_channels or 1, n, rows, half of the columns) are on the
    device; ``local`` is what of the transform's ``shape`` falls on ``sensor``.
    """

    z: int
    window: tuple[slice, slice]
    shape: tuple[int, int]
    local: tuple[slice, slice]
    sensor: tuple[slice, slice]
    masks: Array
    spectra: Array


class VaryingOnDevice(LinearOperator):
    """Sum over strips of masked convolutions, cropped to the sensor, on a device.

    Arrays of the host are taken too, and answered with arrays of the host.

    Parameters
    ----------
    strips, field_shape, sensor_shape, n_z, n_channels, dtype
        As of :class:`~recon.camera.spatially_varying.SpatiallyVarying`.
    xp : module
        Whose arrays: ``cupy``.
    """

    def __init__(
        self,
        strips: list[Strip],
        field_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
        *,
        n_z: int = 1,
        n_channels: int = 1,
        dtype: npt.DTypeLike = np.float32,
        xp: Namespace,
    ) -> None:
        super().__init__((n_channels, n_z, *field_shape), (n_channels, *sensor_shape), dtype)
        self.xp = xp
        self._norm: float | None = None
        placed = (self._placed(strip, number) for strip in strips for number in range(len(strip.parts)))
        self._parts = [part for part in placed if part is not None]

    def _placed(self, strip: Strip, number: int) -> _Placed | None:
        """Put a part on its grid; None where nothing of it reaches the sensor."""
        part, (top, columns) = strip.parts[number], strip.window
        psf, sensor = part.psfs.shape[2:], self.range_shape[1:]
        window = part.rows, columns
        axes = [
            Axis.of(w.start + strip.offset[i], w.stop - w.start, psf[i], sensor[i], real=bool(i))
            for i, w in enumerate(window)
        ]
        if not all(axis.count for axis in axes):
            return None
        rows = slice(part.rows.start - top.start, part.rows.stop - top.start)
        masks = strip.masks[part.members]
        masks = (masks if masks.shape[1] == 1 else masks[:, rows]) * part.weights[:, :, None]
        shape = axes[0].length, axes[1].length
        padded = self.xp.zeros((*part.psfs.shape[:2], *shape), self.dtype)
        padded[..., : psf[0], : psf[1]] = self.xp.asarray(part.psfs.astype(self.dtype, copy=False))
        return _Placed(
            strip.z,
            window,
            shape,
            (_span(axes[0].local, axes[0].count), _span(axes[1].local, axes[1].count)),
            (_span(axes[0].sensor, axes[0].count), _span(axes[1].sensor, axes[1].count)),
            self.xp.asarray(masks.astype(self.dtype, copy=False)),
            fft.rfft(padded),
        )

    @property
    def nbytes(self) -> int:
        """Memory of the device that transfer functions and weights take."""
        return sum(int(part.masks.nbytes + part.spectra.nbytes) for part in self._parts)

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of ``x``."""
        xp = self.xp
        seen = xp.zeros(self.range_shape, self.dtype)
        objects = xp.asarray(x)
        for part in self._parts:
            rows, columns = part.masks.shape[1:]
            for channel in range(len(seen)):
                cast = xp.zeros((len(part.masks), *part.shape), self.dtype)
                cast[:, :rows, :columns] = objects[channel, part.z][part.window] * part.masks
                total = (fft.rfft(cast) * self._transfer(part, channel)).sum(axis=0)
                seen[channel][part.sensor] += fft.irfft(total, part.shape[1])[part.local]
        return self._answered(seen, x, out)

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return the exact transpose: correlate with each PSF, then mask."""
        xp = self.xp
        back = xp.zeros(self.domain_shape, self.dtype)
        images = xp.asarray(y)
        for part in self._parts:
            rows, columns = part.masks.shape[1:]
            for channel in range(len(images)):
                cast = xp.zeros(part.shape, self.dtype)
                cast[part.local] = images[channel][part.sensor]
                spectra = fft.rfft(cast) * self._transfer(part, channel).conj()
                found = fft.irfft(spectra, part.shape[1])[:, :rows, :columns]
                back[channel, part.z][part.window] += (found * part.masks).sum(axis=0)
        return self._answered(back, y, out)

    @staticmethod
    def _transfer(part: _Placed, channel: int) -> Array:
        transfer: Array = part.spectra[channel if len(part.spectra) > 1 else 0]
        return transfer

    def _answered(self, result: Array, asked: Array, out: Array | None) -> Array:
        """Return a result where its question came from, in ``out`` where there is one."""
        if self.xp is not np and namespace_of(asked) is np:
            result = to_host(result)
        if out is None:
            return result
        out[...] = result
        return out

    @property
    def norm_bound(self) -> float:
        """Spectral norm by power iteration, from below within a few per cent, and a tenth more."""
        if self._norm is None:
            self._norm = 1.1 * estimate_norm(self)
        return self._norm


def _span(start: int, count: int) -> slice:
    return slice(start, start + count)
