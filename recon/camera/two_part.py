"""The two-part model: the pattern times the sensor's angular response (Kuo 2020, Eqs. 5.1 and 5.8)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.camera.base import Array
from recon.camera.local_convolution import FieldOfPsfs
from recon.optics.fall_off import FallOff


def two_part_field(
    psf: Array,
    points: npt.ArrayLike,
    fall_off: FallOff,
    *,
    pitch_um: float,
    z_um: float,
    distance_um: float,
) -> FieldOfPsfs:
    """Synthesise the registered PSFs of one depth from the on-axis PSF and the sensor's angular response.

    A source at object pixel ``p`` lies at ``x = -p pitch z / d`` and casts the pattern shifted by ``p``;
    sensor pixel ``u`` sees it under ``tan(theta) = (u pitch - x) / (d + z)``. Registered, pixel ``v`` of the
    pattern is sensor pixel ``v + p``, so the response moves across the pattern (Eq. 5.8).

    Parameters
    ----------
    psf : ndarray, (n_channels, height, width)
        On-axis PSF. The axis' own response is divided out where it is above a thousandth.
    points : array, (n_points, 2)
        ``(row, column)`` of the places to synthesise, in object pixels from the axis.
    fall_off : callable
        Response as a function of the tangents of the angles along y and x (see :mod:`recon.optics.fall_off`).
    pitch_um, z_um, distance_um : float
        Sensor pitch, depth of the plane in front of the diffuser, distance from diffuser to sensor.
    """
    places = np.asarray(points, np.float64)
    height, width = psf.shape[-2:]
    v, w = np.arange(height) - height // 2, np.arange(width) - width // 2
    depth = distance_um + z_um
    stretch = pitch_um * z_um / distance_um

    def response(row: float, column: float) -> npt.NDArray[np.float64]:
        tan_y = ((v + row) * pitch_um + row * stretch) / depth
        tan_x = ((w + column) * pitch_um + column * stretch) / depth
        seen: npt.NDArray[np.float64] = np.asarray(fall_off(tan_y[:, None], tan_x[None, :]), np.float64)
        return np.broadcast_to(seen, (height, width))

    axis = np.maximum(response(0.0, 0.0), 1e-3)
    psfs = np.stack([psf * (response(row, column) / axis) for row, column in places])
    return FieldOfPsfs(psfs.astype(psf.dtype), places)
