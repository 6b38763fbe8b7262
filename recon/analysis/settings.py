"""What an analysis is asked for, and what follows from it without a calibration's PSFs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from recon.analysis.point_noise import AskedNoise
from recon.analysis.resolution import axial_spacing_per_um, gaussian_response, lateral_spacing_um
from recon.arrays import Array, Float64Array
from recon.base.declare import option
from recon.optics.fall_off import FallOff
from recon.types import Calibration

STEEPEST = math.atan(40.0)
"""Angle at which a response is taken to have ended."""


def _cutoff(typed: str) -> tuple[float, float]:
    """Read ``X,Y``, or one angle for both, as ``(y, x)``."""
    try:
        values = [float(part) for part in typed.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(0 < v < 90 for v in values):
        raise ValueError("one or two angles between 0 and 90, as 41.5,30 for x and y.")
    return values[-1], values[0]


@dataclass(frozen=True, slots=True)
class AnalysisSettings:
    """What the calibration itself does not tell.

    Resolution is stated and tested at ``z_um``: without it at the calibrated depth nearest to the middle of
    the range in 1/z, or at a nearer one where the tests along the axis would reach beyond infinity.
    ``deflection_deg`` is the ``beta`` of Kuo 2020; ``cutoff_deg`` is along y and x. The lateral sampling
    follows from ``fall_off``, the sensor's response as a function of the tangents along y and x, else from
    a Gaussian of ``fall_off_deg``; the axial one (Eq. 5.10) from a microlens diffuser's ``lenslet_um`` and
    the wavelength. ``noise`` is the tests' images'.
    """

    z_um: float | None = option(
        None,
        help="Depth to analyse.",
        label="Depth",
        default_words="the middle one in 1/z",
        unit="um",
        shown_unit="mm",
        shown_factor=1000.0,
        above=0,
        group="Optics",
    )
    deflection_deg: float = option(
        0.5, help="The diffuser's largest deflection.", unit="deg", above=0, below=90, group="Optics"
    )
    cutoff_deg: tuple[float | None, float | None] | None = option(
        None,
        help="Angles at which the sensor's response is down to 20 %, along x and y (calibrate angular).",
        default_words="not known",
        unit="deg",
        metavar="X,Y",
        parse=_cutoff,
        group="Optics",
    )
    fall_off: FallOff | None = None
    fall_off_deg: float | None = option(
        None,
        help="Sigma of the sensor's angular response.",
        default_words="from --cutoff-deg",
        unit="deg",
        above=0,
        group="Optics",
    )
    lenslet_um: float | None = option(
        None, help="Diameter of a microlens diffuser's lenses.", unit="um", above=0, group="Optics"
    )
    wavelength_nm: float | None = option(
        None,
        help="Of the light.",
        default_words="the calibration's",
        unit="nm",
        above=0,
        group="Optics",
    )
    points: bool = option(True, help="Two- and 16-point tests by reconstructions.", group="Point tests")
    volumes: bool = option(
        False,
        help="Two points along the axis and 16 points in default volumes, too: minutes.",
        group="Point tests",
    )
    noise: AskedNoise = field(default_factory=AskedNoise)


def response_of(settings: AnalysisSettings) -> Callable[[Array, Array], Array]:
    """Return the pixels' response by the tangents along y and x: 1 where it is not known."""
    if settings.fall_off is not None:
        return settings.fall_off
    given = settings.cutoff_deg or (None, None)
    sigmas = [
        settings.fall_off_deg if angle is None else angle / math.sqrt(2 * math.log(5)) for angle in given
    ]

    def response(y: Array, x: Array) -> Array:
        total: Array = np.ones(np.broadcast(y, x).shape)
        for tangent, sigma in zip((y, x), sigmas, strict=True):
            if sigma is not None:
                total = total * gaussian_response(sigma)(np.arctan(np.abs(tangent)))
        return total

    return response


def lateral_spacing(settings: AnalysisSettings, nearest_um: float, notes: list[str]) -> float | None:
    """Return how far apart, um, the nearest depth's PSFs are to be calibrated (Kuo 2020, Eqs. 5.8, 5.9)."""
    if (fall_off := settings.fall_off) is not None:

        def along(y: float, x: float) -> Callable[[Float64Array], Float64Array]:
            return lambda angles: fall_off(*(n * np.tan(np.minimum(angles, STEEPEST)) for n in (y, x)))

        return min(lateral_spacing_um(f, nearest_um) for f in (along(1, 0), along(0, 1)))
    sigma = settings.fall_off_deg
    if sigma is None and settings.cutoff_deg is not None:
        known = [angle for angle in settings.cutoff_deg if angle is not None]
        if known:
            sigma = min(known) / math.sqrt(2 * math.log(5))  # a Gaussian that falls to 20 % there
    if sigma is None:
        notes.append("The sensor's angular fall-off is not known: no lateral calibration spacing follows.")
        return None
    return lateral_spacing_um(gaussian_response(sigma), nearest_um)


def axial_spacing(settings: AnalysisSettings, calibration: Calibration, notes: list[str]) -> float | None:
    """Return how far apart in 1/z, 1 / um, depths are to be calibrated (Kuo 2020, Eq. 5.10)."""
    wavelength_nm = settings.wavelength_nm or calibration.geometry.wavelength_nm
    if settings.lenslet_um is None or wavelength_nm is None:
        notes.append("Eq. 5.10 (axial calibration spacing) needs the lenslet's diameter and the wavelength.")
        return None
    return axial_spacing_per_um(settings.lenslet_um, 1e-3 * wavelength_nm)
