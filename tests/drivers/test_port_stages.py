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
