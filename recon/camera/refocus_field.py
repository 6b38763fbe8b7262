"""A whole calibration brought to another depth: every place of the field as the one on the axis is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.camera.camera_model import members_of_depths, one_depth
from recon.camera.depth_mixture import (
    Mixture,
    central_members,
    central_psfs,
    mixture_at,
    paraxial_scale,
    sensor_distance_um,
)
from recon.camera.field_registration import remembered_field
from recon.camera.grid import FAR_UM, depth_in_words
from recon.camera.refocus import SAME_DEPTH, Refocused, refocus
from recon.camera.registration import moved
from recon.camera.varying_psfs import interpolation_weights
from recon.errors import InputError
from recon.types import Calibration

SAME_PLACE = 0.02
"""Places of two depths that differ by no more of the field were meant to be the same."""


def extrapolations(calibration: Calibration, made: Sequence[Refocused]) -> list[dict[str, Any]]:
    """Return what is doubtful about depths made of a calibration's, for a provenance: depth and warning each.

    Of depths beyond the calibrated ones, and of those made of such.
    """
    found = []
    for one in made:
        warnings = [*_warnings(calibration, one.from_z_um), *([one.warning] if one.extrapolated else [])]
        found += [{"z_um": one.z_um, "warning": warning} for warning in warnings]
    return found


def beyond_calibrated(calibration: Calibration) -> list[str]:
    """Return the warnings of those depths of a calibration that were made beyond the calibrated ones."""
    return _warnings(calibration, calibration.source_positions_um[:, 2].tolist())


def _warnings(calibration: Calibration, depths_um: Sequence[float]) -> list[str]:
    said = calibration.provenance.get("extrapolated") or []
    if isinstance(said, str):  # as it was written once: of all depths
        return [said]
    return [one["warning"] for one in said if np.isclose(one["z_um"], depths_um).any()]


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
    distance_um, z_um = sensor_distance_um(calibration), min(z_um, FAR_UM)
    pitch_um = calibration.geometry.pixel_pitch_um
    mixture = mixture_at(depths, psfs, z_um, distance_um)
    groups = members_of_depths(calibration.source_positions_um)
    central = central_members(calibration)
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
    points: Any = sum(weight * side.points for weight, side in zip(mixture.weights, fields, strict=True))
    points = np.round(points)  # whole pixels are registered back without another interpolation
    if len(fields) == 1:
        # Beyond one of them x and y are kept; so far away that these are one direction, the angles.
        same_xy = np.round(depths[mixture.members[0]] / z_um * fields[0].points)
        if len(np.unique(same_xy, axis=0)) == len(np.unique(points, axis=0)):
            points = same_xy
    per_px = pitch_um * z_um / distance_um
    positions = [(x_um - column * per_px, y_um - row * per_px, z_um) for row, column in points]
    made = [
        mixture.of([side.psfs[j] for side in fields], [side.points[j] for side in fields], point)
        for j, point in enumerate(points)
    ]
    return _of_places(calibration, np.stack(made), positions)


def _of_places(calibration: Calibration, psfs: Float32Array, positions: Any) -> Calibration:
    return replace(calibration, psfs=psfs, source_positions_um=np.array(positions, np.float64), quality={})


def _axis_at(calibration: Calibration, mixture: Mixture, z_um: float) -> tuple[float, float]:
    """Return where the source of the pattern in the middle would be, at another depth."""
    central = calibration.source_positions_um[central_members(calibration)][list(mixture.members)]
    places = np.nan_to_num(central[:, :2])
    if len(places) > 1:
        places = places * (z_um / central[:, 2:])
    x, y = np.asarray(mixture.weights) @ places
    return float(x), float(y)


@dataclass(frozen=True)
class _Side:
    """The photographs of one depth: ``points`` (n, 2), pixels by which each lies off the central one."""

    psfs: Float32Array
    points: Float64Array
    places_um: Float64Array

    @classmethod
    def of(cls, calibration: Calibration, group: npt.NDArray[np.intp]) -> _Side:
        _, field, _ = remembered_field(calibration, group)
        own = int(np.flatnonzero(group == calibration.nearest_to_axis(group))[0])
        points = field.points - field.points[own]
        return cls(calibration.psfs[group], points, calibration.source_positions_um[group])

    def at(self, points: Float64Array) -> _Side:
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
    distance_um = sensor_distance_um(calibration)
    if any(abs(paraxial_scale(v, z_um, distance_um) - 1) < SAME_DEPTH for v in depths):
        return calibration, None
    made = refocus(calibration, z_um)
    provenance = {**calibration.provenance, "refocused": made.to_json()}
    provenance["extrapolated"] = extrapolations(calibration, [made])
    return replace(refocus_field(calibration, z_um), provenance=provenance), made
