"""A lensless camera in closed form: every facet of its diffuser casts one Gaussian spot.

A point at any continuous place is rendered spot by spot, so that measurements are not made with a
reconstruction's model: no voxel grid, no convolution, no FFT. A facet is a lenslet that focuses, or a patch
of a smooth diffuser that only deflects. The straight ray from a source at ``(x, y, z)`` through a facet at
``u`` has the tangent ``t = (u - x) / z`` and meets the sensor at ``u + (t + tilt) d`` (Kuo 2020, Eqs. 3.1 and
3.2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.arrays import Float32Array, Float64Array

Optics = Literal["random", "regular", "smooth"]

SPOT_PX = 0.7
"""Deviation of spots in best focus: about what a pixel and diffraction leave of a point."""
LENSLETS, PATCHES = 49, 784
"""Facets over the aperture: lenslets as on the dissertation's diffusers, patches of a smooth one to sample
its caustics."""
APERTURE = 0.66
"""Side of the aperture relative to the sensor's."""
PITCH_UM = 20.0
DISTANCE = 0.9
"""Pixel pitch, and the diffuser's distance from the sensor relative to the sensor's longer side."""


@njit(nogil=True, cache=True)
def stamp(image, y, x, sigma, light):  # type: ignore[no-untyped-def]
    """Add a Gaussian spot of unit sum times ``light``, centred at a continuous ``(row, column)``."""
    reach = int(4 * sigma) + 1
    iy, ix = int(np.floor(y)), int(np.floor(x))
    along_y, along_x = np.empty(2 * reach + 1), np.empty(2 * reach + 1)
    for k in range(2 * reach + 1):
        along_y[k] = np.exp(-((iy - reach + k - y) ** 2) / (2 * sigma**2))
        along_x[k] = np.exp(-((ix - reach + k - x) ** 2) / (2 * sigma**2))
    share = light / (along_y.sum() * along_x.sum())
    for j in range(max(iy - reach, 0), min(iy + reach + 1, image.shape[0])):
        for i in range(max(ix - reach, 0), min(ix + reach + 1, image.shape[1])):
            image[j, i] += share * along_y[j - iy + reach] * along_x[i - ix + reach]


@njit(nogil=True, cache=True)
def _cast(image, points, facets, optics):  # type: ignore[no-untyped-def]
    pitch, distance, width, power, aberration, fall_off, spot = optics
    height, columns = image.shape
    for p in range(points.shape[0]):
        x, y, z, light = points[p]
        for k in range(facets.shape[0]):
            t_y, t_x = (facets[k, 0] - y) / z, (facets[k, 1] - x) / z
            out_y, out_x = t_y + facets[k, 2], t_x + facets[k, 3]
            row = height // 2 + (facets[k, 0] + out_y * distance) / pitch
            column = columns // 2 + (facets[k, 1] + out_x * distance) / pitch
            oblique = t_y * t_y + t_x * t_x
            focus = power * (1 + aberration * oblique)
            # A uniform disc of diameter D has a deviation of D / 4 along each axis.
            blur = width / 4 * abs(1 - distance * (focus - 1 / z)) / pitch
            sigma = np.sqrt(spot**2 + blur**2)
            reach = int(4 * sigma) + 1
            if not (-reach < row < height + reach and -reach < column < columns + reach):
                continue
            angle = np.arctan(np.sqrt(out_y**2 + out_x**2))
            seen = np.exp(-0.5 * (angle / fall_off) ** 2)
            stamp(image, row, column, sigma, light * facets[k, 4] * seen / (z * z * (1 + oblique) ** 1.5))


@dataclass(frozen=True)
class LensletCamera:
    """Diffuser and sensor."""

    shape: tuple[int, int]
    """``(height, width)`` of the sensor in pixels; pixel ``(height // 2, width // 2)`` lies on the axis."""
    pitch_um: float
    distance_um: float
    """``pitch_um`` and ``distance_um``: of the pixels, and from the diffuser to the sensor."""
    facets: Float64Array
    """(n, 5): ``y, x`` in the diffuser's plane (micrometres), deflection in tangents along y and x,
    transmitted share of the light."""
    facet_um: float
    """Diameter of a lenslet; 0 for facets that only deflect."""
    focus_um: float
    """Depth whose image is sharpest."""
    aberration: float = 0.0
    """Relative increase of a lenslet's power with the squared tangent of the angle of incidence."""
    fall_off_deg: float = np.inf
    """Standard deviation of the pixels' Gaussian angular response; infinite for none (Kuo 2020, Eq. 5.1)."""
    dispersion: float = 0.0
    """Relative change of power and deflection from green to blue, and its negative to red."""
    spot_px: float = SPOT_PX
    """Deviation of spots in best focus."""

    def light(self, points: npt.ArrayLike, channel: int = 1) -> Float32Array:
        """Return the light of points ``(x, y, z, power)``, (n, 4), micrometres, on the sensor.

        A point of power 1 at the depth of focus on the axis sends a light of about 1 through the aperture.
        ``channel`` is 0 for red, 1 for green, 2 for blue.
        """
        image = np.zeros(self.shape, np.float64)
        strength = 1 + self.dispersion * (channel - 1)
        facets = self.facets * np.array([1, 1, strength, strength, 1])
        facets[:, 4] *= self.focus_um**2
        power = strength * (1 / self.distance_um + 1 / self.focus_um)
        lengths_um = (self.pitch_um, self.distance_um, self.facet_um)
        optics = (*lengths_um, power, self.aberration, np.deg2rad(self.fall_off_deg), self.spot_px)
        places = np.ascontiguousarray(points, np.float64).reshape(-1, 4)
        _cast(image, places, facets, tuple(map(float, optics)))
        return image.astype(np.float32)

    def moved(
        self, shift_px: tuple[float, float] = (0.0, 0.0), scale: float = 1.0, rotation_deg: float = 0.0
    ) -> LensletCamera:
        """Return the camera with its diffuser shifted (sensor pixels: rows, columns), swollen and turned."""
        turn = np.deg2rad(rotation_deg)
        matrix = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        facets = self.facets.copy()
        facets[:, :2] = facets[:, :2] @ matrix.T + np.asarray(shift_px) * self.pitch_um
        facets[:, 2:4] = facets[:, 2:4] @ (matrix.T / scale)
        return replace(self, facets=facets)


def build_camera(
    size: int | tuple[int, int],
    *,
    optics: Optics = "random",
    seed: int = 0,
    focus: float = 6.0,
    **imperfections: float,
) -> LensletCamera:
    """Build a camera whose proportions do not depend on its number of pixels.

    Parameters
    ----------
    size : int or (int, int)
        Pixels of the sensor.
    optics : str
        ``"random"`` or ``"regular"`` lenslets, or a ``"smooth"`` diffuser.
    focus : float
        Depth of best focus, relative to the distance of diffuser and sensor.
    **imperfections
        ``aberration``, ``fall_off_deg``, ``dispersion``, ``spot_px`` of :class:`LensletCamera`.
    """
    shape = (size, size) if isinstance(size, int) else size
    rng = np.random.default_rng(seed)
    distance_um = DISTANCE * max(shape) * PITCH_UM
    extent = APERTURE * np.asarray(shape) * PITCH_UM
    count = PATCHES if optics == "smooth" else LENSLETS
    side = round(np.sqrt(count))
    lattice = (np.arange(side) + 0.5) / side - 0.5
    places = np.stack(np.meshgrid(lattice, lattice, indexing="ij"), axis=-1).reshape(-1, 2)
    tilts, light = np.zeros((count, 2)), np.ones(count)
    if optics == "random":
        # One lenslet a cell of the lattice, anywhere in it: random, without large gaps.
        places = places + rng.uniform(-0.5, 0.5, places.shape) / side
        light = rng.uniform(0.6, 1.4, count)
    elif optics == "smooth":
        tilts = _smooth_tilts(rng, side) * 0.035 / DISTANCE
    facets = np.column_stack([places * extent, tilts, light / count])
    lens = 0.0 if optics == "smooth" else float(extent.mean()) / side
    return LensletCamera(
        shape=shape,
        pitch_um=PITCH_UM,
        distance_um=distance_um,
        facets=facets,
        facet_um=lens,
        focus_um=focus * distance_um,
        **imperfections,
    )


def _smooth_tilts(rng: np.random.Generator, side: int) -> Float64Array:
    """Gradient of a smooth random surface on a lattice, (side * side, 2), of unit root mean square."""
    from scipy.ndimage import gaussian_filter

    surface = gaussian_filter(rng.standard_normal((side, side)), side / 16, mode="wrap")
    slopes = np.stack(np.gradient(surface), axis=-1).reshape(-1, 2)
    return np.asarray(slopes / np.sqrt(np.mean(slopes**2)), np.float64)
