"""My stage keeps the contract that every stage keeps, and says in words what goes wrong."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from my_stage import MyStage, MyStageOptions
from my_stage_emulator import MyStageEmulator

from drivers.device import Device
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.testing.stage import StageContract


@pytest.fixture
def emulator() -> Iterator[MyStageEmulator]:
    emulator = MyStageEmulator()
    yield emulator
    emulator.close()


def stage_at(emulator: MyStageEmulator) -> MyStage:
    return MyStage(MyStageOptions(port=emulator.port))


class TestMyStage(StageContract):
    """The whole contract, from this one method."""

    @pytest.fixture(autouse=True)
    def _plug_in(self, emulator: MyStageEmulator) -> None:
        self.emulator = emulator

    def make(self) -> Device:
        self.emulator.homed = False
        return stage_at(self.emulator)


def test_silence_is_an_error_in_words(emulator: MyStageEmulator) -> None:
    with stage_at(emulator) as stage:
        emulator.silent = True
        with pytest.raises(DeviceTimeoutError, match="did not answer"):
            stage.position()
        emulator.silent = False
        assert stage.position()["x_um"] == 10_000


def test_a_fault_is_an_error_in_words(emulator: MyStageEmulator) -> None:
    with stage_at(emulator) as stage:
        emulator.fault = True
        with pytest.raises(DeviceError, match="reports a fault"):
            stage.position()
        emulator.fault = False


def test_it_is_recognised_at_its_port(emulator: MyStageEmulator) -> None:
    found = MyStage.probe(emulator.port)
    assert found is not None
    assert found.bench_lines() == f'[stage]\ndriver = "my_stage"\nport = "{emulator.port}"'
    emulator.silent = True
    assert MyStage.probe(emulator.port) is None
