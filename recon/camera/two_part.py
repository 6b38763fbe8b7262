"""The two-part model: one pattern of the diffuser, and the sensor's angular response (Kuo 2020, Eq. 5.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from recon.arrays import Float64Array
from recon.camera.camera_model import members_of_depths
from recon.camera.registration import shifted
from recon.camera.transformed import geometric_centre
from recon.errors import InputError
from recon.types import Calibration

Response = Callable[[Float64Array, Float64Array], Float64Array]
"""Maps the tangents of the angle of incidence along y and x to a response relative to normal incidence."""

LEAST_RESPONSE = 0.02
"""Pixels that answer less to the source on the axis tell nothing of the pattern there."""


def two_part(calibration: Calibration, response: Response, *, points: int = 3) -> Calibration:
    """Return PSFs over the field, from that on the axis of each depth and the sensor's angular response.

    ``h(u; x, z) = h0(u + d/z x; z) f(atan(|u - x| / (d + z)))``: the photograph of the source on the axis,
    divided by the response to it, moved, and multiplied by the response to the source at its place; each
    with the ``cos^3`` of a point that shines evenly. Aberrations of the diffuser are not in it: where PSFs
    differ by more than their brightness, measure them.

    Parameters
    ----------
    calibration : Calibration
        With depths, pixel pitch and the diffuser's distance; of each depth the PSF nearest to the axis is
        taken.
    response : callable
        ``response(tan_y, tan_x)``, of arrays that broadcast: as :mod:`recon.optics.fall_off` makes them, or a
        measured one's ``fall_off()``.
    points : int
        Places a side, over the part of the scene that the sensor's grid shows; 1 or more.

    Raises InputError where the geometry is not known.
    """
    geometry, positions = calibration.geometry, calibration.source_positions_um
    pitch_um, distance_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
    z = positions[:, 2]
    if pitch_um is None or not distance_mm or not (np.isfinite(z).all() and (z > 0).all()):
        raise InputError(
            "The angular response needs the depths of the PSFs, the pixel pitch and the distance from "
            "diffuser to sensor; the calibration does not say all of them."
        )
    if points < 1:
        raise InputError(f"A field has 1 place a side or more, not {points}.")
    distance_um = 1e3 * distance_mm
    height, width = calibration.psfs.shape[2:]
    middle = geometric_centre(calibration.psfs)
    steps = [np.round(n * ((np.arange(points) + 0.5) / points - 0.5)).astype(int) for n in (height, width)]
    psfs, places = [], []
    for group in members_of_depths(positions):
        own = calibration.nearest_to_axis(group)
        x, y, depth = np.nan_to_num(positions[own])
        across = distance_um + depth
        rows, columns = ((np.arange(n) - c) * pitch_um for n, c in zip((height, width), middle, strict=True))
        on_axis = _seen(response, rows - y, columns - x, across)
        pattern = np.where(on_axis > LEAST_RESPONSE, 1 / np.maximum(on_axis, LEAST_RESPONSE), 0)
        to_scene = pitch_um * depth / distance_um
        for row, column in product(*steps):
            place = x - column * to_scene, y - row * to_scene
            off = rows + row * pitch_um - place[1], columns + column * pitch_um - place[0]
            gain = (pattern * _seen(response, *off, across)).astype(np.float32)
            psfs.append(shifted(calibration.psfs[own] * gain, int(row), int(column)))
            places.append((*place, depth))
    provenance = {**calibration.provenance, "two_part": "one PSF a depth and an angular response (Eq. 5.1)"}
    return replace(
        calibration,
        psfs=np.stack(psfs).astype(np.float32),
        source_positions_um=np.array(places, np.float64),
        quality={},
        provenance=provenance,
    )


EDGE_PX, CUT = 2, 0.3
"""Pixels along a side that tell whether a pattern goes on beyond it, and how bright they are then beside the
PSF's mean: of simulated patterns on the sensor up to 0.23, of those that go on beyond it up to 1.04."""


def is_cut(calibration: Calibration) -> bool:
    """Whether the pattern of a PSF on the axis goes on beyond the sensor: two-part PSFs do not show it there.

    Their pattern is the photograph's on the axis, moved: what that does not show stays dark over the field.
    """
    for group in members_of_depths(calibration.source_positions_um):
        psf = calibration.psfs[calibration.nearest_to_axis(group)].mean(axis=0, dtype=np.float64)
        sides = (psf[:EDGE_PX], psf[-EDGE_PX:], psf[:, :EDGE_PX], psf[:, -EDGE_PX:])
        if max(float(side.mean()) for side in sides) > CUT * float(psf.mean()):
            return True
    return False


def _seen(
    response: Response, rows_um: Float64Array, columns_um: Float64Array, across_um: float
) -> Float64Array:
    """Light of a point that shines evenly on pixels at these places from below it."""
    tan_y, tan_x = rows_um[:, None] / across_um, columns_um / across_um
    return np.asarray(response(tan_y, tan_x) * (1 + tan_y**2 + tan_x**2) ** -1.5)
