"""What stands in front of the camera, as points at continuous places.

Places are ``(row, column, place in depth)``: rows and columns in pixels of the picture from the axis, the
place in depth from 0 (farthest) to 1 (nearest), evenly in 1/z as PSFs change; with them a brightness each.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Float64Array

SUBSAMPLES = 3
"""Points along each side of a pixel of a picture: its edges lie between the pixels of any reconstruction."""


def dense_picture(rng: np.random.Generator, side: int, density: float) -> Float64Array:
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


def sparse_picture(rng: np.random.Generator, side: int, density: float) -> Float64Array:
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


def text(rng: np.random.Generator, side: int, density: float) -> Float64Array:
    """Lines of letters of several sizes on black, (side, side), 0 to 1. ``density`` scales their number."""
    import cv2

    image = np.zeros((side, side), np.uint8)
    top = 0.08 * side
    while top < 0.92 * side:
        high = rng.uniform(0.06, 0.14) * side / np.sqrt(density)
        letters = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ23456789"), 40))
        # Hershey letters are 21 units high.
        bold = max(round(high / 8), 1)
        place = (round(rng.uniform(0.05, 0.25) * side), round(top + high))
        shown = letters[: max(int((0.9 * side - place[0]) / (0.9 * high)), 1)]
        shade = float(rng.uniform(120, 255))
        cv2.putText(image, shown, place, cv2.FONT_HERSHEY_SIMPLEX, high / 21, shade, bold, cv2.LINE_AA)
        top += 1.5 * high
    return np.asarray(image / 255.0)


def filaments(rng: np.random.Generator, side: int, density: float) -> Float64Array:
    """Bent threads on black, (side, side), 0 to 1. ``density`` scales their number."""
    import cv2

    image = np.zeros((side, side))
    for _ in range(max(round(14 * density), 1)):
        steps = 40
        turn = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.12, steps))
        line = rng.uniform(0.1, 0.9, 2) + np.cumsum(
            np.column_stack([np.cos(turn), np.sin(turn)]), axis=0
        ) / steps * (rng.uniform(0.3, 0.9))
        one = np.zeros((side, side), np.uint8)
        wide = max(round(rng.uniform(0.006, 0.014) * side), 1)
        cv2.polylines(one, [np.round(line * side).astype(np.int32)], False, 255, wide, cv2.LINE_AA)
        image = np.maximum(image, one / 255.0 * rng.uniform(0.3, 1))
    return image


def gradient(rng: np.random.Generator, side: int, density: float) -> Float64Array:
    """Smooth shades with nowhere an edge, (side, side), 0 to 1. ``density`` scales how often they change."""
    y, x = np.mgrid[:side, :side] / side - 0.5
    image = rng.uniform(-1, 1) * y + rng.uniform(-1, 1) * x
    for _ in range(3):
        turn, phase = rng.uniform(0, 2 * np.pi, 2)
        waves = 2 * np.pi * rng.uniform(0.3, 1.2) * density
        image += rng.uniform(0.2, 0.6) * np.sin(waves * (np.cos(turn) * y + np.sin(turn) * x) + phase)
    return _from_0_to_1(image)


def texture(rng: np.random.Generator, side: int, density: float) -> Float64Array:
    """Noise whose amplitudes fall as one over the frequency, as in natural pictures, (side, side), 0 to 1.

    ``density`` makes them fall more slowly.
    """
    frequency = np.hypot(np.fft.fftfreq(2 * side)[:, None], np.fft.rfftfreq(2 * side)) * 2 * side
    spectrum = np.fft.rfft2(rng.standard_normal((2 * side, 2 * side)))
    spectrum *= np.maximum(frequency, 1) ** (-1.3 / density**0.25)
    return _from_0_to_1(np.fft.irfft2(spectrum)[:side, :side])


def lights(rng: np.random.Generator, side: int, density: float) -> Float64Array:
    """Small beads in one plane, on black, (side, side), 0 to 1. ``density`` scales their number."""
    image = np.zeros((side, side))
    radius = 0.008 * side
    reach = int(radius) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    for _ in range(max(round(30 * density), 1)):
        row, column = rng.integers(reach, side - reach, 2)
        disc = np.clip(radius + 0.5 - np.hypot(y, x), 0, 1) * rng.uniform(0.3, 1)
        around = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
        image[around] = np.maximum(image[around], disc)
    return image


def _from_0_to_1(image: Float64Array) -> Float64Array:
    low, high = image.min(), image.max()
    return np.asarray((image - low) / (high - low))


PICTURES = {
    "dense-picture": dense_picture,
    "sparse-picture": sparse_picture,
    "text": text,
    "filaments": filaments,
    "gradient": gradient,
    "texture": texture,
    "lights": lights,
}
"""What draws a picture of each family: ``draw(rng, side, density)``."""


def beads(rng: np.random.Generator, size: float, count: int) -> Float64Array:
    """Beads anywhere in the volume, (count, 4), each as bright as 0.5 to 1.5."""
    places = rng.uniform(-0.42, 0.42, (count, 2)) * size
    return np.column_stack([places, rng.uniform(0.06, 0.94, count), rng.uniform(0.5, 1.5, count)])


def dense_volume(rng: np.random.Generator, size: float, density: float) -> Float64Array:
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


def tissue(rng: np.random.Generator, size: float, density: float) -> Float64Array:
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


def _blobs(rng: np.random.Generator, size: float, count: int, radius: float) -> Float64Array:
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
