"""The solver of the local and low-rank models against FISTA, on small problems."""

import threading

import numpy as np
import pytest

from recon.base import fft, threads
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution
from recon.priors import L1, NonNegativity, TotalVariation
from recon.solvers import Fista, StoppingRules, StopReason
from recon.solvers.operator_admm import OperatorAdmm
from recon.solvers.splitting import SensorData
from recon.solvers.volume_admm import ExactAdmm

POINTS = np.array([(y, x) for y in (-6, 0, 6) for x in (-6, 0, 6)], float)
SENSOR = (14, 13)


def problem(n_z=2, seed=0):
    """PSFs of both signs that change over the field; light in a few voxels."""
    rng = np.random.default_rng(seed)
    fields = []
    for _ in range(n_z):
        base = rng.standard_normal((1, 7, 8)) + 0.2
        changes = 0.3 * rng.standard_normal((9, 1, 7, 8))
        changes[4] = 0
        fields.append(FieldOfPsfs(base + changes, POINTS))
    field = (SENSOR[0] + 6, SENSOR[1] + 7)
    grid = (fft.fast_length(field[0]), fft.fast_length(field[1]))
    camera = local_convolution(fields, SENSOR, grid_shape=grid, dtype=np.float64)
    central = Convolution(np.stack([f.psfs[4] for f in fields]), SENSOR, dtype=np.float64)
    x = np.zeros(camera.domain_shape)
    x[0, 0, 8:12, 9:12], x[0, -1, 6:9, 12] = 1.0, 2.0
    data = camera.forward(x)
    data += 0.01 * data.std() * rng.standard_normal(data.shape)
    return camera, central, data


@pytest.fixture(autouse=True)
def one_thread():
    before = threads.get_threads()
    threads.set_threads(1)
    yield
    threads.set_threads(before)


@pytest.mark.parametrize(
    ("kind", "restraint"), [("l1", None), ("tv", None), ("l1", 0.0), ("tv-isotropic", 0.0), ("tv", 0.1)]
)
def test_reaches_the_minimiser_that_fista_reaches(kind, restraint):
    """With a restraint, also with erased pixels and a background."""
    camera, central, data = problem()
    rng, harder = np.random.default_rng(4), restraint is not None
    valid = rng.random(SENSOR) > 0.2 if harder else np.ones(SENSOR, bool)
    removal = None
    if restraint is not None:
        removal = BackgroundRemoval((1, *SENSOR), (3, 2), valid, np.float64, restraint)
        data = np.where(valid, data + 5 + 2 * np.cos(np.pi * (np.arange(SENSOR[1]) + 0.5) / SENSOR[1]), 0)
    operator = Erasures(valid, data.shape, np.float64) @ camera
    reduced = data
    if removal is not None:
        operator, reduced = removal @ operator, removal.forward(data)
    weight = 0.02 * float(np.abs(operator.adjoint(reduced)).max())
    weights = None if kind == "l1" else (0.5, 1.0, 1.0)
    prior = L1(weight) + NonNegativity()
    if weights is not None:
        prior = (
            TotalVariation(
                weight,
                isotropic=kind == "tv-isotropic",
                axis_weights=weights,
                wrap=(False,) * 3,
                tolerance=1e-6,
            )
            + NonNegativity()
        )
    solver = OperatorAdmm(camera, central, SensorData(data, valid, removal), prior)
    outcome = solver.run(StoppingRules(iterations=250, tolerance=1e-6))
    best = Fista(operator, reduced, prior).run(StoppingRules(iterations=700, tolerance=1e-7)).solution

    def value(x):
        return 0.5 * float(np.sum((operator.forward(x) - reduced) ** 2)) + prior.value(x)

    assert value(outcome.solution) == pytest.approx(value(best), rel=1e-4 if kind == "l1" else 6e-4)
    residual = float(np.linalg.norm(operator.forward(outcome.solution) - reduced))
    assert outcome.history[-1].data_residual == pytest.approx(residual, rel=1e-3)


def solver(data=None, **options):
    camera, central, clean = problem()
    prior = TotalVariation(0.5, axis_weights=(0.5, 1.0, 1.0), wrap=(False,) * 3) + NonNegativity()
    return OperatorAdmm(camera, central, clean if data is None else data, prior, **options)


def test_the_preconditioner_weighs_differences_along_rows_and_columns_each_by_its_own_weight():
    some = solver()
    height, width = some.operator.grid_shape
    along = [np.abs(np.exp(2j * np.pi * np.arange(n) / n) - 1) ** 2 for n in (height, width)]
    expected = 4 * along[0][:, None] + 9 * along[1][: width // 2 + 1] + some._pixels
    np.testing.assert_allclose(some._lateral_eigenvalues(np.array([7.0, 2.0, 3.0])), expected, atol=1e-12)


def test_goes_on_from_a_checkpoint():
    whole, first, second = solver(), solver(), solver()
    whole.run(StoppingRules(iterations=12, tolerance=0))
    first.run(StoppingRules(iterations=5, tolerance=0))
    second.restore(first.checkpoint())
    while second.iteration < 12:
        second.step()
        second.iteration += 1
    np.testing.assert_array_equal(second.solution, whole.solution)


def test_a_scene_full_of_light_keeps_total_variation_going():
    """Hardly a pixel is held by its bound, so that its residuals say nothing of the differences' penalty."""
    camera, central, _ = problem(1)
    x = np.full(camera.domain_shape, 2.0)
    x[..., 6:12, 4:12] = 5.0
    data = camera.forward(x)
    data += 0.05 * data.std() * np.random.default_rng(7).standard_normal(data.shape)
    weight = 0.02 * float(np.abs(camera.adjoint(data)).max())
    prior = TotalVariation(weight, axis_weights=(0.5, 1.0, 1.0), wrap=(False,) * 3) + NonNegativity()
    least = OperatorAdmm(camera, central, data, prior).run(StoppingRules(iterations=600, tolerance=0))

    class Together(OperatorAdmm):
        _rebalance = ExactAdmm._rebalance

    left = {}
    for kind in (OperatorAdmm, Together):
        one = kind(camera, central, data, prior)
        found = one.run(StoppingRules(iterations=40, tolerance=0)).solution
        left[kind] = np.linalg.norm(found - least.solution)
    assert left[OperatorAdmm] < 0.7 * left[Together]


def test_the_change_is_that_of_what_is_shown():
    shown = slice(6, 14), slice(7, 13)
    one, whole = solver(shown=shown), solver()
    for _ in range(4):
        before = one.solution
        record, of_all = one.advance(), whole.advance()
    now = one.solution
    for (rows, columns), told in ((shown, record), ((slice(None),) * 2, of_all)):
        change = np.linalg.norm((now - before)[..., rows, columns])
        assert told.change == pytest.approx(change / np.linalg.norm(now[..., rows, columns]))
    assert record.change != pytest.approx(of_all.change, rel=1e-3)


def test_where_nothing_is_shown_the_light_beyond_goes_on_until_it_is_settled():
    camera, central, data = problem()
    prior = L1(0.2 * float(np.abs(camera.adjoint(data)).max())) + NonNegativity()
    rules = StoppingRules(iterations=300, tolerance=1e-4)
    dark = slice(0, 3), slice(-3, None)
    one, whole = (OperatorAdmm(camera, central, data, prior, **k) for k in ({"shown": dark}, {}))
    first, other = one.run(rules), whole.run(rules)
    assert not first.solution[(..., *dark)].any()
    assert 5 < len(first.history) == len(other.history) < 300


def test_stops_on_nan_and_on_request():
    _, _, data = problem()
    bad = data.copy()
    bad[0, 3, 3] = np.nan
    lost = solver(bad).run(StoppingRules(iterations=20))
    assert lost.stop_reason is StopReason.NOT_FINITE
    assert len(lost.history) <= 2
    assert not lost.solution.any()
    cancel = threading.Event()
    stopped = solver().run(cancel=cancel, callback=lambda *_: cancel.set())
    assert stopped.stop_reason is StopReason.CANCELLED
    assert len(stopped.history) == 1


def test_needs_a_tenth_of_the_iterations_of_fista():
    """On a dense scene under smooth PSFs, where the mean carries the norm."""
    camera, central, _ = problem(1)
    rng = np.random.default_rng(6)
    fields = [FieldOfPsfs(rng.random((1, 1, 7, 8)) * (1 + 0.2 * rng.random((9, 1, 1, 1))), POINTS)]
    camera = local_convolution(fields, SENSOR, dtype=np.float64)
    central = Convolution(fields[0].psfs[4:5], SENSOR, dtype=np.float64)
    x = np.zeros(camera.domain_shape)
    x[0, 0, 4:14, 4:12] = rng.random((10, 8))
    data = camera.forward(x) + 0.01 * rng.standard_normal(camera.range_shape)
    weight = 1e-3 * float(np.abs(camera.adjoint(data)).max())
    prior = L1(weight) + NonNegativity()

    def value(x):
        return 0.5 * float(np.sum((camera.forward(x) - data) ** 2)) + prior.value(x)

    few = OperatorAdmm(camera, central, data, prior).run(StoppingRules(iterations=60, tolerance=0))
    many = Fista(camera, data, prior).run(StoppingRules(iterations=600, tolerance=0))
    assert value(few.solution) <= value(many.solution) * 1.001
