"""Every prox against numerical minimisation; differences against their adjoint and Fourier symbol."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from recon.priors import (
    L1,
    Box,
    Differences,
    HaarTotalVariation,
    NonNegativity,
    Prior,
    Separable,
    TotalVariation,
    Zero,
)

SEPARABLE = [
    Zero(),
    L1(0.7),
    NonNegativity(),
    Box(-0.2, 0.5),
    L1(0.7) + NonNegativity(),
    L1(0.3) + Box(0.1, 0.9),
]


@pytest.mark.parametrize("prior", SEPARABLE, ids=lambda p: f"{p.weight}-{p.lower}-{p.upper}")
def test_separable_prox_minimises(prior):
    step = 0.6
    for x in np.linspace(-2, 2, 41):
        low, high = max(prior.lower, -3), min(prior.upper, 3)
        best = minimize_scalar(
            lambda p, x=x: step * prior.weight * abs(p) + 0.5 * (p - x) ** 2,
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-10},
        ).x
        assert prior.prox(np.array([x]), step)[0] == pytest.approx(best, abs=2e-5)


def test_value_is_infinite_outside_the_box():
    assert NonNegativity().value(np.array([1.0, -1e-9])) == np.inf
    assert (L1(2.0) + NonNegativity()).value(np.array([1.0, 3.0])) == 8
    assert Box(0, 1).value(np.array([0.0, 1.0])) == 0


def perturbation_test(prior: Prior, x: np.ndarray, step: float, slack: float) -> None:
    """No small move from the prox, in any of many directions, may lower the objective."""
    rng = np.random.default_rng(0)
    p = prior.prox(x, step)

    def objective(q: np.ndarray) -> float:
        return step * prior.value(q) + 0.5 * float(np.sum((q - x) ** 2))

    best = objective(p)
    assert np.isfinite(best)
    for scale in (1e-3, 1e-2, 1e-1):
        for _ in range(100):
            direction = rng.standard_normal(x.shape) * (rng.random(x.shape) < rng.random())
            assert objective(p + scale * direction) >= best - slack
    for q in (x, 0 * x, x + 0 * x.mean(), np.maximum(x, 0)):
        assert objective(q) >= best - slack


@pytest.mark.parametrize("separable", [Zero(), NonNegativity(), L1(0.2) + NonNegativity()])
@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("wrap", [(True, True), (False, True)])
def test_total_variation_prox_minimises(isotropic, wrap, separable):
    x = np.random.default_rng(1).standard_normal((2, 6, 7))
    prior = TotalVariation(0.4, isotropic=isotropic, axis_weights=(0.5, 1.0), wrap=wrap, tolerance=1e-12)
    perturbation_test((prior + separable), x, 0.8, 1e-9)


def test_total_variation_of_three_axes():
    x = np.random.default_rng(1).standard_normal((3, 5, 4))
    prior = TotalVariation(
        0.3, axis_weights=(0.2, 1, 1), wrap=(False, True, True), tolerance=1e-12, max_inner=2000
    )
    perturbation_test(prior + NonNegativity(), x, 1.0, 1e-9)


def test_one_dimensional_total_variation_equals_an_exact_solution():
    """Of two levels, TV denoising moves each by strength * 2 / length (two edges on a ring)."""
    x = np.zeros((1, 20))
    x[0, 5:15] = 1
    p = TotalVariation(0.5, axis_weights=(1.0,), tolerance=1e-14, max_inner=5000).prox(x, 1.0)
    assert p[0, 10] == pytest.approx(1 - 2 * 0.5 / 10, abs=1e-5)
    assert p[0, 0] == pytest.approx(2 * 0.5 / 10, abs=1e-5)


def test_isotropic_and_anisotropic_values():
    x = np.zeros((1, 4, 4))
    x[0, 2, 2] = 1
    assert TotalVariation(3.0).value(x) == pytest.approx(12)
    assert TotalVariation(3.0, isotropic=True).value(x) == pytest.approx(3 * (2 + np.sqrt(2)))
    assert HaarTotalVariation(3.0).value(x) == pytest.approx(12)
    assert HaarTotalVariation(3.0).value(x * 0 + 1) == 0


def test_total_variation_with_nothing_to_do():
    x = np.random.default_rng(0).standard_normal((1, 4, 4)).astype(np.float32)
    assert np.array_equal(TotalVariation(0.0).prox(x, 1.0), x)
    assert (TotalVariation(0.0) + NonNegativity()).prox(x, 1.0).min() == 0
    assert TotalVariation(1.0).prox(x, 0.1).dtype == np.float32


def test_haar_prox_is_the_text_s_recipe():
    """Eqs. A.1 and A.2 written out, per axis, averaged."""
    x = np.random.default_rng(2).standard_normal((1, 6, 8))
    weight, step = 0.1, 0.7
    threshold = 2 * 2 * weight * step
    results = []
    for axis in (-2, -1):
        ahead = np.roll(x, -1, axis)
        diff, total = (ahead - x) / 2, (ahead + x) / 2
        diff = np.sign(diff) * np.maximum(np.abs(diff) - threshold, 0)
        results.append((total - diff) / 2 + np.roll((total + diff) / 2, 1, axis))
    assert HaarTotalVariation(weight).prox(x, step) == pytest.approx(np.mean(results, axis=0))


def test_haar_prox_is_close_to_the_exact_one_for_small_weights():
    x = np.random.default_rng(3).standard_normal((1, 16, 16))
    exact = TotalVariation(1.0, tolerance=1e-14, max_inner=3000).prox(x, 1e-3)
    assert np.linalg.norm(HaarTotalVariation(1.0).prox(x, 1e-3) - exact) < 0.1 * np.linalg.norm(exact - x)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("wrap", [(True, True), (False, True), (False, False)])
@pytest.mark.parametrize("shape", [(2, 5, 6), (1, 1, 4), (1, 1, 1)])
def test_differences_adjoint(shape, wrap, dtype):
    psi = Differences(shape, (0.5, 2.0), wrap, dtype)
    rng = np.random.default_rng(0)
    x = rng.standard_normal(psi.domain_shape).astype(dtype)
    y = rng.standard_normal(psi.range_shape).astype(dtype)
    forward = psi.forward(x)
    assert np.vdot(forward, y) == pytest.approx(
        np.vdot(x, psi.adjoint(y)), abs=1e-4 if dtype == np.float32 else 1e-12
    )
    assert np.linalg.norm(forward) <= psi.norm_bound * np.linalg.norm(x)


@pytest.mark.parametrize("weights", [(0.7,), (0.5, 2.0), (0.3, 0.5, 2.0)])
def test_the_bound_of_wrapped_differences_is_their_norm(weights):
    psi = Differences((2, 4, 6), weights, dtype=np.float64)  # of even sides: light and dark in turn
    units = np.eye(48).reshape(-1, 2, 4, 6)
    norm = np.linalg.norm(np.stack([psi.forward(unit).ravel() for unit in units]), 2)
    assert psi.norm_bound == pytest.approx(norm)


def test_differences_may_weigh_each_depth_otherwise():
    by_depth = np.array([[0.3, 1.0, 0.5], [0.4, 0.9, 2.0]])
    x = np.random.default_rng(0).standard_normal((2, 4, 6))
    psi = Differences(x.shape, by_depth, dtype=np.float64)
    expected = np.stack([np.roll(x, -1, axis) - x for axis in range(3)]) * by_depth.T[:, :, None, None]
    np.testing.assert_allclose(psi.forward(x), expected)
    assert np.linalg.norm(psi.forward(x)) <= psi.norm_bound * np.linalg.norm(x)
    assert psi.norm_bound == pytest.approx(2 * np.sqrt(0.4**2 + 1.0 + 4.0))


@pytest.mark.parametrize(
    ("weights", "wrap", "words"),
    [
        ((1.0, 1.0), (True,), "wrap has 1 entries for 2 weights"),
        ((1.0,) * 4, None, r"Weights \(4,\) do not fit"),
        (np.ones((3, 2)), None, r"Weights \(3, 2\) do not fit"),
        (np.ones((2, 2, 2)), None, "do not fit"),
        (np.ones(0), None, "do not fit"),
    ],
)
def test_weights_that_do_not_fit_are_refused(weights, wrap, words):
    with pytest.raises(ValueError, match=words):
        Differences((2, 4, 6), weights, wrap)


def test_haar_total_variation_is_of_each_picture_by_itself():
    x = np.random.default_rng(5).standard_normal((2, 5, 6))
    assert HaarTotalVariation(0.3).value(x) == pytest.approx(TotalVariation(0.3).value(x))
    alone = np.concatenate([HaarTotalVariation(0.3).prox(one[None], 0.7) for one in x])
    np.testing.assert_allclose(HaarTotalVariation(0.3).prox(x, 0.7), alone)


def test_sums_that_are_not_known_are_refused():
    with pytest.raises(TypeError, match="TotalVariation, TotalVariation"):
        (TotalVariation(1.0) + TotalVariation(1.0)).prox(np.ones((1, 4, 4)), 1.0)
    total = NonNegativity() + L1(0.5) + L1(0.25)
    assert isinstance(total, Separable)
    assert (total.weight, total.lower) == (0.75, 0.0)
    tv, separable = (TotalVariation(1.0) + NonNegativity()).terms()
    assert isinstance(tv, TotalVariation)
    assert separable.lower == 0
    for weight in (-1.0, float("nan")):
        for prior in (L1, TotalVariation, HaarTotalVariation):
            with pytest.raises(ValueError, match="must be a number, 0 or more, not"):
                prior(weight)
    with pytest.raises(ValueError, match="above its upper"):
        Box(1, 0)


def beck_teboulle(prior, x, step, iterations, dual):
    """Beck & Teboulle 2009, written out: the prox after so many steps from a dual variable, and the last."""
    strength = prior.weight * step
    rate = 1 / (strength * (2 * np.sqrt(np.sum(prior.axis_weights**2))) ** 2)
    wy, wx = prior.axis_weights

    def forward(p):
        return np.stack([wy * (np.roll(p, -1, -2) - p), wx * (np.roll(p, -1, -1) - p)])

    def adjoint(d):
        return wy * (np.roll(d[0], 1, -2) - d[0]) + wx * (np.roll(d[1], 1, -1) - d[1])

    def project(d):
        return d / np.maximum(1, np.sqrt(np.sum(d**2, axis=0))) if prior.isotropic else np.clip(d, -1, 1)

    ahead, t = dual, 1.0
    for _ in range(iterations):
        p = prior.separable.prox(x - strength * adjoint(ahead), step)
        new = project(ahead + rate * forward(p))
        t_next = (1 + np.sqrt(1 + 4 * t**2)) / 2
        ahead = new + (t - 1) / t_next * (new - dual)
        dual, t = new, t_next
    return p, dual


@pytest.mark.parametrize("isotropic", [False, True])
def test_the_prox_of_total_variation_goes_the_papers_way_from_where_it_was(isotropic):
    x = np.random.default_rng(4).standard_normal((2, 6, 7))
    prior = TotalVariation(0.4, isotropic=isotropic, axis_weights=(0.5, 1.0), tolerance=0.0, max_inner=7)
    prior = prior + L1(0.1) + NonNegativity()
    dual = np.zeros((2, *x.shape))
    for moved in (x, x + 0.1):
        expected, dual = beck_teboulle(prior, moved, 0.8, 7, dual)
        np.testing.assert_allclose(prior.prox(moved, 0.8), expected, atol=1e-12)
        np.testing.assert_allclose(prior.memory, dual, atol=1e-12)
    for other in (x[:1], x.astype(np.float32)):  # of another shape or precision nothing is known
        fresh, _ = beck_teboulle(prior, other.astype(np.float64), 0.8, 7, np.zeros((2, *other.shape)))
        np.testing.assert_allclose(prior.prox(other, 0.8), fresh, atol=1e-5)
        assert prior.memory.dtype == other.dtype
    x[0, 0, 0] = np.nan
    prior.prox(x, 0.8)
    assert prior.memory is None


@pytest.mark.parametrize("isotropic", [False, True])
def test_the_prox_ends_at_every_fifth_step_once_its_gap_is_small_enough(isotropic):
    x = np.random.default_rng(4).standard_normal((1, 6, 7))

    def found(**when):
        prior = TotalVariation(0.4, isotropic=isotropic, axis_weights=(0.5, 1.0), separable=L1(0.1), **when)
        return prior.prox(x, 0.8)

    plain = TotalVariation(0.4, isotropic=isotropic, axis_weights=(0.5, 1.0), separable=L1(0.1))
    third, *steps = (beck_teboulle(plain, x, 0.8, n, np.zeros((2, *x.shape)))[0] for n in (3, 5, 10, 15, 20))
    np.testing.assert_allclose(found(tolerance=1.0), steps[0], atol=1e-12)
    np.testing.assert_allclose(found(tolerance=1.0, max_inner=3), third, atol=1e-12)

    def objective(p):
        return 0.8 * plain.value(p) + 0.5 * float(np.sum((p - x) ** 2))

    best = objective(found(tolerance=1e-14, max_inner=20_000))
    size = 0.5 * float(np.sum(x**2))
    off = [(objective(step) - best) / size for step in steps]
    assert off == sorted(off, reverse=True)
    # The gap is a bound: what is accepted is as good as asked, and the gap of the first four is no more than
    # several times what is left.
    for tolerance in (1e-3, 1e-5, 1e-7):
        accepted = found(tolerance=tolerance, max_inner=5000)
        assert (objective(accepted) - best) / size <= tolerance
    every_fifth = [beck_teboulle(plain, x, 0.8, n, np.zeros((2, *x.shape)))[0] for n in range(5, 61, 5)]
    ended = set()
    for tolerance in np.geomspace(1e-1, 1e-3, 9):
        accepted = found(tolerance=tolerance, max_inner=5000)
        ended |= {n for n, step in enumerate(every_fifth) if np.allclose(accepted, step, atol=1e-12)}
        assert any(np.allclose(accepted, step, atol=1e-12) for step in every_fifth)
    assert len(ended) > 1
