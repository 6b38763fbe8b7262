"""Digital refocus: a PSF brought to another depth by paraxial scaling (Kuo 2020, secs. 3.1 and 5.2).

A ray from a source at ``(x, z)`` straight through the diffuser at ``u`` meets the sensor at ``(1 + d/z) u -
(d/z) x``. From depth ``z_i`` to ``z`` the pattern therefore scales by ``(1 + d/z) / (1 + d/z_i)``, which is
``1 / s_i`` of Eq. 5.2. What scaling does not describe is the light's displacement by the diffuser, ``alpha
d``, which stays as it is where the scaled PSF has it scaled: the error grows as ``alpha d (1 - s)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.camera.depth_likeness import likeness_range
from recon.camera.depth_mixture import (
    Mixture,
    central_places,
    central_psfs,
    likeness,
    mixture_at,
    paraxial_scale,
    sensor_distance_um,
)
from recon.camera.grid import FAR_UM, depth_in_words
from recon.camera.registration import displacement, moved, rescaled
from recon.errors import InputError
from recon.types import Calibration

_PLANES, _PAIRS = 4, 4  # nearest planes, and pairs of them, whose likeness tells how it goes with distance
_BEYOND = 0.5  # part of what is lost beyond the calibrated depths that is not known
_SAID = 0.01  # a range that is said as one
SAME_DEPTH = 1e-4
"""Difference of scale below which a calibrated PSF serves as it is: a twentieth of a pixel at the edge of a
pattern 1000 pixels wide."""
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
        Expected inner product with a PSF measured there, by how alike the calibrated PSFs are. None with
        fewer than three depths, and too far from them.
    """

    psf: Float32Array
    z_um: float
    from_z_um: tuple[float, ...]
    scales: tuple[float, ...]
    displacement_error_um: float
    expected_similarity: float | None
    source_um: tuple[float, float] = (0.0, 0.0)
    """``(x, y)`` of the PSFs it was made of: those nearest to the axis."""
    calibrated_um: tuple[float, float] = (0.0, float("inf"))
    """Nearest and farthest calibrated depth."""
    similarity_within: float | None = None
    """By how much the calibrated PSFs leave the similarity open, to either side."""

    @property
    def extrapolated(self) -> bool:
        """Whether the depth lies outside the calibrated ones, by more than a stage's repeatability."""
        near, far = self.calibrated_um
        return not (1 - SAME_DEPTH) * near <= self.z_um <= (1 + SAME_DEPTH) * far

    @property
    def warning(self) -> str:
        """What is doubtful about a depth outside the calibrated ones, in words; empty inside."""
        if not self.extrapolated:
            return ""
        near, far = (v / 1e3 for v in self.calibrated_um)
        calibrated = f"{near:.4g} to {far:.4g} mm" if far > near else f"depth, {near:.4g} mm"
        asked = depth_in_words(self.z_um)
        return (
            f"{asked[0].upper()}{asked[1:]} lies outside the calibrated {calibrated}: the pattern is "
            "extrapolated, by scaling alone. Measure a PSF there where it matters."
        )

    def to_json(self) -> dict[str, Any]:
        """Return how it was made, for a record."""
        return {
            "z_um": self.z_um,
            "from_z_um": list(self.from_z_um),
            "displacement_error_um": self.displacement_error_um,
            "expected_similarity": self.expected_similarity,
            "similarity_within": self.similarity_within,
        }

    def __str__(self) -> str:
        """Say it in words."""
        sources = " and ".join(f"{z / 1e3:g}" for z in self.from_z_um)
        how = "mixed from the PSFs" if len(self.from_z_um) > 1 else "scaled from the PSF"
        error = f"light up to {self.displacement_error_um:.1f} um off on the sensor"
        expected, within = self.expected_similarity, self.similarity_within
        if expected is not None and within is not None:
            ends = sorted({f"{expected - within:.2f}", f"{expected + within:.2f}"})
            error += f", expected similarity {' to '.join(ends) if within > _SAID else f'{expected:.3f}'}"
        else:
            error += ", similarity not known: it takes three calibrated depths, no farther from it than apart"
        x_mm, y_mm = (1e-3 * v for v in self.source_um)
        place = f" (x = {x_mm:.4g}, y = {y_mm:.4g} mm)" if x_mm or y_mm else ""
        return f"{how} at {sources} mm{place} (Kuo 2020, Eq. 5.2): {error}"


def refocus_psf(psf: Array, z_from_um: float, z_to_um: float, distance_um: float) -> Float32Array:
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

    The central PSFs of the calibrated depths on both sides are scaled to ``z_um`` and registered to each
    other, their spots are moved to between them where they can be followed, and both are mixed by distance
    in 1/z (sec. 5.2); outside the calibrated range, or where the neighbours are too unlike to be mixed, the
    nearest one is scaled.

    Parameters
    ----------
    calibration : Calibration
        With depths, and ``geometry.diffuser_distance_mm``.
    z_um : float
        Infinity is taken as :data:`~recon.camera.grid.FAR_UM`.
    deflection_deg : float
        Typical angle by which the diffuser bends light (its half width at half maximum), for the error.

    Raises InputError when depths or the distance from diffuser to sensor are unknown.
    """
    depths, psfs = central_psfs(calibration)
    distance_um, z_um = sensor_distance_um(calibration), min(z_um, FAR_UM)
    mixture = mixture_at(depths, psfs, z_um, distance_um)
    members, weights = mixture.members, mixture.weights
    bend_um = np.deg2rad(deflection_deg) * distance_um
    error = sum(w * bend_um * abs(1 - 1 / s) for w, s in zip(weights, mixture.scales, strict=True))
    if max(abs(s - 1) for s in mixture.scales) < SAME_DEPTH:
        likeness: tuple[float, float] | None = (1.0, 1.0)
    else:
        likeness = _expected_similarity(depths, psfs, z_um, mixture, distance_um)
    x_um, y_um = central_places(calibration)[members[int(np.argmax(weights))]]
    return Refocused(
        mixture.of([psfs[k] for k in members]),
        float(z_um),
        tuple(float(depths[k]) for k in members),
        mixture.scales,
        float(error),
        None if likeness is None else sum(likeness) / 2,
        (float(x_um), float(y_um)),
        (float(depths[0]), float(depths[-1])),
        None if likeness is None else (likeness[1] - likeness[0]) / 2,
    )


def psf_at(calibration: Calibration, z_um: float) -> Float32Array:
    """Return the PSF of :func:`refocus` alone, colours averaged, (height, width): a third of the time."""
    depths, psfs = central_psfs(calibration)
    mixture = mixture_at(depths, psfs, z_um, sensor_distance_um(calibration))
    averaged: Float32Array = mixture.of([psfs[k] for k in mixture.members]).mean(axis=0)
    return averaged


def _expected_similarity(
    depths: Float64Array,
    psfs: Float32Array,
    z_um: float,
    mixture: Mixture,
    distance_um: float,
) -> tuple[float, float] | None:
    """Predict between what and what a measured PSF would agree: by how alike the planes nearest to it are.

    None with fewer than three depths, and farther from them than they are from one another.
    """
    if len(depths) < 3:
        return None
    nearness = 1 / depths
    away = np.abs(nearness - 1 / z_um)
    if len(mixture.members) == 1:  # the plane that is scaled, with a near, a middle and the farthest one
        (member,) = mixture.members
        others = np.argsort(np.abs(nearness - nearness[member]))[1:]
        pairs = [(member, int(k)) for k in sorted({others[0], others[len(others) // 2], others[-1]})]
    else:
        pairs = list(combinations(np.argsort(away)[:_PLANES].tolist(), 2))
        pairs.sort(key=lambda pair: abs(nearness[pair[0]] - nearness[pair[1]]))
        if len(pairs) > _PAIRS:
            pairs = [*pairs[: _PAIRS - 2], pairs[len(pairs) // 2], pairs[-1]]
    apart = np.array([abs(nearness[i] - nearness[k]) for i, k in pairs])
    distances = away[list(mixture.members)]
    if distances.min() > apart.max():
        return None
    alike = []
    for one, other in pairs:
        scaled = refocus_psf(psfs[one], float(depths[one]), float(depths[other]), distance_um)
        rows, columns = displacement(psfs[other].mean(axis=0), scaled.mean(axis=0))
        alike.append(likeness(moved(scaled, rows, columns), psfs[other]))
    gap = abs(nearness[mixture.members[0]] - nearness[mixture.members[-1]])
    low, high = likeness_range(apart, np.array(alike), distances, np.array(mixture.weights), float(gap))
    if not depths[0] <= z_um <= depths[-1]:  # nothing was seen of how patterns change out there
        low, high = 1 - (1 + _BEYOND) * (1 - low), 1 - (1 - _BEYOND) * (1 - high)
    return max(low, 0.0), high
