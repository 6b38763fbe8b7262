"""What GRBL says is understood, or refused; never a wrong position."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.common.framing import Belongs, LineFramer
from drivers.errors import DeviceError
from drivers.grbl.protocol import (
    Report,
    is_banner,
    jog,
    line_matcher,
    modes_matcher,
    parse_alarm,
    parse_error,
    parse_info,
    parse_report,
    parse_settings,
    report_matcher,
)
from drivers.grbl.settings import ControllerSettings

PLACES = st.lists(st.floats(-9999, 9999, allow_nan=False), min_size=1, max_size=6)
BASE = {
    100: 250.0, 101: 250.0, 102: 250.0, 110: 600.0, 111: 600.0, 112: 600.0, 120: 10.0, 121: 10.0, 122: 10.0,
    130: 100.0, 131: 100.0, 132: 100.0, 27: 1.0,
}  # fmt: skip


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_arbitrary_bytes_never_raise(chunks: list[bytes]) -> None:
    framer = LineFramer()
    lines = [line for chunk in chunks for line in framer.feed(chunk)]
    judges = [line_matcher(), modes_matcher(), report_matcher]
    for line in lines:
        for judge in judges:
            judge(line)
        report = parse_report(line)
        assert report is None or all(map(math.isfinite, report.places))
        parse_error(line)
        parse_alarm(line)
        is_banner(line)
    parse_settings(lines)
    parse_info(lines)


@given(PLACES, st.sampled_from(["Idle", "Jog", "Run", "Hold:0", "Hold:1", "Alarm", "Home", "Door:3"]))
def test_reports_are_read_back(places: list[float], state: str) -> None:
    text = ",".join(f"{place:.3f}" for place in places)
    line = f"<{state}|MPos:{text}|FS:500,0|WCO:{text}|Pn:XZ>".encode()
    report = parse_report(line)
    assert report is not None
    assert report.state == state
    assert report.places == pytest.approx(places, abs=5.1e-4)
    assert report.offset == report.places
    assert report.pins == "XZ"


@given(PLACES, st.data())
def test_a_report_that_lost_bytes_is_none_or_as_long(places: list[float], data: st.DataObject) -> None:
    """A report is either whole or refused: what it lost may only be fields other than the position."""
    text = ",".join(f"{place:.3f}" for place in places)
    line = f"<Idle|MPos:{text}|FS:0,0>".encode()
    end = data.draw(st.integers(0, len(line) - 1))
    assert parse_report(line[:end]) is None
    assert parse_report(line[end + 1 :]) is None


@pytest.mark.parametrize(
    "line",
    [
        b"<Idle|MPos:1.000,2.000",
        b"<Idle|MPos:1.000,2.000|MPos:1.000,2.000>",
        b"<Idle|MPos:1.000,2.000|WPos:1.000,2.000>",
        b"<Idle|MPos:1.000,2.0<Idle|MPos:1.000,2.000>",
        b"<Idle|MPos:1.000,|FS:0,0>",
        b"<Idle|MPos:1.0.0,2.000>",
        b"<Idle|MPos:nan,2.000>",
        b"<Idle|MPos:1e3,2.000>",
        b"<Idle|WPos:1.000,2.000|WCO:1.000>",
        b"<Idle|FS:0,0>",
        b"<|MPos:1.000>",
        b"",
    ],
)
def test_reports_that_are_none(line: bytes) -> None:
    assert parse_report(line) is None
    assert report_matcher(line) is Belongs.OTHER


def test_the_reports_of_the_manuals() -> None:
    assert parse_report(b"<Idle|MPos:0.000,0.000,0.000|FS:0.0,0>") == Report("Idle", (0.0, 0.0, 0.0), True)
    assert parse_report(b"<Hold:0|MPos:5.000,0.000,0.000|FS:0.0,0|Ov:100,100,100>") == Report(
        "Hold:0", (5.0, 0.0, 0.0), True
    )
    assert parse_report(b"<Alarm:9|WPos:1.000|WCO:-2.500|Bf:15,128|H:0,7|In:-1>") == Report(
        "Alarm", (1.0,), False, (-2.5,)
    )


def test_an_old_ok_does_not_end_the_probe() -> None:
    judge = modes_matcher()
    lines = (b"ok", b"error:9", b"[GC:G0 G54]", b"ok", b"ok")
    assert [judge(line) for line in lines] == [
        Belongs.OTHER,
        Belongs.OTHER,
        Belongs.PART,
        Belongs.END,
        Belongs.OTHER,
    ]


def test_what_is_said_unasked() -> None:
    assert parse_alarm(b"ALARM:9") == 9
    assert parse_error(b"error:15") == 15
    assert parse_alarm(b"ALARM:") is None
    assert is_banner(b"Grbl 1.1h ['$' for help]")
    assert is_banner(b"GrblHAL 1.1f ['$' or '$HELP' for help]")
    assert not is_banner(b"[MSG:Grbl 1.1]")


def test_settings_and_information() -> None:
    assert parse_settings([b"$0=10", b"$100=250.000", b"$13=0 (report inches)", b"$300=host", b"$1"]) == {
        0: 10.0,
        100: 250.0,
        13: 0.0,
    }
    info = parse_info(
        [b"[VER:1.1f.20240101:]", b"[OPT:VNZ,35,1024]", b"[AXS:5:XYZAB]", b"[FIRMWARE:grblHAL]"]
    )
    settings = ControllerSettings({}, info)
    assert settings.is_hal
    assert settings.letters == "XYZAB"
    assert not any((settings.soft_limits, settings.hard_limits, settings.homing, settings.reports_inches))
    settings = ControllerSettings({13: 1.0, 20: 1.0, 21: 1.0, 22: 1.0}, info)
    assert all((settings.soft_limits, settings.hard_limits, settings.homing, settings.reports_inches))


@given(
    st.dictionaries(st.sampled_from("XYZABC"), st.floats(-9999, 9999), min_size=1),
    st.floats(0, 1e7),
)
def test_a_jog_says_where_to_in_machine_millimetres(target: dict[str, float], feed: float) -> None:
    text = jog(target, feed).decode()
    assert text.startswith("$J=G21G90G53")
    assert text.endswith("\n")
    assert "e" not in text  # GRBL knows no exponents
    assert len(text) < 128
    words, _, told = text.removeprefix("$J=G21G90G53").strip().partition("F")
    assert float(told) >= max(1.0, feed) - 1e-6
    for letter, place in target.items():
        assert f"{letter}{place:.5f}" in words


@pytest.mark.parametrize(
    ("settings", "info", "travel"),
    [
        ({20: 1, 22: 1}, {"OPT": "V,15,128"}, (-100.0, 0.0)),
        ({21: 1, 22: 1}, {"OPT": "V,15,128"}, (-100.0, -1.0)),
        ({21: 1, 22: 1, 23: 1}, {"OPT": "V,15,128"}, (-99.0, 0.0)),
        ({21: 1, 22: 1, 23: 1}, {"OPT": "VZ,15,128"}, (0.0, 100.0)),
        ({21: 1, 22: 1, 23: 2}, {"OPT": "VZ,15,128"}, (-100.0, 0.0)),
        ({22: 9, 23: 1}, {"FIRMWARE": "grblHAL"}, (0.0, 100.0)),
        ({22: 1, 23: 1}, {"FIRMWARE": "grblHAL", "OPT": "VZ"}, (-100.0, 0.0)),
    ],
)
def test_the_travel_lies_where_homing_puts_it(
    settings: dict[int, float], info: dict[str, str], travel: tuple[float, float]
) -> None:
    assert ControllerSettings(BASE | settings, info).travel(0) == travel


def test_settings_are_looked_up_by_axis_and_in_seconds() -> None:
    values = {
        100: 250.0,
        101: 80.0,
        110: 600.0,
        111: 90.0,
        120: 10.0,
        121: 7.0,
        130: -50.0,
        131: 40.0,
        160: 0.25,
    }
    hal = ControllerSettings(values | {161: 0.5}, {"VER": "1.1f", "FIRMWARE": "grblHAL"})
    assert [hal.steps_per_unit(n) for n in (0, 1)] == [250.0, 80.0]
    assert [hal.rate_per_s(n) for n in (0, 1)] == [10.0, 1.5]
    assert [hal.acceleration_per_s2(n) for n in (0, 1)] == [10.0, 7.0]
    assert [hal.backlash(n) for n in (0, 1, 2)] == [0.25, 0.5, None]
    assert [hal.travel(n) for n in (0, 1)] == [(-50.0, 0.0), (-40.0, 0.0)]
    assert ControllerSettings(values, {}).backlash(0) is None
    assert ControllerSettings(values, {"AXS": "3:X2Z"}).letters == "XYZABCUVW"
    assert not ControllerSettings({21: 2, 22: 2}, {}).hard_limits
    assert not ControllerSettings({21: 2, 22: 2}, {}).homing
    with pytest.raises(DeviceError, match=r"\$101 \(steps per mm of axis Y\) is 0\."):
        ControllerSettings(values | {101: 0.0}, {}).check("stage (test)", 2)


def test_without_a_pull_off_nothing_is_left_out_of_the_travel() -> None:
    values = {number: value for number, value in BASE.items() if number != 27}
    assert ControllerSettings(values | {21: 1, 22: 1}, {}).travel(0) == (-100.0, 0.0)


@pytest.mark.parametrize("missing", [100, 111, 132])
def test_missing_settings_are_named(missing: int) -> None:
    values = {number: value for number, value in BASE.items() if number != missing}
    with pytest.raises(DeviceError, match=rf"\${missing} .* is missing"):
        ControllerSettings(values, {}).check("stage (test)", 3)
