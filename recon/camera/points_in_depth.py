"""Points of light between calibrated depths and between pixels: what they look like through a camera."""

from __future__ import annotations

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.camera.depth_mixture import mixture_at
from recon.camera.grid import Grid, plane_of
from recon.camera.points import FieldFunctions, PointImages

STEPS = 4
"""PSFs that are made a gap between planes; between them patterns are mixed evenly."""
BEYOND = 0.5
"""Planes beyond the first and the last that points may lie at: patterns are scaled from there on."""

KEPT_BYTES = 2**28
"""Of PSFs that were made: further ones take the place of the oldest."""
SHORT = 0.01
"""Part of a plane over which slopes of depth and direction are taken."""


class ImagesInDepth(PointImages):
    """What points look like through one PSF a depth, those between made of both neighbours.

    A place is ``(plane, row, column)``: the plane's number, between planes evenly in ``1 / z``, in which
    patterns grow (Kuo 2020, Eq. 4.7).

    Parameters
    ----------
    z_um : ndarray, (n_z,)
        Depths of the planes, above 0, ascending or descending.
    psfs : ndarray, float32, (n_z, height, width)
    distance_um : float
        From the diffuser to the sensor.
    sensor_shape : (int, int)
    """

    def __init__(
        self,
        z_um: Float64Array,
        psfs: Float32Array,
        distance_um: float,
        sensor_shape: tuple[int, int],
    ) -> None:
        super().__init__(psfs, FieldFunctions(0, np.zeros((1, 2))), sensor_shape)
        self._near = 1 / z_um
        self._order = np.argsort(z_um)
        self._depths = z_um[self._order]
        self._distance_um = distance_um
        self._kept: dict[int, Float32Array] = {}
        self._most_kept = max(KEPT_BYTES // psfs[0].nbytes, 2)

    def depth_um(self, plane: float) -> float:
        """Return the depth of a plane's number."""
        first = int(np.clip(np.floor(plane), 0, len(self._near) - 2))
        share = plane - first
        return float(1 / ((1 - share) * self._near[first] + share * self._near[first + 1]))

    def plane_of(self, z_um: float) -> float:
        """Return the number of a depth's plane."""
        return plane_of(z_um, 1 / self._near)

    def within(self, places: Float64Array) -> Float64Array:
        """Return places, (n, 3), none farther beyond the outermost planes than :data:`BEYOND`."""
        plane = np.clip(places[:, :1], -BEYOND, len(self._near) - 1 + BEYOND)
        return np.hstack([plane, places[:, 1:]])

    def _seen(self, place: Float64Array, slopes: bool) -> tuple[Float32Array, tuple[Float32Array, ...]]:
        at = float(place[0]) * STEPS
        first = int(np.floor(at))
        before, after = self._made(first), self._made(first + 1)
        share = np.float32(at - first)
        psf = np.asarray((1 - share) * before + share * after, np.float32)
        return psf, ((np.asarray(STEPS * (after - before), np.float32),) if slopes else ())

    def _made(self, step: int) -> Float32Array:
        """Return the PSF of a part of a plane, made or kept."""
        if step not in self._kept:
            if len(self._kept) >= self._most_kept:
                del self._kept[next(iter(self._kept))]
            self._kept[step] = self._make(step)
        return self._kept[step]

    def _make(self, step: int) -> Float32Array:
        """Return the PSF of a part of a plane."""
        if step % STEPS == 0 and 0 <= step // STEPS < len(self._near):
            own: Float32Array = self.psfs[step // STEPS]
            return own
        psfs = self.psfs[self._order][:, None]
        mixture = mixture_at(self._depths, psfs, self.depth_um(step / STEPS), self._distance_um)
        made: Float32Array = mixture.of([psfs[k] for k in mixture.members])[0]
        return made


class Rays:
    """From planes, rows and columns of a camera's points to the scene and back."""

    def __init__(self, grid: Grid, camera: ImagesInDepth) -> None:
        self._camera = camera
        self._per_pixel = float(grid.pitch_um[0] / grid.z_um[0])
        axis = np.zeros((len(grid.z_um), 2)) if grid.axis_um is None else grid.axis_um
        self._axis = axis / grid.z_um[:, None]

    def _axis_at(self, plane: float) -> Float64Array:
        """Return the direction ``(x, y) / z`` of a plane's middle: it goes evenly with the pattern."""
        first = int(np.clip(np.floor(plane), 0, len(self._axis) - 2))
        share = plane - first
        return np.asarray((1 - share) * self._axis[first] + share * self._axis[first + 1])

    def place_of(self, place_um: Float64Array) -> Float64Array:
        """Return plane, row and column, these from the axis, of ``(x, y, z)``."""
        plane = self._camera.plane_of(float(place_um[2]))
        column, row = (self._axis_at(plane) - place_um[:2] / place_um[2]) / self._per_pixel
        return np.array([plane, row, column])

    def um_of(self, place: Float64Array) -> Float64Array:
        """Return the inverse of :meth:`place_of`."""
        z_um = self._camera.depth_um(float(place[0]))
        ray = self._axis_at(float(place[0])) - self._per_pixel * place[:0:-1]
        return np.append(ray * z_um, z_um)

    def slopes_of(self, place: Float64Array) -> Float64Array:
        """Return by how much ``(x, y, z)`` change with plane, row and column: (3, 3)."""
        steps = SHORT * np.eye(3)
        return np.stack([self.um_of(place + by) - self.um_of(place - by) for by in steps], axis=1) / (
            2 * SHORT
        )
