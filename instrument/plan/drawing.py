"""A plan's path drawn with letters, for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

Point = tuple[float, float]
WIDTH, HEIGHT = 56, 14


def draw_path(points: Sequence[Point], x_name: str, y_name: str = "") -> str:
    """Return a drawing of points in order: ``S`` the first, ``E`` the last, ``o`` others, dots between.

    Without ``y_name`` the path is a line, and drawn in one.
    """
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    rows = HEIGHT if y_name else 1
    grid = [[" "] * WIDTH for _ in range(rows)]

    def cell(point: Point) -> tuple[int, int]:
        return (
            _scaled(point[1], min(ys), max(ys), rows - 1),
            _scaled(point[0], min(xs), max(xs), WIDTH - 1),
        )

    cells = [cell(point) for point in points]
    for start, end in pairwise(cells):
        length = max(abs(end[0] - start[0]), abs(end[1] - start[1]), 1)
        for i in range(length + 1):
            row = round(start[0] + (end[0] - start[0]) * i / length)
            column = round(start[1] + (end[1] - start[1]) * i / length)
            grid[row][column] = "."
    for row, column in cells:
        grid[row][column] = "o"
    grid[cells[-1][0]][cells[-1][1]] = "E"
    grid[cells[0][0]][cells[0][1]] = "S"
    frame = "+" + "-" * WIDTH + "+"
    drawn = "\n".join("|" + "".join(row) + "|" for row in grid)
    caption = f"{x_name} {min(xs):g} to {max(xs):g}"
    if y_name:
        caption += f" (across), {y_name} {min(ys):g} to {max(ys):g} (down)"
    return f"{frame}\n{drawn}\n{frame}\n{caption}"


def _scaled(value: float, low: float, high: float, last: int) -> int:
    return last // 2 if high == low else round((value - low) / (high - low) * last)
