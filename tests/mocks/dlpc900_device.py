"""A DLPC900 at packet level, after the programmer's guide (DLPU018), which decodes images to pixels.

``Dlpc900Emulator`` takes and gives 64-byte HID reports; ``FakeHidraw`` stands in for hidapi's ``hidraw``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

HEADER = b"Spld"


class BadImageError(Exception):
    """Bytes that the controller could not decompress."""


def decode_image(data: bytes) -> np.ndarray:
    """Return (height, width, 3) of an image with its header: blue, green, red."""
    if len(data) < 48 or data[:4] != HEADER:
        raise BadImageError("no header")
    width, height = int.from_bytes(data[4:6], "little"), int.from_bytes(data[6:8], "little")
    size, kind = int.from_bytes(data[8:12], "little"), data[25]
    if data[12:20] != b"\xff" * 8 or data[24] != 0 or data[26] != 1 or any(data[27:48]):
        raise BadImageError("reserved bytes of the header")
    if len(data) != 48 + size or size % 4:
        raise BadImageError(f"{len(data) - 48} bytes of image, header says {size}")
    body = data[48:]
    if kind == 0:
        if size < width * height * 3:
            raise BadImageError("too short")
        pixels = np.frombuffer(body[: width * height * 3], np.uint8)
        return pixels.reshape(height, width, 3)
    if kind not in (1, 2):
        raise BadImageError(f"compression {kind}")
    return _decompress(body, width, height, enhanced=kind == 2)


class _Codes:
    """The bytes of a compressed image, read one after the other."""

    def __init__(self, body: bytes, *, enhanced: bool) -> None:
        self.body, self.enhanced, self.at = body, enhanced, 0

    def byte(self) -> int:
        if self.at >= len(self.body):
            raise BadImageError("ends within a code")
        self.at += 1
        return self.body[self.at - 1]

    def length(self, first: int) -> int:
        return first if not self.enhanced or first < 128 else (first & 0x7F) | self.byte() << 7

    def pixels(self, n: int) -> bytes:
        self.at += 3 * n
        if self.at > len(self.body):
            raise BadImageError("ends within pixels")
        return self.body[self.at - 3 * n : self.at]


def _decompress(body: bytes, width: int, height: int, *, enhanced: bool) -> np.ndarray:
    out, codes = bytearray(), _Codes(body, enhanced=enhanced)
    while True:
        if len(out) > 3 * width * height:
            raise BadImageError("too many pixels")
        if control := codes.byte():
            n = codes.length(control)
            out += codes.pixels(1) * n
            continue
        control = codes.byte()
        if control == 0:  # end of line
            if len(out) % (3 * width):
                raise BadImageError("a line ends early or late")
            if not enhanced:
                codes.at += -codes.at % 4
        elif control == 1:
            n = codes.byte() if enhanced else 0
            if n == 0:
                break
            n = codes.length(n)
            above = len(out) - 3 * width
            if above < 0:
                raise BadImageError("no line above")
            out += out[above : above + 3 * n]
        else:
            out += codes.pixels(codes.length(control))
    if len(out) != 3 * width * height:
        raise BadImageError(f"{len(out) // 3} pixels of {width * height}")
    return np.frombuffer(bytes(out), np.uint8).reshape(height, width, 3)


@dataclass
class Faults:
    """What goes wrong from now on."""

    silent: bool = False
    late: bool = False
    """Replies are held back, and come before the first that is not late."""
    garbage: bytes | None = None
    """Sent before each reply."""
    truncated: bool = False
    refuse: dict[int, int] = field(default_factory=dict)
    """Error code by command."""
    never_starts: bool = False
    never_ends: bool = False
    stays_in_mode: bool = False
    hardware_status: int | None = None
    unplugged: bool = False


class Dlpc900Emulator:
    """One controller board; ``board`` 1 is a DLP6500, 2 a DLP9000 with two controllers."""

    def __init__(self, board: int = 1, shape: tuple[int, int] | None = None, serial: str = "LCR1") -> None:
        self.board = board
        self.shape = shape or {1: (1080, 1920), 2: (1600, 2560)}.get(board, (768, 1024))
        self.serial = serial
        self.faults = Faults()
        self.commands: list[int] = []
        self.power_cycle()

    def power_cycle(self) -> None:
        self.mode = 1
        self.running = False
        self._polls = self._changing = 0
        self._error = 0
        self._partial = b""
        self._wanted = 0
        self._patterns: dict[int, dict[str, int]] = {}
        self._lut = b""
        self._loading: dict[int, tuple[int, int, bytearray]] = {}
        self._images: dict[tuple[int, int], np.ndarray] = {}
        self.played: list[np.ndarray] = []
        """Of the finite sequence that was started last."""
        self._held: list[bytes] = []

    @property
    def shown(self) -> np.ndarray | None:
        """The grey levels that the mirrors show; None while nothing runs."""
        if not self.running or not self._patterns or self._finite:
            return None
        return self._levels(0)

    def _levels(self, number: int) -> np.ndarray:
        pattern = self._patterns[number]
        halves = [self._images[half, pattern["image"]] for half in range(self.board)]
        blue, green, red = np.moveaxis(np.hstack(halves).astype(np.uint32), 2, 0)
        depth = pattern["bit_depth"]
        levels = (blue << 16 | green << 8 | red) >> pattern["bit_position"] & (2**depth - 1)
        return (levels * (255 // (2**depth - 1))).astype(np.uint8)

    @property
    def pattern(self) -> dict[str, int]:
        """The first pattern that is defined."""
        return self._patterns[0]

    @property
    def _finite(self) -> int:
        """How many patterns are shown until the sequence ends; 0: without end."""
        return int.from_bytes(self._lut[2:], "little")

    # Reports ---------------------------------------------------------------------------------------
    def receive(self, report: bytes) -> list[bytes]:
        """Take a report; return those that are answered."""
        assert len(report) == 64
        if not self._partial:
            self._wanted = 4 + int.from_bytes(report[2:4], "little")
        self._partial += report
        if len(self._partial) < self._wanted:
            return []
        message, self._partial = self._partial[: self._wanted], b""
        return self._answer(message)

    def _answer(self, message: bytes) -> list[bytes]:
        flags, sequence = message[0], message[1]
        command, data = int.from_bytes(message[4:6], "little"), message[6:]
        self.commands.append(command)
        reading = bool(flags & 0x80)
        try:
            if code := self.faults.refuse.get(command):
                raise Refusal(code)
            answer = self._read(command) if reading else self._write(command, data)
            failed = 0
        except Refusal as refusal:
            self._error, answer, failed = refusal.code, b"", 0x20
        if not flags & 0x40 or self.faults.silent:
            return []
        length = len(answer).to_bytes(2, "little")
        reply = (bytes([flags | failed, sequence]) + length + answer)[:64].ljust(64, b"\0")
        replies = [self.faults.garbage, reply] if self.faults.garbage is not None else [reply]
        if self.faults.truncated:
            replies = [reply[:3]]
        if self.faults.late:
            self._held += replies
            return []
        replies, self._held = self._held + replies, []
        return replies

    def _read(self, command: int) -> bytes:
        if command == 0x0100:
            return bytes([self._error])
        if command == 0x0205:
            return bytes([2, 0, 1, 6] + [0] * 12)
        if command == 0x0206:
            return bytes([self.board]) + b"emulated board".ljust(31, b"\0")
        if command == 0x1A0A:
            fine = 0x11 if self.board == 2 else 0x01
            return bytes([fine if self.faults.hardware_status is None else self.faults.hardware_status])
        if command == 0x1A0C:
            self._polls += 1
            if self._finite:
                self.running = self.running and (self._polls < 4 or self.faults.never_ends)
                return bytes([0x02 if self.running else 0])
            started = self.running and self._polls > 2 and not self.faults.never_starts
            return bytes([0x02 if started else 0])
        if command == 0x1A1B:
            if self._changing > 0 or self.faults.stays_in_mode:
                self._changing -= 1
                return bytes([1])
            return bytes([self.mode])
        if command == 0x1A31:
            return self._lut
        raise Refusal(3)

    def _write(self, command: int, data: bytes) -> bytes:
        handlers: dict[int, Callable[[bytes], None]] = {
            0x1A1B: self._set_mode,
            0x1A24: self._start_stop,
            0x1A31: self._configure,
            0x1A34: self._define,
            0x1A2A: lambda data: self._initialise(0, data),
            0x1A2B: lambda data: self._load(0, data),
            0x1A2C: lambda data: self._initialise(1, data),
            0x1A2D: lambda data: self._load(1, data),
        }
        if command not in handlers:
            raise Refusal(3)
        handlers[command](data)
        return b""

    def _set_mode(self, data: bytes) -> None:
        if self.running:
            raise Refusal(5)
        self.mode = data[0] & 0x03
        self._changing = 3  # it takes a while

    def _start_stop(self, data: bytes) -> None:
        if data[0] == 2:
            if self.mode != 3 or len(self._lut) != 6 or not self._patterns:
                raise Refusal(5)
            images = {pattern["image"] for pattern in self._patterns.values()}
            if set(self._images) != {(half, image) for half in range(self.board) for image in images}:
                raise Refusal(11)
            if self._finite:
                self.played = [self._levels(number % len(self._patterns)) for number in range(self._finite)]
        self.running = data[0] == 2
        self._polls = 0

    def _define(self, data: bytes) -> None:
        if self.mode != 3 or self.running:
            raise Refusal(5)
        if len(data) != 12:
            raise Refusal(16)
        image = int.from_bytes(data[10:12], "little")
        pattern = {
            "index": int.from_bytes(data[0:2], "little"),
            "exposure_us": int.from_bytes(data[2:5], "little"),
            "bit_depth": (data[5] >> 1 & 7) + 1,
            "led": data[5] >> 4 & 7,
            "trigger": data[5] >> 7,
            "dark_us": int.from_bytes(data[6:9], "little"),
            "no_trigger_2": data[9] & 1,
            "image": image & 0x7FF,
            "bit_position": image >> 11,
        }
        shortest = (105, 304, 394, 823, 1215, 1487, 1998, 4046)[pattern["bit_depth"] - 1]
        if pattern["exposure_us"] < shortest:
            raise Refusal(14)
        if pattern["index"] == 0:
            self._patterns.clear()
        if pattern["index"] != len(self._patterns) or pattern["index"] >= 400:
            raise Refusal(15)
        self._patterns[pattern["index"]] = pattern
        self._images.clear()  # images must be loaded again after each change

    def _configure(self, data: bytes) -> None:
        if self.running or not self._patterns:
            raise Refusal(5)
        if len(data) != 6 or int.from_bytes(data[:2], "little") != len(self._patterns):
            raise Refusal(6)
        self._lut = data
        self._images.clear()

    def _initialise(self, half: int, data: bytes) -> None:
        if half >= self.board or self.running:
            raise Refusal(5)
        number = int.from_bytes(data[:2], "little")
        if len(data) != 6 or number not in {pattern["image"] for pattern in self._patterns.values()}:
            raise Refusal(6)
        self._loading[half] = (number, int.from_bytes(data[2:6], "little"), bytearray())

    def _load(self, half: int, data: bytes) -> None:
        if (
            half not in self._loading
            or int.from_bytes(data[:2], "little") != len(data) - 2
            or len(data) > 506
        ):
            raise Refusal(6)
        number, wanted, got = self._loading[half]
        got += data[2:]
        if len(got) > wanted:
            raise Refusal(8)
        if len(got) == wanted:
            del self._loading[half]
            try:
                image = decode_image(bytes(got))
            except BadImageError:
                raise Refusal(9) from None
            if image.shape[:2] != (self.shape[0], self.shape[1] // self.board):
                raise Refusal(9)
            self._images[half, number] = image


class Refusal(Exception):  # noqa: N818 - an answer, not a failure
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class FakeHidraw:
    """Stands in for the module ``hidraw``: the controllers that are plugged in, and opening one."""

    def __init__(self, *controllers: Dlpc900Emulator) -> None:
        self.controllers = list(controllers)

    def enumerate(self) -> list[dict[str, Any]]:
        return [
            {
                "path": f"/dev/hidraw{index}".encode(),
                "vendor_id": 0x0451,
                "product_id": 0xC900,
                "serial_number": controller.serial,
                "manufacturer_string": "Texas Instruments",
                "product_string": "DLPC900",
            }
            for index, controller in enumerate(self.controllers)
            if not controller.faults.unplugged
        ]

    def device(self) -> FakeHidDevice:
        return FakeHidDevice(self)


class FakeHidDevice:
    """An opened HID device as hidapi has it: lists of integers, an empty one after the time-out."""

    def __init__(self, module: FakeHidraw) -> None:
        self._module = module
        self._controller: Dlpc900Emulator | None = None
        self._waiting: list[bytes] = []

    def open_path(self, path: bytes) -> None:
        paths = {info["path"]: info["serial_number"] for info in self._module.enumerate()}
        if path not in paths:
            raise OSError("open failed")
        self._controller = next(c for c in self._module.controllers if c.serial == paths[path])

    def write(self, report: bytes) -> int:
        controller = self._plugged()
        assert report[0] == 0  # no report numbers
        self._waiting += controller.receive(bytes(report[1:]))
        return len(report)

    def read(self, size: int, timeout_ms: int) -> list[int]:
        self._plugged()
        return list(self._waiting.pop(0)[:size]) if self._waiting else []

    def error(self) -> str:
        return "No such device"

    def close(self) -> None:
        self._controller = None

    def _plugged(self) -> Dlpc900Emulator:
        if self._controller is None:
            raise ValueError("not open")
        if self._controller.faults.unplugged:
            raise OSError("read error")
        return self._controller
