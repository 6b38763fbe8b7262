"""The data term's system on the sensor: as a dense matrix solves it, and in few steps."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

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
    made.set_scale(2.0)
    made.set_curvature(CAMERA.power()[0] / CAMERA.power().mean())
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
    if not restraint:
        np.testing.assert_allclose(made.masked(e.copy()), e, atol=1e-12)  # as the data are


@pytest.mark.parametrize("restraint", [None, 0.0, 1e-2, 0.3])
def test_a_diffusers_bright_low_frequencies_take_few_steps(restraint):
    """They have ten thousand times the power of the others; wrapped around they took 16 to 28 steps."""
    sensor, rng = (60, 72), np.random.default_rng(0)
    camera = Convolution(gaussian_filter(rng.random(sensor) ** 4, 1.0)[None], sensor, dtype=np.float64)
    background = None
    if restraint is not None:
        background = BackgroundRemoval((1, *sensor), (5, 5), None, np.float64, restraint)
    measured = SensorData(np.zeros((1, *sensor)), None, background)
    made = SensorSystem(camera.grid_shape, camera.sensor_window, measured, dtype=np.float64)
    made.set_curvature(camera.power()[0] / camera.power().mean())
    made.set_scale(5.0)
    right = made.masked(rng.standard_normal(sensor) + 50 + np.linspace(0, 30, sensor[1]))
    e = np.zeros(sensor)
    made.solve(right, e)
    assert made.steps <= 10  # 6 to 9 found
    assert np.linalg.norm(right - e - made._bend(e)) <= 1.01e-4 * np.linalg.norm(right)


def test_the_preconditioner_follows_a_background_whose_restraint_changes():
    background = BackgroundRemoval((1, *SENSOR), (3, 4), None, np.float64, 1e-3)
    measured = SensorData(np.zeros((1, *SENSOR)), None, background)
    made = SensorSystem(CAMERA.grid_shape, CAMERA.sensor_window, measured, dtype=np.float64)
    made.set_curvature(CAMERA.power()[0] / CAMERA.power().mean())
    made.set_scale(200.0)
    right = RNG.standard_normal(SENSOR) + 20
    for restraint in (1e-3, 0.3):
        background.restrain(restraint)
        made.set_background(background)
        made.solve(right, e := np.zeros(SENSOR))
        assert made.steps <= 10  # 9 and 7 found, 18 where it stays as it was
        assert np.linalg.norm(right - e - made._bend(e)) <= 1.01e-4 * np.linalg.norm(right)


def test_no_more_steps_are_taken_than_are_allowed():
    made = system(None, None)
    made.tolerance, made.max_steps = 1e-14, 3
    made.solve(RNG.standard_normal(SENSOR), np.zeros(SENSOR))
    assert made.steps == 3


def test_what_is_solved_already_takes_no_step():
    made = system(None, None)
    made.solve(np.zeros(SENSOR), e := np.zeros(SENSOR))
    assert made.steps == 0
    made.tolerance, made.max_steps = 0.0, 1000  # less than the arithmetic can tell
    made.solve(RNG.standard_normal(SENSOR), e)
    assert made.steps < 1000
    made.solve(np.full(SENSOR, np.inf), e)
    assert np.isnan(e).all()


def test_a_camera_that_is_no_convolution_is_preconditioned_by_its_central_one():
    measured = SensorData(np.zeros((1, *SENSOR)), HOLES, None)
    central = system(HOLES, None)
    made = SensorSystem(
        CAMERA.grid_shape,
        CAMERA.sensor_window,
        measured,
        dtype=np.float64,
        bend=lambda e: central._bend(e) * 1.1,
    )
    for one in (central, made):
        one.set_scale(5.0)
    made.set_curvature(CAMERA.power()[0] / CAMERA.power().mean())
    right = made.masked(RNG.standard_normal(SENSOR))
    made.solve(right, e := np.zeros(SENSOR))
    assert made.steps <= 12  # 10 found, 30 and no end with the inverse turned over
    assert np.linalg.norm(right - e - made._bend(e)) <= 1.01e-4 * np.linalg.norm(right)


@pytest.mark.parametrize("restraint", [None, 0.0, 0.3])
def test_there_the_inverse_is_that_of_a_sensor_that_covers_half_the_grid(restraint):
    background = None
    if restraint is not None:
        background = BackgroundRemoval((1, *SENSOR), (3, 4), None, np.float64, restraint)
    measured = SensorData(np.zeros((1, *SENSOR)), None, background)
    made = SensorSystem(CAMERA.grid_shape, CAMERA.sensor_window, measured, dtype=np.float64, bend=lambda e: e)
    q = CAMERA.power()[0] / CAMERA.power().mean()
    made.set_curvature(q)
    made.set_scale(5.0)
    made._adapt()
    residual = RNG.standard_normal(SENSOR)
    spread = np.zeros(CAMERA.grid_shape)
    weigh = system(None, restraint).masked if restraint else np.array
    spread[CAMERA.sensor_window] = weigh(residual.copy())
    spread = np.fft.irfft2(np.fft.rfft2(spread) / (1 + 5.0 / 2 * q), CAMERA.grid_shape)
    expected = system(None, restraint).masked(spread[CAMERA.sensor_window].copy())
    if restraint:  # smooth light is its own inverse
        expected += residual - system(None, restraint).masked(residual.copy())
    np.testing.assert_allclose(made._preconditioned(residual), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("progress", "tolerance"), [(1.0, 1e-4), (4e-3, 8e-5), (1e-6, 2e-8), (0.0, 2.22e-15)]
)
def test_the_system_is_solved_ahead_of_the_solver_around_it(progress, tolerance):
    made = system(None, None)
    made.follow(progress)
    assert made.tolerance == pytest.approx(tolerance, rel=1e-3, abs=0)  # its own least is 1e-12
