"""What stands in front of the camera, as points at continuous places.

Places are ``(row, column, place in depth)``: rows and columns in pixels of the picture from the axis, the
place in depth from 0 (farthest) to 1 (nearest), evenly in 1/z as PSFs change; with them a brightness each.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SUBSAMPLES = 3
"""Points along each side of a pixel of a picture: its edges lie between the pixels of any reconstruction."""


def dense_picture(rng: np.random.Generator, side: int, density: float) -> Floats:
    """Leaves that cover each other, of all sizes and shades, over a slope: (side, side), 0 to 1.

    ``density`` is the number of leaves relative to the default.
    """
    y, x = np.mgrid[:side, :side] / side - 0.5
    image = 0.35 + 0.3 * (x * rng.uniform(-1, 1) + y * rng.uniform(-1, 1))
    for _ in range(max(round(45 * density), 1)):
        centre = rng.uniform(-0.55, 0.55, 2)
        radius = 0.03 * rng.uniform(0.05, 1) ** -0.7
        turn, stretch = rng.uniform(0, np.pi), rng.uniform(0.3, 1)
        u = (y - centre[0]) * np.cos(turn) + (x - centre[1]) * np.sin(turn)
        v = (x - centre[1]) * np.cos(turn) - (y - centre[0]) * np.sin(turn)
        inside = (
            u**2 + (v / stretch) ** 2 < radius**2
            if rng.random() < 0.6
            else (np.abs(u) < radius) & (np.abs(v) < radius * stretch)
        )
        image[inside] = rng.uniform(0.05, 1) + 0.2 * u[inside] / radius
    return np.asarray(np.clip(image, 0, 1))


def sparse_picture(rng: np.random.Generator, side: int, density: float) -> Floats:
    """Strokes and discs on black, (side, side), 0 to 1. ``density`` scales their number."""
    y, x = np.mgrid[:side, :side] / side - 0.5
    image = np.zeros((side, side))
    for k in range(max(round(7 * density), 1)):
        centre = rng.uniform(-0.38, 0.38, 2)
        turn, length = rng.uniform(0, np.pi), rng.uniform(0.04, 0.14)
        u = (y - centre[0]) * np.cos(turn) + (x - centre[1]) * np.sin(turn)
        v = (x - centre[1]) * np.cos(turn) - (y - centre[0]) * np.sin(turn)
        half = rng.uniform(0.012, 0.03)
        inside = (np.abs(u) < length) & (np.abs(v) < half) if k % 2 else u**2 + v**2 < (1.8 * half) ** 2
        image[inside] = rng.uniform(0.3, 1)
    return image


def beads(rng: np.random.Generator, size: float, count: int) -> Floats:
    """Beads anywhere in the volume, (count, 4), each as bright as 0.5 to 1.5."""
    places = rng.uniform(-0.42, 0.42, (count, 2)) * size
    return np.column_stack([places, rng.uniform(0.06, 0.94, count), rng.uniform(0.5, 1.5, count)])


def dense_volume(rng: np.random.Generator, size: float, density: float) -> Floats:
    """Tilted sheets with holes, thick blobs and threads that fill much of the volume, (n, 4)."""
    step = 0.5
    parts = []
    for _ in range(max(round(3 * density), 1)):
        half = rng.uniform(0.12, 0.26, 2) * size
        rows, columns = (g.ravel() for g in np.mgrid[-half[0] : half[0] : step, -half[1] : half[1] : step])
        hole = np.hypot(rows - half[0] / 3, columns) < 0.35 * half.min()
        tilt = rng.uniform(-0.3, 0.3, 2)
        depth = rng.uniform(0.3, 0.7) + tilt[0] * rows / half[0] + tilt[1] * columns / half[1]
        centre = rng.uniform(-0.2, 0.2, 2) * size
        light = np.full(rows.size, rng.uniform(0.5, 1) * step**2)
        kept = ~hole & (depth > 0.02) & (depth < 0.98)
        parts.append(np.column_stack([rows + centre[0], columns + centre[1], depth, light])[kept])
    parts.append(_blobs(rng, size, max(round(9 * density), 1), 0.06))
    return np.concatenate(parts)


def tissue(rng: np.random.Generator, size: float, density: float) -> Floats:
    """Cell bodies and the threads between them, (n, 4): what fluoresces under a microscope."""
    count = max(round(14 * density), 2)
    bodies = _blobs(rng, size, count, 0.028)
    parts = [bodies]
    for _ in range(count // 2):
        ends = np.column_stack([rng.uniform(-0.4, 0.4, (2, 2)) * size, rng.uniform(0.1, 0.9, 2)])
        n = max(int(2 * np.linalg.norm(ends[1, :2] - ends[0, :2])), 2)
        along = np.linspace(0, 1, n)[:, None]
        line = ends[0] * (1 - along) + ends[1] * along
        line[:, :2] += 0.02 * size * np.sin(2 * np.pi * along * rng.uniform(0.5, 2))
        parts.append(np.column_stack([line, np.full(n, 0.12)]))
    return np.concatenate(parts)


def _blobs(rng: np.random.Generator, size: float, count: int, radius: float) -> Floats:
    """Fill balls with random points: a radius of about ``radius * size`` pixels, and some thickness."""
    parts = []
    for _ in range(count):
        n = 150
        inside = rng.normal(size=(n, 3))
        inside *= (rng.random((n, 1)) ** (1 / 3)) / np.linalg.norm(inside, axis=1, keepdims=True)
        reach = radius * size * rng.uniform(0.6, 1.4)
        centre = np.append(rng.uniform(-0.36, 0.36, 2) * size, rng.uniform(0.15, 0.85))
        places = centre + inside * np.array([reach, reach, 0.06])
        parts.append(np.column_stack([places, np.full(n, rng.uniform(0.6, 1.4) * reach**2 / n)]))
    return np.concatenate(parts)
