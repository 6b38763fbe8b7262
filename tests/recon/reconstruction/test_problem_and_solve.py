"""The parts of the one way: what a problem is made with, what it is solved with, where it may start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon import Calibration, InputError, Options, Problem, choose, reconstruct, solve
from recon.evaluation.scene import make_scene
from recon.priors import PRIORS, NonNegativity, Prior, TotalVariation
from recon.priors.named import NamedPrior
from recon.streams.joint import solve_together
from recon.streams.video import stream_problem

QUICK = {"iterations": 4, "tolerance": 0.0, "judged": False}


@pytest.fixture(scope="module")
def beads():
    return make_scene("beads", size=32, depths=4)


@pytest.fixture
def photograph():
    rng = np.random.default_rng(3)
    psf = (rng.random((24, 24)) > 0.9).astype(np.float32)
    return rng.poisson(50, (24, 24)).astype(np.float32), psf


def test_a_problem_that_was_chosen_for_one_photograph_takes_no_other(beads) -> None:
    chosen = choose(Problem.of(beads.measurement, beads.calibration, Options(prior="l1", **QUICK)))
    with pytest.raises(InputError, match="choose anew"):
        chosen.with_data(beads.measurement)


def test_options_that_a_problem_is_made_with_are_not_ignored_by_solve(photograph) -> None:
    image, psf = photograph
    problem = Problem.of(image, psf, Options(**QUICK))
    with pytest.raises(InputError, match="precision: a problem is made with these"):
        solve(problem, Options(precision="float64", **QUICK))
    assert len(solve(problem, replace(problem.options, iterations=2)).history) == 2


def test_a_start_of_other_depths_is_refused_in_words_by_auto_too(beads) -> None:
    first = reconstruct(beads.measurement, beads.calibration, prior="l1", **QUICK)
    fewer = replace(first, volume=first.volume[:2], state=None)
    with pytest.raises(InputError, match="The volume to start from is"):
        reconstruct(beads.measurement, beads.calibration, prior="l1", warm=fewer, **QUICK)


def test_fista_has_a_positive_background_where_psfs_vary(photograph) -> None:
    image, psf = photograph
    psfs = np.stack([psf, np.roll(psf, 1, 1), np.roll(psf, -1, 1)])[:, None]
    calibration = Calibration(psfs, np.array([[0, 0, 1e4], [300, 0, 1e4], [-300, 0, 1e4]], float))
    result = reconstruct(
        image - 80, calibration, model="local", solver="fista", estimate_background=True,
        positive_background=True, **QUICK,
    )  # fmt: skip
    assert result.background is not None
    assert result.background.min() >= 0


def test_a_weight_beside_a_prior_that_has_its_own_is_refused(photograph) -> None:
    image, psf = photograph
    with pytest.raises(InputError, match="a prior given as an object has its own weight"):
        reconstruct(image, psf, prior=TotalVariation(0.1) + NonNegativity(), tau=0.1)


def test_a_registered_prior_that_is_none_is_said_in_words(photograph) -> None:
    class NoProx(Prior):
        def value(self, x):
            return 0.0

    image, psf = photograph
    try:
        PRIORS.register(NamedPrior("no-prox", "Forgot its prox.", lambda _: NoProx()))
        with pytest.raises(InputError, match=r"'no-prox' cannot be made.*prox"):
            reconstruct(image, psf, prior="no-prox", **QUICK)
    finally:
        PRIORS._foreign.clear()
    with pytest.raises(InputError, match="a name and a help"):
        PRIORS.register(NoProx)


def test_a_priors_words_are_the_same_for_the_same_prior() -> None:
    assert repr(TotalVariation(0.1) + NonNegativity()) == repr(TotalVariation(0.1) + NonNegativity())
    assert repr(TotalVariation(0.1)) != repr(TotalVariation(0.2))


def test_a_prior_over_time_subtracts_the_background_and_keeps_to_its_solver(photograph) -> None:
    image, psf = photograph
    frames = np.stack([image, image + 1])
    given = stream_problem(image, psf, background=20.0, noise=5.0)
    before = stream_problem(image - 20.0, psf, noise=5.0)
    one = solve_together(given, frames, "tv", iterations=3)
    two = solve_together(before, frames - 20, "tv", iterations=3)
    np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-3)
    with pytest.raises(InputError, match="a solver of its own"):
        solve_together(stream_problem(image, psf, solver="fista"), frames, "tv", iterations=3)
