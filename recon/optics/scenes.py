"""Scenes to photograph: a picture on a screen, beads in a volume, a bar target (flat or tilted)."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from recon.optics.scene import Beads, Layer, Scene

Image = npt.NDArray[np.float32]


def picture(image: npt.ArrayLike, z_um: float, width_um: float, *, name: str = "picture") -> Scene:
    """Show a picture on a screen parallel to the sensor.

    Parameters
    ----------
    image : array_like
        ``(height, width)`` grey or ``(height, width, 3)`` colour, linear brightness, not negative.
    """
    radiance = np.asarray(image, np.float32)
    if radiance.ndim == 2:
        radiance = np.repeat(radiance[:, :, None], 3, axis=2)
    size_um = (width_um * radiance.shape[0] / radiance.shape[1], width_um)
    return Scene(name, layers=(Layer(np.ascontiguousarray(radiance), z_um, size_um),))


def bead_volume(
    count: int,
    extent_um: tuple[float, float],
    z_range_um: tuple[float, float],
    *,
    diameter_um: float = 15.0,
    seed: int = 0,
) -> Scene:
    """Scatter beads in a volume, evenly over the angle of view and in ``1 / z``.

    Parameters
    ----------
    extent_um : tuple of float
        Width and height of the field at the nearest depth; it widens in proportion to depth.
    z_range_um : tuple of float
        Nearest and farthest depth.
    """
    rng = np.random.default_rng(seed)
    near, far = z_range_um
    z = 1 / rng.uniform(1 / far, 1 / near, count)
    across = (rng.random((count, 2)) - 0.5) * np.asarray(extent_um) * (z / near)[:, None]
    powers = np.repeat(rng.uniform(0.4, 1.0, (count, 1)), 3, axis=1)
    return Scene("beads", beads=(Beads(np.column_stack([across, z]), powers, diameter_um),))


def bar_target(pixels: int = 512) -> Image:
    """Draw groups of three horizontal and three vertical bars, each group finer than the one before.

    Returns
    -------
    ndarray, float32, (pixels, pixels)
        1 on the bars, 0 elsewhere. Bars from 1/20 down to 1/170 of the side.
    """
    image = np.zeros((pixels, pixels), np.float32)
    x, y, row_height = 0.05, 0.05, 0.0
    for bar in 0.05 * 2.0 ** (-np.arange(19) / 6):
        length, gap = 5 * bar, bar
        if x + 2 * length + gap > 0.97:
            x, y, row_height = 0.05, y + row_height + 0.03, 0.0
        for k in range(3):
            _fill(image, x + 2 * k * bar, x + (2 * k + 1) * bar, y, y + length)
            left = x + length + gap
            _fill(image, left, left + length, y + 2 * k * bar, y + (2 * k + 1) * bar)
        row_height = max(row_height, length)
        x += 2 * length + 3 * gap
    return image


def tilted_target(
    image: npt.ArrayLike,
    z_um: float,
    width_um: float,
    tilt_deg: float,
    *,
    slices: int = 32,
    name: str = "tilted bar target",
) -> Scene:
    """Tilt a flat grey target about its vertical axis, as a staircase of strips parallel to the sensor.

    Parameters
    ----------
    image : array_like, (height, width)
    z_um : float
        Distance of the target's middle.
    width_um : float
        Width of the target in its own plane.
    tilt_deg : float
        Positive: the right side (larger x) is farther away.
    slices : int
        Strips; choose them so narrow that the step between two is below the camera's axial resolution.
    """
    grey = np.asarray(image, np.float32)
    columns = grey.shape[1]
    tilt = np.deg2rad(tilt_deg)
    pitch = width_um / columns
    height_um = pitch * grey.shape[0]
    borders = np.linspace(0, columns, min(slices, columns) + 1).round().astype(int)
    layers = []
    for first, last in itertools.pairwise(borders.tolist()):
        along = ((first + last) / 2 - columns / 2) * pitch
        radiance = np.repeat(grey[:, first:last, None], 3, axis=2)
        width = (last - first) * pitch * np.cos(tilt)
        place = (float(along * np.cos(tilt)), 0.0)
        layers.append(Layer(radiance, float(z_um + along * np.sin(tilt)), (height_um, float(width)), place))
    return Scene(name, layers=tuple(layers))


def _fill(image: Image, left: float, right: float, top: float, bottom: float) -> None:
    side = image.shape[0]
    rows = slice(round(top * side), round(bottom * side))
    image[rows, round(left * side) : round(right * side)] = 1
