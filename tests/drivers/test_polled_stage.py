"""What every polled stage does, over a controller that misbehaves on demand."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping

import pytest

from drivers.common.polled_stage import PolledStage, StageState
from drivers.device import DeviceIdentity, DriverOptions
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.stage import StageAxis
from drivers.testing.stage import StageContract

SPEED_PER_S = 400.0
AXES = (StageAxis("x_um", -50.0, 50.0, SPEED_PER_S, 0.5), StageAxis("y_um", -50.0, 50.0, SPEED_PER_S, 0.5))


class ScriptedStage(PolledStage):
    """A controller of two axes in memory."""

    poll_s = 0.002
    stuck_s = 0.1
    grace_s = 0.03
    stop_again_s = 0.05
    stop_s = 0.2

    def __init__(self) -> None:
        super().__init__()
        self.connected = False
        self.homed = False
        self.places = {"x_um": 3.0, "y_um": 3.0}
        self.targets = dict(self.places)
        self.halts = 0
        self.fault: DeviceError | None = None
        self.says: list[str] = []
        self.blocked = False
        self.forgets_home = False
        self.ignores_stop = False
        self.stops_lost = 0
        self.as_sent: Callable[[], None] = lambda: None
        self.as_asked: Callable[[], None] = lambda: None
        self._read_s = time.monotonic()

    @property
    def name(self) -> str:
        return "stage (scripted)"

    @classmethod
    def claims(cls, _options: DriverOptions) -> tuple[str, ...]:
        return ()

    @property
    def _is_connected(self) -> bool:
        return self.connected

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self.connected = True
        return DeviceIdentity("stage", "scripted", "nobody", "S2", "1", "1", True), AXES

    def _disconnect(self) -> None:
        self.connected = False

    def _state(self) -> StageState:
        self.as_asked()
        if self.fault:
            raise self.fault
        now_s = time.monotonic()
        reach, self._read_s = SPEED_PER_S * (now_s - self._read_s), now_s
        for name, place in self.places.items():
            step = self.targets[name] - place
            if not self.blocked:
                self.places[name] = place + max(-reach, min(reach, step))
        faults = tuple(self.says)
        if not self.faults_last:
            self.says.clear()
        return StageState(dict(self.places), self.places != self.targets, self.homed, faults)

    def _start(self, target: Mapping[str, float]) -> None:
        self._state()
        self.as_sent()
        self.targets.update(target)

    def _start_homing(self) -> None:
        self._start({"x_um": 0.0, "y_um": 0.0})
        self.homed = not self.forgets_home

    def _halt(self) -> None:
        self.halts += 1
        if not self.connected:
            raise DeviceError(self.name, "was lost.")
        self.stops_lost -= 1
        if not self.ignores_stop and self.stops_lost < 0:
            self.targets = dict(self.places)


class TestScriptedStage(StageContract):
    def make(self) -> ScriptedStage:
        return ScriptedStage()


@pytest.fixture
def stage() -> Iterator[ScriptedStage]:
    stage = ScriptedStage()
    with stage:
        stage.home()
        yield stage
        stage.ignores_stop = False


def test_a_move_that_ends_elsewhere_is_an_error(stage: ScriptedStage) -> None:
    stage.move_to({"x_um": 50.0, "y_um": 20.0}, wait=False)
    stage.targets["x_um"] = 10.0  # somebody turns a knob
    with pytest.raises(DeviceError, match="x_um is at 10, not 50") as caught:
        stage.wait(10.0)
    assert "y_um" not in str(caught.value)


def test_a_blocked_axis_is_an_error_and_is_told_to_stop(stage: ScriptedStage) -> None:
    stage.blocked = True
    with pytest.raises(DeviceTimeoutError, match="stayed where it is"):
        stage.move_to({"x_um": 50.0})
    assert stage.halts == 1


def test_a_fault_stops_the_other_axes(stage: ScriptedStage) -> None:
    stage.move_to({"x_um": 50.0, "y_um": 50.0}, wait=False)
    stage.fault = DeviceError(stage.name, "axis x stalled.")
    with pytest.raises(DeviceError, match="stalled"):
        stage.wait(10.0)
    assert stage.halts == 1
    stage.fault = None


@pytest.mark.parametrize("told", ["by wait", "by the next move", "to all who wait"])
def test_a_fault_that_only_a_poller_heard_is_told_to_the_mover(stage: ScriptedStage, told: str) -> None:
    stage.faults_last = False
    stage.move_to({"x_um": 20.0}, wait=False)
    stage.says.append("x_um: following error")
    stage.position()  # of a window, a log: the controller says it once
    while stage.is_moving:
        time.sleep(0.002)
    with pytest.raises(DeviceError, match="following error"):
        stage.move_to({"x_um": 10.0}) if told == "by the next move" else stage.wait(5.0)
    if told == "to all who wait":
        with pytest.raises(DeviceError, match="following error"):
            stage.wait(5.0)
    stage.move_to({"x_um": 10.0})  # it was told once
    stage.says.append("x_um: following error")
    stage.position()
    stage.home()
    stage.move_to({"x_um": 10.0})  # what was before the homing is over


def test_a_lasting_fault_that_is_gone_between_moves_refuses_none(stage: ScriptedStage) -> None:
    stage.says.append("x_um: too hot")
    stage.position()
    stage.says.clear()
    stage.move_to({"x_um": 10.0})


def test_a_move_that_was_refused_half_way_stops_what_had_begun(stage: ScriptedStage) -> None:
    def refuse() -> None:
        stage.targets["x_um"] = 50.0
        raise DeviceError(stage.name, "axis y refuses.")

    stage.as_sent = refuse
    with pytest.raises(DeviceError, match="refuses"):
        stage.move_to({"x_um": 50.0, "y_um": 50.0})
    assert stage.halts == 1
    assert not stage.is_moving
    stage.wait(1.0)


def test_stop_while_a_move_is_being_sent_stops_it(stage: ScriptedStage) -> None:
    stoppers: list[threading.Thread] = []

    def stop_meanwhile() -> None:
        stoppers.append(threading.Thread(target=stage.stop))
        stoppers[0].start()
        while stage.halts == 0:
            time.sleep(0.001)

    stage.as_sent = stop_meanwhile
    with pytest.raises(StoppedError):
        stage.move_to({"x_um": 50.0})
    stoppers[0].join(5.0)
    assert not stage.is_moving
    assert stage.position()["x_um"] < 10.0
    with pytest.raises(StoppedError):
        stage.wait(1.0)


def test_stop_after_arrival_is_no_interruption(stage: ScriptedStage) -> None:
    stage.move_to({"x_um": 20.0}, wait=False)
    while stage.is_moving:
        time.sleep(0.002)
    stage.stop()
    stage.wait(1.0)
    assert stage.commanded_position()["x_um"] == 20.0


def test_an_axis_that_ignores_stop_is_an_error(stage: ScriptedStage) -> None:
    stage.ignores_stop = True
    stage.blocked = True
    stage.move_to({"x_um": 50.0}, wait=False)
    with pytest.raises(DeviceTimeoutError, match=r"still moves 0\.2 s after it was told to stop"):
        stage.stop()
    with pytest.raises(StoppedError):
        stage.wait(1.0)


def test_a_stop_that_is_lost_on_the_line_is_sent_again(stage: ScriptedStage) -> None:
    stage.stops_lost = 1
    stage.move_to({"x_um": 50.0}, wait=False)
    stage.blocked = True  # so that it does not arrive meanwhile
    stage.stop()
    assert not stage.is_moving
    assert stage.halts == 2


def test_moves_begun_during_a_move_join_it(stage: ScriptedStage) -> None:
    stage.move_to({"x_um": 30.0}, wait=False)
    stage.move_to({"y_um": 40.0}, wait=False)
    stage.move_by({"x_um": 10.0}, wait=False)
    stage.wait(10.0)
    assert stage.position() == {"x_um": 40.0, "y_um": 40.0}


def test_homing_without_a_reference_is_an_error() -> None:
    stage = ScriptedStage()
    stage.forgets_home = True
    with stage, pytest.raises(DeviceError, match="without a reference"):
        stage.home()


def test_homing_can_be_stopped() -> None:
    stage = ScriptedStage()
    stage.places = {"x_um": 50.0, "y_um": 50.0}
    outcome: list[BaseException] = []

    def home() -> None:
        try:
            stage.home()
        except StoppedError as error:
            outcome.append(error)

    with stage:
        stage.targets = dict(stage.places)
        thread = threading.Thread(target=home)
        thread.start()
        while not stage.is_moving:
            time.sleep(0.001)
        with pytest.raises(LimitError, match="not homed"):
            stage.move_to({"x_um": 0.0})
        stage.stop()
        thread.join(5.0)
    assert "Home again" in str(outcome[0])


def test_a_lost_stage_closes_without_a_word_and_opens_again(stage: ScriptedStage) -> None:
    stage.connected = False
    assert not stage.is_open
    stage.open()
    assert stage.is_open
    assert stage.halts == 1  # tried, in case that a part of it is left
    stage.connected = False
    stage.close()
    assert stage.halts == 2


@pytest.mark.parametrize("where", ["sending", "waiting"])
def test_ctrl_c_stops_the_move(stage: ScriptedStage, where: str) -> None:
    def interrupt() -> None:
        if where == "sending":
            stage.targets["x_um"] = 50.0
            raise KeyboardInterrupt
        stage.as_asked = raise_once

    def raise_once() -> None:
        stage.as_asked = lambda: None
        raise KeyboardInterrupt

    stage.as_sent = interrupt
    with pytest.raises(KeyboardInterrupt):
        stage.move_to({"x_um": 50.0, "y_um": 50.0})
    stage.as_sent = lambda: None
    assert stage.halts == 1
    assert not stage.is_moving
    assert stage.commanded_position() == pytest.approx(stage.position(), abs=1.0)
    stage.move_to({"x_um": 1.0})


def test_opening_stops_what_moves() -> None:
    stage = ScriptedStage()
    stage.targets["x_um"] = 50.0
    with stage:
        assert stage.halts == 1
        assert not stage.is_moving
