"""The penalties of a picture's ADMM, and what its records tell of both kinds of splits."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.priors import NonNegativity, TotalVariation
from recon.solvers import Admm, Penalties, StoppingRules
from recon.solvers.admm import SETTLING, DataSplit

RNG = np.random.default_rng(3)
CAMERA = Convolution(RNG.random((1, 4, 5)) ** 3, (7, 8), dtype=np.float64)
DATA = CAMERA.forward(RNG.random(CAMERA.domain_shape) ** 6)
POWER = float(np.mean(CAMERA.power()))
TV = TotalVariation(0.03) + NonNegativity()


def run(times: float, penalties: Penalties | None) -> np.ndarray:
    solver = Admm(CAMERA, times * DATA, TotalVariation(0.03 * times) + NonNegativity(), penalties=penalties)
    solver.run(StoppingRules(iterations=40, tolerance=0))
    return np.array(solver.penalties)


def test_a_penalty_that_is_given_stays_and_one_that_is_not_follows_the_weight_over_the_brightness() -> None:
    assert run(1.0, Penalties(0.5, 0.8, 1.5))[:, 0] == pytest.approx([0.5, 0.8 * POWER, 1.5 * POWER])
    own = run(1.0, None)
    assert run(100.0, None) == pytest.approx(own, rel=1e-6), "in other units it is the same problem"
    assert own[1, 0] != pytest.approx(POWER)


def test_penalties_change_before_the_iterations_that_settle_them_alone() -> None:
    solver = Admm(CAMERA, DATA, TV)
    changed, before = [], np.array(solver.penalties)
    for iteration in range(40):
        solver.advance()
        if not np.array_equal(solver.penalties, before):
            changed.append(iteration)
        before = np.array(solver.penalties)
    assert tuple(changed) == SETTLING


def test_what_stands_at_erased_pixels_is_no_data() -> None:
    valid = np.arange(56).reshape(CAMERA.range_shape) % 5 > 0
    operator = Erasures(valid, CAMERA.range_shape, np.float64) @ CAMERA
    one, other = (Admm(operator, np.where(valid, DATA, hole), TV) for hole in (0.0, np.nan))
    for _ in range(3):
        assert one.advance().objective == other.advance().objective


def test_a_channel_without_light_keeps_its_penalty() -> None:
    camera = Convolution(RNG.random((1, 4, 5)) ** 3, (7, 8), n_channels=2, dtype=np.float64)
    data = np.concatenate([np.zeros((1, 7, 8)), DATA])
    solver = Admm(camera, data, TV)
    before = np.array(solver.penalties)
    for _ in range(4):
        assert np.isfinite(solver.advance().objective)
    np.testing.assert_array_equal(solver.penalties, before)
    seen = np.abs(solver.solution[1, ::2, ::2])
    solver.advance()
    after = before.copy()
    after[1, 1] = 0.03 / (np.percentile(seen, 99.9) / 10)  # the threshold is a tenth of the brightness
    np.testing.assert_allclose(solver.penalties, after)


def test_without_a_weight_no_penalty_is_taken_away() -> None:
    solver = Admm(CAMERA, DATA, TotalVariation(0.0) + NonNegativity())
    out = solver.run(StoppingRules(iterations=40, tolerance=0))
    assert np.isfinite(out.solution).all()
    assert (solver.penalties > 0).all()


def test_a_record_tells_the_split_that_is_further_off() -> None:
    solver = Admm(CAMERA, DATA, TV)
    for _ in range(3):
        solver.step()
    agreed, apart = solver._record(1.0, 0.0, 0.0, 1.0, 1.0), solver._record(1.0, 1e4, 1e6, 1.0, 1.0)
    assert agreed.primal_residual > 0
    assert agreed.dual_residual > 0
    assert apart.primal_residual == pytest.approx(100.0)
    assert apart.dual_residual == pytest.approx(1000.0)


@pytest.mark.parametrize("width", [14, 15, 16, 18])
def test_the_datas_split_begins_with_what_the_object_casts_and_counts_its_change_on_any_grid(
    width: int,
) -> None:
    """Grids of even and odd sides: of an even one the last column of half a spectrum stands alone."""
    camera = Convolution(RNG.random((1, 4, 5)) ** 3, (7, 9), grid_shape=(10, width), dtype=np.float64)
    x = RNG.random(camera.domain_shape)
    weight = np.ones(camera.range_shape)
    explained = DataSplit(camera, camera.forward(x), weight, 0.7, x, 1.6)
    np.testing.assert_allclose(explained.Q, 0, atol=1e-9)
    np.testing.assert_allclose(explained.sums[0, [0, 1, 2, 4]], 0, atol=1e-16)
    split = DataSplit(camera, RNG.random(camera.range_shape), weight, 0.7, x, 1.6)

    def prox() -> np.ndarray:
        return np.fft.irfft2(split.T[0] - split.Q[0], camera.grid_shape)

    for _ in range(2):
        before = prox()
        split.solve(0, y := RNG.random(camera.grid_shape), 0.3, 0.2)
        cast = np.fft.irfft2(np.fft.rfft2(y) * camera.channel_spectrum(0)[0], camera.grid_shape)
        taken = np.fft.irfft2(split.Q[0], camera.grid_shape)
        left = cast[camera.sensor_window] - split._data[0]
        assert split.sums[0, 0] == pytest.approx(np.sum(left**2))
        assert split.sums[0, 1] == pytest.approx(np.sum((cast - prox()) ** 2))
        assert split.sums[0, 4] == pytest.approx(np.sum(taken**2))
        assert split.sums[0, 2] == pytest.approx(np.sum((prox() - before) ** 2))
        assert split.sums[0, 3] == pytest.approx(np.sum(prox() ** 2))
