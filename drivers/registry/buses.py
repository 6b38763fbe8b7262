"""What is connected to each of the computer's buses, without opening a device or writing to one.

Each function raises a DeviceError that says what is missing when its bus cannot be looked at.
"""

from __future__ import annotations

from pathlib import Path

from drivers.device import FoundDevice
from drivers.errors import DeviceError

_LASTING_LINKS = (Path("/dev/serial/by-id"), Path("/dev/v4l/by-id"))
_USB_FOLDER = Path("/sys/bus/usb/devices")
_VIDEO_FOLDER = Path("/sys/class/video4linux")
_HUB_CLASS = 9


def usb_devices() -> tuple[FoundDevice, ...]:
    """Return all USB devices but hubs, by PyUSB.

    Names come from the kernel, which read them when the device was plugged in: no permission is needed.
    """
    try:
        import usb.core
    except ImportError as error:
        raise _missing("USB", "pyusb", error) from error
    try:
        devices = list(usb.core.find(find_all=True))
    except usb.core.NoBackendError:
        raise DeviceError(
            "USB", "libusb is not installed.", "Install it (Debian: sudo apt install libusb-1.0-0)."
        ) from None
    except usb.core.USBError as error:
        raise DeviceError("USB", f"libusb cannot list devices: {error}.", "Is /dev/bus/usb there?") from error
    found = []
    for device in devices:
        if device.bDeviceClass == _HUB_CLASS:
            continue
        ports = ".".join(map(str, device.port_numbers or ()))
        folder = _USB_FOLDER / f"{device.bus}-{ports}"
        vendor, product = _line(folder / "manufacturer"), _line(folder / "product")
        found.append(
            FoundDevice(
                bus="USB",
                address=f"bus {device.bus} device {device.address}",
                description=_words(vendor, product) or "unnamed USB device",
                vendor=vendor,
                product=product,
                serial_number=_line(folder / "serial"),
                usb_id=f"{device.idVendor:04x}:{device.idProduct:04x}",
            )
        )
    return tuple(found)


def hid_devices() -> tuple[FoundDevice, ...]:
    """Return all HID devices: keyboards and mice too, and one entry for each interface of a device."""
    try:
        import hidraw  # the kernel's driver stays in place; "import hid" would be hidapi's libusb build
    except ImportError as error:
        raise _missing("HID", "hidapi", error) from error
    return tuple(
        FoundDevice(
            bus="HID",
            address=info["path"].decode(errors="replace"),
            description=_words(info["manufacturer_string"], info["product_string"]) or "unnamed HID device",
            vendor=info["manufacturer_string"] or "",
            product=info["product_string"] or "",
            serial_number=info["serial_number"] or "",
            usb_id=f"{info['vendor_id']:04x}:{info['product_id']:04x}",
        )
        for info in sorted(hidraw.enumerate(), key=lambda info: info["path"])
    )


def serial_ports() -> tuple[FoundDevice, ...]:
    """Return all serial ports, those of USB adapters with vendor, product and serial number."""
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise _missing("serial", "pyserial", error) from error
    return tuple(
        FoundDevice(
            bus="serial",
            address=port.device,
            description=port.description if port.description not in (None, "n/a") else "serial port",
            vendor=port.manufacturer or "",
            product=port.product or "",
            serial_number=port.serial_number or "",
            usb_id="" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
        )
        for port in sorted(list_ports.comports(), key=lambda port: port.device)
    )


def lasting_name(port: str) -> str:
    """Return the link to a serial or video port that stays when devices are plugged anew, or the port."""
    for link in sorted(link for folder in _LASTING_LINKS for link in folder.glob("*")):
        if link.resolve() == Path(port).resolve():
            return str(link)
    return port


def video_devices() -> tuple[FoundDevice, ...]:
    """Return the kernel's video devices: cameras, but also decoders and metadata nodes of cameras."""
    found = []
    for folder in sorted(_VIDEO_FOLDER.glob("video*"), key=lambda folder: int(folder.name[5:])):
        interface = (folder / "device").resolve()  # of a USB camera: the interface; its parent is the device
        vendor_id, product_id = _line(interface.parent / "idVendor"), _line(interface.parent / "idProduct")
        found.append(
            FoundDevice(
                bus="video",
                address=f"/dev/{folder.name}",
                description=_line(folder / "name") or "video device",
                vendor=_line(interface.parent / "manufacturer"),
                product=_line(interface.parent / "product"),
                serial_number=_line(interface.parent / "serial"),
                usb_id=f"{vendor_id}:{product_id}" if vendor_id else "",
            )
        )
    return tuple(found)


def _missing(bus: str, package: str, error: ImportError) -> DeviceError:
    """Return the error for a package that is needed to look at a bus; its modules have other names."""
    return DeviceError(bus, f"{package} cannot be loaded: {error}.", f"Install it (pip install {package}).")


def _line(path: Path) -> str:
    """Return the text of a file of the kernel's, empty where there is none."""
    try:
        return path.read_text("utf-8", errors="replace").strip()
    except OSError:
        return ""


def _words(*names: str | None) -> str:
    return " ".join(name for name in names if name)
