"""Priors over time: each prox against a plain minimiser, the joint solver against its problem."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from recon import InputError, Measurement
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.solvers import SensorAdmm
from recon.streams.joint import (
    OVER_TIME,
    JointAdmm,
    LowRankPlusSparse,
    OverTimeName,
    TemporalTotalVariation,
    require_joint,
    solve_together,
)
from recon.streams.video import stream_problem


def dual_minimum(course: np.ndarray, threshold: float) -> np.ndarray:
    """Total variation denoising by its dual, box-constrained least squares."""
    n = len(course)
    D = np.diff(np.eye(n), axis=0)
    found = minimize(
        lambda p: 0.5 * np.sum((course - D.T @ p) ** 2),
        np.zeros(n - 1),
        jac=lambda p: -D @ (course - D.T @ p),
        bounds=[(-threshold, threshold)] * (n - 1),
        method="L-BFGS-B",
        options={"ftol": 1e-15, "gtol": 1e-12, "maxiter": 5000},
    )
    return course - D.T @ found.x


@given(
    st.lists(st.floats(-5, 5, allow_nan=False, width=32), min_size=2, max_size=14),
    st.floats(0.01, 4),
)
@settings(max_examples=60, deadline=None)
def test_temporal_total_variation_is_denoised_exactly(values: list[float], threshold: float) -> None:
    stack = np.array(values)[:, None, None]
    found = TemporalTotalVariation(2.0).prox(stack, threshold / 2)
    np.testing.assert_allclose(found[:, 0, 0], dual_minimum(stack[:, 0, 0], threshold), atol=2e-4)


def test_temporal_total_variation_of_whole_stacks() -> None:
    stack = np.random.default_rng(0).standard_normal((9, 5, 7))
    found = TemporalTotalVariation(1.0).prox(stack, 0.3)
    for row, column in np.ndindex(5, 7):
        np.testing.assert_allclose(found[:, row, column], dual_minimum(stack[:, row, column], 0.3), atol=2e-4)
    assert TemporalTotalVariation(2.0).value(stack) == pytest.approx(2 * np.abs(np.diff(stack, axis=0)).sum())


def test_low_rank_plus_sparse_settles_at_the_minimum_and_tells_the_parts() -> None:
    rng = np.random.default_rng(0)
    background = np.outer(np.linspace(1, 2, 12), rng.uniform(1, 2, 400)).reshape(12, 20, 20)
    activity = np.zeros((12, 20, 20))
    activity[4, 5, 6], activity[8:10, 12, 3] = 3, 2
    prior = LowRankPlusSparse(2.0, 0.3)
    stack = background + activity
    for _ in range(200):
        found = prior.prox(stack, 0.5)
    assert prior.sparse is not None
    assert set(zip(*np.nonzero(np.abs(prior.sparse) > 0.5), strict=True)) == {
        (4, 5, 6),
        (8, 12, 3),
        (9, 12, 3),
    }
    # Optimality: the rest is a subgradient of both norms.
    rest = (stack - found) / 0.5
    singular = np.linalg.svd(rest.reshape(12, -1), compute_uv=False)
    assert singular[0] == pytest.approx(2.0, rel=1e-2)
    assert np.abs(rest).max() == pytest.approx(0.3, rel=1e-2)


def test_the_value_of_low_rank_plus_sparse_is_that_of_the_parts_last_found() -> None:
    rng = np.random.default_rng(0)
    sparse, low = rng.standard_normal((2, 3, 4, 5))
    prior = LowRankPlusSparse(2.0, 0.3)
    alone = 2 * np.linalg.svd(low.reshape(3, -1), compute_uv=False).sum()
    assert prior.value(low) == pytest.approx(alone)
    prior.sparse = sparse
    assert prior.value(low + sparse) == pytest.approx(alone + 0.3 * np.abs(sparse).sum())
    faint = LowRankPlusSparse(2.0, 0.3).value(0.1 * np.repeat(low[:1], 3, axis=0))  # of rank one, and below 1
    assert faint == pytest.approx(0.2 * np.sqrt(3) * np.linalg.norm(low[0]))
    fainter = LowRankPlusSparse(10.0, 100.0).prox(0.1 * low, 1.0)  # every singular value is below its step
    np.testing.assert_allclose(fainter, 0, atol=1e-12)


def problem(n_frames: int = 4) -> tuple[Convolution, np.ndarray]:
    rng = np.random.default_rng(1)
    psf = rng.random((1, 12, 14)) ** 6
    psf /= np.linalg.norm(psf)
    camera = Convolution(psf, (12, 14), n_channels=n_frames, dtype=np.float64)
    scene = np.zeros(camera.domain_shape)
    scene[:, 8:14, 9:16] = 5
    scene[2:, 10:12, 11:13] += 6
    return camera, camera.forward(scene) + 0.3 * rng.standard_normal(camera.range_shape)


def test_without_weight_over_time_frames_are_what_they_are_alone() -> None:
    camera, data = problem()
    prior = TotalVariation(0.3) + NonNegativity()
    alone, joint = (
        SensorAdmm(camera, data, prior),
        JointAdmm(camera, data, prior, TemporalTotalVariation(0.0)),
    )
    for _ in range(300):
        alone.advance()
        joint.advance()
    np.testing.assert_allclose(joint.solution, alone.solution, atol=2e-3 * alone.solution.max())


@pytest.mark.parametrize("over_time", [TemporalTotalVariation(0.5), LowRankPlusSparse(4.0, 0.4)])
def test_the_joint_solver_reaches_a_minimum(over_time: TemporalTotalVariation | LowRankPlusSparse) -> None:
    camera, data = problem()
    joint = JointAdmm(camera, data, NonNegativity(), over_time)
    for _ in range(700):
        joint.advance()
    x = joint.solution
    np.testing.assert_allclose(joint._split, x, atol=1e-3 * x.max())

    def value(at: np.ndarray) -> float:
        if isinstance(over_time, LowRankPlusSparse):
            # The value of an infimal convolution, by its own prox run to the end at a tiny step.
            fresh = LowRankPlusSparse(over_time.weight_rank, over_time.weight_sparse)
            for _ in range(400):
                fresh.prox(at, 1e-2)
            prior = fresh.value(at)
        else:
            prior = over_time.value(at)
        return 0.5 * float(np.sum((camera.forward(at) - data) ** 2)) + prior

    best = value(x)
    rng = np.random.default_rng(2)
    for size in (1e-2, 1e-1, 1.0):
        for _ in range(5):
            other = np.maximum(x + size * rng.standard_normal(x.shape) * (rng.random(x.shape) < 0.2), 0)
            assert value(other) > best - 1e-3 * abs(best)


def test_time_helps_where_frames_are_alike() -> None:
    rng = np.random.default_rng(0)
    psf = (rng.random((24, 28)) ** 8).astype(np.float32)
    scene = np.zeros((24, 28), np.float32)
    scene[8:14, 9:16] = 1
    wide = Convolution(psf[None], (24, 28))
    whole = np.zeros(wide.domain_shape, np.float32)
    top, left = wide.centre[0] - 12, wide.centre[1] - 14
    whole[0, top : top + 24, left : left + 28] = scene
    clean = wide.forward(whole)[0]
    frames = (clean + 0.1 * clean.max() * rng.standard_normal((8, 24, 28))).astype(np.float32)
    camera = stream_problem(frames[0], psf)

    def error(name: OverTimeName, weight: float) -> float:
        found = solve_together(camera, frames, name, weight=weight)
        assert found is not None
        return float(np.mean((found - scene) ** 2))

    alone = error("tv", 0.0)
    assert error("tv", 1.0) < 0.8 * alone
    assert error("lowrank", 1.0) < 1.2 * alone  # it takes some of the background's light
    assert error("lowrank", 100.0) > 2 * alone
    assert solve_together(camera, frames, "tv", ended=lambda: True) is None
    two = solve_together(camera, frames[:2], "tv")
    assert two is not None
    assert two.shape == (2, 24, 28)


def test_colour_and_single_frames_are_refused() -> None:
    frames = np.random.default_rng(0).random((3, 20, 20, 3)).astype(np.float32)
    camera = stream_problem(frames[0], frames[0, ..., 0] ** 4)
    with pytest.raises(InputError, match="take grey frames; reconstruct each channel on its own"):
        require_joint(camera)
    with pytest.raises(InputError, match="grey"):
        solve_together(camera, frames, "tv")
    grey = stream_problem(frames[0, ..., 0], frames[0, ..., 0] ** 4)
    with pytest.raises(InputError, match="two frames"):
        solve_together(grey, frames[:1, ..., 0], "tv")


def test_a_changed_penalty_leaves_the_multiplier_over_time_as_it_is() -> None:
    camera, data = problem()
    joint = JointAdmm(camera, data, NonNegativity(), TemporalTotalVariation(0.5))
    mu = joint._mu_time
    assert mu == pytest.approx(float(np.mean(joint._mu[1])), rel=1e-12)
    rng = np.random.default_rng(0)
    joint._t_time[...], joint._split[...] = (rng.standard_normal(joint._t_time.shape) for _ in range(2))
    multiplier = mu * (joint._t_time - joint._split)
    joint._splits.set_penalties(3.0 * joint._mu)
    joint._adapt()
    assert joint._mu_time == pytest.approx(3 * mu)
    np.testing.assert_allclose(joint._mu_time * (joint._t_time - joint._split), multiplier, rtol=1e-9)
    kept = joint._t_time.copy()
    joint._adapt()  # as it is already
    np.testing.assert_array_equal(joint._t_time, kept)


def test_the_prior_over_time_is_asked_with_the_step_of_its_penalty() -> None:
    class Noting(TemporalTotalVariation):
        """Notes what it is asked for."""

        def prox(self, stack: np.ndarray, step: float) -> np.ndarray:
            self.asked = stack.copy(), step
            return super().prox(stack, step)

    camera, data = problem()
    noting = Noting(0.5)
    joint = JointAdmm(camera, data, NonNegativity(), noting)
    joint._t_time[...] = np.random.default_rng(0).standard_normal(joint._t_time.shape)
    before, mu = joint._t_time.copy(), joint._mu_time
    joint._update(1)
    np.testing.assert_array_equal(noting.asked[0], before)
    assert noting.asked[1] == 1 / mu


@pytest.mark.parametrize("erased", [False, True])
@pytest.mark.parametrize("weight", [None, 2.5])
def test_weights_over_time_are_those_of_the_noise_that_valid_pixels_pass_on(
    weight: float | None, erased: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    class Given:
        """Notes what it is given, and is solved at once."""

        def __init__(self, operator: Any, data: np.ndarray, prior: Any, over_time: Any) -> None:
            made.append((operator, data, over_time))
            self.solution = np.ones(operator.domain_shape, np.float32)
            self.advances = 0

        def advance(self) -> None:
            made.append("an iteration")

    monkeypatch.setattr("recon.streams.joint.JointAdmm", Given)
    rng = np.random.default_rng(0)
    frames = rng.random((3, 20, 26)).astype(np.float32)
    gone = rng.random((20, 26)) < 0.4 if erased else None
    camera = stream_problem(Measurement(frames[0], erasures=gone, noise=0.1), frames[0] ** 6)
    expected = (1.0 if weight is None else weight) * float(np.sqrt(camera.valid.mean()))
    assert (camera.valid.mean() < 0.8) == erased
    for name in OVER_TIME:
        made.clear()
        found = solve_together(camera, frames, name, weight=weight, iterations=4)
        assert found is not None
        assert made[1:] == ["an iteration"] * 4
        np.testing.assert_array_equal(found, np.full((3, 20, 26), camera.image_scale[0], np.float32))
        operator, data, over_time = made[0]
        assert isinstance(operator, Convolution) != erased
        np.testing.assert_array_equal(data, [camera.with_data(frame).data[0] for frame in frames])
        if isinstance(over_time, LowRankPlusSparse):
            pixels = (20 * 26) ** 0.5
            weights = (over_time.weight_rank, over_time.weight_sparse, over_time.rounds)
            assert weights == pytest.approx((0.03 * expected * pixels, 0.3 * expected, 2))
        else:
            assert over_time.weight == pytest.approx(expected)
    left = iter([False, False, True])
    assert solve_together(camera, frames, "tv", ended=lambda: next(left)) is None
    assert next(left, None) is None


def test_what_a_prior_over_time_has_no_way_for_is_refused() -> None:
    frames = np.random.default_rng(0).random((3, 20, 20)).astype(np.float32)
    asked = stream_problem(frames[0], frames[0] ** 4, solver="admm")
    for refused in (lambda: require_joint(asked), lambda: solve_together(asked, frames, "tv")):
        with pytest.raises(InputError, match="a solver of its own"):
            refused()
    with pytest.raises(InputError, match="two frames"):
        solve_together(stream_problem(frames[0], frames[0] ** 4), frames[0], "tv")
