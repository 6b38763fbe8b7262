"""Compiled FFT entry points (imported lazily by :mod:`recon.base.fft`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, dct, r2c


@njit(nogil=True, cache=True)
def forward(x: Any, out: Any, axes: Any, threads: int) -> None:
    """Real to half spectrum."""
    r2c(x, out, axes, True, 1.0, threads)


@njit(nogil=True, cache=True)
def forward_strip(x: Any, out: Any, start: int, threads: int) -> None:
    """Real to half spectrum of an image that is zero outside rows ``start`` to ``start + x.shape[1]``."""
    out[:, :start] = 0
    out[:, start + x.shape[1] :] = 0
    r2c(x, out[:, start : start + x.shape[1]], np.array([2]), True, 1.0, threads)
    c2c(out, out, np.array([1]), True, 1.0, threads)


@njit(nogil=True, cache=True)
def inverse_strip(X: Any, out: Any, start: int, scale: float, threads: int) -> None:
    """Half spectrum to rows ``start`` to ``start + out.shape[1]`` of the image; ``X`` is overwritten."""
    c2c(X, X, np.array([1]), False, 1.0, threads)
    c2r(X[:, start : start + out.shape[1]], out, np.array([2]), False, scale, threads)


@njit(nogil=True, cache=True)
def multiply(X: Any, H: Any, conjugate: bool, start: int, stop: int) -> None:
    """Multiply rows ``start`` to ``stop`` (of all channels) of ``X`` by ``H`` or its conjugate."""
    height = X.shape[1]
    shared = H.shape[0] == 1
    for r in range(start, stop):
        c, i = r // height, r % height
        x, h = X[c, i], H[0 if shared else c, i]
        if conjugate:
            for j in range(x.size):
                x[j] = complex(
                    h[j].real * x[j].real + h[j].imag * x[j].imag,
                    h[j].real * x[j].imag - h[j].imag * x[j].real,
                )
        else:
            for j in range(x.size):
                x[j] = complex(
                    h[j].real * x[j].real - h[j].imag * x[j].imag,
                    h[j].real * x[j].imag + h[j].imag * x[j].real,
                )


@njit(nogil=True, cache=True)
def inverse(X: Any, out: Any, axes: Any, scale: float, threads: int) -> None:
    """Half spectrum to real; the leading axes are transformed in place, which saves a temporary array."""
    if axes.size > 1:
        c2c(X, X, axes[:-1], False, 1.0, threads)
    c2r(X, out, axes[-1:], False, scale, threads)


@njit(nogil=True, cache=True)
def cosine(x: Any, out: Any, axes: Any, kind: int, scale: float, threads: int) -> None:
    """Orthonormal cosine transform: kind 2, or its inverse 3."""
    dct(x, out, axes, kind, scale, True, threads)
