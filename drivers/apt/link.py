"""One Thorlabs controller on its serial port: requests, what it says unasked, and what it complains of."""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass

from drivers.apt.protocol import (
    CONTROLLERS,
    HW_GET_INFO,
    HW_REQ_INFO,
    HW_RESPONSE,
    HW_RICHRESPONSE,
    AptFramer,
    ControllerName,
    Message,
    decode,
    short,
)
from drivers.common.framing import Belongs, Matcher
from drivers.common.serial_transport import SerialTransport
from drivers.errors import DeviceError, DeviceTimeoutError

_log = logging.getLogger(__name__)
_BAUD_RATE = 115_200
_ATTEMPTS = 2  # and the transport's probes in between
_REPLY_S = 0.5
_INFO = struct.Struct("<l8sH4B60sHHH")
_COMPLAINT = struct.Struct("<HH64s")


@dataclass(frozen=True, slots=True)
class HardwareInfo:
    """What a controller says of itself."""

    model: str
    serial_number: str
    firmware: str


class Link(SerialTransport):
    """The serial port of one controller.

    Parameters
    ----------
    port, device : str
        Serial port, and the stage as error messages name it.
    name : str
        Type of the controller.
    """

    def __init__(self, port: str, device: str, name: ControllerName) -> None:
        self.name = name
        self.controller = CONTROLLERS[name]
        address = self.controller.address
        super().__init__(
            port,
            device,
            baud_rate=_BAUD_RATE,
            framer=AptFramer(),
            probe=(short(HW_REQ_INFO, address), _reply(HW_GET_INFO, None, None)),
            on_message=self._unasked,
            timeout_s=_REPLY_S,
        )
        self._complaint = ""

    def open(self) -> None:
        """Open the port."""
        self._complaint = ""
        super().open()

    def ask(self, request: bytes, number: int, source: int | None, channel: int | None = None) -> Message:
        """Send a request, again if need be, and return its reply.

        Parameters
        ----------
        request : bytes
            One or several messages, of which one is answered.
        number : int
            Of the reply.
        source : int or None
            Who replies; None for whoever it is.
        channel : int, optional
            First word of the reply's data, or its first parameter.

        Raises DeviceTimeoutError when no whole reply came; DeviceError when the port failed.
        """
        for attempt in range(_ATTEMPTS):
            try:
                return decode(self.request(request, _reply(number, source, channel))[-1])
            except DeviceTimeoutError as error:
                if attempt == _ATTEMPTS - 1:
                    raise DeviceTimeoutError(
                        self.device,
                        f"{self.name} did not answer on {self.port}.",
                        "Check its power and cable, and that bench.toml names the right port and controller.",
                    ) from error
                _log.info("%s: %s gave no whole answer, asking again", self.device, self.name)
        raise AssertionError("unreachable")

    def info(self) -> HardwareInfo:
        """Ask who the controller is.

        Raises DeviceError when it is of another type than ``bench.toml`` says.
        """
        address = self.controller.address
        data = self.ask(short(HW_REQ_INFO, address), HW_GET_INFO, None).data
        serial_number, model, _type, minor, interim, major, *_ = _INFO.unpack(data)
        name = model.split(b"\0")[0].decode("ascii", "replace").strip()
        if name[:3] != self.name[:3]:
            raise DeviceError(
                self.device,
                f"{self.port} is a {name or 'nameless controller'}, not a {self.name}.",
                "Correct port or controller in bench.toml.",
            )
        return HardwareInfo(name, str(serial_number), f"{major}.{interim}.{minor}")

    def raise_complaint(self) -> None:
        """Raise what the controller complained of since the last call, if it did."""
        complaint, self._complaint = self._complaint, ""
        if complaint:
            raise DeviceError(self.device, f"{self.name} on {self.port}: {complaint}")

    def _unasked(self, frame: bytes) -> None:
        message = decode(frame)
        if message.number == HW_RICHRESPONSE:
            _about, code, notes = _COMPLAINT.unpack(message.data)
            words = notes.split(b"\0")[0].decode("ascii", "replace").strip()
            self._complaint = f"{words or 'error'} (code {code})."
        elif message.number == HW_RESPONSE:
            self._complaint = "it reports an error that it does not name."


def _reply(number: int, source: int | None, channel: int | None) -> Matcher:
    def judge(frame: bytes) -> Belongs:
        message = decode(frame)
        if message.number != number or source not in (None, message.source):
            return Belongs.OTHER
        found = int.from_bytes(message.data[:2], "little") if message.data else message.first
        return Belongs.END if channel is None or found == channel else Belongs.OTHER

    return judge
