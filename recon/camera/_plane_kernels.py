"""Compiled loops over depth planes: transform, multiply with the plane's transfer function, sum.

Each call takes a run of whole planes with one scratch plane, small enough for its core's own cache: threads
inside transforms of this size would nearly double the work.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, r2c

# NaN must survive (solvers stop on it), so neither nnan nor ninf.
FAST = {"reassoc", "nsz", "arcp", "contract"}

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
def add_conjugate_product(total: Any, H: Any, X: Any) -> None:
    """``total += conj(H) X`` for one plane."""
    for y in range(total.shape[0]):
        for i in range(total.shape[1]):
            total[y, i] += np.conj(H[y, i]) * X[y, i]


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
