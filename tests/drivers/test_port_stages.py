"""Elliptec, SMC100, ESP and ASI stages keep the contract over their emulators, and say what fails."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.asi.stage import AsiOptions, AsiStage
from drivers.elliptec.stage import ElliptecOptions, ElliptecStage
from drivers.errors import DeviceError, LimitError, StoppedError
from drivers.esp301.stage import Esp301Options, Esp301Stage
from drivers.smc100.stage import Smc100Options, Smc100Stage
from drivers.testing.stage import StageContract
from tests.mocks.port_stages import AsiController, ElliptecBus, EspController, Smc100Chain


def elliptec(bus: ElliptecBus) -> ElliptecStage:
    axes = {"x_um": {"address": "0"}, "roll_mrad": {"address": "1", "reverse": True}}
    return ElliptecStage(ElliptecOptions.model_validate({"port": str(bus.link), "axes": axes}))


def smc100(chain: Smc100Chain) -> Smc100Stage:
    axes = {"x_um": {"number": 1}, "z_um": {"number": 2, "reverse": True, "lower_limit": -8000.0}}
    return Smc100Stage(Smc100Options.model_validate({"port": str(chain.link), "axes": axes}))


def esp301(controller: EspController) -> Esp301Stage:
    axes = {"x_um": {"number": 1}, "roll_mrad": {"number": 2, "reverse": True}}
    return Esp301Stage(Esp301Options.model_validate({"port": str(controller.link), "axes": axes}))


def asi(controller: AsiController) -> AsiStage:
    axes = {"x_um": {"letter": "X", "home_at_um": 50_000.0}, "z_um": {"letter": "Z", "home_at_um": 900.0}}
    axes["x_um"] |= {"lower_limit": 41_000.0, "upper_limit": 50_000.0}  # as seen from home
    return AsiStage(AsiOptions.model_validate({"port": str(controller.link), "axes": axes}))


class PortStageContract(StageContract):
    emulator: Any
    stage_of: Any

    @pytest.fixture(autouse=True)
    def _emulated(self, tmp_path: Path) -> Iterator[None]:
        self.device = type(self).emulator(tmp_path)
        yield
        self.device.port.unplug()

    def make(self) -> Any:
        return type(self).stage_of(self.device)


class TestElliptec(PortStageContract):
    emulator = ElliptecBus
    stage_of = staticmethod(elliptec)


class TestElliptecMuteWhenBusy(PortStageContract):
    emulator = staticmethod(lambda folder: ElliptecBus(folder, mute_when_busy=True))
    stage_of = staticmethod(elliptec)


class TestSmc100(PortStageContract):
    emulator = Smc100Chain
    stage_of = staticmethod(smc100)


class TestEsp301(PortStageContract):
    emulator = EspController
    stage_of = staticmethod(esp301)


class TestAsi(PortStageContract):
    emulator = AsiController
    stage_of = staticmethod(asi)


class ToldElliptec(ElliptecStage):
    """A module without a port: it says what it is told to."""

    def __init__(self, about: str, axis: str = "x_um") -> None:
        super().__init__(ElliptecOptions.model_validate({"port": "none", "axes": {axis: {}}}))
        self.says = {"in": f"IN{about}", "gs": "GS00", "gp": "PO00000000"}

    def _query(self, address: str, words: str, reply: str) -> str:
        assert address == "0"
        return self.says[words]


def test_an_elliptec_module_says_its_units() -> None:
    stage = ToldElliptec("14" + "1140TEST2023" + "1781" + "003C" + "00000400")  # ELL20: 60 mm, 1024 a mm
    stage._maps["x_um"], x = stage._read_axis("x_um")
    assert (x.lower_limit, x.upper_limit, x.resolution) == pytest.approx((0, 60_000, 1000 / 1024))
    assert stage._tolerance(x) == 10.0
    stage.says["gp"] = "POFFFFFC00"  # 1024 below its zero
    state = stage._axis_state("x_um")
    assert (state.place, state.moving, state.homed, state.fault) == (-1024, False, False, "")
    stage.says["gp"] = "GS0C"  # a move failed between the questions
    assert "out of its range (status 12)" in stage._axis_state("x_um").fault
    turning = ToldElliptec("0E" + "1140TEST2023" + "1781" + "0168" + "00023000", "yaw_mrad")
    yaw = turning._read_axis("yaw_mrad")[1]
    assert yaw.upper_limit == pytest.approx(2000 * math.pi)
    assert yaw.resolution == pytest.approx(2000 * math.pi / 143_360)
    assert turning._tolerance(yaw) == 1.0
    coarse = ToldElliptec("14" + "1140TEST2023" + "1781" + "003C" + "00000014")  # 20 a mm
    assert 50.0 < coarse._tolerance(coarse._read_axis("x_um")[1]) < 51.0


def test_an_elliptec_module_is_taken_for_what_it_says_that_it_is() -> None:
    for axis, kind, pulses in (("x_um", "0E", "400"), ("yaw_mrad", "14", "400"), ("x_um", "14", "000")):
        told = ToldElliptec(f"{kind}1140TEST20231781003C00000{pulses}", axis)
        with pytest.raises(DeviceError, match=f"is an ELL{int(kind, 16)}, .*cannot be {axis}"):
            told._read_axis(axis)
    assert ToldElliptec("141140TEST20231781000100000001")._read_axis("x_um")[0].scale == 1000.0
    damaged = ToldElliptec("141140TEST20231781003CZZZZZZZZ")
    with pytest.raises(DeviceError, match="module 0 describes itself as 'IN14"):
        damaged._read_axis("x_um")
    assert ToldElliptec("141140TEST20231781003C00000400")._identify() == ("ELL20", "1140TEST", "17")


def test_an_elliptec_module_that_tells_no_place_is_where_it_was_sent() -> None:
    stage = ToldElliptec("14" + "1140TEST2023" + "1781" + "003C" + "00000400")
    stage._maps["x_um"], _ = stage._read_axis("x_um")
    stage.says |= {"gs": "GS09", "gp": "GS09"}
    state = stage._axis_state("x_um")
    assert (state.place, state.moving, state.homed, state.fault) == (0.0, True, False, "")
    stage._commanded = {"x_um": 2000.0}
    stage._homed.add("x_um")
    assert stage._axis_state("x_um") == (state := stage._axis_state("x_um"))
    assert (state.place, state.moving, state.homed) == (2048.0, True, True)
    stage._unasked(b"0GS12")
    assert stage._axis_state("x_um").fault == "unknown status (status 18)"
    assert ElliptecStage.probed_axis == {"address": "0"}


def test_ports_are_opened_at_the_speed_of_their_controllers() -> None:
    assert ToldElliptec("")._link._baud_rate == 9600
    options = Smc100Options.model_validate({"port": "none", "axes": {"x_um": {"number": 3}}})
    assert Smc100Stage(options)._link._baud_rate == 57_600
    with pytest.raises(ValidationError, match="are both controller 1"):
        Smc100Options.model_validate({"port": "p", "axes": {"x_um": {}, "y_um": {}}})


def test_an_elliptec_module_that_was_away_has_lost_its_home() -> None:
    stage = ToldElliptec("14" + "1140TEST2023" + "1781" + "003C" + "00000400")
    stage._homed.add("x_um")
    stage._maps["x_um"], _ = stage._read_axis("x_um")  # as on opening
    assert not stage._axis_state("x_um").homed


class ToldSmc100(Smc100Stage):
    """A controller without a port: it says what it is told to."""

    def __init__(self, **says: str) -> None:
        super().__init__(Smc100Options.model_validate({"port": "none", "axes": {"x_um": {"number": 3}}}))
        self.says = {"SL": "-1.5", "SR": "25", "VA": "0.4", "SU": "0.0001", "TE": "@", "TS": "000032"} | says
        self.sent = b""
        self._link = self  # type: ignore[assignment]

    def send_now(self, message: bytes) -> None:
        self.sent += message

    def _query(self, name: str, words: str, reply: str, question: str = "") -> str:
        return self.says[words]


def test_an_smc100_says_its_units_and_states() -> None:
    stage = ToldSmc100(TP="2.5")
    x = stage._read_axis("x_um")[1]
    assert (x.lower_limit, x.upper_limit, x.speed_per_s) == pytest.approx((-1500, 25_000, 400))
    assert x.resolution == pytest.approx(0.1)
    assert stage._tolerance(x) == 1.0
    coarse = ToldSmc100(SU="0.01")
    assert 10.0 < coarse._tolerance(coarse._read_axis("x_um")[1]) < 10.5
    told = {"000032": (False, True, ""), "000028": (True, True, ""), "00001E": (True, False, "")}
    told |= {"00000A": (False, False, ""), "010014": (False, False, "DC voltage too low")}
    told |= {"002032": (False, True, "following error")}
    for said, expected in told.items():
        stage.says["TS"] = said
        state = stage._axis_state("x_um")
        assert (state.place, state.moving, state.homed, state.fault) == (2.5, *expected)


def test_an_smc100_that_refuses_a_command_says_why() -> None:
    stage = ToldSmc100(TE="G")
    with pytest.raises(DeviceError, match=r"controller 3 refuses 'PA9.500000': the target is out of its lim"):
        stage._send_move("x_um", 9.5)
    assert stage.sent == b"3PA9.500000\r\n"


def test_an_axis_that_was_sent_home_is_there_once_it_has_been_seen_to_leave_or_had_the_time_to() -> None:
    stage = ToldSmc100()
    assert not stage._came_home("x_um", moving=False)  # nobody sent it
    stage._homing["x_um"] = time.monotonic() + 1e3
    assert not stage._came_home("x_um", moving=False)  # it may not have set out yet
    assert not stage._came_home("x_um", moving=True)
    assert stage._came_home("x_um", moving=False)
    assert not stage._came_home("x_um", moving=False)  # once
    stage._left.clear()
    stage._homing["x_um"] = time.monotonic() - 1e3
    assert stage._came_home("x_um", moving=False)  # it stood there already


def test_homing_begins_anew_and_is_not_going_on_where_it_could_not_be_begun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = ToldSmc100()
    stage._left.add("x_um")
    stage._homed.add("x_um")
    stage._start_homing()
    assert (stage._left, stage._homed) == (set(), set())
    assert time.monotonic() - 60 < stage._homing["x_um"] <= time.monotonic()
    stage.says["TE"] = "D"
    with pytest.raises(DeviceError, match="it cannot be done now"):
        stage._start_homing()
    assert stage._homing == {}
    monkeypatch.setattr(stage, "_send_home", lambda _: stage._homing.clear())  # STOP came just then
    stage._start_homing()
    assert stage._homing == {}


def test_elliptec_is_not_homed_when_its_homing_was_stopped(tmp_path: Path) -> None:
    bus = ElliptecBus(tmp_path)
    with elliptec(bus) as stage:
        assert [axis.speed_per_s for axis in stage.axes] == pytest.approx([60_000.0, 5_000.0])
        stage.home()
        stage.move_to({"x_um": 20_000.0, "roll_mrad": -500 * math.pi})
        assert [axis.place for axis in bus.axes.values()] == [20 * 1024, 143_360 // 4]
        bus.axes["0"].set_place(bus.axes["0"].target)
        bus.axes["0"].speed_per_s = 2000  # homing would take 10 s, however late STOP comes
        with ThreadPoolExecutor(1) as other:
            homing = other.submit(stage.home)
            deadline_s = time.monotonic() + 10
            while not stage.is_moving and time.monotonic() < deadline_s:
                time.sleep(0.002)
            stage.stop()
            with pytest.raises(StoppedError):
                homing.result(10)
        assert not stage.is_homed
    bus.port.unplug()


def test_elliptec_failures_are_said(tmp_path: Path) -> None:
    bus = ElliptecBus(tmp_path)
    with elliptec(bus) as stage:
        stage.home()
        stage.move_to({"x_um": 30_000.0}, wait=False)
        bus.status["0"] = 2  # said once: unasked, or to who asks just then
        bus.axes["0"].halt()
        with pytest.raises(DeviceError, match=r"x_um \(module 0\): it did not reach its place in time"):
            stage.wait(5.0)
        stage.home()
        for line in (b"0GS02x", b"0PO02", b"0GS00"):
            stage._unasked(line)
            assert not stage._faults
        stage._unasked(b"0GS02")
        assert [*stage._faults] == ["x_um"]
        assert "it did not reach its place in time" in stage._faults["x_um"]
    wrong = {"port": str(bus.link), "axes": {"x_um": {"address": "1"}}}
    with pytest.raises(DeviceError, match=r"is an ELL14, which turns .*cannot be x_um"):
        ElliptecStage(ElliptecOptions.model_validate(wrong)).open()
    bus.port.unplug()
    with pytest.raises(ValidationError, match="are both address 0"):
        ElliptecOptions.model_validate({"port": "p", "axes": {"x_um": {}, "y_um": {}}})


def test_smc100_failures_are_said_and_a_disabled_axis_is_enabled(tmp_path: Path) -> None:
    chain = Smc100Chain(tmp_path)
    with smc100(chain) as stage:
        assert "LTA-HS" in stage.identity.model
        assert not stage.identity.simulated
        stage.home()
        chain.states[1] = 0x3C
        assert stage.move_to({"x_um": 123.4})["x_um"] == pytest.approx(123.4)
        stage.home()  # it has its reference: to its zero
        assert stage.position()["x_um"] == pytest.approx(0.0, abs=0.2)
        chain.states[2] = 0x3C
        stage.home()
        chain.errors[1] = 0x0020
        with pytest.raises(DeviceError, match=r"x_um \(controller 1\): following error"):
            stage.move_to({"x_um": 50.0})
    chain.port.unplug()


def test_an_smc100pp_opens_and_a_stop_at_rest_refuses_nothing_later(tmp_path: Path) -> None:
    chain = Smc100Chain(tmp_path)
    chain.steppers.add(1)
    with smc100(chain) as stage:
        x, z = stage.axes
        assert (x.resolution, z.resolution) == pytest.approx((1.0, 0.1))
        stage.stop()  # refused by axes without a reference, and kept by them until they are asked
        stage.home()
        assert stage.is_homed
    chain.port.unplug()


def test_esp301_failures_are_said_and_its_units_are_kept(tmp_path: Path) -> None:
    controller = EspController(tmp_path)
    found = Esp301Stage.probe(str(controller.link))
    assert found is not None
    assert "ESP301, firmware 3.0.1" in str(found)
    with esp301(controller) as stage:
        x, roll = stage.axes
        assert (x.lower_limit, x.upper_limit, x.resolution) == pytest.approx((-1000.0, 25_000.0, 0.1))
        assert (roll.lower_limit, roll.upper_limit) == pytest.approx((-157.08, 0.17453), rel=1e-4)
        assert not stage.is_homed
        stage.home()
        assert stage.move_to({"x_um": 123.4})["x_um"] == pytest.approx(123.4)
        controller.powered[1] = False  # by the emergency button: it is switched on again for the next move
        assert stage.move_to({"x_um": 200.0})["x_um"] == pytest.approx(200.0)
        stage.move_to({"x_um": 20_000.0}, wait=False)
        controller.axes[1].halt()
        controller.errors.append((104, "POSITIVE HARDWARE LIMIT DETECTED"))
        with pytest.raises(
            DeviceError, match=r"x_um \(axis 1\): positive hardware limit detected \(error 104\)"
        ):
            stage.wait(5.0)
        with pytest.raises(
            DeviceError, match=r"axis 1 refuses 'PA999': maximum value exceeded \(error 105\)"
        ):
            stage._tell("x_um", "PA999")
        stage._start_homing()
        controller.errors.append((113, "HOME SWITCH NOT FOUND"))
        stage.position()  # of somebody who only looks: the controller does not say it again
        while stage.is_moving or stage._homing:
            time.sleep(0.02)
        assert not stage.is_homed
    controller.units = {1: 0, 2: 2}
    for number, words in ((1, "axis 1 counts in steps: it cannot be x_um"), (2, "axis 2 moves along a line")):
        controller.units[1] = 0 if number == 1 else 3
        with pytest.raises(DeviceError, match=words):
            esp301(controller).open()
    controller.port.unplug()


def test_asi_says_its_refusals_and_reads_what_is_configured_at_home(tmp_path: Path) -> None:
    controller = AsiController(tmp_path)
    with asi(controller) as stage:
        assert stage.identity.firmware == "USB-9.53"
        assert stage.limits["x_um"] == (-5000.0, 5000.0)  # of wherever it was switched on
        stage.home()
        assert stage.position() == {"x_um": 50_000.0, "z_um": 900.0}
        assert stage.limits == {"x_um": (41_000.0, 50_000.0), "z_um": (-900.0, 900.0)}
        assert stage.move_to({"x_um": 41_000.0, "z_um": -899.0})["x_um"] == pytest.approx(41_000.0)
        stage.home()
        assert stage.limits == {"x_um": (41_000.0, 50_000.0), "z_um": (-900.0, 900.0)}
        with pytest.raises(DeviceError, match=r"refuses 'Q X': it does not know the command \(error 1\)"):
            stage._query("Q X")
    axes = {"x_um": {"letter": "X", "home_at_um": 5000.0, "upper_limit": 5001.0}}
    with AsiStage(AsiOptions.model_validate({"port": str(controller.link), "axes": axes})) as stage:
        for _ in range(2):
            with pytest.raises(LimitError, match="-5000 to 5001 reach beyond the controller's own"):
                stage.home()
        assert not stage.is_homed
    found = AsiStage.probe(str(controller.link))
    assert found is not None
    assert found.driver == "asi"
    controller.port.unplug()
    with pytest.raises(DeviceError, match="no port"):
        asi(controller).open()


def test_elliptec_modules_answer_somebody_elses_client_as_they_answer_ours(tmp_path: Path) -> None:
    peer = pytest.importorskip("thorlabs_elliptec", reason="thorlabs-elliptec is not installed (dev extra)")
    bus = ElliptecBus(tmp_path)
    module = peer.ELLx(str(bus.link), x=20)
    try:
        assert (module.travel, module.serial_number, module.units) == (60, "1140TEST", "mm")
        module.home(blocking=True)
        module.move_absolute(1.5, blocking=True)
        assert module.get_position() == pytest.approx(1.5, abs=1e-3)
        with pytest.raises(peer.ELLError) as caught:
            module.move_absolute(61.0, blocking=True)
        assert caught.value.status.value == 12
    finally:
        module.close()
        time.sleep(0.3)  # its thread ends its port
    bus.port.unplug()


def test_an_asi_controller_answers_somebody_elses_client_as_it_answers_ours(tmp_path: Path) -> None:
    peer = pytest.importorskip("asitiger.tigercontroller", reason="asitiger is not installed (dev extra)")
    controller = AsiController(tmp_path)
    tiger = peer.TigerController.from_serial_port(str(controller.link))
    assert float(tiger.speed({"X": "?"})["X"]) == pytest.approx(6.0)
    tiger.move({"X": 20_000})
    tiger.wait_until_idle()
    assert tiger.where(["X"]) == {"X": 20_000}
    tiger.home(["X"])
    with pytest.raises(Exception, match="N-21"):
        tiger.halt()
    tiger.home(["X"])
    tiger.wait_until_idle()
    tiger.here({"X": 1000})
    assert tiger.where(["X"]) == {"X": 1000}
    tiger.connection.disconnect()
    controller.port.unplug()


def test_a_wrong_port_is_no_such_stage(tmp_path: Path) -> None:
    controller = AsiController(tmp_path)
    assert ElliptecStage.probe(str(controller.link)) is None
    controller.port.unplug()
