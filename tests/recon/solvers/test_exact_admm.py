"""Single iterations of the volume ADMMs, held to what the text says they do, by plain operators."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from recon.base import fft
from recon.base.threads import get_threads, set_threads
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution
from recon.priors import L1, Box, NonNegativity, TotalVariation
from recon.solvers import _volume_kernels, tv_admm_volume, volume_admm
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.operator_admm import LEAST_PIXELS, OperatorAdmm
from recon.solvers.prior_splits import balancing
from recon.solvers.splitting import Room, SensorData, Tuning, is_due, residual_norm
from recon.solvers.tv_admm_volume import LeanTotalVariation, volume_solver
from recon.solvers.volume_admm import FIRST_PENALTY, VolumeAdmm, is_lateral_periodic
from tests.device import LIBRARY, played

SENSOR = (7, 8)
RNG = np.random.default_rng(5)
CAMERA_PSFS = RNG.random((3, 1, 5, 4)) ** 3
CAMERA = Convolution(CAMERA_PSFS, SENSOR, dtype=np.float64)
VALID = RNG.random(SENSOR) > 0.2
DATA = RNG.random((1, *SENSOR)) ** 4
DEPTHS = ((0.5, 1.0, 1.0), (0.4, 0.9, 1.1), (0.3, 0.8, 1.2))
FIELDS = [FieldOfPsfs(RNG.random((4, 1, 5, 4)) ** 3, [(-3, -3), (-3, 3), (3, -3), (3, 3)]) for _ in range(3)]
FIELD = local_convolution(FIELDS, SENSOR, dtype=np.float64)
CENTRAL = Convolution(np.stack([field.psfs[0] for field in FIELDS]), SENSOR, dtype=np.float64)


def volume_tv(isotropic: bool = False, weights: Any = DEPTHS) -> TotalVariation:
    return TotalVariation.of_volume(0.03, weights, isotropic=isotropic)


def field_tv(isotropic: bool = False) -> TotalVariation:
    return TotalVariation(0.03, axis_weights=(0.5, 1, 1.1), wrap=(False,) * 3, isotropic=isotropic)


def solver_of(kind: str, prior: Any, **tuning: Any) -> VolumeAdmm | OperatorAdmm:
    data, how = SensorData(DATA, VALID), Tuning(**tuning)
    made: Any = (
        VolumeAdmm(CAMERA, data, prior, tuning=how)
        if kind == "volume"
        else OperatorAdmm(FIELD, CENTRAL, data, prior, tuning=how)
    )
    made.system.follow = lambda progress: None  # as exact as it goes, from the first on
    made.system.tolerance, made.system.max_steps = 1e-13, 200
    return made


def iterate(solver: VolumeAdmm | OperatorAdmm) -> np.ndarray:
    """Return a solver's object, and leave its spectrum, which the transform may spoil, as it was."""
    if isinstance(solver, OperatorAdmm):
        return solver._iterate().copy()
    kept = solver.X.copy()
    x = solver._iterate()
    solver.X = kept
    return x


def shrink(s: np.ndarray, threshold: float, isotropic: bool) -> np.ndarray:
    if isotropic:
        size = np.sqrt(np.sum(s**2, axis=0))
        return s * np.maximum(1 - threshold / np.maximum(size, 1e-300), 0)
    return np.sign(s) * np.maximum(np.abs(s) - threshold, 0)


ANOTHER = TotalVariation(0.02, axis_weights=(1.0, 1.0), tolerance=1e-13, max_inner=5000)
ENDING = TotalVariation(0.02, axis_weights=(1.0, 1.0), wrap=(False, False))
"""Known by its prox only: no sweep has differences that end at the grid's edge."""
PRIORS = {
    "TV": lambda tv: tv(),
    "isotropic TV, bounds": lambda tv: tv(True) + NonNegativity(),
    "TV, l1, bounds": lambda tv: tv() + L1(0.01) + NonNegativity(),
    "another prior": lambda tv: tv() + NonNegativity() + ANOTHER,
    "l1": lambda _: L1(0.02),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["volume", "field"])
@pytest.mark.parametrize("name", PRIORS)
def test_an_iteration_is_what_the_text_says(name: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.solvers.operator_admm.FIRST_STEPS", 200)
    monkeypatch.setattr("recon.solvers.operator_admm.STEPS", 200)
    prior = PRIORS[name](volume_tv if kind == "volume" else field_tv)
    solver = solver_of(kind, prior, kappa=0.7, balance=False)
    camera: Any = CAMERA if kind == "volume" else FIELD
    tv = next((term for term in prior.terms() if isinstance(term, TotalVariation)), None)
    kappa = 0.7 if tv or kind == "volume" else 1.0
    relaxation = 1.8 if kind == "volume" else 1.7
    psi = None if tv is None else tv.differences(np.zeros(camera.domain_shape))
    data = DATA * VALID
    assert solver.penalty == pytest.approx(
        FIRST_PENALTY * (CAMERA if kind == "volume" else CENTRAL).power()[0].mean()
    )
    for n, change in enumerate((1.0, 1.0, 2.5, 0.4)):
        used = solver._used_penalty
        solver.penalty = mu = solver.penalty * change  # as if it had been balanced
        x, S = iterate(solver), solver.S.reshape(-1, *camera.domain_shape).copy()
        before = [(split.split.copy(), split.state.copy(), split.mu) for split in solver.splits]
        record = solver.advance()
        relax = relaxation if n else 1.0
        r = np.zeros(camera.domain_shape)
        primal = dual = size = multiplier = worth = 0.0
        if psi is not None and tv is not None:
            d, u = psi.forward(x), shrink(S, tv.weight / used, tv.isotropic)
            state = u + used / mu * (S - u) + relax * (d - u)
            np.testing.assert_allclose(solver.S.reshape(state.shape), state, atol=1e-9)
            now = shrink(state, tv.weight / mu, tv.isotropic)
            r += psi.adjoint(2 * now - state)
            primal, dual, size, multiplier = (squared(v) for v in (d - now, now - u, d, state - now))
            worth = tv.value(x)
        for split, (variable, old, own) in zip(solver.splits, before, strict=True):
            state = variable + own / (mu * kappa) * (old - variable) + relax * (x - variable)
            np.testing.assert_allclose(split.state, state, atol=1e-9)
            now = split.split
            np.testing.assert_allclose(now, split.prior.prox(state, 1 / (mu * kappa)), atol=1e-6)
            r += kappa * (2 * now - state)
            primal, dual = primal + kappa * squared(x - now), dual + kappa * squared(now - variable)
            size, multiplier = size + kappa * squared(x), multiplier + kappa * squared(state - now)
            worth += split.prior.value(now)
        after = iterate(solver)
        bent = kappa * len(solver.splits) * after
        bent += 0 if psi is None else psi.adjoint(psi.forward(after))
        residual = data - VALID * camera.forward(after)
        np.testing.assert_allclose(mu * (bent - r), camera.adjoint(residual), atol=1e-8)
        np.testing.assert_allclose(solver.e, residual[0], atol=1e-8)
        assert record.data_residual == pytest.approx(np.linalg.norm(residual))
        if n:
            assert record.primal_residual == pytest.approx((primal / size) ** 0.5, rel=1e-6)
            assert record.dual_residual == pytest.approx((dual / multiplier) ** 0.5, rel=1e-6)
        if kind == "volume":
            misfit = 0.5 * squared(data - VALID * camera.forward(x))
            assert record.objective == pytest.approx(misfit + worth, rel=1e-6)
        first = solver.splits[1 if solver.separable.is_zero and len(solver.splits) > 1 else 0].split
        np.testing.assert_array_equal(solver.solution, first)
        if n and kind == "volume":
            moved = sum(squared(s.split - old[0]) for s, old in zip(solver.splits, before, strict=True))
            assert record.change == pytest.approx((moved / (len(before) * squared(x))) ** 0.5)
        elif n:
            place = 1 if solver.separable.is_zero and len(before) > 1 else 0
            assert record.change == pytest.approx((squared(first - before[place][0]) / squared(first)) ** 0.5)


def squared(v: np.ndarray) -> float:
    return float(np.sum(v**2))


@pytest.mark.parametrize(("residuals", "factor"), [(4.0, 2.0), (0.25, 0.5), (100.0, 5.0), (1e-3, 0.2)])
def test_a_volumes_penalty_follows_the_ratio_of_residuals_within_bounds(
    residuals: float, factor: float
) -> None:
    solver = solver_of("volume", volume_tv())
    before = solver.penalty
    solver._rebalance(residuals, np.zeros(9))
    assert solver.penalty == pytest.approx(factor * before)


def test_a_fields_penalties_follow_each_its_own_residuals() -> None:
    solver = solver_of("field", field_tv() + NonNegativity(), kappa=0.6)
    assert isinstance(solver, OperatorAdmm)
    before = solver.penalty
    sums = np.array([7.0, 4.0, 1.0, 1.0, 4.0, 1.0, 16.0, 1.0, 1.0])
    solver._rebalance(9.0, sums)
    assert solver.penalty == pytest.approx(before * balancing(4, 1, 1, 4))
    assert solver.penalty * float(solver.kappa) == pytest.approx(0.6 * before * balancing(1, 16, 1, 1))
    least = LEAST_PIXELS * CENTRAL.power()[0].mean() / 3
    solver._rebalance(9.0, np.array([7.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e9, 1.0, 1.0]))
    solver._rebalance(9.0, np.array([7.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e9, 1.0, 1.0]))
    assert solver.penalty * float(solver.kappa) == pytest.approx(max(least, 0.006 * before * 0.5))
    x = RNG.standard_normal(FIELD.domain_shape)
    psi = field_tv().differences(x)
    bent = psi.adjoint(psi.forward(x)) + float(solver.kappa) * x
    np.testing.assert_allclose(solver._invert(bent), x, atol=1e-9)
    alone = solver_of("field", L1(0.1))
    before = alone.penalty
    alone._rebalance(4.0, np.zeros(9))
    assert alone.penalty == pytest.approx(2 * before)


def test_penalties_are_balanced_ever_more_seldom() -> None:
    due = [n for n in range(200) if is_due(n)]
    assert due == [2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192]


def test_what_is_no_number_is_an_infinite_residual() -> None:
    assert residual_norm(np.array([3.0, 4.0])) == 5.0
    assert residual_norm(np.array([3.0, np.nan])) == np.inf


@pytest.mark.parametrize(
    ("weights", "wrap", "lateral"),
    [
        ((1.0, 1.0), None, True),
        ((1.0, 1.0), (True, True), True),
        ((1.0, 1.0), (False, True), False),
        ((1.0, 1.0, 1.0), (False, True, True), True),
        ((1.0, 1.0, 1.0), None, False),
        ((1.0,), None, False),
        (DEPTHS, (False, True, True), True),
    ],
)
def test_which_differences_a_volumes_sweeps_have(weights: Any, wrap: Any, lateral: bool) -> None:
    assert is_lateral_periodic(TotalVariation(1.0, axis_weights=weights, wrap=wrap)) == lateral


@pytest.mark.parametrize("kind", ["volume", "field"])
def test_a_start_is_seen_and_what_is_solved_obeys_the_bounds_or_the_first_other_prior(kind: str) -> None:
    camera: Any = CAMERA if kind == "volume" else FIELD
    start = np.random.default_rng(8).random(camera.domain_shape)
    data, tv = SensorData(DATA, VALID), volume_tv() if kind == "volume" else field_tv()

    def made(prior: Any) -> VolumeAdmm | OperatorAdmm:
        if kind == "volume":
            return VolumeAdmm(CAMERA, data, prior, initial=start)
        return OperatorAdmm(FIELD, CENTRAL, data, prior, initial=start)

    free = made(tv + ANOTHER)
    np.testing.assert_allclose(free.e, (VALID * (DATA - camera.forward(start)))[0], atol=1e-9)
    np.testing.assert_allclose(iterate(free), start, atol=1e-9)
    np.testing.assert_array_equal(free._solved, free.splits[1].split)
    bounded = made(tv + ANOTHER + NonNegativity())
    np.testing.assert_array_equal(bounded._solved, bounded.splits[0].split)
    np.testing.assert_array_equal(made(tv)._solved, start)


@pytest.fixture
def many_threads() -> Iterator[None]:
    """As many as there are planes, whatever the machine has."""
    before = get_threads()
    set_threads(3)
    yield
    set_threads(before)


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("planes", [1, 3])
@pytest.mark.usefixtures("many_threads")
def test_compiled_sweeps_are_the_same_iterations(planes: int, isotropic: bool, started: bool) -> None:
    camera = Convolution(CAMERA_PSFS[:planes], SENSOR, dtype=np.float64)
    start = np.random.default_rng(8).random(camera.domain_shape) if started else None
    data, prior = SensorData(DATA, VALID), volume_tv(isotropic, DEPTHS[:planes]) + NonNegativity()
    plain, compiled = (kind(camera, data, prior, initial=start) for kind in (VolumeAdmm, LeanTotalVariation))
    followed: list[float] = []
    plain.system.follow, compiled.system.follow = lambda _: None, followed.append  # type: ignore[method-assign]
    for _ in range(5):
        expected, found = plain.advance(), compiled.advance()
        for name in ("objective", "data_residual", "primal_residual", "dual_residual", "change"):
            assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6, abs=1e-9)
        np.testing.assert_allclose(compiled.solution, plain.solution, atol=1e-8)
        assert followed[-1] == max(found.primal_residual, found.dual_residual)
    for solver in (plain, compiled):
        solver.move(2.0, 1.0)
        solver.set_data(SensorData(DATA[:, ::-1].copy(), VALID))
        for _ in range(2):
            solver.advance()
    np.testing.assert_allclose(compiled.solution, plain.solution, atol=1e-8)


@pytest.mark.usefixtures("many_threads")
def test_kernels_stay_within_what_they_are_handed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As plain Python, which looks whether an index is within its array; compiled they write behind it."""
    for name, kernel in vars(_volume_kernels).copy().items():
        if hasattr(kernel, "py_func") and kernel.__module__ == _volume_kernels.__name__:
            monkeypatch.setattr(_volume_kernels, name, kernel.py_func)
    plain = LeanTotalVariation(CAMERA, SensorData(DATA, VALID), volume_tv(True) + NonNegativity())
    plain.advance()
    monkeypatch.undo()
    compiled = LeanTotalVariation(CAMERA, SensorData(DATA, VALID), volume_tv(True) + NonNegativity())
    compiled.advance()
    np.testing.assert_allclose(plain.solution, compiled.solution, atol=1e-12)


def test_a_device_is_asked_for_the_memory_of_all_volumes(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(volume_admm, "require_memory", lambda _, size: asked.append(size))
    for prior in (volume_tv(), volume_tv() + ANOTHER):
        VolumeAdmm(CAMERA, SensorData(DATA, VALID), prior)
    size = 8 * np.prod(CAMERA.domain_shape)
    assert asked == [volume_admm._VOLUMES * size, (volume_admm._VOLUMES + 3) * size]


@pytest.mark.parametrize(
    ("prior", "kind", "elsewhere"),
    [
        (volume_tv() + NonNegativity(), LeanTotalVariation, VolumeAdmm),
        (volume_tv(), VolumeAdmm, VolumeAdmm),
        (volume_tv() + L1(0.1) + NonNegativity(), VolumeAdmm, VolumeAdmm),
        (volume_tv() + NonNegativity() + ANOTHER, VolumeAdmm, VolumeAdmm),
        (ANOTHER, VolumeAdmm, VolumeAdmm),
        (ENDING + NonNegativity(), VolumeAdmm, VolumeAdmm),
        (ENDING + ENDING, VolumeAdmm, VolumeAdmm),
        (ENDING, DouglasRachford, DouglasRachford),
        (L1(0.1) + NonNegativity(), SparseDouglasRachford, DouglasRachford),
        (L1(0.1) + Box(0, 2), DouglasRachford, DouglasRachford),
        (NonNegativity(), SparseDouglasRachford, DouglasRachford),
    ],
)
def test_which_solver_a_volumes_prior_gets(
    prior: Any, kind: type, elsewhere: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    for room in None, Room():
        assert type(volume_solver(CAMERA, DATA, prior, room=room)) is kind
    for name in ("VolumeAdmm", "DouglasRachford"):  # on another device nothing compiled is taken
        monkeypatch.setattr(tv_admm_volume, name, lambda *_, name=name, **__: name)
    assert volume_solver(CAMERA, DATA, prior, room=Room(xp=object())) == elsewhere.__name__  # type: ignore[arg-type]


def test_a_solvers_state_lives_in_its_room() -> None:
    class Elsewhere:
        """A scratch folder, or a device."""

        def zeros(self, shape: tuple[int, ...], dtype: Any) -> tuple[Any, ...]:
            return self, shape, np.dtype(dtype)

    disk: Any = Elsewhere()
    device: Any = Elsewhere()
    assert Room(storage=disk).zeros((2, 3), np.float32) == (disk, (2, 3), np.dtype(np.float32))
    assert Room(xp=device, storage=disk).zeros((2, 3), np.float32) == (device, (2, 3), np.dtype(np.float32))


def test_what_a_start_casts_on_a_device_is_what_it_casts_on_the_host() -> None:
    start = RNG.random(CAMERA.domain_shape)
    with played():
        host, device = (
            VolumeAdmm(CAMERA, SensorData(DATA, VALID), volume_tv(), initial=start, room=room)
            for room in (Room(), Room(xp=LIBRARY))
        )
        for _ in range(3):
            one, other = host.advance(), device.advance()
            assert other.objective == pytest.approx(one.objective)
            assert other.primal_residual == pytest.approx(one.primal_residual)
        np.testing.assert_allclose(device.solution, host.solution, atol=1e-9)


@pytest.mark.parametrize("balance", [True, False])
def test_a_volumes_penalty_is_balanced_after_iterations_that_are_due(balance: bool) -> None:
    solver = VolumeAdmm(CAMERA, SensorData(DATA, VALID), volume_tv(), tuning=Tuning(balance=balance))
    changed, before = [], solver.penalty
    for iteration in range(9):
        solver.advance()
        if solver.penalty != before:
            changed.append(iteration)
        before = solver.penalty
    assert changed == ([2, 4, 6, 8] if balance else [])


def test_of_nothing_a_volume_stays_nothing() -> None:
    solver = VolumeAdmm(CAMERA, SensorData(np.zeros_like(DATA), VALID), volume_tv())
    for _ in range(4):
        assert solver.advance().objective == 0
    assert not solver.solution.any()


def test_a_volumes_solver_takes_one_channel() -> None:
    colours = Convolution(np.repeat(CAMERA_PSFS, 3, axis=1), SENSOR, dtype=np.float64)
    with pytest.raises(ValueError, match="One channel at a time, not 3"):
        VolumeAdmm(colours, DATA, volume_tv())


def test_other_data_are_solved_at_once_and_the_first_again_bring_back_what_was() -> None:
    solver = solver_of("volume", volume_tv() + NonNegativity())
    assert isinstance(solver, VolumeAdmm)
    for _ in range(3):
        solver.advance()
    before, penalty = iterate(solver).copy(), solver._used_penalty
    solver.set_data(SensorData(DATA[:, ::-1].copy(), VALID))
    other = iterate(solver).copy()
    change = CAMERA.adjoint(((DATA[:, ::-1] - DATA) * VALID) - VALID * CAMERA.forward(other - before))
    kappa = float(solver.kappa)
    psi = volume_tv().differences(np.zeros(CAMERA.domain_shape))
    bent = kappa * (other - before) + psi.adjoint(psi.forward(other - before))
    np.testing.assert_allclose(penalty * bent, change, atol=1e-9)
    solver.set_data(SensorData(DATA, VALID))
    np.testing.assert_allclose(iterate(solver), before, atol=1e-9)


@pytest.mark.parametrize("kind", [VolumeAdmm, LeanTotalVariation])
def test_data_of_an_object_that_moved_leave_what_the_moved_object_does_not_explain(kind: Any) -> None:
    solver = kind(CAMERA, SensorData(DATA, VALID), volume_tv() + NonNegativity())
    solver.system.follow = lambda _: None
    solver.system.tolerance, solver.system.max_steps = 1e-13, 200
    for _ in range(3):
        solver.advance()
    kept = solver.X.copy()
    for shift in ((0.0, 0.0), (2.0, 1.0)):
        solver.move(*shift)
        other = DATA[:, ::-1].copy()
        solver.set_data(SensorData(other, VALID))
        kept = solver.X.copy()
        x = fft.irfft(solver.X, CAMERA.grid_shape[1])[None]
        solver.X = kept
        np.testing.assert_allclose(solver.e, (VALID * (other - CAMERA.forward(x)))[0], atol=1e-9)


def test_other_data_bring_a_background_as_restrained_as_it_is_by_then() -> None:
    background = BackgroundRemoval((1, *SENSOR), (2, 2), None, np.float64, 1e-3)
    solver = VolumeAdmm(CAMERA, SensorData(DATA, None, background), volume_tv() + NonNegativity())
    background.restrain(0.3)
    solver.set_data(SensorData(DATA, None, background))
    assert solver.system._taken == background.taken
