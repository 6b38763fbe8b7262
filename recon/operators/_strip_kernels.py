"""Compiled passes of the spatially varying camera (:mod:`recon.operators.spatially_varying`).

A pass along rows takes a run of rows, a pass along columns a tile of neighbouring columns of the half
spectra: small enough for its core's own cache through all of the pass. Half spectra are kept tile by tile,
(n_tiles, rows, tile width), because columns a whole spectrum's row apart cost a page each. Every output
element is computed whole by one worker, in a fixed order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, r2c

from recon.operators._plane_kernels import FAST, FIRST_AXIS, SECOND_AXIS


@njit(nogil=True, cache=True, fastmath=FAST)
def _masked_row(x: Any, mask: Any, out: Any) -> None:
    for i in range(mask.shape[0]):
        out[i] = x[i] * mask[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_masked_row(x: Any, mask: Any, out: Any) -> None:
    for i in range(mask.shape[0]):
        out[i] += x[i] * mask[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _weighted_tile(R: Any, w: Any, out: Any) -> None:
    """``out`` rows ``w R``, and zeros below."""
    n = w.shape[0]
    for y in range(n):
        for i in range(out.shape[1]):
            out[y, i] = w[y] * R[y, i]
    out[n:] = 0


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_product_tile(H: Any, X: Any, total: Any) -> None:
    for y in range(total.shape[0]):
        for i in range(total.shape[1]):
            total[y, i] += H[y, i] * X[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_tile(X: Any, out: Any) -> None:
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] += X[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _conjugate_product_tile(H: Any, E: Any, out: Any) -> None:
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] = np.conj(H[y, i]) * E[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_weighted_tile(X: Any, w: Any, out: Any) -> None:
    for y in range(w.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] += w[y] * X[y, i]


@njit(nogil=True, cache=True)
def _to_tiles(rows: Any, tiles: Any, first: int) -> None:
    """Copy rows of half spectra to where their tiles' rows, from ``first``, lie."""
    width = tiles.shape[2]
    for t in range(tiles.shape[0]):
        part = rows[:, t * width : (t + 1) * width]
        tiles[t, first : first + len(rows), : part.shape[1]] = part


@njit(nogil=True, cache=True)
def _from_tiles(tiles: Any, first: int, rows: Any) -> None:
    """Copy rows back."""
    width = tiles.shape[2]
    for t in range(tiles.shape[0]):
        part = rows[:, t * width : (t + 1) * width]
        part[:] = tiles[t, first : first + len(rows), : part.shape[1]]


@njit(nogil=True, cache=True)
def object_rows(
    x: Any, row: int, left: int, mask: Any, first: int, last: int, plane: Any, spectrum: Any, R: Any
) -> None:
    """Transform rows ``first`` to ``last`` of the window at (``row``, ``left``), seen through ``mask``."""
    width = mask.shape[1]
    n = last - first
    plane[:, width:] = 0
    for y in range(n):
        m = mask[first + y] if mask.shape[0] > 1 else mask[0]
        _masked_row(x[row + first + y, left : left + width], m, plane[y])
    r2c(plane[:n], spectrum[:n], SECOND_AXIS, True, 1.0, 1)
    _to_tiles(spectrum[:n], R, first)


@njit(nogil=True, cache=True)
def columns_forward(
    R: Any, tile: int, first: int, members: Any, weights: Any, H: Any, total: Any, scratch: Any, S: Any,
    sensor: int, local: int, count: int,
) -> None:  # fmt: skip
    """Convolve one part of a strip along columns: ``S += F^-1 sum_m H_m F (w_m R_m)``, cropped to its rows."""
    total[:] = 0
    for m in range(members.shape[0]):
        w = weights[m]
        _weighted_tile(R[members[m], tile, first : first + w.shape[0]], w, scratch)
        c2c(scratch, scratch, FIRST_AXIS, True, 1.0, 1)
        _add_product_tile(H[m], scratch, total)
    c2c(total, total, FIRST_AXIS, False, 1.0 / total.shape[0], 1)
    _add_tile(total[local : local + count], S[sensor : sensor + count])


@njit(nogil=True, cache=True)
def columns_adjoint(
    S: Any, sensor: int, local: int, count: int, H: Any, members: Any, weights: Any, data: Any, scratch: Any,
    R: Any, tile: int, first: int,
) -> None:  # fmt: skip
    """``R_m += w_m F^-1 conj(H_m) F S`` for one part of a strip."""
    data[:local] = 0
    data[local : local + count] = S[sensor : sensor + count]
    data[local + count :] = 0
    c2c(data, data, FIRST_AXIS, True, 1.0, 1)
    for m in range(members.shape[0]):
        w = weights[m]
        _conjugate_product_tile(H[m], data, scratch)
        c2c(scratch, scratch, FIRST_AXIS, False, 1.0 / data.shape[0], 1)
        _add_weighted_tile(scratch, w, R[members[m], tile, first : first + w.shape[0]])


@njit(nogil=True, cache=True)
def sensor_rows(
    S: Any, shift: int, local: int, first: int, last: int, plane: Any, spectrum: Any, out: Any, left: int,
    width: int,
) -> None:  # fmt: skip
    """Add rows ``first`` to ``last`` of what a strip casts on the sensor; row y is row ``y - shift`` of S."""
    n = last - first
    _from_tiles(S, first - shift, spectrum[:n])
    c2r(spectrum[:n], plane[:n], SECOND_AXIS, False, 1.0 / plane.shape[1], 1)
    for y in range(n):
        out[first + y, left : left + width] += plane[y, local : local + width]


@njit(nogil=True, cache=True)
def data_rows(
    data: Any, left: int, width: int, local: int, shift: int, first: int, last: int, plane: Any,
    spectrum: Any, S: Any,
) -> None:  # fmt: skip
    """Transform rows ``first`` to ``last`` of the data that a strip can reach."""
    n = last - first
    plane[:, :local] = 0
    plane[:, local + width :] = 0
    for y in range(n):
        plane[y, local : local + width] = data[first + y, left : left + width]
    r2c(plane[:n], spectrum[:n], SECOND_AXIS, True, 1.0, 1)
    _to_tiles(spectrum[:n], S, first - shift)


@njit(nogil=True, cache=True)
def object_rows_back(
    R: Any, mask: Any, first: int, last: int, plane: Any, spectrum: Any, out: Any, row: int, left: int
) -> None:
    """Add rows ``first`` to ``last`` of a strip's window, seen through ``mask``, to the object."""
    width = mask.shape[1]
    n = last - first
    _from_tiles(R, first, spectrum[:n])
    c2r(spectrum[:n], plane[:n], SECOND_AXIS, False, 1.0 / plane.shape[1], 1)
    for y in range(n):
        m = mask[first + y] if mask.shape[0] > 1 else mask[0]
        _add_masked_row(plane[y], m, out[row + first + y, left : left + width])
