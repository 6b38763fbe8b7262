"""How a spatially varying camera is cut up: windows of the object, and the grids they are convolved on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.camera.base import Array

Window = tuple[slice, slice]

TILE = 16
"""Most columns of a half spectrum that a worker takes through a pass at once: they fit a core's cache."""
RUN = 64
"""Rows that a worker transforms at once."""


@dataclass(frozen=True)
class Part:
    """Rows of a strip that are convolved together.

    Attributes
    ----------
    rows : slice
        On the object's grid, within the strip's window.
    members : ndarray of int, (n,)
        Which of the strip's masks each PSF sees the object through.
    weights : ndarray, (n, number of rows)
        A further weight along the rows, for each PSF.
    psfs : ndarray, (n_channels or 1, n, psf height, psf width)
        Cut to their support.
    """

    rows: slice
    members: npt.NDArray[np.int64]
    weights: Array
    psfs: Array


@dataclass(frozen=True)
class Strip:
    """A window of the object at one depth.

    Attributes
    ----------
    z : int
    window : (slice, slice)
        On the object's grid.
    masks : ndarray, (n_masks, window height or 1, window width)
    parts : tuple of Part
    offset : (int, int)
        Sensor position on which object pixel (0, 0) casts the first pixel of the cut PSF.
    """

    z: int
    window: Window
    masks: Array
    parts: tuple[Part, ...]
    offset: tuple[int, int]


@dataclass(frozen=True)
class _Axis:
    """One axis of a convolution on its grid: the FFT length, and which of it goes where on the sensor."""

    length: int
    sensor: int
    local: int
    count: int

    @classmethod
    def of(cls, start: int, patch: int, psf: int, sensor: int, *, real: bool) -> _Axis:
        """Place ``patch`` pixels of object that cast their first PSF pixel at ``start`` on ``sensor`` pixels.

        Only what falls on the sensor must be free of wrap-around: a full convolution's first and last pixels
        beside the sensor may be wrapped onto.
        """
        whole = patch + psf - 1
        first, last = max(start, 0), min(start + whole, sensor)
        if last <= first:
            return cls(0, 0, 0, 0)
        needed = max(whole - min(first - start, start + whole - last), last - first, patch, psf)
        return cls(fft.fast_length(needed, real=real), first, first - start, last - first)


class PlacedStrip:
    """A strip on its grids; nothing of it reaches the sensor where ``parts`` is empty.

    ``parts``, ``members``, ``weights`` and ``spectra`` (n_channels or 1, n_tiles, rows, tile width) are as
    :mod:`recon.camera._strip_kernels` has them.
    """

    def __init__(self, strip: Strip, sensor_shape: tuple[int, int], dtype: npt.DTypeLike) -> None:
        rows, columns = strip.window
        psf_height, psf_width = strip.parts[0].psfs.shape[2:]
        self.z, self.row, self.left = strip.z, rows.start, columns.start
        self.height = rows.stop - rows.start
        self.masks = np.ascontiguousarray(strip.masks, dtype)
        start, width = columns.start + strip.offset[1], columns.stop - columns.start
        self.axis = _Axis.of(start, width, psf_width, sensor_shape[1], real=True)
        placed = [
            (
                p,
                _Axis.of(
                    p.rows.start + strip.offset[0],
                    p.rows.stop - p.rows.start,
                    psf_height,
                    sensor_shape[0],
                    real=False,
                ),
            )
            for p in strip.parts
        ]
        placed = [(p, axis) for p, axis in placed if axis.count and self.axis.count]
        self.top = min((axis.sensor for _, axis in placed), default=0)
        self.bottom = max((axis.sensor + axis.count for _, axis in placed), default=0)
        self.n_tiles, self.tile = _tiling(self.axis.length // 2 + 1)
        parts: list[tuple[int, ...]] = []
        members: list[tuple[int, ...]] = []
        weights, spectra = [np.empty(0, dtype)], []
        at = n_weights = 0
        for part, axis in placed:
            parts.append(
                (
                    part.rows.start - rows.start,
                    axis.length,
                    axis.sensor - self.top,
                    axis.local,
                    axis.count,
                    len(members),
                    len(members) + len(part.members),
                )
            )
            for mask, weight in zip(part.members, part.weights, strict=True):
                members.append((int(mask), n_weights, len(weight), at))
                weights.append(weight.astype(dtype))
                n_weights += len(weight)
                at += axis.length
            spectra.append(self._spectra(part.psfs, axis.length, dtype))
        self.parts = np.array(parts, np.int64).reshape(-1, 7)
        self.members = np.array(members, np.int64).reshape(-1, 4)
        self.weights = np.concatenate(weights)
        self.spectra = np.concatenate(spectra, axis=2) if spectra else np.empty((1, 0, 0, 0))

    def _spectra(self, psfs: Array, length: int, dtype: npt.DTypeLike) -> Array:
        """Return a part's transfer functions, tile by tile."""
        channels, n, height, width = psfs.shape
        padded = np.zeros((channels, n, length, self.axis.length), dtype)
        padded[..., :height, :width] = psfs
        half = self.axis.length // 2 + 1
        spectra = np.zeros((channels, n * length, self.n_tiles * self.tile), fft.complex_dtype(dtype))
        spectra[..., :half] = fft.rfft(padded).reshape(channels, n * length, half)
        tiles = spectra.reshape(channels, n * length, self.n_tiles, self.tile)
        return np.ascontiguousarray(tiles.transpose(0, 2, 1, 3))

    def of(self, channel: int) -> Array:
        """Return the transfer functions that serve a channel."""
        spectra: Array = self.spectra[channel if len(self.spectra) > 1 else 0]
        return spectra

    @property
    def object_shape(self) -> tuple[int, int, int, int]:
        """Shape of the rows' spectra of the masked object."""
        return (len(self.masks), self.n_tiles, self.height, self.tile)

    @property
    def sensor_shape(self) -> tuple[int, int, int]:
        """Shape of the rows' spectra of what falls on the sensor."""
        return (self.n_tiles, self.bottom - self.top, self.tile)

    def run(self, dtype: np.dtype[Any]) -> tuple[Array, Array]:
        """Return scratch for a run of rows, and for its spectrum."""
        length = self.axis.length
        return np.empty((RUN, length), dtype), np.empty((RUN, length // 2 + 1), fft.complex_dtype(dtype))

    def columns(self) -> tuple[Array, Array]:
        """Return two tiles of scratch."""
        first, second = np.empty((2, int(self.parts[:, 1].max()), self.tile), self.spectra.dtype)
        return first, second


def _tiling(columns: int) -> tuple[int, int]:
    """Return number and width of the tiles that hold so many columns; the width is whole SIMD registers."""
    count = -(-columns // TILE)
    return count, 8 * -(-columns // (8 * count))
