"""A verdict's rules one at a time: where each begins, what is said then, what is named first."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from recon.verdict import judge
from recon.verdict.calibration_check import CalibrationCheck, Fit
from recon.verdict.chance import Chances, place_of, value_of
from recon.verdict.coded import CODED, coded, straight
from recon.verdict.evidence import DIVERGED, Evidence
from recon.verdict.judge import Region, Verdict
from tests.recon.verdict.test_judge import evidence


class Told:
    """Cases that tell a chance, and blame each number by so much for each step to the typical one."""

    features = ("detail", "unexplained", "load", "signal", "saturated", "lit")
    reliable, far = 0.2, 4.0
    n_cases, n_scenes = 30, 10

    def __init__(self, chance: float, distance: float = 1.0, **shares: float) -> None:
        self._chance, self._distance = chance, distance
        self._shares = np.array([shares.get(name, 0.0) for name in self.features])
        good = {
            "detail": 40.0,
            "unexplained": 0.01,
            "load": 0.05,
            "signal": 40.0,
            "saturated": 0.0,
            "lit": 0.05,
        }
        self.typical = place_of({**good, "edges": 0.06}, self.features)

    def chance(self, _: Any) -> float:
        return self._chance

    def distance(self, _: Any) -> float:
        return self._distance

    def blame(self, place: Any) -> float:
        return float(self._shares @ np.abs(place - self.typical))

    def no_better_than_any(self, place: Any) -> Any:
        return place


def judged(told: Told, **numbers: float) -> Verdict:
    found: Evidence = evidence(**numbers)
    return judge.verdict_on(found, "admm tv", cast(Chances, told))


@pytest.mark.parametrize(
    ("chance", "numbers", "region", "begins"),
    [
        (0.2, {}, Region.INSIDE, "reliable: inside the region where admm tv works (chance of failing 20%"),
        (0.21, {}, Region.NEAR, "doubtful: near the boundary where admm tv fails (chance of failing 21%"),
        (0.49, {}, Region.NEAR, "doubtful: near"),
        (
            0.5,
            {},
            Region.OUTSIDE,
            "not reliable: outside the region where admm tv works (chance of failing 50%",
        ),
        (0.1, {"unsettled": 0.69}, Region.INSIDE, "reliable"),
        (0.1, {"unsettled": 0.7}, Region.NEAR, judge.STILL_CHANGING),
        (0.1, {"unsettled": 9.9}, Region.NEAR, judge.STILL_CHANGING),
        (0.1, {"unsettled": 10.0}, Region.OUTSIDE, judge.FIRST_ITERATIONS),
        (0.49, {"unsettled": 10.0}, Region.OUTSIDE, judge.FIRST_ITERATIONS),
        (0.5, {"unsettled": 10.0}, Region.OUTSIDE, "not reliable: outside"),
        (0.1, {"unexplained": 0.149}, Region.INSIDE, "reliable"),
        (0.1, {"unexplained": 0.15}, Region.NEAR, "doubtful: the model leaves 3.2 times the noise, 15.0%"),
        (0.1, {"signal": 100.0, "unexplained": 0.048}, Region.INSIDE, "reliable"),
        (0.1, {"signal": 100.0, "unexplained": 0.05}, Region.NEAR, "doubtful: the model leaves 5.1 times"),
        (0.1, {"signal": 999.0, "unexplained": 0.001}, Region.INSIDE, "reliable"),
        (0.1, {"signal": 1000.0, "unexplained": 0.001}, Region.UNKNOWN, judge.COMPUTED),
        (0.1, {"load": float("nan")}, Region.OUTSIDE, "not reliable: outside"),
    ],
)
def test_where_a_reconstruction_lies(
    chance: float, numbers: dict[str, float], region: Region, begins: str
) -> None:
    verdict = judged(Told(chance), **numbers)
    assert verdict.region is region
    assert verdict.sentences[0].startswith(begins)
    assert ("chance of failing" in verdict.sentences[0]) == (not verdict.decided)
    assert verdict.basis == "a regression on 30 simulated cases of 10 scenes"


@pytest.mark.parametrize(("distance", "is_known"), [(4.0, True), (4.1, False), (float("nan"), False)])
def test_what_lies_farther_than_any_case_is_not_judged(distance: float, *, is_known: bool) -> None:
    verdict = judged(Told(0.1, distance), load=0.5)
    assert (verdict.region is Region.INSIDE) == is_known
    assert judge.unlike_any(verdict) == (not is_known)
    assert ("unexplained" in verdict.sentences[-1]) == (not is_known)
    assert not verdict.findings, "nothing brings it nearer"


def test_what_sets_it_apart_from_all_cases_is_named() -> None:
    told = Told(0.1)
    load = told.features.index("load")
    told.distance = lambda place: 5 * abs(float(place[load] - told.typical[load]))  # type: ignore[method-assign]
    verdict = judged(told, load=0.5)
    assert verdict.region is Region.UNKNOWN
    assert verdict.sentences[1].startswith("What sets it apart: 0.5 unknowns for each measured pixel")
    assert verdict.findings[0].gain == pytest.approx(5 * np.log(0.505 / 0.055), rel=1e-3)


def test_a_computed_image_is_not_told_what_it_leaves_unexplained() -> None:
    verdict = judged(Told(0.1), signal=1000.0, unexplained=0.001)
    assert not judge.unlike_any(verdict)
    assert verdict.sentences == (f"{judge.COMPUTED}.",)


def test_pixels_that_were_not_seen_tell_where_no_case_does() -> None:
    numbers = {"signal": 10.0, "unexplained": 0.1}
    assert judge.left_unexplained(numbers, None) == (
        "The model leaves 1.4 times the noise, 10.0% of the measurement's contrast, unexplained"
    )
    assert judge.left_unexplained(numbers, 1.25).endswith(
        "unexplained; pixels that a shorter run did not see are missed by 1.2 times the noise"
    )


def test_only_what_a_tenth_of_the_chance_goes_with_is_named_the_most_first() -> None:
    verdict = judged(
        Told(0.6, load=0.3, unexplained=0.02, detail=0.1), detail=10.0, load=0.5, unexplained=0.02
    )
    assert [finding.stress for finding in verdict.findings] == ["load", "detail"]
    assert len(verdict.sentences) == 3
    assert verdict.findings[0].value == 0.5
    assert "0.5 unknowns for each measured pixel" in verdict.sentences[1]
    good = judged(Told(0.6, load=0.3), detail=50.0, signal=50.0, load=0.05, unexplained=0.005, lit=0.5)
    assert good.findings == ()


def test_more_light_relieves_what_lacks_most_and_at_most_tenfold() -> None:
    told = Told(0.6, detail=0.1, signal=0.1)
    (dim,) = judged(told, detail=20.0, signal=10.0, unexplained=0.001).findings
    assert dim.stress == "signal"
    steps = [np.log(40 / 20), np.log(40 / 10), abs(np.log(80.05 / 40.05)), 0.0]  # four times the light
    assert dim.gain == pytest.approx(0.1 * (steps[0] + steps[1] - steps[2] - steps[3]), abs=1e-2)
    (dark,) = judged(told, detail=1.0, signal=1.0, unexplained=0.001).findings
    assert dark.gain == pytest.approx(0.1 * 2 * np.log(10), abs=2e-2)
    # What stands out of the noise already is not lifted by more light.
    assert judged(told, detail=20.0, signal=10.0, unexplained=0.18).findings == ()
    (below,) = judged(told, detail=20.0, signal=10.0, unexplained=0.17).findings
    assert below.stress == "signal"


@pytest.mark.parametrize(("share", "first"), [(0.019, "detail"), (0.02, "saturated")])
def test_many_pixels_at_full_scale_are_named_first_and_no_light_is_asked_for(
    share: float, first: str
) -> None:
    verdict = judged(Told(0.6, detail=0.1, load=0.1), detail=1.0, load=0.5, saturated=share)
    assert verdict.findings[0].stress == first
    assert ("detail" in [f.stress for f in verdict.findings]) == (first == "detail")
    assert "load" in [f.stress for f in verdict.findings]


@pytest.mark.parametrize("unsettled", [0.7, 10.0, DIVERGED])
def test_a_run_that_was_ended_too_early_is_told_so_first_and_once(unsettled: float) -> None:
    verdict = judged(Told(0.1, load=0.1), load=0.5, unsettled=unsettled)
    stresses = [finding.stress for finding in verdict.findings]
    assert stresses == ["unsettled", "load"]
    assert ("another method" in verdict.findings[0].help) == (unsettled == DIVERGED)
    sure = judged(Told(0.9, load=0.1), load=0.5, unsettled=unsettled)
    assert (sure.findings[0].stress == "unsettled") == (unsettled >= judge.UNFINISHED)


def test_what_is_unexplained_is_named_first_where_that_decided() -> None:
    verdict = judged(Told(0.1, load=0.1, unexplained=0.01), load=0.5, unexplained=0.2)
    assert [finding.stress for finding in verdict.findings] == ["unexplained", "load"]


@pytest.mark.parametrize(
    ("fit", "before", "after"),
    [
        (Fit.FITS, Region.INSIDE, Region.INSIDE),
        (Fit.FITS, Region.OUTSIDE, Region.OUTSIDE),
        (Fit.UNTOLD, Region.INSIDE, Region.NEAR),
        (Fit.UNTOLD, Region.NEAR, Region.NEAR),
        (Fit.UNTOLD, Region.UNKNOWN, Region.UNKNOWN),
        (Fit.FOREIGN, Region.INSIDE, Region.OUTSIDE),
        (Fit.FOREIGN, Region.UNKNOWN, Region.OUTSIDE),
    ],
)
def test_with_a_calibration_that_is_not_known_to_be_right_nothing_is_reliable(
    fit: Fit, before: Region, after: Region
) -> None:
    check = CalibrationCheck(fit, {}, 100)
    numbers = evidence().as_json()
    verdict = Verdict(before, "admm tv", 0.1, (), numbers).with_calibration(check)
    assert (verdict.region, verdict.calibration) == (after, check)
    assert verdict.as_json()["calibration"] == check.as_json()
    assert Verdict(before, "admm tv", 0.1, (), numbers).as_json()["calibration"] is None
    assert ("does not belong to this photograph" in verdict.sentences[0]) == (fit is Fit.FOREIGN)
    is_said = "does not tell whether the calibration is its own" in verdict.sentences[0]
    assert is_said == (fit is Fit.UNTOLD and before is Region.INSIDE)


def test_a_little_less_light_than_in_good_cases_is_relieved_by_as_much() -> None:
    told = Told(0.6, signal=0.9)
    (dim,) = judged(told, detail=45.0, signal=30.0, unexplained=0.001).findings
    assert dim.gain == pytest.approx(0.9 * np.log(40.1 / 30.1), rel=0.02)


def test_far_from_all_cases_little_sets_it_apart_too_and_what_decides_keeps_its_gain() -> None:
    told = Told(0.1)
    load = told.features.index("load")
    told.distance = lambda place: 4 + 0.2 * abs(float(place[load] - told.typical[load]))  # type: ignore[method-assign]
    (apart,) = judged(told, load=0.1).findings
    assert apart.gain == pytest.approx(0.2 * np.log(0.105 / 0.055), rel=1e-3)
    first, second = judged(Told(0.1, load=0.1, unexplained=0.03), load=0.5, unexplained=0.2).findings
    assert (first.stress, first.gain) == ("unexplained", pytest.approx(0.03 * np.log(0.22 / 0.03), rel=1e-3))
    assert (second.stress, second.gain) == ("load", pytest.approx(0.1 * np.log(0.505 / 0.055), rel=1e-3))


def test_what_is_unexplained_is_named_with_no_gain_where_it_alone_decided_and_not_where_it_did_not() -> None:
    first, _ = judged(Told(0.1, load=0.1), load=0.5, unexplained=0.2).findings
    assert (first.stress, first.gain) == ("unexplained", 0)
    near = judged(Told(0.3, load=0.1), load=0.5, unexplained=0.02)
    assert (near.region, [finding.stress for finding in near.findings]) == (Region.NEAR, ["load"])


def test_what_limits_is_said_of_what_is_not_reliable_and_one_thing_sets_apart() -> None:
    good = judged(Told(0.1, load=0.1), load=0.5)
    assert (good.region, len(good.findings), len(good.sentences)) == (Region.INSIDE, 1, 1)
    told = Told(0.1)
    told.distance = lambda place: 5 * float(np.sum(np.abs(place - told.typical)))  # type: ignore[method-assign]
    apart = judged(told, load=0.5, unexplained=0.3)
    assert len(apart.findings) > 1
    said = [sentence for sentence in apart.sentences if sentence.startswith("What sets it apart")]
    assert len(said) == 1
    assert apart.findings[0].words in said[0]


@pytest.mark.parametrize("region", [Region.INSIDE, Region.NEAR, Region.UNKNOWN])
def test_a_psf_that_is_cut_makes_a_reliable_picture_doubtful_and_no_other(region: Region) -> None:
    before = judged(Told(0.1, load=0.1), load=0.5)
    verdict = Verdict(region, "admm tv", 0.1, before.findings, before.evidence, before.basis)
    after = verdict.with_cut_psf(0.31)
    if region is not Region.INSIDE:
        assert after is verdict
        return
    assert (after.region, after.findings) == (Region.NEAR, ())
    assert after.sentences[0].startswith("doubtful: the PSF seems to go on beyond the sensor's edges")
    assert "up to 31% of its light" in after.sentences[0]


def test_names_of_methods_are_the_maps() -> None:
    assert judge.method_name("wiener", "l1", volume=True) == "wiener"
    assert judge.method_name("fista", "tv-isotropic") == "fista tv"
    assert judge.method_name("admm", "l1", volume=True) == f"admm l1{judge.OF_VOLUMES}"


def test_a_coordinate_is_that_of_its_evidence() -> None:
    numbers = {**evidence(12.0, 0.3).as_json(), "missed": 0.0}
    names = ("detail", "unexplained", "load", "ambiguity")
    for name, coordinate in zip(names, place_of(numbers, names), strict=True):
        assert value_of(name, float(coordinate)) == pytest.approx(numbers[name])


def test_photographs_are_asked_whether_they_are_coded_where_much_is_unexplained() -> None:
    photograph, psfs = np.array([1.0, 4.0], np.float32), np.array([2.0, 3.0], np.float32)

    def left(given: float, of_both: float, of_one: float) -> Any:
        def share(image: Any, psf: Any) -> float:
            if image is photograph:
                return given
            return of_one if psf is psfs else of_both

        return share

    one, both = CODED
    assert coded(photograph, psfs, left(0.049, 0.01, 0.01)) is None
    assert coded(photograph, psfs, left(0.049, 0.02, 0.01), asked=True) == one
    assert coded(photograph, psfs, left(0.05, 0.02, 0.03)) == both
    assert coded(photograph, psfs, left(0.1, 0.0899, 0.2)) == both
    assert coded(photograph, psfs, left(0.1, 0.0901, 0.2)) is None
    assert (one.words, one.option, both.words, both.option) == (
        "the photograph is",
        "photograph",
        "both are",
        "both",
    )
    np.testing.assert_allclose(straight([-1.0, 0.0, 2.0, 4.0]), [0, 0, 4 * 0.5**2.2, 4])
    assert one.straightened(photograph, psfs)[1] is psfs
    np.testing.assert_allclose(both.straightened(photograph, psfs)[1], straight(psfs))


def test_a_picture_over_a_background_below_zero_is_not_inside() -> None:
    good = Verdict(Region.INSIDE, "admm tv", 0.0, ())
    doubted = good.with_background_below_zero(-0.65)
    assert doubted.region is Region.NEAR
    assert "below zero, at -65%" in doubted.sentences[0]
    bad = Verdict(Region.OUTSIDE, "admm tv", 0.9, ())
    assert bad.with_background_below_zero(-0.65) is bad
