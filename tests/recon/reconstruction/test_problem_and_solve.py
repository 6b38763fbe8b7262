"""The parts of the one way: what a problem is made with, what it is solved with, where it may start."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from recon import Calibration, InputError, Measurement, Options, Problem, choose, reconstruct, solve
from recon.evaluation.scene import make_scene
from recon.priors import PRIORS, NonNegativity, Prior, TotalVariation
from recon.priors.named import NamedPrior
from recon.reconstruction.reconstruct import held_out_error
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


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"device": 5}, "device must be one of cpu, gpu, not 5"),
        ({"precision": 5}, "precision must be one of auto, float32, float64, not 5"),
        ({"choose": {"binning": 1}}, "choose must be an Overrides"),
        ({"prior": 3}, "a Prior, not 3"),
        ({"iterations": "5"}, "iterations must be a whole number"),
        ({"scratch": 5}, "scratch must be the name of a file"),
        ({"method": "admm"}, "no option 'method'. It is called 'solver'"),
    ],
)
def test_an_option_of_another_type_is_refused_in_words(photograph, wrong, said) -> None:
    with pytest.raises(InputError, match=said):
        reconstruct(*photograph, **wrong)


@pytest.mark.parametrize("solver", ["admm", "admm-sensor", "fista"])
def test_weights_of_differences_are_those_of_pictures_too(photograph, solver) -> None:
    image, psf = photograph
    asked = {"solver": solver, "tau": 0.05, "iterations": 40, "tolerance": 0.0, "judged": False}
    even, same, along_x, along_y = (
        reconstruct(image, psf, axis_weights=weights, **asked).image
        for weights in (None, (7, 1, 1), (1, 0, 1), [[1, 1, 0]])
    )
    np.testing.assert_allclose(same, even, atol=1e-4 * even.max())
    rough = [np.abs(np.diff(picture, axis=axis)).sum() for picture in (along_x, along_y) for axis in (0, 1)]
    assert rough[1] < 0.5 * rough[0]  # differences along x cost, those along y do not
    assert rough[2] < 0.5 * rough[3]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"axis_weights": (1, 1)}, r"\(3,\) or \(1, 3\)"),
        ({"axis_weights": "even"}, "found 'even'"),
        ({"axis_weights": (1, -1, 1)}, "0 or more"),
        ({"axis_weights": (1, 1, float("nan"))}, "finite"),
        ({"axis_weights": (1, 1, 1), "prior": "l1"}, "the prior l1 has none that"),
        ({"axis_weights": (1, 1, 1), "prior": TotalVariation(0.1)}, "has its own"),
    ],
)
def test_weights_of_differences_that_are_none_are_refused(photograph, asked, said) -> None:
    with pytest.raises(InputError, match=said):
        reconstruct(*photograph, **asked)


def test_erasures_and_background_of_patterned_light_are_shaped_as_its_frames(photograph) -> None:
    image, psf = photograph
    patterns = np.stack([np.linspace(0, 1, 24)[None] * np.ones((24, 1)), np.ones((24, 24))])
    frames = np.stack([image * 0.5, image])
    erased = np.zeros(frames.shape, bool)
    erased[0, 3:6, 4:8] = True
    each = Problem.of(Measurement(frames, background=frames * 0.1, erasures=erased, patterns=patterns), psf)
    np.testing.assert_array_equal(each.valid, ~erased)
    np.testing.assert_allclose(
        each.data * each.noise[:, None, None], np.where(erased, 0, 0.9 * frames), rtol=1e-5
    )
    one = Problem.of(Measurement(frames, background=image, erasures=erased[0], patterns=patterns), psf)
    np.testing.assert_array_equal(one.valid, ~np.stack([erased[0]] * 2))
    assert np.isfinite(solve(each, replace(each.options, **QUICK)).image).all()
    with pytest.raises(InputError, match=r"is \(24, 24, 3\), and the frames are \(2, 24, 24\)"):
        Problem.of(Measurement(frames, erasures=np.zeros((3, 24, 24)), patterns=patterns), psf)


def test_pixels_held_out_tell_how_far_they_are_and_are_given_up(photograph) -> None:
    image, psf = photograph
    problem = Problem.of(image, psf, Options(**QUICK))
    result, cancel, told = solve(problem), threading.Event(), []

    def tell(share: float, what: str) -> None:
        told.append((share, what))
        if len(told) == 3:
            cancel.set()

    assert held_out_error(result, problem, on_stage=tell, cancel=cancel) is None
    assert [what for _, what in told] == ["judging: pixels held out"] * 3
    assert 0 < told[0][0] < told[2][0] < 1
    assert held_out_error(result, problem, cancel=cancel) is None
    assert held_out_error(result, problem) > 0
