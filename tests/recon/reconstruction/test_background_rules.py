"""When a photograph is given light back, or a background: each rule where it begins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon.camera.vignetting import shade_of
from recon.errors import InputError
from recon.priors import L1
from recon.reconstruction.background import (
    LIT_PICTURE,
    POINTS,
    VOLUME,
    Trial,
    background_of,
    beyond_of,
    floor,
)
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.mending import restored_light as module
from recon.reconstruction.mending.restored_light import (
    _least,
    _offset_of,
    _shade_of,
    _Small,
    with_light_restored,
)
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.types import Calibration

Counts = np.ndarray[Any, np.dtype[Any]]
NOTHING = Trial(2.0, 2.0, 0.0, 0.0, VOLUME)


def of_squares(without2: float, lit2: float, **facts: Any) -> Trial:
    return replace(NOTHING, without=without2**0.5, lit=lit2**0.5, **facts)


@pytest.mark.parametrize(
    ("without2", "lit2", "facts", "explains"),
    [
        (7.9, 3.95, {}, False),  # half is gone, but no four units
        (8.2, 4.05, {}, True),
        (9.0, 4.6, {}, False),  # four units, but not half
        (9.0, 4.4, {}, True),
        (100.0, 5.1, {"picture": True, "light": -0.01}, False),
        (100.0, 4.9, {"picture": True, "light": -0.01}, True),
        (100.0, 40.0, {"picture": True, "light": 0.0}, True),
        (100.0, 40.0, {"picture": True, "least": -0.14}, True),
        (100.0, 40.0, {"picture": True, "least": -0.16}, False),
        (100.0, 40.0, {"picture": False, "light": -1.0, "least": -1.0}, True),
    ],
)
def test_a_background_explains_by_four_units_and_half_of_what_is_missed(
    without2: float, lit2: float, facts: dict[str, Any], *, explains: bool
) -> None:
    trial = of_squares(without2, lit2, **facts)
    assert trial.explains is explains
    assert trial.asks() is trial.helps is explains


def test_half_as_much_ends_a_pass_early() -> None:
    trial = of_squares(4.4, 2.2)
    assert not trial.asks()
    assert trial.asks(0.5)
    assert not of_squares(4.4, 3.4).asks(0.5)  # a quarter of it is asked for as well
    assert not of_squares(3.9, 2.0).asks(0.5)  # and two units


@pytest.mark.parametrize(
    ("taken", "lit2", "facts", "asks"),
    [
        (VOLUME, 0.89, {"light": 0.08}, True),
        (VOLUME, 0.91, {"light": 0.08}, False),
        (VOLUME, 0.89, {"light": 0.079}, False),
        (VOLUME, 0.89, {"light": 0.08, "dim": True}, False),
        (VOLUME, 0.89, {"light": 0.08, "least": -0.01}, False),
        (LIT_PICTURE, 0.71, {"light": 0.5}, False),
        (LIT_PICTURE, 0.69, {"light": 0.5}, True),
    ],
)
def test_stray_light_asks_for_less(taken: Any, lit2: float, facts: dict[str, Any], *, asks: bool) -> None:
    assert of_squares(1.0, lit2, taken=taken, **facts).asks() is asks


@pytest.mark.parametrize(
    ("taken", "dark", "light", "helps"),
    [
        (LIT_PICTURE, 0.68, 0.18, True),
        (LIT_PICTURE, 0.67, 0.18, False),
        (LIT_PICTURE, 0.68, 0.17, False),
        (POINTS, 0.93, 0.32, True),
        (POINTS, 0.92, 0.32, False),
        (VOLUME, 1.0, 1.0, False),
    ],
)
def test_even_light_over_a_dark_scene_is_no_object(
    taken: Any, dark: float, light: float, *, helps: bool
) -> None:
    trial = of_squares(1.0, 1.0, taken=taken, dark=dark, light=light)
    assert trial.helps is helps
    assert not trial.asks()
    assert not replace(trial, least=-0.01).helps


def test_what_is_decided_of_a_background_is_told() -> None:
    nothing = Overrides()
    decided = background_of(of_squares(9.0, 4.0, light=0.25, dark=0.5), nothing, given=False)
    assert (decided.value, decided.down, decided.up) == ("estimated", "none", None)
    assert decided.why == (
        "held-out pixels are missed by 3.0 times the error to expect, with a background of 25% of the light "
        "by 2.0 times"
    )
    assert decided.numbers["held_out_without"] == pytest.approx(3.0)
    dark = background_of(of_squares(1.0, 1.0, taken=POINTS, dark=0.95, light=0.4), nothing, given=False)
    assert dark.why.endswith(", and 95% of the picture would be dark under it")
    none = background_of(NOTHING, nothing, given=False)
    assert (none.value, none.up, none.down) == ("none", "estimated", None)
    assert none.why.endswith(": too little for one")
    below = background_of(of_squares(1.0, 0.5, light=0.5, least=-0.1), nothing, given=False)
    assert below.value == "none"
    assert below.why.endswith(", which falls below zero: no light")


@pytest.mark.parametrize(
    ("asked", "given", "value", "why"),
    [
        (None, True, "none", "a background was given"),
        (None, False, "none", "the darkest tenth leaves no room for stray light"),
        (True, False, "estimated", ""),
        (False, False, "none", ""),
    ],
)
def test_where_nobody_looked_the_wish_counts(
    asked: bool | None, *, given: bool, value: str, why: str
) -> None:
    decided = background_of(None, Overrides(background=asked), given=given)
    assert (decided.value, decided.why, decided.overruled) == (value, why, asked is not None)
    assert not decided.open


def test_planes_beyond_are_taken_where_four_units_less_are_missed() -> None:
    nothing = Overrides()
    taken = beyond_of(of_squares(9.0, 9.0), of_squares(4.9, 9.0), nothing, None)
    assert (taken.value, taken.up, taken.down) == ("planes", None, "none")
    assert (
        "missed by 3.0 times the error to expect, with planes beyond the farthest depth by 2.2" in taken.why
    )
    left = beyond_of(of_squares(9.0, 9.0), of_squares(5.1, 9.0), nothing, None)
    assert (left.value, left.up, left.down) == ("none", "planes", None)
    assert left.why.endswith(": too little for them")
    nobody = beyond_of(None, NOTHING, nothing, None)
    assert nobody == beyond_of(NOTHING, None, nothing, None)
    assert (nobody.value, nobody.overruled, nobody.open) == ("none", False, False)
    assert nobody.why == "what the depths leave unexplained asks for none"
    assert beyond_of(None, None, nothing, "there is one depth").why == "there is one depth"
    wished = beyond_of(NOTHING, NOTHING, Overrides(beyond=True), None)
    assert (wished.value, wished.why, wished.overruled) == ("planes", "", True)
    assert beyond_of(NOTHING, NOTHING, Overrides(beyond=False), "there is one depth").value == "none"
    with pytest.raises(InputError, match=r"beyond=on.*there is one depth"):
        beyond_of(None, None, Overrides(beyond=True), "there is one depth")


def test_the_darkest_part_is_relative_to_the_mean() -> None:
    data = np.arange(101.0)
    assert floor(data) == pytest.approx(10 / 50)
    assert floor(data, 1) == pytest.approx(1 / 50)
    assert floor(-data) == floor(0 * data) == 0.0


def test_the_least_that_serves_is_found_by_halves() -> None:
    assert 0.37 <= _least(lambda share: share < 0.37, 0.6, 5) < 0.37 + 0.6 / 32
    assert _least(lambda _: True, 0.6, 5) == 0.6  # the most, which serves, whatever else
    assert _least(lambda _: False, 0.6, 2) == 0.15


def small_of(left2: Any, usual2: tuple[float, ...] = (0.0,)) -> _Small:
    """Return channels that leave ``left2(offset)``."""
    made = object.__new__(_Small)
    made.usual2 = np.array(usual2)
    made.left2 = lambda share: np.full(len(usual2), left2(share))  # type: ignore[method-assign]
    return made


def test_what_is_lacking_is_more_than_calibrated_cameras_leave() -> None:
    small = small_of(lambda _: 0.0, (1.0, 3.0))
    assert small.beyond(np.array([4.0, 8.0])) == 2.0
    assert small.beyond(np.array([4.0, 8.0]), np.array([2.0, 4.0])) == 1.0
    assert small.lacks(np.array([2.1, 4.0]))
    assert not small.lacks(np.array([2.0, 4.0]))
    assert not small.lacks(np.array([4.0, 8.0]), np.array([2.0, 4.0]))
    rng = np.random.default_rng(0)
    data = rng.normal(20, 5, (1, 40, 50)).astype(np.float32)
    valid = np.ones(data.shape, bool)
    valid[:, :, :25] = False
    data[~valid] = 1e6
    made: Any = _Small([SimpleNamespace(noise=[2.0], data=data, valid=valid)])  # type: ignore[list-item]
    seen = data[valid].astype(float)
    assert made.mean == pytest.approx(2 * seen.mean())
    assert made.usual2 == pytest.approx([0.02**2 * (seen.var() - 1)])
    dim: Any = _Small([SimpleNamespace(noise=[2.0], data=data / 10, valid=valid)])  # type: ignore[list-item]
    assert dim.usual2 == [0], "less than noise"


@pytest.mark.parametrize(
    ("missing", "left", "found"),
    [
        (0.2, 1.0, (0.2, 0.22)),
        (0.018, 1.0, (0.0, 0.0)),  # the dark level of a camera that is as it should be
        (0.028, 1.0, (0.03, 0.04)),
        (0.2, 4.0, (0.2, 0.22)),
        (0.2, 4.1, (0.0, 0.0)),  # it was something else
    ],
)
def test_the_least_offset_that_explains_as_much_as_the_largest(
    missing: float, left: float, found: tuple[float, float]
) -> None:
    small = small_of(lambda share: left + (50.0 if share < missing else 0.0))
    assert found[0] <= _offset_of(small, small.left2(0.6)) <= found[1]


NUMBERS = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
SIDE = 31


def shade_found(
    monkeypatch: pytest.MonkeyPatch,
    given2: float = 25.0,
    needed: float = 0.7,
    rest2: float = 1.0,
    partly2: float | None = None,
    numbers: Any = NUMBERS,
    psf: Any = None,
    usual2: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Any, list[Any]]:
    """Return the shade of channels that ``needed`` of some numbers explains, and which one was fitted."""
    peak = np.zeros((1, 1, SIDE, SIDE)) if psf is None else psf
    peak[0, 0, 5:20, 5:20] = 1.0
    valid = np.ones((1, SIDE, SIDE), bool)
    channels: Any = [
        SimpleNamespace(sensor_shape=(SIDE, SIDE), calibration=SimpleNamespace(psfs=peak), valid=valid)
        for _ in usual2
    ]
    fitted: list[Any] = []

    def fit(channel: Any, usual: float) -> Any:
        fitted.append(([one is channel for one in channels].index(True), usual))
        return numbers

    def left(_: Any, shade: Counts, _iterations: int) -> Counts:
        share = np.log(shade.min()) / np.log(
            shade_of(NUMBERS if numbers is None else numbers, (SIDE, SIDE)).min()
        )
        too_little = given2 if partly2 is None else partly2
        return np.full((SIDE, SIDE), (rest2 if needed - 1e-6 <= share <= 1 + 1e-6 else too_little) ** 0.5)

    monkeypatch.setattr(module, "_shade_fitted", fit)
    monkeypatch.setattr(module, "_shade_left", left)
    small = small_of(lambda _: given2, usual2)
    small.channels = channels
    return _shade_of(small, small.left2(0.0)), fitted


def test_of_a_shade_the_least_that_explains_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    found, fitted = shade_found(monkeypatch, needed=0.65)
    np.testing.assert_allclose(found, 11 / 16 * NUMBERS)
    np.testing.assert_allclose(shade_found(monkeypatch, needed=0.65, partly2=1.5)[0], 11 / 16 * NUMBERS)
    assert fitted == [(0, 1.0)]
    _, fitted = shade_found(monkeypatch, usual2=(0.0, 0.5))
    assert fitted == [(1, 1.5)], "the channel of most contrast"


def test_no_shade_is_taken_where_it_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shade_found(monkeypatch, numbers=None)[0] is None
    pedestal = np.full((1, 1, SIDE, SIDE), 0.1)
    found, fitted = shade_found(monkeypatch, psf=pedestal)
    assert (found, fitted) == (None, [])
    assert shade_found(monkeypatch, psf=np.full((1, 1, SIDE, SIDE), 0.02))[0] is not None
    assert shade_found(monkeypatch, rest2=4.1)[0] is None  # too much is left
    assert shade_found(monkeypatch, rest2=3.9)[0] is not None
    # A deep one explains nearly anything: for each unit of its logarithm 1.1 of what usual errors leave.
    assert shade_found(monkeypatch, numbers=2.3 * NUMBERS)[0] is not None  # 4 are gone, of 3.2
    assert shade_found(monkeypatch, numbers=2.3 * NUMBERS, given2=10.0)[0] is None
    # What is less than usual errors leave is no gain: 3.2 less 1 are gone, of 2.4.
    assert shade_found(monkeypatch, numbers=2.3 * NUMBERS, given2=10.0, rest2=0.25)[0] is None
    # What is left counts by its squares: 4.2 less 1.7 are gone.
    assert shade_found(monkeypatch, numbers=2.3 * NUMBERS, given2=17.4, rest2=3.0)[0] is not None


def looked_at(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> bool:
    def look(*_: Any) -> None:
        raise LookupError

    monkeypatch.setattr(module, "_small", look)
    try:
        assert with_light_restored(problem) is problem
    except LookupError:
        return True
    return False


@pytest.mark.parametrize(
    ("options", "known", "looks"),
    [
        ({}, {}, True),
        ({"solver": "admm"}, {}, True),
        ({"estimate_background": True}, {}, False),
        ({"positive_background": True}, {}, False),
        ({"choose": Overrides(background=False)}, {}, False),
        ({"choose": Overrides(model="convolution")}, {}, True),
        ({"solver": "wiener"}, {}, False),
        ({"prior": L1(0.1)}, {}, False),
        ({}, {"background": 1.0}, False),
        ({}, {"vignetting": 0.5}, False),
    ],
)
def test_what_is_missing_is_looked_for_where_nobody_said_what_it_is(
    options: dict[str, Any], known: dict[str, Any], monkeypatch: pytest.MonkeyPatch, *, looks: bool
) -> None:
    image, psf = np.random.default_rng(0).random((2, 40, 48), np.float32)
    problem = Problem.of(Measurement(image, noise=0.1, **known), psf, ReconstructionOptions(**options))
    assert looked_at(problem, monkeypatch) is looks


@pytest.mark.parametrize(("sides", "factor"), [((40, 64), 1), ((40, 65), 2), ((130, 40), 3)])
def test_it_is_looked_for_on_64_pixels_a_side_at_most(
    sides: tuple[int, int], factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def look(_problem: Problem, _channel: int, small: int) -> None:
        asked.append(small)
        raise LookupError

    monkeypatch.setattr(module, "_small", look)
    image, psf = np.random.default_rng(0).random((2, *sides), np.float32)
    with pytest.raises(LookupError):
        with_light_restored(Problem.of(Measurement(image, noise=0.1), psf, ReconstructionOptions()))
    assert asked == [factor]
    assert isinstance(asked[0], int)


def test_nothing_is_looked_for_in_volumes(monkeypatch: pytest.MonkeyPatch) -> None:
    image, *psfs = np.random.default_rng(0).random((3, 40, 48), np.float32)
    places = np.array([[0, 0, 1e4], [0, 0, 2e4]])
    calibration = Calibration(np.stack(psfs)[:, None], places)
    problem = Problem.of(Measurement(image, noise=0.1), calibration, ReconstructionOptions())
    assert problem.n_planes == 2
    assert not looked_at(problem, monkeypatch)


@pytest.mark.parametrize(("every", "looks"), [(None, True), (10, True), (3, False)])
def test_nothing_is_looked_for_where_erased_pixels_leave_no_small_copy(
    every: int | None, monkeypatch: pytest.MonkeyPatch, *, looks: bool
) -> None:
    """One pixel is erased in each square of so many a side: of ten, squares of two are whole as a rule."""
    image, psf = np.random.default_rng(0).random((2, 260, 20), np.float32)
    erased = np.zeros(image.shape, bool)
    if every is not None:
        erased[::every, ::every] = True
    measurement = Measurement(image, noise=0.1, erasures=erased)
    assert looked_at(Problem.of(measurement, psf, ReconstructionOptions()), monkeypatch) is looks


def restored(
    monkeypatch: pytest.MonkeyPatch,
    *,
    mean: float = 50.0,
    given2: float = 9.0,
    explained2: float = 1.0,
    numbers: Any = None,
    share: float = 0.0,
    offset: bool = True,
) -> tuple[Problem, Problem]:
    """Return a problem, and that with light restored which one number or a shade is found to explain."""

    def left2(_: Any, offset: float) -> Any:
        return np.array([{0.0: given2, module.MOST_OFFSET: explained2}[offset]])

    monkeypatch.setattr(module, "_small", lambda *_: None)
    facts = {"mean": mean, "usual2": np.zeros(1), "channels": []}
    monkeypatch.setattr(_Small, "__init__", lambda self, _: vars(self).update(facts))
    monkeypatch.setattr(module.odd_places, "odd_places", lambda *_: None)
    monkeypatch.setattr(_Small, "left2", left2)
    monkeypatch.setattr(module, "_shade_of", lambda *_: numbers)
    monkeypatch.setattr(module, "_offset_of", lambda *_: share)
    image, psf = np.random.default_rng(0).random((2, 20, 24), np.float32)
    problem = Problem.of(Measurement(image, noise=0.1), psf, ReconstructionOptions())
    return problem, with_light_restored(problem, offset=offset)


@pytest.mark.parametrize(
    "facts",
    [
        {"share": 0.1, "mean": 0.0},
        {"share": 0.1, "mean": -1.0},
        {"share": 0.1, "given2": 0.9},  # nothing lacks
        {"share": 0.1, "explained2": 8.5},  # an offset explains no more
        {"share": 0.1, "offset": False},
        {"share": 0.0},
    ],
)
def test_nothing_is_restored_where_nothing_lacks_or_nothing_explains_it(
    facts: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = restored(monkeypatch, **facts)
    assert after is before


def test_an_offset_is_added_in_counts_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    assert restored(monkeypatch, share=0.1, mean=0.5)[1].measurement.background == -0.05
    before, after = restored(monkeypatch, share=0.1)
    assert after.measurement.background == -5.0
    assert after.measurement.found["added_counts"] == 5.0
    assert "5 counts (10% of its mean) were added" in after.warnings[-1]
    assert after.warnings[-1].endswith("--no-background leaves it as it is.")
    assert after.warnings[:-1] == before.warnings


@pytest.mark.parametrize("offset", [True, False])
def test_a_photograph_is_divided_by_its_shade_whatever_else_would_explain_it(
    offset: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, after = restored(monkeypatch, numbers=NUMBERS, share=0.1, offset=offset)
    shade = shade_of(NUMBERS, (20, 24))
    np.testing.assert_array_equal(after.measurement.vignetting, shade)
    assert after.measurement.found["shade"] == NUMBERS.tolist()
    assert after.measurement.background is None
    assert f"(to {shade.min():.0%} in its darkest corner)" in after.warnings[-1]


@dataclass(frozen=True)
class Channel:
    """What is held of a channel on few pixels."""

    data: Counts
    valid: Counts
    sensor_shape: tuple[int, int] = (SIDE, SIDE)


VALID = np.random.default_rng(1).random((1, SIDE, SIDE)) > 0.2
CHANNEL: Any = Channel(np.full((1, SIDE, SIDE), 6.0, np.float32), VALID)


def test_what_a_channel_leaves_under_a_shade_is_told_in_its_own_light(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Any] = []

    def pilot(channel: Channel, iterations: int) -> Any:
        given.append((channel.data, iterations))
        return SimpleNamespace(left=np.where(VALID, 3.0, 99.0).astype(np.float32))

    monkeypatch.setattr(module, "pilot", pilot)
    shade = np.linspace(0.5, 1, SIDE, dtype=np.float32) * np.ones((SIDE, 1), np.float32)
    found = module._shade_left(CHANNEL, shade, 17)
    np.testing.assert_allclose(found, np.where(VALID[0], 3 * shade, 0))
    ((data, iterations),) = given
    np.testing.assert_allclose(data[0], 6 / shade)
    assert iterations == 17


def test_a_shade_is_fitted_to_what_usual_errors_leave_and_none_is_the_deepest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    left = np.arange(float(SIDE**2)).reshape(SIDE, SIDE)
    monkeypatch.setattr(module, "_shade_left", lambda *given: asked.append(given) or left)
    monkeypatch.setattr(module, "least_squares", lambda *functions: functions)
    found: Any = module._shade_fitted(CHANNEL, 9.0)
    left_of, is_deepest = found
    np.testing.assert_allclose(left_of(NUMBERS), left.ravel() / 3)
    ((channel, shade, iterations),) = asked
    assert (channel, iterations) == (CHANNEL, module.SHADE_ITERATIONS)
    np.testing.assert_array_equal(shade, shade_of(NUMBERS, (SIDE, SIDE)))
    assert not is_deepest(NUMBERS)
    assert is_deepest(9 * NUMBERS)
