"""Single iterations of the Douglas-Rachford splitting by plain operators, and which planes are left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.errors import StructureError
from recon.priors import L1, Box, HaarTotalVariation, NonNegativity, TotalVariation, Zero
from recon.solvers.douglas_rachford import (
    EXCESS,
    PATIENCE,
    DouglasRachford,
    EmptyPlanes,
    PlaneWatch,
    SparseDouglasRachford,
)
from recon.solvers.splitting import SensorData, Tuning

SENSOR = (7, 8)
RNG = np.random.default_rng(5)
CAMERA = Convolution(RNG.random((3, 1, 5, 4)) ** 3, SENSOR, dtype=np.float64)
VALID = RNG.random(SENSOR) > 0.2
DATA = RNG.random((1, *SENSOR)) ** 4
SPARSE = L1(0.05) + NonNegativity()
TV = TotalVariation.of_volume(0.03)


def solver_of(kind: type[DouglasRachford], prior: Any, **tuning: Any) -> DouglasRachford:
    solver = kind(CAMERA, SensorData(DATA, VALID), prior, tuning=Tuning(**tuning))
    solver.system.follow = lambda progress: None  # type: ignore[method-assign]
    solver.system.tolerance, solver.system.max_steps = 1e-13, 200
    return solver


def squared(v: np.ndarray) -> float:
    return float(np.sum(v**2))


CASES: list[tuple[type[DouglasRachford], Any]] = [
    (DouglasRachford, SPARSE), (DouglasRachford, L1(0.05)), (DouglasRachford, Zero()), (DouglasRachford, TV),
    (SparseDouglasRachford, SPARSE), (SparseDouglasRachford, L1(0.05)),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(CASES)))
def test_an_iteration_is_what_the_text_says(case: int) -> None:
    kind, prior = CASES[case]
    solver = solver_of(kind, prior, drop_empty=False)
    data = DATA * VALID
    power = CAMERA.power()[0].mean()
    if prior in (TV, CASES[2][1]):
        assert solver.gamma == pytest.approx(1 / power)
    roughly = solver.e.copy()
    followed: list[float] = []
    solver.system.follow = followed.append  # type: ignore[method-assign]
    solver._solve_data_term(solver._forward(solver.z))  # to the last digit
    assert np.linalg.norm(roughly - solver.e) < 0.2 * np.linalg.norm(solver.e)
    for n in range(10):
        gamma, used = solver.gamma, solver._used_gamma
        seen = CAMERA.adjoint(solver.e[None] * VALID)[0]  # A^H e
        state = solver.z + (used - gamma) * seen  # the same x and multiplier, of another step
        x = state + gamma * seen
        residual = data - VALID * CAMERA.forward(x[None])
        np.testing.assert_allclose(solver.e, residual[0], atol=1e-8)
        u = prior.prox((2 * x - state)[None], gamma)[0]
        record = solver.advance()
        np.testing.assert_allclose(solver.z, state + 1.7 * (u - x), atol=1e-6)
        assert solver._used_gamma == gamma
        np.testing.assert_allclose(
            solver.e,
            (data - VALID * CAMERA.forward((solver.z + gamma * CAMERA.adjoint(solver.e[None])[0])[None]))[0],
            atol=1e-8,
        )
        gap = (squared(u - x) / squared(u)) ** 0.5
        assert record.primal_residual == pytest.approx(gap, rel=1e-4)
        assert followed[-1] == record.primal_residual
        assert record.change == pytest.approx(1.7 * gap, rel=1e-4)
        assert record.data_residual == pytest.approx(np.linalg.norm(residual))
        worth = prior.value(u[None])
        assert record.objective == pytest.approx(0.5 * squared(residual) + worth, rel=1e-4)
        balanced = gamma * np.clip((squared(u) / squared(gamma * seen)) ** 0.5, 0.2, 5.0)
        assert solver.gamma == pytest.approx(balanced if n in (2, 4, 6, 8) else gamma, rel=1e-5)
    after = CAMERA.adjoint(solver.e[None] * VALID)[0]
    expected = prior.prox((solver.z + 2 * solver._used_gamma * after)[None], solver._used_gamma)
    np.testing.assert_allclose(solver.solution, expected, atol=1e-5)


def test_the_first_step_is_a_tenth_of_the_height_that_a_voxel_may_have(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    power = CAMERA.power()[0]
    between = np.zeros(CAMERA.domain_shape)
    between[0, 1, 4, 5] = 9.0  # each plane is asked for its height, where there are few
    seen = CAMERA.forward(between)
    solver = DouglasRachford(CAMERA, SensorData(seen, VALID), SPARSE)
    spectrum = np.fft.rfft2(CAMERA.adjoint(seen * VALID)[0])
    regularised = np.fft.irfft2(spectrum / (power + 0.01 * power.mean()), CAMERA.grid_shape)
    assert solver.gamma == pytest.approx(0.1 * regularised.max() / 0.05)
    assert solver_of(DouglasRachford, SPARSE, first=3.0).gamma == 3.0
    faint = DouglasRachford(CAMERA, SensorData(1e-6 * seen, VALID), SPARSE)
    assert faint.gamma == pytest.approx(1e-6 * solver.gamma)
    monkeypatch.setattr("recon.solvers.douglas_rachford._PLANES", 1)
    first = np.fft.irfft2((spectrum / (power + 0.01 * power.mean()))[:1], CAMERA.grid_shape).max()
    assert solver._expected_height() == pytest.approx(first), "of many planes every so-manyth"
    dark = DouglasRachford(CAMERA, SensorData(0 * DATA, VALID), SPARSE)
    assert dark.gamma == pytest.approx(1 / power.mean())
    for _ in range(4):  # what is dark changes no step, and has no relative change
        record = dark.advance()
        assert (record.primal_residual, record.objective, dark.gamma) == (0.0, 0.0, dark._used_gamma)


@pytest.mark.parametrize(("first", "factor"), [(10.0, 0.2), (1e-6, 5.0)])
def test_a_step_is_balanced_by_a_factor_of_five_at_most(first: float, factor: float) -> None:
    solver = solver_of(DouglasRachford, SPARSE, first=first)
    for _ in range(3):
        solver.advance()
    assert solver.gamma == pytest.approx(factor * first)


def test_what_it_has_no_sweep_or_no_prox_for_is_refused() -> None:
    assert SparseDouglasRachford.knows(SPARSE)
    assert SparseDouglasRachford.knows(L1(1.0))
    assert not SparseDouglasRachford.knows(TV)
    with pytest.raises(StructureError, match="for l1 and non-negativity alone"):
        solver_of(SparseDouglasRachford, Box(0.0, 1.0))
    with pytest.raises(StructureError, match="HaarTotalVariation"):
        solver_of(DouglasRachford, HaarTotalVariation(0.1))


def test_a_plane_is_left_out_when_it_was_empty_for_long_and_one_stays() -> None:
    watch = PlaneWatch(3)
    for _ in range(PATIENCE - 1):
        watch.note(np.array([0.0, 1.0, 0.0]))
    assert not watch.due().any()
    watch.note(np.array([0.0, 1.0, 1e-9]))
    assert watch.due().tolist() == [True, False, False]
    watch.active[0] = False
    assert not watch.due().any()
    for _ in range(PATIENCE):
        watch.note(np.zeros(3))
    assert watch.empty_for.tolist() == [2 * PATIENCE, PATIENCE, PATIENCE]
    assert watch.due().tolist() == [False, False, True], "the first of those left stays"
    watch.bring_back(np.array([0]))
    assert watch.active.all()
    assert watch.empty_for.tolist() == [0, PATIENCE, PATIENCE]
    assert watch.patience.tolist() == [2 * PATIENCE, PATIENCE, PATIENCE]
    for _ in range(PATIENCE):
        watch.note(np.zeros(3))
    assert watch.due().tolist() == [False, True, True]


def test_planes_are_certified_up_to_a_hundredth() -> None:
    assert EmptyPlanes().certified
    assert EmptyPlanes((1,), 1 + EXCESS).certified
    assert not EmptyPlanes((1,), 1 + 1.1 * EXCESS).certified


@pytest.mark.parametrize("prior", [SPARSE, L1(0.05)])
def test_planes_left_out_come_back_where_the_residual_asks_for_them(prior: Any) -> None:
    solver = solver_of(SparseDouglasRachford, prior)
    assert isinstance(solver, SparseDouglasRachford)
    for _ in range(3):
        solver.advance()
    assert not solver._bring_back(), "none is left out"
    solver.watch.active[:] = [False, True, False]
    solver._regroup()
    solver.z[[0, 2]] = 0
    seen = CAMERA.adjoint(solver.e[None] * VALID)[0]
    peaks = (seen if prior is SPARSE else np.abs(seen)).max(axis=(1, 2))
    np.testing.assert_allclose(solver._peaks(), [peaks[0], 0, peaks[2]], rtol=1e-9)
    np.testing.assert_allclose(solver._power, np.abs(CAMERA.channel_spectrum(0)[1]) ** 2, rtol=1e-9)
    lower, upper = sorted((peaks[0], peaks[2]))
    solver.weight = 0.5 * (lower + upper) / (1 + EXCESS)
    comes = 0 if peaks[0] > peaks[2] else 2
    assert not solver.confirm()
    assert solver.watch.active.tolist() == [n in (1, comes) for n in range(3)]
    np.testing.assert_allclose(solver.z[comes], -solver._used_gamma * seen[comes], atol=1e-9)
    assert not solver.z[2 - comes].any()
    assert solver._planes.tolist() == sorted((1, comes))
    assert solver._total is None
    assert solver.confirm()
    solver._end()
    assert solver.empty.planes == (2 - comes,)
    assert solver.empty.worst == pytest.approx(lower / solver.weight)


def test_planes_are_looked_at_every_tenth_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[tuple[int, int]] = []
    back: list[tuple[int, int]] = []
    cases: list[tuple[Any, bool]] = [(SPARSE, True), (SPARSE, False), (NonNegativity(), True)]
    for case, (prior, drop) in enumerate(cases):
        solver = solver_of(SparseDouglasRachford, prior, drop_empty=drop)
        monkeypatch.setattr(solver, "_leave_out", lambda: left.append((case, solver.iteration)))  # noqa: B023
        monkeypatch.setattr(solver, "_bring_back", lambda: back.append((case, solver.iteration)))  # noqa: B023
        for _ in range(31):
            solver.advance()
    assert left == [(0, 10), (0, 20), (0, 30)]
    assert back == [(0, n) for n in (2, 4, 6, 8, 12, 16, 24)]


def test_what_was_empty_for_long_takes_no_part() -> None:
    solver = solver_of(SparseDouglasRachford, SPARSE)
    assert isinstance(solver, SparseDouglasRachford)
    solver._leave_out()
    assert solver.watch.active.all()
    solver.watch.empty_for[:] = [PATIENCE, 0, PATIENCE]
    solver._leave_out()
    assert solver.watch.active.tolist() == [False, True, False]
    assert solver._planes.tolist() == [1]
    solver.advance()
    assert solver.watch.empty_for.tolist() == [PATIENCE + 1, 0, PATIENCE + 1]
    again = solver_of(SparseDouglasRachford, SPARSE)
    assert isinstance(again, SparseDouglasRachford)
    again.restore(solver.checkpoint())
    assert again._planes.tolist() == [1]
    plain = solver_of(SparseDouglasRachford, NonNegativity())
    plain._end()
    assert plain.empty == EmptyPlanes()


def test_it_begins_with_what_the_data_lack_of_the_starting_point() -> None:
    initial = RNG.random(CAMERA.domain_shape)
    solver = DouglasRachford(CAMERA, SensorData(DATA, VALID), SPARSE, initial=initial)
    np.testing.assert_allclose(solver.z, initial[0])
    roughly = solver.e.copy()
    solver.system.tolerance, solver.system.max_steps = 1e-13, 200
    solver._solve_data_term(VALID * CAMERA.forward(initial)[0])
    assert np.linalg.norm(roughly - solver.e) < 0.2 * np.linalg.norm(solver.e)
