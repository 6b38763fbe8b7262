"""What a screen shows for a calibration, and where the camera sees each of its pixels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean

Levels = npt.NDArray[np.uint8]
Light = Float32Array

LIT_CELLS = 0.2
LEAST_MARKS = 6
"""Of which a projective map is told from: four determine it, two more tell whether it is one."""
_OUTLIER_PX = 1.5
_MOST_FINE = 4  # cells along a sensor pixel that the screen's pixels are averaged over
_GAMMA = 2.2  # about any screen's; only for levels that spread evenly in light


@dataclass(frozen=True)
class ScreenMap:
    """Where the camera sees a screen's pixels: a projective map of one plane onto the other.

    Rows and columns of the sensor are those of a picture on its grid: the place in it that a point of the
    screen belongs to, upside down as in :mod:`recon.types`.
    """

    matrix: tuple[tuple[float, ...], ...]
    """(3, 3): from (column, row, 1) on the screen to the same on the sensor, up to a factor."""
    marks: int
    """It was told from."""
    misfit_px: float
    """Root mean square distance of the marks from it."""

    @classmethod
    def of_marks(cls, screen: Float64Array, sensor: Float64Array) -> ScreenMap | None:
        """Fit marks' places (n, 2), each (row, column); marks far from the fit are left out.

        None where fewer than :data:`LEAST_MARKS` agree on a map.
        """
        if len(screen) < LEAST_MARKS:
            return None
        first, second = screen[:, ::-1], sensor[:, ::-1]
        matrix, kept = cv2.findHomography(first, second, cv2.RANSAC, _OUTLIER_PX)
        if matrix is None or (count := int(kept.sum())) < LEAST_MARKS:
            return None
        inside = kept.ravel() > 0
        matrix, _ = cv2.findHomography(first[inside], second[inside])
        found = cls(tuple(tuple(map(float, row)) for row in matrix), count, 0.0)
        off = found.on_sensor(screen[inside]) - sensor[inside]
        return cls(found.matrix, count, float(np.sqrt((off**2).sum(axis=1).mean())))

    def on_sensor(self, places: Float64Array) -> Float64Array:
        """Return where places on the screen are seen, (..., 2) rows and columns both."""
        return _mapped(np.array(self.matrix), places)

    def on_screen(self, places: Float64Array) -> Float64Array:
        """Return which places of the screen are seen at places of the sensor, likewise."""
        return _mapped(np.linalg.inv(np.array(self.matrix)), places)

    def scale(self, shape: tuple[int, int]) -> float:
        """Return sensor pixels a screen pixel about the middle of a sensor of a shape."""
        middle = self.on_screen(np.array(shape) / 2)
        around = self.on_sensor(middle + np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]]))
        return float(np.sqrt(abs(np.linalg.det(around[1:] - around[0]))))

    def drawn(
        self, picture: Levels, corner: tuple[float, float], cell: float, shape: tuple[int, int]
    ) -> Levels:
        """Return the screen's levels that show a picture so that the camera sees it upright on its grid.

        Parameters
        ----------
        picture : ndarray, uint8, (rows, columns)
        corner : (float, float)
            Row and column on the sensor of the picture's first corner; a pixel's middle is at whole numbers.
        cell : float
            Sensor pixels that one of its pixels is wide.
        shape : (int, int)
            Of the screen; black where the picture is not.
        """
        (top, left), back = corner, 1 / cell
        to_cells = np.array([[back, 0, -left * back - 0.5], [0, back, -top * back - 0.5], [0, 0, 1]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        shown = cv2.warpPerspective(picture, to_cells @ np.array(self.matrix), shape[::-1], flags=flags)
        return np.asarray(shown, np.uint8)

    def seen(self, light: Light, shape: tuple[int, int], binning: int = 1) -> Light:
        """Return the screen's light, float32, on a sensor's pixels of a shape: its mean over each, binned."""
        finer = int(np.clip(np.ceil(2 / self.scale(shape)), 1, _MOST_FINE))
        # Pixel p's middle is fine pixel (p + 0.5) * finer - 0.5.
        refined = np.array([[finer, 0, (finer - 1) / 2], [0, finer, (finer - 1) / 2], [0, 0, 1.0]])
        matrix = refined @ np.array(self.matrix)
        size = (shape[1] * finer, shape[0] * finer)
        fine = cv2.warpPerspective(np.asarray(light, np.float32), matrix, size, flags=cv2.INTER_NEAREST)
        return np.asarray(block_mean(fine, finer * binning), np.float32)


def _mapped(matrix: Float64Array, places: Float64Array) -> Float64Array:
    flat = np.asarray(places, np.float64).reshape(-1, 2)[:, ::-1]
    mapped = np.column_stack([flat, np.ones(len(flat))]) @ matrix.T
    found: Float64Array = (mapped[:, :2] / mapped[:, 2:])[:, ::-1].reshape(np.shape(places))
    return found


def random_cells(shape: tuple[int, int], seed: int) -> Levels:
    """Return cells of which a fifth is white, the rest black, at random.

    All details are alike in such pictures, so that least squares tell the finest of a PSF as soon as the
    coarsest; few lit cells give the most contrast for their light
    (docs/decisions/0066-calibrate-by-a-screen.md).
    """
    return np.where(np.random.default_rng(seed).random(shape) < LIT_CELLS, 255, 0).astype(np.uint8)


def dead_leaves(shape: tuple[int, int], seed: int) -> Levels:
    """Return shapes of all sizes that hide each other, as in photographs, of any brightness.

    Their sizes' density falls with the third power, which makes a picture look alike at every scale and its
    spectrum fall as that of natural pictures does (Lee, Mumford and Huang 2001).
    """
    rng = np.random.default_rng(seed)
    smallest, largest = 1.0, max(shape) / 3
    picture = np.zeros(shape, np.uint8)
    for _ in range(picture.size // 4):
        u = rng.random()
        size = 1 / np.sqrt((1 - u) / smallest**2 + u / largest**2)
        center = rng.random(2) * shape[::-1]
        level = round(255 * rng.random() ** (1 / _GAMMA))
        angle, squeeze = rng.uniform(0, 180), rng.uniform(0.4, 1)
        box = (tuple(map(float, center)), (float(2 * size), float(2 * size * squeeze)), float(angle))
        if rng.random() < 0.5:
            cv2.ellipse(picture, box, level, -1)
        else:
            cv2.fillPoly(picture, [cv2.boxPoints(box).round().astype(np.int32)], level)
    return picture


def bars(shape: tuple[int, int], count: int, axis: int) -> list[Levels]:
    """Return pictures of a white bar each, which together fill the screen along an axis."""
    borders = np.linspace(0, shape[axis], count + 1).round().astype(int)
    pictures = []
    for first, last in itertools.pairwise(borders):
        levels = np.zeros(shape, np.uint8)
        np.moveaxis(levels, axis, 0)[first:last] = 255
        pictures.append(levels)
    return pictures


def field_along(light: Float64Array, side: int) -> tuple[float, float]:
    """Return where along a side of the screen the camera sees it: where a bar gives half the most light.

    ``light`` is what each of :func:`bars` gave, in order.
    """
    middles = (np.arange(len(light)) + 0.5) * side / len(light)
    half = light.max() / 2
    seen = np.flatnonzero(light >= half)
    first, last = int(seen[0]), int(seen[-1])
    low = 0.0 if first == 0 else np.interp(half, light[first - 1 : first + 1], middles[first - 1 : first + 1])
    if last == len(light) - 1:
        return float(low), float(side)
    return float(low), float(np.interp(-half, -light[last : last + 2], middles[last : last + 2]))


@dataclass(frozen=True)
class ScreenTone:
    """Light of a screen's levels, relative to white, less black's."""

    levels: tuple[int, ...]
    light: tuple[float, ...]
    """At these levels, ascending from 0 to 1."""

    @classmethod
    def of(cls, levels: Sequence[int], light: Sequence[float]) -> ScreenTone:
        """Take measured light above black's at ascending levels, the last 255.

        Raises ValueError when it does not rise.
        """
        relative = np.array([0.0, *light]) / max(light[-1], 1e-12)
        if light[-1] <= 0 or (np.diff(relative) <= 0).any():
            raise ValueError("light does not rise with the level")
        return cls((0, *levels), tuple(map(float, relative)))

    @property
    def gamma(self) -> float:
        """Exponent that comes nearest, light as its weight."""
        x, y = np.log(np.array(self.levels[1:]) / 255), np.log(self.light[1:])
        return float(
            (np.array(self.light[1:]) * x * y).sum() / max((np.array(self.light[1:]) * x * x).sum(), 1e-12)
        )

    def of_picture(self, levels: Levels) -> Light:
        """Return a picture's light, float32."""
        from scipy.interpolate import PchipInterpolator

        x = np.array(self.levels) / 255
        # Interpolated where it is nearly straight: as a power law's ratio.
        bent = np.array([1.0, *np.array(self.light[1:]) / x[1:] ** self.gamma])
        bent[0] = bent[1]
        table = PchipInterpolator(x, bent)(np.arange(256) / 255) * (np.arange(256) / 255) ** self.gamma
        return np.asarray(table, np.float32)[levels]
