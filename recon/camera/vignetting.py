"""How a photograph's light falls off towards its edges, where its PSF's does not: fitted to itself.

Whatever the object, a convolution casts no light that is shaded with the sensor's own place. So the shade by
which the photograph is divided is right where its PSF then explains it: few numbers, found by Gauss-Newton on
what the reconstruction of a small copy leaves (variable projection).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recon.arrays import Float32Array, Float64Array

STEPS, SETTLED, ENOUGH = 6, 0.05, 0.7
"""Gauss-Newton's at most, the share of the misfit by which the last one falls, and the mean square, in units
of what usual errors leave, with which it ends."""
DIFFERENCE = 0.05
"""Of each number, for its derivative."""
LEAST = 0.1
"""Penalty on the squared numbers, misfit in units of the usual error: light that falls off a little is an
object's as well. With 0.5 a deep shade (a quarter in the corners) is missed and 3 dB of the hand are lost."""
FIRM, FIRMEST = 1e-2, 1e3
"""Levenberg's damping, at first and where no step is found any more."""
NUMBERS = 5
"""Of a shade."""
DEEPEST = 0.05
"""Least of a shade relative to its brightest place; one that comes to it is none."""


def shade_of(numbers: Float64Array, shape: tuple[int, int]) -> Float32Array:
    """Return relative light on pixels, (height, width), 1 where it is brightest.

    Parameters
    ----------
    numbers : ndarray, (5,)
        Of x^2, y^2, r^4, x and y in units of half the longer side from the centre: minus its logarithm.
    shape : (int, int)
    """
    fallen = np.tensordot(numbers, _terms(shape), 1)
    relative: Float32Array = np.maximum(np.exp(fallen.min() - fallen), DEEPEST).astype(np.float32)
    return relative


def _terms(shape: tuple[int, int]) -> Float64Array:
    y, x = ((np.arange(n) - (n - 1) / 2) / (max(shape) / 2) for n in shape)
    rows, columns = np.meshgrid(y, x, indexing="ij")
    return np.stack([columns**2, rows**2, (columns**2 + rows**2) ** 2, columns, rows])


def least_squares(
    left: Callable[[Float64Array], Float64Array], deepest: Callable[[Float64Array], bool]
) -> Float64Array | None:
    """Return the numbers of a shade of least mean square and penalty, by Levenberg's steps from none.

    None as soon as a step comes to a shade that is ``deepest``: it is none, however much it explains.
    """
    firm, numbers = FIRM, np.zeros(NUMBERS)
    rest = left(numbers)
    least = float(np.mean(rest**2))
    for _ in range(STEPS):
        moves = DIFFERENCE * np.eye(len(numbers))
        slopes = np.stack([(left(numbers + move) - rest) / DIFFERENCE for move in moves], axis=1)
        normal = slopes.T @ slopes / len(rest) + LEAST * np.eye(len(numbers))
        downhill = -(slopes.T @ rest / len(rest) + LEAST * numbers)
        while firm < FIRMEST:
            tried = numbers + np.linalg.solve(normal + firm * np.diag(np.diag(normal)), downhill)
            after = left(tried)
            misfit = float(np.mean(after**2)) + LEAST * float(tried @ tried)
            if misfit < least:
                break
            firm *= 10
        else:
            break
        fallen, firm = 1 - misfit / least, max(firm / 10, FIRM / 10)
        numbers, rest, least = tried, after, misfit
        if deepest(numbers):
            return None
        if fallen < SETTLED or float(np.mean(rest**2)) < ENOUGH:
            break
    return numbers
