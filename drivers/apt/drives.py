"""One axis of a controller: a servo or stepper motor, or a channel of a piezo inertia drive."""

from __future__ import annotations

import struct
import threading
import time
from dataclasses import dataclass

from drivers.apt.link import Link
from drivers.apt.protocol import (
    BAY_1,
    ENABLE,
    HOMED,
    HW_STOP_UPDATEMSGS,
    MOD_GET_CHANENABLESTATE,
    MOD_REQ_CHANENABLESTATE,
    MOD_SET_CHANENABLESTATE,
    MOT_ACK_DCSTATUSUPDATE,
    MOT_GET_DCSTATUSUPDATE,
    MOT_GET_STATUSUPDATE,
    MOT_GET_VELPARAMS,
    MOT_MOVE_ABSOLUTE,
    MOT_MOVE_HOME,
    MOT_MOVE_STOP,
    MOT_REQ_DCSTATUSUPDATE,
    MOT_REQ_STATUSUPDATE,
    MOT_REQ_VELPARAMS,
    MOT_SET_VELPARAMS,
    MOVING,
    PZMOT_ACK_STATUSUPDATE,
    PZMOT_DRIVE,
    PZMOT_ENABLED,
    PZMOT_GET_PARAMS,
    PZMOT_GET_STATUSUPDATE,
    PZMOT_MOVE_ABSOLUTE,
    PZMOT_POSITION,
    PZMOT_REQ_PARAMS,
    PZMOT_REQ_STATUSUPDATE,
    PZMOT_SET_PARAMS,
    RACK,
    RACK_GET_BAYUSED,
    RACK_REQ_BAYUSED,
    SPEED_SCALE,
    STOP_AT_ONCE,
    fault_words,
    long,
    short,
)
from drivers.errors import DeviceError

_STATUS = struct.Struct("<HlHHL")
_VELOCITY = struct.Struct("<Hlll")
_INERTIA_STATUS = struct.Struct("<HllL")
_INERTIA_DRIVE = struct.Struct("<HHHll")
_START_S = 0.3


@dataclass(frozen=True, slots=True)
class DriveState:
    """Where an axis is, in counts, and how it fares."""

    counts: int
    moving: bool
    homed: bool
    faults: list[str]


class Motor:
    """A motor with a reference switch: a cube's only channel, or the bay of a rack."""

    def __init__(self, link: Link, channel: int) -> None:
        self._link = link
        self._bay = channel
        self._in_rack = link.controller.address == RACK
        self._address = BAY_1 + channel - 1 if self._in_rack else link.controller.address
        self._channel = 1
        servo = link.controller.family in ("servo", "brushless")
        self._scale = SPEED_SCALE[link.controller.family]
        self._status = MOT_GET_DCSTATUSUPDATE if servo else MOT_GET_STATUSUPDATE
        request = MOT_REQ_DCSTATUSUPDATE if servo else MOT_REQ_STATUSUPDATE
        # Servos want the host's sign of life at least every 50 status messages; others do not know it.
        sign_of_life = short(MOT_ACK_DCSTATUSUPDATE, self._address) if servo else b""
        self._status_request = sign_of_life + short(request, self._address, self._channel)

    def prepare(self) -> None:
        """Switch the axis on, and its unasked status messages off."""
        if self._in_rack:
            used = self._link.ask(
                short(RACK_REQ_BAYUSED, RACK, self._bay - 1), RACK_GET_BAYUSED, RACK, self._bay - 1
            )
            if used.second != 1:
                raise DeviceError(
                    self._link.device, f"bay {self._bay} of {self._link.port} is empty.", "Check channel."
                )
        self._link.send_now(short(HW_STOP_UPDATEMSGS, self._address))
        self._link.send_now(short(MOD_SET_CHANENABLESTATE, self._address, self._channel, ENABLE))
        enabled = self._link.ask(
            short(MOD_REQ_CHANENABLESTATE, self._address, self._channel),
            MOD_GET_CHANENABLESTATE,
            self._address,
            self._channel,
        )
        if enabled.second != ENABLE:
            raise DeviceError(
                self._link.device,
                f"channel {self._bay} of {self._link.port} does not switch on.",
                "Check that an actuator is connected and the controller shows no error.",
            )

    def state(self) -> DriveState:
        """Ask where the axis is."""
        reply = self._link.ask(self._status_request, self._status, self._address, self._channel)
        _, counts, _, _, bits = _STATUS.unpack(reply.data)
        return DriveState(counts, bool(bits & MOVING), bool(bits & HOMED), fault_words(bits))

    def move(self, counts: int) -> None:
        """Begin a move."""
        self._link.send_now(long(MOT_MOVE_ABSOLUTE, self._address, "Hl", self._channel, counts))

    def home(self) -> None:
        """Begin to look for the reference."""
        self._link.send_now(short(MOT_MOVE_HOME, self._address, self._channel))

    def stop(self) -> None:
        """Stop at once; from any thread."""
        self._link.send_now(short(MOT_MOVE_STOP, self._address, self._channel, STOP_AT_ONCE))

    def speed(self) -> float:
        """Ask for the speed of moves, counts a second."""
        return self._velocity()[3] / self._scale

    def set_speed(self, counts_per_s: float) -> None:
        """Set the speed of moves; the acceleration stays."""
        _, slowest, acceleration, _ = self._velocity()
        wanted = round(counts_per_s * self._scale)
        values = (self._channel, slowest, acceleration, wanted)
        self._link.send_now(long(MOT_SET_VELPARAMS, self._address, "Hlll", *values))

    def _velocity(self) -> tuple[int, int, int, int]:
        reply = self._link.ask(
            short(MOT_REQ_VELPARAMS, self._address, self._channel),
            MOT_GET_VELPARAMS,
            self._address,
            self._channel,
        )
        channel, slowest, acceleration, fastest = _VELOCITY.unpack(reply.data)
        return channel, slowest, acceleration, fastest


class InertiaUnit:
    """What the channels of a piezo inertia drive share: it moves one of them at a time, the others wait.

    A waiting move begins when the state is asked for and the one before it has ended.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self._address = link.controller.address
        self._lock = threading.Lock()
        self._waiting: dict[int, int] = {}
        self._stops = 0
        self._current: tuple[int, int, float] | None = None

    def status(self) -> dict[int, tuple[int, int]]:
        """Ask for counts and status bits of every channel; begin the next move when none is under way."""
        request = short(PZMOT_ACK_STATUSUPDATE, self._address) + short(
            PZMOT_REQ_STATUSUPDATE, self._address, 1
        )
        with self._lock:
            stops = self._stops
            reply = self.link.ask(request, PZMOT_GET_STATUSUPDATE, self._address)
            found = {
                ident: (counts, bits) for ident, counts, _, bits in _INERTIA_STATUS.iter_unpack(reply.data)
            }
            if self._current is not None:
                channel, target, began_s = self._current
                counts, bits = found.get(_bit(channel), (0, 0))
                moving = bool(bits & MOVING)
                if not moving and (counts == target or time.monotonic() - began_s > _START_S):
                    self._current = None
            waiting = self._waiting
            if self._current is None and waiting:
                self._begin(*waiting.popitem(), stops)
            return found

    def is_busy(self, channel: int) -> bool:
        """Whether a channel's move has not begun, or has only just."""
        current = self._current
        return channel in self._waiting or (current is not None and current[0] == channel)

    def queue(self, channel: int, target: int) -> None:
        """Begin a move, or let it wait for its turn."""
        with self._lock:
            if self._current is None or self._current[0] == channel:
                self._begin(channel, target, self._stops)
            else:
                self._waiting[channel] = target

    def forget(self) -> None:
        """Let no move that waited when the connection was lost begin after it came back."""
        self._waiting = {}
        self._current = None

    def stop(self, channel: int) -> None:
        """Stop whatever moves; from any thread, and whatever reply is awaited."""
        self._stops += 1  # whoever is about to begin a move sees it
        self._waiting = {}
        self._current = None
        self.link.send_now(
            short(MOT_MOVE_STOP, self._address, _bit(channel), STOP_AT_ONCE)
            + long(PZMOT_SET_PARAMS, self._address, "HH", PZMOT_ENABLED, 0)
        )

    def _begin(self, channel: int, target: int, stops: int) -> None:
        self._current = (channel, target, time.monotonic())
        self.link.send_now(
            long(PZMOT_SET_PARAMS, self._address, "HH", PZMOT_ENABLED, channel)
            + long(PZMOT_MOVE_ABSOLUTE, self._address, "Hl", _bit(channel), target)
        )
        if self._stops != stops:
            self.stop(channel)


class InertiaChannel:
    """A piezo inertia actuator: it counts steps and has no reference; homing calls the present place zero."""

    def __init__(self, unit: InertiaUnit, channel: int) -> None:
        self._unit = unit
        self._link = unit.link
        self._address = unit.link.controller.address
        self._channel = channel
        self._zeroed = False
        self._last = 0

    def prepare(self) -> None:
        """Forget the zero unless the steps say that the unit was under power all the time."""
        self._unit.forget()
        self._link.send_now(short(HW_STOP_UPDATEMSGS, self._address))
        last = self._last
        self._zeroed = self._zeroed and last != 0 and self.state().counts == last

    def state(self) -> DriveState:
        """Ask where the axis is."""
        found = self._unit.status().get(_bit(self._channel))
        if found is None:
            raise DeviceError(self._link.device, f"{self._link.name} has no channel {self._channel}.")
        self._last, bits = found
        moving = bool(bits & MOVING) or self._unit.is_busy(self._channel)
        return DriveState(self._last, moving, self._zeroed, fault_words(bits))

    def move(self, counts: int) -> None:
        """Begin a move, or let it wait for its turn."""
        self._unit.queue(self._channel, counts)

    def home(self) -> None:
        """Call the present place zero."""
        values = (PZMOT_POSITION, _bit(self._channel), 0, 0)
        self._link.send_now(long(PZMOT_SET_PARAMS, self._address, "HHll", *values))
        self._zeroed = True

    def stop(self) -> None:
        """Stop at once; from any thread."""
        self._unit.stop(self._channel)

    def speed(self) -> float:
        """Ask for the step rate, steps a second."""
        return float(self._drive()[3])

    def set_speed(self, counts_per_s: float) -> None:
        """Set the step rate; voltage and acceleration stay."""
        _, _, volts, _, acceleration = self._drive()
        values = (PZMOT_DRIVE, _bit(self._channel), volts, round(counts_per_s), acceleration)
        self._link.send_now(long(PZMOT_SET_PARAMS, self._address, "HHHll", *values))

    def _drive(self) -> tuple[int, int, int, int, int]:
        request = short(PZMOT_REQ_PARAMS, self._address, PZMOT_DRIVE, _bit(self._channel))
        reply = self._link.ask(request, PZMOT_GET_PARAMS, self._address, PZMOT_DRIVE)
        if len(reply.data) != _INERTIA_DRIVE.size:
            raise DeviceError(
                self._link.device, f"{self._link.name} answers {reply.data!r} for its step rate."
            )
        sub, channel, volts, rate, acceleration = _INERTIA_DRIVE.unpack(reply.data)
        return sub, channel, volts, rate, acceleration


def _bit(channel: int) -> int:
    """Return how messages of inertia drives name a channel: 1, 2, 4, 8."""
    return 1 << (channel - 1)


Drive = Motor | InertiaChannel
"""An axis, whatever moves it."""
