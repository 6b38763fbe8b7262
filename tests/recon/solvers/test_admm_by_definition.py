"""The ADMM of the data's split by what defines it: objective, units, a problem on its side, settling."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.priors import L1, Box, NonNegativity, TotalVariation
from recon.solvers import Admm, Penalties, StoppingRules
from recon.solvers.admm import SETTLING, _energy
from tests.recon.solvers.test_sensor_admm_by_definition import DATA, PSFS, SENSOR, TV, VALID, turned
from tests.recon.solvers.test_sensor_admm_other_data import Opaque

RECORDED = ("objective", "data_residual", "primal_residual", "dual_residual", "change")


def camera() -> Convolution:
    return Convolution(PSFS, SENSOR, n_channels=2, dtype=np.float64)


@pytest.mark.parametrize("erased", [False, True])
def test_a_problem_on_its_side_has_its_picture_on_its_side(erased: bool) -> None:
    histories, pictures = [], []
    for turn in (np.array, turned):
        shape = turn(DATA).shape
        operator = Convolution(turn(PSFS), shape[1:], n_channels=2, dtype=np.float64)
        power = float(np.mean(operator.power()))  # of half a spectrum, which has sides
        if erased:
            operator = Erasures(turn(VALID), shape, np.float64) @ operator
        solver = Admm(operator, turn(DATA), TV, penalties=Penalties(0.5, 4.0 / power, 7.0 / power))
        histories.append([solver.advance() for _ in range(10)])
        pictures.append(solver.solution)
    np.testing.assert_allclose(turned(pictures[1]), pictures[0], atol=1e-9)
    for one, other in zip(*histories, strict=True):
        for name in RECORDED:
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("prior", [TV, TotalVariation(0.05) + Box(0.1, 0.9), L1(0.05) + NonNegativity()])
def test_in_the_end_it_tells_the_objective_and_the_residual_of_its_picture(prior) -> None:
    out = Admm(camera(), DATA, prior).run(StoppingRules(iterations=600, tolerance=1e-7))
    left = camera().forward(out.solution) - DATA
    assert out.history[-1].data_residual == pytest.approx(np.linalg.norm(left), rel=1e-3)
    assert out.history[-1].objective == pytest.approx(
        0.5 * np.sum(left**2) + prior.value(out.solution), rel=1e-3
    )


def test_in_units_of_a_thousandth_every_step_is_the_same() -> None:
    solvers = [
        Admm(camera(), times * DATA, TotalVariation(0.05 * times) + NonNegativity()) for times in (1.0, 1e-3)
    ]
    for _ in range(6):
        one, other = (solver.advance() for solver in solvers)
        for name in ("primal_residual", "dual_residual", "change"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6)
        assert other.objective == pytest.approx(1e-6 * one.objective, rel=1e-6)


def test_penalties_of_a_prior_known_by_its_prox_settle_with_the_others(monkeypatch) -> None:
    solver = Admm(camera(), DATA, Opaque(L1(0.02) + NonNegativity()))
    settled = []
    monkeypatch.setattr(solver._splits, "set_penalties", lambda _: settled.append(solver.iteration))
    for _ in range(34):
        solver.advance()
    assert tuple(settled) == SETTLING


def test_a_prior_known_by_its_prox_has_the_minimum_of_the_same_prior_in_the_sweep() -> None:
    known = L1(0.05) + NonNegativity()
    ends = [
        Admm(camera(), DATA, prior).run(StoppingRules(iterations=300, tolerance=0)).history[-1].objective
        for prior in (known, Opaque(known))
    ]
    assert ends[1] == pytest.approx(ends[0], rel=1e-3)


@pytest.mark.parametrize("width", [6, 7])
def test_the_energy_of_half_a_spectrum_is_the_whole_ones(width: int) -> None:
    image = np.random.default_rng(1).normal(size=(5, width))
    assert _energy(np.fft.rfft2(image), width) == pytest.approx(np.sum(np.abs(np.fft.fft2(image)) ** 2))


def test_it_begins_with_the_mean_power_of_its_psf() -> None:
    power = float(np.mean(camera().power()))
    for penalties in (Penalties(), None):
        begun = Admm(camera(), DATA, TV, penalties=penalties).penalties
        np.testing.assert_allclose(begun, np.array([[0.1], [power], [0.3 * power]]) * [1, 1])
