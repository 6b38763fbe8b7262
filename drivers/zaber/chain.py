"""Asking the devices of a Zaber chain: every reply belongs to its command, damaged ones are asked again."""

from __future__ import annotations

import itertools
import logging
import threading

from drivers.common.framing import Belongs
from drivers.common.serial_transport import SerialTransport
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.zaber.protocol import FAULTS, REJECTIONS, Message, command, flag_words, parse

_log = logging.getLogger(__name__)
_NUMBERS = 100
_ATTEMPTS = 3
_REPLY_S = 0.5


class Chain:
    """The devices behind one serial port.

    Every command carries a message number, so that no reply is taken for another's, and a checksum. A command
    whose reply is lost or damaged is sent again: all that are used here may be (absolute moves, settings).

    Parameters
    ----------
    port, device : str
        Serial port, and the stage as error messages name it.
    baud_rate : int
    """

    def __init__(self, port: str, device: str, baud_rate: int) -> None:
        self.device = device
        self._transport = SerialTransport(
            port, device, baud_rate=baud_rate, timeout_s=_REPLY_S, on_message=self._unasked
        )
        self._numbers = itertools.cycle(range(_NUMBERS))
        self._counting = threading.Lock()
        self._checksummed: set[int] = set()
        """Devices that were told to send checksums: what comes without is torn."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open and has not failed."""
        return self._transport.is_open

    def open(self) -> None:
        """Open the port."""
        self._checksummed.clear()
        self._transport.open()

    def close(self) -> None:
        """Close the port."""
        self._transport.close()

    def ask(self, text: str, device: int, axis: int = 0) -> Message:
        """Send a command to one device or axis and return its reply.

        Raises
        ------
        DeviceTimeoutError
            When no whole reply came.
        DeviceError
            When the device rejects the command (with its reason in words), or the port failed.
        """
        for attempt in range(_ATTEMPTS):
            with self._counting:
                number = next(self._numbers)
            try:
                reply = self._exchange(text, device, axis, number)
            except DeviceTimeoutError as error:
                if attempt == _ATTEMPTS - 1:
                    raise DeviceTimeoutError(
                        self.device,
                        f"device {device} did not answer {text!r} on {self._transport.port}.",
                        "Check its power, the cable, its number and the baud rate (Zaber's software shows "
                        "both).",
                    ) from error
                _log.info("%s: no whole answer to %r, asking again", self.device, text)
                continue
            if reply.accepted:
                return reply
            reason = REJECTIONS.get(reply.data.split(" ")[0], "")
            raise DeviceError(
                self.device,
                f"device {device} axis {axis} rejects {text!r}: {reason or 'it says'} ({reply.data})"
                + (f"; {flag_words(reply.flag)}." if reply.flag != "--" else "."),
            )
        raise AssertionError("unreachable")

    def number(self, text: str, device: int, axis: int = 0) -> float:
        """Ask for one number; errors as ``ask``, and when the answer is none."""
        return _number(self.device, text, self.ask(text, device, axis).data)

    def have_checksums(self, device: int) -> bool:
        """Have a device send checksums from now on; return whether it did before.

        Raises
        ------
        DeviceError
            When its firmware cannot.
        """
        before = self.number("get comm.checksum", device) != 0
        if not before:
            self.ask("set comm.checksum 1", device)
        self._checksummed.add(device)
        return before

    def no_checksums(self, device: int) -> None:
        """Have a device send no checksums, as it was found."""
        self._checksummed.discard(device)
        self.ask("set comm.checksum 0", device)

    def stop(self) -> None:
        """Stop every axis of every device at once, whatever reply is awaited; callable from any thread."""
        self._transport.send_now(command("stop"))

    def _exchange(self, text: str, device: int, axis: int, number: int) -> Message:
        def judge(line: bytes) -> Belongs:
            message = self._parsed(line)
            if message is None or (message.kind, message.device, message.number) != ("@", device, number):
                return Belongs.OTHER
            return Belongs.END

        lines = self._transport.request(command(text, device, axis, number), judge)
        message = self._parsed(lines[-1])
        if message is None:
            raise AssertionError("a reply that was matched can be parsed")
        return message

    def _parsed(self, line: bytes) -> Message | None:
        message = parse(line)
        if message is not None and message.device in self._checksummed:
            return parse(line, need_checksum=True)
        return message

    def _unasked(self, line: bytes) -> None:
        """Take note of alerts, of replies to STOP and of garbage."""
        message = self._parsed(line)
        if message is None:
            _log.info("%s: sent %r, which is no message", self.device, line[:80])
        elif message.flag != "--":
            level = logging.WARNING if message.flag in FAULTS else logging.INFO
            _log.log(level, "%s: device %d: %s", self.device, message.device, flag_words(message.flag))


def _number(device: str, text: str, data: str) -> float:
    try:
        return float(data)
    except ValueError:
        raise DeviceError(device, f"answers {data!r} to {text!r}; a number is expected.") from None
