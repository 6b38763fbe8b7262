"""Where the source truly stands, told by an axial sweep itself: light and place of its pattern.

Light through the aperture falls off with the square of the distance, so that planes tell how far the source
is beyond where it is recorded, whatever d. The pattern's centroid runs as ``-x d / z`` (Kuo 2020, Eq. 3.1),
which tells how far beside the aperture's middle it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from calibration_routines.psf.psf_quality import MAX_CLIPPED, PsfQuality
from recon.types import Geometry

_LEAST_PLANES = 4
_LEAST_RANGE = 1.2  # of depths, farthest over nearest
_NEAR = 10.0  # apertures: nearer, light falls off otherwise than with the square
_LEAST_ERROR = 0.002  # of a plane's brightness: what dark frames and the sensor's edge leave
_SURE = 5.0  # standard deviations
_TOLERATED = 0.01  # of the nearest distance
_BESIDE_PX = 2.0  # of the centroid's way over the sweep
_OFF_MIDDLE = 0.03  # of a pattern's radius: its light need not be even
_UNEVEN = 0.02  # of a plane's brightness: a step away from the law


@dataclass(frozen=True, slots=True)
class MountFit:
    """The source against its record, um, each with a standard deviation."""

    farther_um: float
    farther_error_um: float
    """How much farther it is than recorded."""
    beside_um: tuple[float, float] | None
    """``(x, y)`` from the axis through the aperture's middle; None where d or the pitch is not known."""
    beside_error_um: float
    uneven: float
    """Largest relative departure of a plane's light from the square law."""
    findings: tuple[str, ...] = ()


def fit_mount(
    planes: Sequence[PsfQuality],
    light: npt.NDArray[np.floating],
    geometry: Geometry,
    brightness_error: float = 0.0,
) -> MountFit | None:
    """Fit where the source of an axial sweep stands; None where too little tells.

    Parameters
    ----------
    planes : sequence of PsfQuality
        The central PSFs, one a depth.
    light : ndarray, (n,)
        All light of each, at one exposure, the source's drift taken out.
    geometry : Geometry
        Of the PSFs' pixels.
    brightness_error : float
        Standard deviation of a PSF's brightness by what flickers, relative.
    """
    kept = [i for i, p in enumerate(planes) if p.radius_px > 0 and p.clipped <= MAX_CLIPPED and light[i] > 0]
    z = np.array([planes[i].z_um for i in kept])
    if len(kept) < _LEAST_PLANES or z.max() < _LEAST_RANGE * z.min():
        return None
    if geometry.aperture_mm is None or z.min() < _NEAR * 1e3 * max(geometry.aperture_mm):
        return None
    logs = np.log(np.asarray(light, np.float64)[kept])
    scale = z.min()

    def off(p: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(logs - p[0] + 2 * np.log(np.maximum(z + scale * p[1], 0.05 * z)))

    start = np.array([float(np.mean(logs + 2 * np.log(z))), 0.0])
    fitted = least_squares(off, start, loss="soft_l1", f_scale=0.01)
    rest = off(fitted.x)
    spread = max(float(np.sqrt((rest**2).sum() / (len(z) - 2))), brightness_error, _LEAST_ERROR)
    jacobian = np.stack([-np.ones_like(z), 2 * scale / (z + scale * fitted.x[1])], axis=1)
    errors = spread * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    farther, error = scale * float(fitted.x[1]), scale * float(errors[1])
    beside, beside_error, way = _beside([planes[i] for i in kept], z + farther, geometry)
    found = []
    if abs(farther) > max(_SURE * error, _TOLERATED * scale):
        found.append(
            "the light falls off with the square of the distance as if the source stood "
            f"{abs(farther) / 1e3:.2f} +- {error / 1e3:.2f} mm {'farther' if farther > 0 else 'nearer'} than "
            "recorded: check the mount, and set the z of [source] offset_um, or the stage's zero."
        )
    uneven = float(np.abs(rest).max())
    if uneven > max(_UNEVEN, _SURE * max(brightness_error, _LEAST_ERROR)):
        worst = z[int(np.argmax(np.abs(rest)))] / 1e3
        found.append(
            f"the light departs from the square law by {uneven:.1%} at z = {worst:.4g} mm: z lost steps "
            "there, the lamp changed, or something stands in the way. Take the sweep again."
        )
    if beside is not None and way > _BESIDE_PX and np.hypot(*beside) > _SURE * beside_error:
        found.append(
            f"the pattern moves with depth as if the source stood x = {beside[0] / 1e3:.2f}, y = "
            f"{beside[1] / 1e3:.2f} mm (+- {beside_error / 1e3:.2f}) beside the axis through the aperture's "
            "middle: centre it, set [source] offset_um, or see whether the rail leans."
        )
    return MountFit(farther, error, beside, beside_error, uneven, tuple(found))


def _beside(
    planes: Sequence[PsfQuality], z: npt.NDArray[np.float64], geometry: Geometry
) -> tuple[tuple[float, float] | None, float, float]:
    """Return the source's place across, its error, and how far that moves the centroid, pixels."""
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    if d_mm is None or pitch_um is None:
        return None, 0.0, 0.0
    px_per_um = 1e3 * d_mm / z / pitch_um
    places = np.array([plane.centroid_px for plane in planes])
    design = np.stack([np.ones_like(z), -px_per_um], axis=1)
    solution, *_ = np.linalg.lstsq(design, places, rcond=None)
    rest = places - design @ solution
    spread = max(float(np.sqrt((rest**2).sum() / (2 * len(z) - 4))), 0.05)
    error = spread * float(np.sqrt(np.linalg.inv(design.T @ design)[1, 1]))
    y_um, x_um = (float(v) for v in solution[1])
    return (x_um, y_um), error, float(np.hypot(x_um, y_um) * np.ptp(px_per_um))


def off_middle(planes: Sequence[PsfQuality], geometry: Geometry) -> str:
    """Return words where the central patterns lie beside the sensor's middle at every depth; else nothing.

    A rail that leans by an angle moves them as a diffuser does that stands ``d`` times the angle beside the
    sensor's middle: which of them it is no sweep tells.
    """
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    kept = [p for p in planes if p.radius_px > 0 and p.clipped <= MAX_CLIPPED]
    if d_mm is None or pitch_um is None or not kept:
        return ""
    z = np.array([p.z_um for p in kept])
    recorded = np.array([(p.y_um, p.x_um) for p in kept])
    off = np.array([p.centroid_px for p in kept]) + recorded * (1e3 * d_mm / z / pitch_um)[:, None]
    one_depth = len(np.unique(z)) < 2
    if not one_depth:  # what goes with 1/z is the source's place
        off = np.linalg.lstsq(np.stack([np.ones_like(z), 1 / z], axis=1), off, rcond=None)[0]
    row, column = (float(v) for v in off[0])
    if np.hypot(row, column) <= max(_BESIDE_PX, _OFF_MIDDLE * kept[0].radius_px):
        return ""
    off_um = float(np.hypot(row, column)) * pitch_um
    lean_mrad = off_um / d_mm
    who = "the diffuser or the source stands" if one_depth else "the diffuser stands"
    return (
        f"Middle: the pattern's light lies {column:+.1f}, {row:+.1f} pixels (x, y) beside the sensor's "
        f"middle: {who} beside it, by {off_um / 1e3:.2f} mm on the sensor, or the rail leans by "
        f"{lean_mrad:.1f} mrad; the sweep cannot tell which. PSFs are right where they were taken."
    )
