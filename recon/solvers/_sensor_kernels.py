"""Compiled loops of :mod:`recon.solvers.sensor_admm` over spectra and sensor images (imported lazily: numba).

One channel at a time; a call does the rows from ``start`` to ``stop``. ``T = mu_w + mu_u |Psi|^2`` and
``|H|^2`` are computed on the fly: reading them would cost more than the arithmetic. Scalars must come in the
arrays' precision.
"""

from __future__ import annotations

from typing import Any

from numba import njit

FAST = {"reassoc", "contract", "nsz"}


@njit(nogil=True, cache=True, fastmath=FAST)
def predict(
    start: int, stop: int, Y: Any, E: Any, H: Any, laplace_rows: Any, laplace_columns: Any,
    mu_u: Any, mu_w: Any, MY: Any,
) -> None:  # fmt: skip
    """``Y <- (Y + conj(H) E) / T`` and ``MY <- H Y``: the object that the data term's dual ``E`` implies."""
    for i in range(start, stop):
        row = mu_w + mu_u * laplace_rows[i]
        for j in range(Y.shape[1]):
            scale = 1 / (row + mu_u * laplace_columns[j])
            hr, hi = H[i, j].real, H[i, j].imag
            er, ei = E[i, j].real, E[i, j].imag
            yr = (Y[i, j].real + hr * er + hi * ei) * scale
            yi = (Y[i, j].imag + hr * ei - hi * er) * scale
            Y[i, j] = complex(yr, yi)
            MY[i, j] = complex(hr * yr - hi * yi, hr * yi + hi * yr)


@njit(nogil=True, cache=True, fastmath=FAST)
def curvature(
    start: int, stop: int, P: Any, H: Any, laplace_rows: Any, laplace_columns: Any, mu_u: Any, mu_w: Any,
    even_width: bool, sums: Any,
) -> None:  # fmt: skip
    """``sums[row] <- sum q |P|^2`` over the whole (not only the half) spectrum, ``q = |H|^2 / T``."""
    last = P.shape[1] - 1
    for i in range(start, stop):
        row = mu_w + mu_u * laplace_rows[i]
        total = mu_w - mu_w
        for j in range(1, last):
            total += _weighted_power(P[i, j], H[i, j], row + mu_u * laplace_columns[j])
        total += total
        total += _weighted_power(P[i, 0], H[i, 0], row + mu_u * laplace_columns[0])
        if last > 0:
            edge = _weighted_power(P[i, last], H[i, last], row + mu_u * laplace_columns[last])
            total += edge if even_width else edge + edge
        sums[i] = total


@njit(inline="always")
def _weighted_power(p: Any, h: Any, scale: Any) -> Any:
    return (p.real * p.real + p.imag * p.imag) * (h.real * h.real + h.imag * h.imag) / scale


@njit(nogil=True, cache=True, fastmath=FAST)
def weigh(
    start: int, stop: int, P: Any, H: Any, laplace_rows: Any, laplace_columns: Any, mu_u: Any, mu_w: Any
) -> None:
    """``P <- q P``."""
    for i in range(start, stop):
        row = mu_w + mu_u * laplace_rows[i]
        for j in range(P.shape[1]):
            h = H[i, j]
            P[i, j] *= (h.real * h.real + h.imag * h.imag) / (row + mu_u * laplace_columns[j])


@njit(nogil=True, cache=True, fastmath=FAST)
def advance(
    start: int, stop: int, Y: Any, E: Any, P: Any, H: Any, laplace_rows: Any, laplace_columns: Any,
    mu_u: Any, mu_w: Any, length: Any,
) -> None:  # fmt: skip
    """``E += length P`` and ``Y += length conj(H) P / T``."""
    for i in range(start, stop):
        row = mu_w + mu_u * laplace_rows[i]
        for j in range(Y.shape[1]):
            scale = length / (row + mu_u * laplace_columns[j])
            hr, hi = H[i, j].real, H[i, j].imag
            pr, pi = P[i, j].real, P[i, j].imag
            E[i, j] += complex(length * pr, length * pi)
            Y[i, j] += complex((hr * pr + hi * pi) * scale, (hr * pi - hi * pr) * scale)


@njit(nogil=True, cache=True, fastmath=FAST)
def residual(start: int, stop: int, r: Any, seen: Any, left: int, data: Any, e: Any) -> None:
    """``r <- data - seen - e``."""
    for i in range(start, stop):
        for j in range(data.shape[1]):
            r[i, j] = data[i, j] - seen[i, left + j] - e[i, j]


@njit(nogil=True, cache=True, fastmath=FAST)
def reduce_residual(start: int, stop: int, r: Any, p: Any, image: Any, left: int, length: Any) -> None:
    """``r <- r - length (p + image)``."""
    for i in range(start, stop):
        for j in range(r.shape[1]):
            r[i, j] -= length * (p[i, j] + image[i, left + j])


@njit(nogil=True, cache=True, fastmath=FAST)
def impute(start: int, stop: int, data: Any, weight: Any, e: Any, relax: Any) -> None:
    """Move ``data`` on erased pixels by ``-relax e``: towards what the object would have cast there."""
    for i in range(start, stop):
        for j in range(data.shape[1]):
            data[i, j] -= (1 - weight[i, j]) * relax * e[i, j]
