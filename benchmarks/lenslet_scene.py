"""A lensless camera with a random microlens diffuser, and scenes in front of it, in closed form.

Every lenslet casts one Gaussian spot. A point at any continuous position (x, y, z) is rendered spot by spot,
so that measurements are not made with the reconstruction's model: no voxel grid, no convolution, no FFT.
Lengths are in sensor pixels; ``m`` is the depth coordinate along which PSFs change evenly, the magnification
``1 + d / z`` (Kuo 2020, Eq. 4.7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from recon.evaluation.lenslets import stamp


@njit(nogil=True)
def _render(image, points, lenses, brightness, focus, blur):
    for p in range(points.shape[0]):
        y, x, m, light = points[p]
        sigma = np.sqrt(0.7**2 + (blur * (m - focus)) ** 2)
        for k in range(lenses.shape[0]):
            row = image.shape[0] // 2 + y + m * lenses[k, 0]
            column = image.shape[1] // 2 + x + m * lenses[k, 1]
            if -9 < row < image.shape[0] + 9 and -9 < column < image.shape[1] + 9:
                stamp(image, row, column, sigma, light * brightness[k])


@dataclass(frozen=True)
class Camera:
    """Sensor of ``size`` x ``size`` pixels; depths evenly spaced in magnification."""

    size: int
    depths: int
    lenses: int = 80
    span: float = 0.3
    seed: int = 0

    @property
    def magnifications(self) -> np.ndarray:
        """One a depth plane; the nearest (largest) first."""
        return np.linspace(1 + self.span, 1.0, self.depths)

    def render(self, points: np.ndarray) -> np.ndarray:
        """Return the noise-free measurement of points ``(y, x, m, light)``, float32."""
        rng = np.random.default_rng(self.seed)
        lenses = rng.uniform(-0.33, 0.33, (self.lenses, 2)) * self.size
        brightness = rng.uniform(0.5, 1.5, self.lenses)
        image = np.zeros((self.size, self.size), np.float32)
        blur = 1.5 / self.span
        _render(image, np.asarray(points, np.float64), lenses, brightness, 1 + 0.4 * self.span, blur)
        return image

    def psfs(self) -> np.ndarray:
        """Return the calibration: a unit point on the axis at every depth, (depths, 1, size, size)."""
        return np.stack([self.render(np.array([[0, 0, m, 1.0]]))[None] for m in self.magnifications])

    def grid(self, points: np.ndarray, shape: tuple[int, int, int], centre: tuple[int, int]) -> np.ndarray:
        """Return the truth on a voxel grid: each point's light shared by its eight nearest voxels."""
        truth = np.zeros(shape, np.float32)
        y, x, m, light = np.asarray(points, np.float64).T
        z = (1 + self.span - m) / self.span * (self.depths - 1)
        corner = [np.floor(v).astype(int) for v in (z, y + centre[0], x + centre[1])]
        part = [v - np.floor(v) for v in (z, y, x)]
        for bits in range(8):
            index, weight = [], light.copy()
            for axis in range(3):
                far = bits >> axis & 1
                index.append(np.clip(corner[axis] + far, 0, shape[axis] - 1))
                weight = weight * (part[axis] if far else 1 - part[axis])
            np.add.at(truth, tuple(index), weight)
        return truth


def beads(camera: Camera, count: int, seed: int = 1, field: float = 0.42) -> np.ndarray:
    """Return beads at random continuous positions inside the field, not in the outermost planes."""
    rng = np.random.default_rng(seed)
    y, x = rng.uniform(-field, field, (2, count)) * camera.size
    m = 1 + camera.span * rng.uniform(0.15, 0.85, count)
    return np.stack([y, x, m, rng.uniform(0.5, 1.5, count)], axis=1)


def tilted_bars(camera: Camera, field: float = 0.4) -> np.ndarray:
    """Return bars of falling width on a plane tilted about the vertical axis, as densely spaced points."""
    points = []
    half = field * camera.size
    x, width = -half, camera.size / 14
    while x + width < half:
        for column in np.arange(x, x + width, 0.5):
            depth = 0.15 + 0.7 * (column + half) / (2 * half)
            rows = np.arange(-0.6 * half, 0.6 * half, 0.5)
            line = np.stack([rows, np.full_like(rows, column), np.full_like(rows, 1 + camera.span * depth)])
            points.append(np.concatenate([line, np.full((1, rows.size), 0.25)]))
        x, width = x + 2 * width, max(width * 0.85, 1.5)
    return np.concatenate(points, axis=1).T


def expose(clean: np.ndarray, photons: float, read_noise: float = 2.0, seed: int = 2) -> np.ndarray:
    """Return counts with photon and read noise; ``photons`` at the brightest pixel."""
    rng = np.random.default_rng(seed)
    light = clean * (photons / clean.max())
    return (rng.poisson(light) + rng.normal(0, read_noise, light.shape)).astype(np.float32)
