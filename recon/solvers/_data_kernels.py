"""Compiled loops of :mod:`recon.solvers.admm` over spectra and sensor images (imported lazily: numba).

One channel at a time; a call does the rows from ``start`` to ``stop``, and sums are kept per row, so that
results do not depend on the number of threads. Scalars must come in the arrays' precision.
"""

from __future__ import annotations

from typing import Any

from numba import njit

# Columns of the sums over the sensor's pixels, and over the grid's frequencies. Squared norms.
DATA, PRIMAL, CHANGE, NORM, MULTIPLIER, STEP_SEEN, STATE_SEEN = 0, 1, 2, 3, 4, 5, 6
N_SENSOR_SUMS = 7
STEP, STATE = 0, 1
N_GRID_SUMS = 2

# Reordering sums is fine (it is the same for every row); NaN and infinity must stay what they are.
FAST = {"reassoc", "contract", "nsz"}


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


@njit(nogil=True, cache=True, fastmath=FAST)
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


@njit(nogil=True, cache=True, fastmath=FAST)
def see(
    start: int, stop: int, band: Any, left: int, t: Any, data: Any, weight: Any, mu: Any, relax: Any,
    sums: Any,
) -> None:  # fmt: skip
    """Take the data state's new values on the sensor; put what its prox takes off in their place.

    ``prox(t) = t - q``, ``q = w / (w + mu) (t - b)``. In: ``band`` the sensor's rows of the new state,
    ``t`` the sensor's part of the one before. Out: ``t`` the new one, ``band`` ``q``, zero off the sensor.
    """
    for i in range(start, stop):
        row = band[i]
        zero = mu - mu
        residual, primal, change, norm, multiplier = zero, zero, zero, zero, zero
        step_sum, state_sum = zero, zero
        for j in range(left):
            row[j] = zero
        for j in range(left + t.shape[1], row.size):
            row[j] = zero
        for j in range(t.shape[1]):
            w, b, before, new = weight[i, j], data[i, j], t[i, j], row[left + j]
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
            t[i, j] = new
            row[left + j] = q
        out = sums[i]
        out[DATA], out[PRIMAL], out[CHANGE], out[NORM] = residual, primal, change, norm
        out[MULTIPLIER], out[STEP_SEEN], out[STATE_SEEN] = multiplier, step_sum, state_sum
