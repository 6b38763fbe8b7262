"""Scores of a calibration and of its decoys held against each other: where odds and tiles begin to tell."""

from __future__ import annotations

import json

import numpy as np
import pytest

from recon.camera.transformed import Transformation
from recon.verdict.calibration_check import (
    BETWEEN,
    CERTAIN,
    FAR,
    GIVEN,
    NEARLY,
    CalibrationCheck,
    Certainty,
    Fit,
    Score,
    as_given,
    check_of,
    is_ahead,
    is_told,
    near_decoys,
)

PIXELS = 10_000
NEAR = near_decoys((160, 160), sizes=True)
UP_AND_DOWN = np.array([1.0, -1.0] * 8) * 0.01
ERROR = 0.01 * (16 / 15) ** 0.5 / 4
"""Of the mean of sixteen tiles that go up and down by a hundredth."""


def score(objective: float, errors: float = 0.0, *, misfit: float = 1.0, fine: float = 1.0) -> Score:
    """Return a score which one of ``fine`` leads by so many standard errors."""
    told = tuple(fine * np.exp(errors * ERROR + UP_AND_DOWN))
    return Score(misfit, objective, told, told)


def plain(objective: float, *, misfit: float = 1.0, fine: float = 1.0) -> Score:
    """Return a score of a photograph whose tiles are all alike."""
    return Score(misfit, objective, (fine,) * 16, (fine,) * 16)


GOOD = plain(1.0)


@pytest.mark.parametrize("errors", [-3.0, 0.0, 0.5, 2.5, 40.0])
def test_one_leads_by_the_standard_errors_of_its_tiles(errors: float) -> None:
    assert GOOD.leads(score(1.0, errors)) == pytest.approx(errors, abs=1e-9)
    assert plain(1.0, fine=7.0).leads(score(1.0, errors, fine=7.0)) == pytest.approx(errors, abs=1e-9)


def test_structure_or_prior_leads_whichever_says_more_and_tiles_that_do_not_differ_say_much() -> None:
    behind, ahead = score(1.0, -4.0), score(1.0, 3.0)
    assert GOOD.leads(Score(1.0, 1.0, behind.fine, ahead.tiles)) == pytest.approx(3)
    assert GOOD.leads(Score(1.0, 1.0, ahead.fine, behind.tiles)) == pytest.approx(3)
    assert GOOD.leads(plain(1.0, fine=1.1)) > 1e9
    one = Score(1.0, 1.0, (1.0,), (1.0,))
    assert one.leads(Score(1.0, 1.0, (2.0,), (2.0,))) == pytest.approx(0), "a single tile has no error"
    two = Score(1.0, 1.0, (np.e, np.exp(3)), (np.e, np.exp(3)))
    assert Score(1.0, 1.0, (1.0, 1.0), (1.0, 1.0)).leads(two) == pytest.approx(2), "of 1 and 3 the error is 1"
    dark = Score(1.0, 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert dark.leads(dark) == 0


@pytest.mark.parametrize(
    ("objective", "pixels", "told"),
    [
        (1.1, 501, True),  # 25.05 nats
        (1.1, 499, False),
        (1.0019, 1_000_000, False),  # a five hundredth of the score is an error of the model
        (1.0021, 1_000_000, True),
        (0.5, 1_000_000, False),
    ],
)
def test_odds_tell_beyond_chance_and_the_models_errors(objective: float, pixels: int, told: bool) -> None:
    assert is_told(GOOD, plain(objective), pixels) == told
    assert is_told(plain(10.0), plain(10 * objective), 1_000_000) == (objective > 1.002)


def test_ahead_of_others_is_who_is_ahead_of_each_by_odds_and_by_tiles() -> None:
    by = Certainty(25.0, 2.5)
    clear, close, even = score(1.1, 9.0), score(1.1, 2.4), score(1.001, 9.0)
    assert is_ahead(GOOD, [clear, score(1.1, 2.6)], PIXELS, by)
    assert not is_ahead(GOOD, [clear, close], PIXELS, by)
    assert not is_ahead(GOOD, [even, clear], PIXELS, by)
    assert is_ahead(GOOD, (one for one in (clear, clear)), PIXELS, by), "asked twice of what is read once"
    assert is_ahead(GOOD, [], PIXELS, by)
    assert not is_ahead(GOOD, [clear, close], PIXELS)
    assert is_ahead(GOOD, [clear, close], PIXELS, NEARLY)
    assert CERTAIN.nats > NEARLY.nats


@pytest.mark.parametrize(
    ("shape", "degrees", "step"),
    [
        ((160, 160), 1.0, 0.01),
        ((40, 120), 1.0, 0.01),
        ((40, 30), np.rad2deg(0.03), 0.03),  # 0.6 pixels at the edge of the longer side
        ((1000, 2000), 1.0, 0.01),
    ],
)
def test_near_decoys_move_a_patterns_edge(shape: tuple[int, int], degrees: float, step: float) -> None:
    turned = [Transformation(rotation_deg=d) for d in (degrees, -degrees)]
    for found, wanted in zip(near_decoys(shape, sizes=False), turned, strict=True):
        assert found.matrix == pytest.approx(wanted.matrix)
    sized = near_decoys(shape, sizes=True)
    assert [one.scale for one in sized] == pytest.approx([1, 1, 1 + step, 1 - step])
    assert [one.rotation_deg for one in sized] == pytest.approx([degrees, -degrees, 0, 0])


def test_the_better_of_the_given_one_and_it_between_pixels_counts() -> None:
    better, worse = plain(0.9), plain(1.2)
    assert as_given({GIVEN: worse, BETWEEN: better, FAR[0]: plain(0.1)}) is better
    assert as_given({GIVEN: better, BETWEEN: worse}) is better
    assert as_given({GIVEN: worse}) is worse
    check = check_of({GIVEN: worse, BETWEEN: better, FAR[0]: score(1.1, 9.0)}, PIXELS)
    assert check.fit is Fit.FITS
    assert check.scores[GIVEN] is better


FAR_OFF = dict.fromkeys(FAR, score(1.5, 9.0))


def test_who_is_ahead_of_all_far_ones_fits_however_near_the_near_ones_are() -> None:
    near = dict.fromkeys(NEAR, score(1.001, 0.5))
    close = check_of({GIVEN: GOOD} | near | FAR_OFF, PIXELS)
    assert (close.fit, close.better, close.pixels) == (Fit.FITS, None, PIXELS)
    assert not close.sure
    apart = check_of({GIVEN: GOOD} | dict.fromkeys(NEAR, score(1.1, 1.8)) | FAR_OFF, PIXELS)
    assert apart.fit is Fit.FITS
    assert apart.sure
    one_close = dict.fromkeys(NEAR, score(1.1, 9.0)) | {NEAR[-1]: score(1.1, 1.7)}
    assert not check_of({GIVEN: GOOD, BETWEEN: GOOD} | one_close | FAR_OFF, PIXELS).sure
    assert not CalibrationCheck(Fit.UNTOLD, apart.scores, PIXELS).sure
    wide = {GIVEN: GOOD, BETWEEN: GOOD} | dict.fromkeys(NEAR, score(1.1, 1.8)) | FAR_OFF
    assert check_of(wide, PIXELS).sure, "it need not be ahead of itself, nor of far ones by more than it was"


def test_a_decoy_that_is_ahead_of_the_given_one_and_of_other_far_ones_is_better() -> None:
    given, better = score(1.1, 2.0), GOOD
    near = dict.fromkeys(NEAR, given) | {NEAR[1]: better}
    check = check_of({GIVEN: given} | near | FAR_OFF, PIXELS)
    assert (check.fit, check.better, check.wrong) == (Fit.OFF, NEAR[1], True)
    slight = check_of({GIVEN: score(1.1, 1.7)} | near | FAR_OFF, PIXELS)
    assert slight.fit is not Fit.OFF
    flipped = check_of({GIVEN: given} | dict.fromkeys(NEAR, given) | FAR_OFF | {FAR[1]: better}, PIXELS)
    assert (flipped.fit, flipped.better) == (Fit.OFF, FAR[1]), "it is not asked to be ahead of itself"
    rival = FAR_OFF | {FAR[0]: score(1.001, 9.0)}
    assert check_of({GIVEN: given} | near | rival, PIXELS).fit is not Fit.OFF, "any PSF would explain it"


def foreign(
    objective: float = 1.0, errors: float = 0.5, fine: float = 2.0, near: float = 1.0, pixels: int = PIXELS
) -> Fit:
    """Return what is said where ``fine`` is left, and far decoys of an objective are led by errors."""
    given, far = plain(1.0, fine=fine), score(objective, errors, fine=fine)
    scores = {GIVEN: given} | dict.fromkeys(NEAR, plain(near, fine=fine)) | dict.fromkeys(FAR, far)
    return check_of(scores, pixels).fit


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"near": 1.05}, Fit.FOREIGN),  # 250 nats among all
        ({"near": 1.039}, Fit.UNTOLD),  # 195
        ({"near": 1.041}, Fit.FOREIGN),
        ({"near": 1.05, "pixels": 7000}, Fit.UNTOLD),
        ({"near": 1.05, "errors": 0.99}, Fit.FOREIGN),
        ({"near": 1.05, "errors": 1.01}, Fit.UNTOLD),
        ({"near": 1.05, "fine": 1.11}, Fit.FOREIGN),
        ({"near": 1.05, "fine": 1.09}, Fit.UNTOLD),
        ({"objective": 1.049}, Fit.FOREIGN),
        ({"objective": 1.051}, Fit.UNTOLD),  # far ones are all less likely
        ({"objective": 0.95}, Fit.FOREIGN),
    ],
)
def test_where_a_photograph_has_its_say_who_is_no_better_than_far_ones_is_foreign(
    changes: dict[str, float], said: Fit
) -> None:
    assert foreign(**changes) is said


def test_far_ones_clear_only_where_all_of_them_are_less_likely() -> None:
    given, likely, unlikely = plain(1.0, fine=2.0), score(1.04, 0.5, fine=2.0), score(1.06, 0.5, fine=2.0)
    scores = {GIVEN: given, **dict.fromkeys(NEAR, given), FAR[0]: unlikely, FAR[1]: likely, FAR[2]: unlikely}
    assert check_of(scores, PIXELS).fit is Fit.FOREIGN
    assert check_of(scores | {FAR[1]: unlikely}, PIXELS).fit is Fit.UNTOLD


def resolved(
    gains: tuple[float, float, float], left: float = 0.8, structure: float = 1.0, pixels: int = 4000
) -> Fit:
    """Return what is said of fine structure of which ``left`` is left, far ones' scores being greater so."""
    given = plain(10.0, fine=left)
    far = {how: score(10.0 + gain, 0.5, fine=left) for how, gain in zip(FAR, gains, strict=True)}
    return check_of({GIVEN: given} | dict.fromkeys(NEAR, given) | far, pixels, structure).fit


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"gains": (0.02, 0.02, 0.02)}, Fit.FOREIGN),  # 2400 nats of structure are explained
        ({"gains": (0.03, 0.02, 0.024)}, Fit.FOREIGN),
        ({"gains": (0.03, 0.026, 0.03)}, Fit.UNTOLD),
        ({"gains": (0.02, 0.02, 0.02), "structure": 0.7}, Fit.UNTOLD),
        ({"gains": (0.017, 0.02, 0.02), "structure": 0.7}, Fit.FOREIGN),
        ({"gains": (0.02, 0.02, 0.02), "left": 1.49}, Fit.FOREIGN),  # 1020 nats
        ({"gains": (0.02, 0.02, 0.02), "left": 1.51}, Fit.UNTOLD),
        ({"gains": (0.02, 0.02, 0.02), "pixels": 1600}, Fit.UNTOLD),
        ({"gains": (0.041, 0.0, 0.045)}, Fit.UNTOLD),  # half its own mirror image: the others tell
        ({"gains": (0.039, 0.0, 0.045)}, Fit.FOREIGN),
        ({"gains": (0.075, 0.0, 0.079), "structure": 2.0}, Fit.FOREIGN),
        ({"gains": (0.081, 0.0, 0.085), "structure": 2.0}, Fit.UNTOLD),
        ({"gains": (0.1, -0.009, 0.09), "structure": 2.0}, Fit.UNTOLD),
        ({"gains": (0.1, -0.011, 0.09), "structure": 2.0}, Fit.FOREIGN),
        ({"gains": (0.05, -0.004, 0.045)}, Fit.UNTOLD),
        ({"gains": (0.05, -0.006, 0.045)}, Fit.FOREIGN),
    ],
)
def test_who_resolves_structure_has_to_be_ahead_by_a_share_of_it(given: dict, said: Fit) -> None:
    assert resolved(**given) is said


def test_two_far_decoys_do_not_clear_a_third_that_was_not_tried() -> None:
    given = plain(10.0, fine=0.8)
    far = {FAR[0]: score(10.0, 0.5, fine=0.8), FAR[1]: score(10.05, 0.5, fine=0.8)}
    assert check_of({GIVEN: given} | far, 4000, 1.0).fit is Fit.FOREIGN


@pytest.mark.parametrize(("left", "said"), [(1.4, Fit.FOREIGN), (1.6, Fit.UNTOLD)])
def test_structure_is_explained_by_whichever_explains_most(left: float, said: Fit) -> None:
    given = plain(10.0, fine=1.7)
    far = {how: score(10.0, 0.5, fine=1.7) for how in FAR}
    near = dict.fromkeys(NEAR, given) | {NEAR[0]: plain(10.0, fine=left)}
    assert check_of({GIVEN: given} | near | far, 4000, 1.0).fit is said


TURNED = Transformation(rotation_deg=-2.0)


MUCH = "What is still unexplained is much"


@pytest.mark.parametrize(
    ("fit", "better", "left", "found", "advice"),
    [
        (Fit.FITS, None, 4.0, "", ""),
        (Fit.OFF, TURNED, 1.44, "better turned by -2 degrees (the residual falls to 60%)", "diffuser or sen"),
        (Fit.OFF, TURNED, 3.24, "better turned by -2 degrees (the residual falls to 90%)", MUCH),
        (Fit.OFF, FAR[0], 3.24, "better mirrored (the residual falls to 90%)", "flipped or turned"),
        (Fit.OFF, None, 4.0, "", ""),
        (Fit.FOREIGN, None, 4.0, "no better than it would mirrored or upside down", "of this camera"),
        (Fit.UNTOLD, TURNED, 4.0, "does not tell whether the calibration is its own", ""),
    ],
)
def test_what_is_wrong_is_said_with_what_to_do(
    fit: Fit, better: Transformation | None, left: float, found: str, advice: str
) -> None:
    scores = {GIVEN: plain(1.0, misfit=4.0)} | {how: plain(1.0, misfit=left) for how in (TURNED, FAR[0])}
    check = CalibrationCheck(fit, scores, PIXELS, better)
    said = check.sentences
    assert check.wrong == (fit in (Fit.OFF, Fit.FOREIGN))
    assert len(said) == (0, 1, 2)[bool(found) + bool(advice)]
    assert not said or (found in said[0] and advice in said[-1])
    assert any(MUCH in sentence for sentence in said) == (advice == MUCH), "nor has a flipped one moved"
    known = CalibrationCheck(fit, scores, PIXELS, better, ("it is coded", "Straighten it")).sentences
    if check.wrong:
        assert known == ("the calibration does not fit this photograph: it is coded", "Straighten it")
    else:
        assert known == said


def test_a_check_is_kept_with_its_scores() -> None:
    scores = {GIVEN: plain(1.5, misfit=1.25), TURNED: plain(1.0, misfit=0.5)}
    kept = CalibrationCheck(Fit.OFF, scores, PIXELS, TURNED, ("found", "help")).as_json()
    assert json.loads(json.dumps(kept)) == {
        "fit": "off",
        "better": "turned by -2 degrees",
        "scores": {str(GIVEN): [1.25, 1.5], "turned by -2 degrees": [0.5, 1.0]},
        "pixels": PIXELS,
        "cause": ["found", "help"],
    }
    bare = CalibrationCheck(Fit.FITS, scores, PIXELS).as_json()
    assert (bare["better"], bare["cause"]) == (None, None)
