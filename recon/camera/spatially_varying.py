"""Cameras whose PSF changes over the field: weighted objects, convolved and summed (Kuo 2020, Eqs. 5.4-5.7).

``A x = C sum_i h_i * (w_i x)``: **mask first, then convolve** (Eq. 5.5). With ``w_i`` the interpolation
weights of measured PSFs this is the local convolution model, with ``w_i`` the interpolated scores of
principal components the low-rank model.

The work is cut into strips, windows of the object that share an FFT length along rows, and these into parts,
which share one along columns. Weights that are products of a weight along x
and one along y (bilinear interpolation) are applied on either side of the transform along rows, so that one
such transform serves a column of PSFs. Only rows that hold object, and rows that fall on the sensor, are
transformed along rows at all; the parts of a strip share the latter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base import fft
from recon.base.threads import in_blocks
from recon.camera.base import LinearOperator, estimate_norm
from recon.errors import InputError

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
class Axis:
    """One axis of a convolution on its grid: the FFT length, and which of it goes where on the sensor."""

    length: int
    sensor: int
    local: int
    count: int

    @classmethod
    def of(cls, start: int, patch: int, psf: int, sensor: int, *, real: bool) -> Axis:
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
    :mod:`recon.camera._kernels` has them.
    """

    def __init__(self, strip: Strip, sensor_shape: tuple[int, int], dtype: npt.DTypeLike) -> None:
        rows, columns = strip.window
        psf_height, psf_width = strip.parts[0].psfs.shape[2:]
        self.z, self.row, self.left = strip.z, rows.start, columns.start
        self.height = rows.stop - rows.start
        self.masks = np.ascontiguousarray(strip.masks, dtype)
        start, width = columns.start + strip.offset[1], columns.stop - columns.start
        self.axis = Axis.of(start, width, psf_width, sensor_shape[1], real=True)
        placed = [
            (
                p,
                Axis.of(
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
        weights = [np.empty(0, dtype)]
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
        self.parts = np.array(parts, np.int64).reshape(-1, 7)
        self.members = np.array(members, np.int64).reshape(-1, 4)
        self.weights = np.concatenate(weights)
        self._psfs = [(part.psfs, axis.length) for part, axis in placed]
        channels = max((psfs.shape[0] for psfs, _ in self._psfs), default=1)
        self._shape, self._dtype = (channels, self.n_tiles, at, self.tile), fft.complex_dtype(dtype)
        held = int(np.prod(self._shape)) * self._dtype.itemsize
        self.nbytes = held + self.masks.nbytes + self.weights.nbytes

    @cached_property
    def spectra(self) -> Array:
        """The transfer functions; made when they are asked for first: their memory is known before."""
        spectra, at = np.zeros(self._shape, self._dtype), 0
        half = self.axis.length // 2 + 1
        for psfs, length in self._psfs:
            channels, n, height, width = psfs.shape
            padded = np.zeros((channels, n, length, self.axis.length), self.masks.dtype)
            padded[..., :height, :width] = psfs
            rows = fft.rfft(padded).reshape(channels, n * length, half)
            for tile in range(self.n_tiles):
                columns = rows[..., tile * self.tile : (tile + 1) * self.tile]
                spectra[:, tile, at : at + n * length, : columns.shape[2]] = columns
            at += n * length
        self._psfs = []
        return spectra

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
        first, second = np.empty((2, int(self.parts[:, 1].max()), self.tile), self._dtype)
        return first, second


def _tiling(columns: int) -> tuple[int, int]:
    """Return number and width of the tiles that hold so many columns; the width is whole SIMD registers."""
    count = -(-columns // TILE)
    return count, 8 * -(-columns // (8 * count))


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
        placed = [PlacedStrip(s, sensor_shape, dtype) for s in strips]
        self._depths: list[list[PlacedStrip]] = [[] for _ in range(n_z)]
        for strip in placed:
            if len(strip.parts):
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
        held = sum(s.nbytes for strips in self._depths for s in strips)
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
                columns = sum(int(p[1]) * int(p[6] - p[5] + 1) for p in s.parts)
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

    def _forward_depth(self, x: Array, strips: list[PlacedStrip], channel: int, out: Array) -> None:
        from recon.camera import _kernels as kernels

        R, S = self._work(strips)
        masks = [(i, m) for i, s in enumerate(strips) for m in range(len(s.masks))]

        def transform(which: int, first: int, last: int) -> None:
            i, m = masks[which]
            s = strips[i]
            kernels.object_rows(x, s.row, s.left, s.masks[m], first, last, *s.run(self.dtype), R[i][m])

        _in_order(transform, [strips[i].height for i, _ in masks])

        def convolve(i: int, first: int, last: int) -> None:
            s = strips[i]
            kernels.columns_forward(
                R[i], s.parts, s.members, s.weights, s.of(channel), first, last, *s.columns(), S[i]
            )

        _in_order(convolve, [s.n_tiles for s in strips])

        def add(first: int, last: int) -> None:
            for s, spectrum in zip(strips, S, strict=True):
                a, b = max(first, s.top), min(last, s.bottom)
                if a < b:
                    kernels.sensor_rows(
                        spectrum, s.top, s.axis.local, a, b, *s.run(self.dtype), out, s.axis.sensor,
                        s.axis.count,
                    )  # fmt: skip

        in_blocks(add, len(out), grain=RUN)

    def _adjoint_depth(self, y: Array, strips: list[PlacedStrip], channel: int, out: Array) -> None:
        from recon.camera import _kernels as kernels

        R, S = self._work(strips)

        def transform(i: int, first: int, last: int) -> None:
            s = strips[i]
            kernels.data_rows(
                y, s.axis.sensor, s.axis.count, s.axis.local, s.top, s.top + first, s.top + last,
                *s.run(self.dtype), S[i],
            )  # fmt: skip

        _in_order(transform, [s.bottom - s.top for s in strips])

        def correlate(i: int, first: int, last: int) -> None:
            s = strips[i]
            kernels.columns_adjoint(
                S[i], s.parts, s.members, s.weights, s.of(channel), first, last, *s.columns(), R[i]
            )

        _in_order(correlate, [s.n_tiles for s in strips])

        def add(first: int, last: int) -> None:
            for s, spectra in zip(strips, R, strict=True):
                a, b = max(first - s.row, 0), min(last - s.row, s.height)
                if a < b:
                    for mask, spectrum in zip(s.masks, spectra, strict=True):
                        kernels.object_rows_back(spectrum, mask, a, b, *s.run(self.dtype), out, s.row, s.left)

        in_blocks(add, len(out), grain=RUN)

    def _work(self, strips: list[PlacedStrip]) -> tuple[list[Array], list[Array]]:
        """Cut the work arrays for one depth, whose transfer functions are there then."""
        for s in strips:
            s.spectra  # noqa: B018 - made before workers share it
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
                self._norm = float(np.sqrt(abs(float(rows) * float(columns)))) * (1 + 1e-5)
            else:
                self._norm = 1.1 * estimate_norm(self)
        return self._norm


def _in_order(job: Callable[[int, int, int], None], lengths: list[int]) -> None:
    """Call ``job(i, first, last)`` for all of every length, shared among the workers as one range."""
    edges = [0, *(int(e) for e in np.cumsum(lengths))]

    def block(start: int, stop: int) -> None:
        for i, (a, b) in enumerate(pairwise(edges)):
            first, last = max(start, a) - a, min(stop, b) - a
            if first < last:
                job(i, first, last)

    in_blocks(block, edges[-1])


def _cut(flat: Array, shapes: list[tuple[int, ...]]) -> list[Array]:
    """Return consecutive views of a flat array."""
    views, at = [], 0
    for shape in shapes:
        size = int(np.prod(shape))
        views.append(flat[at : at + size].reshape(shape))
        at += size
    return views
