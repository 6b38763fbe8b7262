"""What is connected is listed with what its bus says of it; what cannot be looked at says so in words."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import usb.core
from hypothesis import given
from hypothesis import strategies as st
from serial.tools import list_ports

from drivers.device import Device, FoundDevice, port_claim
from drivers.dlpc900.link import HidLink
from drivers.errors import DeviceError
from drivers.registry import buses, registry
from drivers.registry.claim import Claim
from drivers.registry.registry import Listing, list_devices
from instrument.cli.bench import _listing_words


def usb_device(**changes: Any) -> SimpleNamespace:
    row = {
        "bDeviceClass": 0,
        "bus": 1,
        "address": 4,
        "port_numbers": (2, 1),
        "idVendor": 0x403,
        "idProduct": 0xFAF0,
    }
    return SimpleNamespace(**row | changes)


def hid_device(path: bytes, **changes: Any) -> dict[str, Any]:
    row = {
        "path": path,
        "vendor_id": 0x451,
        "product_id": 0xC900,
        "serial_number": "LCR3",
        "manufacturer_string": "Texas Instruments",
        "product_string": "DLPC900",
    }
    return row | changes


def port(device: str, **changes: Any) -> SimpleNamespace:
    row = {
        "description": "n/a",
        "manufacturer": None,
        "product": None,
        "serial_number": None,
        "vid": None,
        "pid": None,
    }
    return SimpleNamespace(device=device, **row | changes)


@pytest.fixture
def computer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A computer with one device on each bus; ``/sys`` is the folder returned."""
    names = tmp_path / "usb" / "1-2.1"
    names.mkdir(parents=True)
    (names / "manufacturer").write_text("Thorlabs\n")
    (names / "product").write_text("APT DC Motor Controller\n")
    (names / "serial").write_text("27000001\n")
    camera = tmp_path / "usb" / "1-3"
    (camera / "1-3:1.0" / "video4linux" / "video10").mkdir(parents=True)
    (camera / "idVendor").write_text("1234\n")
    (camera / "idProduct").write_text("00ab\n")
    (camera / "manufacturer").write_text("Kuo Optics\n")
    (camera / "1-3:1.0" / "video4linux" / "video10" / "name").write_text("Lensless\n")
    (camera / "1-3:1.0" / "video4linux" / "video10" / "device").symlink_to(camera / "1-3:1.0")
    (tmp_path / "video").mkdir()
    (tmp_path / "video" / "video10").symlink_to(camera / "1-3:1.0" / "video4linux" / "video10")
    (tmp_path / "video" / "video2").mkdir()
    monkeypatch.setattr(buses, "_USB_FOLDER", tmp_path / "usb")
    monkeypatch.setattr(buses, "_VIDEO_FOLDER", tmp_path / "video")
    monkeypatch.setattr(usb.core, "find", lambda find_all: [usb_device(), usb_device(bDeviceClass=9)])
    monkeypatch.setitem(
        sys.modules, "hidraw", SimpleNamespace(enumerate=lambda: [hid_device(b"/dev/hidraw3")])
    )
    ports = [
        port(
            "/dev/ttyUSB1",
            description="FT232R",
            manufacturer="FTDI",
            vid=0x403,
            pid=0x6001,
            serial_number="A5",
        ),
        port("/dev/ttyS0"),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    return tmp_path


@pytest.fixture
def drivers(monkeypatch: pytest.MonkeyPatch) -> list[type[Any]]:
    """The drivers that are asked, none at first."""
    asked: list[type[Any]] = []
    monkeypatch.setattr(
        registry, "_drivers", lambda unavailable: ((driver.__name__.lower(), driver) for driver in asked)
    )
    return asked


@pytest.mark.usefixtures("computer", "drivers")
def test_every_bus_is_listed_with_names_and_ids() -> None:
    listed = list_devices()
    assert listed.unavailable == ()
    rows = {(d.bus, d.address): (d.description, d.usb_id, d.serial_number) for d in listed.found}
    assert rows == {
        ("USB", "bus 1 device 4"): ("Thorlabs APT DC Motor Controller", "0403:faf0", "27000001"),
        ("HID", "/dev/hidraw3"): ("Texas Instruments DLPC900", "0451:c900", "LCR3"),
        ("serial", "/dev/ttyS0"): ("serial port", "", ""),
        ("serial", "/dev/ttyUSB1"): ("FT232R", "0403:6001", "A5"),
        ("video", "/dev/video2"): ("video device", "", ""),
        ("video", "/dev/video10"): ("Lensless", "1234:00ab", ""),
    }


@pytest.mark.usefixtures("computer", "drivers")
def test_a_bus_that_cannot_be_looked_at_says_so_and_the_others_are_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def find(**_: bool) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    listed = list_devices()
    assert listed.unavailable == (
        "USB: libusb is not installed. Install it (Debian: sudo apt install libusb-1.0-0).",
    )
    assert {device.bus for device in listed.found} == {"HID", "serial", "video"}


@pytest.mark.usefixtures("computer", "drivers")
@pytest.mark.parametrize(
    ("module", "bus", "package"),
    [
        ("usb.core", "USB", "pyusb"),
        ("hidraw", "HID", "hidapi"),
        ("serial.tools", "serial", "pyserial"),
    ],
)
def test_a_missing_module_ends_the_look_at_its_bus_only(
    monkeypatch: pytest.MonkeyPatch, module: str, bus: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    listed = list_devices()
    (said,) = listed.unavailable
    assert said.startswith(f"{bus}: {package} cannot be loaded: ")
    assert said.endswith(f" Install it (pip install {package}).")
    assert {device.bus for device in listed.found} == {"USB", "HID", "serial", "video"} - {bus}


def test_an_slm_that_cannot_be_looked_for_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hidraw", None)
    with pytest.raises(DeviceError, match=r"slm \(dlpc900\): hidapi cannot be loaded.*pip install hidapi"):
        HidLink("slm (dlpc900)", None).open()


class Finds(Device):
    """A driver that knows the HID device, and recognises no port but ttyUSB1."""

    asked: list[str] = []  # noqa: RUF012

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        return (FoundDevice("HID", "/dev/hidraw3", "LightCrafter", driver="dlpc900", kind="slm"),)

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        cls.asked.append(port)
        if port != "/dev/ttyUSB1":
            return None
        return FoundDevice("serial", port, "GRBL 1.1h", driver="grbl", kind="stage", options={"port": port})


class Fails(Device):
    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        raise DeviceError("GenICam", "Aravis is not installed.", "Install it.")


@pytest.mark.usefixtures("computer")
def test_what_a_driver_claims_replaces_what_the_bus_says(drivers: list[type[Any]]) -> None:
    drivers += [Fails, Finds, Fails]
    listed = list_devices()
    assert [d.description for d in listed.found if d.bus == "HID"] == ["LightCrafter"]
    assert listed.unavailable == ("GenICam: Aravis is not installed. Install it.",)


@pytest.mark.usefixtures("computer")
def test_ports_are_asked_only_on_request_and_never_those_in_use(drivers: list[type[Any]]) -> None:
    drivers += [Fails, Finds]
    Finds.asked.clear()
    list_devices()
    assert Finds.asked == []
    said: list[str] = []
    listed = list_devices(probe=True, say=said.append)
    assert sorted(Finds.asked) == ["/dev/ttyS0", "/dev/ttyUSB1"]
    assert sorted(said) == [
        f"Asking at {port} as driver finds would." for port in ("/dev/ttyS0", "/dev/ttyUSB1")
    ]
    probed = next(d for d in listed.found if d.address == "/dev/ttyUSB1")
    assert (probed.usb_id, probed.serial_number) == ("0403:6001", "A5")
    lines = next(d for d in listed.found if d.address == "/dev/ttyUSB1").bench_lines()
    assert lines == '[stage]\ndriver = "grbl"\nport = "/dev/ttyUSB1"'
    Finds.asked.clear()
    claim = Claim(port_claim("/dev/ttyUSB1"), "stage")
    try:
        listed = list_devices(probe=True)
    finally:
        claim.release()
    assert Finds.asked == ["/dev/ttyS0"]
    assert any("/dev/ttyUSB1 is in use by" in sentence for sentence in listed.unavailable)


def test_every_installed_driver_can_be_asked() -> None:
    """On this computer, whatever is connected: words, no exception."""
    assert all(sentence.endswith(".") or ")" in sentence for sentence in list_devices().unavailable)


PLAIN = st.recursive(
    st.text()
    | st.integers(-(2**60), 2**60)
    | st.booleans()
    | st.floats(allow_nan=False, allow_infinity=False),
    lambda items: st.lists(items, max_size=3),
    max_leaves=6,
)


@given(
    st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True).filter(lambda key: key != "driver"), PLAIN)
)
def test_the_lines_for_bench_toml_mean_the_options(options: dict[str, object]) -> None:
    found = FoundDevice("HID", "there", "thing", driver="x", kind="slm", options=options)
    assert tomllib.loads(found.bench_lines()) == {"slm": {"driver": "x", **options}}


def test_a_table_of_options_is_written_inline() -> None:
    options = {"axes": {"z_um": {"scale": 0.5}}}
    found = FoundDevice("HID", "there", "thing", driver="x", kind="slm", options=options)
    assert tomllib.loads(found.bench_lines())["slm"]["axes"] == options["axes"]


def test_a_note_is_a_comment_after_the_lines() -> None:
    found = FoundDevice("display", "DP-1", "SLM", driver="x", kind="slm", note="pitch_um must be added")
    assert found.bench_lines() == '[slm]\ndriver = "x"\n# pitch_um must be added'


def test_the_command_tells_nothing_found_from_not_looked_at(capsys: pytest.CaptureFixture[str]) -> None:
    found = FoundDevice("serial", "/dev/ttyUSB0", "FT232R", usb_id="0403:6001", serial_number="A5")
    print(_listing_words(Listing((found,), ("USB: libusb is not installed. Install it.",))))
    shown = capsys.readouterr().out
    assert "USB: could not be looked at, see below\nHID: none found\n" in shown
    assert "serial:\n  /dev/ttyUSB0  FT232R, 0403:6001, serial A5\n" in shown
    assert shown.endswith("Could not be looked at:\n  USB: libusb is not installed. Install it.\n")


def test_without_a_driver_there_are_no_lines() -> None:
    assert FoundDevice("HID", "there", "thing").bench_lines() == ""
