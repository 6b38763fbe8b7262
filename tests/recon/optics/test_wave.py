"""Point spread functions against the laws of physics."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from recon.optics.diffuser import smooth_diffuser
from recon.optics.grid import PixelGrid
from recon.optics.spectrum import GREEN
from recon.optics.wave import WavePropagator

DISTANCE_UM = 8900.0
LIGHT = GREEN.samples(1)
GRID = PixelGrid((240, 320), 13.0)


@pytest.fixture(scope="module")
def propagator() -> WavePropagator:
    return WavePropagator(smooth_diffuser((1500.0, 2000.0), 5.0, seed=3), DISTANCE_UM)


def centroid(image: npt.NDArray[np.float32], grid: PixelGrid) -> npt.NDArray[np.float64]:
    total = image.sum(dtype=np.float64)
    return np.array([(image.sum(axis=0) * grid.x_um).sum(), (image.sum(axis=1) * grid.y_um).sum()]) / total


@pytest.mark.parametrize("shift_um", [(2000.0, 0.0), (0.0, -3137.0), (1234.5, 777.0)])
def test_psf_moves_against_the_source_by_d_over_z(
    propagator: WavePropagator, shift_um: tuple[float, float]
) -> None:
    z = 60e3
    here = centroid(propagator.psf((0.0, 0.0, z), GRID, LIGHT), GRID)
    there = centroid(propagator.psf((*shift_um, z), GRID, LIGHT), GRID)
    expected = -np.array(shift_um) * DISTANCE_UM / z
    np.testing.assert_allclose(
        there - here, expected, atol=0.02 * GRID.pitch_um + 2e-3 * np.abs(expected).max()
    )
