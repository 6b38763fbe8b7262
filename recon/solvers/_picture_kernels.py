"""Compiled sweeps of the solvers of pictures (imported lazily: numba).

Those of :mod:`recon.solvers.prior_splits`: arrays are ``(n_channels, height, width)``. Each channel is cut
into strips of rows (``edges``) that do not depend on the number of threads, and sums are kept per row, so
that results do not depend on it either. Penalties and thresholds are arrays with one entry a channel, in the
precision of the images: a Python float would turn all arithmetic into float64.

Those of the data's split (:mod:`recon.solvers.admm`) and of the data term on the sensor
(:mod:`recon.solvers.sensor_admm`): one channel at a time; a call does the rows from ``start`` to ``stop``,
and sums are kept per row. ``T = mu_w + mu_u |Psi|^2`` and ``|H|^2`` of the latter are computed on the fly:
reading them would cost more than the arithmetic.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from recon.camera._kernels import FAST

# Columns of ``sums``
# (squared norms; CHANGE: of a split variable; MULTIPLIER: of its scaled dual variable)
TV, L1 = 0, 1
PRIMAL_U, CHANGE_U, NORM_U, MULTIPLIER_U = 2, 3, 4, 5
PRIMAL_W, CHANGE_W, NORM_W, MULTIPLIER_W = 6, 7, 8, 9
N_SUMS = 10


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


# Columns of the sums over the sensor's pixels, and over the grid's frequencies. Squared norms.
DATA, PRIMAL, CHANGE, NORM, MULTIPLIER, STEP_SEEN, STATE_SEEN = 0, 1, 2, 3, 4, 5, 6
N_SENSOR_SUMS = 7
STEP, STATE = 0, 1
N_GRID_SUMS = 2


@njit(inline="always")
def _frequencies(
    first: int, last: int, y: Any, t: Any, q: Any, h: Any, p: Any, row: Any, columns: Any,
    mu_v: Any, relax: Any,
) -> Any:  # fmt: skip
    step, state = row - row, row - row
    one = mu_v / mu_v
    for j in range(first, last):
        hr, hi = h[j].real, h[j].imag
        tr, ti = t[j].real, t[j].imag
        qr, qi = q[j].real, q[j].imag
        # R(t) = 2 prox(t) - t = t - 2 q
        rr, ri = mu_v * (tr - qr - qr), mu_v * (ti - qi - qi)
        inverse = one / (mu_v * (hr * hr + hi * hi) + row + columns[j])
        yr = (y[j].real + hr * rr + hi * ri) * inverse
        yi = (y[j].imag + hr * ri - hi * rr) * inverse
        sr, si = hr * yr - hi * yi - tr + qr, hr * yi + hi * yr - ti + qi
        tr, ti = tr + relax * sr, ti + relax * si
        y[j] = complex(yr, yi)
        t[j] = complex(tr, ti)
        p[j] = complex(tr, ti)
        step += sr * sr + si * si
        state += tr * tr + ti * ti
    return step, state


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def solve(
    start: int, stop: int, Y: Any, T: Any, Q: Any, H: Any, P: Any, rows: Any, columns: Any,
    mu_v: Any, relax: Any, nyquist: bool, sums: Any,
) -> None:  # fmt: skip
    """Solve for ``y`` and advance the data state by ``relax (M y - prox(t))``.

    In: ``Y`` the spectrum of the prior's right-hand side, ``T`` that of the state, ``Q`` that of what its
    prox takes off; ``rows[i] + columns[j]`` the prior's part of the system. Out: ``Y`` the spectrum of ``y``,
    ``T`` the new state's, also in ``P``. ``nyquist``: whether the last column stands for itself alone, as the
    first does, and not for its mirror image too.
    """
    width = Y.shape[1]
    last = width - 1 if nyquist else width
    for i in range(start, stop):
        y, t, q, h, p, row = Y[i], T[i], Q[i], H[i], P[i], rows[i]
        first_sums = _frequencies(0, 1, y, t, q, h, p, row, columns, mu_v, relax)
        inner_sums = _frequencies(1, last, y, t, q, h, p, row, columns, mu_v, relax)
        last_sums = _frequencies(last, width, y, t, q, h, p, row, columns, mu_v, relax)
        sums[i, STEP] = first_sums[0] + inner_sums[0] + inner_sums[0] + last_sums[0]
        sums[i, STATE] = first_sums[1] + inner_sums[1] + inner_sums[1] + last_sums[1]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def see(
    start: int, stop: int, band: Any, left: int, t: Any, data: Any, weight: Any, mu: Any, relax: Any,
    sums: Any,
) -> None:  # fmt: skip
    """Take the data state's new values on the sensor; put what its prox takes off in their place.

    ``prox(t) = t - q``, ``q = w / (w + mu) (t - b)``. In: ``band`` the sensor's rows of the new state,
    ``t`` the sensor's part of the one before. Out: ``t`` the new one, ``band`` ``q``, zero off the sensor.
    """
    for i in range(start, stop):
        for j in range(left):
            band[i, j] = 0
        for j in range(left + t.shape[1], band.shape[1]):
            band[i, j] = 0
        # Slices: an index with an offset may be negative for all the compiler knows, and costs the vectors.
        row, state, pixels, weights = band[i, left : left + t.shape[1]], t[i], data[i], weight[i]
        zero = mu - mu
        residual, primal, change, norm, multiplier = zero, zero, zero, zero, zero
        step_sum, state_sum = zero, zero
        for j in range(state.shape[0]):
            w, b, before, new = weights[j], pixels[j], state[j], row[j]
            share = w / (w + mu)
            step = (new - before) / relax
            p = before - share * (before - b)
            my = p + step
            q = share * (new - b)
            p_new = new - q
            residual += w * (my - b) ** 2
            primal += (my - p_new) ** 2
            change += (p_new - p) ** 2
            norm += p_new * p_new
            multiplier += q * q
            step_sum += step * step
            state_sum += new * new
            state[j] = new
            row[j] = q
        out = sums[i]
        out[DATA], out[PRIMAL], out[CHANGE], out[NORM] = residual, primal, change, norm
        out[MULTIPLIER], out[STEP_SEEN], out[STATE_SEEN] = multiplier, step_sum, state_sum


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
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


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
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


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def weigh(
    start: int, stop: int, P: Any, H: Any, laplace_rows: Any, laplace_columns: Any, mu_u: Any, mu_w: Any
) -> None:
    """``P <- q P``."""
    for i in range(start, stop):
        row = mu_w + mu_u * laplace_rows[i]
        for j in range(P.shape[1]):
            h = H[i, j]
            P[i, j] *= (h.real * h.real + h.imag * h.imag) / (row + mu_u * laplace_columns[j])


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
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
            e, y = E[i, j], Y[i, j]  # adding to an element in place costs the vectors
            E[i, j] = complex(e.real + length * pr, e.imag + length * pi)
            Y[i, j] = complex(y.real + (hr * pr + hi * pi) * scale, y.imag + (hr * pi - hi * pr) * scale)


@njit(nogil=True, cache=True, fastmath=FAST)
def residual(start: int, stop: int, r: Any, seen: Any, left: int, data: Any, e: Any) -> None:
    """``r <- data - seen - e``."""
    for i in range(start, stop):
        row = seen[i, left : left + data.shape[1]]
        for j in range(data.shape[1]):
            r[i, j] = data[i, j] - row[j] - e[i, j]


@njit(nogil=True, cache=True, fastmath=FAST)
def reduce_residual(start: int, stop: int, r: Any, p: Any, image: Any, left: int, length: Any) -> None:
    """``r <- r - length (p + image)``."""
    for i in range(start, stop):
        row = image[i, left : left + r.shape[1]]
        for j in range(r.shape[1]):
            r[i, j] -= length * (p[i, j] + row[j])


@njit(nogil=True, cache=True, fastmath=FAST)
def impute(start: int, stop: int, data: Any, weight: Any, e: Any, relax: Any) -> None:
    """Move ``data`` on erased pixels by ``-relax e``: towards what the object would have cast there."""
    for i in range(start, stop):
        for j in range(data.shape[1]):
            data[i, j] -= (1 - weight[i, j]) * relax * e[i, j]


@njit(nogil=True, cache=True, fastmath=FAST)
def move_rows(
    start: int, stop: int, out: Any, image: Any, down: int, right: int, along: Any, across: Any
) -> None:
    """``out <- image`` moved by ``down - f`` and ``right - g``, of whose fractions the four weights are."""
    height, width = image.shape
    row = np.empty(width + 3, image.dtype)
    turn = right % width
    for i in range(start, stop):
        a, b = image[(i - down - 1) % height], image[(i - down) % height]
        c, d = image[(i - down + 1) % height], image[(i - down + 2) % height]
        for j in range(width):
            row[j + 1] = along[0] * a[j] + along[1] * b[j] + along[2] * c[j] + along[3] * d[j]
        row[0], row[width + 1], row[width + 2] = row[width], row[1], row[1 + 1 % width]
        for first, last, to in ((0, width - turn, turn), (width - turn, width, turn - width)):
            for j in range(first, last):
                out[i, j + to] = (
                    across[0] * row[j]
                    + across[1] * row[j + 1]
                    + across[2] * row[j + 2]
                    + across[3] * row[j + 3]
                )
