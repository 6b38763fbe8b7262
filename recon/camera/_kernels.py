"""Compiled passes of the cameras (imported lazily: numba).

**Depth planes** of a convolution: transform, multiply with the plane's transfer function, sum. Each call
takes a run of whole planes with one scratch plane, small enough for its core's own cache: threads inside
transforms of this size would nearly double the work.

**Strips** of the spatially varying camera (:mod:`recon.camera.spatially_varying`): a pass along rows takes a
run of rows, a pass along columns a tile of neighbouring columns of the half spectra: small enough for its
core's own cache through all of the pass. Half spectra are kept tile by tile, (n_tiles, rows, tile width),
because columns a whole spectrum's row apart cost a page each. Every output element is computed whole by one
worker, in a fixed order.

``parts`` has a row a part: its first row in the window, its FFT length, its first row and number of rows on
the sensor with the first row of the transform that falls there between them, its first and last member.
``members`` has a row a PSF: the mask it sees the object through, where its weights along the rows begin in
``weights`` and how many there are, and where its transfer function begins in ``H`` (n_tiles, rows, tile
width).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, r2c

# NaN must survive (solvers stop on it), so neither nnan nor ninf.
FAST = {"reassoc", "nsz", "arcp", "contract"}
# Loops that divide need error_model="numpy" too: Python's error at a division by zero costs the vectors.

FIRST_AXIS = np.array([0])
SECOND_AXIS = np.array([1])
BOTH_AXES = np.array([0, 1])


@njit(nogil=True, cache=True)
def to_spectrum(x: Any, X: Any) -> None:
    """Forward transform of one plane."""
    r2c(x, X, BOTH_AXES, True, 1.0, 1)


@njit(nogil=True, cache=True)
def from_spectrum(X: Any, x: Any) -> None:
    """Inverse transform of one plane; overwrites ``X``."""
    c2c(X, X, FIRST_AXIS, False, 1.0, 1)
    c2r(X, x, SECOND_AXIS, False, 1.0 / (x.shape[0] * x.shape[1]), 1)


@njit(nogil=True, cache=True, fastmath=FAST)
def add_product(total: Any, H: Any, X: Any) -> None:
    """``total += H X`` for one plane."""
    for y in range(total.shape[0]):
        for i in range(total.shape[1]):
            total[y, i] += H[y, i] * X[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def conjugate_product(H: Any, E: Any, out: Any) -> None:
    """``out = conj(H) E`` for one plane."""
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] = np.conj(H[y, i]) * E[y, i]


@njit(nogil=True, cache=True)
def forward_planes(x: Any, H: Any, total: Any, scratch: Any, z0: int, z1: int) -> None:
    """``total += sum_z H_z F x_z`` over ``z0 <= z < z1``."""
    for z in range(z0, z1):
        to_spectrum(x[z], scratch)
        add_product(total, H[z], scratch)


@njit(nogil=True, cache=True)
def adjoint_planes(E: Any, H: Any, x: Any, scratch: Any, z0: int, z1: int) -> None:
    """``x_z = F^-1 conj(H_z) E`` for ``z0 <= z < z1``."""
    for z in range(z0, z1):
        conjugate_product(H[z], E, scratch)
        from_spectrum(scratch, x[z])


@njit(nogil=True, cache=True, fastmath=FAST)
def _masked_row(x: Any, mask: Any, out: Any) -> None:
    for i in range(mask.shape[0]):
        out[i] = x[i] * mask[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_masked_row(x: Any, mask: Any, out: Any) -> None:
    for i in range(mask.shape[0]):
        out[i] += x[i] * mask[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_row(x: Any, out: Any) -> None:
    for i in range(out.shape[0]):
        out[i] += x[i]


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


@njit(nogil=True, cache=True, fastmath=FAST)
def _weighted_tile(R: Any, w: Any, out: Any) -> None:
    """``out`` rows ``w R``, and zeros below."""
    n = w.shape[0]
    for y in range(n):
        for i in range(out.shape[1]):
            out[y, i] = w[y] * R[y, i]
    out[n:] = 0


@njit(nogil=True, cache=True, fastmath=FAST)
def _product_tile(H: Any, X: Any, out: Any) -> None:
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] = H[y, i] * X[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_tile(X: Any, out: Any) -> None:
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] += X[y, i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_weighted_tile(X: Any, w: Any, out: Any) -> None:
    for y in range(w.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] += w[y] * X[y, i]


@njit(nogil=True, cache=True)
def object_rows(
    x: Any, row: int, left: int, mask: Any, first: int, last: int, plane: Any, spectrum: Any, R: Any
) -> None:
    """Transform rows ``first`` to ``last`` of the window at (``row``, ``left``), seen through ``mask``."""
    width = mask.shape[1]
    plane[:, width:] = 0
    for a in range(first, last, plane.shape[0]):
        n = min(plane.shape[0], last - a)
        for y in range(n):
            m = mask[a + y] if mask.shape[0] > 1 else mask[0]
            _masked_row(x[row + a + y, left : left + width], m, plane[y])
        r2c(plane[:n], spectrum[:n], SECOND_AXIS, True, 1.0, 1)
        _to_tiles(spectrum[:n], R, a)


@njit(nogil=True, cache=True)
def columns_forward(
    R: Any, parts: Any, members: Any, weights: Any, H: Any, first: int, last: int, total: Any, scratch: Any,
    S: Any,
) -> None:  # fmt: skip
    """Convolve a strip along columns, in tiles ``first`` to ``last``.

    For each part ``S += F^-1 sum_m H_m F (w_m R_m)``, cropped to its rows on the sensor.
    """
    for t in range(first, last):
        S[t] = 0
        for part in parts:
            at, length, sensor, local, count, m0, m1 = part
            x, sums = scratch[:length], total[:length]
            for m in range(m0, m1):
                mask, w0, n, h0 = members[m]
                _weighted_tile(R[mask, t, at : at + n], weights[w0 : w0 + n], x)
                c2c(x, x, FIRST_AXIS, True, 1.0, 1)
                if m == m0:
                    _product_tile(H[t, h0 : h0 + length], x, sums)
                else:
                    add_product(sums, H[t, h0 : h0 + length], x)
            c2c(sums, sums, FIRST_AXIS, False, 1.0 / length, 1)
            _add_tile(sums[local : local + count], S[t, sensor : sensor + count])


@njit(nogil=True, cache=True)
def columns_adjoint(
    S: Any, parts: Any, members: Any, weights: Any, H: Any, first: int, last: int, data: Any, scratch: Any,
    R: Any,
) -> None:  # fmt: skip
    """Correlate along columns: ``R_m = w_m F^-1 conj(H_m) F S``, summed over the parts."""
    for t in range(first, last):
        R[:, t] = 0
        for part in parts:
            at, length, sensor, local, count, m0, m1 = part
            d, x = data[:length], scratch[:length]
            d[:local] = 0
            d[local : local + count] = S[t, sensor : sensor + count]
            d[local + count :] = 0
            c2c(d, d, FIRST_AXIS, True, 1.0, 1)
            for m in range(m0, m1):
                mask, w0, n, h0 = members[m]
                conjugate_product(H[t, h0 : h0 + length], d, x)
                c2c(x, x, FIRST_AXIS, False, 1.0 / length, 1)
                _add_weighted_tile(x, weights[w0 : w0 + n], R[mask, t, at : at + n])


@njit(nogil=True, cache=True)
def sensor_rows(
    S: Any, shift: int, local: int, first: int, last: int, plane: Any, spectrum: Any, out: Any, left: int,
    width: int,
) -> None:  # fmt: skip
    """Add rows ``first`` to ``last`` of what a strip casts on the sensor; row y is row ``y - shift`` of S."""
    for a in range(first, last, plane.shape[0]):
        n = min(plane.shape[0], last - a)
        _from_tiles(S, a - shift, spectrum[:n])
        c2r(spectrum[:n], plane[:n], SECOND_AXIS, False, 1.0 / plane.shape[1], 1)
        for y in range(n):
            _add_row(plane[y, local : local + width], out[a + y, left : left + width])


@njit(nogil=True, cache=True)
def data_rows(
    data: Any, left: int, width: int, local: int, shift: int, first: int, last: int, plane: Any,
    spectrum: Any, S: Any,
) -> None:  # fmt: skip
    """Transform rows ``first`` to ``last`` of the data that a strip can reach."""
    plane[:] = 0
    for a in range(first, last, plane.shape[0]):
        n = min(plane.shape[0], last - a)
        for y in range(n):
            plane[y, local : local + width] = data[a + y, left : left + width]
        r2c(plane[:n], spectrum[:n], SECOND_AXIS, True, 1.0, 1)
        _to_tiles(spectrum[:n], S, a - shift)


@njit(nogil=True, cache=True)
def object_rows_back(
    R: Any, mask: Any, first: int, last: int, plane: Any, spectrum: Any, out: Any, row: int, left: int
) -> None:
    """Add rows ``first`` to ``last`` of a strip's window, seen through ``mask``, to the object."""
    width = mask.shape[1]
    for a in range(first, last, plane.shape[0]):
        n = min(plane.shape[0], last - a)
        _from_tiles(R, a, spectrum[:n])
        c2r(spectrum[:n], plane[:n], SECOND_AXIS, False, 1.0 / plane.shape[1], 1)
        for y in range(n):
            m = mask[a + y] if mask.shape[0] > 1 else mask[0]
            _add_masked_row(plane[y], m, out[row + a + y, left : left + width])
