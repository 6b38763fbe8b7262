"""What the residual says at the end of a run."""

from __future__ import annotations

import numpy as np
import pytest

from recon.reconstruction.problem import Problem
from recon.reconstruction.residual import residual_in_words
from recon.solvers.base import IterationRecord, Outcome, StopReason


@pytest.fixture
def problem() -> Problem:
    rng = np.random.default_rng(0)
    return Problem.of(100 + 100 * rng.random((24, 24)), rng.random((24, 24)) ** 8)


def said(problem: Problem, norms: list[float], why: StopReason = StopReason.ITERATIONS) -> str:
    history = tuple(IterationRecord(k + 1, 0.1, data_residual=n) for k, n in enumerate(norms))
    return " ".join(residual_in_words(problem, Outcome(np.empty(0), history, why, 1.0), norms[-1], 24.0))


def test_at_the_noise_nothing_is_said(problem: Problem) -> None:
    assert said(problem, [400.0, 60.0, 26.0, 25.0, 25.0, 25.0, 25.0]) == ""
    assert said(problem, [400.0]) == "", "so few iterations say nothing"


def test_a_residual_that_rises_is_said_with_its_least_value(problem: Problem) -> None:
    text = said(problem, [400.0, 48.0, *np.linspace(50, 240, 12)])
    assert "10.0 times their noise" in text
    assert "from 2.0 times after 2 iterations" in text
    assert "--background" in text
    assert "rose" not in said(problem, [400.0, 80.0, *np.linspace(80, 90, 12)]), "a little is no sign"


def test_a_residual_that_comes_up_from_below_the_noise_is_no_alarm(problem: Problem) -> None:
    assert said(problem, [6.0, *np.linspace(8, 34, 12)]) == ""
    assert "rose" in said(problem, [6.0, *np.linspace(8, 120, 12)]), (
        "beyond what models leave as a rule it is"
    )
    assert "after 1 iteration:" in said(problem, [6.0, *np.linspace(8, 120, 12)])


def test_a_run_that_was_cut_short_is_told_from_a_wrong_model(problem: Problem) -> None:
    assert "More iterations" in said(problem, [900.0, 800.0, 700.0, 600.0, 500.0, 400.0, 300.0])
    slow = [200 * 0.99**k for k in range(20)]
    assert "More iterations" in said(problem, slow), "slow convergence is no fault of the camera"
    assert "--tolerance" in said(problem, slow, StopReason.CONVERGED)
    assert "another state" in said(problem, [400.0, *[200.0] * 12], StopReason.CONVERGED)


def test_a_weight_that_is_held_above_the_noise_is_named_before_the_camera(problem: Problem) -> None:
    history = tuple(IterationRecord(k + 1, 0.1, data_residual=n) for k, n in enumerate([400.0, *[90.0] * 12]))
    outcome = Outcome(np.empty(0), history, StopReason.CONVERGED, 1.0)
    (text,) = residual_in_words(problem, outcome, 90.0, 24.0, (1e-2, 9.0))
    assert "the weight of the prior keeps some of it, 9 times what noise asks for" in text
    assert "--tau 0.003" in text
    (text,) = residual_in_words(problem, outcome, 90.0, 24.0, (1e-2, 2.0))
    assert "weight" not in text
