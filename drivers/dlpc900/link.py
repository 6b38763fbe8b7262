"""The USB HID link to one DLPC900: found, opened, one message of 64-byte reports at a time (section 1.2)."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from drivers.device import FoundDevice
from drivers.dlpc900.commands import Command, error_words
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError
from drivers.registry.buses import hid_devices

REPORT_BYTES = 64
_HEADER_BYTES = 4
_READ, _REPLY, _ERROR = 0x80, 0x40, 0x20


@dataclass(frozen=True, slots=True)
class Reply:
    """What the controller answered to the message with the same sequence number."""

    sequence: int
    refused: bool
    """Whether it did not know, or did not carry out, the command."""
    data: bytes


def reports(command: int, data: bytes, sequence: int, *, read: bool) -> Iterator[bytes]:
    """Cut one message into reports of 64 bytes, the last filled up with zeros.

    A reply is asked for to writes, too: it says whether the command was carried out.

    Parameters
    ----------
    command : int
        The guide's USB command, e.g. 0x1A24.
    data : bytes
    sequence : int
        0 to 255; comes back in the reply.
    read : bool
        Whether this is a read.
    """
    flags = _REPLY | (_READ if read else 0)
    length = 2 + len(data)
    message = bytes([flags, sequence]) + length.to_bytes(2, "little") + command.to_bytes(2, "little") + data
    for start in range(0, len(message), REPORT_BYTES):
        yield message[start : start + REPORT_BYTES].ljust(REPORT_BYTES, b"\0")


def parse_reply(report: bytes) -> Reply | None:
    """Return the reply in a report; None when the bytes are none.

    Replies longer than a report are cut off: none that this driver asks for is.
    """
    if len(report) < _HEADER_BYTES or not report[0] & _REPLY:
        return None
    length = int.from_bytes(report[2:4], "little")
    data = report[_HEADER_BYTES : _HEADER_BYTES + length]
    if len(data) < min(length, REPORT_BYTES - _HEADER_BYTES):
        return None
    return Reply(report[1], bool(report[0] & _ERROR), bytes(data))


USB_ID = "0451:c900"
_ANSWER_S = 2.0
_POLL_MS = 50
_REPORT_ID = b"\x00"


def found_controllers() -> tuple[FoundDevice, ...]:
    """Return the controllers that are connected."""
    return tuple(device for device in hid_devices() if device.usb_id == USB_ID)


class HidLink:
    """Messages to one controller, each with the reply that belongs to it.

    Parameters
    ----------
    device : str
        The device as error messages name it.
    serial_number : str, optional
        USB serial number; None takes the only controller that is connected.
    """

    def __init__(self, device: str, serial_number: str | None) -> None:
        self._device = device
        self._serial_number = serial_number
        self._lock = threading.RLock()
        self._hid: Any = None
        self._sequence = 0
        self.found: FoundDevice | None = None
        """What the bus says of the controller, once open."""

    @property
    def is_open(self) -> bool:
        """Whether the link stands."""
        return self._hid is not None

    def open(self) -> None:
        """Find and open the controller.

        Raises DeviceError when it is missing, there are several, or it may not be opened.
        """
        try:
            found = self._find()
        except DeviceError as error:
            if error.device == self._device:
                raise
            # The bus could not be looked at; who checks a bench looks for the device.
            raise DeviceError(self._device, error.problem, error.remedy) from error
        import hidraw

        hid = hidraw.device()
        try:
            hid.open_path(found.address.encode())
        except OSError as error:
            raise DeviceError(
                self._device,
                f"{found.address} cannot be opened ({error}).",
                "Another program may have it; or permission is missing: add the udev rule of "
                "docs/how-to/devices/dlpc900.md and plug it in again.",
            ) from error
        with self._lock:
            self._hid, self.found = hid, found

    def close(self) -> None:
        """Close the link; closing twice does nothing."""
        with self._lock:
            hid, self._hid = self._hid, None
            if hid is not None:
                hid.close()

    def read(self, command: Command, n_bytes: int) -> bytes:
        """Ask for a value.

        Raises DeviceError when the controller refuses, is silent, answers too little, or was unplugged.
        """
        data = self._exchange(command, b"", read=True).data
        if len(data) < n_bytes:
            raise DeviceError(
                self._device,
                f"answered {len(data)} bytes to {_words(command)}; {n_bytes} are expected.",
                "Its firmware may be of another generation than the programmer's guide (DLPU018).",
            )
        return data[:n_bytes]

    def write(self, command: Command, data: bytes) -> None:
        """Have a command carried out; errors as ``read``, with the controller's reason in words."""
        self._exchange(command, data, read=False)

    def _exchange(self, command: Command, data: bytes, *, read: bool) -> Reply:
        with self._lock:
            if self._hid is None:
                raise DeviceNotOpenError(self._device)
            self._sequence = (self._sequence + 1) % 256
            self._send_whole(list(reports(command, data, self._sequence, read=read)))
            reply = self._receive(self._sequence, command)
            if reply.refused:
                raise DeviceError(
                    self._device, f"refused {_words(command)}: {self._reason(command)}.", "See its manual."
                )
            return reply

    def _reason(self, refused: Command) -> str:
        if refused is Command.ERROR_CODE:
            return "it does not say why"
        return error_words(self.read(Command.ERROR_CODE, 1)[0])

    def _send_whole(self, message: list[bytes]) -> None:
        """Send a message to its end even on Ctrl-C: the next one would be taken for the rest of it."""
        for number, report in enumerate(message, 1):
            try:
                self._send(report)
            except DeviceError:
                raise
            except BaseException:  # raised behind the call that it interrupted: that report is sent
                for rest in message[number:]:
                    self._send(rest)
                raise

    def _send(self, report: bytes) -> None:
        try:
            written = self._hid.write(_REPORT_ID + report)
        except (OSError, ValueError) as error:
            raise self._unplugged(error) from error
        if written < 0:
            raise self._unplugged(self._hid.error())

    def _receive(self, sequence: int, command: Command) -> Reply:
        deadline_s = time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline_s:
            try:
                report = bytes(self._hid.read(REPORT_BYTES, _POLL_MS))
            except (OSError, ValueError) as error:
                raise self._unplugged(error) from error
            reply = parse_reply(report)
            if reply is not None and reply.sequence == sequence:
                return reply  # others are late replies to what was given up
        raise DeviceTimeoutError(
            self._device,
            f"did not answer {_words(command)} within {_ANSWER_S:g} s.",
            "Switch it off and on again, then open it again.",
        )

    def _unplugged(self, reason: object) -> DeviceError:
        self.close()
        return DeviceError(
            self._device,
            f"was unplugged or switched off ({reason}).",
            "Connect it, switch it on, and open it again.",
        )

    def _find(self) -> FoundDevice:
        controllers = found_controllers()
        fitting = [
            device
            for device in controllers
            if self._serial_number is None or device.serial_number == self._serial_number
        ]
        if len({device.serial_number for device in fitting}) > 1:
            numbers = ", ".join(device.serial_number or "none" for device in fitting)
            raise DeviceError(
                self._device,
                f"several DLPC900 are connected (serial numbers {numbers}).",
                "Name one by serial_number.",
            )
        if not fitting:
            numbers = ", ".join(device.serial_number or "none" for device in controllers)
            which = "no DLPC900" if self._serial_number is None else f"no DLPC900 {self._serial_number}"
            others = f" Connected are serial numbers {numbers}." if controllers else ""
            raise DeviceError(
                self._device,
                f"{which} (USB {USB_ID}) is connected.{others}",
                "Is it switched on, and its USB cable plugged in?",
            )
        return fitting[0]  # of several interfaces of one controller the first takes commands


def _words(command: Command) -> str:
    return f"{command.name.lower().replace('_', ' ')} (0x{command:04X})"
