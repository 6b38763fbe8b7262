"""FISTA against direct solutions; the run loop's stops."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from scipy.optimize import nnls

from recon.camera.convolution import Convolution
from recon.priors import L1, NonNegativity, Zero
from recon.solvers import Fista, StoppingRules, StopReason


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    psf = rng.random((1, 4, 5)) * (rng.random((1, 4, 5)) > 0.6)
    psf[0, 1, 2] += 4
    operator = Convolution(psf, (6, 5), dtype=np.float64)
    x = np.zeros(operator.domain_shape)
    x[0, 4, 5], x[0, 6, 3] = 1, 2
    data = operator.forward(x) + 0.01 * rng.standard_normal(operator.range_shape)
    return operator, data


def columns(operator):
    eye = np.eye(int(np.prod(operator.domain_shape)))
    A = np.stack([operator.forward(c.reshape(operator.domain_shape)).ravel() for c in eye], axis=1)
    # Pixels beyond the field reach the sensor by rounding alone; NNLS would amplify that without limit.
    return np.where(np.abs(A) > 1e-12, A, 0)


@pytest.mark.parametrize("restart", ["function", "gradient", "none"])
def test_reaches_the_non_negative_least_squares_solution(problem, restart):
    operator, data = problem
    data = data + 0.3 * np.random.default_rng(1).standard_normal(data.shape)
    _, residual = nnls(columns(operator), data.ravel())
    out = Fista(operator, data, NonNegativity(), restart=restart).run(
        StoppingRules(iterations=4000, tolerance=0)
    )
    assert residual > 0.1
    assert out.history[-1].data_residual == pytest.approx(residual, rel=1e-5)
    assert out.solution.min() >= 0
    assert out.stop_reason is StopReason.ITERATIONS


def test_satisfies_the_optimality_condition_of_l1(problem):
    operator, data = problem
    weight = 0.05
    out = Fista(operator, data, L1(weight) + NonNegativity()).run(
        StoppingRules(iterations=5000, tolerance=1e-10)
    )
    x = out.solution
    gradient = operator.adjoint(operator.forward(x) - data) + weight
    assert gradient.min() > -1e-4
    assert abs(np.vdot(gradient, x)) < 1e-4
    objective = 0.5 * np.sum((operator.forward(x) - data) ** 2) + weight * x.sum()
    assert out.history[-1].objective == pytest.approx(objective)


def test_ista_descends_and_fista_is_ahead(problem):
    operator, data = problem
    rules = StoppingRules(iterations=60, tolerance=0)
    slow = Fista(operator, data, NonNegativity(), accelerate=False).run(rules)
    fast = Fista(operator, data, NonNegativity()).run(rules)
    assert (np.diff([r.objective for r in slow.history]) <= 1e-12).all()
    assert fast.history[-1].objective < slow.history[-1].objective


def test_stops_at_the_noise_level(problem):
    operator, data = problem
    out = Fista(operator, data, NonNegativity()).run(StoppingRules(noise_norm=0.5))
    assert out.stop_reason is StopReason.NOISE_LEVEL
    assert out.history[-1].data_residual <= 0.5 < out.history[-2].data_residual


def test_stops_when_nothing_changes(problem):
    operator, data = problem
    out = Fista(operator, np.zeros_like(data), Zero()).run()
    assert out.stop_reason is StopReason.CONVERGED
    assert not out.solution.any()


def test_stops_in_time_and_when_cancelled(problem):
    operator, data = problem
    out = Fista(operator, data, Zero()).run(StoppingRules(iterations=None, time_s=0.02, tolerance=0))
    assert out.stop_reason is StopReason.TIME
    cancel = threading.Event()
    out = Fista(operator, data, Zero()).run(
        callback=lambda solver, record: record.iteration == 3 and cancel.set(), cancel=cancel
    )
    assert out.stop_reason is StopReason.CANCELLED
    assert len(out.history) == 3


def test_stops_at_nan_with_a_finite_solution(problem):
    operator, data = problem
    with np.errstate(all="ignore"):
        out = Fista(operator, data, Zero(), step=1e6).run(StoppingRules(iterations=5000, tolerance=0))
    assert out.stop_reason is StopReason.NOT_FINITE
    assert np.isfinite(out.solution).all()


def test_resumes_from_a_checkpoint_exactly(problem):
    operator, data = problem
    rules = StoppingRules(iterations=20, tolerance=0)
    whole = Fista(operator, data, NonNegativity()).run(rules)
    first = Fista(operator, data, NonNegativity())
    first.run(StoppingRules(iterations=12, tolerance=0))
    state = first.checkpoint()
    first.run(StoppingRules(iterations=15, tolerance=0))
    second = Fista(operator, data, NonNegativity())
    second.restore(state)
    out = second.run(rules)
    assert second.iteration == 20
    assert np.array_equal(out.solution, whole.solution)


def test_rules_need_an_end():
    with pytest.raises(ValueError, match="needs an end"):
        StoppingRules(iterations=None, tolerance=0)


def literal(operator, data, prior, *, initial, restart, accelerate, step, iterations):
    """Beck & Teboulle 2009 with the restarts of O'Donoghue & Candès 2015, as they are written."""
    step = 1 / operator.norm_bound**2 if step is None else step
    x = before = np.zeros(operator.domain_shape) if initial is None else initial
    t, last, restarts, told = 1.0, np.inf, 0, []
    for _ in range(iterations):
        t_next = (1 + np.sqrt(1 + 4 * t**2)) / 2 if accelerate else 1.0
        y = x + (t - 1) / t_next * (x - before)
        new = prior.prox(y - step * operator.adjoint(operator.forward(y) - data), step)
        against = np.vdot(y - new, new - x) > 0
        before, x = x, new
        residual = np.linalg.norm(operator.forward(x) - data)
        objective = 0.5 * residual**2 + prior.value(x)
        again = against if restart == "gradient" else objective > last if restart == "function" else False
        t, last, restarts = 1.0 if again else t_next, objective, restarts + again
        size = np.linalg.norm(x)
        told.append((objective, residual, np.linalg.norm(x - before) / size if size else 0.0))
    return x, told, restarts


@pytest.mark.parametrize("restart", ["function", "gradient", "none"])
@pytest.mark.parametrize(
    ("accelerate", "step", "begun"), [(True, None, False), (True, 1e-3, True), (False, None, True)]
)
def test_every_iterate_is_that_of_the_papers(problem, restart, accelerate, step, begun):
    operator, data = problem
    options = {"initial": np.full(operator.domain_shape, 0.2) if begun else None, "accelerate": accelerate}
    options |= {"restart": restart, "step": step}
    prior = L1(0.02) + NonNegativity()
    x, told, restarts = literal(operator, data, prior, iterations=50, **options)
    out = Fista(operator, data, prior, **options).run(StoppingRules(iterations=50, tolerance=0))
    np.testing.assert_allclose(out.solution, x, rtol=1e-7, atol=1e-9)
    records = [(record.objective, record.data_residual, record.change) for record in out.history]
    np.testing.assert_allclose(records, told, rtol=1e-6, atol=1e-9)
    assert restarts or restart == "none" or not accelerate or step


def test_an_operator_that_sees_nothing_and_a_dark_object_divide_by_nothing(problem):
    operator, data = problem
    dark = Convolution(np.zeros((1, 4, 5)), (6, 5), dtype=np.float64)
    assert dark.norm_bound == 0
    assert Fista(dark, data, Zero()).step_length == 1.0
    assert Fista(operator, 0 * data, NonNegativity()).step().change == 0.0
