"""The smooth background as a projection."""

import numpy as np
import pytest
from scipy import optimize
from scipy.fft import dctn

from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.priors import L1, NonNegativity
from recon.solvers import Fista, StoppingRules
from recon.solvers.douglas_rachford import SparseDouglasRachford
from recon.solvers.splitting import SensorData


@pytest.mark.parametrize("erased", [0.0, 0.3])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), (np.float64, 1e-12)])
def test_is_an_orthogonal_projection(erased, dtype, tolerance):
    rng = np.random.default_rng(0)
    shape = (2, 13, 10)
    valid = rng.random(shape) >= erased
    P = BackgroundRemoval(shape, (4, 3), valid, dtype)
    x, y = rng.standard_normal((2, *shape)).astype(dtype)
    px = P.forward(x)
    np.testing.assert_allclose(P.forward(px), px, atol=tolerance)
    assert abs(np.vdot(px, y) - np.vdot(x, P.adjoint(y))) < 10 * tolerance
    smooth = P.background(rng.standard_normal(shape).astype(dtype))
    np.testing.assert_allclose(P.forward(smooth), 0, atol=10 * tolerance)
    np.testing.assert_allclose(P.background(smooth), smooth, atol=10 * tolerance)


def test_removes_the_low_dct_frequencies_and_no_others():
    x = np.random.default_rng(1).random((1, 12, 9))
    coefficients = dctn(BackgroundRemoval((1, 12, 9), (5, 2), dtype=np.float64).forward(x)[0], norm="ortho")
    expected = dctn(x[0], norm="ortho")
    expected[:5, :2] = 0
    np.testing.assert_allclose(coefficients, expected, atol=1e-12)


def test_background_is_recovered():
    """Two blocks under a background as bright, with and without its estimation."""
    rng = np.random.default_rng(2)
    psfs = np.zeros((3, 1, 24, 24))
    for z in range(3):
        psfs[z, 0].flat[rng.choice(24 * 24, 30, replace=False)] = 1
    camera = Convolution(psfs, (32, 32), dtype=np.float64)
    truth = np.zeros(camera.domain_shape)
    truth[0, 1, 24:27, 26:29] = truth[0, 0, 30:34, 21:24] = 1
    y, x = np.mgrid[:32, :32] / 32
    background = 3 + 5 * np.cos(np.pi * x) + 4 * np.cos(np.pi * y) * np.cos(2 * np.pi * x) + 8
    clean = camera.forward(truth)
    data = clean + background + 0.02 * rng.standard_normal(clean.shape)
    removal = BackgroundRemoval(data.shape, (5, 5), dtype=np.float64)
    weight = 0.02 * float(np.abs(camera.adjoint(removal.forward(data))).max())
    rules, prior = StoppingRules(iterations=300), L1(weight) + NonNegativity()
    found = SparseDouglasRachford(camera, SensorData(data, None, removal), prior).run(rules).solution
    blind = SparseDouglasRachford(camera, data, prior).run(rules).solution

    def error(x):
        return np.linalg.norm(x - truth) / np.linalg.norm(truth)

    assert error(found) < 0.35
    assert error(blind) > 2 * error(found)
    estimate = removal.background(data - camera.forward(found))
    assert np.linalg.norm(estimate - background) < 0.01 * np.linalg.norm(background)


def test_non_negative_background_is_the_nearest():
    """Against a slow projected search over the coefficients."""
    rng = np.random.default_rng(7)
    valid = rng.random((24, 20)) > 0.3
    removal = BackgroundRemoval((1, 24, 20), (3, 3), valid, np.float64)
    y = rng.standard_normal((1, 24, 20)) + np.linspace(-2, 3, 20)
    found = removal.non_negative(y)
    assert found.min() >= -1e-12
    assert removal.background(y).min() < -1
    np.testing.assert_allclose(removal.background(np.where(valid, found, 0)), found, atol=1e-8)

    def miss(g):
        return float(np.sum(np.where(valid, g - y, 0) ** 2))

    for _ in range(300):
        other = removal.background(rng.standard_normal((1, 24, 20))) * rng.choice([0.1, 1.0]) + found
        if other.min() >= 0:
            assert miss(other) >= 0.999 * miss(found)
    positive = np.full((1, 24, 20), 5.0)
    np.testing.assert_allclose(removal.non_negative(positive), positive)


@pytest.mark.parametrize("times", [1.0, 1e4])
def test_a_non_negative_background_is_that_of_a_general_optimiser(times):
    rng = np.random.default_rng(8)
    shape = (1, 60, 50)
    valid = rng.random(shape[1:]) > 0.3
    removal = BackgroundRemoval(shape, (3, 3), valid, np.float64)
    y = times * (rng.standard_normal(shape) + np.linspace(-2, 3, 50) + np.linspace(1, -1, 60)[:, None])
    rows, columns, _ = removal.basis(0)
    basis = np.einsum("ay,bx->yxab", rows, columns).reshape(60 * 50, 9) * 50
    inner, wanted = basis[valid.ravel()], y[0][valid] / times
    found = optimize.minimize(
        lambda c: float(np.mean((inner @ c - wanted) ** 2)),
        np.r_[1.0, np.zeros(8)],
        jac=lambda c: 2 * inner.T @ (inner @ c - wanted) / wanted.size,
        constraints={"type": "ineq", "fun": lambda c: (basis @ c)[::7], "jac": lambda c: basis[::7]},
        method="SLSQP",
        options={"ftol": 1e-7, "maxiter": 300},
    )
    assert found.success
    smooth = removal.non_negative(y)
    assert smooth.min() >= -1e-12 * times
    assert np.mean((smooth[0][valid] / times - wanted) ** 2) <= 1.002 * found.fun
    assert removal.background(y).min() < -0.5 * times


@pytest.mark.parametrize("erased", [0.0, 0.3])
def test_a_restrained_background_is_the_penalised_one(erased):
    """Against least squares over the cosines' coefficients, with the background's norm as further rows."""
    rng = np.random.default_rng(4)
    valid, y = rng.random((9, 8)) >= erased, rng.standard_normal((1, 9, 8)) * 3 + 2
    removal = BackgroundRemoval((1, 9, 8), (3, 2), valid, np.float64, restraint=0.4)
    assert 0 < removal.taken < 1
    rows, columns, _ = removal.basis(0)
    basis = np.einsum("ay,bx->yxab", rows, columns).reshape(72, 6) * valid.ravel()[:, None]
    wanted = np.concatenate([(y[0] * valid).ravel(), np.zeros(72)])
    best = np.linalg.lstsq(np.concatenate([basis, np.sqrt(0.4) * basis]), wanted, rcond=None)[0]
    smooth = removal.background(y)[0] * valid
    np.testing.assert_allclose(smooth.ravel(), basis @ best, atol=1e-10)
    least = np.sum((y[0] * valid - smooth) ** 2) + 0.4 * np.sum(smooth**2)
    assert np.sum(removal.forward(y) ** 2) == pytest.approx(least)


def test_a_volume_with_a_restrained_background_is_that_of_a_plain_method():
    """The splitting against FISTA on the operator with its factor."""
    rng = np.random.default_rng(5)
    psfs = rng.random((2, 1, 12, 12)) ** 6 / 4
    camera = Convolution(psfs, (16, 16), dtype=np.float64)
    data = camera.forward(rng.random(camera.domain_shape) ** 8) + 0.5
    removal = BackgroundRemoval(data.shape, (3, 3), dtype=np.float64, restraint=0.05)
    prior = L1(0.05) + NonNegativity()
    splitting = SparseDouglasRachford(camera, SensorData(data, None, removal), prior)
    found = splitting.run(StoppingRules(iterations=200)).history[-1].objective
    plain = Fista(removal @ camera, removal.forward(data), prior).run(StoppingRules(iterations=800))
    assert found == pytest.approx(plain.history[-1].objective, rel=2e-3)


def test_the_cosines_are_orthonormal():
    for cosines in BackgroundRemoval((1, 13, 10), (4, 3)).basis(0)[:2]:
        np.testing.assert_allclose(cosines @ cosines.T, np.eye(len(cosines)), atol=1e-12)
