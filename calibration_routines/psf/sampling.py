"""How many places a calibration must measure, from the physics of the camera (Kuo 2020, Sec. 5.3).

Across the field the registered PSFs change with the sensor's angular response, ``f(atan(x / z))`` at the
pixel beneath the axis (Eq. 5.9). Its bandwidth gives the spacing. Along the axis the edge of the pattern
moves (Eq. 4.7), or lenslets go out of focus (Eq. 5.10).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration_routines.psf.axial_plan import planes_needed
from instrument.files.errors import BenchError
from recon.optics.fall_off import FallOff
from recon.types import Geometry

BANDWIDTH_LEVEL = 0.01
"""Part of the response's mean below which its frequencies no longer count. With it the microscope's 13
degrees give 0.41 mm at 1.7 mm; the dissertation says 0.4 mm, and not at which level or depth."""
NO_FALL_OFF_STEP_DEG = 15.0
"""Spacing where the sensor's response is not known: the PSF itself keeps its shape this far (Kuo 2020, Fig.
5.1)."""
FEATURE_PX = 2.0
"""How far the edge of the pattern may move from plane to plane: the PSF's smallest features (Sec. 4.3)."""
_EXTENT = 20.0  # in tangents: the response is taken to be zero beyond
_SAMPLES = 1 << 14


@dataclass(frozen=True, slots=True)
class Sampling:
    """A spacing, or a number of planes, with its reason in words."""

    value: float
    reason: str


def lateral_spacing(
    response: FallOff | None, z_um: float, *, along: str = "x", level: float = BANDWIDTH_LEVEL
) -> Sampling:
    """Return the largest spacing of calibration points at a depth, micrometres.

    Half a period of the highest frequency at which the spectrum of ``f(atan(x / z))`` is above ``level`` of
    its value at zero (Kuo 2020, Eqs. 5.8 and 5.9).

    Parameters
    ----------
    response : callable, optional
        The sensor's angular response (:mod:`recon.optics.fall_off`); None: not known, or none.
    z_um : float
    along : {"x", "y"}
    level : float
    """
    if response is None:
        spacing_um = float(np.tan(np.deg2rad(NO_FALL_OFF_STEP_DEG)) * z_um)
        return Sampling(
            spacing_um,
            f"{spacing_um / 1e3:.3g} mm along {along} at z = {z_um / 1e3:.4g} mm: {NO_FALL_OFF_STEP_DEG:g} "
            "degrees, over which a PSF keeps its shape (Kuo 2020, Fig. 5.1); no angular response of the "
            "sensor is known",
        )
    bandwidth = _bandwidth(response, along, level)
    spacing_um = z_um / (2 * bandwidth)
    return Sampling(
        spacing_um,
        f"{spacing_um / 1e3:.3g} mm along {along} at z = {z_um / 1e3:.4g} mm: the sensor's response "
        f"f(atan({along}/z)) has frequencies up to {1e3 * bandwidth / z_um:.3g} per mm above {level:.0%} of "
        "its mean, and is sampled at twice that (Kuo 2020, Eqs. 5.8 and 5.9)",
    )


def _bandwidth(response: FallOff, along: str, level: float) -> float:
    """Highest frequency of the response as a function of the tangent, periods per unit."""
    tangents = np.linspace(-_EXTENT, _EXTENT, _SAMPLES, endpoint=False)
    zero = np.zeros_like(tangents)
    values = response(zero, tangents) if along == "x" else response(tangents, zero)
    # A response that does not reach zero has a constant part, which any spacing samples.
    values = np.asarray(values, np.float64) - float(np.min(values))
    spectrum = np.abs(np.fft.rfft(values))
    if not spectrum[0] > 0:
        raise BenchError("The sensor's angular response is the same at all angles: it asks for no spacing.")
    above = np.flatnonzero(spectrum > level * spectrum[0])
    step = 1 / (2 * _EXTENT)
    # At least one frequency: the response changes once over the field.
    return float(max(int(above[-1]), 1) * step)


def axial_planes(
    z_min_um: float,
    z_max_um: float,
    geometry: Geometry,
    *,
    lenslet_um: float | None = None,
    wavelength_nm: float | None = None,
) -> Sampling:
    """Return how many planes, evenly spaced in 1/z, leave no depth between them unsampled.

    Parameters
    ----------
    z_min_um, z_max_um : float
    geometry : Geometry
    lenslet_um : float, optional
        Diameter p of a microlens diffuser's lenslets: then ``1/z1 - 1/z2 <= 4 wavelength / p^2`` (Kuo 2020,
        Eq. 5.10). Else the edge of the pattern moves by two pixels at most (Eq. 4.7).
    wavelength_nm : float, optional
        For Eq. 5.10; the geometry's by default.

    Raises
    ------
    BenchError
        When what is needed is not known.
    """
    if not 0 < z_min_um < z_max_um:
        raise BenchError(
            f"Planes lie in front of the diffuser, nearest first: 0 < z min < z max, not "
            f"{z_min_um / 1e3:g} and {z_max_um / 1e3:g} mm."
        )
    if lenslet_um is None:
        number = max(2, planes_needed(z_min_um, z_max_um, geometry, FEATURE_PX))
        step = (1 / z_min_um - 1 / z_max_um) / (number - 1)
        return Sampling(
            number,
            f"{number} planes every {1e6 * step:.3g} per metre: the edge of the pattern moves by up to "
            f"{FEATURE_PX:g} pixels from one to the next (Kuo 2020, Eq. 4.7)",
        )
    wavelength_nm = wavelength_nm or geometry.wavelength_nm
    if wavelength_nm is None or lenslet_um <= 0:
        raise BenchError(
            "For lenslets the spacing of the planes follows from their diameter and the wavelength "
            "(4 wavelength / p^2): give both, or wavelength_nm in [geometry] of bench.toml."
        )
    if not (lenslet_um > 1e-3 * wavelength_nm and lenslet_um < 1e6):
        raise BenchError(
            f"A lenslet is wider than the wavelength and less than a metre: {lenslet_um:g} um and "
            f"{wavelength_nm:g} nm make no sense together."
        )
    step = 4e-3 * wavelength_nm / lenslet_um**2
    number = max(2, 1 + int(np.ceil((1 / z_min_um - 1 / z_max_um) / step - 1e-9)))
    return Sampling(
        number,
        f"{number} planes, at most {1e6 * step:.3g} per metre apart: 4 wavelength / p^2 with lenslets of "
        f"{lenslet_um:g} um and {wavelength_nm:g} nm (Kuo 2020, Eq. 5.10)",
    )
