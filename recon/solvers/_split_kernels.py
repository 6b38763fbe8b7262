"""Compiled sweeps of :mod:`recon.solvers.prior_splits` (imported lazily: numba).

Arrays are ``(n_channels, height, width)``. Each channel is cut into strips of rows (``edges``) that do not
depend on the number of threads, and sums are kept per row, so that results do not depend on it either.
Penalties and thresholds are arrays with one entry a channel, in the precision of the images: a Python float
would turn all arithmetic into float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# Columns of ``sums``
# (squared norms; CHANGE: of a split variable; MULTIPLIER: of its scaled dual variable)
TV, L1 = 0, 1
PRIMAL_U, CHANGE_U, NORM_U, MULTIPLIER_U = 2, 3, 4, 5
PRIMAL_W, CHANGE_W, NORM_W, MULTIPLIER_W = 6, 7, 8, 9
N_SUMS = 10

# Reordering sums is fine (it is the same for every strip); NaN and infinity must stay what they are.
FAST = {"reassoc", "contract", "nsz"}


@njit(inline="always")
def _soft(t: Any, threshold: Any) -> Any:
    return t - min(max(t, -threshold), threshold)


@njit(nogil=True, cache=True, fastmath=FAST)
def save_strip_neighbours(
    y: Any, tx: Any, ty: Any, edges: Any, threshold: Any, relax: Any, isotropic: bool, below: Any, above: Any
) -> None:
    """Save what a strip needs of its neighbours before these are overwritten.

    ``below[c, s]``: the row of ``y`` after strip ``s``. ``above[c, s]``: the reflected vertical difference
    state of the row before it, as :func:`sweep_priors` will make it.
    """
    n_channels, height, width = y.shape
    spare = np.empty(width, y.dtype)
    sums = np.zeros(N_SUMS)
    for c in range(n_channels):
        for s in range(edges.size - 1):
            # By element: assigning slices costs seconds of compilation, for their error messages.
            for j in range(width):
                below[c, s, j] = y[c, edges[s + 1] % height, j]
            before = (edges[s] - 1) % height
            _update_differences(
                y[c, before], y[c, edges[s]], tx[c, before].copy(), ty[c, before].copy(),
                threshold[c], relax, isotropic, spare, above[c, s], sums,
            )  # fmt: skip


@njit(nogil=True, cache=True, fastmath=FAST)
def _update_differences(
    y: Any, following: Any, tx: Any, ty: Any, threshold: Any, relax: Any, isotropic: bool,
    rx: Any, ry: Any, sums: Any,
) -> None:  # fmt: skip
    """Update the difference states of one row; ``rx``, ``ry`` get the reflected states."""
    width = y.size
    zero = threshold - threshold
    one = y.dtype.type(1)
    tiny = y.dtype.type(1e-30)
    tv, primal, change, norm, multiplier = zero, zero, zero, zero, zero
    for j in range(width):
        dx = y[j + 1 if j + 1 < width else 0] - y[j]
        dy = following[j] - y[j]
        a, b = tx[j], ty[j]
        if isotropic:
            keep = max(one - threshold / max(np.sqrt(a * a + b * b), tiny), zero)
            p, q = keep * a, keep * b
        else:
            p, q = _soft(a, threshold), _soft(b, threshold)
        a += relax * (dx - p)
        b += relax * (dy - q)
        if isotropic:
            keep = max(one - threshold / max(np.sqrt(a * a + b * b), tiny), zero)
            p_new, q_new = keep * a, keep * b
            tv += np.sqrt(dx * dx + dy * dy)
        else:
            p_new, q_new = _soft(a, threshold), _soft(b, threshold)
            tv += abs(dx) + abs(dy)
        tx[j], ty[j] = a, b
        rx[j], ry[j] = p_new + p_new - a, q_new + q_new - b
        primal += (dx - p_new) ** 2 + (dy - q_new) ** 2
        change += (p_new - p) ** 2 + (q_new - q) ** 2
        norm += p_new * p_new + q_new * q_new
        multiplier += (a - p_new) ** 2 + (b - q_new) ** 2
    sums[TV] += tv
    sums[PRIMAL_U] += primal
    sums[CHANGE_U] += change
    sums[NORM_U] += norm
    sums[MULTIPLIER_U] += multiplier


@njit(nogil=True, cache=True, fastmath=FAST)
def _update_separable(
    y: Any, t: Any, threshold: Any, lower: Any, upper: Any, relax: Any, reflected: Any, sums: Any
) -> None:
    """Update the separable prior's state of one row."""
    zero = relax - relax
    primal, change, norm, multiplier, l1 = zero, zero, zero, zero, zero
    for j in range(y.size):
        p = min(max(_soft(t[j], threshold), lower), upper)
        new = t[j] + relax * (y[j] - p)
        p_new = min(max(_soft(new, threshold), lower), upper)
        t[j] = new
        reflected[j] = p_new + p_new - new
        primal += (y[j] - p_new) ** 2
        change += (p_new - p) ** 2
        norm += p_new * p_new
        multiplier += (new - p_new) ** 2
        l1 += abs(p_new)
    sums[L1] += l1
    sums[PRIMAL_W] += primal
    sums[CHANGE_W] += change
    sums[NORM_W] += norm
    sums[MULTIPLIER_W] += multiplier


@njit(nogil=True, cache=True, fastmath=FAST)
def sweep_priors(
    start: int, stop: int, edges: Any, below: Any, above: Any, y: Any, tx: Any, ty: Any, t_w: Any,
    mu_u: Any, mu_w: Any, threshold_u: Any, threshold_w: Any, lower: Any, upper: Any,
    relax: Any, isotropic: bool, sums: Any,
) -> None:  # fmt: skip
    """Update the priors' split states from ``y``, and put their next right-hand side in its place.

    Does strips ``start`` to ``stop``, counted over all channels, and starts their rows of ``sums`` anew.
    Afterwards ``y`` holds ``mu_u Psi^T R(t_u) + mu_w R(t_w)``, with ``R(t) = 2 prox(t) - t``.
    """
    _, height, width = y.shape
    n_strips = edges.size - 1
    rx = np.empty(width, y.dtype)
    ry = np.empty(width, y.dtype)
    rw = np.empty(width, y.dtype)
    ry_above = np.empty(width, y.dtype)
    for strip in range(start, stop):
        c, s = strip // n_strips, strip % n_strips
        for j in range(width):
            ry_above[j] = above[c, s, j]
        for i in range(edges[s], edges[s + 1]):
            row = sums[c * height + i]
            for k in range(N_SUMS):
                row[k] = 0
            following = below[c, s] if i + 1 == edges[s + 1] else y[c, i + 1]
            out = y[c, i]
            _update_separable(out, t_w[c, i], threshold_w[c], lower, upper, relax, rw, row)
            _update_differences(
                out, following, tx[c, i], ty[c, i], threshold_u[c], relax, isotropic, rx, ry, row
            )
            out[0] = mu_w[c] * rw[0] + mu_u[c] * (rx[width - 1] - rx[0] + ry_above[0] - ry[0])
            for j in range(1, width):
                out[j] = mu_w[c] * rw[j] + mu_u[c] * (rx[j - 1] - rx[j] + ry_above[j] - ry[j])
            ry, ry_above = ry_above, ry
