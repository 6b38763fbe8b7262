"""Compiled FFT entry points (imported lazily by :mod:`recon.fft`)."""

from __future__ import annotations

from typing import Any

from numba import njit
from rocket_fft import c2c, c2r, r2c


@njit(nogil=True, cache=True)
def forward(x: Any, out: Any, axes: Any, threads: int) -> None:
    """Real to half spectrum."""
    r2c(x, out, axes, True, 1.0, threads)


@njit(nogil=True, cache=True)
def inverse(X: Any, out: Any, axes: Any, scale: float, threads: int) -> None:
    """Half spectrum to real; the leading axes are transformed in place, which saves a temporary array."""
    if axes.size > 1:
        c2c(X, X, axes[:-1], False, 1.0, threads)
    c2r(X, out, axes[-1:], False, scale, threads)
