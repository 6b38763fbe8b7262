"""Thorlabs controllers on a pseudo-terminal, from the APT protocol document; another client tests them."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.mocks.moving_axis import MovingAxis
from tests.mocks.pty_device import Answer, PtyDevice

HOST, RACK, BAY, USB = 0x01, 0x11, 0x21, 0x50
STATUS_WITHOUT_SIGN_OF_LIFE = 50


def split_messages(received: bytes) -> tuple[list[bytes], bytes]:
    messages = []
    while len(received) >= 6:
        length = 6 + (struct.unpack_from("<H", received, 2)[0] if received[4] & 0x80 else 0)
        if len(received) < length:
            break
        messages.append(received[:length])
        received = received[length:]
    return messages, received


@dataclass
class AptAxis:
    motion: MovingAxis
    enabled: bool = False
    acceleration: int = 4506
    fastest: float = math.inf
    """Counts a second that the controller does not let the speed exceed."""
    faults: int = 0
    was_moving: bool = False
    extra: dict[str, int] = field(default_factory=dict)


class AptController:
    """A controller of each type; ``spoil`` holds what is to be done to the next replies."""

    def __init__(
        self,
        port: Path | Callable[[Callable[[bytes], list[Answer]]], PtyDevice],
        model: str,
        motions: list[MovingAxis],
        serial_number: int = 27_000_001,
    ) -> None:
        """``port`` is a folder for a pseudo-terminal, or makes another port for what answers messages."""
        self.model = model
        self.serial_number = serial_number
        self.axes = [AptAxis(motion) for motion in motions]
        self.spoil: list[Callable[[bytes], list[Answer]]] = []
        self.driven = 0
        """The channel that a KIM101 can move."""
        self.strange: list[int] = []
        """Numbers of messages that this type does not know."""
        self._unacknowledged = 0
        self._servo = model[:3] in ("KDC", "TDC", "KBD", "BBD")
        self._in_rack = model[:3] in ("BSC", "BBD")
        sampling_s = 102.4e-6 if model[1:3] == "BD" else 2048 / 6e6
        self._scale = 65_536 * sampling_s if self._servo else 53.68
        if isinstance(port, Path):
            port.mkdir(exist_ok=True)
            self.port = PtyDevice(port, self.answer, split_messages)
        else:
            self.port = port(self.answer)

    def close(self) -> None:
        self.port.unplug()

    # Messages ---
    def _short(self, number: int, first: int, second: int, source: int) -> bytes:
        return struct.pack("<HBBBB", number, first, second, HOST, source)

    def _long(self, number: int, source: int, data: bytes) -> bytes:
        return struct.pack("<HHBB", number, len(data), HOST | 0x80, source) + data

    def complain(self, code: int, notes: str) -> None:
        self.port.send(self._long(0x0081, self._home, struct.pack("<HH64s", 0, code, notes.encode())))

    @property
    def _home(self) -> int:
        return RACK if self._in_rack else USB

    def answer(self, message: bytes) -> list[Answer]:
        number, first, second, to, _ = struct.unpack_from("<HBBBB", message)
        data = message[6:]
        reply = self._reply(number, first, second, to & 0x7F, data)
        unasked: list[Answer] = list(self._completed())
        if reply is None:
            return unasked
        return unasked + (self.spoil.pop(0)(reply) if self.spoil else [reply])

    def _completed(self) -> list[bytes]:
        found = []
        for index, axis in enumerate(self.axes):
            moving = axis.motion.moving
            if axis.was_moving and not moving and not self.model.startswith("KIM"):
                found.append(self._long(0x0464, self._address(index), self._status(axis)))
            axis.was_moving = moving
        return found

    def _address(self, index: int) -> int:
        return BAY + index if self._in_rack else USB

    def _reply(self, number: int, first: int, second: int, to: int, data: bytes) -> bytes | None:
        if number == 0x0005 and to in (self._home, USB):
            model = self.model.encode().ljust(8, b"\0")
            version = bytes([3, 2, 1, 0])
            info = struct.pack(
                "<l8sH4s60sHHH", self.serial_number, model, 44, version, b"", 1, 0, len(self.axes)
            )
            return self._long(0x0006, self._home, info)
        if number == 0x0060 and to == RACK:
            return self._short(0x0061, first, 1 if first < len(self.axes) else 2, RACK)
        if self.model.startswith("KIM"):
            return self._inertia(number, first, second, data)
        index = to - BAY if self._in_rack else 0
        known = to == USB or (self._in_rack and 0 <= index < len(self.axes))
        return self._motor(self.axes[index], number, first, second, to, data) if known else None

    # Motors ---
    def _status(self, axis: AptAxis) -> bytes:
        motion = axis.motion
        place = motion.place
        bits = 0x100 | axis.faults | (0x8000_0000 if axis.enabled else 0)
        if motion.moving:
            bits |= 0x10 if motion.forward else 0x20
        bits |= 0x200 if motion.homing else 0
        bits |= 0x400 if motion.homed else 0
        speed = int(motion.speed_per_s) & 0x7FFF if motion.moving else 0
        return struct.pack("<HlHHL", 1, place, speed, 0, bits)

    def _motor(
        self, axis: AptAxis, number: int, first: int, second: int, to: int, data: bytes
    ) -> bytes | None:
        motion = axis.motion
        match number:
            case 0x0490 if self._servo:
                return self._counted(self._long(0x0491, to, self._status(axis)))
            case 0x0480 if not self._servo:
                return self._counted(self._long(0x0481, to, self._status(axis)))
            case 0x0492 if self._servo:
                self._unacknowledged = 0
            case 0x0492 | 0x0490 | 0x0480:
                self.strange.append(number)
            case 0x0210:
                axis.enabled = second == 1
            case 0x0211:
                return self._short(0x0212, first, 1 if axis.enabled else 2, to)
            case 0x0413:
                _, _, axis.acceleration, fastest = struct.unpack("<Hlll", data)
                motion.speed_per_s = min(fastest / self._scale, axis.fastest)
            case 0x0414:
                values = (first, 0, axis.acceleration, round(motion.speed_per_s * self._scale))
                return self._long(0x0415, to, struct.pack("<Hlll", *values))
            case 0x0443 if axis.enabled:
                motion.home()
            case 0x0453 if axis.enabled and data:
                motion.go(struct.unpack("<Hl", data)[1])
            case 0x0448 if axis.enabled and data:
                motion.go(motion.place + struct.unpack("<Hl", data)[1])
            case 0x0465:
                motion.halt() if second == 1 else motion.stop()
        return None

    def _counted(self, status: bytes) -> bytes | None:
        self._unacknowledged += 1
        return status if self._unacknowledged <= STATUS_WITHOUT_SIGN_OF_LIFE or not self._servo else None

    # Piezo inertia ---
    def _inertia(self, number: int, first: int, second: int, data: bytes) -> bytes | None:
        match number:
            case 0x08E0:
                return self._long(0x08E1, USB, b"".join(map(self._channel, range(len(self.axes)))))
            case 0x08C0:
                self._set_inertia(*struct.unpack_from("<HH", data), data)
            case 0x08C1 if first == 0x07:
                motion = self.axes[second.bit_length() - 1].motion
                values = (7, second, 110, int(motion.speed_per_s), 100_000)
                return self._long(0x08C2, USB, struct.pack("<HHHll", *values))
            case 0x08D4:
                bit, target = struct.unpack("<Hl", data)
                if bit.bit_length() == self.driven:
                    self.axes[self.driven - 1].motion.go(target)
            case 0x0465:
                self.axes[first.bit_length() - 1].motion.halt()
        return None

    def _channel(self, index: int) -> bytes:
        motion = self.axes[index].motion
        place = motion.place
        bits = (0x10 if motion.forward else 0x20) if motion.moving else 0
        return struct.pack("<HllL", 1 << index, place, 0, bits | self.axes[index].faults)

    def _set_inertia(self, sub: int, channel: int, data: bytes) -> None:
        if sub == 0x05:
            self.axes[channel.bit_length() - 1].motion.set_place(struct.unpack_from("<l", data, 4)[0])
        elif sub == 0x07:
            self.axes[channel.bit_length() - 1].motion.speed_per_s = struct.unpack_from("<l", data, 6)[0]
        elif sub == 0x2B and channel != self.driven:
            if self.driven:
                self.axes[self.driven - 1].motion.halt()
            self.driven = channel
