"""A kernel with one video device and its sensor's node; it answers byte by byte as <linux/videodev2.h> says.

Offsets and request numbers are written out from the 64-bit header, not taken from the driver.
Frames are exposed on the clock, whether or not buffers are queued; what finds none is lost.
"""

from __future__ import annotations

import errno
import os
import select
import struct
import time
from collections import deque
from collections.abc import Callable
from ctypes import Structure, addressof, c_char, sizeof
from dataclasses import dataclass, field

import numpy as np

QUERYCAP, ENUM_FMT, G_FMT, S_FMT = 0x80685600, 0xC0405602, 0xC0D05604, 0xC0D05605
REQBUFS, QUERYBUF, QBUF, DQBUF = 0xC0145608, 0xC0585609, 0xC058560F, 0xC0585611
STREAMON, STREAMOFF, G_PARM, S_PARM = 0x40045612, 0x40045613, 0xC0CC5615, 0xC0CC5616
G_CTRL, S_CTRL, QUERYCTRL, QUERYMENU = 0xC008561B, 0xC008561C, 0xC0445624, 0xC02C5625
ENUM_FRAMESIZES, G_SELECTION, S_SELECTION = 0xC02C564A, 0xC040565E, 0xC040565F

EXPOSURE, AUTO_EXPOSURE, GAIN, AUTOGAIN, BLACK = 0x9A0902, 0x9A0901, 0x980913, 0x980912, 0x98090B
_BYTES = {
    "GREY": 1,
    "RGGB": 1,
    "GRBG": 1,
    "Y10 ": 2,
    "Y16 ": 2,
    "RG10": 2,
    "YUYV": 2,
    "UYVY": 2,
    "NV12": 1,
    "RGB3": 3,
}


@dataclass
class FakeControl:
    name: str
    type: int
    minimum: int
    maximum: int
    step: int
    default: int
    value: int
    menu: dict[int, str] = field(default_factory=dict)
    flags: int = 0


def _controls() -> dict[int, FakeControl]:
    automatic = {0: "Auto Mode", 1: "Manual Mode", 3: "Aperture Priority Mode"}
    return {
        0x980900: FakeControl("Brightness", 1, -64, 64, 1, 0, 0),
        BLACK: FakeControl("Black Level", 1, 0, 255, 1, 16, 16),
        AUTOGAIN: FakeControl("Gain, Automatic", 2, 0, 1, 1, 1, 1),
        GAIN: FakeControl("Gain", 1, 0, 100, 1, 0, 10),
        0x980918: FakeControl(
            "Power Line Frequency", 3, 0, 2, 1, 1, 1, {0: "Disabled", 1: "50 Hz", 2: "60 Hz"}
        ),
        0x98091C: FakeControl("Read Only", 1, 0, 9, 1, 3, 3, flags=0x4),
        AUTO_EXPOSURE: FakeControl("Auto Exposure", 3, 0, 3, 1, 3, 3, automatic),
        EXPOSURE: FakeControl("Exposure Time, Absolute", 1, 1, 5000, 1, 156, 156),
        0x9A0908: FakeControl("Pan, Reset", 4, 0, 0, 0, 0, 0),
    }


class Mapped(np.ndarray):
    """A mapping of a buffer's memory: a buffer itself, and closed when it is no longer used."""

    def __new__(cls, memory: bytearray) -> Mapped:
        return np.frombuffer(memory, np.uint8).view(cls)

    def close(self) -> None:
        self.closed = True


class FakeKernel:
    """One camera at ``/dev/video0``; faults on demand."""

    def __init__(
        self, shape: tuple[int, int] = (48, 64), formats: tuple[str, ...] = ("GREY", "Y16 ")
    ) -> None:
        self.shape = shape
        self.formats = formats
        self.controls = _controls()
        self.of_subdevice: dict[int, FakeControl] = {}
        """Controls of ``/dev/v4l-subdev0``, which is there when it has some."""
        self.frames_per_s = 200.0
        self.line_padding = 0
        self.shapes: dict[str, tuple[int, int]] = {}
        """Largest images of formats that have others than ``shape``."""
        self.taken_for: dict[str, str] = {}
        """Formats that the driver offers, but takes another one instead."""
        self.crop_step = 0
        """Steps of the sensor's regions; 0: it cannot crop."""
        self.exposure_step = 1
        """Steps to which the driver rounds exposures without a word."""
        self.lost: set[int] = set()
        """Sequence numbers that the camera loses."""
        self.damaged: set[int] = set()
        self.numbered = True
        self.planes = 0
        """Memory planes of an image; 0: the driver does not speak of planes."""
        self.start_of_exposure = False
        self.clock_flags = 0x2000
        self.refuse: dict[int, int] = {}
        """Request to the error it ends with, once."""
        self.unplugged = False
        self.failed = False
        self.image: Callable[[int, int, int], bytes] | None = None
        self.calls: list[int] = []
        self.opened = 0
        self._wake = -1
        self._reset()

    def _reset(self) -> None:
        self.code = self.formats[0]
        self.size = self.shape
        self.crop = (0, 0, *self.shape)
        self.memory: list[bytearray] = []
        self.queued: deque[int] = deque()
        self.done: deque[tuple[int, int, int, float]] = deque()
        self.streaming = False

    # The calls -------------------------------------------------------------------------------------
    def open(self, path: str) -> int:
        if path == "/dev/v4l-subdev0" and self.of_subdevice and not self.unplugged:
            self.opened += 1
            return 98
        if path != "/dev/video0" or self.unplugged:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        if 0 in self.refuse:
            number = self.refuse.pop(0)
            raise OSError(number, os.strerror(number))
        self._reset()
        self.opened += 1
        return 99

    def close(self, fd: int) -> None:
        assert fd in (98, 99)
        self.opened -= 1
        self.streaming = self.streaming and fd == 98

    def map(self, fd: int, length: int, offset: int) -> Mapped:
        assert length == len(self.memory[offset >> 12])
        return Mapped(self.memory[offset >> 12])

    def wait(self, fd: int, wake_fd: int, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while True:
            self._expose()
            if self.done or self.unplugged or self.failed or not self.streaming:
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            until = min(left, max(0.0, self._ends - time.monotonic()), 0.02)
            if select.select([wake_fd], [], [], until)[0]:
                return False

    def ioctl(self, fd: int, request: int, argument: Structure) -> None:
        assert fd == 99 or (fd == 98 and request in (QUERYCTRL, QUERYMENU, G_CTRL, S_CTRL))
        self._asked = self.controls if fd == 99 else self.of_subdevice
        self.calls.append(request)
        data = (c_char * sizeof(argument)).from_address(addressof(argument))
        assert request >> 16 & 0x3FFF == len(data), "the structure is not what the request number says"
        if self.unplugged:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        number = self.refuse.pop(request, 0) or self._answer(request, data)
        if number:
            raise OSError(number, os.strerror(number))

    def _answer(self, request: int, data: object) -> int:
        handler = {
            QUERYCAP: self._querycap,
            ENUM_FMT: self._enum_fmt,
            ENUM_FRAMESIZES: self._enum_sizes,
            G_FMT: self._g_fmt,
            S_FMT: self._s_fmt,
            G_PARM: self._g_parm,
            S_PARM: self._s_parm,
            QUERYCTRL: self._queryctrl,
            QUERYMENU: self._querymenu,
            G_CTRL: self._g_ctrl,
            S_CTRL: self._s_ctrl,
            G_SELECTION: self._g_selection,
            S_SELECTION: self._s_selection,
            REQBUFS: self._reqbufs,
            QUERYBUF: self._querybuf,
            QBUF: self._qbuf,
            DQBUF: self._dqbuf,
            STREAMON: self._streamon,
            STREAMOFF: self._streamoff,
        }.get(request)
        return errno.ENOTTY if handler is None else handler(data) or 0

    # What it is ------------------------------------------------------------------------------------
    @property
    def _kind(self) -> int:
        return 9 if self.planes else 1

    def _querycap(self, d: object) -> None:
        here = 0x04201000 if self.planes else 0x04200001
        row = (b"fakecam", b"Fake Camera", b"usb-1", 0x6010A, 0x80000000 | here, here)
        struct.pack_into("16s32s32sIII", d, 0, *row)

    def _plane(self, d: object) -> object:
        """The plane that a buffer points to."""
        (address,) = struct.unpack_from("Q", d, 64)
        assert struct.unpack_from("I", d, 72) == (1,)
        return (c_char * 64).from_address(address)

    def _enum_fmt(self, d: object) -> int:
        index, kind = struct.unpack_from("II", d, 0)
        if kind != self._kind or index >= len(self.formats):
            return errno.EINVAL
        struct.pack_into("4s", d, 44, self.formats[index].encode())
        return 0

    def _enum_sizes(self, d: object) -> int:
        index, code = struct.unpack_from("I4s", d, 0)
        sizes = [(16, 32), self.shapes.get(code.decode(), self.shape)]
        if code.decode() not in self.formats or index >= len(sizes):
            return errno.EINVAL
        height, width = sizes[index]
        struct.pack_into("III", d, 8, 1, width, height)
        return 0

    def _layout(self) -> tuple[int, int]:
        if self.code == "MJPG":
            return 0, self.size[0] * self.size[1] * 3
        line = self.size[1] * _BYTES[self.code] + self.line_padding
        return line, line * self.size[0] * (3 if self.code == "NV12" else 2) // 2

    def _g_fmt(self, d: object) -> None:
        line, n_bytes = self._layout()
        if self.planes:
            struct.pack_into("II4sI", d, 8, self.size[1], self.size[0], self.code.encode(), 1)
            struct.pack_into("II", d, 28, n_bytes, line)
            struct.pack_into("B", d, 188, self.planes)
            return
        struct.pack_into("II4sIII", d, 8, self.size[1], self.size[0], self.code.encode(), 1, line, n_bytes)

    def _s_fmt(self, d: object) -> int:
        if self.memory:
            return errno.EBUSY
        width, height, code = struct.unpack_from("II4s", d, 8)
        self.code = code.decode() if code.decode() in self.formats else self.formats[0]
        self.code = self.taken_for.get(self.code, self.code)
        sizes = [(16, 32), self.shapes.get(self.code, self.shape)]
        sizes += [self.crop[2:]] if self.crop_step else []
        self.size = min(sizes, key=lambda s: abs(s[0] - height) + abs(s[1] - width))
        self._g_fmt(d)
        return 0

    def _g_parm(self, d: object) -> None:
        struct.pack_into("IIII", d, 4, 0x1000, 0, 1000, round(self.frames_per_s * 1000))

    def _s_parm(self, d: object) -> None:
        numerator, denominator = struct.unpack_from("II", d, 12)
        self.frames_per_s = min(denominator / numerator, 500.0)
        self._g_parm(d)

    # Controls --------------------------------------------------------------------------------------
    def _queryctrl(self, d: object) -> int:
        (asked,) = struct.unpack_from("I", d, 0)
        following = [number for number in sorted(self._asked) if number > asked & 0x7FFFFFFF]
        if not asked >> 31 or not following:
            return errno.EINVAL
        c = self._asked[following[0]]
        row = (following[0], c.type, c.name.encode(), c.minimum, c.maximum, c.step, c.default, c.flags)
        struct.pack_into("II32siiiiI", d, 0, *row)
        return 0

    def _querymenu(self, d: object) -> int:
        number, index = struct.unpack_from("II", d, 0)
        if index not in self._asked[number].menu:
            return errno.EINVAL
        struct.pack_into("32s", d, 8, self._asked[number].menu[index].encode())
        return 0

    def _g_ctrl(self, d: object) -> int:
        (number,) = struct.unpack_from("I", d, 0)
        if number not in self._asked or self._asked[number].type == 4:
            return errno.EINVAL if number not in self._asked else errno.EACCES
        struct.pack_into("i", d, 4, self._asked[number].value)
        return 0

    def _s_ctrl(self, d: object) -> int:
        number, value = struct.unpack_from("Ii", d, 0)
        control = self._asked.get(number)
        if control is None:
            return errno.EINVAL
        if control.flags & 0x4:
            return errno.EACCES
        if number == EXPOSURE:
            if self.controls[AUTO_EXPOSURE].value != 1:
                return errno.EACCES
            value = max(value // self.exposure_step * self.exposure_step, control.minimum)
        if control.flags & 0x400 and value != control.value:  # its pixels turn, and with them the mosaic
            self.formats = tuple({"RGGB": "GRBG", "GRBG": "RGGB"}.get(code, code) for code in self.formats)
            self.code = {"RGGB": "GRBG", "GRBG": "RGGB"}.get(self.code, self.code)
        control.value = value
        return 0

    # Regions ---------------------------------------------------------------------------------------
    def _g_selection(self, d: object) -> int:
        if not self.crop_step:
            return errno.ENOTTY
        _, target, _ = struct.unpack_from("III", d, 0)
        top, left, height, width = (0, 0, *self.shape) if target == 1 else self.crop
        struct.pack_into("iiII", d, 12, left, top, width, height)
        return 0

    def _s_selection(self, d: object) -> int:
        if not self.crop_step or self.memory:
            return errno.EBUSY if self.memory else errno.ENOTTY
        left, top, width, height = struct.unpack_from("iiII", d, 12)
        step = self.crop_step
        self.crop = (top // step * step, left // step * step, height // step * step, width // step * step)
        self.size = self.crop[2:]
        struct.pack_into("iiII", d, 12, self.crop[1], self.crop[0], self.crop[3], self.crop[2])
        return 0

    # Buffers ---------------------------------------------------------------------------------------
    def _reqbufs(self, d: object) -> int:
        count, kind, memory = struct.unpack_from("III", d, 0)
        assert (kind, memory) == (self._kind, 1)
        count = max(count, 2) if count else 0
        self.memory = [bytearray(self._layout()[1]) for _ in range(count)]
        self.queued.clear()
        self.done.clear()
        struct.pack_into("I", d, 0, count)
        return 0

    def _querybuf(self, d: object) -> None:
        (index,) = struct.unpack_from("I", d, 0)
        if self.planes:
            struct.pack_into("III", self._plane(d), 0, 0, len(self.memory[index]), index << 12)
            return
        struct.pack_into("I4xI", d, 64, index << 12, len(self.memory[index]))

    def _qbuf(self, d: object) -> int:
        (index,) = struct.unpack_from("I", d, 0)
        self._expose()
        if self.planes:
            struct.pack_into("8xI", self._plane(d), 0, index << 12)  # the kernel writes it back
        assert index not in self.queued
        self.queued.append(index)
        return 0

    def _dqbuf(self, d: object) -> int:
        self._expose()
        if self.failed:
            return errno.EIO
        if not self.streaming:
            return errno.EINVAL
        if not self.done:
            return errno.EAGAIN
        index, sequence, used, ended = self.done.popleft()
        flags = self.clock_flags | (0x40 if sequence in self.damaged else 0)
        if self.start_of_exposure:
            flags |= 0x10000
            ended -= self.controls[EXPOSURE].value * 1e-4
        if self.planes:
            struct.pack_into("I", self._plane(d), 0, used)
            used = 0
        struct.pack_into("IIII", d, 0, index, self._kind, used, flags)
        struct.pack_into("qq", d, 24, int(ended), int(ended % 1 * 1e6))
        struct.pack_into("II", d, 56, sequence if self.numbered else 0, 1)
        return 0

    def _streamon(self, d: object) -> int:
        self.streaming = True
        self.sequence = 0
        self._ends = time.monotonic() + self._period
        return 0

    def _streamoff(self, d: object) -> int:
        self.streaming = False
        self.done.clear()
        self.queued.clear()
        return 0

    # Exposing --------------------------------------------------------------------------------------
    @property
    def _period(self) -> float:
        return max(1 / self.frames_per_s, self.controls[EXPOSURE].value * 1e-4)

    def _expose(self) -> None:
        """Let the time that has passed happen."""
        while self.streaming and self._ends <= time.monotonic():
            sequence, ended = self.sequence, self._ends
            self.sequence += 1
            self._ends += self._period
            if sequence in self.lost or not self.queued:
                continue
            index = self.queued.popleft()
            image = self._image(sequence)
            self.memory[index][: len(image)] = image
            self.done.append((index, sequence, len(image), ended))

    def _image(self, sequence: int) -> bytes:
        """Return an image that tells its number, row and column apart."""
        height, width = self.size
        if self.image is not None:
            return self.image(sequence, height, width)
        line, n_bytes_of_all = self._layout()
        top, left = self.crop[:2]
        rows, columns = np.mgrid[top : top + height, left : left + width]
        counts = (rows * 7 + columns * 3 + sequence) % (1 << (10 if "10" in self.code else 8))
        row_bytes = np.full((n_bytes_of_all // line, line), 0xEE, np.uint8)
        n_bytes = _BYTES[self.code]
        if n_bytes == 2 and self.code not in ("YUYV", "UYVY"):
            row_bytes[:, : width * 2] = (
                (counts * (257 if "16" in self.code else 1)).astype("<u2").view(np.uint8)
            )
        elif self.code in ("YUYV", "UYVY"):
            row_bytes[:, : width * 2] = 128
            row_bytes[:, self.code.index("Y") : width * 2 : 2] = counts
        elif self.code == "NV12":
            row_bytes[:height, :width] = counts
            row_bytes[height:, :width] = 128
        else:
            row_bytes[:, : width * n_bytes] = np.repeat(counts, n_bytes, axis=1).astype(np.uint8)
        return row_bytes.tobytes()
