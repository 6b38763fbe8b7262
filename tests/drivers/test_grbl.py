"""The GRBL driver over its emulator: STOP, alarms, resets, settings, faults."""

from __future__ import annotations

import logging
import math
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.grbl.settings import GrblOptions
from drivers.grbl.stage import GrblStage
from tests.mocks.grbl_controller import GrblController
from tests.mocks.pty_device import Answer
from tests.mocks.waiting import in_background, until


@pytest.fixture(params=[False, True], ids=["grbl", "hal"])
def board(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[GrblController]:
    board = GrblController(tmp_path, hal=request.param)
    yield board
    board.unplug()


@pytest.fixture
def plain(tmp_path: Path) -> Iterator[GrblController]:
    board = GrblController(tmp_path)
    yield board
    board.unplug()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of silence: less of it."""
    monkeypatch.setattr(GrblStage, "reply_s", 0.4)
    monkeypatch.setattr(GrblStage, "meet_s", 0.8)


def stage_on(board: GrblController, **options: object) -> GrblStage:
    return GrblStage(GrblOptions.model_validate({"port": str(board.link), **options}))


@pytest.fixture
def stage(board: GrblController) -> Iterator[GrblStage]:
    with stage_on(board) as stage:
        stage.home()
        yield stage


@pytest.fixture
def plain_stage(plain: GrblController) -> Iterator[GrblStage]:
    with stage_on(plain) as stage:
        stage.home()
        yield stage


def true_um(board: GrblController) -> float:
    return 1e3 * board.place[0]


# STOP --------------------------------------------------------------------------------------------
def test_a_cancel_that_comes_before_its_jog_is_read_is_sent_again(
    board: GrblController, stage: GrblStage
) -> None:
    board.line_delay_s = 0.4
    thread, outcome = in_background(lambda: stage.move_to({"x_um": -19_000.0}))
    assert until(lambda: board._lines)
    stage.stop()
    thread.join(20)
    assert isinstance(outcome[0], StoppedError)
    assert board.state == "Idle"
    assert stage.is_homed
    assert -19_000 < stage.position()["x_um"] == pytest.approx(true_um(board))
    assert sum(line.startswith(b"$J=") for line in board.received) == 1


def test_stop_ends_homing_and_it_must_be_done_again(board: GrblController, stage: GrblStage) -> None:
    board.homing_s = 30.0
    thread, outcome = in_background(stage.home)
    assert until(lambda: board.received.count(b"$H") == 2)
    assert stage.is_moving
    stage.stop()
    thread.join(20)
    assert isinstance(outcome[0], StoppedError)
    assert not stage.is_homed
    with pytest.raises(LimitError, match="not homed"):
        stage.move_to({"x_um": -5000.0})
    board.homing_s = 0.02
    stage.home()
    assert stage.move_to({"x_um": -5000.0})["x_um"] == -5000.0


def test_stop_keeps_the_position_and_queued_moves_end_too(board: GrblController, stage: GrblStage) -> None:
    stage.move_to({"x_um": -19_000.0}, wait=False)
    stage.move_to({"y_um": -19_000.0}, wait=False)
    stage.stop()
    assert not stage.is_moving
    time.sleep(0.1)
    assert board.state == "Idle"
    assert stage.position()["y_um"] == -1000.0
    assert stage.position()["x_um"] == pytest.approx(true_um(board)) == stage.commanded_position()["x_um"]


def test_stop_does_not_disturb_who_asks_for_the_position(board: GrblController, stage: GrblStage) -> None:
    done = threading.Event()
    asking, outcome = in_background(lambda: [stage.position() for _ in iter(done.is_set, True)])
    for _ in range(10):
        stage.move_to({"x_um": -19_000.0}, wait=False)
        stage.stop()
        stage.move_to({"x_um": -1000.0})
    done.set()
    asking.join(20)
    assert outcome == [None]
    assert true_um(board) == -1000.0


def test_a_program_that_runs_when_the_stage_is_opened_is_halted_without_losing_steps(
    board: GrblController,
) -> None:
    board.settings[20] = 0
    board.state = "Idle"
    board._g_code("G1X-15F1000")
    with stage_on(board) as stage:
        assert not stage.is_moving
        assert board.state == "Idle"
        assert stage.position()["x_um"] == pytest.approx(true_um(board))
        assert -15_000 < stage.position()["x_um"] < -3000


# Alarms and resets -------------------------------------------------------------------------------
def test_a_limit_switch_ends_the_move_and_the_reference(board: GrblController, stage: GrblStage) -> None:
    thread, outcome = in_background(lambda: stage.move_to({"x_um": -19_000.0}))
    assert until(lambda: board.state == "Jog")
    board.hit_limit_switch()
    thread.join(20)
    assert "limit switch was hit" in str(outcome[0])
    assert "home again" in str(outcome[0])
    assert not stage.is_homed
    with pytest.raises(DeviceError, match="limit switch was hit"):
        stage.move_to({"x_um": -5000.0})
    assert stage.position()["x_um"] == pytest.approx(true_um(board))  # it can still be asked
    stage.home()
    assert stage.move_to({"x_um": -5000.0})["x_um"] == pytest.approx(true_um(board))
    assert stage.settings()["faults"] == ()


def test_a_reset_in_motion_loses_the_reference(board: GrblController, stage: GrblStage) -> None:
    thread, outcome = in_background(lambda: stage.move_to({"x_um": -19_000.0}))
    assert until(lambda: board.state == "Jog")
    board._realtime(0x18)
    thread.join(20)
    assert "reset while it moved: steps may be lost (alarm 3)" in str(outcome[0])
    assert board.place != board.reported
    assert not stage.is_homed


@pytest.mark.parametrize(("alarm", "words"), [(8, "pull-off"), (9, "found no limit switch")])
def test_homing_that_fails_says_why(board: GrblController, stage: GrblStage, alarm: int, words: str) -> None:
    board.homing_alarm = alarm
    with pytest.raises(DeviceError, match=rf"{words}.*\(alarm {alarm}\).*home again"):
        stage.home()
    assert not stage.is_homed
    board.homing_alarm = None
    stage.home()
    assert stage.is_homed


def test_homing_takes_no_longer_than_allowed(plain: GrblController) -> None:
    with stage_on(plain, homing_timeout_s=0.3) as stage:
        plain.homing_s = 30.0
        with pytest.raises(DeviceTimeoutError, match="stayed where it is"):
            stage.home()
        assert not stage.is_homed
        plain.homing_s = 0.02
        stage.home()


def test_a_controller_that_was_reset_is_not_trusted(board: GrblController, stage: GrblStage) -> None:
    stage.move_to({"x_um": -5000.0})
    board.press_reset()
    for _ in range(2):
        with pytest.raises(DeviceError, match=r"was reset .* not to be trusted.*home again"):
            stage.move_to({"x_um": -6000.0})
    assert not stage.is_homed
    assert not any(line.startswith(b"$J=") and b"-6." in line for line in board.received)
    stage.home()
    assert stage.move_to({"x_um": -6000.0})["x_um"] == pytest.approx(true_um(board))


def test_an_alarm_at_rest_is_a_fault_until_homed(board: GrblController, stage: GrblStage) -> None:
    board._raise_alarm(2, critical=True)
    for _ in range(2):
        with pytest.raises(DeviceError, match="soft limits"):
            stage.move_to({"x_um": -5000.0})
    assert not stage.is_homed
    assert "alarm 2" in str(stage.settings()["faults"])
    stage.home()
    stage.move_to({"x_um": -5000.0})


def test_homing_is_the_way_out_of_an_alarm_nobody_saw(board: GrblController, stage: GrblStage) -> None:
    board._raise_alarm(1, critical=True)
    stage.home()
    assert stage.is_homed
    assert stage.settings()["faults"] == ()


def test_an_open_door_is_said(plain: GrblController, plain_stage: GrblStage) -> None:
    plain.state = "Door:1"
    with pytest.raises(DeviceError, match="safety door is open"):
        plain_stage.move_to({"x_um": -5000.0})
    plain.state = "Idle"


def test_feed_hold_by_hand_is_no_arrival(board: GrblController, stage: GrblStage) -> None:
    thread, outcome = in_background(lambda: stage.move_to({"x_um": -19_000.0}))
    assert until(lambda: board.state == "Jog")
    board._realtime(ord("!"))
    thread.join(20)
    assert "came to rest elsewhere: x_um is at" in str(outcome[0])


def test_a_blocked_axis_is_an_error(plain: GrblController, plain_stage: GrblStage) -> None:
    plain.settings[110] = 1e-9
    plain_stage.stuck_s = 0.3
    type(plain_stage).stuck_s, usual = 0.3, type(plain_stage).stuck_s
    try:
        with pytest.raises(DeviceTimeoutError, match="stayed where it is"):
            plain_stage.move_to({"x_um": -5000.0})
    finally:
        type(plain_stage).stuck_s = usual


def test_what_the_controller_refuses_is_said_and_nothing_moves(
    plain: GrblController, plain_stage: GrblStage
) -> None:
    plain.settings[130] = 5.0  # behind the driver's back
    before = plain_stage.position()
    with pytest.raises(DeviceError, match=r"refuses '\$J=.*travel.*\(error 15\)"):
        plain_stage.move_to({"x_um": -15_000.0})
    assert plain_stage.position() == before
    assert plain_stage.move_to({"x_um": -4000.0})["x_um"] == -4000.0


# Settings ----------------------------------------------------------------------------------------
def test_positions_in_work_coordinates_are_understood(plain: GrblController) -> None:
    plain.settings[10] = 0
    plain.work_offset = [1.5, -2.0, 7.25]
    with stage_on(plain) as stage:
        stage.home()
        stage.move_to({"x_um": -5000.0, "z_um": -6000.0})
        assert stage.position() == {"x_um": -5000.0, "y_um": -1000.0, "z_um": -6000.0}
        assert plain.reported == [-5.0, -1.0, -6.0]


def test_limits_and_speeds_come_from_the_controller(plain: GrblController) -> None:
    plain.settings |= {23: 0b010, 112: 600.0, 101: 8000.0}
    axes = {
        "x_um": {"upper_limit": -2000.0},
        "y_um": {"reverse": True},
        "pitch_mrad": {"letter": "Z", "scale": 10.0, "speed_per_s": 20.0},
    }
    with stage_on(plain, axes=axes) as stage:
        assert stage.limits == {
            "x_um": (-20_000.0, -2000.0),
            "y_um": (0.0, 19_000.0),
            "pitch_mrad": (-200.0, -10.0),
        }
        speeds = {axis.name: axis.speed_per_s for axis in stage.axes}
        assert speeds == {"x_um": 20_000.0, "y_um": 20_000.0, "pitch_mrad": 20.0}
        # Finer than what reports show.
        assert [axis.resolution for axis in stage.axes] == pytest.approx([4.0, 1.0, 0.04])


def test_no_axis_is_faster_than_it_may(plain: GrblController) -> None:
    with stage_on(plain, axes={"x_um": {"speed_per_s": 1000.0}, "y_um": {}}) as stage:
        stage.home()
        stage.move_to({"x_um": -1400.0, "y_um": -1300.0})
        (words,) = [line for line in plain.received if line.startswith(b"$J=")]
        match = re.fullmatch(rb"\$J=G21G90G53X-1\.40000Y-1\.30000F([\d.]+)", words)
        assert match is not None
        assert float(match[1]) == pytest.approx(60 * math.hypot(0.4, 0.3) / 0.4, abs=0.11)
    with pytest.raises(DeviceError, match=r"x_um \(axis X\) goes at most 20000 a second \(\$110\)"):
        stage_on(plain, axes={"x_um": {"speed_per_s": 1e6}}).open()


def test_a_move_takes_as_long_as_it_accelerates(plain_stage: GrblStage) -> None:
    # 20 mm/s and 10 mm/s^2: 40 mm until it has its speed.
    assert plain_stage.move_duration_s({"x_um": 0.0}, {"x_um": 10_000.0}) == pytest.approx(2.0)
    assert plain_stage.move_duration_s({"x_um": 0.0}, {"x_um": 90_000.0}) == pytest.approx(6.5)


def test_settings_tell_what_the_controller_has(tmp_path: Path) -> None:
    board = GrblController(tmp_path, hal=True)
    board.settings[160] = 0.02
    with stage_on(board) as stage:
        settings = stage.settings()
        assert settings["$100"] == 250.0
        assert settings["resolution_x_um"] == 4.0
        assert settings["acceleration_x_um_per_s2"] == 10_000.0
        assert settings["backlash_compensated_x_um"] == 20.0
        assert settings["controller_soft_limits"] is True
        assert "backlash_compensated_y_um" not in settings
        identity = stage.identity
        assert (identity.vendor, identity.model, identity.firmware) == (
            "grblHAL",
            "Bench board",
            "1.1f.20240101",
        )
    board.unplug()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({13: 1}, r"reports inches \(\$13=1\)"),
        ({112: 0}, r"\$112 \(maximum rate of axis Z\) is 0"),
    ],
)
def test_settings_that_make_positions_wrong_are_refused(
    plain: GrblController, wrong: dict[int, float], words: str
) -> None:
    plain.settings |= wrong
    stage = stage_on(plain)
    with pytest.raises(DeviceError, match=words):
        stage.open()
    assert not stage.is_open


def test_homing_switched_off_says_what_to_do(plain: GrblController) -> None:
    plain.settings |= {20: 0, 22: 0}
    with stage_on(plain) as stage, pytest.raises(DeviceError, match=r'\$22=0.*homing = "here"'):
        stage.home()


HERE = {"homing": "here", "axes": {"x_um": {"lower_limit": -9e3, "upper_limit": 9e3}}}


@pytest.mark.parametrize("while_open", [False, True])
def test_without_homing_an_alarm_is_unlocked_by_who_asks_for_it(
    plain: GrblController, *, while_open: bool
) -> None:
    plain.settings |= {20: 0, 21: 1, 22: 0}
    if not while_open:
        plain._raise_alarm(3, critical=False)
    with stage_on(plain, **HERE) as stage:
        if while_open:
            plain.press_reset()
            stage.home()
            stage.move_to({"x_um": 100.0})
            plain.hit_limit_switch()
            assert until(lambda: not stage.is_homed)
        with pytest.raises(DeviceError, match=r"locked by an alarm.*is lost then.*Stage, Unlock.*unlock\(\)"):
            stage.home()
        assert stage.needs_unlocking
        stage.unlock()
        stage.position()
        assert not stage.needs_unlocking
        assert not stage.is_homed
        with pytest.raises(DeviceError, match="was unlocked: its position has no reference"):
            stage.move_to({"x_um": 50.0})
        stage.home()
        assert stage.move_to({"x_um": 50.0}) == pytest.approx({"x_um": 50.0}, abs=4.0)


def test_what_homes_by_switches_is_not_unlocked(plain_stage: GrblStage) -> None:
    with pytest.raises(DeviceError, match=r"homes by its switches.*Home it"):
        plain_stage.unlock()


def test_soft_limits_switched_off_are_warned_of(
    plain: GrblController, caplog: pytest.LogCaptureFixture
) -> None:
    plain.settings[20] = 0
    with caplog.at_level(logging.WARNING), stage_on(plain):
        assert "soft limits are off" in caplog.text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"axes": {"x_um": {}, "y_um": {"letter": "X"}}}, "are both axis X"),
        ({"homing": "here"}, "needs lower_limit and upper_limit"),
        ({"homing": "here", "axes": {"x_um": {"lower_limit": 0}}}, "needs lower_limit and upper_limit"),
        ({"axes": {"x_mm": {}}}, "must be an axis of the bench"),
        ({"axes": {}}, "at least 1"),
    ],
)
def test_mistakes_in_the_configuration(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        GrblOptions.model_validate({"port": "/dev/ttyUSB0", **options})


def test_an_axis_that_is_not_there(plain: GrblController) -> None:
    with pytest.raises(
        DeviceError, match=r"has no axis A for roll_mrad; it has X, Y, Z.*\[stage.axes.roll_mrad\]"
    ):
        stage_on(plain, axes={"roll_mrad": {}}).open()


def test_probe_recognises_a_controller(board: GrblController, monkeypatch: pytest.MonkeyPatch) -> None:
    found = GrblStage.probe(str(board.link))
    assert found is not None
    assert (found.driver, found.kind, found.options) == ("grbl", "stage", {"port": str(board.link)})
    assert ("grblHAL" if board.hal else "GRBL 1.1h") in found.description
    assert "3 axes" in found.description
    board.silent = True
    monkeypatch.setattr(GrblStage, "meet_s", 0.2)
    before = board.received.count(b"\x18")
    assert GrblStage.probe(str(board.link)) is None
    assert board.received.count(b"\x18") == before, "probing resets nobody"


# Faults ------------------------------------------------------------------------------------------
@pytest.mark.usefixtures("quick")
def test_spoilt_reports_are_never_a_position(plain: GrblController, plain_stage: GrblStage) -> None:
    plain_stage.move_to({"x_um": -5000.0})
    spoilt = iter(
        [
            [b"<Idle|MPos:-9.000,-1.0\r\n"],
            [b"<Idle|MPos:-9.000,-1.0", b"00,-1.000|FS:0,0<Idle|MPos:-9.000,-1.000,-1.000>\r\n"],
            [b"\xff\xfe<Idle|MPos:-9.000,-1.000>\r\n"],
        ]
    )

    def fault(asked: bytes, reply: bytes) -> list[Answer]:
        return next(spoilt, [reply]) if asked == b"?" else [reply]  # type: ignore[return-value]

    plain.fault = fault
    with pytest.raises(DeviceTimeoutError):
        plain_stage.position()  # asked twice, nothing whole came
    assert plain_stage.position()["x_um"] == -5000.0  # asked again
    assert next(spoilt, None) is None
    plain.fault = lambda asked, reply: [b"<Idle|MPos:-9.000,-1.000>\r\n"] if asked == b"?" else [reply]
    with pytest.raises(DeviceError, match="reports 2 axes, not 3"):
        plain_stage.position()
    plain.fault = None
    assert plain_stage.position()["x_um"] == -5000.0


@pytest.mark.usefixtures("quick")
def test_a_late_ok_is_not_taken_for_the_next_moves(plain: GrblController, plain_stage: GrblStage) -> None:
    late = [[0.6, b"ok\r\n"]]

    def fault(asked: bytes, reply: bytes) -> list[Answer]:
        return late.pop() if late and asked.startswith(b"$J=") else [reply]

    plain.fault = fault
    with pytest.raises(DeviceTimeoutError, match="did not answer"):
        plain_stage.move_to({"x_um": -3000.0})
    plain.settings[130] = 5.0
    with pytest.raises(DeviceError, match="error 15"):
        plain_stage.move_to({"x_um": -15_000.0})


def test_silence_is_an_error_in_words(plain: GrblController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GrblStage, "meet_s", 0.4)
    plain.silent = True
    with pytest.raises(
        DeviceTimeoutError,
        match=r"stage \(grbl, .*answers on .* at 115200 baud.*Check that port and baud_rate.*Switch it off",
    ):
        stage_on(plain).open()


@pytest.mark.usefixtures("quick")
def test_a_board_stuck_in_an_alarm_is_brought_back(plain: GrblController) -> None:
    plain._raise_alarm(1, critical=True)
    with stage_on(plain) as stage:
        assert not stage.is_homed
        stage.home()


def test_older_firmware_is_refused(plain: GrblController) -> None:
    plain.fault = lambda asked, reply: (
        [b"[0.9j.20150930:]\r\n"] if asked == b"$I" and reply.startswith(b"[") else [reply]
    )
    with pytest.raises(DeviceError, match=r"version is 'unknown'; GRBL 1\.1 or grblHAL was expected"):
        stage_on(plain).open()


def test_unplugged_in_a_move_and_plugged_in_again(board: GrblController, stage: GrblStage) -> None:
    thread, outcome = in_background(lambda: stage.move_to({"x_um": -19_000.0}))
    assert until(lambda: board.state == "Jog")
    board.unplug()
    thread.join(20)
    assert re.search(r"stage \(grbl, .*was lost", str(outcome[0]))
    assert not stage.is_open
    with pytest.raises(DeviceError, match="there is no port"):
        stage.open()
    board.plug_in()
    stage.open()
    assert not stage.is_homed
    stage.home()
    assert stage.move_to({"x_um": -4000.0})["x_um"] == pytest.approx(true_um(board))


def test_unplugged_while_homing(plain: GrblController, plain_stage: GrblStage) -> None:
    plain.homing_s = 30.0
    thread, outcome = in_background(plain_stage.home)
    assert until(lambda: plain.received.count(b"$H") == 2)
    plain.unplug()
    thread.join(20)
    assert "was lost" in str(outcome[0])
    plain_stage.close()
    plain.plug_in()
