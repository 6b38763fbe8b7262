"""Cameras whose PSF changes over the field: weighted objects, convolved and summed (Kuo 2020, Eqs. 5.4-5.7).

``A x = C sum_i h_i * (w_i x)``: **mask first, then convolve** (Eq. 5.5). With ``w_i`` the interpolation
weights of measured PSFs this is the local convolution model, with ``w_i`` the interpolated scores of
principal components the low-rank model.

The work is cut into strips, windows of the object that share an FFT length along rows, and these into parts,
which share one along columns (:mod:`recon.camera.strips`). Weights that are products of a weight along x
and one along y (bilinear interpolation) are applied on either side of the transform along rows, so that one
such transform serves a column of PSFs. Only rows that hold object, and rows that fall on the sensor, are
transformed along rows at all; the parts of a strip share the latter.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.threads import in_blocks
from recon.camera.base import Array, LinearOperator, estimate_norm
from recon.camera.strips import RUN, PlacedStrip, Strip
from recon.errors import InputError


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
        held = sum(
            s.masks.nbytes + s.weights.nbytes + s.spectra.nbytes for strips in self._depths for s in strips
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
        from recon.camera import _strip_kernels as kernels

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
        from recon.camera import _strip_kernels as kernels

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
