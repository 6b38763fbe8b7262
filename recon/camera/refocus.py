"""Digital refocus: a PSF brought to another depth by paraxial scaling (Kuo 2020, secs. 3.1 and 5.2).

A ray from a source at ``(x, z)`` straight through the diffuser at ``u`` meets the sensor at ``(1 + d/z) u -
(d/z) x``. From depth ``z_i`` to ``z`` the pattern therefore scales by ``(1 + d/z) / (1 + d/z_i)``, which is
``1 / s_i`` of Eq. 5.2. What scaling does not describe is the light's displacement by the diffuser, ``alpha
d``, which stays as it is where the scaled PSF has it scaled: the error grows as ``alpha d (1 - s)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.camera_model import members_of_depths
from recon.camera.registration import displacement, moved, rescaled
from recon.errors import InputError
from recon.types import Calibration

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

SAME_DEPTH = 1e-4
"""Difference of scale below which a calibrated PSF serves as it is: a twentieth of a pixel at the edge of a
pattern 1000 pixels wide."""
LEAST_LIKENESS = 0.5
"""Scaled neighbours less alike than this are not mixed: the mixture would be a double image."""
TYPICAL_DEFLECTION_DEG = 0.25
"""Half width of the deflection of the dissertation's 0.5 degree diffuser (A.2), where nothing is known."""


@dataclass(frozen=True, slots=True)
class Refocused:
    """A PSF at a depth that was not calibrated.

    Attributes
    ----------
    psf : ndarray, float32, (n_channels, height, width)
        In the calibration's counts: the brightness falls as ``1 / (d + z)^2``.
    z_um : float
    from_z_um : tuple of float
        Depths of the calibrated PSFs it was made of: one, or the neighbours on both sides.
    scales : tuple of float
        By how much each was enlarged.
    displacement_error_um : float
        Expected error of the light's place on the sensor, from the diffuser's deflection: the weighted mean
        of ``deflection * d * |1 - s|``.
    expected_similarity : float or None
        Expected inner product with a PSF measured there: from the nearest calibrated PSFs, each predicted
        from its own neighbours, scaled to this distance. None with fewer than three depths.
    """

    psf: Floats
    z_um: float
    from_z_um: tuple[float, ...]
    scales: tuple[float, ...]
    displacement_error_um: float
    expected_similarity: float | None
    source_um: tuple[float, float] = (0.0, 0.0)
    """``(x, y)`` of the PSFs it was made of: those nearest to the axis."""
    calibrated_um: tuple[float, float] = (0.0, float("inf"))
    """Nearest and farthest calibrated depth."""

    @property
    def extrapolated(self) -> bool:
        """Whether the depth lies outside the calibrated ones, by more than a stage's repeatability."""
        near, far = self.calibrated_um
        return not (1 - SAME_DEPTH) * near <= self.z_um <= (1 + SAME_DEPTH) * far

    def __str__(self) -> str:
        """Say it in words."""
        sources = " and ".join(f"{z / 1e3:g}" for z in self.from_z_um)
        how = "mixed from the PSFs" if len(self.from_z_um) > 1 else "scaled from the PSF"
        error = f"light up to {self.displacement_error_um:.1f} um off on the sensor"
        if self.expected_similarity is not None:
            error += f", expected similarity {self.expected_similarity:.3f}"
        x_mm, y_mm = (1e-3 * v for v in self.source_um)
        place = f" (x = {x_mm:.4g}, y = {y_mm:.4g} mm)" if x_mm or y_mm else ""
        return f"{how} at {sources} mm{place} (Kuo 2020, Eq. 5.2): {error}"


def paraxial_scale(z_from_um: float, z_to_um: float, distance_um: float) -> float:
    """Return by how much a pattern grows from one depth to another: ``(1 + d/z_to) / (1 + d/z_from)``."""
    return (1 + distance_um / z_to_um) / (1 + distance_um / z_from_um)


def refocus_psf(psf: Array, z_from_um: float, z_to_um: float, distance_um: float) -> Floats:
    """Bring an on-axis PSF (..., height, width) from one depth to another (Eq. 5.2).

    Scaled about the sensor's centre, which lies on the axis (see :mod:`recon.types`); brightness on a pixel
    goes as ``1 / (d + z)^2``.
    """
    if not (z_from_um > 0 and z_to_um > 0 and distance_um > 0):
        raise InputError(
            f"Depths and the diffuser's distance are positive, not {z_from_um:g}, {z_to_um:g} and "
            f"{distance_um:g} um."
        )
    s = 1 / paraxial_scale(z_from_um, z_to_um, distance_um)
    brightness = ((distance_um + z_from_um) / (distance_um + z_to_um)) ** 2
    return rescaled(psf, s) * np.float32(brightness)


def refocus(
    calibration: Calibration, z_um: float, *, deflection_deg: float = TYPICAL_DEFLECTION_DEG
) -> Refocused:
    """Return the PSF at a depth that need not have been calibrated.

    The central PSFs of the calibrated depths on both sides are scaled to ``z_um``, registered to each other,
    and mixed by distance in 1/z (sec. 5.2); outside the calibrated range, or where the neighbours are too
    unlike to be mixed, the nearest one is scaled.

    Parameters
    ----------
    calibration : Calibration
        With depths, and ``geometry.diffuser_distance_mm``.
    z_um : float
    deflection_deg : float
        Typical angle by which the diffuser bends light (its half width at half maximum), for the error.

    Raises InputError when depths or the distance from diffuser to sensor are unknown.
    """
    depths, psfs = central_psfs(calibration)
    distance_um = _distance_um(calibration)
    if not 0 < z_um < np.inf:
        raise InputError(f"The depth to refocus to is above 0, not {z_um:g} um.")
    psf, members, weights = _mixed(depths, psfs, z_um, distance_um)
    scales = tuple(paraxial_scale(depths[k], z_um, distance_um) for k in members)
    bend_um = np.deg2rad(deflection_deg) * distance_um
    error = sum(w * bend_um * abs(1 - 1 / s) for w, s in zip(weights, scales, strict=True))
    if max(abs(s - 1) for s in scales) < SAME_DEPTH:
        likeness: float | None = 1.0
    else:
        likeness = _expected_similarity(depths, psfs, z_um, members, distance_um)
    x_um, y_um = central_places(calibration)[members[int(np.argmax(weights))]]
    return Refocused(
        psf,
        float(z_um),
        tuple(float(depths[k]) for k in members),
        scales,
        float(error),
        likeness,
        (float(x_um), float(y_um)),
        (float(depths[0]), float(depths[-1])),
    )


def at_depth(calibration: Calibration, z_um: float) -> tuple[Calibration, Refocused | None]:
    """Return a calibration of one PSF at ``z_um``, and how it was made (None where it was calibrated).

    Where the calibration has the depth (to :data:`SAME_DEPTH` of the pattern's scale), its PSFs are returned
    as they are. Raises as :func:`refocus`.
    """
    distance_um = _distance_um(calibration)
    z, _ = central_psfs(calibration)
    same = np.array([abs(paraxial_scale(v, z_um, distance_um) - 1) < SAME_DEPTH for v in z])
    if same.any():
        return calibration, None
    made = refocus(calibration, z_um)
    provenance = {**calibration.provenance, "refocused_to_um": z_um, "refocused_from_um": made.from_z_um}
    return (
        replace(
            calibration,
            psfs=made.psf[None],
            source_positions_um=np.array([[*made.source_um, z_um]]),
            quality={},
            provenance=provenance,
        ),
        made,
    )


def central_psfs(calibration: Calibration) -> tuple[npt.NDArray[np.float64], Floats]:
    """Return the calibrated depths, ascending, and of each the PSF nearest to the axis.

    Returns
    -------
    ndarray, (n_z,), and ndarray, float32, (n_z, n_channels, height, width)
    """
    chosen = _central(calibration)
    depths = calibration.source_positions_um[chosen, 2].astype(np.float64)
    return depths, calibration.psfs[chosen]


def central_places(calibration: Calibration) -> npt.NDArray[np.float64]:
    """Return ``(x, y)`` of the PSFs that :func:`central_psfs` returns, micrometres: (n_z, 2)."""
    return np.asarray(calibration.source_positions_um[_central(calibration), :2], np.float64)


def _central(calibration: Calibration) -> list[int]:
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


def _mixed(
    depths: npt.NDArray[np.float64], psfs: Floats, z_um: float, distance_um: float
) -> tuple[Floats, list[int], list[float]]:
    """Return the PSF at ``z_um``, the planes it was made of and their weights."""
    exact = np.flatnonzero(np.abs(depths / z_um - 1) < 1e-9)  # but for rounding
    if exact.size:
        return psfs[exact[0]], [int(exact[0])], [1.0]
    above = int(np.searchsorted(depths, z_um))
    if above in (0, len(depths)):
        nearest = min(above, len(depths) - 1)
        return refocus_psf(psfs[nearest], depths[nearest], z_um, distance_um), [nearest], [1.0]
    near, far = above - 1, above
    share = float((1 / depths[near] - 1 / z_um) / (1 / depths[near] - 1 / depths[far]))
    scaled = [refocus_psf(psfs[k], depths[k], z_um, distance_um) for k in (near, far)]
    # The stage's line need not pass through the sensor's centre: what is left between the two scaled
    # patterns grows evenly in 1/z, so each goes its share of the way.
    rows, columns = displacement(scaled[1].mean(axis=0), scaled[0].mean(axis=0))
    if rows or columns:
        scaled = [
            moved(psf, part * rows, part * columns)
            for psf, part in zip(scaled, (share, share - 1), strict=True)
        ]
    if _likeness(*scaled) < LEAST_LIKENESS:
        nearest = near if share <= 0.5 else far
        return refocus_psf(psfs[nearest], depths[nearest], z_um, distance_um), [nearest], [1.0]
    mixed = (1 - share) * scaled[0] + share * scaled[1]
    return np.asarray(mixed, np.float32), [near, far], [1 - share, share]


def _likeness(first: Array, second: Array) -> float:
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def _expected_similarity(
    depths: npt.NDArray[np.float64], psfs: Floats, z_um: float, members: list[int], distance_um: float
) -> float | None:
    """Predict what a measured PSF would agree to, from calibrated PSFs left out one at a time.

    A plane predicted from planes at a distance ``D`` in 1/z misses ``1 - similarity``, which grows as
    ``D^2`` while it is small; so it is scaled to the distance of the wanted depth.
    """
    if len(depths) < 3:
        return None
    wanted = min(abs(1 / depths[k] - 1 / z_um) for k in members)
    nearest = np.argsort(np.abs(1 / depths - 1 / z_um))[:2]
    missed = []
    for k in nearest:
        rest = np.arange(len(depths)) != k
        predicted, used, _ = _mixed(depths[rest], psfs[rest], float(depths[k]), distance_um)
        rows, columns = displacement(psfs[k].mean(axis=0), predicted.mean(axis=0))
        likeness = _likeness(moved(predicted, rows, columns), psfs[k])
        gap = min(abs(1 / depths[rest][j] - 1 / depths[k]) for j in used)
        missed.append((1 - likeness) * (wanted / gap) ** 2)
    return float(np.clip(1 - np.mean(missed), 0.0, 1.0))


def _distance_um(calibration: Calibration) -> float:
    distance_mm = calibration.geometry.diffuser_distance_mm
    if distance_mm is None:
        raise InputError(
            "The calibration does not say how far the sensor is from the diffuser, which refocusing needs: "
            "give diffuser_distance_mm in [geometry] of bench.toml and calibrate again."
        )
    return 1e3 * distance_mm
