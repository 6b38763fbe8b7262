"""The one way to a serial port: one owner, replies matched to their commands, and no doubt afterwards.

What goes wrong on serial lines is met here once for all drivers: silence, garbage, half replies, replies
that come too late (and would be taken for the answer to the next command), a stop while a reply is awaited, a
cable that is pulled and plugged in again.
"""

from __future__ import annotations

import contextlib
import logging
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import serial

from drivers.common.framing import Belongs, Framer, LineFramer, Matcher
from drivers.device import port_claim
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, StoppedError
from drivers.registry.claim import holder_of


def port_error(device: str, port: str, error: Exception) -> DeviceError:
    """Return the error of a serial port that does not open, in words an operator can act on."""
    text = str(error)
    if "exclusively lock" in text or "busy" in text.lower():
        # This program claims a port before it opens it, so its own claim says nothing of who has the port.
        if holder := holder_of(port_claim(port)):
            return DeviceError(device, f"{port} is in use by {holder}.", "Close that program.")
        return DeviceError(
            device,
            f"{port} is in use by another program, or by another device of this bench.",
            f"Close that program (fuser {port} names it), or give each device its own port.",
        )
    if "No such file" in text or ("could not open port" in text and "Permission" not in text):
        return DeviceError(device, f"there is no port {port}.", "Is it plugged in and switched on?")
    if "Permission" in text:
        return DeviceError(
            device,
            f"{port} may not be used (permission denied).",
            "Join the group that owns it (Debian: sudo adduser $USER dialout) and log in again.",
        )
    return DeviceError(device, f"{port} cannot be opened: {text}.", "Check port and baud rate.")


_log = logging.getLogger(__name__)
_POLL_S = 0.1
_QUIET_S = 0.1
_PROBES = 3


@dataclass
class _Awaited:
    """A command whose reply is awaited."""

    matcher: Matcher
    messages: list[bytes]
    done: bool = False
    error: DeviceError | None = None


class SerialTransport:
    """A serial port with one owner.

    ``request`` may be called from any thread, one command at a time is on its way. ``overtake`` does not wait
    for it: that is how STOP gets through.

    Parameters
    ----------
    port : str
        ``"/dev/ttyUSB0"``, or anything else that pyserial opens.
    device : str
        The device as error messages name it.
    baud_rate : int
    framer : Framer, optional
        Cuts bytes into messages; lines by default.
    probe : (bytes, Matcher), optional
        A command without effect and its reply. After a reply that did not come, or that was not waited for,
        it is sent until it is answered, so that everything before it is known to be old.
    on_message : callable, optional
        Called, in the reading thread, with messages that belong to no command: alerts, greetings, garbage.
    timeout_s : float
        For replies, unless a request says otherwise.
    settle_s : float
        Time that the device needs after the port was opened (boards that reset then).
    """

    def __init__(
        self,
        port: str,
        device: str,
        *,
        baud_rate: int = 115_200,
        framer: Framer | None = None,
        probe: tuple[bytes, Matcher] | None = None,
        on_message: Callable[[bytes], None] | None = None,
        timeout_s: float = 1.0,
        settle_s: float = 0.0,
    ) -> None:
        self.port = port
        self.device = device
        self._baud_rate = baud_rate
        self._framer: Framer = framer or LineFramer()
        self._probe = probe
        self._on_message = on_message
        self._timeout_s = timeout_s
        self.probe_s = timeout_s
        """For the probe's reply: a silent port is given up after three of them."""
        self._settle_s = settle_s
        self._serial: Any = None
        self._reader: threading.Thread | None = None
        self._owner = threading.RLock()
        self._write = threading.Lock()
        self._changed = threading.Condition()
        self._awaited: _Awaited | None = None
        self._failure: DeviceError | None = None
        self._doubts = 0  # counts what may leave replies behind that nobody awaits
        self._settled = 0  # how many of those are over
        self._cancelled = 0
        self._last_byte_s = 0.0
        self._restorers: dict[str, Callable[[], None]] = {}
        self.unmatched = 0
        """Messages that belonged to no command, since the port was opened."""

    # Opening and closing ---------------------------------------------------------------------------
    @property
    def is_open(self) -> bool:
        """Whether the port is open and has not failed."""
        return self._serial is not None and self._failure is None

    def open(self) -> None:
        """Open the port for this owner alone. Opening an open port does nothing.

        Raises DeviceError when the port is missing, may not be used, or has another owner (which is named
        where known).
        """
        with self._owner:
            if self._serial is not None:
                return
            try:
                self._serial = serial.Serial(
                    self.port, self._baud_rate, timeout=_POLL_S, write_timeout=self._timeout_s, exclusive=True
                )
            except (serial.SerialException, OSError, ValueError) as error:
                raise port_error(self.device, self.port, error) from error
            self._failure = None
            self.unmatched = 0
            if self._settle_s or self._probe is not None:
                self._doubts += 1
            self._framer.reset()
            self._reader = threading.Thread(
                target=self._read, args=(self._serial,), name=f"reader of {self.port}", daemon=True
            )
            self._reader.start()
            if self._settle_s:
                time.sleep(self._settle_s)

    def close(self) -> None:
        """Close the port; whoever awaits a reply gets a StoppedError. Closing twice does nothing."""
        port, reader = self._serial, self._reader
        self._serial = self._reader = None
        self._fail_awaited(StoppedError(self.device, "the port was closed."))
        if port is None:
            return
        with contextlib.suppress(Exception):  # of a port that is gone already
            port.cancel_read()
        if reader is not None and reader is not threading.current_thread():
            reader.join()
        with contextlib.suppress(Exception):
            port.close()

    def remember(self, setting: str, restore: Callable[[], None]) -> None:
        """Keep how to bring a setting back after a reconnection; the latest for each name counts."""
        self._restorers[setting] = restore

    def reconnect(self) -> tuple[str, ...]:
        """Close and open the port again and bring back all remembered settings.

        Returns
        -------
        tuple of str
            The settings that could not be brought back; each is logged with its reason.

        Raises DeviceError when the device is not there again.
        """
        with self._owner:
            self.close()
            self.open()
            self._get_in_step(self._cancelled)
            lost: list[str] = []
            for setting, restore in self._restorers.items():
                try:
                    restore()
                except DeviceError as error:
                    _log.warning("%s: %s was not restored: %s", self.device, setting, error)
                    lost.append(setting)
            return tuple(lost)

    # Talking ---------------------------------------------------------------------------------------
    def request(self, command: bytes, matcher: Matcher, timeout_s: float | None = None) -> list[bytes]:
        """Send a command and return the messages of its reply.

        Parameters
        ----------
        command : bytes
            With whatever ends it.
        matcher : Matcher
            Tells which messages are its reply. Others go to ``on_message``.
        timeout_s : float, optional
            For the whole reply.

        Raises DeviceTimeoutError when the reply did not end in time. Should it come later it is not mistaken
        for another's; StoppedError when ``cancel`` or ``close`` was called meanwhile; DeviceError when the
        port failed: a pulled cable.
        """
        ticket = self._cancelled
        with self._owner:
            if self._settled != self._doubts:
                self._get_in_step(ticket)
            timeout_s = self._timeout_s if timeout_s is None else timeout_s
            return self._exchange(command, matcher, timeout_s, ticket)

    def send_now(self, data: bytes) -> None:
        """Send bytes at once, also while a reply is awaited, and expect none. Callable from any thread."""
        with self._write:
            self._send(data)

    def cancel(self) -> None:
        """End every request made so far with a StoppedError: those not yet sent never are.

        Callable from any thread.
        """
        with self._write:
            self._cancelled += 1
        self._fail_awaited(StoppedError(self.device, "the command was cancelled."))

    def overtake(self, data: bytes, *, answered: bool = False) -> None:
        """Cancel every request made so far and send bytes at once: STOP. Callable from any thread.

        With ``answered`` the device replies to these bytes; nobody awaits that, and no later command takes it
        for its own reply.
        """
        self.cancel()
        if answered:
            with self._write:
                self._doubts += 1
        self.send_now(data)

    def _send(self, data: bytes) -> None:
        port = self._serial
        if port is None:
            raise DeviceNotOpenError(self.device)
        if self._failure is not None:
            raise self._failure
        try:
            port.write(data)
            port.flush()
        except (serial.SerialException, OSError, termios.error) as error:  # the last from flush
            raise self._lost(error) from error

    def _exchange(self, command: bytes, matcher: Matcher, timeout_s: float, ticket: int) -> list[bytes]:
        awaited = _Awaited(matcher, [])
        sent = False
        with self._changed:
            self._awaited = awaited
        try:
            with self._write:
                if self._cancelled != ticket:
                    raise StoppedError(self.device, "the command was cancelled before it was sent.")
                sent = True
                self._send(command)
            with self._changed:
                self._changed.wait_for(lambda: awaited.done or awaited.error is not None, timeout_s)
                if awaited.done:
                    return awaited.messages
                if awaited.error is not None:
                    raise awaited.error
            raise DeviceTimeoutError(
                self.device,
                f"did not answer {_shown(command)} on {self.port} within {timeout_s:g} s"
                + (f" (so far: {_shown(b' '.join(awaited.messages))})." if awaited.messages else "."),
                "Check its power, cable and baud rate.",
            )
        finally:
            with self._changed:
                self._awaited = None
            if sent and not awaited.done:  # too late, cancelled, Ctrl-C: a reply may still come
                with self._write:
                    self._doubts += 1

    def _get_in_step(self, ticket: int) -> None:
        """Wait until old replies have run dry, then have the probe answered."""
        doubts = self._doubts
        self._wait_for_quiet()
        self._framer.reset()
        if self._probe is not None:
            unanswered = self._have_probe_answered(*self._probe, ticket)
            if unanswered:
                doubts += unanswered
                self._wait_for_quiet()  # the device may have been late with those replies
        self._settled = doubts

    def _wait_for_quiet(self) -> None:
        deadline_s = time.monotonic() + max(2.0, 2 * self._timeout_s)
        began_s = time.monotonic()
        while (now := time.monotonic()) - max(self._last_byte_s, began_s) < _QUIET_S:
            if now > deadline_s:
                raise DeviceTimeoutError(
                    self.device, f"sends without end on {self.port}.", "Check its baud rate and mode."
                )
            time.sleep(_QUIET_S / 5)

    def _have_probe_answered(self, command: bytes, matcher: Matcher, ticket: int) -> int:
        """Return how many attempts were not answered in time before one was."""
        for unanswered in range(_PROBES - 1):
            with contextlib.suppress(DeviceTimeoutError):
                self._exchange(command, matcher, self.probe_s, ticket)
                return unanswered
        self._exchange(command, matcher, self.probe_s, ticket)
        return _PROBES - 1

    # The reading thread ----------------------------------------------------------------------------
    def _read(self, port: Any) -> None:
        try:
            while self._serial is port:
                data = port.read(max(1, port.in_waiting))
                if data:
                    self._last_byte_s = time.monotonic()
                    for message in self._framer.feed(data):
                        self._dispatch(message)
        except Exception as error:  # noqa: BLE001 - the port, or what a driver makes of its messages
            if self._serial is port:  # else it was closed under pyserial's read
                self._fail_awaited(self._lost(error))

    def _dispatch(self, message: bytes) -> None:
        with self._changed:
            awaited = self._awaited
            verdict = Belongs.OTHER
            if awaited is not None and not awaited.done and awaited.error is None:
                verdict = awaited.matcher(message)
                if verdict is not Belongs.OTHER:
                    awaited.messages.append(message)
                if verdict is Belongs.END:
                    awaited.done = True
                    self._changed.notify_all()
        if verdict is Belongs.OTHER:
            self.unmatched += 1
            _log.debug("%s: %s belongs to no command", self.device, _shown(message))
            if self._on_message is not None:
                self._on_message(message)

    def _fail_awaited(self, error: DeviceError) -> None:
        with self._changed:
            if self._awaited is not None and self._awaited.error is None and not self._awaited.done:
                self._awaited.error = error
            self._changed.notify_all()

    # Failures --------------------------------------------------------------------------------------
    def _lost(self, error: Exception) -> DeviceError:
        self._failure = DeviceError(
            self.device,
            f"was lost on {self.port}: {error}.",
            "Check its cable and power, then reconnect.",
        )
        return self._failure


def _shown(data: bytes, longest: int = 60) -> str:
    text = repr(data)[1:]
    return text if len(text) <= longest else text[:longest] + "...'"
