"""The priors' splits, number by number: states, penalties that change, balances, residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.priors import L1, HaarTotalVariation, NonNegativity, TotalVariation, Zero
from recon.solvers.prior_splits import (
    LARGEST_STEP,
    SETTLED,
    PriorSplits,
    ProxSplit,
    balancing,
    is_plain,
    split_prior,
)

SHAPE = (2, 5, 6)


def random(seed: int, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def norms(*parts: np.ndarray) -> tuple[float, ...]:
    return tuple(float(np.sum(part**2)) for part in parts)


def split_of(seed: int, mu: float = 1.0) -> ProxSplit:
    split = ProxSplit(L1(0.4), random(seed))
    split.set_penalty(mu)
    return split


def test_a_split_is_the_prox_of_its_state_and_pulls_by_its_reflection() -> None:
    start, y = random(0), random(1)
    split = ProxSplit(L1(0.4), start)
    assert split.mu == 1.0
    np.testing.assert_array_equal(split.state, start)
    assert split.state is not start
    np.testing.assert_allclose(split.split, L1(0.4).prox(start, 1.0))
    split.mu = 2.0
    before = split.split
    split.meet(y, 1.5)
    state = start + 1.5 * (y - before)
    after = L1(0.4).prox(state, 0.5)
    np.testing.assert_allclose(split.state, state)
    np.testing.assert_allclose(split.split, after)
    assert split.sums == pytest.approx(norms(y - after, after - before, after, state - after))
    np.testing.assert_allclose(split.pull(), 2.0 * (2 * after - state))


def test_a_penalty_that_changes_leaves_variable_and_multiplier() -> None:
    split = split_of(0)
    split.meet(random(1), 1.5)
    variable, multiplier = split.split.copy(), split.mu * (split.state - split.split)
    split.set_penalty(0.25)
    np.testing.assert_array_equal(split.split, variable)
    np.testing.assert_allclose(split.mu * (split.state - split.split), multiplier)
    state = split.state
    split.set_penalty(0.25)
    assert split.state is state


def test_penalties_are_guessed_until_residuals_are_known_and_balanced_from_then_on() -> None:
    split = split_of(0, mu=3.0)
    assert split.balanced(7.0) == 7.0
    split.sums = (4.0, 1.0, 2.0, 8.0)
    assert split.balanced(7.0) == pytest.approx(3.0 * (4 / 1 * (8 / 2)) ** 0.25)


@pytest.mark.parametrize(
    ("sums", "factor"),
    [
        ((16.0, 1.0, 1.0, 1.0), 2.0),
        ((1.0, 16.0, 1.0, 1.0), 0.5),
        ((1.0, 1.0, 16.0, 1.0), 0.5),
        ((1.0, 1.0, 1.0, 16.0), 2.0),
        ((1e9, 1.0, 1.0, 1.0), LARGEST_STEP),
        ((1.0, 1e9, 1.0, 1.0), 1 / LARGEST_STEP),
        ((0.0, 1.0, 1.0, 1.0), 1.0),
        ((1.0, 1.0, 1.0, 0.0), 1.0),
        ((1.0, np.inf, 1.0, 1.0), 1.0),
        ((np.nan, 1.0, 1.0, 1.0), 1.0),
        ((SETTLED**2, 4 * SETTLED**2, 1.0, 16.0), 1.0),
        ((SETTLED**2 / 4, 16 * SETTLED**2, 1.0, 16.0), 1.0),
        ((1.01 * SETTLED**2, 1.01 * SETTLED**2, 1.0, 16.0), 2.0),
        ((SETTLED**2, 16.16 * SETTLED**2, 1.0, 16.0), 1.01**-0.25),
    ],
)
def test_a_penalty_is_multiplied_by_what_makes_relative_residuals_equal(
    sums: tuple[float, ...], factor: float
) -> None:
    assert balancing(*sums) == pytest.approx(factor)


def test_a_split_goes_on_from_a_checkpoint_moves_and_begins_anew() -> None:
    prior = TotalVariation(0.3) + NonNegativity()  # its prox keeps a dual variable
    split = ProxSplit(prior, random(0))
    split.meet(random(1), 1.5)
    kept = split.checkpoint()
    assert set(kept) == set(ProxSplit.kept)
    other = ProxSplit(prior, random(2))
    other.restore({name: np.copy(value) for name, value in kept.items()})
    for each in (split, other):
        each.meet(random(3), 1.5)
    np.testing.assert_array_equal(split.state, other.state)
    np.testing.assert_array_equal(split.split, other.split)
    assert (split.mu, split.sums) == (other.mu, other.sums)
    no_memory = ProxSplit(L1(0.1), random(0))
    no_memory.prior.memory = random(1)
    no_memory.restore(ProxSplit(L1(0.1), random(4)).checkpoint())
    assert no_memory.prior.memory is None
    state, variable = split.state.copy(), split.split.copy()
    split.move(1.0, -2.0)
    np.testing.assert_allclose(split.state, np.roll(state, (1, -2), (1, 2)), atol=1e-12)
    np.testing.assert_allclose(split.split, np.roll(variable, (1, -2), (1, 2)), atol=1e-12)
    split.restart()
    assert not split.state.any()
    assert split.sums == (0.0, 0.0, 0.0, 0.0)
    assert not split.split.any()


TV = TotalVariation(0.3)
ISOTROPIC = TotalVariation(0.3, isotropic=True)


def swept(prior: Any, mu: tuple[float, float] = (0.7, 1.3), relax: float = 1.6) -> tuple[PriorSplits, Any]:
    """Return splits after a sweep from another object, and the states before it."""
    splits = PriorSplits(prior, random(0).copy())
    splits.set_penalties(np.array([[mu[0]] * 2, [mu[1]] * 2]))
    before = splits.tx.copy(), splits.ty.copy(), splits.t_w.copy()
    splits.y[...] = random(1)
    splits.sweep(relax)
    return splits, before


def test_states_begin_as_the_differences_and_pixels_of_the_start_and_begin_anew_from_zero() -> None:
    start = random(0)
    splits = PriorSplits(TV, start.copy())
    np.testing.assert_array_equal(splits.tx, np.roll(start, -1, 2) - start)
    np.testing.assert_array_equal(splits.ty, np.roll(start, -1, 1) - start)
    np.testing.assert_array_equal(splits.t_w, start)
    np.testing.assert_array_equal(splits.mu, np.ones((2, 2)))
    splits.restart()
    assert not any(part.any() for part in (splits.y, splits.tx, splits.ty, splits.t_w))


@pytest.mark.parametrize("tv", [TV, ISOTROPIC])
@pytest.mark.parametrize("relax", [1.6, 0.0])
def test_a_sweep_is_what_the_text_says(tv: TotalVariation, relax: float) -> None:
    splits, (tx, ty, t_w) = swept(tv + L1(0.2) + NonNegativity(), relax=relax)
    y = random(1)
    ux, uy = soft(tx, ty, 0.3 / 0.7, tv.isotropic)
    w = np.maximum(t_w - 0.2 / 1.3, 0)
    new_x = tx + relax * (np.roll(y, -1, 2) - y - ux)
    new_y = ty + relax * (np.roll(y, -1, 1) - y - uy)
    new_w = t_w + relax * (y - w)
    np.testing.assert_allclose(splits.tx, new_x, atol=1e-12)
    np.testing.assert_allclose(splits.ty, new_y, atol=1e-12)
    np.testing.assert_allclose(splits.t_w, new_w, atol=1e-12)
    vx, vy = soft(new_x, new_y, 0.3 / 0.7, tv.isotropic)
    v = np.maximum(new_w - 0.2 / 1.3, 0)
    rx, ry = 2 * vx - new_x, 2 * vy - new_y
    back = np.roll(rx, 1, 2) - rx + np.roll(ry, 1, 1) - ry
    np.testing.assert_allclose(splits.y, 0.7 * back + 1.3 * (2 * v - new_w), atol=1e-12)
    np.testing.assert_allclose(splits.solution(), v, atol=1e-12)


def soft(x: np.ndarray, y: np.ndarray, threshold: float, isotropic: bool) -> tuple[np.ndarray, np.ndarray]:
    if isotropic:
        keep = np.maximum(1 - threshold / np.hypot(x, y), 0)
        return x * keep, y * keep
    return tuple(np.sign(t) * np.maximum(np.abs(t) - threshold, 0) for t in (x, y))  # type: ignore[return-value]


@pytest.mark.parametrize("tv", [TV, ISOTROPIC])
def test_penalties_that_change_leave_split_variables_and_multipliers(tv: TotalVariation) -> None:
    splits, _ = swept(tv + L1(0.2) + NonNegativity())

    def variables(mu_u: float, mu_w: float) -> tuple[np.ndarray, ...]:
        ux, uy = soft(splits.tx, splits.ty, 0.3 / mu_u, tv.isotropic)
        w = np.maximum(splits.t_w - 0.2 / mu_w, 0)
        return ux, uy, w, mu_u * (splits.tx - ux), mu_u * (splits.ty - uy), mu_w * (splits.t_w - w)

    before = variables(0.7, 1.3)
    splits.set_penalties(np.array([[2.1, 2.1], [0.4, 0.4]]))
    for now, then in zip(variables(2.1, 0.4), before, strict=True):
        np.testing.assert_allclose(now, then, atol=1e-12)
    np.testing.assert_array_equal(splits.mu, [[2.1, 2.1], [0.4, 0.4]])
    np.testing.assert_array_equal(splits.pixel_penalties, [0.4, 0.4])


def test_without_total_variation_differences_have_no_penalty() -> None:
    splits = PriorSplits(L1(0.2), random(0).copy())
    splits.set_penalties(np.array([[0.0, 0.0], [0.5, 0.8]]))
    np.testing.assert_array_equal(splits.mu, [[0.0, 0.0], [0.5, 0.8]])
    assert np.isfinite(splits.tx).all()
    splits.y[...] = random(1)
    splits.sweep(1.5)
    assert np.isfinite(splits.y).all()
    channel = splits.solution()[1]
    np.testing.assert_allclose(channel, L1(0.2).prox(splits.t_w[1], 1 / 0.8))


def told(prior: Any, **known: float) -> PriorSplits:
    """Return splits whose last sweep told these sums, of channel 0; of channel 1 the same."""
    splits = PriorSplits(prior, random(0).copy())
    splits._sums[...] = 0
    for name, value in known.items():
        splits._sums[[0, 5], getattr(splits._kernels, name)] = value / 4  # two rows of either channel
        splits._sums[[2, 7], getattr(splits._kernels, name)] = 3 * value / 4
    return splits


W = {"PRIMAL_W": 4.0, "NORM_W": 100.0, "CHANGE_W": 9.0, "MULTIPLIER_W": 25.0}
U = {"PRIMAL_U": 49.0, "NORM_U": 100.0, "CHANGE_U": 64.0, "MULTIPLIER_U": 100.0, "TV": 5.0, "L1": 7.0}


def test_residuals_are_the_largest_of_all_splits() -> None:
    assert told(L1(0.2), **W, **U).residuals() == pytest.approx((0.2, 0.6, 0.3))
    assert told(TV + L1(0.2), **W, **U).residuals() == pytest.approx((0.7, 0.8, 0.3))
    less = U | {"PRIMAL_U": 1.0, "CHANGE_U": 1.0}
    assert told(TV + L1(0.2), **W, **less).residuals() == pytest.approx((0.2, 0.6, 0.3))
    two = told(L1(0.2) + TotalVariation(0.3, axis_weights=(0.5, 1.0)), **W)
    (other,) = two.others
    other.sums = (81.0, 16.0, 100.0, 25.0)  # its primal residual 0.9, dual 0.8, change 0.4
    assert two.residuals() == pytest.approx((0.9, 0.8, 0.4))
    other.sums = (1.0, 1.0, 100.0, 25.0)
    assert two.residuals() == pytest.approx((0.2, 0.6, 0.3))


def test_the_value_is_that_of_all_priors_at_their_splits() -> None:
    assert told(L1(0.2), **U).value() == pytest.approx(2 * 0.2 * 7)
    assert told(TV + L1(0.2), **U).value() == pytest.approx(2 * (0.3 * 5 + 0.2 * 7))
    odd = TotalVariation(0.3, axis_weights=(0.5, 1.0))
    splits = told(L1(0.2) + odd, **U)
    assert splits.value() == pytest.approx(2 * 0.2 * 7 + odd.value(splits.others[0].split))


def test_penalties_are_balanced_each_by_its_own_residuals() -> None:
    splits = told(TV + L1(0.2), **W, **U)
    splits.mu[...] = [[2.0, 3.0], [5.0, 7.0]]
    u, w = (49 / 64 * (100 / 100)) ** 0.25, (4 / 9 * (25 / 100)) ** 0.25
    np.testing.assert_allclose(splits.balanced_penalties(), [[2 * u, 3 * u], [5 * w, 7 * w]])
    np.testing.assert_array_equal(splits.mu, [[2.0, 3.0], [5.0, 7.0]])
    for primal, change in ((100, 5), (10, 25)):
        calm = W | {"PRIMAL_W": primal * SETTLED**2, "CHANGE_W": change * SETTLED**2}
        np.testing.assert_array_equal(told(L1(0.2), **calm).balanced_penalties()[1], [1.0, 1.0])
    one = W | {"PRIMAL_W": 101 * SETTLED**2, "CHANGE_W": 25 * SETTLED**2}
    np.testing.assert_allclose(told(L1(0.2), **one).balanced_penalties()[1], 1.01**0.25)
    other = W | {"PRIMAL_W": 100 * SETTLED**2, "CHANGE_W": 25.25 * SETTLED**2}
    np.testing.assert_allclose(told(L1(0.2), **other).balanced_penalties()[1], 1.01**-0.25)
    for unknown in W:
        np.testing.assert_array_equal(
            told(L1(0.2), **(W | {unknown: 0.0})).balanced_penalties()[1], [1.0, 1.0]
        )


def test_priors_are_taken_apart_into_what_has_a_sweep_and_what_has_none() -> None:
    odd = TotalVariation(0.3, wrap=(False, True))
    assert is_plain(TV)
    assert is_plain(TotalVariation(0.3, wrap=(True, True)))
    assert not is_plain(odd)
    assert not is_plain(TotalVariation(0.3, axis_weights=(0.5, 1.0)))
    tv, separable, others = split_prior(TV + L1(0.2) + NonNegativity() + odd)
    assert tv is not None
    assert (tv.weight, separable.weight, separable.lower) == (0.3, 0.2, 0.0)
    assert [other.wrap for other in others] == [(False, True)]  # type: ignore[attr-defined]
    first, _, second = split_prior(TV + TotalVariation(0.9))
    assert first is not None
    assert (first.weight, [other.weight for other in second]) == (0.3, [0.9])  # type: ignore[attr-defined]
    none, zero, _ = split_prior(Zero())
    assert none is None
    assert zero.is_zero
    with pytest.raises(TypeError, match="HaarTotalVariation is only near"):
        split_prior(HaarTotalVariation(0.1))


def test_the_solution_is_the_other_priors_where_nothing_is_asked_of_pixels() -> None:
    odd = TotalVariation(0.3, axis_weights=(0.5, 1.0))
    alone, bounded = PriorSplits(odd, random(0).copy()), PriorSplits(odd + NonNegativity(), random(0).copy())
    np.testing.assert_array_equal(alone.solution(), alone.others[0].split)
    assert alone.solution() is not alone.others[0].split
    np.testing.assert_array_equal(bounded.solution(), np.maximum(random(0), 0))
    bounded.y[...] = 0
    right = bounded.y.copy()
    bounded.sweep(0.0)
    without = PriorSplits(NonNegativity(), random(0).copy())
    without.y[...] = right
    without.sweep(0.0)
    np.testing.assert_allclose(bounded.y - without.y, bounded.others[0].pull(), atol=1e-12)


def test_channels_one_after_the_other_are_all_at_once() -> None:
    whole, _ = swept(TV + L1(0.2) + NonNegativity())
    single = PriorSplits(TV + L1(0.2) + NonNegativity(), random(0).copy())
    single.set_penalties(np.array([[0.7, 0.7], [1.3, 1.3]]))
    single.y[...] = random(1)
    for channel in (1, 0):
        single.sweep(1.6, channel)
    for name in ("y", "tx", "ty", "t_w"):
        np.testing.assert_array_equal(getattr(single, name), getattr(whole, name))
    np.testing.assert_allclose(single.channel_sums(), whole.channel_sums(), rtol=1e-12)
