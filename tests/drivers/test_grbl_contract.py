"""The GRBL driver keeps the stages' contract, over GRBL 1.1 and grblHAL, of three and six axes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.device import Device
from drivers.grbl.stage import GrblOptions, GrblStage
from drivers.testing.stage import StageContract
from tests.mocks.grbl_controller import GrblController

SIX = {name: {} for name in ("x_um", "y_um", "z_um", "roll_mrad", "pitch_mrad", "yaw_mrad")}


class GrblContract(StageContract):
    rate = 6000.0

    def controller(self, folder: Path) -> GrblController:
        raise NotImplementedError

    @pytest.fixture(autouse=True)
    def _controller(self, tmp_path: Path) -> Iterator[None]:
        self.board = self.controller(tmp_path)
        self.board.settings |= {110 + axis: self.rate for axis in range(len(self.board.letters))}
        yield
        self.board.unplug()

    def make(self) -> Device:
        return GrblStage(GrblOptions.model_validate({"port": str(self.board.link), **self.options()}))

    def options(self) -> dict[str, object]:
        return {}


class TestGrbl(GrblContract):
    def controller(self, folder: Path) -> GrblController:
        return GrblController(folder)


class TestGrblHalOfSixAxes(GrblContract):
    def controller(self, folder: Path) -> GrblController:
        board = GrblController(folder, axes=6, hal=True)
        board.settings |= {22: 9, 23: 0b000101}
        return board

    def options(self) -> dict[str, object]:
        return {"axes": SIX | {"y_um": {"reverse": True, "speed_per_s": 60_000.0}}}


class TestGrblWithoutSwitches(GrblContract):
    rate = 2000.0  # short ways: slow enough to be stopped

    def controller(self, folder: Path) -> GrblController:
        board = GrblController(folder, axes=4)
        board.settings |= {20: 0, 21: 0, 22: 0}
        board.press_reset()
        return board

    def options(self) -> dict[str, object]:
        limits = {"lower_limit": -900.0, "upper_limit": 1000.0}
        return {"homing": "here", "axes": {"z_um": limits, "yaw_mrad": limits | {"letter": "A"}}}
