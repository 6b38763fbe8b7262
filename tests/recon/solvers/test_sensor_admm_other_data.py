"""The exact ADMM with other data, erased pixels, a background and a prior of which only the prox is known."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.filling import fill_smoothly
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures
from recon.priors import L1, Box, NonNegativity, TotalVariation
from recon.priors.base import Prior
from recon.solvers import SensorAdmm, StoppingRules
from recon.solvers.cosine_preconditioner import PicturePreconditioner

TV = TotalVariation(0.05) + NonNegativity()
ONLY_A_PROX = TotalVariation(0.05, axis_weights=(0.5, 1.0), tolerance=1e-8)
SENSOR = (9, 10)


def camera_and_data(*, erased: bool = False):
    rng = np.random.default_rng(4)
    psfs = rng.random((2, 7, 8)) * (rng.random((2, 7, 8)) > 0.7)
    psfs[:, 3, 4] += 2
    camera = Convolution(psfs, SENSOR, n_channels=2, dtype=np.float64)
    scene = np.zeros((2, *camera.domain_shape))
    scene[0, :, 5:9, 6:11], scene[1, :, 4:8, 3:9] = 1.0, 3.0
    data = [camera.forward(one) + 0.02 * rng.standard_normal(camera.range_shape) for one in scene]
    if not erased:
        return camera, data
    valid = rng.random(camera.range_shape) > 0.3
    return Erasures(valid, camera.range_shape, np.float64) @ camera, [one * valid for one in data]


def background() -> BackgroundRemoval:
    return BackgroundRemoval((2, *SENSOR), (3, 3), dtype=np.float64, restraint=0.3)


CASES = pytest.mark.parametrize(
    ("prior", "erased", "with_background"),
    [
        (TotalVariation(0.05) + Box(0.1, 2.5), True, False),
        (TV, False, True),
        (ONLY_A_PROX + L1(0.02), True, False),
    ],
)


@CASES
def test_begun_anew_with_other_data_it_is_as_if_it_were_new(prior, erased, with_background):
    operator, (first, second) = camera_and_data(erased=erased)
    options = {"background": background()} if with_background else {}
    used, new = (SensorAdmm(operator, data, prior, **options) for data in (first, second))
    for _ in range(5):  # penalties were balanced once by then
        used.advance()
    used.restart(second)
    assert used.iteration == 0
    for _ in range(5):
        records = used.advance(), new.advance()
        assert records[0].objective == pytest.approx(records[1].objective, rel=1e-9)
        np.testing.assert_allclose(used.solution, new.solution, atol=1e-9)


@pytest.mark.parametrize("erased", [False, True])
def test_other_data_stand_where_they_are_valid_and_are_continued_over_what_is_erased(erased):
    operator, (first, second) = camera_and_data(erased=erased)
    solver = SensorAdmm(operator, first, TV)
    kept = solver._y.copy(), solver._mu.copy()
    solver.set_data(second)
    expected = second.copy()
    if erased:
        for image, valid in zip(expected, operator.outer.valid, strict=True):
            fill_smoothly(image, valid.astype(float))
        assert (expected[~operator.outer.valid] > 0).all()
    np.testing.assert_array_equal(solver._data, expected)
    for before, now in zip(kept, (solver._y, solver._mu), strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.parametrize("prior", [TV, ONLY_A_PROX + L1(0.02)])
def test_the_misfit_that_is_told_is_that_of_all_channels_valid_pixels(prior):
    operator, (data, _) = camera_and_data(erased=True)
    solver = SensorAdmm(operator, data, prior)
    for _ in range(2):
        told = solver.advance().data_residual
        assert told == pytest.approx(np.linalg.norm(operator.outer.valid * solver._e), rel=1e-12)


def system(solver, camera, channel):
    """``A^H A + mu_u Psi^T Psi + mu_w`` of a channel's object, splits of the object in ``mu_w``."""
    mu_u = solver._mu[0, channel]
    mu_w = solver._mu[1, channel] + sum(other.mu for other in solver._splits.others)

    def applied(y):
        psi = sum(2 * y - np.roll(y, 1, axis) - np.roll(y, -1, axis) for axis in (0, 1))
        stack = np.zeros(camera.domain_shape)
        stack[channel] = y
        return camera.adjoint(camera.forward(stack))[channel] + mu_u * psi + mu_w * y

    return applied


@pytest.mark.parametrize(("prior", "removed"), [(ONLY_A_PROX + L1(0.02), False), (TV, True)])
def test_the_object_solves_its_quadratic_problem_of_what_a_background_leaves(prior, removed):
    """``W A y = W b`` in the sense of least squares; other splits' penalties count as the pixels' own."""
    camera, (data, other) = camera_and_data()
    removal = background() if removed else None
    solver = SensorAdmm(camera, other, prior, data_steps=60, background=removal)
    solver.advance()
    if removal:
        removal.restrain(0.05)
    solver.set_data(data)
    seen, left = (removal @ camera, removal.forward(data)) if removal else (camera, data)
    right = solver._y.copy()
    misfit = sum(solver._solve(channel, 60) for channel in (0, 1))
    for channel in (0, 1):
        expected = seen.adjoint(left)[channel] + right[channel]
        applied = system(solver, seen, channel)(solver._y[channel])
        np.testing.assert_allclose(applied, expected, atol=1e-7 * np.abs(expected).max())
    assert misfit == pytest.approx(np.sum((left - seen.forward(solver._y)) ** 2), rel=1e-6)


def test_a_background_that_takes_another_share_has_the_preconditioners_told():
    """As after a run's first solution, whose light says how much a background may take."""
    camera, (data, _) = camera_and_data()
    removal = background()
    solver = SensorAdmm(camera, data, TV, background=removal)
    removal.restrain(0.01)
    solver.set_data(data)
    image = np.random.default_rng(0).standard_normal(SENSOR)
    told = PicturePreconditioner(camera.power()[1], camera.grid_shape, SENSOR)
    told.weigh((3, 3), np.sqrt(0.01 / 1.01))  # what is left of the smooth part
    told.set_penalties(*solver._mu[:, 1])
    images = [of.apply(image, np.empty(SENSOR)).copy() for of in (solver._preconditioners[1], told)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-9)
    assert solver._adapted_to == removal.taken


def test_the_gradient_that_sets_pixels_penalties_is_of_what_a_background_leaves(monkeypatch):
    camera, (data, _) = camera_and_data()
    removal = background()
    solver = SensorAdmm(camera, data, TV, background=removal)
    for _ in range(12):
        solver.advance()
    monkeypatch.setattr(solver._splits, "balanced_penalties", lambda: solver._mu.copy())
    w, seen = solver.solution, removal @ camera
    gradient = seen.adjoint(seen.forward(w) - removal.forward(data))
    found = solver._balanced_penalties()[1]
    for channel in (0, 1):
        multiplier = solver._mu[1, channel] * np.linalg.norm(solver._splits.t_w[channel] - w[channel])
        slope = np.linalg.norm(gradient[channel])
        expected = np.sqrt(multiplier * slope) / np.linalg.norm(w[channel])
        assert solver._mu[1, channel] / 100 < expected < solver._mu[1, channel] * 100
        assert found[channel] == pytest.approx(max(expected, 0.03 * solver._mu[0, channel]), rel=1e-9)


def test_object_and_multipliers_move_and_what_is_left_of_the_data_stays():
    camera, (data, _) = camera_and_data()
    solver = SensorAdmm(camera, data, TV)
    for _ in range(4):
        solver.advance()
    solution, left = solver.solution, solver._e.copy()
    solver.move(2, -1)
    np.testing.assert_allclose(solver.solution, np.roll(solution, (2, -1), axis=(1, 2)), atol=1e-9)
    np.testing.assert_array_equal(solver._e, left)


class Opaque(Prior):
    """A prior of which a solver knows no more than of a user's own."""

    def __init__(self, prior: Prior) -> None:
        self.prior = prior

    def value(self, x):
        return self.prior.value(x)

    def prox(self, x, step):
        return self.prior.prox(x, step)


@pytest.mark.parametrize("beside", [None, NonNegativity()])
def test_a_prior_known_by_its_prox_has_the_minimum_of_the_same_prior_in_the_sweep(beside):
    operator, (data, _) = camera_and_data(erased=True)
    known = L1(0.05) + NonNegativity()
    ends = [
        SensorAdmm(operator, data, prior).run(StoppingRules(iterations=250, tolerance=1e-7))
        for prior in (known, Opaque(known) if beside is None else Opaque(known) + beside)
    ]
    np.testing.assert_allclose(ends[1].solution, ends[0].solution, atol=3e-3 * ends[0].solution.max())
    assert ends[1].history[-1].objective == pytest.approx(ends[0].history[-1].objective, rel=1e-4)
