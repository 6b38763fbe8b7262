"""The fast ADMM against FISTA with exact proxes, a solver that shares none of its code."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.threads import get_threads, set_threads
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.priors import L1, Box, Differences, HaarTotalVariation, NonNegativity, TotalVariation, Zero
from recon.solvers import Admm, Fista, Penalties, StoppingRules, StopReason
from recon.solvers.admm import DataSplit, _energy
from recon.solvers.prior_splits import split_prior
from tests.recon.solvers.literal_admm import LiteralAdmm, circular

PRIORS = {
    "tv": TotalVariation(0.05, tolerance=1e-8) + NonNegativity(),
    "isotropic tv": TotalVariation(0.05, isotropic=True, tolerance=1e-8) + NonNegativity(),
    "free tv": TotalVariation(0.05, tolerance=1e-8),
    "tv and l1": TotalVariation(0.05, tolerance=1e-8) + L1(0.02) + NonNegativity(),
    "l1": L1(0.05) + NonNegativity(),
    "box": TotalVariation(0.01, tolerance=1e-8) + Box(0, 0.8),
}


def problem(n_channels=1, erased=False, dtype=np.float64):
    rng = np.random.default_rng(0)
    psfs = rng.random((n_channels, 7, 8)) * (rng.random((n_channels, 7, 8)) > 0.7)
    psfs[:, 3, 4] += 2
    camera = Convolution(psfs, (9, 10), dtype=dtype)
    scene = np.zeros(camera.domain_shape, dtype)
    scene[:, 5:9, 6:11] = 1
    operator = camera
    if erased:
        operator = Erasures(rng.random((n_channels, 9, 10)) > 0.4, camera.range_shape, dtype) @ camera
    noise = 0.02 * rng.standard_normal(camera.range_shape)
    return operator, (operator.forward(scene) + noise).astype(dtype)


def objective(operator, data, prior, x):
    return 0.5 * float(np.sum((operator.forward(x) - data) ** 2)) + prior.value(x)


def masked(operator, data):
    return data * operator.outer.valid if hasattr(operator, "outer") else data


def test_what_stands_at_erased_pixels_does_not_count():
    operator, data = problem(erased=True)
    prior, rules = PRIORS["tv"], StoppingRules(iterations=20, tolerance=0)
    left_out = ~np.broadcast_to(operator.outer.valid, data.shape)
    expected = Admm(operator, np.where(left_out, 0, data), prior).run(rules).solution
    for number in (np.nan, np.inf, 1e6):
        found = Admm(operator, np.where(left_out, number, data), prior).run(rules).solution
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("n_channels", "erased"), [(1, False), (2, True)])
@pytest.mark.parametrize("name", PRIORS)
def test_reaches_the_same_minimum_as_fista(name, n_channels, erased):
    operator, data = problem(n_channels, erased)
    data = masked(operator, data)
    prior = PRIORS[name]
    slow = Fista(operator, data, prior).run(StoppingRules(iterations=600, tolerance=1e-6))
    fast = Admm(operator, data, prior).run(StoppingRules(iterations=2000, tolerance=1e-9))
    expected = objective(operator, data, prior, slow.solution)
    assert objective(operator, data, prior, fast.solution) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("relax", [1.0, 1.7])
@pytest.mark.parametrize("name", ["tv", "isotropic tv", "l1", "box"])
def test_is_the_textbook_s_admm_step_by_step(name, relax):
    """Boyd et al. 2011, scaled form with over-relaxation, on dense matrices."""
    operator, data = problem(erased=True)
    data = masked(operator, data)
    tv, separable, _ = split_prior(PRIORS[name])
    camera, size = operator.inner, int(np.prod(operator.domain_shape))
    points = np.eye(size).reshape(size, *operator.domain_shape)
    M = np.stack([circular(camera, p).ravel() for p in points], axis=1)
    psi = Differences(operator.domain_shape, (1.0, 1.0), dtype=np.float64)
    Psi = np.stack([psi.forward(p).ravel() for p in points], axis=1)
    mask, b = np.zeros(operator.domain_shape), np.zeros(operator.domain_shape)
    window = (..., *camera.sensor_window)
    mask[window], b[window] = operator.outer.valid, data
    mask, b = mask.ravel(), b.ravel()
    weight = tv.weight if tv else 0.0

    def prox_u(t, mu):
        pair = t.reshape(2, -1)
        length = np.linalg.norm(pair, axis=0) if tv and tv.isotropic else np.abs(pair)
        return (pair * np.maximum(1 - weight / mu / np.maximum(length, 1e-300), 0)).ravel()

    power = float(np.mean(camera.power()))
    splits = [
        (M, 0.5, lambda t, mu: (b + mu * t) / (mask + mu)),
        (Psi, 0.8 * power, prox_u),
        (np.eye(size), 1.5 * power, lambda t, mu: separable.prox(t, 1 / mu)),
    ]
    normal = sum(mu * K.T @ K for K, mu, _ in splits)
    y = np.zeros(size)
    z = [prox(K @ y, mu) for K, mu, prox in splits]
    d = [K @ y - v for (K, _, _), v in zip(splits, z, strict=True)]
    fast = Admm(operator, data, PRIORS[name], penalties=Penalties(0.5, 0.8, 1.5), relax=relax)
    for _ in range(10):
        for i, (K, mu, prox) in enumerate(splits):
            ahead = relax * (K @ y) + (1 - relax) * z[i]
            z[i] = prox(ahead + d[i], mu)
            d[i] = d[i] + ahead - z[i]
        right = sum(mu * K.T @ (v - e) for (K, mu, _), v, e in zip(splits, z, d, strict=True))
        y = np.linalg.solve(normal, right)
        fast.step()
        assert fast._y.ravel() == pytest.approx(y, abs=1e-10)
        assert fast.solution.ravel() == pytest.approx(z[2], abs=1e-10)


@pytest.mark.parametrize("name", PRIORS)
def test_literal_algorithm_reaches_the_same_minimum(name):
    operator, data = problem(2, erased=True)
    data = masked(operator, data)
    fast = Admm(operator, data, PRIORS[name]).run(StoppingRules(iterations=2000, tolerance=1e-7))
    slow = LiteralAdmm(operator, data, PRIORS[name], (0.1, 3.0, 3.0)).run(
        StoppingRules(iterations=3000, tolerance=1e-7)
    )
    expected = objective(operator, data, PRIORS[name], slow.solution)
    assert objective(operator, data, PRIORS[name], fast.solution) == pytest.approx(expected, rel=1e-4)


def test_penalties_and_relaxation_change_the_way_not_the_goal():
    operator, data = problem()
    prior = PRIORS["tv"]
    ends = [
        Admm(operator, data, prior, penalties=p, relax=r).run(StoppingRules(iterations=5000, tolerance=1e-11))
        for p, r in ((Penalties(), 1.0), (Penalties(0.3, 5, 2), 1.8))
    ]
    values = [objective(operator, data, prior, e.solution) for e in ends]
    assert values[0] == pytest.approx(values[1], rel=1e-6)


@pytest.mark.parametrize("width", [6, 7, 9])
def test_the_energy_of_half_a_spectrum_is_that_of_its_image(width):
    image = np.random.default_rng(0).standard_normal((5, width))
    whole = np.sum(np.abs(np.fft.fft2(image)) ** 2)
    assert _energy(np.fft.rfft2(image), width) == pytest.approx(whole)


def test_float32_follows_float64():
    prior = PRIORS["tv"]
    rules = StoppingRules(iterations=500, tolerance=0)
    single, double = (Admm(*problem(dtype=d), prior).run(rules).solution for d in (np.float32, np.float64))
    assert single.dtype == np.float32
    assert np.linalg.norm(single - double) < 1e-4 * np.linalg.norm(double)


def test_does_not_depend_on_threads():
    before = get_threads()
    solutions = []
    try:
        for threads in (1, 3):
            set_threads(threads)
            solver = Admm(*problem(2, dtype=np.float32), PRIORS["isotropic tv"])
            solutions.append(solver.run(StoppingRules(iterations=30, tolerance=0)))
    finally:
        set_threads(before)
    assert np.array_equal(solutions[0].solution, solutions[1].solution)
    assert solutions[0].history[-1].objective == solutions[1].history[-1].objective


def test_records_its_state_truthfully():
    operator, data = problem()
    prior = PRIORS["tv"]
    out = Admm(operator, data, prior).run(StoppingRules(iterations=3000, tolerance=1e-10))
    x = out.solution
    assert out.history[-1].data_residual == pytest.approx(
        np.linalg.norm(operator.forward(x) - data), rel=1e-4
    )
    assert out.history[-1].objective == pytest.approx(objective(operator, data, prior, x), rel=1e-4)


def test_resumes_from_a_checkpoint_exactly():
    operator, data = problem()
    whole = Admm(operator, data, PRIORS["tv"]).run(StoppingRules(iterations=30, tolerance=0))
    first = Admm(operator, data, PRIORS["tv"])
    first.run(StoppingRules(iterations=17, tolerance=0))
    second = Admm(operator, data, PRIORS["tv"])
    second.restore(first.checkpoint())
    assert np.array_equal(second.run(StoppingRules(iterations=30, tolerance=0)).solution, whole.solution)


def test_starts_from_a_given_object():
    operator, data = problem()
    rules = StoppingRules(iterations=3000, tolerance=1e-10)
    cold = Admm(operator, data, PRIORS["tv"]).run(rules)
    warm = Admm(operator, data, PRIORS["tv"], initial=cold.solution).run(
        StoppingRules(iterations=20, tolerance=0)
    )
    zero = Admm(operator, data, PRIORS["tv"]).run(StoppingRules(iterations=20, tolerance=0))
    distance = [np.linalg.norm(o.solution - cold.solution) for o in (warm, zero)]
    assert distance[0] < 0.5 * distance[1]


@pytest.mark.parametrize("name", ["tv", "isotropic tv"])
def test_settling_a_penalty_leaves_split_and_multiplier(name):
    solver = Admm(*problem(2), PRIORS[name])
    for _ in range(6):
        solver.step()

    def split_and_multiplier():
        t = np.stack([solver._splits.tx, solver._splits.ty])
        size = np.linalg.norm(t, axis=0) if "iso" in name else np.abs(t)
        mu = solver._mu[0][:, None, None]
        u = t * np.maximum(1 - 0.05 / mu / np.maximum(size, 1e-300), 0)
        return mu.copy(), u, mu * (t - u)

    mu, u, multiplier = split_and_multiplier()
    solver._settle_differences(0.05)
    new_mu, new_u, new_multiplier = split_and_multiplier()
    assert (new_mu != mu).all()
    assert new_u == pytest.approx(u, abs=1e-12)
    assert new_multiplier == pytest.approx(multiplier, abs=1e-12)


def test_refuses_what_it_has_no_fast_way_for():
    operator, data = problem()
    with pytest.raises(TypeError, match="HaarTotalVariation"):
        Admm(operator, data, HaarTotalVariation(0.1))
    other = Erasures(np.ones((3, 3), bool), (1, 3, 3), np.float64)
    with pytest.raises(TypeError, match="Fista takes any operator"):
        Admm(other, np.zeros((1, 3, 3)), Zero())


def test_zero_data_gives_zero():
    operator, data = problem()
    out = Admm(operator, 0 * data, PRIORS["tv"]).run()
    assert out.stop_reason is StopReason.CONVERGED
    assert not out.solution.any()


@pytest.mark.parametrize("relax", [1.0, 1.6])
def test_the_sums_of_the_datas_split_are_those_of_the_whole_grid(relax):
    """Beyond the sensor, too, where nothing is transformed back: residual, what the prox leaves and takes."""
    camera, data = problem()
    rng = np.random.default_rng(5)
    split = DataSplit(camera, data, np.ones_like(data), 0.7, rng.random(camera.domain_shape), relax)
    y = rng.random(camera.grid_shape)
    split.solve(0, y, 0.3, 0.2)
    seen = np.fft.irfft2(np.fft.rfft2(y) * camera.spectrum[0, 0], camera.grid_shape)
    state, taken = (np.fft.irfft2(part[0], camera.grid_shape) for part in (split.T, split.Q))
    np.testing.assert_allclose(
        split.sums[0, [1, 3, 4]], [np.sum(a**2) for a in (seen - state + taken, state - taken, taken)]
    )
