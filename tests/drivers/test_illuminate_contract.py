"""The Illuminate driver keeps the LED arrays' contract, over firmware 1.32, old and new, 2.26 and 2.32."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.device import Device
from drivers.illuminate.led_array import IlluminateLedArray, IlluminateOptions
from drivers.testing.led_array import LedArrayContract
from tests.mocks.illuminate_emulator import IlluminateEmulator


class IlluminateContract(LedArrayContract):
    version: str
    normalises = False

    @pytest.fixture(autouse=True)
    def _array(self, tmp_path: Path) -> Iterator[None]:
        self.array = IlluminateEmulator(tmp_path, self.version, normalises=self.normalises)
        yield
        self.array.unplug()
        assert self.array.corrupted == []

    def make(self) -> Device:
        return IlluminateLedArray(IlluminateOptions(port=str(self.array.link)))


class TestFirmware1(IlluminateContract):
    version = "1.32"


class TestNormalisingFirmware1(IlluminateContract):
    version = "1.32"
    normalises = True


class TestFirmware226(IlluminateContract):
    version = "2.26"


class TestFirmware232(IlluminateContract):
    version = "2.32"
