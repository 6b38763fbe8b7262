"""What the engine promises of every iterative solver, tried on every one of them."""

import itertools
import threading
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution, low_rank
from recon.priors import L1, NonNegativity, TotalVariation
from recon.solvers import Admm, Fista, SensorAdmm, StoppingRules, StopReason
from recon.solvers.base import IterationRecord
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.operator_admm import OperatorAdmm
from recon.solvers.splitting import SensorData
from recon.solvers.tv_admm_volume import LeanTotalVariation
from recon.solvers.volume_admm import VolumeAdmm
from tests.recon.solvers.literal_admm import LiteralAdmm
from tests.recon.solvers.literal_volume import LiteralAdmm as LiteralVolume

RNG = np.random.default_rng(0)
SENSOR = (12, 13)
PICTURE_PSF = RNG.random((2, 7, 8)) ** 4
VOLUME_PSFS = RNG.random((4, 1, 7, 8)) ** 4
POINTS = np.array([(y, x) for y in (-4.0, 4.0) for x in (-4.0, 4.0)])
FIELD = [FieldOfPsfs(RNG.random((4, 1, 7, 8)) ** 4, POINTS)]
VALID = RNG.random((2, *SENSOR)) > 0.2
TV = TotalVariation(0.02, tolerance=1e-6) + NonNegativity()


def picture_camera():
    camera = Convolution(PICTURE_PSF, SENSOR, dtype=np.float64)
    return Erasures(VALID, camera.range_shape, np.float64) @ camera


def volume_camera():
    return Convolution(VOLUME_PSFS, SENSOR, dtype=np.float64)


def central():
    return Convolution(FIELD[0].psfs[:1], SENSOR, dtype=np.float64)


def varying(kind):
    model = local_convolution if kind == "local" else low_rank
    options = {} if kind == "local" else {"error": 0.1}
    return model(FIELD, SENSOR, grid_shape=central().grid_shape, dtype=np.float64, **options)


SPARSE = L1(0.02) + NonNegativity()
VOLUME_TV = TotalVariation.of_volume(0.02) + NonNegativity()
LATERAL = TotalVariation(0.02, axis_weights=(0, 1, 1), wrap=(False,) * 3) + NonNegativity()

SOLVERS = {
    "FISTA": (picture_camera, lambda A, b, x: Fista(A, b, TV, initial=x)),
    "ISTA": (picture_camera, lambda A, b, x: Fista(A, b, SPARSE, accelerate=False, initial=x)),
    "ADMM": (picture_camera, lambda A, b, x: Admm(A, b, TV, initial=x)),
    "exact-data ADMM": (picture_camera, lambda A, b, x: SensorAdmm(A, b, TV, initial=x)),
    "literal ADMM": (picture_camera, lambda A, b, x: LiteralAdmm(A, b, TV, (0.3, 3.0, 3.0), initial=x)),
    "lean TV": (
        volume_camera,
        lambda A, b, x: LeanTotalVariation(A, SensorData(b, VALID[0]), VOLUME_TV, initial=x),
    ),
    "Douglas-Rachford": (
        volume_camera,
        lambda A, b, x: SparseDouglasRachford(A, SensorData(b, VALID[0]), SPARSE, initial=x),
    ),
    "literal volume": (
        volume_camera,
        lambda A, b, x: LiteralVolume(A, b, 0.02, penalties=(0.3, 3.0, 3.0), initial=x),
    ),
    "lean TV by namespace": (
        volume_camera,
        lambda A, b, x: VolumeAdmm(A, SensorData(b, VALID[0]), VOLUME_TV, initial=x),
    ),
    "Douglas-Rachford by namespace": (
        volume_camera,
        lambda A, b, x: DouglasRachford(A, SensorData(b, VALID[0]), SPARSE, initial=x),
    ),
    "local model": (
        lambda: varying("local"),
        lambda A, b, x: OperatorAdmm(A, central(), b, LATERAL, initial=x),
    ),
    "low-rank model": (
        lambda: varying("low rank"),
        lambda A, b, x: OperatorAdmm(A, central(), b, SPARSE, initial=x),
    ),
}  # fmt: skip
PROXIMAL_GRADIENT = ("FISTA", "ISTA")
"""These have no split variables, and so no primal and dual residuals."""


@pytest.fixture(params=SOLVERS, scope="module")
def case(request):
    """Name, and what makes a solver from a starting point (and data other than the scene's)."""
    make_camera, make = SOLVERS[request.param]
    camera = make_camera()
    scene = np.zeros(camera.domain_shape)
    scene[..., 5:9, 6:11] = 1
    clean = camera.forward(scene)
    data = clean + 0.01 * np.random.default_rng(1).standard_normal(clean.shape)

    def solver(initial=None, bad=False):
        given = data.copy()
        if bad:
            given[0, np.argwhere(VALID[0])[20][0], np.argwhere(VALID[0])[20][1]] = np.nan
        return make(camera, given, initial)

    return request.param, solver


def test_starts_warm(case):
    _, solver = case
    end = solver().run(StoppingRules(iterations=400, tolerance=0)).solution
    warm, cold = (solver(x).run(StoppingRules(iterations=2, tolerance=0)).solution for x in (end, None))
    assert np.linalg.norm(warm - end) < 0.6 * np.linalg.norm(cold - end)


def test_is_watched_and_cancelled_within_one_iteration(case):
    _, solver = case
    stop, seen = threading.Event(), []

    def watch(running, record):
        seen.append((record.iteration, running.solution.shape))
        if record.iteration == 3:
            stop.set()

    out = solver().run(StoppingRules(iterations=50, tolerance=0), callback=watch, cancel=stop)
    assert out.stop_reason is StopReason.CANCELLED
    assert seen == [(i, out.solution.shape) for i in (1, 2, 3)]


class Kept:
    """A keeper in memory."""

    def __init__(self, state=None, history=()):
        self.state, self.history, self.ends = state, history, 0

    def resume(self, part, solver):
        if self.state is not None:
            solver.restore(self.state)
        return self.history

    def keep(self, part, solver, history, *, ended):
        self.state, self.history = solver.checkpoint(), tuple(history)
        self.ends += ended


def test_goes_on_exactly_from_what_was_kept(case):
    _, solver = case
    rules = StoppingRules(iterations=47, tolerance=0)
    whole = solver().run(rules)
    kept = Kept()
    solver().run(StoppingRules(iterations=31, tolerance=0), keeper=kept)
    assert kept.ends == 1
    rest = solver().run(rules, keeper=Kept(kept.state, kept.history))
    # Bit for bit here, wherever in memory arrays were put; a BLAS may sum otherwise elsewhere.
    assert rest.solution == pytest.approx(whole.solution, abs=1e-8 * float(np.abs(whole.solution).max()))
    assert [r.objective for r in rest.history] == pytest.approx(
        [r.objective for r in whole.history], rel=1e-8
    )
    assert rest.seconds > kept.history[-1].seconds
    # What is finished already takes no further step.
    again = solver().run(StoppingRules(iterations=31, tolerance=0), keeper=Kept(kept.state, kept.history))
    assert len(again.history) == 31
    assert again.stop_reason is StopReason.ITERATIONS


def test_stops_on_nan_with_numbers(case):
    _, solver = case
    out = solver(bad=True).run(StoppingRules(iterations=50, tolerance=0))
    assert out.stop_reason is StopReason.NOT_FINITE
    assert len(out.history) < 5
    assert np.isfinite(out.solution).all()


def test_stops_by_each_rule_and_says_which(case):
    _, solver = case
    many = 4000
    first = solver().run(StoppingRules(iterations=5, tolerance=0))
    assert first.stop_reason is StopReason.ITERATIONS
    assert len(first.history) == 5
    level = 1.001 * first.history[-1].data_residual
    noise = solver().run(StoppingRules(iterations=many, tolerance=0, noise_norm=level))
    assert noise.stop_reason is StopReason.NOISE_LEVEL
    assert noise.history[-1].data_residual <= level
    late = solver().run(StoppingRules(iterations=None, time_s=1e-4, tolerance=0))
    assert late.stop_reason is StopReason.TIME
    assert late.seconds >= 1e-4
    calm = solver().run(StoppingRules(iterations=many, tolerance=1e-3))
    assert calm.stop_reason is StopReason.CONVERGED
    assert calm.history[-1].change < 1e-3


def test_history_tells_all_that_is_known(case):
    name, solver = case
    history = solver().run(StoppingRules(iterations=20, tolerance=0)).history
    known = {f.name for f in fields(IterationRecord)}
    if name in PROXIMAL_GRADIENT:
        known -= {"primal_residual", "dual_residual"}
    if "Douglas-Rachford" in name:
        known -= {"dual_residual"}  # one fixed-point residual speaks for both
    for field in known:
        assert np.isfinite([getattr(record, field) for record in history]).all(), field
    assert [r.iteration for r in history] == list(range(1, 21))
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(history))


@pytest.mark.parametrize(
    ("rules", "says"),
    [
        ({"iterations": None, "tolerance": 0}, "needs an end"),
        ({"iterations": 0}, "1 or more, not 0"),
        ({"time_s": 0}, "above 0, not 0"),
        ({"time_s": float("nan")}, "above 0, not nan"),
        ({"tolerance": -1e-9}, "tolerance must be a number, 0 or more"),
    ],
)
def test_rules_by_which_no_run_ends_well_are_refused(rules: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        StoppingRules(**rules)
