"""A prior of the user's own, of which ``value`` and ``prox`` are known: every splitting solver takes it."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from recon.base.registry import Registry
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution
from recon.errors import InputError, StructureError
from recon.priors import (
    L1,
    PRIORS,
    Box,
    HaarTotalVariation,
    NamedPrior,
    NonNegativity,
    Prior,
    Sum,
    TotalVariation,
    Zero,
)
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.solvers import SOLVERS
from recon.solvers import Admm, Fista, SensorAdmm, StoppingRules
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.operator_admm import OperatorAdmm
from recon.solvers.splitting import SensorData
from recon.solvers.tv_admm_volume import LeanTotalVariation, volume_solver
from recon.solvers.volume_admm import VolumeAdmm


class Ridge(Prior):
    """``weight / 2 ||x||^2``, as a newcomer would write it."""

    def __init__(self, weight):
        self.weight = weight

    def value(self, x):
        return 0.5 * self.weight * float(np.vdot(x, x))

    def prox(self, x, step):
        return x / (1 + self.weight * step)


class PositiveRidge(Ridge):
    """The same with non-negativity, whose common prox is known."""

    def value(self, x):
        return np.inf if x.min() < 0 else super().value(x)

    def prox(self, x, step):
        return np.maximum(super().prox(x, step), 0)


def problem(n_channels=2):
    rng = np.random.default_rng(0)
    camera = Convolution(rng.random((n_channels, 5, 6)), (9, 8), dtype=np.float64)
    x = np.maximum(rng.standard_normal(camera.domain_shape), 0)
    data = camera.forward(x) + 0.1 * rng.standard_normal(camera.range_shape)
    return Erasures(rng.random((1, 9, 8)) > 0.1, data.shape, np.float64) @ camera, data


def minimum(operator, data, prior, x):
    data = operator.outer.forward(data)
    return 0.5 * float(np.linalg.norm(operator.forward(x) - data) ** 2) + prior.value(x)


RULES = StoppingRules(iterations=1500, tolerance=1e-8)


@pytest.fixture(scope="module")
def reference():
    operator, data = problem()
    masked = operator.outer.forward(data)
    return (
        Fista(operator, masked, PositiveRidge(0.5))
        .run(StoppingRules(iterations=6000, tolerance=1e-9))
        .solution
    )


@pytest.mark.parametrize("solver", [Admm, SensorAdmm])
@pytest.mark.parametrize(
    "prior",
    [
        Ridge(0.5) + NonNegativity(),
        NonNegativity() + Ridge(0.5),
        PositiveRidge(0.5) + Zero(),
    ],
    ids=["sum", "sum the other way", "with the bound inside"],
)
def test_admm_reaches_the_minimiser(solver, prior, reference):
    operator, data = problem()
    found = solver(operator, data, prior).run(RULES)
    assert found.solution.min() >= -1e-12
    best = minimum(operator, data, PositiveRidge(0.5), reference)
    assert minimum(operator, data, PositiveRidge(0.5), np.maximum(found.solution, 0)) == pytest.approx(
        best, rel=1e-5
    )


@pytest.mark.parametrize("solver", [Admm, SensorAdmm])
def test_three_priors_at_once_agree_between_solvers(solver):
    operator, data = problem()
    prior = Ridge(0.3) + TotalVariation(0.2) + NonNegativity()
    found = solver(operator, data, prior).run(RULES).solution
    other = (SensorAdmm if solver is Admm else Admm)(operator, data, prior).run(RULES).solution
    assert minimum(operator, data, prior, found) == pytest.approx(
        minimum(operator, data, prior, other), rel=1e-5
    )


@pytest.mark.parametrize("solver", [Admm, SensorAdmm])
def test_a_second_total_variation_is_taken_by_its_prox(solver):
    """Two halves are the whole."""
    operator, data = problem(1)
    half = TotalVariation(0.2, tolerance=1e-12)
    found = solver(operator, data, half + half + NonNegativity()).run(
        StoppingRules(iterations=250, tolerance=1e-8)
    )
    whole = solver(operator, data, TotalVariation(0.4) + NonNegativity()).run(RULES)
    of = TotalVariation(0.4) + NonNegativity()
    assert minimum(operator, data, of, found.solution) == pytest.approx(
        minimum(operator, data, of, whole.solution), rel=1e-4
    )


@pytest.mark.parametrize("solver", [Admm, SensorAdmm])
def test_a_run_goes_on_from_a_checkpoint(solver):
    operator, data = problem()
    prior = Ridge(0.5) + NonNegativity()
    whole = solver(operator, data, prior).run(StoppingRules(iterations=20, tolerance=0)).solution
    first = solver(operator, data, prior)
    first.run(StoppingRules(iterations=9, tolerance=0))
    second = solver(operator, data, prior)
    second.restore(first.checkpoint())
    found = second.run(StoppingRules(iterations=20, tolerance=0)).solution
    np.testing.assert_allclose(found, whole, atol=1e-12)


def test_a_restart_forgets_the_prior_s_state():
    operator, data = problem()
    rules = StoppingRules(iterations=12, tolerance=0)
    solver = SensorAdmm(operator, data, Ridge(0.5) + NonNegativity())
    cold = solver.run(rules).solution
    solver.restart(data)
    np.testing.assert_allclose(solver.run(rules).solution, cold, atol=1e-12)


def test_fista_says_why_it_does_not_take_a_sum_without_a_prox():
    operator, data = problem()
    with pytest.raises(StructureError, match="prox of this sum is not known: Ridge, NonNegativity"):
        Fista(operator, data, Ridge(0.5) + NonNegativity()).step()


def test_a_prox_that_is_not_that_of_its_value_is_refused():
    operator, data = problem()
    for solver in (Admm, SensorAdmm):
        with pytest.raises(StructureError, match=r"HaarTotalVariation.*settle somewhere else.*fista"):
            solver(operator, data, Ridge(0.5) + HaarTotalVariation(0.1))


def test_names_are_objects_in_one_registry():
    assert isinstance(PRIORS, Registry)
    assert PRIORS.names()[:6] == ("tv", "tv-isotropic", "tv-haar", "l1", "nonnegative", "none")
    assert all(prior.help.endswith(".") and prior.accepts(None) is None for prior in PRIORS.values())
    assert [n for n, p in PRIORS.items() if not p.weighted] == ["nonnegative", "none"]
    tv, bound = PRIORS["tv"](0.3).terms()
    assert (tv.weight, bound.lower) == (0.3, 0)
    with pytest.raises(InputError, match="Did you mean 'tv-haar'"):
        PRIORS.named("tv-har")
    own = NamedPrior("ridge", "Small.", Ridge)
    registry = Registry("prior", "nobody's group", lambda: PRIORS.values())
    registry.register(own)
    assert registry.names()[-1] == "ridge"
    assert registry["ridge"](0.5).weight == 0.5


def volume_problem():
    rng = np.random.default_rng(1)
    camera = Convolution(rng.random((3, 1, 5, 6)), (9, 8), dtype=np.float64)
    x = np.maximum(rng.standard_normal(camera.domain_shape), 0)
    data = camera.forward(x) + 0.1 * rng.standard_normal(camera.range_shape)
    valid = rng.random((9, 8)) > 0.1
    return camera, Erasures(valid, data.shape, np.float64) @ camera, SensorData(data, valid)


def varying_problem():
    rng = np.random.default_rng(2)
    points = np.array([(y, x) for y in (-4.0, 4.0) for x in (-4.0, 4.0)])
    fields = [FieldOfPsfs(rng.random((4, 1, 5, 6)), points) for _ in range(2)]
    central = Convolution(np.stack([f.psfs[0] for f in fields]), (9, 8), dtype=np.float64)
    camera = local_convolution(fields, (9, 8), grid_shape=central.grid_shape, dtype=np.float64)
    data = camera.forward(np.maximum(rng.standard_normal(camera.domain_shape), 0))
    valid = rng.random((9, 8)) > 0.1
    operator = Erasures(valid, data.shape, np.float64) @ camera
    return lambda data, prior: OperatorAdmm(camera, central, data, prior), operator, SensorData(data, valid)


SUMS = {
    "a prox of its own": PositiveRidge(0.5),
    "with the bound beside it": Ridge(0.5) + NonNegativity(),
    "with total variation": Ridge(0.5) + NonNegativity() + TotalVariation.of_volume(0.3),
}


@pytest.mark.parametrize("prior", SUMS.values(), ids=SUMS)
@pytest.mark.parametrize("camera", ["convolutions", "varying"])
def test_volume_solvers_reach_the_minimiser(camera, prior):
    if camera == "convolutions":
        convolutions, operator, measured = volume_problem()
        make = partial(volume_solver, convolutions)
    else:
        make, operator, measured = varying_problem()
    found = make(measured, prior).run(StoppingRules(iterations=800, tolerance=1e-7)).solution
    assert found.min() >= -1e-9

    def value(x):
        misfit = operator.forward(x) - operator.outer.forward(measured.image)
        return 0.5 * float(np.sum(misfit**2)) + prior.value(np.maximum(x, 0))

    # No small move lowers it, in any of many directions that stay within the bounds.
    best, rng = value(found), np.random.default_rng(0)
    for scale in (1e-3, 1e-2):
        for _ in range(60):
            step = rng.standard_normal(found.shape) * (rng.random(found.shape) < rng.random())
            assert value(np.maximum(found + scale * step, 0)) >= best * (1 - 1e-6)
    assert value(np.maximum(found * 0.99, 0)) >= best * (1 - 1e-6)
    assert value(np.maximum(found * 1.01, 0)) >= best * (1 - 1e-6)


@pytest.mark.parametrize("prior", SUMS.values(), ids=SUMS)
def test_a_volume_goes_on_from_a_checkpoint(prior):
    camera, _, measured = volume_problem()
    rules = StoppingRules(iterations=14, tolerance=0)
    whole = volume_solver(camera, measured, prior).run(rules).solution
    first, second = (volume_solver(camera, measured, prior) for _ in range(2))
    first.run(StoppingRules(iterations=6, tolerance=0))
    second.restore(first.checkpoint())
    np.testing.assert_allclose(second.run(rules).solution, whole, atol=1e-12)


def test_each_prior_has_its_solver():
    camera, _, measured = volume_problem()
    tv, sparse = TotalVariation.of_volume(1.0), L1(1.0)
    expected = (
        (tv + NonNegativity(), LeanTotalVariation),
        (tv, VolumeAdmm),
        (tv + Box(0, 2), VolumeAdmm),
        (sparse + NonNegativity(), SparseDouglasRachford),
        (sparse, SparseDouglasRachford),
        (sparse + Box(0, 2), DouglasRachford),
        (PositiveRidge(1.0), DouglasRachford),
        (Ridge(1.0) + NonNegativity(), VolumeAdmm),
    )
    for prior, kind in expected:
        assert type(volume_solver(camera, measured, prior)) is kind
    with pytest.raises(StructureError, match="HaarTotalVariation"):
        volume_solver(camera, measured, HaarTotalVariation(1.0))


def test_a_sum_without_a_common_prox_is_refused_by_fista_before_the_work() -> None:
    scene = np.random.default_rng(0).random((16, 16))
    problem = Problem.of(
        Measurement(scene), scene**4, ReconstructionOptions(prior=Sum(L1(1.0), TotalVariation(1.0)))
    )
    assert "without a common prox" in str(SOLVERS["fista"].accepts(problem))
