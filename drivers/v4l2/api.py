"""The part of ``<linux/videodev2.h>`` that a camera needs: structures, ioctl numbers, flags; and the calls.

Layouts are those of 64-bit Linux. The tests hold sizes, offsets and request numbers to the kernel's header.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import select
from ctypes import (
    Array,
    Structure,
    Union,
    c_char,
    c_int32,
    c_int64,
    c_uint8,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
    sizeof,
)
from typing import Any, Protocol


def fourcc(code: str, big_endian: bool = False) -> int:
    """Return a four-character code as the kernel writes it."""
    return int.from_bytes(code.encode("ascii"), "little") | (big_endian << 31)


class Timeval(Structure):
    _fields_ = (("tv_sec", c_int64), ("tv_usec", c_int64))
    tv_sec: int
    tv_usec: int


class Fraction(Structure):
    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))
    numerator: int
    denominator: int


class Rect(Structure):
    _fields_ = (("left", c_int32), ("top", c_int32), ("width", c_uint32), ("height", c_uint32))
    left: int
    top: int
    width: int
    height: int


class Capability(Structure):
    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )
    driver: bytes
    card: bytes
    bus_info: bytes
    version: int
    capabilities: int
    device_caps: int


class FormatDescription(Structure):
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )
    index: int
    type: int
    description: bytes
    pixelformat: int


class PixFormat(Structure):
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )
    width: int
    height: int
    pixelformat: int
    field: int
    bytesperline: int
    sizeimage: int


class _PlaneFormat(Structure):
    _pack_ = 1
    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint16 * 6))
    sizeimage: int
    bytesperline: int


class PixFormatPlanes(Structure):
    """``v4l2_pix_format_mplane``: the format of a device whose buffers have memory planes."""

    _pack_ = 1
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", _PlaneFormat * 8),
        ("num_planes", c_uint8),
        ("rest", c_uint8 * 11),
    )
    width: int
    height: int
    pixelformat: int
    field: int
    plane_fmt: Array[_PlaneFormat]
    num_planes: int


class _FormatUnion(Union):
    # Other members of the kernel's union hold pointers: it is aligned to 8 bytes.
    _fields_ = (
        ("pix", PixFormat),
        ("planes", PixFormatPlanes),
        ("raw_data", c_uint8 * 200),
        ("_align", c_uint64),
    )
    pix: PixFormat
    planes: PixFormatPlanes


class Format(Structure):
    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))
    type: int
    fmt: _FormatUnion


class _FrameSizeStepwise(Structure):
    _fields_ = tuple(
        (name, c_uint32)
        for name in ("min_width", "max_width", "step_width", "min_height", "max_height", "step_height")
    )
    min_width: int
    max_width: int
    step_width: int
    min_height: int
    max_height: int
    step_height: int


class FrameSize(Structure):
    """Discrete sizes lie in ``min_width`` and the word after it (``max_width``: the height)."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("stepwise", _FrameSizeStepwise),
        ("reserved", c_uint32 * 2),
    )
    index: int
    pixel_format: int
    type: int
    stepwise: _FrameSizeStepwise


class RequestBuffers(Structure):
    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )
    count: int
    type: int
    memory: int


class Timecode(Structure):
    _fields_ = (
        ("type", c_uint32),
        ("flags", c_uint32),
        ("frames", c_uint8),
        ("seconds", c_uint8),
        ("minutes", c_uint8),
        ("hours", c_uint8),
        ("userbits", c_uint8 * 4),
    )


class _Memory(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64), ("planes", c_void_p), ("fd", c_int32))
    offset: int
    planes: int


class Plane(Structure):
    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("m", _Memory),
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )
    bytesused: int
    length: int
    m: _Memory
    data_offset: int


class Buffer(Structure):
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", Timeval),
        ("timecode", Timecode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _Memory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )
    index: int
    type: int
    bytesused: int
    flags: int
    timestamp: Timeval
    sequence: int
    memory: int
    m: _Memory
    length: int
    plane: Plane | None = None
    """What ``m.planes`` points to, kept as long as the buffer is: the kernel writes to it."""


class BufferType(Structure):
    """The plain ``int`` that STREAMON and STREAMOFF point to."""

    _fields_ = (("type", c_int32),)
    type: int


class QueryControl(Structure):
    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )
    id: int
    type: int
    name: bytes
    minimum: int
    maximum: int
    step: int
    default_value: int
    flags: int


class _MenuUnion(Union):
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", c_int64))
    name: bytes
    value: int


class QueryMenu(Structure):
    _pack_ = 1
    _fields_ = (("id", c_uint32), ("index", c_uint32), ("u", _MenuUnion), ("reserved", c_uint32))
    id: int
    index: int
    u: _MenuUnion


class ControlValue(Structure):
    _fields_ = (("id", c_uint32), ("value", c_int32))
    id: int
    value: int


class Selection(Structure):
    _fields_ = (
        ("type", c_uint32),
        ("target", c_uint32),
        ("flags", c_uint32),
        ("r", Rect),
        ("reserved", c_uint32 * 9),
    )
    type: int
    target: int
    flags: int
    r: Rect


class _CaptureParm(Structure):
    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )
    capability: int
    timeperframe: Fraction


class _ParmUnion(Union):
    _fields_ = (("capture", _CaptureParm), ("raw_data", c_uint8 * 200))
    capture: _CaptureParm


class StreamParm(Structure):
    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))
    type: int
    parm: _ParmUnion


class InputNumber(Structure):
    """The plain ``int`` that S_INPUT points to."""

    _fields_ = (("number", c_int32),)
    number: int


_NONE, _WRITE, _READ = 0, 1, 2


def _request(direction: int, number: int, argument: type[Structure]) -> int:
    """``_IOC`` of <asm-generic/ioctl.h>, type 'V'."""
    return direction << 30 | sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FormatDescription)
G_FMT = _request(_READ | _WRITE, 4, Format)
S_FMT = _request(_READ | _WRITE, 5, Format)
REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, BufferType)
STREAMOFF = _request(_WRITE, 19, BufferType)
G_PARM = _request(_READ | _WRITE, 21, StreamParm)
S_PARM = _request(_READ | _WRITE, 22, StreamParm)
G_CTRL = _request(_READ | _WRITE, 27, ControlValue)
S_CTRL = _request(_READ | _WRITE, 28, ControlValue)
QUERYCTRL = _request(_READ | _WRITE, 36, QueryControl)
QUERYMENU = _request(_READ | _WRITE, 37, QueryMenu)
S_INPUT = _request(_READ | _WRITE, 39, InputNumber)
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, FrameSize)
G_SELECTION = _request(_READ | _WRITE, 94, Selection)
S_SELECTION = _request(_READ | _WRITE, 95, Selection)

BUF_TYPE_VIDEO_CAPTURE = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE = 9
MEMORY_MMAP = 1
FIELD_NONE = 1
CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000
BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000
BUF_FLAG_TSTAMP_SRC_MASK = 0x70000
BUF_FLAG_TSTAMP_SRC_SOE = 0x10000
FRMSIZE_TYPE_DISCRETE = 1
SEL_TGT_CROP = 0x0000
SEL_TGT_CROP_DEFAULT = 0x0001
SEL_FLAG_LE = 0x2
CAP_TIMEPERFRAME = 0x1000
CTRL_FLAG_NEXT_CTRL = 0x80000000
CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_READ_ONLY = 0x4
CTRL_FLAG_INACTIVE = 0x10
CTRL_FLAG_WRITE_ONLY = 0x40
CTRL_FLAG_MODIFY_LAYOUT = 0x400
CTRL_TYPE_INTEGER = 1
CTRL_TYPE_BOOLEAN = 2
CTRL_TYPE_MENU = 3
CTRL_TYPE_BUTTON = 4
CTRL_TYPE_BITMASK = 8
CTRL_TYPE_INTEGER_MENU = 9

CID_BLACK_LEVEL = 0x0098090B
CID_AUTO_WHITE_BALANCE = 0x0098090C
CID_HUE_AUTO = 0x00980919
CID_AUTO_BRIGHTNESS = 0x00980920
CID_EXPOSURE = 0x00980911
CID_AUTOGAIN = 0x00980912
CID_GAIN = 0x00980913
CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
CID_EXPOSURE_AUTO_PRIORITY = 0x009A0903
CID_FOCUS_AUTO = 0x009A090C
CID_AUTO_N_PRESET_WHITE_BALANCE = 0x009A0914
CID_ANALOGUE_GAIN = 0x009E0903
EXPOSURE_MANUAL = 1
EXPOSURE_SHUTTER_PRIORITY = 2


class Kernel(Protocol):
    """The system calls that a video device is used by."""

    def open(self, path: str) -> int: ...

    def close(self, fd: int) -> None: ...

    def ioctl(self, fd: int, request: int, argument: Structure) -> None: ...

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Return a buffer (with ``close``) over a buffer of the device's."""

    def wait(self, fd: int, wake_fd: int, timeout_s: float) -> bool:
        """Wait until the device has something (true), or ``wake_fd``, or the time is over (false)."""


class LinuxKernel:
    """The kernel that this runs on."""

    def open(self, path: str) -> int:
        """Open without blocking: DQBUF says EAGAIN, and waiting can be ended."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        """Close; a device that is gone is closed, too."""
        with contextlib.suppress(OSError):
            os.close(fd)

    def ioctl(self, fd: int, request: int, argument: Structure) -> None:
        """Call again when a signal came between."""
        while True:
            try:
                fcntl.ioctl(fd, request, argument, True)
                return
            except InterruptedError:
                continue

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Map a buffer for reading."""
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)

    def wait(self, fd: int, wake_fd: int, timeout_s: float) -> bool:
        """Poll both; an error condition of the device counts as something: DQBUF says which."""
        poll = select.poll()
        poll.register(fd, select.POLLIN | select.POLLPRI)
        poll.register(wake_fd, select.POLLIN)
        return any(ready == fd for ready, _ in poll.poll(max(0, round(timeout_s * 1e3))))
