"""The connection to a GRBL controller: commands, status reports, and what it says unasked."""

from __future__ import annotations

import logging
import threading
import time

from drivers.common.serial_transport import SerialTransport
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.grbl.protocol import (
    ALARMS,
    ERRORS,
    SOFT_RESET,
    STATUS,
    Report,
    is_banner,
    line_matcher,
    modes_matcher,
    parse_alarm,
    parse_error,
    parse_report,
    report_matcher,
)

_log = logging.getLogger(__name__)
_RESET_S = 2.0
_OFFSET_REPORTS = 40  # GRBL sends the offset with every thirtieth report at least


class GrblLink(SerialTransport):
    """A serial port with a GRBL controller at its other end.

    Parameters
    ----------
    port : str
    device : str
        The stage as error messages name it.
    baud_rate : int
    timeout_s : float
        For replies.
    """

    def __init__(self, port: str, device: str, baud_rate: int, timeout_s: float) -> None:
        self._place = f"{port} at {baud_rate} baud"
        super().__init__(
            port,
            device,
            baud_rate=baud_rate,
            probe=(b"$G\n", modes_matcher()),
            on_message=self._unasked,
            timeout_s=timeout_s,
        )
        self._offset: tuple[float, ...] | None = None
        self._heard = threading.Condition()
        self._banners = self._reports = 0
        self._alarm: int | None = None
        self._ends: list[bytes] = []
        self._said: list[str] = []

    def open(self) -> None:
        """Open the port."""
        super().open()
        self._offset = None

    def meet(self, within_s: float, *, reset: bool) -> None:
        """Wait until a GRBL controller says something, or refuse the port.

        With ``reset`` a controller that is silent for half the time is reset: stuck in a critical alarm it
        hears nothing else. Boards that start anew when their port is opened greet within two seconds.
        """
        began_s = time.monotonic()
        with self._heard:
            before = self._banners + self._reports
            while self._banners + self._reports == before:
                waited_s = time.monotonic() - began_s
                if waited_s > within_s:
                    raise self._stranger(f"nothing that it says was heard in {within_s:g} s")
                if reset and waited_s > within_s / 2:
                    self.send_now(SOFT_RESET)
                    reset = False
                self.send_now(STATUS)
                self._heard.wait(within_s / 8)

    def _stranger(self, found: str) -> DeviceTimeoutError:
        return DeviceTimeoutError(
            self.device,
            f"no GRBL controller answers on {self._place}: {found}.",
            "Check that port and baud_rate are this controller's (115200 unless changed), its cable "
            "and its power. Switch it off and on, then open it again.",
        )

    # Asking ----------------------------------------------------------------------------------------
    def report(self) -> Report:
        """Ask for a status report; positions are machine coordinates whatever ``$10`` says."""
        for _ in range(_OFFSET_REPORTS):
            report = parse_report(self._report_line())
            assert report is not None, "the matcher lets nothing else through"
            if report.offset is not None:
                self._offset = report.offset
            if report.machine:
                return report
            if self._offset is not None and len(self._offset) == len(report.places):
                places = tuple(w + o for w, o in zip(report.places, self._offset, strict=True))
                return Report(report.state, places, True, self._offset, report.pins)
        raise DeviceError(
            self.device,
            "reports work positions ($10) without their offset.",
            "Send $10=1 to the controller: machine positions.",
        )

    def _report_line(self) -> bytes:
        """Ask once more where nothing came: GRBL keeps one flag for any number of ``?``, read together.

        So a question that meets another one, or the byte that stops a move, may share its answer.
        """
        try:
            (line,) = self.request(STATUS, report_matcher)
        except DeviceTimeoutError as error:
            _log.warning("%s Asked again.", error)
            (line,) = self.request(STATUS, report_matcher)
        return line

    def command(self, line: bytes) -> list[bytes]:
        """Send a line and return what came before its ``ok``.

        Raises DeviceError when the controller refuses it, with the error's meaning.
        """
        *lines, end = self.request(line, line_matcher())
        code = parse_error(end)
        if code is not None:
            raise self.refused(line, code)
        return lines

    def refused(self, line: bytes, code: int) -> DeviceError:
        """Return the error for ``error:code``."""
        meaning = ERRORS.get(code, "see the controller's list of error codes")
        said = f" It said: {' '.join(self._said)}" if self._said else ""
        return DeviceError(
            self.device, f"refuses {line.decode(errors='replace').strip()!r}: {meaning} (error {code}).{said}"
        )

    # Telling ---------------------------------------------------------------------------------------
    def begin(self, line: bytes) -> None:
        """Send a line whose ``ok`` comes much later; ``ended`` tells of it."""
        self.report()  # from here on, whatever ends a command ends this one
        with self._heard:
            self._ends.clear()
            self._said.clear()
        self.send_now(line)

    def ended(self) -> bytes | None:
        """Return ``ok`` or ``error:n`` of the line that was begun; None while it goes on."""
        with self._heard:
            return self._ends[0] if self._ends else None

    def reset(self) -> None:
        """Reset the controller, and wait until it has said so."""
        with self._heard:
            before = self._banners
            self.overtake(SOFT_RESET)
            if not self._heard.wait_for(lambda: self._banners > before, _RESET_S):
                raise self._stranger("it does not answer a reset")

    # What it says unasked --------------------------------------------------------------------------
    @property
    def banners(self) -> int:
        """How often it was reset, by whomever."""
        return self._banners

    def take_alarm(self) -> int | None:
        """Return the code of an alarm since the last call."""
        with self._heard:
            alarm, self._alarm = self._alarm, None
            return alarm

    def alarm_words(self, alarm: int) -> str:
        """Return what an alarm means."""
        return f"{ALARMS.get(alarm, 'see the list of alarm codes')} (alarm {alarm})"

    def _unasked(self, line: bytes) -> None:
        alarm = parse_alarm(line)
        with self._heard:
            if alarm is not None:
                self._alarm = alarm
                _log.info("%s: %s", self.device, self.alarm_words(alarm))
            elif is_banner(line):
                self._banners += 1
                self._offset = None
            elif parse_report(line) is not None:
                self._reports += 1
            elif line == b"ok" or parse_error(line) is not None:
                self._ends.append(line)
            elif line.startswith(b"[MSG:"):
                self._said = [*self._said[-2:], line.decode(errors="replace")]
            self._heard.notify_all()
