"""Field of view, and how PSFs change across it (Kuo 2020, Eqs. 3.12 and 4.6, Fig. 5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.correlation import RESOLUTION_LEVEL, autocorrelate, correlate
from recon.camera.camera_model import members_of_depths
from recon.camera.registration import register
from recon.errors import InputError
from recon.types import Calibration

Array = npt.NDArray[Any]

HOLDS = 1.1
"""Spot size relative to the axis up to which the convolution model is said to hold: Fig. 5.1e is flat to
within this up to 15 degrees, where the dissertation draws the line."""


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """Half the angle of view along one axis, degrees, and what limits it.

    Attributes
    ----------
    half_deg : float
        ``beta + min(alpha_c, atan((l + w) / d))``.
    geometric_deg : float
        ``atan((l + w) / d)``: beyond it no light reaches the sensor.
    cutoff_deg : float or None
        ``alpha_c``: the pixels' response is down to 20 %; None where it was not measured.
    """

    half_deg: float
    geometric_deg: float
    cutoff_deg: float | None

    @property
    def limited_by(self) -> str:
        """``"the pixels' angular response"`` or ``"the sensor's and the aperture's size"``."""
        by_pixels = self.cutoff_deg is not None and self.cutoff_deg < self.geometric_deg
        return "the pixels' angular response" if by_pixels else "the sensor's and the aperture's size"


def field_of_view(
    sensor_um: float,
    support_um: float,
    distance_um: float,
    *,
    deflection_deg: float,
    cutoff_deg: float | None = None,
) -> FieldOfView:
    """Half the angle of view along one axis (Eq. 3.12, which with full widths is Eq. 4.6).

    Parameters
    ----------
    sensor_um, support_um : float
        Full extent of the sensor, ``2 l``, and of the PSF's support, ``2 w``.
    distance_um : float
        From the diffuser to the sensor.
    deflection_deg : float
        Largest deflection by the diffuser, ``beta``.
    cutoff_deg : float, optional
        Angle at which the sensor's response is down to 20 %, ``alpha_c``.
    """
    if min(sensor_um, support_um, distance_um) <= 0:
        raise InputError(
            f"Sensor, support and distance are positive, not {sensor_um:g}, {support_um:g}, {distance_um:g}."
        )
    geometric = float(np.rad2deg(np.arctan((sensor_um + support_um) / (2 * distance_um))))
    limit = geometric if cutoff_deg is None else min(cutoff_deg, geometric)
    return FieldOfView(deflection_deg + limit, geometric, cutoff_deg)


@dataclass(frozen=True, slots=True)
class FieldPoint:
    """One PSF of the field compared with the central one of its depth (Figs. 5.1d and 5.1e).

    Attributes
    ----------
    angle_deg : float
        Between the directions of both sources.
    similarity : float
        Inner product after registration between pixels, over those that both show.
    spot : float
        Width of the cross-correlation over that of the central PSF's autocorrelation: the size of the spot
        that the convolution model makes of a point there.
    """

    x_um: float
    y_um: float
    z_um: float
    angle_deg: float
    similarity: float
    spot: float


def across_field(calibration: Calibration, z_um: float | None = None) -> tuple[FieldPoint, ...]:
    """Compare every PSF of one depth with the one nearest to the axis, nearest directions first.

    Parameters
    ----------
    calibration : Calibration
    z_um : float, optional
        The nearest depth in 1/z is taken; default the one calibrated at most places.
    """
    positions = calibration.source_positions_um
    if not np.isfinite(positions).all():
        return ()
    groups = members_of_depths(positions)
    if z_um is None:
        members = max(groups, key=len)
    else:
        members = min(groups, key=lambda g: abs(1 / float(positions[g, 2].mean()) - 1 / z_um))
    centre = members[int(np.argmin(np.hypot(positions[members, 0], positions[members, 1])))]
    reference = calibration.psfs[centre].mean(axis=0)
    width = _spot_px(autocorrelate(reference))
    points = []
    for k in members:
        psf = calibration.psfs[k].mean(axis=0)
        # Off the axis the sensor's edge cuts the pattern: only pixels that both show are compared.
        likeness = 1.0 if k == centre else register(psf, reference).similarity
        points.append(
            FieldPoint(
                x_um=float(positions[k, 0]),
                y_um=float(positions[k, 1]),
                z_um=float(positions[k, 2]),
                angle_deg=_angle_between_deg(positions[k], positions[centre]),
                similarity=likeness,
                spot=_spot_px(correlate(reference, psf)) / width,
            )
        )
    return tuple(sorted(points, key=lambda p: p.angle_deg))


def convolution_holds_deg(points: tuple[FieldPoint, ...]) -> float | None:
    """Return the largest calibrated angle up to which every spot is at most :data:`HOLDS` wide.

    None where only one place was calibrated: then nobody knows.
    """
    if len(points) < 2:
        return None
    first = min((p.angle_deg for p in points if p.spot > HOLDS), default=np.inf)
    # Points of a ring are at one angle but for the stage's error.
    return max((p.angle_deg for p in points if p.angle_deg < first - 0.1), default=0.0)


def _spot_px(correlation: Any) -> float:
    return float(
        np.sqrt(correlation.half_width(0, RESOLUTION_LEVEL) * correlation.half_width(1, RESOLUTION_LEVEL))
    )


def _angle_between_deg(first: Array, second: Array) -> float:
    cosine = float(first @ second / (np.linalg.norm(first) * np.linalg.norm(second)))
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
