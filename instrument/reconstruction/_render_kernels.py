"""Compiled loops of :mod:`instrument.reconstruction.rendering` (imported lazily: numba)."""

from __future__ import annotations

from typing import Any

from numba import njit


@njit(nogil=True, cache=True)
def brightest(
    start: int, stop: int, best: Any, where: Any, slices: Any, down: Any, right: Any, by_slice: bool
) -> None:
    """Put the brightest voxels along a sheared axis into rows ``start`` to ``stop`` of ``best``.

    Slice ``k`` of ``slices`` (n, height, width) is moved by ``down[k]`` and ``right[k]``; ``where`` gets the
    number of its slice, or of its row in the slice.
    """
    n, height, width = slices.shape
    for row in range(start, stop):
        best[row] = 0
        where[row] = 0
        for k in range(n):
            i = row - down[k]
            if i < 0 or i >= height:
                continue
            line = slices[k, i]
            mark = k if by_slice else i
            value, place = best[row, right[k] : right[k] + width], where[row, right[k] : right[k] + width]
            for j in range(width):  # without branches: vector instructions
                more = line[j] > value[j]
                value[j] = line[j] if more else value[j]
                place[j] = mark if more else place[j]


@njit(nogil=True, cache=True)
def draw(
    start: int, stop: int, out: Any, best: Any, where: Any, warp: Any, low: float, high: float, shades: Any
) -> None:
    """Draw rows ``start`` to ``stop`` of ``out``, (height, width, 3), uint8, from a sheared projection.

    ``warp``, (2, 3), gives row and column in ``best`` of a row and column of ``out``; ``shades``,
    (n, 256, 3), the colours of a place's number and level.
    """
    height, width = best.shape
    scale = 255.0 / (high - low)
    for row in range(start, stop):
        for column in range(out.shape[1]):
            y = warp[0, 0] * row + warp[0, 1] * column + warp[0, 2]
            x = warp[1, 0] * row + warp[1, 1] * column + warp[1, 2]
            if not (0 <= y < height - 1 and 0 <= x < width - 1):
                out[row, column] = 0
                continue
            i, j = int(y), int(x)
            b, a = y - i, x - j
            above = best[i, j] * (1 - a) + best[i, j + 1] * a
            below = best[i + 1, j] * (1 - a) + best[i + 1, j + 1] * a
            level = int(min(max((above * (1 - b) + below * b - low) * scale, 0.0), 255.0))
            shade = shades[min(int(where[int(y + 0.5), int(x + 0.5)]), shades.shape[0] - 1), level]
            out[row, column, 0] = shade[0]
            out[row, column, 1] = shade[1]
            out[row, column, 2] = shade[2]
