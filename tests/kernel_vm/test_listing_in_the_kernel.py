"""``diffuserbench devices`` on a computer with one device on each of the kernel's buses."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.registry.buses import hid_devices, serial_ports, usb_devices, video_devices
from tests.mocks.dlpc900_device import Dlpc900Emulator
from tests.mocks.uhid_device import UhidDevice
from tests.mocks.usb_gadget import UsbSerialGadget
from tests.mocks.waiting import until

pytestmark = pytest.mark.kernel_vm
NAMES = ("Kuo Optics", "Diffuser Stage", "SN-0042")


@pytest.fixture
def devices() -> Iterator[None]:
    gadget = UsbSerialGadget((0x1D6B, 0x0104), NAMES, lambda _: [], lambda data: ([], data))
    slm = UhidDevice(0x0451, 0xC900, "Texas Instruments DLPC900", "LCR9", Dlpc900Emulator().receive)
    yield
    slm.unplug()
    gadget.unplug()


@pytest.mark.usefixtures("devices")
def test_every_bus_says_what_is_on_it() -> None:
    assert until(lambda: any(port.usb_id == "1d6b:0104" for port in serial_ports()), every_s=0.1)
    (port,) = (port for port in serial_ports() if port.usb_id == "1d6b:0104")
    assert (port.vendor, port.product, port.serial_number) == NAMES
    (usb,) = (device for device in usb_devices() if device.usb_id == "1d6b:0104")
    assert (usb.vendor, usb.product, usb.serial_number) == NAMES
    assert usb.address.startswith("bus ")
    (hid,) = (device for device in hid_devices() if device.usb_id == "0451:c900")
    assert hid.serial_number == "LCR9"
    assert hid.address.startswith("/dev/hidraw")
    assert any("vivid" in device.description for device in video_devices())
