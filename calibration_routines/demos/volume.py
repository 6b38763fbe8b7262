"""The demo's second scene: green lights that wind away from the camera, and how well they are placed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import Reconstruction
from recon.arrays import Float32Array, Float64Array
from recon.optics.scene import Beads, Scene
from recon.types import Calibration

TURNS = 2.25
NARROWEST = 0.3
"""Of the spiral's angle of view at the nearest light, that of the farthest."""
DIAMETER_UM = 200.0
REACH_PX = 3
"""How far from its place a light is looked for."""


@dataclass(frozen=True, slots=True)
class Placed:
    """Lights in a volume: where they are, and where they were found.

    Attributes
    ----------
    pixels : ndarray, float64, (n, 2)
        Row and column of each.
    planes, found : ndarray, float64, (n,)
        The plane in which each is, counted from 0 and between two of them as it comes, and the one found:
        the mean over depth of what was reconstructed around its place. NaN where there is nothing.
    seen : ndarray, float32, (n_z, height, width)
        The volume in light that reaches the sensor: a far light is not dimmer for its distance.
    """

    pixels: Float64Array
    planes: Float64Array
    found: Float64Array
    seen: Float32Array

    @property
    def in_plane(self) -> int:
        """How many were found within half a plane."""
        return int(np.count_nonzero(np.abs(self.found - self.planes) <= 0.5))


@dataclass(frozen=True, slots=True)
class Lights:
    """Lights in a spiral through all depths, evenly in 1/z; each sends as much light to the sensor.

    Attributes
    ----------
    count : int
    z_um : tuple of float
        The sweep's planes, ascending.
    tangents : (float, float)
        Of half the angle of view of the nearest, vertically and horizontally.
    """

    count: int
    z_um: tuple[float, ...]
    tangents: tuple[float, float]

    def positions_um(self) -> Float64Array:
        """Return x, y and z of every light, (count, 3), the nearest first."""
        way = np.linspace(0.0, 1.0, self.count)
        z = 1.0 / ((1 - way) / self.z_um[0] + way / self.z_um[-1])
        radius, angle = 1 - (1 - NARROWEST) * way, 2 * np.pi * TURNS * way
        along_y, along_x = self.tangents
        x, y = along_x * radius * np.cos(angle) * z, along_y * radius * np.sin(angle) * z
        return np.stack([x, y, z], axis=1)

    def scene(self) -> Scene:
        """Return them as a scene."""
        places = self.positions_um()
        powers = np.zeros((self.count, 3))
        powers[:, 1] = (places[:, 2] / self.z_um[-1]) ** 2
        return Scene("lights that wind away", beads=(Beads(places, powers, DIAMETER_UM),))

    def placed(self, volume: Reconstruction, calibration: Calibration) -> Placed:
        """Hold a reconstruction from a calibration's planes against the lights' places."""
        light = calibration.psfs.sum(axis=(1, 2, 3))
        seen = np.asarray(volume.volume * (light / light.mean())[:, None, None], np.float32)
        geometry, grid = calibration.geometry, volume.grid
        if geometry.diffuser_distance_mm is None or grid.sensor_pitch_um is None:
            raise ValueError("The demo's bench knows its pixel pitch and the distance d.")
        places = self.positions_um()
        on_sensor = places[:, 1::-1] / places[:, 2:] * (1e3 * geometry.diffuser_distance_mm)
        pixels = np.asarray(grid.centre) - on_sensor / grid.sensor_pitch_um
        planes = np.interp(-1 / places[:, 2], -1 / grid.z_um, np.arange(len(grid.z_um)))
        found = np.array([_mean_plane(seen, row, column) for row, column in pixels])
        return Placed(pixels, planes, found, seen)


def _mean_plane(seen: Float32Array, row: float, column: float) -> float:
    rows, columns = (
        slice(max(0, round(at) - REACH_PX), round(at) + REACH_PX + 1) for at in (float(row), float(column))
    )
    light = seen[:, rows, columns].sum(axis=(1, 2), dtype=np.float64)
    total = float(light.sum())
    return float(light @ np.arange(len(light))) / total if total > 0 else float("nan")
