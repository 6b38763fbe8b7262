"""What counts as failure."""

from __future__ import annotations

import numpy as np
import pytest

from recon.solvers.base import IterationRecord, StopReason
from recon.verdict.map import (
    WORST,
    Failure,
    bounded,
    convergence_severity,
    relative_error,
    resolution_severity,
    ring_correlation,
    trivial_error,
    worst,
)

RNG = np.random.default_rng(0)


def test_the_worst_criterion_speaks_and_fails_from_one_on() -> None:
    assert worst({Failure.TRIVIAL: 0.9, Failure.SPOTS: 0.2}) == (0.9, None)
    assert worst({Failure.TRIVIAL: 0.9, Failure.SPOTS: 1.0}) == (1.0, Failure.SPOTS)
    assert worst({Failure.TRIVIAL: float("nan")}) == (WORST, Failure.TRIVIAL)
    assert bounded(np.inf) == WORST
    with pytest.raises(ValueError, match="criterion"):
        worst({})


def test_the_trivial_reconstruction_may_choose_scale_and_offset() -> None:
    truth = RNG.random((9, 8))
    assert trivial_error(-3 * truth + 7, truth) == pytest.approx(0, abs=1e-9)
    # A back-projection without a trace of the truth leaves the truth's mean.
    assert trivial_error(np.ones((9, 8)), truth) == pytest.approx(truth.std() / np.sqrt(np.mean(truth**2)))


def test_the_relative_error_is_scale_free() -> None:
    truth = RNG.random((3, 9, 8))
    assert relative_error(5 * truth, truth) == pytest.approx(0, abs=1e-6)
    other = RNG.random((3, 9, 8))
    assert relative_error(other, truth) == pytest.approx(relative_error(40 * other, truth))


def test_resolution_fails_where_the_ring_is_blurred_or_noise() -> None:
    x = np.mgrid[:64, :64][1]
    truth = 1 + np.sin(2 * np.pi * x / 4)
    assert ring_correlation(truth, truth, 4.0) == pytest.approx(1)
    assert resolution_severity(truth, truth, 2.0) == pytest.approx(0.5)
    assert resolution_severity(RNG.random((64, 64)), truth, 2.0) > 1
    assert resolution_severity(np.ones((64, 64)), truth, 2.0) == WORST


def test_only_a_run_that_a_limit_ended_may_fail_to_converge() -> None:
    last = (IterationRecord(200, 1.0, change=0.05),)
    assert convergence_severity(last, StopReason.ITERATIONS, 1e-3) == pytest.approx(5)
    assert convergence_severity(last, StopReason.CONVERGED, 1e-3) == 0
    assert convergence_severity((), StopReason.NOT_FINITE, 1e-3) == WORST
