"""Verdicts are what the maps saw of similar cases."""

from __future__ import annotations

import json

import numpy as np
import pytest

from recon.verdict import cases, judge
from recon.verdict.evidence import Evidence
from recon.verdict.judge import Region

TV = "admm tv of volumes"


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


@pytest.fixture(autouse=True)
def planted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps in which a picture fails below a detail of 5, and above 20 % unexplained."""
    entries = []
    for detail in np.geomspace(0.5, 50, 15):
        for unexplained in np.geomspace(0.01, 1, 15):
            failed = detail < 5 or unexplained > 0.2
            numbers = evidence(float(detail), float(unexplained)).as_json()
            entries.append({"ix": 0, "iy": 0, "severity": 2.0 if failed else 0.5, **numbers})
    maps = {"planted": {"methods": {"admm tv, left out": {"evidence": entries}}}}
    cases.cases_of.cache_clear()
    monkeypatch.setattr(cases, "shipped_maps", lambda: maps)
    monkeypatch.setattr(cases, "mixed_scenes", lambda: ())
    yield
    cases.cases_of.cache_clear()


def test_regions_are_where_they_were_planted() -> None:
    assert judge.verdict_on(evidence(30, 0.03), "admm tv").region is Region.INSIDE
    assert judge.verdict_on(evidence(1, 0.03), "admm tv").region is Region.OUTSIDE
    assert judge.verdict_on(evidence(30, 0.8), "admm tv").region is Region.OUTSIDE
    assert judge.verdict_on(evidence(6, 0.03), "admm tv").region is Region.NEAR
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


def test_who_overexposed_a_volume_is_not_told_to_give_more_light(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = []
    for k in range(60):
        numbers = evidence(20 + 0.1 * k, peaks=40.0 if k % 2 else 3.0, height=20.0, ends=0.4)
        severity = 2.0 if k % 2 else 0.5
        entries.append({"scene": k, "method": TV, "severity": severity, "evidence": numbers.as_json()})
    monkeypatch.setattr(cases, "mixed_scenes", lambda: tuple(entries))
    cases.cases_of.cache_clear()
    grainy = {"peaks": 40.0, "height": 20.0, "ends": 0.4}
    clipped = judge.verdict_on(evidence(22, saturated=0.05, **grainy), TV)
    assert [f.stress for f in clipped.findings] == ["saturated", "peaks"]
    assert "A stronger prior (--tau) would help" in clipped.sentences[2]
    assert "light" not in " ".join(clipped.sentences).lower()
    dim = judge.verdict_on(evidence(22, **grainy), TV)
    assert "More light or a stronger prior (--tau) would help" in dim.sentences[1]


def test_what_no_map_saw_is_not_called_reliable() -> None:
    assert judge.verdict_on(evidence(30, 0.03), "admm nonnegative").region is Region.UNKNOWN
    strange = judge.verdict_on(evidence(30, 0.03, load=40.0), "admm tv")
    assert strange.region is Region.UNKNOWN
    # What sets it apart is named, with what would help.
    assert strange.findings[0].stress == "load"
    assert strange.sentences[1].startswith("What sets it apart: 40 unknowns")
    # More light than any case had is as good as the most.
    assert judge.verdict_on(evidence(500, 0.03), "admm tv").region is Region.INSIDE
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
    assert misfit.failing is not None
    assert misfit.failing > 0.5
    assert misfit.region is Region.UNKNOWN
    assert misfit.sentences == exact.sentences
    # Too few iterations are seen without the noise.
    assert judge.verdict_on(evidence(9e4, 0.8, unsettled=20), "admm tv").region is Region.OUTSIDE
    # What is unlike all cases is not given those cases' share of failures.
    assert "%" not in judge.verdict_on(evidence(30, 0.03, load=40.0), "admm tv").sentences[0]


def test_a_picture_that_had_hardly_begun_to_settle_is_said_to_be_just_that() -> None:
    # No similar case failed: their share would contradict the verdict, and nothing else explains it.
    good = judge.verdict_on(evidence(30, 0.03, unsettled=20), "admm tv")
    assert good.failing is not None
    assert good.failing < 0.05
    assert len(good.sentences) == 2
    assert "hardly begun to settle" in good.sentences[0]
    assert "%" not in good.sentences[0]
    assert "More iterations" in good.sentences[1]
    # Similar cases failed as well: what remains unexplained may come of too few iterations, named first.
    bad = judge.verdict_on(evidence(30, 0.8, unsettled=20), "admm tv")
    assert bad.region is Region.OUTSIDE
    assert [f.stress for f in bad.findings[:2]] == ["unsettled", "unexplained"]
    assert "% failed" in bad.sentences[0]
    assert "More iterations" in bad.sentences[1]
    assert len([f for f in bad.findings if f.stress == "unsettled"]) == 1
    diverged = judge.verdict_on(evidence(30, 0.8, unsettled=1e3), "fista tv")
    assert "another method" in diverged.sentences[1]


def test_a_psf_that_repeats_itself_is_judged_by_those_that_did(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = evidence(30, 0.03, ambiguity=0.82).as_json()
    lost = [
        {"scene": k, "method": "admm tv", "severity": 3.0, "evidence": {**numbers, "signal": 25.0 + k}}
        for k in range(12)
    ]
    monkeypatch.setattr(cases, "mixed_scenes", lambda: tuple(lost))
    cases.cases_of.cache_clear()
    regular = judge.verdict_on(evidence(30, 0.03, ambiguity=0.82), "admm tv")
    assert regular.region is Region.OUTSIDE
    assert regular.findings[0].stress == "ambiguity"
    assert "repeats itself" in " ".join(regular.sentences)
    assert judge.verdict_on(evidence(30, 0.03), "admm tv").region is Region.INSIDE


def test_a_run_that_was_still_changing_is_not_called_reliable() -> None:
    changing = judge.verdict_on(evidence(30, 0.03, unsettled=0.4), "admm tv")
    assert changing.region is Region.NEAR
    assert changing.findings[0].stress == "unsettled"
    assert "still changed" in changing.sentences[0]
    assert "%" not in changing.sentences[0]
    assert "More iterations" in changing.sentences[1]
    assert judge.verdict_on(evidence(30, 0.03, unsettled=0.1), "admm tv").region is Region.INSIDE


def test_volumes_are_judged_by_their_points_and_cases_without_them_take_no_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two volumes alike in all else, the one that is grainy and hazy is like those that failed."""

    def entries(with_points: bool) -> list[dict]:
        made = []
        for k in range(60):
            bad = k % 2
            points = {
                "height": 2.0 if bad else 20.0,
                "peaks": 40.0 if bad else 3.0,
                "ends": 1.6 if bad else 0.4,
            }
            numbers = evidence(20 + 0.1 * k, 0.03, planes=4, **(points if with_points else {})).as_json()
            severity = 2.0 if bad else 0.5
            made.append({"scene": k, "method": TV, "severity": severity, "evidence": numbers})
        return made

    monkeypatch.setattr(cases, "mixed_scenes", lambda: tuple(entries(True)))
    cases.cases_of.cache_clear()
    good = judge.verdict_on(evidence(22, height=20.0, peaks=3.0, ends=0.4), TV)
    assert good.region is Region.INSIDE
    bad = judge.verdict_on(evidence(22, height=2.0, peaks=40.0, ends=1.6), TV)
    assert bad.region is Region.OUTSIDE
    assert {f.stress for f in bad.findings} <= {"height", "peaks", "ends"}
    monkeypatch.setattr(cases, "mixed_scenes", lambda: tuple(entries(False)))
    cases.cases_of.cache_clear()
    old = judge.verdict_on(evidence(22, height=20.0, peaks=3.0, ends=0.4), TV)
    assert old.region is Region.UNKNOWN
    assert old.failing is None


def test_a_scene_can_be_judged_without_its_own_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    own = evidence(30, 0.03).as_json()
    entry = {"scene": 7, "method": "admm tv", "severity": 3.0, "evidence": own}
    monkeypatch.setattr(cases, "mixed_scenes", lambda: (entry,) * 12)
    cases.cases_of.cache_clear()
    known = cases.cases_of("picture tv")
    assert judge.verdict_on(evidence(30, 0.03), "admm tv").region is Region.OUTSIDE
    assert judge.verdict_on(evidence(30, 0.03), "admm tv", known.without(7)).region is Region.INSIDE
    assert len(known.without(8).severities) == len(known.severities) == 12 + 225


def test_a_verdict_is_a_record() -> None:
    record = judge.verdict_on(evidence(1, 0.03), "admm tv").as_json()
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert record["region"] == "outside"


def test_methods_have_the_names_of_the_maps() -> None:
    assert judge.method_name("admm", "tv-isotropic") == "admm tv"
    assert judge.method_name("wiener", "none") == "wiener"
    assert judge.method_name("admm", "l1", volume=True) == "admm l1 of volumes"
