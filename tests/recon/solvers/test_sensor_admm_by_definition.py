"""The exact ADMM by what defines it: its first right-hand side, its objective, a problem on its side."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures
from recon.priors import L1, Box, Differences, NonNegativity, TotalVariation
from recon.solvers import SensorAdmm, StoppingRules

RNG = np.random.default_rng(12)
PSFS = RNG.random((2, 5, 7)) ** 4
SENSOR = (8, 13)
DATA = RNG.random((2, *SENSOR)) ** 3
VALID = RNG.random((2, *SENSOR)) > 0.2
TV = TotalVariation(0.05) + NonNegativity()


def turned(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.swapaxes(image, -1, -2))


@pytest.mark.parametrize("kind", ["plain", "erased", "background"])
def test_a_problem_on_its_side_has_its_picture_on_its_side(kind: str) -> None:
    """PSFs of odd sides, whose middle stays in the middle."""
    histories, pictures = [], []
    for turn in (np.array, turned):
        shape = turn(DATA).shape
        camera = Convolution(turn(PSFS), shape[1:], n_channels=2, dtype=np.float64)
        operator, options = camera, {}
        if kind == "erased":
            operator = Erasures(turn(VALID), shape, np.float64) @ camera
        elif kind == "background":
            few = (2, 4) if turn is np.array else (4, 2)
            options["background"] = BackgroundRemoval(shape, few, dtype=np.float64, restraint=0.1)
        solver = SensorAdmm(operator, turn(DATA), TV, data_steps=2, **options)
        histories.append([solver.advance() for _ in range(8)])
        pictures.append(solver.solution)
    np.testing.assert_allclose(turned(pictures[1]), pictures[0], atol=1e-9)
    for one, other in zip(*histories, strict=True):
        for name in ("objective", "data_residual", "primal_residual", "dual_residual", "change"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("isotropic", [False, True])
def test_it_begins_with_splits_that_agree_with_the_object(isotropic: bool) -> None:
    """``Psi^T (mu_u u - d) + (mu_w w - e)``: what penalties of 1 make of it, and then other penalties."""
    camera = Convolution(PSFS, SENSOR, n_channels=2, dtype=np.float64)
    x = RNG.normal(size=camera.domain_shape)
    tv, box = TotalVariation(0.3, isotropic=isotropic), Box(-0.5, 0.7)
    solver = SensorAdmm(camera, DATA, tv + box, initial=x)
    psi = Differences(camera.domain_shape, (1.0, 1.0), dtype=np.float64)
    mu_u, mu_w = solver._mu[:, :, None, None]
    t = psi.forward(x)
    size = np.sqrt(np.sum(t**2, axis=0, keepdims=True)) if isotropic else np.abs(t)
    u, w = t * np.maximum(1 - 0.3 / np.maximum(size, 1e-300), 0), np.clip(x, -0.5, 0.7)
    expected = psi.adjoint(mu_u * u - (t - u)) + mu_w * w - (x - w)
    np.testing.assert_allclose(solver._y, expected, atol=1e-9)
    np.testing.assert_allclose(solver.solution, np.clip(x, -0.5, 0.7))


@pytest.mark.parametrize("prior", [TV, TotalVariation(0.05) + Box(0.1, 0.9), L1(0.05) + NonNegativity()])
def test_in_the_end_it_tells_the_objective_and_the_residual_of_its_picture(prior) -> None:
    camera = Convolution(PSFS, SENSOR, n_channels=2, dtype=np.float64)
    out = SensorAdmm(camera, DATA, prior).run(StoppingRules(iterations=400, tolerance=1e-9))
    left = camera.forward(out.solution) - DATA
    assert out.history[-1].data_residual == pytest.approx(np.linalg.norm(left), rel=1e-5)
    whole = 0.5 * np.sum(left**2) + prior.value(out.solution)
    assert out.history[-1].objective == pytest.approx(whole, rel=1e-5)


def test_a_lower_bound_counts_from_the_first_step_after_a_restart_on() -> None:
    camera = Convolution(PSFS, SENSOR, n_channels=2, dtype=np.float64)
    prior = TotalVariation(0.05) + Box(0.2, 0.9)
    used, new = (SensorAdmm(camera, data, prior) for data in (DATA[::-1], DATA))
    for _ in range(4):
        used.advance()
    used.restart(DATA)
    np.testing.assert_allclose(used._y, new._y, atol=1e-12)
    assert new._y.min() > 0
