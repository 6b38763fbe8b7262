"""The regressions of a verdict by their equations: places, terms, minimisers, curves, what is left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np
import pytest

from recon.verdict import chance
from recon.verdict.chance import (
    ALLOWED,
    BLUNT,
    FEATURES,
    HIGHEST,
    JOINT_BENT,
    MOST,
    Chances,
    fitted,
    is_whole,
    place_of,
    value_of,
)

RNG = np.random.default_rng(4)
EVIDENCE: Mapping[str, float] = {
    "detail": 20.0,
    "unexplained": 0.1,
    "load": 0.05,
    "signal": 8.0,
    "erased": 0.0,
    "saturated": 0.0,
    "ambiguity": 0.2,
    "edges": 0.06,
    "lit": 0.03,
}


def logistic(logits: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-logits)))


def some_chances(features: tuple[str, ...] = ("detail", "unexplained", "lit")) -> Chances:
    n = len(features)
    lower = RNG.random(n)
    return Chances(
        features,
        RNG.normal(size=n),
        RNG.uniform(0.5, 2, n),
        np.stack([lower - 1, lower + 1], axis=1),
        RNG.normal(size=n),
        RNG.normal(size=1 + 2 * n),
        RNG.normal(size=1 + n * (n + 3) // 2),
        np.eye(n) + 0.2,
        3.0,
        0.2,
        30,
        10,
    )


def test_a_place_is_the_logarithm_of_what_stands_above_a_floor() -> None:
    features = ("detail", "unexplained", "saturated", "grain", "residual", "missed")
    place = place_of(EVIDENCE, features)
    beyond2 = (8 * 0.1) ** 2
    numbers = [20 + 0.05, 0.1 + 0.02, 0.01, 0.061 / 0.031 + 0.05, (1 + beyond2) ** 0.5 + 0.01]
    numbers += [(1 + beyond2) / (1 + 8**2) + 0.03]
    np.testing.assert_allclose(place, np.log(numbers))
    for name, coordinate in zip(features[:3], place[:3], strict=True):
        assert value_of(name, coordinate) == pytest.approx(EVIDENCE[name])
    assert value_of("detail", np.log(0.05)) == pytest.approx(0)
    more = place_of({**EVIDENCE, "unexplained": 99.0}, ("missed",))
    assert more == pytest.approx(np.log(1.03)), "no more is missed than there is"
    assert place_of({**EVIDENCE, "detail": np.inf}, ("detail",)) == [1e3]
    assert place_of({**EVIDENCE, "saturated": -1.0}, ("saturated",)) == pytest.approx(np.log(0.01))


def test_what_follows_from_other_evidence_need_not_be_told() -> None:
    assert is_whole(EVIDENCE, FEATURES)
    assert is_whole({**EVIDENCE, "more": 1.0}, FEATURES)
    assert not is_whole({name: value for name, value in EVIDENCE.items() if name != "load"}, FEATURES)


def test_a_chance_is_the_mean_of_two_regressions_in_logits_within_the_cases_scatter() -> None:
    found = some_chances()
    for place in RNG.normal(size=(5, 3)):
        a, b, c = np.clip((place - found.centre) / found.spread, -MOST, MOST)
        own = found.coefficients @ [1, a, b, c, a * a, b * b, c * c]
        joint = found.joint @ [1, a, b, c, a * a, a * b, a * c, b * b, b * c, c * c]
        assert found.chance(place) == pytest.approx(logistic((own + joint) / 2))
        assert found.blame(place) == pytest.approx(logistic(own))
        step = (place - found.centre) / found.spread
        expected = sum(step[i] * step[j] * found.precision[i, j] for i in range(3) for j in range(3))
        assert found.distance(place) == pytest.approx(expected**0.5)
    places = RNG.normal(size=(2, 4, 3))
    assert found.chance(places).shape == (2, 4)
    assert found.chance(places)[1, 2] == pytest.approx(found.chance(places[1, 2]))
    sure = replace(found, coefficients=found.coefficients * 1e4, joint=found.joint * 1e4)
    assert (sure.chance(places) > 0).all()
    assert {round(float(p)) for p in sure.chance(places).ravel()} <= {0, 1}


def test_more_light_than_any_case_had_is_as_good_as_the_most() -> None:
    found = some_chances()  # of which detail is better, unexplained worse, and lit neither
    (low0, high0), (low1, high1), _ = found.best
    above = found.no_better_than_any(np.array([high0 + 1, high1 + 1, 99.0]))
    np.testing.assert_allclose(above, [high0, high1 + 1, 99])
    below = found.no_better_than_any(np.array([low0 - 1, low1 - 1, -99.0]))
    np.testing.assert_allclose(below, [low0 - 1, low1, -99])
    given = found.best.mean(axis=1)
    assert found.no_better_than_any(given) is not given
    np.testing.assert_array_equal(found.no_better_than_any(given), given)


def test_regressions_come_back_from_their_file() -> None:
    found = some_chances()
    entry = json.loads(json.dumps(found.as_json()))
    again = Chances.from_json(entry)
    for one in fields(Chances):
        kept, came = getattr(found, one.name), getattr(again, one.name)
        assert np.shape(kept) == np.shape(came)
        if isinstance(kept, np.ndarray):
            np.testing.assert_allclose(came, kept, rtol=1e-5)
        else:
            assert came == kept
    assert entry["centre"][0] == float(f"{found.centre[0]:.6g}")


def test_a_ridge_has_no_slope_left_at_its_minimum_and_spares_the_constant() -> None:
    steps = RNG.normal(size=(40, 3))
    terms, wanted, strength = chance._joint_terms(steps), RNG.normal(size=40) + 5, 7.0
    found = chance._ridge(terms, wanted, strength)
    weights = np.array([0, *[1.0] * 3, *[JOINT_BENT] * 6])
    slope = terms.T @ (terms @ found - wanted) + strength * weights * found
    np.testing.assert_allclose(slope, 0, atol=1e-9)


def surprise(coefficients: np.ndarray, terms: np.ndarray, failed: np.ndarray) -> float:
    p = logistic(terms @ coefficients)
    return float(-np.sum(failed * np.log(p) + (1 - failed) * np.log(1 - p)))


def test_a_feature_of_known_effect_never_has_the_other_one() -> None:
    """Slopes at both ends are of its sign or none; within that nothing near is less surprising."""
    steps = np.clip(RNG.normal(size=(60, 3)), -MOST, MOST)
    failed = (steps @ [2.0, 2.0, 1.0] + RNG.normal(size=60) > 0).astype(float)  # all three do harm
    terms, signs = chance._terms(steps), np.array([1, -1, 0])
    found = chance._regressed(terms, failed, 2.0, signs)
    linear, squared = found[1:4], found[4:]
    for end in (-MOST, MOST):
        slopes = linear + 2 * end * squared
        assert slopes[0] >= -1e-9
        assert slopes[1] <= 1e-9
    assert linear[0] > 0.1
    assert linear[2] > 0.1
    assert abs(linear[1]) < 1e-6, "it would have done harm: it does nothing"
    penalty = np.array([1e-3, 2, 2, 2, 2 * chance.BENT, 2 * chance.BENT, 2 * chance.BENT])

    def objective(at: np.ndarray) -> float:
        return surprise(at, terms, failed) + float(penalty @ at**2) / 2

    free = chance._regressed(terms, failed, 2.0, np.zeros(3, int))
    slope = terms.T @ (logistic(terms @ free) - failed) + penalty * free
    np.testing.assert_allclose(slope, 0, atol=2e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_where_more_harm_would_begin_by_doing_good_the_slope_begins_with_none(sign: int) -> None:
    """Only the highest fail: a free parabola would fall at first."""
    steps = np.linspace(-MOST, MOST, 80)[:, None] * sign
    failed = (sign * steps[:, 0] > 1).astype(float)
    terms = chance._terms(steps)
    free, bound = (chance._regressed(terms, failed, 0.1, np.array([s])) for s in (0, sign))

    def slopes(at: np.ndarray) -> np.ndarray:
        return sign * (at[1] + 2 * MOST * np.array([-sign, sign]) * at[2])

    assert slopes(free)[0] < -0.1
    assert slopes(bound)[0] == pytest.approx(0, abs=1e-6)
    assert slopes(bound)[1] > 1
    penalty = np.array([1e-3, 0.1, 0.1 * chance.BENT])

    def objective(at: np.ndarray) -> float:
        return surprise(at, terms, failed) + float(penalty @ at**2) / 2

    for direction in RNG.normal(size=(50, 3)):
        moved = bound + 0.05 * direction
        if (slopes(moved) >= 0).all():
            assert objective(moved) > objective(bound)


def test_cases_that_are_left_out_are_told_by_the_others_alone() -> None:
    terms, wanted = RNG.normal(size=(8, 2)), np.arange(8.0)
    folds = [np.array([0, 0, 1, 1, 2, 2, 3, 3]), np.array([0, 1, 0, 1, 0, 1, 0, 1])]
    given = []

    def regress(others: np.ndarray, wanted: np.ndarray, penalty: float) -> np.ndarray:
        given.append(len(others))
        return np.array([wanted.mean(), penalty])

    told = chance._left_out(regress, terms, wanted, folds, 0.5)
    for case in range(8):
        means = [wanted[fold != fold[case]].mean() for fold in folds]
        expected = np.mean([terms[case] @ [mean, 0.5] for mean in means])
        assert told[case] == pytest.approx(expected)
    assert given == [6, 6, 6, 6, 4, 4]


def test_a_curve_makes_chances_of_what_was_told() -> None:
    told = np.linspace(-2, 2, 401)
    chances = logistic(0.7 + 1.5 * told)
    failed = (RNG.random(401) < chances).astype(float)
    offset, slope = chance._curve(told, failed)
    assert offset == pytest.approx(0.7, abs=0.5)
    assert slope == pytest.approx(1.5, abs=0.5)
    p = logistic(offset + slope * told)
    np.testing.assert_allclose([np.sum(p - failed), np.sum((p - failed) * told)], 0, atol=0.05)
    terms = np.stack([np.ones(401), told], axis=1)
    assert chance._surprise(offset + slope * told, failed) == pytest.approx(
        surprise(np.array([offset, slope]), terms, failed)
    )


def cases(n: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Places of which the first feature alone does harm, and how badly; the second never varies."""
    places = np.stack([RNG.normal(size=n) * 2 + 3, np.full(n, -1.0)], axis=1)
    return places, np.exp(places[:, 0] - 4 + 0.2 * RNG.normal(size=n))


@pytest.fixture(scope="module")
def told() -> tuple[Chances, np.ndarray, np.ndarray]:
    places, severities = cases()
    return fitted(("load", "lit"), places, severities, range(len(places))), places, severities


def test_what_is_kept_of_cases_is_theirs(told: tuple[Chances, np.ndarray, np.ndarray]) -> None:
    found, places, severities = told
    np.testing.assert_allclose(found.centre, places.mean(axis=0))
    np.testing.assert_allclose(found.spread, [places[:, 0].std(), 0.1])  # a tenth is no difference
    np.testing.assert_allclose(found.best, [[places[:, 0].min(), places[:, 0].max()], [-1, -1]])
    np.testing.assert_allclose(found.typical, np.median(places[severities < 0.7], axis=0))
    scatter = np.array([[1 + BLUNT, 0], [0, BLUNT]])
    np.testing.assert_allclose(found.precision, np.linalg.inv(scatter), atol=1e-9)
    assert found.far == pytest.approx(max(found.distance(place) for place in places))
    assert (found.n_cases, found.n_scenes, found.features) == (120, 120, ("load", "lit"))


def test_what_does_harm_is_learned_and_the_threshold_lets_few_failures_pass(
    told: tuple[Chances, np.ndarray, np.ndarray],
) -> None:
    found, places, severities = told
    for by in (found.chance, found.blame):
        chances = by(np.stack([np.linspace(-1, 9, 50), np.full(50, -1.0)], axis=1))
        assert (np.diff(chances) > -1e-4).all()
        assert chances[0] < 0.1
        assert chances[-1] > 0.9
        assert np.interp(0.5, chances, np.linspace(-1, 9, 50)) == pytest.approx(4, abs=0.7)
    assert 0 < found.reliable <= HIGHEST
    called = found.chance(places) <= found.reliable
    assert np.mean(severities[called] >= 1) <= 1.5 * ALLOWED
    assert called.mean() > 0.5


def test_where_all_failed_nothing_is_called_reliable() -> None:
    places, _ = cases(30)
    found = fitted(("lit", "edges"), places, np.full(30, 1.0), range(30))
    assert found.reliable == 0
    np.testing.assert_allclose(found.typical, np.median(places, axis=0))


def test_penalties_are_those_by_which_cases_left_out_are_told_best_and_the_threshold_is_theirs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is told of cases left out is planted: 50 that go well, but for two of them, and 50 that fail."""
    places, _ = cases(100)
    severities = np.array([0.5] * 47 + [0.7, 1.0, 1.5] + [3.0] * 50)
    failed, severe = severities >= 1, np.log(np.clip(severities, 0.5, 2))
    odds, told = np.where(np.arange(100) < 50, np.linspace(-6, -2, 100), 3.0), severe + [0.8, -0.9] * 50
    seen: list[list[np.ndarray]] = []

    def left_out(_: object, terms: np.ndarray, wanted: np.ndarray, folds: list, penalty: float) -> np.ndarray:
        assert len(terms) == len(wanted) == 100
        seen.append(folds)
        if penalty in chance.PENALTIES:
            return odds if penalty == 4 else np.zeros(100)
        return told if penalty == 100 else told + [0.9, -0.9] * 50

    monkeypatch.setattr(chance, "_left_out", left_out)
    scenes = np.repeat(np.arange(50), 2)
    found = fitted(("load", "lit"), places, severities, scenes)
    near = np.clip((places - found.centre) / found.spread, -MOST, MOST)
    by_steps = chance._regressed(chance._terms(near), failed, 4.0, np.array([1, 0]))
    np.testing.assert_allclose(found.coefficients, by_steps)
    offset, slope = chance._curve(told, failed)
    joint = slope * chance._ridge(chance._joint_terms(near), severe, 100.0)
    np.testing.assert_allclose(found.joint, [joint[0] + offset, *joint[1:]])
    np.testing.assert_allclose(found.typical, np.median(places[:47], axis=0))
    unseen = logistic((odds + offset + slope * told) / 2)
    most = [u for u in unseen if failed[unseen <= u].mean() <= 0.04 and u <= HIGHEST]
    assert found.reliable == pytest.approx(max(most))
    assert failed[unseen <= max(most)].mean() == 0.04
    for folds in seen:
        assert len(folds) == 4
        for fold in folds:
            assert list(np.bincount(fold)) == [10] * 10
            assert (fold[::2] == fold[1::2]).all(), "a scene's cases are left out together"
        assert not np.array_equal(folds[0], folds[1])


@pytest.mark.parametrize(("first_failure", "last_reliable"), [(95, 62), (30, 30)])
def test_the_threshold_is_no_higher_than_the_highest_and_lets_no_more_failures_pass(
    first_failure: int, last_reliable: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    odds, places = np.linspace(-8, 2, 100), np.random.default_rng(2).normal(size=(100, 2))
    monkeypatch.setattr(chance, "_left_out", lambda *_: odds)
    monkeypatch.setattr(chance, "_curve", lambda *_: (0.0, 0.0))
    severities = np.where(np.arange(100) < first_failure, 0.5, 2.0)
    unseen = logistic(odds / 2)
    assert unseen[62] <= HIGHEST < unseen[63]
    found = fitted(("load", "lit"), places, severities, range(100))
    assert found.reliable == pytest.approx(unseen[last_reliable])


def test_the_threshold_counts_those_of_which_the_chance_decides() -> None:
    places, severities = cases()
    wrong = severities.copy()
    low = np.argsort(places[:, 0])[:20]
    wrong[low[::2]] = 2.0  # failures where all is well, which another rule sees
    decides = np.ones(120, bool)
    decides[low[::2]] = False
    every = fitted(("load", "lit"), places, wrong, range(120))
    those = fitted(("load", "lit"), places, wrong, range(120), decides)
    none = fitted(("load", "lit"), places, wrong, range(120), np.zeros(120, bool))
    assert none.reliable == every.reliable < those.reliable
    np.testing.assert_array_equal(every.coefficients, those.coefficients)


def test_a_scene_is_left_out_whole() -> None:
    """Two cases of each scene that are alike to a hair, of which nothing else tells."""
    rng = np.random.default_rng(9)
    own = rng.normal(size=(40, 2))
    places, failed = np.repeat(own, 2, axis=0), np.repeat(np.where(rng.random(40) < 0.5, 2.0, 0.5), 2)
    scenes = np.repeat(np.arange(40), 2)
    apart, together = (fitted(("lit", "edges"), places, failed, s) for s in (range(80), scenes))
    assert (apart.n_scenes, together.n_scenes) == (80, 40)
    assert together.reliable <= apart.reliable
