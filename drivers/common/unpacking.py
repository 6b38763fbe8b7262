"""Loops over packed pixels, compiled by numba: one pixel after the other, the interpreter's lock released.

Imported by :mod:`drivers.common.pixels` when the first packed image comes. The functions do not call each
other.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import numpy.typing as npt

Kernel = Callable[[npt.NDArray[np.uint8], npt.NDArray[np.uint16]], None]


@numba.njit(cache=True, nogil=True)
def _lsb10(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """Ten bits after ten bits, lowest first: a pixel lies in two bytes."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            first = 10 * x >> 3
            word = rows[y, first] | rows[y, first + 1] << 8
            out[y, x] = word >> (10 * x & 7) & 0x3FF


@numba.njit(cache=True, nogil=True)
def _lsb12(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """Twelve bits after twelve bits, lowest first."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            first = 12 * x >> 3
            word = rows[y, first] | rows[y, first + 1] << 8
            out[y, x] = word >> (12 * x & 7) & 0xFFF


@numba.njit(cache=True, nogil=True)
def _gige10(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """High bytes first and last, the low two bits of both in the nibbles of the byte between."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            group, odd = 3 * (x >> 1), x & 1
            out[y, x] = rows[y, group + 2 * odd] << 2 | rows[y, group + 1] >> 4 * odd & 0x3


@numba.njit(cache=True, nogil=True)
def _gige12(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """High bytes first and last, the low four bits of both in the byte between."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            group, odd = 3 * (x >> 1), x & 1
            out[y, x] = rows[y, group + 2 * odd] << 4 | rows[y, group + 1] >> 4 * odd & 0xF


@numba.njit(cache=True, nogil=True)
def _mipi10(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """Four high bytes, then the low two bits of each in one."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            group, place = 5 * (x >> 2), x & 3
            out[y, x] = rows[y, group + place] << 2 | rows[y, group + 4] >> 2 * place & 0x3


@numba.njit(cache=True, nogil=True)
def _mipi12(rows: npt.NDArray[np.uint8], out: npt.NDArray[np.uint16]) -> None:
    """Two high bytes, then the low four bits of each in one."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            group, odd = 3 * (x >> 1), x & 1
            out[y, x] = rows[y, group + odd] << 4 | rows[y, group + 2] >> 4 * odd & 0xF


KERNELS: dict[str, Kernel] = {
    "lsb 10": _lsb10,
    "lsb 12": _lsb12,
    "gige 10": _gige10,
    "gige 12": _gige12,
    "mipi 10": _mipi10,
    "mipi 12": _mipi12,
}
"""By the names of ``drivers.common.pixels.Packing``; each takes ``(lines, bytes)`` and ``(lines,
pixels)``."""
