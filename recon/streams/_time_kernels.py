"""Compiled loops of :mod:`recon.streams.joint` (imported lazily: numba)."""

from __future__ import annotations

from typing import Any

from numba import njit


@njit(nogil=True, cache=True)
def denoise(start: int, stop: int, courses: Any, threshold: Any, result: Any) -> None:
    """Total-variation denoise rows ``start`` to ``stop`` of ``courses`` (n_courses, n_times) into ``result``.

    A segment begins at ``first``. ``low`` and ``high`` are the values between which its own must lie,
    ``below`` and ``above`` the dual variable that each would give; ``at_low`` and ``at_high`` are the last
    places where that touched its bound. A value out of reach ends the segment there.
    """
    last = courses.shape[1] - 1
    for row in range(start, stop):
        y, x = courses[row], result[row]
        k = first = at_low = at_high = 0
        low, high = y[0] - threshold, y[0] + threshold
        below, above = threshold, -threshold
        while True:
            if k == last:
                if below < 0:
                    x[first : at_low + 1] = low
                    first = k = at_low = at_low + 1
                    low, below = y[k], threshold
                    above = low + threshold - high
                elif above > 0:
                    x[first : at_high + 1] = high
                    first = k = at_high = at_high + 1
                    high, above = y[k], -threshold
                    below = high - threshold - low
                else:
                    x[first:] = low + below / (k - first + 1)
                    break
                continue
            below += y[k + 1] - low
            above += y[k + 1] - high
            if below < -threshold:
                x[first : at_low + 1] = low
                first = k = at_low = at_high = at_low + 1
                low, high = y[k], y[k] + 2 * threshold
                below, above = threshold, -threshold
            elif above > threshold:
                x[first : at_high + 1] = high
                first = k = at_low = at_high = at_high + 1
                low, high = y[k] - 2 * threshold, y[k]
                below, above = threshold, -threshold
            else:
                k += 1
                if below >= threshold:
                    at_low = k
                    low += (below - threshold) / (k - first + 1)
                    below = threshold
                if above <= -threshold:
                    at_high = k
                    high += (above + threshold) / (k - first + 1)
                    above = -threshold
