"""Compiled sweeps of the solvers of volumes (imported lazily: numba).

Total variation (:mod:`recon.solvers.tv_admm_volume`), and l1 (:mod:`recon.solvers.douglas_rachford`, at the
end); these modules have the formulae.

One worker takes a run of whole depth planes (:func:`plane_sweep`) or of whole spectral rows
(:func:`solve_rows`), with its scratch planes small enough for its core's own cache. Every output element is
computed whole by one worker and sums are kept per plane or per group of planes, so that results do not depend
on the number of workers.

The loops over a row are kept short on purpose: with more than a few arrays the compiler gives up proving that
they do not overlap, and with it vector instructions (a factor of three). A row stays in the first-level
cache.

``p`` is ``relaxation, threshold, previous threshold, dual scale, kappa``. ``s`` is (4, Nx): the states of the
z, y and x differences and of non-negativity. ``w`` are the plane's weights of the z, y and x differences.
``st`` collects the plane's sums: TV, then squared primal residual, dual residual, size of the split variables
and size of the multipliers of the differences, then the same four of non-negativity.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from recon.camera._kernels import (
    FAST,
    add_product,
    conjugate_product,
    from_spectrum,
    to_spectrum,
)

STATISTICS = 9
SCRATCH_PLANES = 4
SCRATCH_ROWS = 8
TINY = np.finfo(np.float32).tiny


@njit(nogil=True, cache=True, fastmath=FAST)
def _split_row(s: Any, x: Any, neighbour: Any, v: Any, w: Any, p: Any, st: Any) -> None:
    """Advance one anisotropic difference's state; ``v = w (2 u - s)``."""
    relax, t, t_old, dual_scale = p[0], p[1], p[2], p[3]
    zero = relax - relax
    tv, primal, dual, kx, y = zero, zero, zero, zero, zero
    for i in range(s.shape[0]):
        d = w * (neighbour[i] - x[i])
        c = max(min(s[i], t_old), -t_old)
        u = s[i] - c
        a = u + dual_scale * c + relax * (d - u)
        s[i] = a
        c = max(min(a, t), -t)
        e = a - c
        v[i] = w * (e - c)
        tv += abs(d)
        primal += (d - e) * (d - e)
        dual += (e - u) * (e - u)
        kx += d * d
        y += c * c
    st[0] += tv
    st[1] += primal
    st[2] += dual
    st[3] += kx
    st[4] += y


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _clip_factor_row(s0: Any, s1: Any, s2: Any, t: Any, k: Any) -> None:
    """Isotropic: ``k`` such that the multiplier is ``k s`` and the split variable ``(1 - k) s``."""
    least = max(t, t - t + TINY)
    for i in range(k.shape[0]):
        k[i] = t / max(np.sqrt(s0[i] * s0[i] + s1[i] * s1[i] + s2[i] * s2[i]), least)


@njit(nogil=True, cache=True, fastmath=FAST)
def _advance_row(s: Any, difference: Any, old: Any, k: Any, p: Any) -> None:
    """Isotropic: advance one difference's state; ``old`` gets the split variable before."""
    relax, dual_scale = p[0], p[3]
    for i in range(s.shape[0]):
        c = k[i] * s[i]
        u = s[i] - c
        old[i] = u
        s[i] = u + dual_scale * c + relax * (difference[i] - u)


@njit(nogil=True, cache=True, fastmath=FAST)
def _difference_row(x: Any, neighbour: Any, w: Any, out: Any) -> None:
    for i in range(out.shape[0]):
        out[i] = w * (neighbour[i] - x[i])


@njit(nogil=True, cache=True, fastmath=FAST)
def _reflect_row(s: Any, v: Any, old: Any, k: Any, w: Any, st: Any) -> None:
    """Isotropic: ``v``, which holds the difference, becomes ``w (2 u - s)``."""
    zero = w - w
    primal, dual, kx, y = zero, zero, zero, zero
    for i in range(s.shape[0]):
        c = k[i] * s[i]
        e = s[i] - c
        primal += (v[i] - e) * (v[i] - e)
        dual += (e - old[i]) * (e - old[i])
        kx += v[i] * v[i]
        y += c * c
        v[i] = w * (e - c)
    st[1] += primal
    st[2] += dual
    st[3] += kx
    st[4] += y


@njit(nogil=True, cache=True, fastmath=FAST)
def _sum_of_magnitudes(d0: Any, d1: Any, d2: Any) -> Any:
    total = d0[0] - d0[0]
    for i in range(d0.shape[0]):
        total += np.sqrt(d0[i] * d0[i] + d1[i] * d1[i] + d2[i] * d2[i])
    return total


@njit(nogil=True, cache=True, fastmath=FAST)
def _positive_row(s: Any, x: Any, r: Any, p: Any, st: Any) -> None:
    """Advance the state of non-negativity; add ``kappa (2 max(s, 0) - s)`` to ``r``."""
    relax, dual_scale, kappa = p[0], p[3], p[4]
    zero = relax - relax
    primal, dual, xx, y = zero, zero, zero, zero
    for i in range(s.shape[0]):
        u = max(s[i], zero)
        a = u + dual_scale * (s[i] - u) + relax * (x[i] - u)
        s[i] = a
        e = max(a, zero)
        r[i] += kappa * abs(a)
        primal += (x[i] - e) * (x[i] - e)
        dual += (e - u) * (e - u)
        xx += x[i] * x[i]
        y += (a - e) * (a - e)
    st[5] += primal
    st[6] += dual
    st[7] += xx
    st[8] += y


@njit(nogil=True, cache=True, fastmath=FAST)
def _update_row(
    s: Any, x: Any, below: Any, deeper: Any, v: Any, r: Any, w: Any, p: Any, isotropic: bool, st: Any
) -> None:
    """Advance the four states of one row; ``v[:3]`` gets the reflections of the differences."""
    n = x.shape[0]
    right = v[3]
    right[: n - 1] = x[1:]
    right[n - 1] = x[0]
    if isotropic:
        k = v[4]
        _clip_factor_row(s[0], s[1], s[2], p[2], k)
        _difference_row(x, deeper, w[0], v[0])
        _difference_row(x, below, w[1], v[1])
        _difference_row(x, right, w[2], v[2])
        st[0] += _sum_of_magnitudes(v[0], v[1], v[2])
        for axis in range(3):
            _advance_row(s[axis], v[axis], v[5 + axis], k, p)
        _clip_factor_row(s[0], s[1], s[2], p[1], k)
        for axis in range(3):
            _reflect_row(s[axis], v[axis], v[5 + axis], k, w[axis], st)
    else:
        _split_row(s[0], x, deeper, v[0], w[0], p, st)
        _split_row(s[1], x, below, v[1], w[1], p, st)
        _split_row(s[2], x, right, v[2], w[2], p, st)
    _positive_row(s[3], x, r, p, st)


@njit(nogil=True, cache=True, fastmath=FAST)
def _divergence_row(r: Any, below: Any, vz: Any, v: Any) -> None:
    """Add ``Psi^T v`` of one row; ``vz`` holds the z reflections of the plane above, then of this one."""
    v0, v1, v2 = v[0], v[1], v[2]
    n = r.shape[0]
    for i in range(n):
        r[i] += vz[i] - v0[i] - v1[i] - v2[i]
        vz[i] = v0[i]
        below[i] += v1[i]
    r[0] += v2[n - 1]
    for i in range(1, n):
        r[i] += v2[i - 1]


@njit(nogil=True, cache=True)
def z_reflection(S: Any, x: Any, deeper: Any, w: Any, p: Any, isotropic: bool, rows: Any, out: Any) -> None:
    """Reflections of the z differences of one plane after its update, without updating it.

    What the worker that starts on the next plane needs to know.
    """
    ny = x.shape[0]
    state, ignored, r = np.empty_like(S[0]), np.zeros(STATISTICS), np.zeros_like(x[0])
    for y in range(ny):
        state[:] = S[y]
        _update_row(state, x[y], x[y + 1 if y + 1 < ny else 0], deeper[y], rows, r, w, p, isotropic, ignored)
        out[y] = rows[0]


@njit(nogil=True, cache=True, fastmath=FAST)
def _keep_and_add(total: Any, g: Any, R: Any, X: Any) -> None:
    """``X = R`` and ``total += conj(g) R`` for one plane."""
    for y in range(total.shape[0]):
        for i in range(total.shape[1]):
            v = R[y, i]
            X[y, i] = v
            total[y, i] += np.conj(g[y, i]) * v


@njit(nogil=True, cache=True)
def plane_sweep(
    X: Any, S: Any, g: Any, totals: Any, group: Any, w: Any, p: Any, isotropic: bool, st: Any, z0: int,
    z1: int, first: Any, last: Any, vz_before: Any, planes: Any, spectrum: Any, rows: Any,
) -> None:  # fmt: skip
    """States, right-hand side, its transform and its sum with ``conj(g)``, for planes ``z0 <= z < z1``.

    ``X`` enters as the spectrum of the estimate and leaves as that of the right-hand side. ``first`` and
    ``last`` are the estimate at planes ``z0`` and ``z1``, ``vz_before`` the z reflections of plane
    ``z0 - 1``: other workers may have overwritten what they come from. Transforms along columns stay within
    ``spectrum``, which the core's cache holds; ``X`` is read and written once, row after row.
    """
    nz = X.shape[0]
    x, x_next, r, vz = planes[0], planes[1], planes[2], planes[3]
    ny = x.shape[0]
    if z0 > 0:
        x[:] = first
        vz[:] = vz_before
    else:
        spectrum[:] = X[z0]
        from_spectrum(spectrum, x)
        vz[:] = 0
    for z in range(z0, z1):
        if z + 1 == nz:
            x_next[:] = x
        elif z + 1 == z1:
            x_next[:] = last
        else:
            spectrum[:] = X[z + 1]
            from_spectrum(spectrum, x_next)
        r[:] = 0
        st[z] = 0
        for y in range(ny):
            below = y + 1 if y + 1 < ny else 0
            _update_row(S[z, y], x[y], x[below], x_next[y], rows, r[y], w[z], p, isotropic, st[z])
            _divergence_row(r[y], r[below], vz[y], rows)
        to_spectrum(r, spectrum)
        _keep_and_add(totals[group[z]], g[z], spectrum, X[z])
        x, x_next = x_next, x


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _pivot_tile(
    ratio: Any, ratio_before: Any, inverse: Any, dx2: Any, row: Any, wx2: Any, wz2: Any, wb2: Any
) -> None:
    for i in range(dx2.shape[0]):
        inverse[i] = 1 / (row + wx2 * dx2[i] - wb2 * ratio_before[i])
        ratio[i] = wz2 * inverse[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _forward_tile(R: Any, before: Any, inverse: Any, wb2: Any) -> None:
    for i in range(inverse.shape[0]):
        R[2 * i] = (R[2 * i] + wb2 * before[2 * i]) * inverse[i]
        R[2 * i + 1] = (R[2 * i + 1] + wb2 * before[2 * i + 1]) * inverse[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _backward_tile(R: Any, after: Any, ratio: Any) -> None:
    for i in range(ratio.shape[0]):
        R[2 * i] += ratio[i] * after[2 * i]
        R[2 * i + 1] += ratio[i] * after[2 * i + 1]


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_product_tile(R: Any, g: Any, E: Any) -> None:
    for i in range(R.shape[0] // 2):
        R[2 * i] += g[2 * i] * E[2 * i] - g[2 * i + 1] * E[2 * i + 1]
        R[2 * i + 1] += g[2 * i] * E[2 * i + 1] + g[2 * i + 1] * E[2 * i]


@njit(nogil=True, cache=True)
def solve_rows(
    R: Any, g: Any, E: Any, w: Any, dy2: Any, dx2: Any, kappa: Any, add: bool, y0: int, y1: int, ratio: Any
) -> None:
    """``R <- T^-1 R``, and ``+ g E`` where ``add``, on spectral rows ``y0 <= y < y1``.

    Thomas' algorithm along z, without wrap-around. ``R``, ``g`` and ``E`` are real views (..., 2 Nxh) of the
    spectra; ``dy2`` and ``dx2`` the squared magnitudes of the lateral differences' transfer functions;
    ``ratio`` scratch (n_z + 1, columns taken together).
    """
    nz = R.shape[0]
    tile = ratio.shape[1]
    inverse = ratio[nz]
    zero = kappa - kappa
    for y in range(y0, y1):
        for i0 in range(0, dx2.shape[0], tile):
            i1 = min(i0 + tile, dx2.shape[0])
            n = i1 - i0
            for z in range(nz):
                b = z - 1 if z > 0 else 0
                wz2 = w[z, 0] * w[z, 0] if z + 1 < nz else zero
                wb2 = w[b, 0] * w[b, 0] if z > 0 else zero
                row = kappa + wz2 + wb2 + w[z, 1] * w[z, 1] * dy2[y]
                _pivot_tile(
                    ratio[z, :n], ratio[b, :n], inverse[:n], dx2[i0:i1], row, w[z, 2] * w[z, 2], wz2, wb2
                )
                _forward_tile(R[z, y, 2 * i0 : 2 * i1], R[b, y, 2 * i0 : 2 * i1], inverse[:n], wb2)
            e = E[y, 2 * i0 : 2 * i1]
            for z in range(nz - 2, -1, -1):
                _backward_tile(R[z, y, 2 * i0 : 2 * i1], R[z + 1, y, 2 * i0 : 2 * i1], ratio[z, :n])
                if add:
                    _add_product_tile(R[z + 1, y, 2 * i0 : 2 * i1], g[z + 1, y, 2 * i0 : 2 * i1], e)
            if add:
                _add_product_tile(R[0, y, 2 * i0 : 2 * i1], g[0, y, 2 * i0 : 2 * i1], e)


@njit(nogil=True, cache=True)
def solve_transfer_rows(
    g: Any, w: Any, dy2: Any, dx2: Any, kappa: Any, q: Any, y0: int, y1: int, ratio: Any, H: Any
) -> None:
    """``g``, which holds the transfer functions H, becomes ``T^-1 conj(H)``; ``q = sum_z H_z g_z`` (real)."""
    real = g.view(q.dtype)
    for y in range(y0, y1):
        for z in range(g.shape[0]):
            H[z] = g[z, y]
            g[z, y] = np.conj(g[z, y])
        solve_rows(real, real, real[0], w, dy2, dx2, kappa, False, y, y + 1, ratio)
        q[y] = 0
        for z in range(g.shape[0]):
            for i in range(q.shape[1]):
                q[y, i] += (H[z, i] * g[z, y, i]).real


L1_STATISTICS = 4


@njit(nogil=True, cache=True, fastmath=FAST)
def _update_plane(z: Any, d: Any, t: Any, relax: Any, step_scale: Any, positive: bool, st: Any) -> None:
    """``x = z + d; u = prox(x + d); z <- z + relax (u - x)``; ``st``: l1, (u - x)^2, u^2, d^2.

    Where gamma is multiplied by ``step_scale``, so is ``d``, about an unchanged x.
    """
    zero = t - t
    shift = relax / relax - step_scale
    for y in range(z.shape[0]):
        a, b = z[y], d[y]
        l1, gap, uu, dd = zero, zero, zero, zero
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
        a, b = z[y], d[y]
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
