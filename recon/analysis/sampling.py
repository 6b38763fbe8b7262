"""How densely to calibrate and to reconstruct (Kuo 2020, Eqs. 4.7, 5.8-5.10, secs. 4.4 and 5.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

SPECTRUM_LEVEL = 0.01
"""Share of the fall-off's spectrum at which it is taken to end. With it the microscope of Ch. 6 (sigma 13
degrees, nearest objects at 1.7 mm) needs a PSF every 0.4 mm, as the dissertation says."""
MOST_PLANES = 512


def lateral_spacing_um(
    response: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]],
    z_um: float,
    *,
    level: float = SPECTRUM_LEVEL,
) -> float:
    """Spacing of calibration points that samples the angular fall-off at Nyquist's rate (Eqs. 5.8, 5.9).

    The registered fall-off is ``f(atan(x / z))``; its spectrum is computed numerically and cut where it is
    below ``level`` of its value at zero from there on.

    Parameters
    ----------
    response : callable
        ``f`` of angles in radians, 0 on the axis, even.
    z_um : float
        Depth; the nearest one asks for the densest points.
    """
    if not z_um > 0:
        raise InputError(f"The depth is above 0, not {z_um:g} um.")
    n = 1 << 15
    tangents = np.linspace(-40.0, 40.0, n, endpoint=False)
    step = tangents[1] - tangents[0]
    values = np.asarray(response(np.arctan(np.abs(tangents))), np.float64)
    # A response that does not vanish sideways has a constant part, which needs no sampling.
    values = values - float(response(np.array([np.pi / 2]))[0])
    spectrum = np.abs(np.fft.rfft(values))
    if spectrum[0] <= 0:
        return float("inf")
    above = np.flatnonzero(spectrum > level * spectrum[0])
    highest = (int(above[-1]) + 1) / (n * step)
    return float(z_um / (2 * highest))


def gaussian_response(
    sigma_deg: float,
) -> Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]:
    """Return a Gaussian angular response (Fig. 5.3a: 13 degrees)."""
    sigma = np.deg2rad(sigma_deg)

    def response(angles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(np.exp(-0.5 * (angles / sigma) ** 2))

    return response


def axial_spacing_per_um(lenslet_um: float, wavelength_um: float) -> float:
    """Difference in 1/z between calibration planes of a microlens diffuser: ``4 lambda / p^2`` (Eq. 5.10)."""
    if min(lenslet_um, wavelength_um) <= 0:
        raise InputError("Lenslet and wavelength are positive.")
    return 4 * wavelength_um / lenslet_um**2


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """A grid that samples the resolution twice: fine where the camera is sharp, coarse where it is not.

    Attributes
    ----------
    binning : int
        Sensor pixels to bin so that two binned pixels are one resolved step, at least 1.
    lateral_px : float
        Voxel size on the sensor, in the calibration's pixels (equal to ``binning``).
    z_um : tuple of float
        Depth planes, nearest first: evenly spaced in 1/z (Eq. 4.7).
    lateral_um : tuple of float
        Voxel size at each plane, in the object.
    complete : bool
        False where more than :data:`MOST_PLANES` would be needed and the list was cut.
    """

    binning: int
    lateral_px: float
    z_um: tuple[float, ...]
    lateral_um: tuple[float, ...]
    complete: bool = True


def voxel_grid(
    *,
    resolution_px: float,
    step_per_um: float,
    z_range_um: tuple[float, float],
    pitch_um: float,
    distance_um: float,
) -> VoxelGrid:
    """Recommend voxels that sample lateral and axial resolution at Nyquist's rate (sec. 4.4, Fig. 4.3d).

    Parameters
    ----------
    resolution_px : float
        Lateral two-point resolution on the sensor.
    step_per_um : float
        Axial two-point resolution, ``c`` of Eq. 4.7.
    z_range_um : (float, float)
        Nearest and farthest depth wanted.
    """
    near, far = z_range_um
    if not 0 < near <= far:
        raise InputError(f"Depths run from near to far, above 0, not from {near:g} to {far:g} um.")
    binning = max(1, int(resolution_px / 2))
    # Beyond the hyperfocal distance 1/step one more plane would tell nothing new.
    span = 1 / near - 1 / far
    needed = 1 + int(np.ceil(span / (step_per_um / 2) - 1e-9)) if np.isfinite(step_per_um) else 1
    count = min(max(needed, 1), MOST_PLANES)
    inverse = np.linspace(1 / near, 1 / near - (count - 1) * min(step_per_um / 2, span), count)
    if needed <= MOST_PLANES:
        inverse = np.linspace(1 / near, 1 / far, count)
    depths = tuple(float(1 / v) for v in inverse)
    voxel_um = binning * pitch_um / distance_um
    return VoxelGrid(binning, float(binning), depths, tuple(voxel_um * z for z in depths), needed == count)
