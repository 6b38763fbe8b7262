"""The DLPC900 driver through the kernel: hidapi, ``/dev/hidraw``, and an emulated controller behind uhid."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.dlpc900 import commands
from drivers.dlpc900.commands import Board
from drivers.dlpc900.slm import Dlpc900Options, Dlpc900Slm
from drivers.errors import DeviceError
from drivers.registry.buses import hid_devices
from tests.mocks.dlpc900_device import Dlpc900Emulator
from tests.mocks.uhid_device import UhidDevice
from tests.mocks.waiting import until

pytestmark = pytest.mark.kernel_vm
SHAPE = (48, 64)


def plugged_in(emulator: Dlpc900Emulator) -> UhidDevice:
    return UhidDevice(0x0451, 0xC900, "Texas Instruments DLPC900", emulator.serial, emulator.receive)


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Dlpc900Emulator:
    monkeypatch.setattr(commands, "BOARDS", {1: Board("DLP6500", SHAPE, 7.56, 1)})
    return Dlpc900Emulator(shape=SHAPE, serial="UHID1")


@pytest.fixture
def device(board: Dlpc900Emulator) -> Iterator[UhidDevice]:
    device = plugged_in(board)
    assert until(lambda: any(found.usb_id == "0451:c900" for found in hid_devices()), every_s=0.1)
    yield device
    if not device._stopping.is_set():
        device.unplug()


@pytest.mark.usefixtures("device")
def test_it_is_found_and_shows_its_levels_exactly(board: Dlpc900Emulator) -> None:
    (found,) = Dlpc900Slm.discover()
    assert found.address.startswith("/dev/hidraw")
    assert found.serial_number == "UHID1"
    levels = np.random.default_rng(0).integers(0, 256, SHAPE, dtype=np.uint8)
    with Dlpc900Slm(Dlpc900Options(serial_number="UHID1", settle_ms=0)) as slm:
        slm.display(levels)
        np.testing.assert_array_equal(board.shown, levels)
        assert slm.settings()["status"] == "DMD active, sequencer runs"
    assert board.shown is None


def test_unplugged_is_an_error_and_plugged_in_again_it_works(
    board: Dlpc900Emulator, device: UhidDevice
) -> None:
    slm = Dlpc900Slm(Dlpc900Options(settle_ms=0))
    slm.open()
    device.unplug()
    with pytest.raises(DeviceError, match="was unplugged or switched off"):
        slm.blank()
    assert not slm.is_open
    board.power_cycle()
    again = plugged_in(board)
    try:
        assert until(lambda: bool(Dlpc900Slm.discover()), every_s=0.1)
        slm.open()
        slm.display(np.full(SHAPE, 7, np.uint8))
        assert (board.shown == 7).all()
        slm.close()
    finally:
        again.unplug()
