"""How PSFs at a depth are made of calibrated ones: of which depths, how much of each, how much larger.

Both refocusing of one PSF (:mod:`recon.camera.refocus`) and of a field (:mod:`recon.camera.refocus_field`)
go by it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.camera.camera_model import members_of_depths
from recon.camera.registration import displacement, moved, register
from recon.camera.spot_flow import met
from recon.camera.transformed import geometric_centre, resampled
from recon.errors import InputError
from recon.types import Calibration

LEAST_LIKENESS = 0.5
"""Scaled neighbours less alike than this are not mixed: the mixture would be a double image."""


def paraxial_scale(z_from_um: float, z_to_um: float, distance_um: float) -> float:
    """Return by how much a pattern grows from one depth to another: ``(1 + d/z_to) / (1 + d/z_from)``."""
    return (1 + distance_um / z_to_um) / (1 + distance_um / z_from_um)


def central_psfs(calibration: Calibration) -> tuple[Float64Array, Float32Array]:
    """Return the calibrated depths, ascending, and of each the PSF nearest to the axis.

    Returns
    -------
    ndarray, (n_z,), and ndarray, float32, (n_z, n_channels, height, width)
    """
    chosen = central_members(calibration)
    depths = calibration.source_positions_um[chosen, 2].astype(np.float64)
    return depths, calibration.psfs[chosen]


def central_places(calibration: Calibration) -> Float64Array:
    """Return ``(x, y)`` of the PSFs that :func:`central_psfs` returns, micrometres: (n_z, 2)."""
    return np.asarray(calibration.source_positions_um[central_members(calibration), :2], np.float64)


def central_members(calibration: Calibration) -> list[int]:
    """Return which PSF of each depth is nearest to the axis, the nearest depth first."""
    positions = calibration.source_positions_um
    if not len(positions):
        raise InputError("The calibration holds no PSF.")
    if not np.isfinite(positions[:, 2]).all() or (positions[:, 2] <= 0).any():
        raise InputError("The depths of the calibration's PSFs are not known, so none can be refocused.")
    off_axis = np.nan_to_num(np.hypot(positions[:, 0], positions[:, 1]))
    # PSFs of one depth may differ a little in z: the stage says where it truly stopped.
    chosen = [members[int(np.argmin(off_axis[members]))] for members in members_of_depths(positions)]
    chosen.sort(key=lambda k: float(positions[k, 2]))
    return chosen


@dataclass(frozen=True)
class Mixture:
    """How PSFs at a depth are made: of which planes, how much of each, how much larger, and where.

    ``offsets`` (row, column) is what is added to a plane's scaled pattern so that it lies on the other's.
    """

    members: tuple[int, ...]
    weights: tuple[float, ...]
    scales: tuple[float, ...]
    dimmed: tuple[float, ...]
    offsets: tuple[tuple[float, float], ...]

    def of(self, psfs: list[Float32Array], points: Any = None, target: Any = (0.0, 0.0)) -> Float32Array:
        """Mix one photograph of each plane: displaced by ``points``, (row, column) each, into ``target``."""
        points = np.zeros((len(psfs), 2)) if points is None else np.asarray(points)
        parts = []
        for psf, scale, dimmed, offset, point in zip(
            psfs, self.scales, self.dimmed, self.offsets, points, strict=True
        ):
            middle, s = geometric_centre(psf), 1 / scale
            start = middle + point - s * (middle + target + np.asarray(offset))
            whole = s == 1 and np.allclose(start, np.round(start), atol=1e-9)
            brought = moved(psf, *-np.round(start)) if whole else resampled(psf, [s, s], start)
            shown = [
                (s * np.arange(n) + first >= 0) & (s * np.arange(n) + first <= n - 1)
                for n, first in zip(psf.shape[-2:], start, strict=True)
            ]
            parts.append((brought * np.float32(dimmed), shown[0][:, None] & shown[1]))
        if len(parts) == 1:
            return parts[0][0]
        (first, in_first), (second, in_second) = parts
        both = met(first, second, self.weights[1], in_first & in_second)
        parts = [(both[0], in_first), (both[1], in_second)]
        mixed = sum(w * psf * seen for w, (psf, seen) in zip(self.weights, parts, strict=True))
        total = sum(w * seen for w, (_, seen) in zip(self.weights, parts, strict=True))
        return np.asarray(mixed / np.where(total > 0, total, 1), np.float32)


def mixture_at(depths: Float64Array, psfs: Float32Array, z_um: float, distance_um: float) -> Mixture:
    """Return what PSFs at ``z_um`` are made of, by the central ones, (n_z, n_channels, height, width)."""
    if not z_um > 0:
        raise InputError(f"The depth to refocus to is above 0, not {z_um:g} um.")

    def of(members: tuple[int, ...], weights: tuple[float, ...]) -> Mixture:
        scales = tuple(paraxial_scale(depths[k], z_um, distance_um) for k in members)
        dimmed = tuple(((distance_um + depths[k]) / (distance_um + z_um)) ** 2 for k in members)
        return Mixture(members, weights, scales, dimmed, ((0.0, 0.0),) * len(members))

    exact = np.flatnonzero(np.abs(depths / z_um - 1) < 1e-9)  # but for rounding
    if exact.size:
        return Mixture((int(exact[0]),), (1.0,), (1.0,), (1.0,), ((0.0, 0.0),))
    above = int(np.searchsorted(depths, z_um))
    if above in (0, len(depths)):
        return of((min(above, len(depths) - 1),), (1.0,))
    near, far = above - 1, above
    share = float((1 / depths[near] - 1 / z_um) / (1 / depths[near] - 1 / depths[far]))
    both = of((near, far), (1 - share, share))
    scaled = [
        replace(both, members=(k,), weights=(1.0,), scales=(s,), dimmed=(b,), offsets=((0.0, 0.0),)).of(
            [psfs[k]]
        )
        for k, s, b in zip((near, far), both.scales, both.dimmed, strict=True)
    ]
    # The stage's line need not pass through the sensor's centre: what is left between the two scaled
    # patterns grows evenly in 1/z, so each goes its share of the way.
    second, first = (psf.mean(axis=0) for psf in scaled[::-1])
    whole = displacement(second, first)
    found = register(second, first, near=whole, within_px=2.0)
    rows, columns = (found.rows, found.columns) if found.reliable else whole
    if likeness(scaled[0], moved(scaled[1], -rows, -columns)) < LEAST_LIKENESS:
        return of((near if share <= 0.5 else far,), (1.0,))
    return replace(
        both, offsets=((share * rows, share * columns), ((share - 1) * rows, (share - 1) * columns))
    )


def likeness(first: Array, second: Array) -> float:
    """Return the inner product of two images of one shape, each divided by its norm."""
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def sensor_distance_um(calibration: Calibration) -> float:
    """Return how far the sensor is from the diffuser; InputError where that is not known."""
    distance_mm = calibration.geometry.diffuser_distance_mm
    if distance_mm is None:
        raise InputError(
            "The calibration does not say how far the sensor is from the diffuser, which refocusing needs: "
            "give diffuser_distance_mm in [geometry] of bench.toml and calibrate again."
        )
    return 1e3 * distance_mm
