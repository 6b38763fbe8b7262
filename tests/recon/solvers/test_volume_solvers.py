"""The fast volume solvers against slow and plain ones, on small problems."""

import threading

import numba
import numpy as np
import pytest

from recon.base import threads
from recon.camera.convolution import Convolution
from recon.priors import L1, NonNegativity, TotalVariation
from recon.solvers import Fista, StoppingRules, StopReason
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.splitting import Room, SensorData, Tuning
from recon.solvers.tv_admm_volume import LeanTotalVariation
from tests.recon.solvers.literal_volume import LiteralAdmm

LONG = StoppingRules(iterations=3000, tolerance=1e-7)


def problem(n_z=5, psf=(10, 9), sensor=(12, 11), dtype=np.float64, seed=0):
    """PSFs of both signs: without a dominating mean, plain methods converge as well."""
    rng = np.random.default_rng(seed)
    psfs = rng.standard_normal((n_z, 1, *psf)) + 0.2
    operator = Convolution(psfs.astype(dtype), sensor, dtype=dtype)
    x = np.zeros(operator.domain_shape, dtype)
    x[0, n_z // 2, 3:7, 4:7] = 1
    x[0, min(1, n_z - 1), 5:8, 2:6] += 2
    data = operator.forward(x)
    data += 0.01 * data.std() * rng.standard_normal(data.shape).astype(dtype)
    return operator, data


def tau(operator, data, relative):
    return relative * float(np.abs(operator.adjoint(data)).max())


def differences(x, weights):
    """Neumann in depth, circular in the plane, as the solver has it."""
    dz = np.zeros_like(x)
    dz[:-1] = np.diff(x, axis=0)
    d = np.stack([dz, np.roll(x, -1, 1) - x, np.roll(x, -1, 2) - x])
    return np.moveaxis(weights, -1, 0)[:, :, None, None] * d


def differences_adjoint(u, weights):
    u = np.moveaxis(weights, -1, 0)[:, :, None, None] * u
    r = np.roll(u[1], 1, 1) - u[1] + np.roll(u[2], 1, 2) - u[2]
    r[:-1] -= u[0, :-1]
    r[1:] += u[0, :-1]
    return r


def objective(operator, data, weight, weights, isotropic, x, valid=1.0):
    d = differences(x[0], weights)
    tv = np.sqrt((d**2).sum(axis=0)).sum() if isotropic else np.abs(d).sum()
    return 0.5 * np.sum(valid * (operator.forward(x) - data) ** 2) + weight * tv


def dense_minimiser(operator, data, weight, weights, isotropic, valid, iterations=3000):
    """ADMM with brute-force matrices, one penalty and nothing clever."""
    shape = operator.domain_shape
    unit = np.eye(int(np.prod(shape))).reshape(-1, *shape)
    A = np.stack([(valid * operator.forward(e)).ravel() for e in unit], axis=1)
    K = np.concatenate(
        [np.stack([differences(e[0], weights).ravel() for e in unit], axis=1), np.eye(len(unit))]
    )
    rho = weight * 10
    inverse = np.linalg.inv(A.T @ A + rho * K.T @ K)
    u = np.zeros(len(K))
    y = np.zeros(len(K))
    n = len(unit)
    back = A.T @ (valid * data).ravel()
    for _ in range(iterations):
        x = inverse @ (back + rho * K.T @ (u - y))
        s = K @ x + y
        d = s[:-n].reshape(3, n)
        size = np.sqrt((d**2).sum(axis=0)) if isotropic else np.abs(d)
        u = np.concatenate(
            [(d * np.maximum(1 - weight / rho / np.maximum(size, 1e-30), 0)).ravel(), np.maximum(s[-n:], 0)]
        )
        y = s - u
    return u[-n:].reshape(shape)


def tv(weight, **options):
    return TotalVariation.of_volume(weight, **options) + NonNegativity()


def l1(weight):
    return L1(weight) + NonNegativity()


@pytest.mark.parametrize("isotropic", [False, True], ids=["anisotropic", "isotropic"])
@pytest.mark.parametrize("erased", [0.0, 0.4])
def test_lean_tv_reaches_the_minimiser(isotropic, erased):
    operator, data = problem(3, (5, 4), (5, 6))
    weight = tau(operator, data, 0.01)
    weights = np.outer(np.linspace(0.5, 1.0, 3), [0.6, 1.0, 1.3])
    valid = np.random.default_rng(1).random(operator.sensor_shape) >= erased
    expected = dense_minimiser(operator, data, weight, weights, isotropic, valid)
    solver = LeanTotalVariation(
        operator, SensorData(data, valid), tv(weight, axis_weights=weights, isotropic=isotropic)
    )
    found = solver.run(LONG).solution
    values = [objective(operator, data, weight, weights, isotropic, x, valid) for x in (found, expected)]
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("n_z", [1, 4])
def test_lean_tv_reaches_the_minimiser_of_the_literal_admm(n_z):
    """Without a weight in depth, where the literal one wraps around."""
    operator, data = problem(n_z)
    weight = tau(operator, data, 0.005)
    weights = np.tile([0.0, 1.0, 1.0], (n_z, 1))
    found = LeanTotalVariation(operator, data, tv(weight, axis_weights=weights)).run(LONG).solution
    mu = 10 * weight / found.max()
    literal = LiteralAdmm(operator, data, weight, axis_weights=(0, 1, 1), penalties=(0.03, mu, mu))
    expected = literal.run(StoppingRules(iterations=4000, tolerance=0)).solution
    values = [objective(operator, data, weight, weights, False, x) for x in (found, expected)]
    assert values[0] == pytest.approx(values[1], rel=1e-4)


@pytest.mark.parametrize("other", ["FISTA", "literal ADMM"])
def test_douglas_rachford_reaches_the_same_minimiser(other):
    operator, data = problem()
    weight = tau(operator, data, 0.02)
    prior = L1(weight) + NonNegativity()
    solver = SparseDouglasRachford(operator, data, l1(weight))
    found = solver.run(LONG).solution
    if other == "FISTA":
        reference = Fista(operator, data, prior).run(StoppingRules(iterations=20000, tolerance=1e-9))
    else:
        penalties = (0.03, weight / found.max(), weight / found.max())
        literal = LiteralAdmm(operator, data, weight, axis_weights=None, penalties=penalties)
        reference = literal.run(StoppingRules(iterations=4000, tolerance=0))

    def value(x):
        return 0.5 * np.sum((operator.forward(x) - data) ** 2) + prior.value(x)

    assert value(found) == pytest.approx(value(reference.solution), rel=1e-4)


def solvers(dtype=np.float64):
    operator, data = problem(dtype=dtype)
    weight = tau(operator, data, 0.01)
    yield lambda **options: LeanTotalVariation(operator, data, tv(weight), **options)
    yield lambda **options: LeanTotalVariation(operator, data, tv(weight, isotropic=True), **options)
    yield lambda **options: SparseDouglasRachford(operator, data, l1(weight), **options)


KINDS = pytest.mark.parametrize("kind", [0, 1, 2], ids=["TV", "isotropic TV", "l1"])


@KINDS
def test_single_precision_does_not_drift(kind):
    rules = StoppingRules(iterations=500, tolerance=0)
    single, double = (list(solvers(d))[kind]().run(rules).solution for d in (np.float32, np.float64))
    assert single.dtype == np.float32
    assert np.linalg.norm(single - double) < 5e-3 * np.linalg.norm(double)


@KINDS
def test_threads_do_not_change_a_bit(kind):
    before = threads.get_threads()
    results = []
    try:
        for n in (1, 2, 5):
            threads.set_threads(n)
            results.append(list(solvers())[kind]().run(StoppingRules(iterations=7, tolerance=0)).solution)
    finally:
        threads.set_threads(before)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


@pytest.mark.parametrize("kind", [DouglasRachford, SparseDouglasRachford, LeanTotalVariation])
def test_numbers_do_not_depend_on_units(kind):
    operator, data = problem()
    weight = tau(operator, data, 0.02)
    plain, small = (
        kind(operator, unit * data, (tv if kind is LeanTotalVariation else l1)(unit * weight)).run(
            StoppingRules(iterations=12, tolerance=0)
        )
        for unit in (1.0, 1e-6)
    )
    np.testing.assert_allclose(1e6 * small.solution, plain.solution, atol=1e-6 * plain.solution.max())
    for one, other in zip(plain.history, small.history, strict=True):
        assert other.primal_residual == pytest.approx(one.primal_residual, rel=1e-5)
        assert other.change == pytest.approx(one.change, rel=1e-5)
        assert 1e12 * other.objective == pytest.approx(one.objective, rel=1e-5)


@KINDS
def test_goes_on_from_a_checkpoint(kind):
    make = list(solvers())[kind]
    whole, first, second = make(), make(), make()
    whole.run(StoppingRules(iterations=12, tolerance=0))
    first.run(StoppingRules(iterations=5, tolerance=0))
    second.restore(first.checkpoint())
    while second.iteration < 12:
        second.step()
        second.iteration += 1
    np.testing.assert_array_equal(second.solution, whole.solution)


@KINDS
def test_warm_start_starts_ahead(kind):
    make = list(solvers())[kind]
    converged = make().run(LONG).solution
    few = StoppingRules(iterations=8, tolerance=0)
    cold, warm = make().run(few).solution, make(initial=converged).run(few).solution
    assert np.linalg.norm(warm - converged) < 0.7 * np.linalg.norm(cold - converged)


@KINDS
def test_stops_on_nan_and_on_request(kind):
    operator, data = problem()
    bad = data.copy()
    bad[0, 3, 3] = np.nan
    kinds = (
        lambda d: LeanTotalVariation(operator, d, tv(1.0)),
        lambda d: LeanTotalVariation(operator, d, tv(1.0, isotropic=True)),
        lambda d: SparseDouglasRachford(operator, d, l1(1.0)),
    )
    lost = kinds[kind](bad).run(StoppingRules(iterations=20))
    assert lost.stop_reason is StopReason.NOT_FINITE
    assert len(lost.history) <= 2
    assert not lost.solution.any()
    cancel = threading.Event()
    stopped = kinds[kind](data).run(cancel=cancel, callback=lambda *_: cancel.set())
    assert stopped.stop_reason is StopReason.CANCELLED
    assert len(stopped.history) == 1


@KINDS
def test_result_without_kept_state_is_the_same(kind):
    make = list(solvers())[kind]
    rules = StoppingRules(iterations=6, tolerance=0)
    np.testing.assert_array_equal(
        make(room=Room(keep_state=False)).run(rules).solution, make().run(rules).solution
    )


def test_total_variation_leaves_what_is_empty_at_zero():
    operator, data = problem()
    solver = LeanTotalVariation(operator, data, tv(tau(operator, data, 0.02)))
    found = solver.run(StoppingRules(iterations=40, tolerance=0)).solution
    assert found.max() > 0.5
    # Not the x of the data term, which is nowhere exactly zero.
    assert 0.3 < np.mean(found == 0) < 1


def test_total_variation_begins_at_its_start():
    operator, data = problem()
    start = np.random.default_rng(5).standard_normal(operator.domain_shape)
    solver = LeanTotalVariation(operator, data, tv(1.0), initial=start)
    np.testing.assert_array_equal(solver.solution, np.maximum(start, 0))


def test_kernels_are_compiled_once_for_weights_of_all_planes_and_of_each():
    operator, data = problem()
    solvers = [
        LeanTotalVariation(operator, data, tv(0.1, axis_weights=w)) for w in (np.ones(3), np.ones((5, 3)))
    ]
    assert numba.typeof(solvers[0].axis_weights) == numba.typeof(solvers[1].axis_weights)


def test_residual_is_that_of_the_solution():
    operator, data = problem()
    solver = SparseDouglasRachford(operator, data, l1(tau(operator, data, 0.01)))
    outcome = solver.run(LONG)
    residual = np.linalg.norm(operator.forward(outcome.solution) - data)
    assert outcome.history[-1].data_residual == pytest.approx(residual, rel=1e-4)


def thin_scene(n_z=12):
    """Light in two planes of a dozen only."""
    rng = np.random.default_rng(3)
    psfs = rng.standard_normal((n_z, 1, 12, 12)) + 0.2
    operator = Convolution(psfs, (14, 14), dtype=np.float64)
    x = np.zeros(operator.domain_shape)
    x[0, 3, 10:13, 9], x[0, 8, 12, 12] = 1.0, 2.0
    data = operator.forward(x)
    data += 0.01 * data.std() * rng.standard_normal(data.shape)
    return operator, data, tau(operator, data, 0.05)


def test_empty_planes_are_left_out_with_a_certificate():
    operator, data, weight = thin_scene()
    rules = StoppingRules(iterations=3000, tolerance=1e-6)
    solver = SparseDouglasRachford(operator, data, l1(weight))
    whole = SparseDouglasRachford(operator, data, l1(weight), tuning=Tuning(drop_empty=False))
    found, expected = solver.run(rules), whole.run(rules)
    assert found.stop_reason is StopReason.CONVERGED
    assert len(solver.empty.planes) >= 8
    assert solver.empty.certified
    assert not whole.empty.planes
    np.testing.assert_allclose(found.solution, expected.solution, atol=1e-3 * expected.solution.max())
    # The certificate, worked out from the solution alone.
    correlation = operator.adjoint(data - operator.forward(found.solution))[0]
    left_out = list(solver.empty.planes)
    assert correlation[left_out].max() == pytest.approx(solver.empty.worst * weight, rel=1e-3)
    assert correlation[left_out].max() <= 1.01 * weight


def test_a_plane_left_out_by_mistake_comes_back():
    operator, data, weight = thin_scene()
    solver = SparseDouglasRachford(operator, data, l1(weight))
    solver.watch.active[[2, 3, 5]] = False
    solver._regroup()
    outcome = solver.run(StoppingRules(iterations=3000, tolerance=1e-6))
    expected = SparseDouglasRachford(operator, data, l1(weight), tuning=Tuning(drop_empty=False))
    best = expected.run(StoppingRules(iterations=3000, tolerance=1e-6)).solution
    assert 3 not in solver.empty.planes
    np.testing.assert_allclose(outcome.solution, best, atol=1e-3 * best.max())


def test_a_run_cut_short_says_that_nothing_is_certain():
    operator, data, weight = thin_scene()
    solver = SparseDouglasRachford(operator, data, l1(weight))
    solver.watch.active[3] = False
    solver._regroup()
    solver.run(StoppingRules(iterations=1))
    assert solver.empty.planes == (3,)
    assert solver.empty.worst > 1.5
    assert not solver.empty.certified


def test_planes_left_out_are_part_of_the_checkpoint():
    operator, data, weight = thin_scene()
    whole, first, second = (SparseDouglasRachford(operator, data, l1(weight)) for _ in range(3))
    whole.run(StoppingRules(iterations=60, tolerance=0))
    first.run(StoppingRules(iterations=45, tolerance=0))
    assert not first.watch.active.all()
    second.restore(first.checkpoint())
    while second.iteration < 60:
        second.step()
        second.iteration += 1
    np.testing.assert_array_equal(second.solution, whole.solution)
