"""The Thorlabs driver through the kernel's USB: found by its numbers, moved, unplugged, and back."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.apt.stage import AptOptions, AptStage
from drivers.device import FoundDevice
from drivers.errors import DeviceError
from tests.mocks.apt_controller import AptController, split_messages
from tests.mocks.moving_axis import MovingAxis
from tests.mocks.usb_gadget import UsbSerialGadget
from tests.mocks.waiting import until

pytestmark = pytest.mark.kernel_vm
SERIAL_NUMBER = 27_501_971


@pytest.fixture
def cube() -> Iterator[AptController]:
    names = ("Thorlabs", "APT DC Motor Controller", str(SERIAL_NUMBER))
    axes = [MovingAxis(0, 857_600, 400_000, 777)]
    cube = AptController(
        lambda answer: UsbSerialGadget((0x0403, 0xFAF0), names, answer, split_messages),
        "KDC101",
        axes,
        SERIAL_NUMBER,
    )
    yield cube
    cube.close()


def found() -> tuple[FoundDevice, ...]:
    return AptStage.discover()


def test_it_is_found_moves_and_comes_back_after_unplugging(cube: AptController) -> None:
    assert until(lambda: len(found()) == 1, every_s=0.1)
    (device,) = found()
    assert (device.product, device.serial_number, device.usb_id) == ("KDC101", "27501971", "0403:faf0")
    axis = {"port": device.address, "controller": device.product, "actuator": "Z825"}
    stage = AptStage(AptOptions.model_validate({"axes": {"x_um": axis}}))
    with stage:
        assert stage.identity.serial_number == device.serial_number
        stage.home()
        stage.move_to({"x_um": 1000.0})
        assert cube.axes[0].motion.place == 34_304
        stage.move_to({"x_um": 25_000.0}, wait=False)
        cube.port.unplug()
        with pytest.raises(DeviceError, match="stage \\(apt"):
            stage.wait(30.0)
        assert not stage.is_open
        assert until(lambda: not found(), every_s=0.1)
        with pytest.raises(DeviceError, match="there is no port"):
            stage.open()
        cube.port.plug_in()
        assert until(lambda: len(found()) == 1, every_s=0.1)
        stage.open()
        assert stage.is_homed  # the cube has a power supply of its own
        stage.move_to({"x_um": 2000.0})
        assert cube.axes[0].motion.place == 68_608
