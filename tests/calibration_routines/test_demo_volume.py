"""Lights in a volume are found where they are, and said to be elsewhere when they are."""

from __future__ import annotations

import numpy as np

from calibration_routines.demos.volume import Lights
from recon import Calibration, Geometry
from recon.reconstruction.result import Grid, Reconstruction
from recon.solvers.base import StopReason

Z_UM = (100e3, 120e3, 150e3, 200e3, 300e3)
LIGHTS = Lights(9, Z_UM, (0.05, 0.08))


def _volume(shift: float) -> tuple[Reconstruction, Calibration]:
    """Return the lights as points, between planes by their share of each, ``shift`` planes off."""
    calibration = Calibration(
        np.ones((5, 1, 8, 8), np.float32),
        np.array([[0, 0, z] for z in Z_UM], np.float64),
        geometry=Geometry(20.0, 10.0, None),
    )
    grid = Grid((5, 101, 141), (50, 70), np.array(Z_UM), np.array(Z_UM) * 2e-3, 20.0)
    volume = np.zeros(grid.shape, np.float32)
    for x, y, z in LIGHTS.positions_um():
        plane = 4 * (1 / Z_UM[0] - 1 / z) / (1 / Z_UM[0] - 1 / Z_UM[-1]) + shift
        plane = float(np.clip(plane, 0, 4))
        row, column = (round(centre - at / z * 10e3 / 20.0) for centre, at in ((50, y), (70, x)))
        below = min(int(plane), 3)
        volume[below, row, column] += below + 1 - plane
        volume[below + 1, row, column] += plane - below
    solved = Reconstruction(
        volume, grid, "convolution", "", "admm", "l1", None, 1.0, (), ((),), (StopReason.CONVERGED,), 0.0
    )
    return solved, calibration


def test_lights_are_counted_where_they_are_and_not_a_plane_away() -> None:
    right = LIGHTS.placed(*_volume(0.0))
    assert right.in_plane == LIGHTS.count
    np.testing.assert_allclose(right.found, right.planes, atol=0.02)
    assert LIGHTS.placed(*_volume(1.0)).in_plane < LIGHTS.count / 3
    dark, calibration = _volume(0.0)
    dark.volume[:] = 0
    assert LIGHTS.placed(dark, calibration).in_plane == 0
