"""Verdicts are what was learned from cases with a truth, within limits that no case overrules."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from recon.verdict import judge
from recon.verdict.chance import FEATURES, FEATURES_OF_VOLUMES, Chances, fitted, place_of
from recon.verdict.evidence import Evidence
from recon.verdict.judge import Region

TV = "admm tv of volumes"
RNG = np.random.default_rng(3)


def evidence(detail: float = 20.0, unexplained: float = 0.02, **others: float) -> Evidence:
    numbers = {
        "signal": detail,
        "erased": 0.0,
        "saturated": 0.0,
        "lit": 0.05,
        "edges": 0.06,
        "load": 0.05,
        "planes": 1,
        "similarity": 0.0,
        "dimming": 1.0,
        "ambiguity": 0.2,
        "unsettled": 0.0,
    }
    return Evidence(**{**numbers, "detail": detail, "unexplained": unexplained, **others})  # type: ignore[arg-type]


def learned(cases: list[Evidence], failed: list[bool]) -> Chances:
    features = FEATURES if cases[0].peaks is None else FEATURES_OF_VOLUMES
    places = np.array([place_of(case.as_json(), features) for case in cases])
    return fitted(features, places, np.where(failed, 2.0, 0.5), range(len(cases)))


@cache
def planted_chances() -> Chances:
    """Pictures that fail below a detail of 5, above 20 % unexplained, and by a PSF that repeats itself."""
    rng = np.random.default_rng(3)
    cases, failed = [], []
    for detail in np.geomspace(0.5, 50, 15):
        for unexplained in np.geomspace(0.01, 1, 15):
            ambiguity, load, shown = rng.uniform(0.1, 0.9), rng.uniform(0.03, 0.08), rng.uniform(0.8, 1.25)
            cases.append(
                evidence(
                    float(detail),
                    float(unexplained),
                    signal=float(detail * shown),
                    ambiguity=ambiguity,
                    load=load,
                    saturated=float(rng.choice([0, 0.1])),
                )
            )
            failed.append(bool(detail < 5 or unexplained > 0.2 or ambiguity > 0.6))
    return learned(cases, failed)


@pytest.fixture(autouse=True)
def planted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judge, "shipped_chances", lambda: {"picture tv": planted_chances()})


def test_regions_are_where_they_were_planted() -> None:
    assert judge.verdict_on(evidence(30, 0.03), "admm tv").region is Region.INSIDE
    assert judge.verdict_on(evidence(1, 0.03), "admm tv").region is Region.OUTSIDE
    assert judge.verdict_on(evidence(30, 0.8), "admm tv").region is Region.OUTSIDE
    between = [judge.verdict_on(evidence(float(d), 0.03), "admm tv").region for d in np.geomspace(2, 20, 20)]
    order = [Region.OUTSIDE, Region.NEAR, Region.INSIDE]
    assert set(between) == set(order)
    assert between == sorted(between, key=order.index)
    # The same minimiser fails alike, whichever solver finds it.
    assert judge.verdict_on(evidence(30, 0.03), "fista tv").region is Region.INSIDE


def test_the_limiting_stress_is_named_with_what_helps() -> None:
    dim = judge.verdict_on(evidence(1, 0.03), "admm tv")
    assert dim.findings[0].stress in ("detail", "signal")
    assert "light" in " ".join(dim.sentences)
    moved = judge.verdict_on(evidence(30, 0.8), "admm tv")
    assert moved.findings[0].stress == "unexplained"
    assert "diffuserbench compare" in " ".join(moved.sentences)
    assert len(judge.verdict_on(evidence(30, 0.03), "admm tv").sentences) == 1


def test_who_overexposed_is_not_told_to_give_more_light() -> None:
    clipped = judge.verdict_on(evidence(1, 0.03, saturated=0.2), "admm tv")
    assert clipped.findings[0].stress == "saturated"
    assert "20% of the pixels used are at full scale" in clipped.sentences[1]
    assert "More light" not in " ".join(clipped.sentences)
    assert "More light" in " ".join(judge.verdict_on(evidence(1, 0.03, saturated=1e-3), "admm tv").sentences)


def of_volumes(*, bad: bool, spread: float = 0, rng: np.random.Generator = RNG) -> Evidence:
    """Grainy and hazy where bad, and alike in all else; with no spread, the typical one of its kind."""
    grain = 1 + spread * rng.uniform(-0.1, 0.1, 3)
    points = (2.0, 40.0, 1.6) if bad else (20.0, 3.0, 0.4)
    height, peaks, ends = (float(g * p) for g, p in zip(grain, points, strict=True))
    numbers = {"height": height, "peaks": peaks, "ends": ends, "planes": 4, "similarity": 0.7}
    detail, saturated = 22 + spread * rng.uniform(-4, 4), spread * float(rng.choice([0, 0.1]))
    return evidence(float(detail), 0.03, saturated=saturated, **numbers)


@cache
def volumes() -> Chances:
    rng = np.random.default_rng(3)
    bad = [bool(k % 2) for k in range(60)]
    return learned([of_volumes(bad=b, spread=1, rng=rng) for b in bad], bad)


def test_who_overexposed_a_volume_is_not_told_to_give_more_light() -> None:
    chances, grainy = volumes(), of_volumes(bad=True)
    clipped = judge.verdict_on(replace(grainy, saturated=0.05), TV, chances)
    assert clipped.findings[0].stress == "saturated"
    assert {f.stress for f in clipped.findings} <= {"saturated", "peaks", "ends"}
    assert "light would help" not in " ".join(clipped.sentences)
    dim = judge.verdict_on(replace(grainy, saturated=0.0), TV, chances)
    assert "More light" in " ".join(f.help for f in dim.findings)


def test_what_is_like_no_case_is_not_judged() -> None:
    unknown = judge.verdict_on(evidence(30, 0.03), "admm nonnegative")
    assert unknown.region is Region.UNKNOWN
    assert unknown.sentences == (
        "not judged: there are no known cases of admm nonnegative.",
        "The model leaves 1.3 times the noise, 3.0% of the measurement's contrast, unexplained.",
    )
    strange = judge.verdict_on(evidence(30, 0.03, load=40.0), "admm tv")
    assert strange.region is Region.UNKNOWN
    # What sets it apart is named, with what would help.
    assert strange.findings[0].stress == "load"
    assert strange.sentences[1].startswith("What sets it apart: 40 unknowns")
    # What is known without cases is said instead: 0.03 of a contrast of 30 times the noise, and the noise.
    assert strange.sentences[2].startswith("The model leaves 1.3 times the noise, 3.0%")
    # More light than any case had is as good as the most.
    assert judge.verdict_on(evidence(120, 0.03), "admm tv").region is Region.INSIDE
    assert judge.verdict_on(evidence(30, unsettled=20), "admm tv").region is Region.OUTSIDE


def test_data_without_noise_are_no_photograph() -> None:
    """Numbers in units of the noise mean nothing there, good or bad."""
    exact = judge.verdict_on(evidence(9e4, 0.03, load=5e-4), "admm tv")
    assert exact.region is Region.UNKNOWN
    assert len(exact.sentences) == 1
    assert "next to no noise" in exact.sentences[0]
    assert "%" not in exact.sentences[0]
    # Nor are they called unreliable for what is left unexplained beyond such a noise.
    misfit = judge.verdict_on(evidence(9e4, 0.8), "admm tv")
    assert misfit.region is Region.UNKNOWN
    assert misfit.sentences == exact.sentences
    # Too few iterations are seen without the noise.
    assert judge.verdict_on(evidence(9e4, 0.8, unsettled=20), "admm tv").region is Region.OUTSIDE
    # What is unlike all cases is not given a chance of failing.
    assert "%" not in judge.verdict_on(evidence(30, 0.03, load=40.0), "admm tv").sentences[0]


def test_a_picture_that_had_hardly_begun_to_settle_is_said_to_be_just_that() -> None:
    # A low chance of failing would contradict the verdict, and nothing else explains it.
    good = judge.verdict_on(evidence(30, 0.03, unsettled=20), "admm tv")
    assert good.failing is not None
    assert good.failing < 0.1
    assert len(good.sentences) == 2
    assert "hardly begun to settle" in good.sentences[0]
    assert "%" not in good.sentences[0]
    assert "More iterations" in good.sentences[1]
    # It would have failed as well: what remains unexplained may come of too few iterations, named first.
    bad = judge.verdict_on(evidence(30, 0.8, unsettled=20), "admm tv")
    assert bad.region is Region.OUTSIDE
    assert [f.stress for f in bad.findings[:2]] == ["unsettled", "unexplained"]
    assert "chance of failing" in bad.sentences[0]
    assert "More iterations" in bad.sentences[1]
    assert len([f for f in bad.findings if f.stress == "unsettled"]) == 1
    diverged = judge.verdict_on(evidence(30, 0.8, unsettled=1e3), "fista tv")
    assert "another method" in diverged.sentences[1]


def test_a_psf_that_repeats_itself_is_named() -> None:
    regular = judge.verdict_on(evidence(30, 0.03, ambiguity=0.82), "admm tv")
    assert regular.region is Region.OUTSIDE
    assert regular.findings[0].stress == "ambiguity"
    assert "repeats itself" in " ".join(regular.sentences)
    # More light would change nothing.
    assert "light" not in " ".join(regular.sentences)


@pytest.mark.parametrize(("detail", "unexplained"), [(30, 0.19), (600, 0.012)])
def test_no_case_overrules_what_the_model_leaves_unexplained(detail: float, unexplained: float) -> None:
    """Much of the contrast, or far above the noise, though similar cases were good."""
    cases = [evidence(float(d), float(u)) for d in (20, 100, 600) for u in np.geomspace(0.01, 0.3, 30)]
    chances = learned(cases, [c.unexplained > 0.25 for c in cases])
    judged = judge.verdict_on(evidence(detail, unexplained), "admm tv", chances)
    assert judged.failing is not None
    assert judged.failing < chances.reliable
    assert judged.region is Region.NEAR
    assert judged.findings[0].stress == "unexplained"
    assert f"{unexplained:.1%} of the measurement's contrast" in judged.sentences[0]


def test_a_run_that_was_still_changing_is_not_called_reliable() -> None:
    changing = judge.verdict_on(evidence(30, 0.03, unsettled=0.8), "admm tv")
    assert changing.region is Region.NEAR
    assert changing.findings[0].stress == "unsettled"
    assert "still changed" in changing.sentences[0]
    assert "%" not in changing.sentences[0]
    assert "More iterations" in changing.sentences[1]
    assert judge.verdict_on(evidence(30, 0.03, unsettled=0.1), "admm tv").region is Region.INSIDE


def test_volumes_are_judged_by_their_points() -> None:
    """Of two volumes alike in all else, the one that is grainy and hazy is like those that failed."""
    chances = volumes()
    good = judge.verdict_on(of_volumes(bad=False), TV, chances)
    assert good.region is Region.INSIDE
    bad = judge.verdict_on(of_volumes(bad=True), TV, chances)
    assert bad.region is Region.OUTSIDE
    assert {"height", "peaks", "ends"} & {f.stress for f in bad.findings}


def test_what_was_learned_is_the_same_from_a_file() -> None:
    chances = volumes()
    read = Chances.from_json(json.loads(json.dumps(chances.as_json(), allow_nan=False)))
    places = np.array([place_of(of_volumes(bad=b).as_json(), read.features) for b in (True, False)])
    np.testing.assert_allclose(read.chance(places), chances.chance(places), rtol=1e-3)
    assert read.distance(places[0]) == pytest.approx(chances.distance(places[0]), rel=1e-3)


def test_what_does_harm_is_never_taken_for_good_and_failing_together_is_seen() -> None:
    """Light comes with what fails, among these cases; and either of two numbers is harmless alone."""
    steps = RNG.normal(size=(300, 3))
    steps[:, 0] += 0.8 * steps[:, 1]
    failed = steps[:, 1] + steps[:, 2] > 0.5
    found = fitted(("signal", "grain", "lit"), steps, np.where(failed, 2.0, 0.5), range(300))
    more_light = found.blame(np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert more_light[1] <= more_light[0]
    both = np.where(steps[:, 1] * steps[:, 2] > 0, 2.0, 0.5)
    found = fitted(("a", "b", "c"), steps, both, range(300))
    together, apart = found.chance(np.array([[0.0, 1.4, 1.4], [0.0, 1.4, -1.4]]))
    assert together > 0.6 > 0.4 > apart


def test_chances_are_those_that_were_planted() -> None:
    """The regression returns the chance where cases fail by one, and not only whether."""
    places = RNG.normal(size=(4000, 2))
    chance = 1 / (1 + np.exp(-(places[:, 0] - places[:, 1] ** 2)))
    found = fitted(("a", "b"), places, np.where(RNG.random(4000) < chance, 2.0, 0.5), range(4000))
    inner = np.abs(places).max(axis=1) < 2
    assert np.abs(found.chance(places) - chance)[inner].mean() < 0.03
    called = found.chance(places) <= found.reliable
    assert chance[called].mean() < 0.08


def test_a_verdict_is_a_record() -> None:
    record = judge.verdict_on(evidence(1, 0.03), "admm tv").as_json()
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert record["region"] == "outside"


def test_methods_have_the_names_of_the_maps() -> None:
    assert judge.method_name("admm", "tv-isotropic") == "admm tv"
    assert judge.method_name("wiener", "none") == "wiener"
    assert judge.method_name("admm", "l1", volume=True) == "admm l1 of volumes"
