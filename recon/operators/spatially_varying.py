"""Cameras whose PSF changes over the field: weighted objects, convolved and summed (Kuo 2020, Eqs. 5.4-5.7).

``A x = C sum_i h_i * (w_i x)``: **mask first, then convolve** (Eq. 5.5). With ``w_i`` the interpolation
weights of measured PSFs this is the local convolution model, with ``w_i`` the interpolated scores of
principal components the low-rank model.

The work is cut into :class:`Strip`s, windows of the object that share an FFT length along rows, and these
into :class:`Part`s, which share one along columns. Weights that are products of a weight along x and one
along y (bilinear interpolation) are applied on either side of the transform along rows, so that two such
transforms serve four PSFs. Only rows that hold object, and rows that fall on the sensor, are transformed
along rows at all; the parts of a strip share the latter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon import fft
from recon.errors import InputError
from recon.operators.base import Array, LinearOperator, estimate_norm
from recon.threads import in_blocks

Window = tuple[slice, slice]

_TILE = 64
"""Most columns of a half spectrum that a worker takes through a pass at once: they fit a core's cache."""
_RUN = 32
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


class _PlacedPart:
    """A part on its grid, with its transfer functions (n_channels or 1, n_tiles, n, grid height, tile width)."""

    def __init__(self, part: Part, strip: Strip, rows: _Axis, width: int, dtype: npt.DTypeLike) -> None:
        self.axis = rows
        self.first = part.rows.start - strip.window[0].start
        self.members = np.ascontiguousarray(part.members, np.int64)
        self.weights = np.ascontiguousarray(part.weights, dtype)
        channels, n, height, breadth = part.psfs.shape
        padded = np.zeros((channels, n, rows.length, width), dtype)
        padded[..., :height, :breadth] = part.psfs
        count, tile = _tiling(width // 2 + 1)
        spectra = np.zeros((channels, n, rows.length, count * tile), fft.complex_dtype(dtype))
        spectra[..., : width // 2 + 1] = fft.rfft(padded)
        tiles = spectra.reshape(channels, n, rows.length, count, tile)
        self.spectra = np.ascontiguousarray(tiles.transpose(0, 3, 1, 2, 4))

    def of(self, channel: int) -> Array:
        """Return the transfer functions that serve a channel."""
        spectra: Array = self.spectra[channel if len(self.spectra) > 1 else 0]
        return spectra


class _PlacedStrip:
    """A strip on its grids; nothing of it reaches the sensor where ``parts`` is empty."""

    def __init__(self, strip: Strip, sensor_shape: tuple[int, int], dtype: npt.DTypeLike) -> None:
        rows, columns = strip.window
        height, width = strip.parts[0].psfs.shape[2:]
        self.z, self.row, self.left = strip.z, rows.start, columns.start
        self.height = rows.stop - rows.start
        self.masks = np.ascontiguousarray(strip.masks, dtype)
        self.axis = _Axis.of(
            columns.start + strip.offset[1],
            columns.stop - columns.start,
            width,
            sensor_shape[1],
            real=True,
        )
        self.parts: list[_PlacedPart] = []
        for part in strip.parts:
            axis = _Axis.of(
                part.rows.start + strip.offset[0],
                part.rows.stop - part.rows.start,
                height,
                sensor_shape[0],
                real=False,
            )
            if axis.count and self.axis.count:
                self.parts.append(_PlacedPart(part, strip, axis, self.axis.length, dtype))
        self.top = min((p.axis.sensor for p in self.parts), default=0)
        self.bottom = max((p.axis.sensor + p.axis.count for p in self.parts), default=0)
        self.n_tiles, self.tile = _tiling(self.axis.length // 2 + 1)

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
        return np.empty((_RUN, length), dtype), np.empty((_RUN, length // 2 + 1), fft.complex_dtype(dtype))


class SpatiallyVarying(LinearOperator):
    """Sum over strips of masked convolutions, cropped to the sensor.

    Parameters
    ----------
    strips : list of Strip
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
        strips: list[Strip],
        field_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
        *,
        n_z: int = 1,
        n_channels: int = 1,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        super().__init__((n_channels, n_z, *field_shape), (n_channels, *sensor_shape), dtype)
        parts = [p for s in strips for p in s.parts]
        for part in parts:
            if part.psfs.shape[0] not in (1, n_channels):
                raise InputError(
                    f"PSFs of {part.psfs.shape[0]} channels do not serve {n_channels}: give 1 or as many."
                )
        placed = [_PlacedStrip(s, sensor_shape, dtype) for s in strips]
        self._depths: list[list[_PlacedStrip]] = [[] for _ in range(n_z)]
        for strip in placed:
            if strip.parts:
                self._depths[strip.z].append(strip)
        self._non_negative = all((s.masks >= 0).all() for s in strips) and all(
            (p.weights >= 0).all() and (p.psfs >= 0).all() for p in parts
        )
        self._norm: float | None = None
        # Spectra of the rows of one depth at a time, of object and sensor.
        needed = [
            (
                sum(int(np.prod(s.object_shape)) for s in strips),
                sum(int(np.prod(s.sensor_shape)) for s in strips),
            )
            for strips in self._depths
        ]
        objects, sensors = (max(sizes) for sizes in zip(*needed, strict=True))
        complex_dtype = fft.complex_dtype(dtype)
        # Zeros, as what fills up the last tile must be finite.
        self._object_work, self._sensor_work = (np.zeros(n, complex_dtype) for n in (objects, sensors))

    @property
    def nbytes(self) -> int:
        """Memory that transfer functions, weights and work arrays take."""
        held = sum(
            s.masks.nbytes + sum(p.spectra.nbytes + p.weights.nbytes for p in s.parts)
            for strips in self._depths
            for s in strips
        )
        return held + self._object_work.nbytes + self._sensor_work.nbytes

    @property
    def fft_pixels(self) -> int:
        """Pixels transformed in one forward and adjoint: the cost, to compare models by.

        A pass along one axis counts half.
        """
        pixels = 0
        for strips in self._depths:
            for s in strips:
                rows = len(s.masks) * s.height + s.bottom - s.top
                columns = sum((len(p.members) + 1) * p.axis.length for p in s.parts)
                pixels += s.axis.length * (rows + columns)
        return pixels

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of ``x``."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        out[...] = 0
        x = np.ascontiguousarray(x, self.dtype)
        for channel, image in enumerate(out):
            for z, strips in enumerate(self._depths):
                if strips:
                    self._forward_depth(x[channel, z], strips, channel, image)
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return the exact transpose: correlate with each PSF, then mask."""
        out = np.empty(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        y = np.ascontiguousarray(y, self.dtype)
        for channel, image in enumerate(y):
            for z, strips in enumerate(self._depths):
                if strips:
                    self._adjoint_depth(image, strips, channel, out[channel, z])
        return out

    def _forward_depth(self, x: Array, strips: list[_PlacedStrip], channel: int, out: Array) -> None:
        from recon.operators import _strip_kernels as kernels

        R, S = self._work(strips)

        def transform(i: int, mask: int, first: int, last: int) -> None:
            s = strips[i]
            kernels.object_rows(x, s.row, s.left, s.masks[mask], first, last, *s.run(self.dtype), R[i][mask])

        _in_turn(
            transform,
            [
                (i, m, *run)
                for i, s in enumerate(strips)
                for m in range(len(s.masks))
                for run in _runs(0, s.height)
            ],
        )

        def convolve(i: int, tile: int) -> None:
            s, onto = strips[i], S[i][tile]
            onto[...] = 0
            for p in s.parts:
                total, scratch = np.empty((2, p.axis.length, s.tile), R[i].dtype)
                kernels.columns_forward(
                    R[i], tile, p.first, p.members, p.weights, p.of(channel)[tile], total, scratch, onto,
                    p.axis.sensor - s.top, p.axis.local, p.axis.count,
                )  # fmt: skip

        _in_turn(convolve, _tiles(strips))

        def add(first: int, last: int) -> None:
            for s, spectrum in zip(strips, S, strict=True):
                a, b = max(first, s.top), min(last, s.bottom)
                if a < b:
                    kernels.sensor_rows(
                        spectrum, s.top, s.axis.local, a, b, *s.run(self.dtype), out, s.axis.sensor,
                        s.axis.count,
                    )  # fmt: skip

        _in_turn(add, _runs(0, len(out)))

    def _adjoint_depth(self, y: Array, strips: list[_PlacedStrip], channel: int, out: Array) -> None:
        from recon.operators import _strip_kernels as kernels

        R, S = self._work(strips)

        def transform(i: int, first: int, last: int) -> None:
            s = strips[i]
            kernels.data_rows(
                y, s.axis.sensor, s.axis.count, s.axis.local, s.top, first, last, *s.run(self.dtype), S[i]
            )

        _in_turn(transform, [(i, *run) for i, s in enumerate(strips) for run in _runs(s.top, s.bottom)])

        def correlate(i: int, tile: int) -> None:
            s = strips[i]
            R[i][:, tile] = 0
            for p in s.parts:
                data, scratch = np.empty((2, p.axis.length, s.tile), R[i].dtype)
                kernels.columns_adjoint(
                    S[i][tile], p.axis.sensor - s.top, p.axis.local, p.axis.count, p.of(channel)[tile],
                    p.members, p.weights, data, scratch, R[i], tile, p.first,
                )  # fmt: skip

        _in_turn(correlate, _tiles(strips))

        def add(first: int, last: int) -> None:
            for s, spectra in zip(strips, R, strict=True):
                a, b = max(first - s.row, 0), min(last - s.row, s.height)
                if a < b:
                    for mask, spectrum in zip(s.masks, spectra, strict=True):
                        kernels.object_rows_back(spectrum, mask, a, b, *s.run(self.dtype), out, s.row, s.left)

        top, bottom = min(s.row for s in strips), max(s.row + s.height for s in strips)
        _in_turn(add, _runs(top, bottom))

    def _work(self, strips: list[_PlacedStrip]) -> tuple[list[Array], list[Array]]:
        """Cut the work arrays for one depth."""
        return (
            _cut(self._object_work, [s.object_shape for s in strips]),
            _cut(self._sensor_work, [s.sensor_shape for s in strips]),
        )

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


def _in_turn(job: Callable[..., None], units: list[tuple[int, ...]]) -> None:
    """Do every unit of work, shared among all workers."""

    def block(start: int, stop: int) -> None:
        for unit in units[start:stop]:
            job(*unit)

    in_blocks(block, len(units))


def _runs(first: int, last: int) -> list[tuple[int, int]]:
    """Cut a range of rows into runs for the workers."""
    return [(a, min(a + _RUN, last)) for a in range(first, last, _RUN)]


def _tiling(columns: int) -> tuple[int, int]:
    """Return number and width of the tiles that hold so many columns; the width is whole SIMD registers."""
    count = -(-columns // _TILE)
    return count, 8 * -(-columns // (8 * count))


def _tiles(strips: list[_PlacedStrip]) -> list[tuple[int, int]]:
    """Return every tile: its strip and its number there."""
    return [(i, t) for i, s in enumerate(strips) for t in range(s.n_tiles)]


def _cut(flat: Array, shapes: list[tuple[int, ...]]) -> list[Array]:
    """Return consecutive views of a flat array."""
    views, at = [], 0
    for shape in shapes:
        size = int(np.prod(shape))
        views.append(flat[at : at + size].reshape(shape))
        at += size
    return views
