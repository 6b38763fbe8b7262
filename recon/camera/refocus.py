"""Digital refocus: a PSF brought to another depth by paraxial scaling (Kuo 2020, secs. 3.1 and 5.2).

A ray from a source at ``(x, z)`` straight through the diffuser at ``u`` meets the sensor at ``(1 + d/z) u -
(d/z) x``. From depth ``z_i`` to ``z`` the pattern therefore scales by ``(1 + d/z) / (1 + d/z_i)``, which is
``1 / s_i`` of Eq. 5.2. What scaling does not describe is the light's displacement by the diffuser, ``alpha
d``, which stays as it is where the scaled PSF has it scaled: the error grows as ``alpha d (1 - s)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.camera_model import members_of_depths, one_depth
from recon.camera.depth_likeness import likeness_range
from recon.camera.field_registration import remembered_field
from recon.camera.grid import FAR_UM, depth_in_words
from recon.camera.registration import displacement, moved, register, rescaled
from recon.camera.spot_flow import met
from recon.camera.transformed import geometric_centre, resampled
from recon.camera.varying_psfs import interpolation_weights
from recon.errors import InputError
from recon.types import Calibration

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

SAME_DEPTH = 1e-4
"""Difference of scale below which a calibrated PSF serves as it is: a twentieth of a pixel at the edge of a
pattern 1000 pixels wide."""
SAME_PLACE = 0.02
"""Places of two depths that differ by no more of the field were meant to be the same."""
LEAST_LIKENESS = 0.5
"""Scaled neighbours less alike than this are not mixed: the mixture would be a double image."""
_PLANES, _PAIRS = 4, 4  # nearest planes, and pairs of them, whose likeness tells how it goes with distance
_BEYOND = 0.5  # part of what is lost beyond the calibrated depths that is not known
_SAID = 0.01  # a range that is said as one
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
    similarity_within: float | None = None
    """By how much the calibrated PSFs leave the similarity open, to either side."""

    @property
    def extrapolated(self) -> bool:
        """Whether the depth lies outside the calibrated ones, by more than a stage's repeatability."""
        near, far = self.calibrated_um
        return not (1 - SAME_DEPTH) * near <= self.z_um <= (1 + SAME_DEPTH) * far

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
    distance_um, z_um = _distance_um(calibration), min(z_um, FAR_UM)
    mixture = _mixture(depths, psfs, z_um, distance_um)
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


def psf_at(calibration: Calibration, z_um: float) -> Floats:
    """Return the PSF of :func:`refocus` alone, colours averaged, (height, width): a third of the time."""
    depths, psfs = central_psfs(calibration)
    mixture = _mixture(depths, psfs, z_um, _distance_um(calibration))
    averaged: Floats = mixture.of([psfs[k] for k in mixture.members]).mean(axis=0)
    return averaged


def refocus_field(calibration: Calibration, z_um: float) -> Calibration:
    """Return what a calibration would hold of one depth, at one that need not have been calibrated.

    Every place of the field is brought there as the one on the axis (Kuo 2020, Eqs. 5.2 and 5.3 in depth):
    the photographs of the neighbouring depths are scaled about where their pattern lies, and mixed. Where the
    depths were calibrated at the same places, or at the same angles, so is the new one; else at those of the
    depth with most, the other's PSFs interpolated between its own.

    What no photograph shows, of patterns that reach beyond the sensor, is dark.

    Raises as :func:`refocus`, and InputError where the pixel pitch is not known.
    """
    depths, psfs = central_psfs(calibration)
    distance_um, z_um = _distance_um(calibration), min(z_um, FAR_UM)
    pitch_um = calibration.geometry.pixel_pitch_um
    mixture = _mixture(depths, psfs, z_um, distance_um)
    groups = members_of_depths(calibration.source_positions_um)
    central = _central(calibration)
    sides = [next(g for g in groups if central[k] in g) for k in mixture.members]
    if mixture.scales == (1.0,):
        return calibration.part(sides[0])
    if max(len(g) for g in sides) == 1:
        alone = mixture.of([psfs[k] for k in mixture.members])
        return _of_places(calibration, alone[None], [(*_axis_at(calibration, mixture, z_um), z_um)])
    if pitch_um is None:
        raise InputError(
            "The pixel pitch is not known, so a field of PSFs cannot be brought to another depth."
        )
    fields = _of_equal_places([_Side.of(calibration, group) for group in sides])
    x_um, y_um = _axis_at(calibration, mixture, z_um)
    # Pixels by which the pattern of a place is displaced go with x / z: linear in 1 / z between the depths.
    ratios = [depths[k] / z_um if len(fields) == 1 else 1.0 for k in mixture.members]
    points = np.zeros_like(fields[0].points)
    for weight, ratio, side in zip(mixture.weights, ratios, fields, strict=True):
        points += weight * ratio * side.points
    points = np.round(points)  # whole pixels are registered back without another interpolation
    per_px = pitch_um * z_um / distance_um
    positions = [(x_um - column * per_px, y_um - row * per_px, z_um) for row, column in points]
    made = [
        mixture.of([side.psfs[j] for side in fields], [side.points[j] for side in fields], point)
        for j, point in enumerate(points)
    ]
    return _of_places(calibration, np.stack(made), positions)


def _of_places(calibration: Calibration, psfs: Floats, positions: Any) -> Calibration:
    return replace(calibration, psfs=psfs, source_positions_um=np.array(positions, np.float64), quality={})


def _axis_at(calibration: Calibration, mixture: _Mixture, z_um: float) -> tuple[float, float]:
    """Return where the source of the pattern in the middle would be, at another depth."""
    central = calibration.source_positions_um[_central(calibration)][list(mixture.members)]
    places = np.nan_to_num(central[:, :2])
    if len(places) > 1:
        places = places * (z_um / central[:, 2:])
    x, y = np.asarray(mixture.weights) @ places
    return float(x), float(y)


@dataclass(frozen=True)
class _Side:
    """The photographs of one depth: ``points`` (n, 2), pixels by which each lies off the central one."""

    psfs: Floats
    points: npt.NDArray[np.float64]
    places_um: npt.NDArray[np.float64]

    @classmethod
    def of(cls, calibration: Calibration, group: npt.NDArray[np.intp]) -> _Side:
        _, field, _ = remembered_field(calibration, group)
        own = int(np.flatnonzero(group == calibration.nearest_to_axis(group))[0])
        points = field.points - field.points[own]
        return cls(calibration.psfs[group], points, calibration.source_positions_um[group])

    def at(self, points: npt.NDArray[np.float64]) -> _Side:
        """Return PSFs at other places, displaced by ``points``, from those around (Eq. 5.3)."""
        psfs = []
        for row, column in points:
            weights = interpolation_weights(self.points, np.eye(len(self.points)), [row], [column])[:, 0, 0]
            used = np.flatnonzero(weights > 1e-6)
            total: Any = 0.0
            shown: Any = 1e-9
            for j in used:
                by = row - self.points[j, 0], column - self.points[j, 1]
                total = total + weights[j] * moved(self.psfs[j], *by)
                shown = shown + weights[j] * moved(np.ones(self.psfs.shape[2:], np.float32), *np.round(by))
            psfs.append(np.asarray(total / shown, np.float32))
        places = np.column_stack([points, np.full(len(points), np.nan)])
        return _Side(np.stack(psfs), points, places)


def _of_equal_places(sides: list[_Side]) -> list[_Side]:
    """Return the depths' photographs, the same places in the same order."""
    if len(sides) == 1:
        return sides
    first, second = sides
    for divided in (False, True):  # the same x and y, or the same angles
        a, b = (s.places_um[:, :2] / (s.places_um[:, 2:] if divided else 1) for s in sides)
        if len(a) != len(b) or not np.isfinite(a).all() or not np.isfinite(b).all():
            break
        away = np.linalg.norm(a[:, None] - b, axis=2)
        order = away.argmin(axis=1)
        size = max(float(np.ptp(a, axis=0).max()), 1e-12)
        if len(set(order.tolist())) == len(order) and away.min(axis=1).max() < SAME_PLACE * size:
            return [first, _Side(second.psfs[order], second.points[order], second.places_um[order])]
    fuller = int(len(second.psfs) > len(first.psfs))
    other = 1 - fuller
    # At the same x and y the displacement goes with 1 / z.
    ratio = float(np.mean(sides[fuller].places_um[:, 2]) / np.mean(sides[other].places_um[:, 2]))
    made = sides[other].at(sides[fuller].points * ratio)
    return [sides[0], made] if other else [made, sides[1]]


def at_depth(calibration: Calibration, z_um: float) -> tuple[Calibration, Refocused | None]:
    """Return a calibration for the picture at a depth: at ``z_um`` alone, wherever PSFs can be brought there.

    Returns
    -------
    Calibration
        As it is where it has the depth (to :data:`SAME_DEPTH` of the pattern's scale). How it was made is in
        its provenance, ``refocused``; where nothing can be brought because the diffuser's distance is not
        known, it is the nearest of its depths, and ``not_refocused`` says so.
    Refocused or None
        How it was made; None where it is as it was measured.

    Raises InputError where ``z_um`` is no distance, the depths are not known, or there is one that nothing
    can bring to ``z_um``.
    """
    asked, z_um = depth_in_words(z_um), min(z_um, FAR_UM)
    if not z_um > 0:
        raise InputError(f"The scene's distance must be above 0 mm, not {asked}.")
    z = calibration.source_positions_um[:, 2]
    as_it_is = "Leave the distance (--z-mm) out to take the PSF as it is, or give a calibration"
    if not (z > 0).all():
        raise InputError(
            f"The depths of the calibration's PSFs are not known, so they cannot be brought to {asked}. "
            f"{as_it_is} with the depths of its PSFs."
        )
    if calibration.geometry.diffuser_distance_mm is None:
        why = "the diffuser's distance from the sensor is not known; the nearest is taken"
        said = f"not refocused to {asked}: {why}"
        if np.isclose(z, z_um).any() or calibration.provenance.get("not_refocused") == said:
            return calibration, None
        if len(members_of_depths(calibration.source_positions_um)) == 1:
            raise InputError(
                f"The calibration has one depth, {z[0] / 1e3:g} mm, and the diffuser's distance from the "
                f"sensor is not known, so it cannot be brought to {asked}. {as_it_is} of several depths."
            )
        provenance = {**calibration.provenance, "not_refocused": said}
        return replace(one_depth(calibration, z_um), provenance=provenance), None
    depths, _ = central_psfs(calibration)
    distance_um = _distance_um(calibration)
    if any(abs(paraxial_scale(v, z_um, distance_um) - 1) < SAME_DEPTH for v in depths):
        return calibration, None
    made = refocus(calibration, z_um)
    provenance = {**calibration.provenance, "refocused": made.to_json()}
    return replace(refocus_field(calibration, z_um), provenance=provenance), made


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


@dataclass(frozen=True)
class _Mixture:
    """How PSFs at a depth are made: of which planes, how much of each, how much larger, and where.

    ``offsets`` (row, column) is what is added to a plane's scaled pattern so that it lies on the other's.
    """

    members: tuple[int, ...]
    weights: tuple[float, ...]
    scales: tuple[float, ...]
    dimmed: tuple[float, ...]
    offsets: tuple[tuple[float, float], ...]

    def of(self, psfs: list[Floats], points: Any = None, target: Any = (0.0, 0.0)) -> Floats:
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


def _mixture(depths: npt.NDArray[np.float64], psfs: Floats, z_um: float, distance_um: float) -> _Mixture:
    """Return what PSFs at ``z_um`` are made of, by the central ones, (n_z, n_channels, height, width)."""
    if not z_um > 0:
        raise InputError(f"The depth to refocus to is above 0, not {z_um:g} um.")

    def of(members: tuple[int, ...], weights: tuple[float, ...]) -> _Mixture:
        scales = tuple(paraxial_scale(depths[k], z_um, distance_um) for k in members)
        dimmed = tuple(((distance_um + depths[k]) / (distance_um + z_um)) ** 2 for k in members)
        return _Mixture(members, weights, scales, dimmed, ((0.0, 0.0),) * len(members))

    exact = np.flatnonzero(np.abs(depths / z_um - 1) < 1e-9)  # but for rounding
    if exact.size:
        return _Mixture((int(exact[0]),), (1.0,), (1.0,), (1.0,), ((0.0, 0.0),))
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
    if _likeness(scaled[0], moved(scaled[1], -rows, -columns)) < LEAST_LIKENESS:
        return of((near if share <= 0.5 else far,), (1.0,))
    return replace(
        both, offsets=((share * rows, share * columns), ((share - 1) * rows, (share - 1) * columns))
    )


def _likeness(first: Array, second: Array) -> float:
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def _expected_similarity(
    depths: npt.NDArray[np.float64],
    psfs: Floats,
    z_um: float,
    mixture: _Mixture,
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
        alike.append(_likeness(moved(scaled, rows, columns), psfs[other]))
    gap = abs(nearness[mixture.members[0]] - nearness[mixture.members[-1]])
    low, high = likeness_range(apart, np.array(alike), distances, np.array(mixture.weights), float(gap))
    if not depths[0] <= z_um <= depths[-1]:  # nothing was seen of how patterns change out there
        low, high = 1 - (1 + _BEYOND) * (1 - low), 1 - (1 - _BEYOND) * (1 - high)
    return max(low, 0.0), high


def _distance_um(calibration: Calibration) -> float:
    distance_mm = calibration.geometry.diffuser_distance_mm
    if distance_mm is None:
        raise InputError(
            "The calibration does not say how far the sensor is from the diffuser, which refocusing needs: "
            "give diffuser_distance_mm in [geometry] of bench.toml and calibrate again."
        )
    return 1e3 * distance_mm
