"""The data term's system on the sensor: as a dense matrix solves it, and in few steps."""

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.solvers.splitting import SensorData, SensorSystem

SENSOR = (24, 21)
RNG = np.random.default_rng(6)
CAMERA = Convolution(RNG.random((3, 1, 9, 8)) ** 4, SENSOR, dtype=np.float64)
HOLES = RNG.random(SENSOR) > 0.15
"""Valid pixels."""


def system(valid, restraint):
    """Return a system of much curvature, and how many cosines its background has."""
    background = None
    if restraint is not None:
        background = BackgroundRemoval((1, *SENSOR), (3, 4), valid, np.float64, restraint)
    measured = SensorData(np.zeros((1, *SENSOR)), valid, background)
    made = SensorSystem(CAMERA.grid_shape, CAMERA.sensor_window, measured, dtype=np.float64)
    made.set_curvature(2 * CAMERA.power()[0] / CAMERA.power().mean())
    return made


@pytest.mark.parametrize("valid", [None, HOLES], ids=["all", "erased"])
@pytest.mark.parametrize("restraint", [None, 0.0, 1e-4, 0.3])
def test_it_is_solved_in_few_steps_as_a_dense_matrix_solves_it(valid, restraint):
    """Smooth light on pixels that nobody measured took thirty steps, which led nowhere."""
    made = system(valid, restraint)
    right = made.masked(RNG.standard_normal(SENSOR))
    units = np.eye(right.size).reshape(-1, *SENSOR)
    # Of a projection's range all data and solutions are; a restrained background's factor has no other.
    bent = [made._bend(unit if restraint else made.masked(unit.copy())) for unit in units]
    dense = np.eye(right.size) + np.stack([column.ravel() for column in bent], axis=1)
    np.testing.assert_allclose(dense, dense.T, atol=1e-12)
    exact = np.linalg.solve(dense, right.ravel()).reshape(SENSOR)
    e = np.zeros(SENSOR)
    made.solve(right, e)
    assert made.steps <= 12  # 7 to 10 found
    assert np.linalg.norm(e - exact) < 2e-4 * np.linalg.norm(exact)
    assert valid is None or not e[~valid].any()
