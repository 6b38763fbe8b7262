"""Who operates a served bench: one at a time, and a bench that is safe whenever nobody does."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError, StoppedError
from drivers.frame import Frame
from drivers.registry.claim import DeviceBusyError
from drivers.remote.wire import Call, Kind
from instrument.bench.bench import Bench
from instrument.bench.config import BenchConfig
from instrument.bench.safety import StepsFailedError
from instrument.files.errors import BenchError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Operator:
    """A program that has devices of the bench open."""

    key: str
    """What its calls carry."""
    words: str
    """Who it is, for people."""
    since: datetime = field(default_factory=lambda: datetime.now(UTC))


WATCHER = Operator("the page", "the page in the browser")
"""Who looks while nobody operates, and gives way to whoever wants to."""


@dataclass
class _Hold:
    """A device that the operator has open."""

    device: Device
    on_end: Callable[[DeviceError], None]
    """Tells the operator why it is not his any more."""
    stopped_at: int = 0
    """Number of the last call that overtook others."""


class Operation:
    """Opens a bench's devices for one operator at a time, and closes them when he has gone, however.

    Between operators nothing is open, but the camera while somebody looks at the page: other programs of this
    computer may use the devices.

    Parameters
    ----------
    config : BenchConfig
    say : callable
        Takes a sentence for whoever looks after the server.
    """

    def __init__(self, config: BenchConfig, say: Callable[[str], None]) -> None:
        self.config = config
        self._tell = say
        self._taking, self._dropping = threading.RLock(), threading.Lock()
        self._bench: Bench | None = None
        self._dropped: Bench | None = None
        """One whose operation is being ended: once is enough, however many connections break."""
        self._ended: DeviceError | None = None
        self._dismissed: tuple[str, DeviceError] | None = None
        """The key of the last operator whose operation was ended, and why, until he has a device again."""
        self._holds: dict[Kind, _Hold] = {}
        self.operator: Operator | None = None
        self.newest_frame: Frame | None = None
        """The last frame that went to the operator, or to whoever watches."""
        self.trouble: str = ""
        """What could not be made safe the last time, in words; empty when all could."""

    # Taking and letting go -----------------------------------------------------------------------
    def take(self, kind: Kind, operator: Operator, on_end: Callable[[DeviceError], None]) -> Device:
        """Open a device for an operator.

        Raises DeviceBusyError when another operates; DeviceError when the bench has none of this kind, or it
        cannot be opened.
        """
        with self._taking:
            if self._ended is not None:
                raise self._ended
            if self.operator == WATCHER and operator != WATCHER:
                self.let_go("camera", WATCHER)
            present = self.operator
            if present is not None and present.key != operator.key:
                raise DeviceBusyError(
                    kind,
                    f"is operated by {present.words} since {present.since:%Y-%m-%d %H:%M:%S} UTC.",
                    "There is one operator at a time: wait until that program ends, or press STOP on the "
                    "server's page, which ends its operation.",
                )
            if kind in self._holds:
                raise DeviceBusyError(kind, "is open in this program already.", "Close it there first.")
            if kind not in self.config.devices:
                has = ", ".join(self.config.devices)
                raise DeviceError(kind, f"there is none on {self.config.label}.", f"That bench has {has}.")
            bench = self._bench or Bench(self.config)
            try:
                device = bench.open_device(kind)
                if self._ended is not None:  # meanwhile
                    raise self._ended
            except BaseException:
                if self._bench is None:
                    self._close(bench)
                raise
            if self.operator is None and operator != WATCHER:
                self._say(f"Operated by {operator.words}.")
            self._bench, self.operator = bench, present or operator
            self._holds[kind] = _Hold(device, on_end)
            if self._dismissed is not None and self._dismissed[0] == operator.key:
                self._dismissed = None
            return device

    def let_go(self, kind: Kind, operator: Operator) -> None:
        """Close a device that its operator has closed.

        Raises StepsFailedError naming what could not be made safe.
        """
        with self._taking:
            if self.operator is None or self.operator.key != operator.key or kind not in self._holds:
                return
            assert self._bench is not None
            del self._holds[kind]
            try:
                self._bench.close_device(kind)
            finally:
                if not self._holds:
                    self._end(self._bench)

    def drop(self, operator: Operator, reason: DeviceError) -> None:
        """Make the bench safe at once and close it: its operator is lost, or somebody pressed STOP.

        Raises StepsFailedError naming what could not be made safe; all was tried.
        """
        with self._dropping:
            bench = self._bench
            if bench is None or self.operator is None or self.operator.key != operator.key:
                return
            if self._dropped is bench:
                return
            self._dropped = bench
        for hold in list(self._holds.values()):  # a device may be being opened
            hold.stopped_at = 1 << 62  # nothing that is still on its way is carried out
        failure: StepsFailedError | None = None
        try:
            bench.stop()  # not behind a device that is being opened
        except StepsFailedError as error:
            failure = error
        try:
            with self._taking, ExitStack() as last:
                if self._bench is bench:
                    # Whoever cannot be told, the others are, and the devices are closed.
                    last.callback(self._end, bench)
                    self._dismissed = (operator.key, reason)
                    last.callback(self._say, reason.problem)
                    for hold in self._holds.values():
                        last.callback(hold.on_end, reason)
        finally:
            if failure is not None:
                self.trouble = str(failure)
                self._say(self.trouble)
        if failure is not None:
            raise failure

    def stop(self, who: str) -> None:
        """Make the bench safe and end its operation, whoever operates.

        Raises StepsFailedError naming what could not be made safe; all was tried. Raises BenchError when
        nobody operates, and something could not be made safe before.
        """
        operator = self.operator
        if operator is not None:
            reason = StoppedError("bench", f"STOP was pressed by {who}.", "Open it again to go on.")
            self.drop(operator, reason)
        elif self.trouble:
            raise BenchError(self.trouble)

    def end(self, reason: DeviceError) -> None:
        """Make the bench safe and close it for good; errors as ``stop``."""
        self._ended = reason
        if self.operator is not None:
            self.drop(self.operator, reason)

    def _end(self, bench: Bench) -> None:
        operator = self.operator
        self._holds.clear()
        self._close(bench)
        self._bench, self.operator = None, None
        if operator is not None and operator != WATCHER:
            self._say(f"No longer operated by {operator.words}.")

    def _say(self, sentence: str) -> None:
        """Tell whoever looks after the server; a closed terminal or a full disk ends nothing half-way."""
        with suppress(OSError, ValueError):
            self._tell(sentence)

    def _close(self, bench: Bench) -> None:
        try:
            bench.close()
            self.trouble = ""
        except StepsFailedError as error:
            self.trouble = str(error)
            self._say(self.trouble)

    # Calls ---------------------------------------------------------------------------------------
    def device(self, kind: Kind, key: str) -> Device:
        """Return the device that an operator has open.

        Raises DeviceLostError when he has it no more, or what it was taken from him for.
        """
        return self._hold(kind, key).device

    def _hold(self, kind: Kind, key: str) -> _Hold:
        hold, operator = self._holds.get(kind), self.operator
        if hold is None or operator is None or operator.key != key:
            dismissed = self._dismissed  # which another thread may forget meanwhile
            if dismissed is not None and dismissed[0] == key:  # the call was on its way meanwhile
                raise dismissed[1].with_traceback(None)  # else every such call would be kept with it
            raise DeviceLostError(kind, "is not open for this program any more.", "Open it again.")
        return hold

    def make(self, call: Call, kind: Kind, key: str, number: int, arguments: Mapping[str, Any]) -> Any:
        """Carry out a call of the operator's.

        Raises StoppedError when a stop that was sent after it has come before it; ValueError when the
        arguments do not fit; what the device raises.
        """
        hold = self._hold(kind, key)
        if call.verb == "PUT":
            hold.stopped_at = max(hold.stopped_at, number)
        elif call.verb == "POST" and number < hold.stopped_at:
            raise StoppedError(kind, f"{call.name} was overtaken by a stop on its way.")
        made = call.make(hold.device, arguments)
        if isinstance(made, Frame):
            self.newest_frame = made
        return made

    def readings(self) -> dict[str, str]:
        """Return what the open devices say of themselves now, in words, by device."""
        said: dict[str, str] = {}
        bench = self._bench
        if bench is None:
            return said
        for kind, hold in list(self._holds.items()):
            try:
                said[kind] = _words(bench, kind, hold.device)
            except (DeviceError, BenchError) as error:
                said[kind] = str(error)
        return said


def _words(bench: Bench, kind: Kind, device: Device) -> str:
    if not device.is_open:
        return f"{device.name} was lost"
    identity = device.identity
    said = f"{identity.vendor} {identity.model}{' (SIMULATED)' if identity.simulated else ''}: "
    if kind == "camera":
        camera = bench.camera
        streams = ", streaming" if camera.is_streaming else ""
        return f"{said}{camera.exposure_ms:g} ms, gain {camera.gain:.3g}, {camera.pixel_format}{streams}"
    if kind == "stage" and bench.stage is not None:
        moves = ", moving" if bench.stage.is_moving else ""
        places = ", ".join(f"{name} = {place:.6g}" for name, place in bench.stage.position().items())
        return said + places + moves
    if kind == "led_array" and bench.led_array is not None:
        return said + bench.led_array.pattern.description
    if kind == "slm" and bench.slm is not None:
        return said + ("shows an image" if bench.slm.displayed.any() else "blank")
    return said
