"""Compiled sweep of the Douglas-Rachford solver (:mod:`recon.solvers.douglas_rachford`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from recon.camera._plane_kernels import FAST, add_product, conjugate_product, from_spectrum, to_spectrum

__all__ = ["conjugate_product", "correlation_peaks", "from_spectrum", "l1_solution_plane", "l1_sweep"]

STATISTICS = 4


@njit(nogil=True, cache=True, fastmath=FAST)
def _update_plane(z: Any, d: Any, t: Any, relax: Any, step_scale: Any, positive: bool, st: Any) -> None:
    """``x = z + d; u = prox(x + d); z <- z + relax (u - x)``; ``st``: l1, (u - x)^2, u^2, d^2.

    Where gamma is multiplied by ``step_scale``, so is ``d``, about an unchanged x.
    """
    zero = t - t
    shift = relax / relax - step_scale
    for y in range(z.shape[0]):
        a = z[y]
        b = d[y]
        l1 = zero
        gap = zero
        uu = zero
        dd = zero
        for i in range(a.shape[0]):
            scaled = step_scale * b[i]
            state = a[i] + shift * b[i]
            v = state + scaled + scaled
            u = max(v - t, zero) if positive else v - max(min(v, t), -t)
            r = u - state - scaled
            a[i] = state + relax * r
            l1 += abs(u)
            gap += r * r
            uu += u * u
            dd += scaled * scaled
        st[0] += l1
        st[1] += gap
        st[2] += uu
        st[3] += dd


@njit(nogil=True, cache=True)
def l1_sweep(
    Z: Any, H: Any, E: Any, t: Any, relax: Any, step_scale: Any, positive: bool, total: Any, st: Any,
    planes: Any, d: Any, scratch: Any,
) -> None:  # fmt: skip
    """One iteration on some planes; ``total += H F z``. ``E`` carries the factor gamma."""
    for z in planes:
        conjugate_product(H[z], E, scratch)
        from_spectrum(scratch, d)
        st[z] = 0
        _update_plane(Z[z], d, t, relax, step_scale, positive, st[z])
        to_spectrum(Z[z], scratch)
        add_product(total, H[z], scratch)


@njit(nogil=True, cache=True, fastmath=FAST)
def l1_solution_plane(z: Any, d: Any, t: Any, positive: bool) -> None:
    """``z <- prox(z + 2 d)`` for one plane."""
    zero = t - t
    for y in range(z.shape[0]):
        a = z[y]
        b = d[y]
        for i in range(a.shape[0]):
            v = a[i] + b[i] + b[i]
            a[i] = max(v - t, zero) if positive else v - max(min(v, t), -t)


@njit(nogil=True, cache=True)
def correlation_peaks(H: Any, E: Any, positive: bool, peaks: Any, planes: Any, d: Any, scratch: Any) -> None:
    """Largest value, or magnitude where negative voxels count, of ``F^-1 conj(H) E`` on some planes."""
    for z in planes:
        conjugate_product(H[z], E, scratch)
        from_spectrum(scratch, d)
        peak = max(d.max(), -d.min())
        peaks[z] = d.max() if positive else peak


def plane_scratch(shape: tuple[int, int], dtype: Any) -> tuple[Any, Any]:
    """Return scratch for one worker: a plane and its spectrum."""
    return np.empty(shape, dtype), np.empty(
        (shape[0], shape[1] // 2 + 1), np.result_type(dtype, np.complex64)
    )
