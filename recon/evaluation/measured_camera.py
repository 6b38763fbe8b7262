"""A lensless camera whose PSFs were measured: what a simulated one lacks, caustics, halo and veil, it has.

A point at any continuous place is rendered with the PSF as it was photographed, on pixels several times finer
than the sensor's, which are then summed: a reconstruction's pixels, its window and its PSFs, which are
photographed anew through this camera, with noise, are not what made the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.base import fft
from recon.base.blocks import block_sum
from recon.camera.transformed import Transformation, transformed
from recon.errors import InputError
from recon.evaluation.lenslets import DISTANCE, PITCH_UM
from recon.evaluation.measured_sets import MeasuredSet, measured_set

Points = Float64Array

SUBPIXELS = 6
"""Fine pixels along each side of the sensor's, at most."""
RINGS = 4
"""Tangents of incidence, from the axis to the farthest point, at which a PSF that changes is made."""


AS_IT_WAS = Transformation()


@dataclass(frozen=True)
class MeasuredCamera:
    """Diffuser and sensor of a measured set: what a ``LensletCamera`` is of lenslets."""

    shape: tuple[int, int]
    """``(height, width)`` of the sensor in pixels; pixel ``(height // 2, width // 2)`` lies on the axis."""
    pitch_um: float
    distance_um: float
    psfs: Float32Array
    """(n_z, fine height, fine width): the nearest first; the middle one has a light of 1."""
    inverse_depths: tuple[float, float]
    """1/z of the nearest and the farthest PSF, per micrometre; those between are even in 1/z."""
    fall_off_deg: float = np.inf
    """Standard deviation of the Gaussian angular response; infinite for none."""
    aberration: float = 0.0
    """Relative growth of the pattern with the squared tangent of the angle of incidence."""
    dispersion: float = 0.0
    """Relative growth of the pattern from green to blue, and its negative to red."""
    drift: Transformation = AS_IT_WAS
    """Where the pattern went, in pixels of the sensor."""

    @property
    def subpixels(self) -> int:
        """Fine pixels along each side of the sensor's."""
        return int(self.psfs.shape[1] // self.shape[0])

    def light(self, points: npt.ArrayLike, channel: int = 1) -> Float32Array:
        """Return the light of points ``(x, y, z, power)``, (n, 4), micrometres, on the sensor.

        ``channel`` is 0 for red, 1 for green, 2 for blue.
        """
        x, y, z, power = np.asarray(points, np.float64).reshape(-1, 4).T
        oblique = (x**2 + y**2) / z**2
        seen = power * np.exp(-0.5 * (np.arctan(np.sqrt(oblique)) / np.deg2rad(self.fall_off_deg)) ** 2)
        near, far = self.inverse_depths
        place = np.zeros(len(z)) if near == far else (near - 1 / z) / (near - far) * (len(self.psfs) - 1)
        plane = np.clip(np.round(place).astype(int), 0, len(self.psfs) - 1)
        to_fine = -self.distance_um / z / self.pitch_um * self.subpixels
        where = np.column_stack([y * to_fine, x * to_fine])
        shape: tuple[int, int] = self.psfs.shape[1:]
        sizes = tuple(fft.fast_length(2 * n) for n in shape)
        total = np.zeros((sizes[0], sizes[1] // 2 + 1), np.complex128)
        growths = self._growths(oblique)
        for p in np.unique(plane):
            for growth, share in growths:
                chosen = (plane == p) & (share > 0)
                if chosen.any():
                    psf = self._psf(int(p), growth * (1 + self.dispersion * (channel - 1)))
                    lights = _on_offsets(sizes, shape, where[chosen], (seen * share)[chosen])
                    total += np.fft.rfft2(lights) * np.fft.rfft2(psf, sizes)
        fine = np.fft.irfft2(total, sizes)[: shape[0], : shape[1]]
        return np.maximum(block_sum(fine, self.subpixels), 0)

    def moved(
        self, shift_px: tuple[float, float] = (0.0, 0.0), scale: float = 1.0, rotation_deg: float = 0.0
    ) -> MeasuredCamera:
        """Return the camera with its diffuser shifted (sensor pixels: rows, columns), swollen and turned."""
        return replace(self, drift=Transformation(*shift_px, scale, rotation_deg))

    def _growths(self, oblique: Points) -> list[tuple[float, Points]]:
        """Return sizes of the pattern, and every point's share in each: linear in the squared tangent."""
        most = float(oblique.max(initial=0.0))
        if not self.aberration or not most:
            return [(1.0, np.ones(len(oblique)))]
        at = oblique / most * (RINGS - 1)
        shares = [np.maximum(1 - np.abs(at - k), 0) for k in range(RINGS)]
        return [(1 + self.aberration * most * k / (RINGS - 1), share) for k, share in enumerate(shares)]

    def _psf(self, plane: int, growth: float) -> Float32Array:
        drift, k = self.drift, self.subpixels
        how = Transformation(drift.rows * k, drift.columns * k, drift.scale * growth, drift.rotation_deg)
        psf = self.psfs[plane]
        return psf if how == AS_IT_WAS else transformed(psf, how)


def measured_camera(
    shape: tuple[int, int],
    of: MeasuredSet,
    depths: tuple[float, float],
    *,
    plane: float | None,
    fall_off_deg: float = np.inf,
    aberration: float = 0.0,
    dispersion: float = 0.0,
) -> MeasuredCamera:
    """Return the camera of a measured set, its sensor cut and binned to a shape.

    Parameters
    ----------
    shape : (int, int)
        Pixels of the sensor: as many binned ones of the measured as fit, in the middle.
    of : str
        The set: ``"hand"`` (one depth) or ``"usaf"`` (44).
    depths : (float, float)
        Depths of the nearest and the farthest measured PSF, relative to the distance of diffuser and sensor.
    plane : float or None
        For scenes in one plane: which of the measured depths, from 0 to below 1; it stands for all.
    fall_off_deg, aberration, dispersion : float
        Of :class:`MeasuredCamera`.

    Raises InputError when the set is not there, too small, or has one depth where several are asked for.
    """
    psfs = _fine_psfs(of, shape)
    if plane is None and len(psfs) == 1:
        raise InputError(f"The measured set {of} has one depth: choose a picture, or the set usaf.")
    if plane is not None:
        psfs = psfs[int(plane * len(psfs))][None]
    distance_um = DISTANCE * max(shape) * PITCH_UM
    near, far = (1 / (depth * distance_um) for depth in depths)
    light = np.float32(psfs[len(psfs) // 2].sum(dtype=np.float64))
    return MeasuredCamera(
        shape,
        PITCH_UM,
        distance_um,
        psfs / light,
        (near, far),
        fall_off_deg,
        aberration,
        dispersion,
    )


@lru_cache(maxsize=4)
def smooth_light(of: MeasuredSet, shape: tuple[int, int]) -> Points:
    """Return a set's photograph, smoothed over an eighth of its sides, on a sensor of a shape, counts."""
    from scipy import ndimage

    photograph = measured_set(of)[1]
    coarse = block_sum(photograph, min(photograph.shape) // 50)
    smooth = ndimage.gaussian_filter(coarse, [n / 8 for n in coarse.shape], mode="nearest")
    steps = [(np.arange(n) + 0.5) * m / n - 0.5 for n, m in zip(shape, smooth.shape, strict=True)]
    return np.asarray(
        ndimage.map_coordinates(smooth, np.meshgrid(*steps, indexing="ij"), order=1), np.float64
    )


@lru_cache(maxsize=4)
def _fine_psfs(of: MeasuredSet, shape: tuple[int, int]) -> Float32Array:
    """Return a set's PSFs cut to a sensor's shape, on as many finer pixels as there are, 6 at most."""
    psfs, _ = measured_set(of)
    height, width = psfs.shape[1:]
    fits = min(height // shape[0], width // shape[1])
    if fits < 1:
        raise InputError(f"The measured set {of} has {height} x {width} pixels: no room for {shape}.")
    binning = -(-fits // SUBPIXELS)
    rows, columns = (n * (fits // binning) * binning for n in shape)
    top, left = (height - rows) // 2, (width - columns) // 2
    return block_sum(psfs[:, top : top + rows, left : left + columns], binning)


def _on_offsets(sizes: tuple[int, ...], shape: tuple[int, int], where: Points, light: Points) -> Points:
    """Return points on a cyclic grid of offsets from the axis, in the nearest four; far ones are lost."""
    grid = np.zeros(sizes)
    corner = np.floor(where).astype(int)
    part = where - corner
    inside = (np.abs(where) < np.array(shape) - 1).all(axis=1)
    for far in np.ndindex(2, 2):
        share = light * np.prod(np.where(far, part, 1 - part), axis=1)
        cells = (corner + far)[inside] % sizes
        np.add.at(grid, tuple(cells.T), share[inside])
    return grid
