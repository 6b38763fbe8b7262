"""A hologram's loss and gradient on a GPU's arrays: what the model's compiled loops do, by whole arrays.

For a far picture through a mask in its place, by any loss; the search keeps its vectors on the device too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.arrays import Array
from recon.base.namespace import Namespace
from recon.holography.losses import Loss
from recon.holography.target import Band

DeviceArray = Any
"""Of the device."""


@dataclass(frozen=True)
class Tables:
    """What a model is made of, in the host's memory.

    Attributes
    ----------
    band : Band
    loss : Loss
    cutoff : float
        Of the loss's low-pass; 0: none.
    behind : list of ndarray, complex, (height, width)
        For each plane what the mask and the way there make of light.
    envelope : ndarray, ``band.shape``
    wanted : list of ndarray
        The targets' kept lags, a plane each.
    images : list of ndarray or None
        The same as images, for losses that look at them.
    peaks : tuple of float
    weights, inside : ndarray or None
        Over the field, and where it counts.
    factor : int
        Mask pixels a pixel of the SLM.
    modulated, amplitude : float, complex
        Of light that the SLM turns, and that it does not.
    dtype : dtype
    """

    band: Band
    loss: Loss
    cutoff: float
    behind: list[Array]
    envelope: Array
    wanted: list[Array]
    images: list[Array | None]
    peaks: tuple[float, ...]
    weights: Array | None
    inside: Array | None
    factor: int
    modulated: float
    amplitude: complex
    dtype: np.dtype[Any]


class OnDevice:
    """A model's tables on a device, and what is computed with them."""

    def __init__(self, xp: Namespace, tables: Tables) -> None:
        self.xp, self.tables = xp, tables
        self.real = np.empty(0, tables.dtype).real.dtype

        def there(array: Array | None) -> DeviceArray:
            return None if array is None else xp.asarray(array)

        self._behind = [there(one) for one in tables.behind]
        self._wanted, self._images = (
            [there(one) for one in tables.wanted],
            [there(one) for one in tables.images],
        )
        self._envelope, self._weights, self._inside = map(
            there, (tables.envelope, tables.weights, tables.inside)
        )
        band = tables.band
        y, x = band.lags()
        self._passed, self._filter = (self._low_pass(y, x, cutoff) for cutoff in (band.cutoff, tables.cutoff))
        twice = np.full(band.kept[1], 2.0)  # the mirrored half counts too
        twice[0] = 1.0
        if band.full:
            twice[-1] = 1.0
        self._twice = xp.asarray(twice)

    def _low_pass(self, y: DeviceArray, x: DeviceArray, cutoff: float) -> DeviceArray:
        """Kuo 2020, Eq. 7.18, on the kept lags; everything passes where the cut-off is 0."""
        r = (y[:, None] ** 2 + x**2) / cutoff**2 if cutoff else np.zeros((len(y), len(x)))
        return self.xp.asarray((1 / (1 + r**5)).astype(self.real))

    def evaluate(self, slm: DeviceArray) -> tuple[float, DeviceArray, float]:
        """Return loss, gradient by the SLM's field, (n_frames, height, width), and relative square error."""
        xp, model = self.xp, self.tables
        shape = model.band.shape
        sent = xp.asarray(slm, dtype=model.dtype)
        sent = sent * model.dtype.type(model.modulated) + model.dtype.type(model.amplitude)
        k = model.factor
        cells = xp.repeat(xp.repeat(sent, k, axis=1), k, axis=2)
        height, width = cells.shape[1:]
        gradient = xp.zeros(sent.shape, model.dtype)
        loss = error = 0.0
        for plane, behind in enumerate(self._behind):
            fields = xp.zeros((len(sent), *shape), model.dtype)
            fields[:, :height, :width] = cells * behind
            fields = xp.fft.fft2(fields).astype(model.dtype, copy=False)
            intensity = (fields.real**2 + fields.imag**2).sum(axis=0) * self._envelope / np.prod(shape)
            kept = self._kept(xp.fft.rfft2(intensity), shape[0]).astype(model.dtype, copy=False)
            own, missed, slope = self._loss(kept, plane)
            loss, error = loss + own, error + missed / model.peaks[plane] ** 2
            lags = self._spread(slope, (shape[0], shape[1] // 2 + 1))
            weight = xp.fft.irfft2(lags, s=shape).astype(self.real, copy=False) * self._envelope
            back = xp.fft.ifft2(fields * weight)[:, :height, :width] * xp.conj(behind) * np.prod(shape)
            rows, columns = sent.shape[1:]
            gradient += back.reshape(-1, rows, k, columns, k).sum(axis=(2, 4)).astype(model.dtype, copy=False)
        gradient *= self.real.type(model.modulated)
        return loss, gradient, error / len(self._behind)

    def _loss(self, kept: DeviceArray, plane: int) -> tuple[float, float, DeviceArray]:
        """Return loss, mean square error, and ``dL/dI``'s kept lags (Kuo 2020, Eq. A.9)."""
        xp, model = self.xp, self.tables
        difference = kept - self._wanted[plane]
        error = self._power(difference * self._passed)
        filtered = difference * self._filter
        if model.loss.mean_square:
            return self._power(filtered) / 2, error, filtered * self._filter
        seen_shape = model.band.seen_shape
        small = self._spread(filtered, (seen_shape[0], seen_shape[1] // 2 + 1))
        seen = (xp.fft.irfft2(small, s=seen_shape) * np.prod(seen_shape)).astype(self.real, copy=False)
        if self._inside is not None:
            error = float((seen * self._inside * seen).sum() / self._inside.sum())
        value = model.loss.value(seen, self._images[plane], self._weights)
        slope = xp.fft.rfft2(model.loss.gradient(seen, self._images[plane], self._weights))
        return value, error, self._kept(slope, seen_shape[0]).astype(model.dtype, copy=False) * self._filter

    def _power(self, lags: DeviceArray) -> float:
        return float(((lags.real**2 + lags.imag**2).sum(axis=0, dtype=np.float64) * self._twice).sum())

    def _rows(self, height: int) -> DeviceArray:
        """Return where the kept rows of a spectrum of some height are."""
        kept, top = self.tables.band.kept[0], self.tables.band.top
        return self.xp.asarray(np.concatenate([np.arange(top), np.arange(height - kept + top, height)]))

    def _kept(self, spectrum: DeviceArray, height: int) -> DeviceArray:
        return spectrum[self._rows(height)][:, : self.tables.band.kept[1]]

    def _spread(self, lags: DeviceArray, shape: tuple[int, int]) -> DeviceArray:
        """Put kept lags into a half spectrum of zeros."""
        whole = self.xp.zeros(shape, self.tables.dtype)
        rows = self.xp.zeros((shape[0], lags.shape[1]), self.tables.dtype)
        rows[self._rows(shape[0])] = lags
        whole[:, : lags.shape[1]] = rows
        return whole
