"""Measurements, PSFs and pictures of the golden cases: NumPy and SciPy only, from fixed seeds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from recon.arrays import BoolArray, Float32Array, Float64Array

Point = tuple[float, float, float, float]
"""Row and column from the axis in pixels, depth plane (may lie between two), light."""

SHAPE = (40, 48)
PITCH_UM, DISTANCE_MM = 10.0, 5.0
READ_NOISE = 2.0

BEADS: tuple[Point, ...] = ((-9.3, 4.6, 0.2, 9000.0), (6.4, -7.7, 1.9, 7000.0), (2.1, 9.2, 1.1, 8000.0))


def depths_um(count: int) -> Float64Array:
    """Depths evenly spaced in 1/z, the farthest first."""
    return np.linspace(1 / 25, 1 / 8, count) ** -1 * 1000


def _lenses(shape: tuple[int, int], seed: int) -> Float64Array:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (18, 2)) * shape


def cast(
    points: Sequence[Point],
    *,
    shape: tuple[int, int] = SHAPE,
    seed: int = 0,
    depths: int = 3,
    stretch: float = 0.0,
) -> Float64Array:
    """Draw what random lenslets cast of points: a Gaussian spot a lenslet, at continuous places.

    ``stretch`` moves each lenslet's spot outwards by that share of the point's distance from the axis, so
    that patterns vary over the field.
    """
    y, x = np.mgrid[: shape[0], : shape[1]] - np.array([shape[0] // 2, shape[1] // 2])[:, None, None]
    image = np.zeros(shape)
    for row, column, depth, light in points:
        near = depth / max(depths - 1, 1)
        size = (1 + 0.3 * near) * (1 + stretch * np.hypot(row, column) / max(shape))
        sigma = 1.0 + 0.4 * abs(near - 0.4)
        for lens_y, lens_x in size * _lenses(shape, seed):
            spot = np.exp(-((y - row - lens_y) ** 2 + (x - column - lens_x) ** 2) / (2 * sigma**2))
            image += light / (2 * np.pi * sigma**2) * spot
    return image


@cache
def psf(shape: tuple[int, int] = SHAPE, seed: int = 0) -> Float64Array:
    """One PSF on the axis."""
    return cast([(0, 0, 0, 50.0)], shape=shape, seed=seed, depths=1)


def noisy(image: Float64Array, seed: int) -> Float64Array:
    """Add photon noise and read noise, counts."""
    rng = np.random.default_rng(seed)
    return rng.poisson(np.maximum(image, 0)) + rng.normal(0, READ_NOISE, image.shape)


def strokes(shape: tuple[int, int] = SHAPE, seed: int = 3) -> Float64Array:
    """Smooth bright shapes on black."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    scene = np.zeros(shape)
    for _ in range(5):
        cy, cx = rng.uniform(0.25, 0.75, 2) * shape
        a, b = rng.uniform(0.05, 0.15, 2) * shape
        scene[((y - cy) / a) ** 2 + ((x - cx) / b) ** 2 < 1] = rng.uniform(0.3, 1.0)
    return gaussian_filter(scene, 0.6)


@cache
def photograph(
    shape: tuple[int, int] = SHAPE, seed: int = 1, channels: int = 0, dense: bool = False
) -> Float32Array:
    """A photograph of shapes through :func:`psf`: summed shift by shift, so that no FFT is in it."""
    height, width = shape
    kernel = psf(shape) / 50.0
    images = []
    for channel in range(max(channels, 1)):
        scene = strokes(shape, 3 + channel) * (1 - 0.25 * channel) + (0.3 if dense else 0.0)
        wide = np.zeros((2 * height, 2 * width))
        wide[height // 2 : height // 2 + height, width // 2 : width // 2 + width] = kernel
        image = np.zeros(shape)
        for row, column in zip(*np.nonzero(scene > 1e-3), strict=True):
            top, left = height - row, width - column
            image += scene[row, column] * wide[top : top + height, left : left + width]
        images.append(noisy(image * 1500 / image.max(), seed + 10 * channel))
    found = images[0] if not channels else np.stack(images, axis=-1)
    return np.asarray(found, np.float32)


def axial(depths: int = 3, shape: tuple[int, int] = SHAPE, channels: int = 1) -> dict[str, Any]:
    """A calibration on the axis as plain arrays: psfs, positions, pitch and distance."""
    psfs = np.stack([cast([(0, 0, z, 50.0)], shape=shape, depths=depths) for z in range(depths)])
    psfs = np.repeat(psfs[:, None], channels, axis=1)
    positions = np.stack([np.zeros(depths), np.zeros(depths), depths_um(max(depths, 2))[:depths]], axis=1)
    return _arrays(psfs, positions)


def over_field(depths: int = 1, shape: tuple[int, int] = SHAPE, stretch: float = 0.8) -> dict[str, Any]:
    """A calibration of 3 x 3 places at each depth, whose patterns vary over the field."""
    psfs, positions = [], []
    for plane, z_um in enumerate(depths_um(max(depths, 2))[:depths]):
        for row in (-9, 0, 9):
            for column in (-9, 0, 9):
                psfs.append(cast([(row, column, plane, 50.0)], shape=shape, depths=depths, stretch=stretch))
                metres = -PITCH_UM * z_um / (1000 * DISTANCE_MM)
                positions.append((column * metres, row * metres, z_um))
    return _arrays(np.stack(psfs)[:, None], np.array(positions))


def _arrays(psfs: Float64Array, positions: Float64Array) -> dict[str, Any]:
    return {
        "psfs": np.ascontiguousarray(psfs, np.float32),
        "positions_um": np.asarray(positions, np.float64),
        "pitch_um": PITCH_UM,
        "distance_mm": DISTANCE_MM,
    }


def beads(
    depths: int = 3,
    *,
    shape: tuple[int, int] = SHAPE,
    stretch: float = 0.0,
    background: float = 0.0,
    channels: int = 0,
    seed: int = 2,
) -> Float32Array:
    """A photograph of three beads, in a volume or, with one depth, flat; ``background`` adds a smooth one."""
    points = [(y, x, min(z, depths - 1.0) if depths > 1 else 0, light) for y, x, z, light in BEADS]
    image = cast(points, shape=shape, depths=depths, stretch=stretch)
    v, u = np.mgrid[: shape[0], : shape[1]] / np.array(shape)[:, None, None]
    image = image + background * (1 + 0.5 * np.cos(np.pi * v) * np.cos(np.pi * u))
    if not channels:
        return np.asarray(noisy(image, seed), np.float32)
    return np.stack([noisy(image * (1 - 0.2 * c), seed + c) for c in range(channels)], -1).astype(np.float32)


def erased(shape: tuple[int, int] = SHAPE, share: float = 0.3) -> BoolArray:
    """Which pixels tell nothing."""
    return np.random.default_rng(5).random(shape) < share


def patterns(shape: tuple[int, int] = SHAPE) -> tuple[Float32Array, Float32Array]:
    """Frames of one scene under four patterns of light, and the patterns."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    light = np.stack([1 + 0.8 * np.cos(2 * np.pi * (x / 11 + y / 17) + k * np.pi / 2) for k in range(4)])
    frames = []
    for k in range(4):
        points = [
            (row, column, 0, bright * light[k, round(row) + shape[0] // 2, round(column) + shape[1] // 2])
            for row, column, _, bright in BEADS
        ]
        frames.append(noisy(cast(points, shape=shape, depths=1), 20 + k))
    return np.asarray(frames, np.float32), light.astype(np.float32)


def frames(count: int, shape: tuple[int, int] = SHAPE, step: float = 0.5) -> Float32Array:
    """A video of three beads, one of which moves ``step`` pixels a frame."""
    made = []
    for n in range(count):
        points = [(y, x + (step * n if k == 0 else 0), 0, light) for k, (y, x, _, light) in enumerate(BEADS)]
        made.append(noisy(cast(points, shape=shape, depths=1), 40 + n))
    return np.asarray(made, np.float32)


def mosaic(shape: tuple[int, int] = SHAPE) -> npt.NDArray[np.uint16]:
    """A raw RGGB frame of the colour photograph."""
    colours = photograph(shape, channels=3)
    raw = colours[..., 1].copy()
    raw[0::2, 0::2], raw[1::2, 1::2] = colours[0::2, 0::2, 0], colours[1::2, 1::2, 2]
    return np.clip(np.round(raw + 100), 0, 65535).astype(np.uint16)


def shown(shape: tuple[int, int]) -> Float64Array:
    """A picture for holograms: smooth shapes and edges between 0 and 1."""
    y, x = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j]
    image = 0.5 + 0.3 * np.sin(7 * x + 3 * y)
    image[(y - 0.6) ** 2 + (x - 0.4) ** 2 < 0.04] = 0.9
    image[(abs(y - 0.3) < 0.1) & (abs(x - 0.7) < 0.2)] = 0.15
    return image
