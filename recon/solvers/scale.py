"""The scene's scale, from the data alone: what makes penalties independent of exposure and size."""

from __future__ import annotations

import numpy as np

from recon.base import fft
from recon.camera.base import Array
from recon.camera.convolution3d import Convolution3D
from recon.solvers.sensor_system import SensorSystem

_PLANES = 8


def expected_height(operator: Convolution3D, system: SensorSystem, data: Array) -> float:
    """Brightest voxel of the regularised back-projection ``M^H (M M^H + lambda)^-1 C^T b``.

    What the data say when no prior is asked: within a small factor of the brightest voxels of the solution.
    Looks at no more than ``_PLANES`` planes, spread over the depths.
    """
    power = operator.power()
    spectrum = system.spectrum_of(data) / (power + 0.01 * float(power.mean()))
    X = np.empty_like(spectrum)
    height = 0.0
    n_z = operator.domain_shape[1]
    for z in range(0, n_z, max(n_z // _PLANES, 1)):
        operator.transfer_plane(z, out=X)
        np.conj(X, out=X)
        X *= spectrum
        height = max(height, float(fft.irfft(X, operator.grid_shape[1]).max()))
    return height
