"""The ADMM with the exact data term, its preconditioner and the transforms under them."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import scipy.fft

from recon.base import fft
from recon.base.metrics import psnr
from recon.base.threads import get_threads, set_threads
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures
from recon.priors import L1, Box, HaarTotalVariation, NonNegativity, TotalVariation, Zero
from recon.solvers import Admm, Fista, SensorAdmm, StoppingRules, StopReason, cosine_preconditioner
from recon.solvers.cosine_preconditioner import PicturePreconditioner
from recon.solvers.prior_splits import PriorSplits

PRIORS = {
    "tv": TotalVariation(0.05, tolerance=1e-8) + NonNegativity(),
    "isotropic tv": TotalVariation(0.05, isotropic=True, tolerance=1e-8) + NonNegativity(),
    "free tv": TotalVariation(0.05, tolerance=1e-8),
    "tv and l1": TotalVariation(0.05, tolerance=1e-8) + L1(0.02) + NonNegativity(),
    "l1": L1(0.05) + NonNegativity(),
    "nonnegative": NonNegativity(),
    "box": TotalVariation(0.01, tolerance=1e-8) + Box(0, 0.8),
}


def problem(n_channels=1, *, erased=False, dtype=np.float64, sensor=(9, 10), shared_psf=False):
    rng = np.random.default_rng(0)
    psfs = rng.random((1 if shared_psf else n_channels, 7, 8))
    psfs *= rng.random(psfs.shape) > 0.7
    psfs[:, 3, 4] += 2
    camera = Convolution(psfs, sensor, n_channels=n_channels, dtype=dtype)
    scene = np.zeros(camera.domain_shape, dtype)
    scene[:, 5:9, 6:11] = 1
    data = (camera.forward(scene) + 0.02 * rng.standard_normal(camera.range_shape)).astype(dtype)
    if not erased:
        return camera, data
    valid = rng.random(camera.range_shape) > 0.4
    return Erasures(valid, camera.range_shape, dtype) @ camera, data * valid


def objective(operator, data, prior, x):
    return 0.5 * float(np.sum((operator.forward(x) - data) ** 2)) + prior.value(x)


def run(operator, data, prior, iterations=1000, tolerance=1e-9, **options):
    solver = SensorAdmm(operator, data, prior, **options)
    return solver.run(StoppingRules(iterations=iterations, tolerance=tolerance))


@pytest.mark.parametrize(("n_channels", "erased"), [(1, False), (1, True), (2, False)])
@pytest.mark.parametrize("name", PRIORS)
def test_reaches_the_same_minimum_as_fista(name, n_channels, erased):
    operator, data = problem(n_channels, erased=erased)
    prior = PRIORS[name]
    slow = Fista(operator, data, prior).run(StoppingRules(iterations=1000, tolerance=1e-7))
    fast = run(operator, data, prior)
    # Both points are feasible, so that lower is closer to the minimum.
    ratio = objective(operator, data, prior, fast.solution) / objective(operator, data, prior, slow.solution)
    assert 1 - 1e-3 < ratio < 1 + 1e-4


@pytest.mark.parametrize("erased", [False, True])
def test_reaches_the_same_minimum_as_the_splitting_admm_on_a_larger_sensor(erased):
    operator, data = problem(2, erased=erased, sensor=(31, 44), shared_psf=True)
    prior = PRIORS["tv"]
    split = Admm(operator, data, prior).run(StoppingRules(iterations=2000, tolerance=0))
    exact = run(operator, data, prior, 1000, 0)
    value = objective(operator, data, prior, exact.solution)
    assert 1 - 1e-3 < value / objective(operator, data, prior, split.solution) < 1 + 1e-4
    assert exact.history[-1].objective == pytest.approx(value, rel=1e-4)
    residual = np.linalg.norm(operator.forward(exact.solution) - data)
    assert exact.history[-1].data_residual == pytest.approx(residual, rel=1e-3)


@pytest.mark.parametrize("restraint", [0.0, 0.05])
def test_with_a_background_reaches_the_minimum_of_what_it_leaves(restraint):
    operator, data = problem(2)
    data = data + 3 * np.linspace(1, 2, data.shape[2])
    removal = BackgroundRemoval(data.shape, (3, 3), dtype=np.float64, restraint=0.5)
    solver = SensorAdmm(operator, 0.3 * data, PRIORS["tv"], background=removal)
    solver.run(StoppingRules(iterations=5, tolerance=0))
    removal.restrain(restraint)  # other data may leave more or less to the background
    solver.set_data(data)
    fast = solver.run(StoppingRules(iterations=800, tolerance=1e-9))
    left, seen = removal.forward(data), removal @ operator
    slow = Fista(seen, left, PRIORS["tv"]).run(StoppingRules(iterations=1000, tolerance=1e-7))
    value = objective(seen, left, PRIORS["tv"], fast.solution)
    assert 1 - 1e-3 < value / objective(seen, left, PRIORS["tv"], slow.solution) < 1 + 1e-4
    assert fast.history[-1].objective == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize("steps", [1, 3])
def test_relaxation_and_data_steps_change_the_way_not_the_goal(steps):
    operator, data = problem()
    prior = PRIORS["tv"]
    ends = [run(operator, data, prior, 1500, 0, relax=r, data_steps=steps) for r in (1.0, 1.8)]
    values = [objective(operator, data, prior, e.solution) for e in ends]
    assert values[0] == pytest.approx(values[1], rel=1e-5)


def test_a_dense_scene_converges_in_few_iterations(shoot):
    # Half of the light comes from outside the sensor's field of view; the PSF has a hundred times more power
    # at its lowest frequencies than elsewhere.
    shot = shoot(91, 111, snr=100)
    energy = float(np.linalg.norm(shot.psf))
    camera = Convolution((shot.psf / energy)[None], shot.psf.shape)
    data = (shot.measurement / shot.noise)[None].astype(np.float32)
    prior = TotalVariation(0.5) + NonNegativity()
    (row, column), (height, width) = camera.centre, camera.sensor_shape
    top, left = row - height // 2, column - width // 2
    quality = []

    def judge(solver, _):
        image = solver.solution[0, top : top + height, left : left + width] * (shot.noise / energy)
        quality.append(psnr(image, shot.truth))

    SensorAdmm(camera, data, prior).run(StoppingRules(iterations=300, tolerance=0), callback=judge)
    assert quality[-1] > 15
    assert min(quality[24:]) > quality[-1] - 0.15


def test_numbers_do_not_depend_on_units():
    operator, data = problem()
    brighter = Convolution(
        3 * fft.irfft(operator.spectrum[:, 0].copy(), operator.grid_shape[1])[:, :7, :8],
        (9, 10),
        dtype=np.float64,
    )
    x = run(operator, data, PRIORS["tv"], 20, 0).solution
    twice = run(operator, 2 * data, TotalVariation(0.1) + NonNegativity(), 20, 0).solution
    thrice = run(brighter, 3 * data, TotalVariation(0.45) + NonNegativity(), 20, 0).solution
    assert twice == pytest.approx(2 * x, abs=1e-9)
    assert thrice == pytest.approx(x, abs=1e-9)


def test_float32_follows_float64():
    prior = PRIORS["tv"]
    single, double = (run(*problem(dtype=d), prior, 500, 0).solution for d in (np.float32, np.float64))
    assert single.dtype == np.float32
    assert np.linalg.norm(single - double) < 1e-4 * np.linalg.norm(double)


def test_does_not_depend_on_threads():
    before = get_threads()
    ends = []
    try:
        for threads in (1, 3):
            set_threads(threads)
            ends.append(run(*problem(2, dtype=np.float32, erased=True), PRIORS["isotropic tv"], 30, 0))
    finally:
        set_threads(before)
    assert np.array_equal(ends[0].solution, ends[1].solution)
    assert ends[0].history[-1].objective == ends[1].history[-1].objective


def test_resumes_from_a_checkpoint_exactly():
    operator, data = problem()
    whole = run(operator, data, PRIORS["tv"], 30, 0)
    first = SensorAdmm(operator, data, PRIORS["tv"])
    first.run(StoppingRules(iterations=17, tolerance=0))
    second = SensorAdmm(operator, data, PRIORS["tv"])
    second.restore(first.checkpoint())
    assert np.array_equal(second.run(StoppingRules(iterations=30, tolerance=0)).solution, whole.solution)


def test_starts_from_a_given_object():
    operator, data = problem()
    end = run(operator, data, PRIORS["tv"], 3000, 1e-10).solution
    warm, cold = (run(operator, data, PRIORS["tv"], 3, 0, initial=start).solution for start in (end, None))
    assert np.linalg.norm(warm - end) < 0.3 * np.linalg.norm(cold - end)


def test_can_be_watched_and_cancelled():
    stop = threading.Event()
    seen = []

    def watch(solver, record):
        seen.append((record.iteration, solver.solution.shape))
        if record.iteration == 3:
            stop.set()

    operator, data = problem()
    out = SensorAdmm(operator, data, PRIORS["tv"]).run(callback=watch, cancel=stop)
    assert out.stop_reason is StopReason.CANCELLED
    assert seen == [(i, operator.domain_shape) for i in (1, 2, 3)]


def test_stops_on_nan_and_gives_the_start_back():
    operator, data = problem()
    start = np.full(operator.domain_shape, 0.5)
    data[0, 2, 3] = np.nan
    out = SensorAdmm(operator, data, PRIORS["tv"], initial=start).run()
    assert out.stop_reason is StopReason.NOT_FINITE
    assert len(out.history) == 1
    assert np.array_equal(out.solution, start)


def test_zero_data_gives_zero():
    operator, data = problem()
    out = SensorAdmm(operator, 0 * data, PRIORS["tv"]).run()
    assert out.stop_reason is StopReason.CONVERGED
    assert not out.solution.any()


def test_refuses_what_it_has_no_fast_way_for():
    operator, data = problem()
    with pytest.raises(TypeError, match="HaarTotalVariation"):
        SensorAdmm(operator, data, HaarTotalVariation(0.1))
    volume = Convolution(np.ones((2, 1, 3, 3)), (4, 5), dtype=np.float64)
    with pytest.raises(TypeError, match="ista"):
        SensorAdmm(volume, np.zeros((1, 4, 5)), Zero())


def system_matrix(camera, mu):
    """``I + A T^-1 A^H``, column by column."""
    height, width = camera.grid_shape
    n = height * width
    eye = np.eye(n).reshape(n, height, width)
    laplacian = sum(2 * eye - np.roll(eye, 1, axis) - np.roll(eye, -1, axis) for axis in (1, 2))
    T = mu[0] * laplacian.reshape(n, n) + mu[1] * np.eye(n)
    A = np.stack([camera.forward(e[None])[0].ravel() for e in eye], axis=1)
    return np.eye(len(A)) + A @ np.linalg.solve(T, A.T)


def preconditioner_matrix(camera, mu):
    preconditioner = PicturePreconditioner(camera.power()[0], camera.grid_shape, camera.sensor_shape)
    preconditioner.set_penalties(*mu)
    units = np.eye(np.prod(camera.sensor_shape)).reshape(-1, *camera.sensor_shape)
    return np.stack([preconditioner.apply(u, np.empty_like(u)).ravel() for u in units], axis=1)


def smooth_camera(sensor, psf_shape):
    rng = np.random.default_rng(1)
    return Convolution(1 + rng.random((1, *psf_shape)), sensor, dtype=np.float64)


@pytest.mark.parametrize("psf_shape", [(9, 12), (4, 5), (15, 17)])
def test_preconditioner_is_exact_where_all_modes_are_inverted_together(psf_shape):
    camera, mu = smooth_camera((9, 12), psf_shape), (2.0, 0.1)
    product = preconditioner_matrix(camera, mu) @ system_matrix(camera, mu)
    assert product == pytest.approx(np.eye(len(product)), abs=1e-8)


def spread(matrix):
    values = np.linalg.eigvals(matrix).real
    values = values[values > 1e-9]
    return values.max() / values.min()


def test_preconditioner_bounds_the_condition_of_what_remains(monkeypatch):
    monkeypatch.setattr(cosine_preconditioner, "EXACT_MODES", 8)
    camera, mu = smooth_camera((14, 18), (14, 18)), (2.0, 0.1)
    system, approximate = system_matrix(camera, mu), preconditioner_matrix(camera, mu)
    assert approximate == pytest.approx(approximate.T, abs=1e-10)
    assert np.linalg.eigvalsh(approximate).min() > 0
    assert spread(system) > 1e3
    assert spread(approximate @ system) < 10


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cosine_transforms(dtype):
    rng = np.random.default_rng(0)
    whole = rng.standard_normal((9, 10)).astype(dtype)
    tolerance = 1e-5 if dtype == np.float32 else 1e-13
    Y = fft.dct(whole, np.empty_like(whole))
    assert pytest.approx(scipy.fft.dctn(whole, norm="ortho"), abs=tolerance) == Y
    assert fft.idct(Y, np.empty_like(Y)) == pytest.approx(whole, abs=tolerance)
    with pytest.raises(ValueError, match="out must be"):
        fft.dct(whole, np.empty((3, 3), dtype))


def test_new_penalties_keep_split_variables_and_multipliers():
    rng = np.random.default_rng(0)
    splits = PriorSplits(PRIORS["tv and l1"], rng.standard_normal((2, 6, 8)))
    for _ in range(3):
        splits.y[...] = rng.standard_normal(splits.y.shape)
        splits.sweep(1.5)
    before, multipliers = splits.solution(), splits.mu[1][:, None, None] * (splits.t_w - splits.solution())
    splits.set_penalties(splits.mu * [[3.0, 0.5], [0.2, 7.0]])
    assert splits.solution() == pytest.approx(before)
    after = splits.mu[1][:, None, None] * (splits.t_w - splits.solution())
    assert after == pytest.approx(multipliers)


def test_data_that_are_no_numbers_end_the_run_and_a_direction_that_leads_nowhere_is_not_gone(monkeypatch):
    operator, data = problem()
    spoilt = data.copy()
    spoilt[0, 3, 3] = np.nan
    with np.errstate(all="ignore"):
        assert run(operator, spoilt, PRIORS["tv"]).stop_reason is StopReason.NOT_FINITE
    solver = SensorAdmm(operator, data, NonNegativity())
    for preconditioned in (np.zeros_like, np.negative):  # as rounding may have it where nothing is left
        monkeypatch.setattr(
            PicturePreconditioner, "apply", lambda _, r, out, f=preconditioned: np.copyto(out, f(r)) or out
        )
        solver.step()
        assert not solver._e.any()


def test_the_penalties_are_balanced_within_bounds_and_for_a_dark_object_too():
    operator, data = problem(2)
    solver = SensorAdmm(operator, 0 * data, PRIORS["tv"])
    solver.iteration = 12  # the data's gradient has no object to be measured against
    solver._splits.balanced_penalties = lambda: np.array([[2.0, 1e9], [1e-9, 3.0]])
    solver._mu[...] = [[1.0, 1.0], [1.0, 1.0]]
    assert solver._balanced_penalties().tolist() == [[2.0, 10.0], [2.0 * 0.03, 3.0]]
    solver._mu[...] = [[1.0, 0.0], [1.0, 1e-4]]
    assert solver._balanced_penalties().tolist() == [[2.0, 0.0], [2.0 * 0.03, 1e-2]]


def quadratic(solver, camera, channel):
    """Return the data term's system on a channel's object, ``A^H A + T``, as a function."""
    mu_u, mu_w = solver._mu[:, channel]

    def applied(y):
        psi = sum(2 * y - np.roll(y, 1, axis) - np.roll(y, -1, axis) for axis in (0, 1))
        stack = np.zeros(camera.domain_shape)
        stack[channel] = y
        return camera.adjoint(camera.forward(stack))[channel] + mu_u * psi + mu_w * y

    return applied


@pytest.mark.parametrize("shared_psf", [False, True])
@pytest.mark.parametrize("prior", [PRIORS["tv"], PRIORS["l1"]])
def test_with_many_data_steps_an_object_solves_its_quadratic_problem(prior, shared_psf):
    camera, data = problem(2, shared_psf=shared_psf)
    solver = SensorAdmm(camera, data, prior, data_steps=40)
    for _ in range(2):
        right = solver._y.copy()
        misfits = [solver._solve(channel, 40) for channel in (0, 1)]
        y = solver._y.copy()
        for channel in (0, 1):
            expected = camera.adjoint(data)[channel] + right[channel]
            np.testing.assert_allclose(quadratic(solver, camera, channel)(y[channel]), expected, atol=1e-8)
        residual = data - camera.forward(y)
        np.testing.assert_allclose(solver._e, residual, atol=1e-8)
        assert misfits == pytest.approx(list(np.sum(residual**2, axis=(1, 2))), rel=1e-6)
        solver._splits.sweep(1.5)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_data_steps_are_those_of_preconditioned_conjugate_gradients(monkeypatch, steps):
    monkeypatch.setattr(cosine_preconditioner, "EXACT_MODES", 8)  # else the first step is the last
    camera, data = problem(sensor=(14, 18))
    solver = SensorAdmm(camera, data, PRIORS["tv"])
    solver.step()
    mu_u, mu_w = solver._mu[:, 0]
    laplacian = sum(
        (4 * np.sin(np.pi * np.arange(n) / n) ** 2).reshape(shape)
        for n, shape in zip(camera.grid_shape, ((-1, 1), (1, -1)), strict=True)
    )

    def inverted(y):  # T^-1 y
        return np.fft.ifft2(np.fft.fft2(y) / (mu_u * laplacian + mu_w)).real

    def bent(e):
        return e + camera.forward(inverted(camera.adjoint(e[None])[0])[None])[0]

    right, e = solver._y[0].copy(), solver._e[0].copy()
    r = data[0] - camera.forward(inverted(right)[None])[0] - bent(e)
    precondition = solver._preconditioners[0].apply
    z = precondition(r, np.empty_like(r)).copy()
    p, rho = z, float(np.vdot(r, z))
    for _ in range(steps):
        assert rho > 1e-5
        length = rho / float(np.vdot(p, bent(p)))
        e = e + length * p
        r = r - length * bent(p)
        z = precondition(r, np.empty_like(r)).copy()
        rho, before = float(np.vdot(r, z)), rho
        p = z + rho / before * p
    misfit = solver._solve(0, steps)
    np.testing.assert_allclose(solver._e[0], e, atol=1e-9)
    np.testing.assert_allclose(solver._y[0], inverted(right + camera.adjoint(e[None])[0]), atol=1e-9)
    assert misfit == pytest.approx(float(np.vdot(e, e)))


def test_the_first_iteration_takes_four_data_steps_and_others_as_many_as_asked(monkeypatch):
    taken = []
    monkeypatch.setattr(SensorAdmm, "_solve", lambda _self, _channel, steps: float(bool(taken.append(steps))))
    for asked in (1, 6):
        solver = SensorAdmm(*problem(), PRIORS["l1"], data_steps=asked)
        solver.advance()
        solver.advance()
    assert taken == [4, 1, 6, 6]


@pytest.mark.parametrize(
    ("prior", "strength"),
    [(PRIORS["tv"], 0.05), (PRIORS["l1"], 0.05), (TotalVariation(0.05) + L1(0.02), 0.05), (Zero(), None)],
)
def test_first_penalties_follow_the_objects_mean(prior, strength):
    camera, data = problem(2)
    data[1] *= 3
    solver = SensorAdmm(camera, data, prior)
    sums = camera._psfs.sum(axis=(2, 3))[0]
    for channel in (0, 1):
        mean = np.linalg.norm(data[channel]) / (np.sqrt(data[channel].size) * sums[channel])
        power = np.abs(np.fft.rfft2(camera._psfs[0, channel], camera.grid_shape)) ** 2
        penalty = power.mean() if strength is None else strength / (0.3 * mean)
        mu_u, mu_w = solver._first_penalties()[:, channel]
        assert mu_w == pytest.approx(0.05 * penalty, rel=1e-6)
        assert mu_u == (pytest.approx(penalty, rel=1e-6) if "Total" in str(prior) else 0)
    dark = SensorAdmm(camera, 0 * data, prior)._first_penalties()
    np.testing.assert_allclose(dark[1], [
        0.05 * np.mean(np.abs(np.fft.rfft2(psf, camera.grid_shape)) ** 2) for psf in camera._psfs[0]
    ], rtol=1e-6)  # fmt: skip


def test_pixels_penalties_are_set_by_the_data_terms_gradient_at_three_iterations(monkeypatch):
    operator, data = problem(2, erased=True)
    solver = SensorAdmm(operator, data, PRIORS["tv"])
    for _ in range(12):
        solver.advance()
    monkeypatch.setattr(solver._splits, "balanced_penalties", lambda: solver._mu.copy())
    w = solver.solution
    gradient = operator.adjoint(operator.forward(w) - solver._weight * solver._data)
    for channel in (0, 1):
        multiplier = solver._mu[1, channel] * np.linalg.norm(solver._splits.t_w[channel] - w[channel])
        slope = np.linalg.norm(gradient[channel])
        expected = np.sqrt(multiplier * slope) / np.linalg.norm(w[channel])
        expected = np.clip(expected, solver._mu[1, channel] / 100, solver._mu[1, channel] * 100)
        expected = max(expected, 0.03 * solver._mu[0, channel])
        assert solver._balanced_penalties()[1, channel] == pytest.approx(expected, rel=1e-9)
    solver.iteration = 6  # no turn of the gradient's
    unchanged = np.maximum(solver._mu[1], 0.03 * solver._mu[0])
    np.testing.assert_allclose(solver._balanced_penalties(), [solver._mu[0], unchanged])
    monkeypatch.setattr(solver._splits, "balanced_penalties", lambda: 1e4 * solver._mu)
    np.testing.assert_allclose(solver._balanced_penalties(), np.array([[10.0], [100.0]]) * solver._mu)
    monkeypatch.setattr(solver._splits, "balanced_penalties", lambda: 1e-4 * solver._mu)
    least = [solver._mu[0] / 10, np.maximum(solver._mu[1] / 100, 0.003 * solver._mu[0])]
    np.testing.assert_allclose(solver._balanced_penalties(), least)
