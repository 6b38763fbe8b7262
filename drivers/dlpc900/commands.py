"""What is sent to the controller: the commands that the driver uses, what its numbers mean, and images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt


class Command(IntEnum):
    """USB commands of the guide, section 2."""

    ERROR_CODE = 0x0100
    FIRMWARE_VERSION = 0x0205
    HARDWARE = 0x0206
    HARDWARE_STATUS = 0x1A0A
    MAIN_STATUS = 0x1A0C
    DISPLAY_MODE = 0x1A1B
    START_STOP = 0x1A24
    INITIALISE_PRIMARY_IMAGE = 0x1A2A
    LOAD_PRIMARY_IMAGE = 0x1A2B
    INITIALISE_SECONDARY_IMAGE = 0x1A2C
    LOAD_SECONDARY_IMAGE = 0x1A2D
    PATTERN_CONFIGURATION = 0x1A31
    PATTERN_DEFINITION = 0x1A34


PATTERN_ON_THE_FLY = 3
"""Display mode (section 2.4.1): images come over USB."""
STOP, START = 0, 2
"""For ``START_STOP``."""
LOAD_BYTES = 504
"""Most bytes of an image in one message (section 2.4.4.4.2)."""
MODES: Mapping[int, str] = {
    0: "video",
    1: "pre-stored pattern",
    2: "video pattern",
    PATTERN_ON_THE_FLY: "pattern on the fly",
}
LED_BITS: Mapping[str, int] = {
    "off": 0b000,
    "red": 0b001,
    "green": 0b010,
    "yellow": 0b011,
    "blue": 0b100,
    "magenta": 0b101,
    "cyan": 0b110,
    "white": 0b111,
}
"""The LED enable outputs during a pattern (section 2.4.4.3.5)."""
MIN_EXPOSURE_US: Mapping[int, int] = {1: 105, 8: 4046}
"""Shortest exposure by bits a pixel (pattern modes, constant illumination)."""
MAX_EXPOSURE_US = 2**24 - 1
IMAGE_BITS = 24
"""Bits a pixel of an image: so many patterns of one bit are in one."""
MOST_PATTERNS: Mapping[int, int] = {1: 400, 8: 50}
"""Patterns by bits a pixel that the controller's memory holds."""
TRIGGER_OUTPUTS = 2
"""TRIG_OUT_1 is high while a pattern is exposed, TRIG_OUT_2 pulses as one begins."""

_ERRORS: Mapping[int, str] = {
    1: "batch file checksum error",
    2: "device failure",
    3: "invalid command number",
    4: "incompatible controller and DMD",
    5: "command not allowed in the current mode",
    6: "invalid command parameter",
    7: "the item that the parameter refers to is not present",
    8: "out of memory (RAM or flash)",
    9: "invalid BMP compression",
    10: "pattern bit number out of range",
    11: "pattern BMP not present in flash",
    12: "pattern dark time out of range",
    13: "signal delay out of range",
    14: "pattern exposure time out of range",
    15: "pattern number out of range",
    16: "invalid pattern definition",
    17: "pattern image memory address out of range",
    255: "internal error",
}


@dataclass(frozen=True, slots=True)
class Board:
    """What there is to know about the hardware behind a controller (section 2.1.5)."""

    model: str
    shape: tuple[int, int]
    """``(height, width)``, mirrors."""
    pitch_um: float
    controllers: int
    """Two share an image: the primary has its left half, the secondary its right half."""


BOARDS: Mapping[int, Board] = {
    1: Board("DLP6500", (1080, 1920), 7.56, 1),
    2: Board("DLP9000", (1600, 2560), 7.56, 2),
}
OTHER_BOARDS: Mapping[int, str] = {0: "unknown hardware", 3: "DLP670S", 4: "DLP500YX", 5: "DLP5500"}


def error_words(code: int) -> str:
    """Return what an error code says (section 2.1.6), with the code."""
    return f"{_ERRORS.get(code, 'an error that the programmer’s guide does not define')} (error {code})"


def hardware_faults(status: int, controllers: int) -> tuple[str, ...]:
    """Return what is wrong according to the hardware status (section 2.1.1); empty when nothing is."""
    faults = [] if status & 0x01 else ["its initialisation failed"]
    for bit, words in (
        (0x02, "controller and DMD do not fit, or the firmware is for another board"),
        (0x04, "DMD resets overlapped"),
        (0x08, "a swap of buffers was forced"),
        (0x40, "the sequencer aborted"),
        (0x80, "the sequencer detected an error"),
    ):
        if status & bit:
            faults.append(words)
    if controllers == 2 and not status & 0x10:
        faults.append("its secondary controller is missing or not ready")
    return tuple(faults)


SEQUENCER_RUNS = 0x02
"""Bit of the main status (section 2.1.3): patterns are being shown."""


def main_status_words(status: int) -> str:
    """Return the main status (section 2.1.3) in words."""
    return ", ".join(
        (
            "DMD parked" if status & 0x01 else "DMD active",
            "sequencer runs" if status & SEQUENCER_RUNS else "sequencer stopped",
            *(["video frozen"] if status & 0x04 else []),
        )
    )


_SIGNATURE = b"Spld"
_UNCOMPRESSED, _RLE, _ENHANCED_RLE = 0, 1, 2
_MAX_RLE_RUN = 255
_END_OF_LINE = b"\x00\x00"

# Pattern images: header (section 2.4.2) and compression (section 2.4.3). A pattern has up to 8 bits a pixel,
# an image 24: bit 0 is the lowest of a pixel's last byte.
Levels = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.uint32]
Numbers = npt.NDArray[np.intp]


def image_of(patterns: Sequence[Levels], bit_depth: int) -> Pixels:
    """Return the image, (height, width), that holds patterns of 1 or 8 bits one beside the other.

    Patterns are uint8 levels, of which the upper ``bit_depth`` bits count; the first is at bit 0. A single
    one fills all bits, so that it is the same from whichever it is taken.
    """
    if len(patterns) == 1:
        return np.asarray(patterns[0].astype(np.uint32) * 0x010101, np.uint32)
    image = np.zeros(patterns[0].shape, np.uint32)
    for number, levels in enumerate(patterns):
        image |= (levels >> (8 - bit_depth)).astype(np.uint32) << np.uint32(number * bit_depth)
    return image


def encode(pixels: Pixels, compression: str = "auto") -> bytes:
    """Return an image with its header.

    Parameters
    ----------
    pixels : ndarray
        (height, width) uint32, of :func:`image_of`; of a board with two controllers, one of the halves.
    compression : str
        ``"none"``, ``"rle"``, ``"enhanced_rle"``, or ``"auto"``: the shortest of them.
    """
    if compression == "auto":
        return min((encode(pixels, name) for name in ("enhanced_rle", "none")), key=len)
    code, compress = _COMPRESSIONS[compression]
    data = compress(pixels)
    data += bytes(-len(data) % 4)
    height, width = pixels.shape
    header: bytes = (
        _SIGNATURE
        + width.to_bytes(2, "little")
        + height.to_bytes(2, "little")
        + len(data).to_bytes(4, "little")
        + b"\xff" * 8
        + bytes(4)  # background colour
        + bytes([0, code, 1])
        + bytes(21)
    )
    return header + data


def _uncompressed(pixels: Pixels) -> bytes:
    """Return three bytes a pixel, the highest first."""
    return np.stack([pixels >> 16, pixels >> 8, pixels], axis=-1).astype(np.uint8).tobytes()


def _rle(image: Pixels) -> bytes:
    """Compress by runs of up to 255 pixels; lines begin at multiples of four bytes (section 2.4.3.1)."""
    width = image.shape[1]
    pixels = image.ravel()
    out = bytearray()
    segments = _segments(image, np.zeros(image.shape, bool))
    for start, n, kind in zip(*(part.tolist() for part in segments), strict=True):
        for at in range(start, start + n, _MAX_RLE_RUN):
            count = min(_MAX_RLE_RUN, start + n - at)
            # A literal of one pixel does not exist: its code ends the image.
            is_run = kind == _RUN or count == 1
            out += bytes([count]) if is_run else bytes([0, count])
            out += _uncompressed(pixels[at : at + (1 if is_run else count)])
        if (start + n) % width == 0:
            out += _END_OF_LINE
            out += bytes(-len(out) % 4)
    return bytes(out) + b"\x00\x01"


def _enhanced_rle(image: Pixels) -> bytes:
    """Compress by runs of any length, and by runs of the line above (section 2.4.3.2).

    A copy of n pixels from above is ``00 01 n``, a run ``n pixel``, a literal ``00 n pixels``; n is one byte
    below 128, else two: its low seven bits with a mark, then the rest. All segments are written at once.
    """
    above = np.zeros(image.shape, bool)
    above[1:] = image[1:] == image[:-1]
    start, n, kind = _segments(image, above)
    pixels = image.ravel()
    head = np.array([0, 1, 2])[kind]  # bytes before the length, by kind
    long = n >= 128
    n_pixels = np.where(kind == _COPY, 0, np.where(kind == _LITERAL, n, 1))
    ends_line = (start + n) % image.shape[1] == 0
    size = head + 1 + long + 3 * n_pixels + len(_END_OF_LINE) * ends_line
    stop = np.cumsum(size)
    out = np.zeros(int(stop[-1]), np.uint8)
    at = stop - size
    out[at[kind == _COPY] + 1] = 1
    at += head
    out[at] = np.where(long, n & 0x7F | 0x80, n)
    out[at[long] + 1] = n[long] >> 7
    at += 1 + long
    # Every pixel that is written out, by its number within its segment.
    within = np.arange(int(n_pixels.sum())) - np.repeat(np.cumsum(n_pixels) - n_pixels, n_pixels)
    place = np.repeat(at, n_pixels) + 3 * within
    values = pixels[np.repeat(start, n_pixels) + within]
    for color in range(3):
        out[place + color] = (values >> (16 - 8 * color)).astype(np.uint8)
    return out.tobytes() + b"\x00\x01\x00"


_COMPRESSIONS: Mapping[str, tuple[int, Callable[[Pixels], bytes]]] = {
    "none": (_UNCOMPRESSED, _uncompressed),
    "rle": (_RLE, _rle),
    "enhanced_rle": (_ENHANCED_RLE, _enhanced_rle),
}


_RUN, _LITERAL, _COPY = range(3)


def _segments(image: Pixels, copied: npt.NDArray[np.bool_]) -> tuple[Numbers, Numbers, Numbers]:
    """Cut an image into runs of one value, literals, and copies of what is above, none beyond its line.

    Returns
    -------
    start, n, kind : ndarray
        First pixel, counted along the lines; number of pixels; ``_RUN``, ``_LITERAL`` or ``_COPY``.
    """
    width = image.shape[1]
    pixels, copy = image.ravel(), copied.ravel()
    # A border lies before a pixel where a line begins, its value changes, or whether it is copied.
    border = np.ones(pixels.size, bool)
    border[1:] = (copy[1:] != copy[:-1]) | (~copy[1:] & (pixels[1:] != pixels[:-1]))
    border[::width] = True
    start = np.flatnonzero(border)
    single = (np.diff(start, append=pixels.size) == 1) & ~copy[start]
    # Single pixels beside each other in a line become one literal.
    joins = np.zeros(start.size, bool)
    joins[1:] = single[1:] & single[:-1] & (start[1:] % width != 0)
    kept = np.flatnonzero(~joins)
    start, single = start[kept], single[kept]
    n = np.diff(start, append=pixels.size)
    kind = np.where(copy[start], _COPY, np.where(single & (n > 1), _LITERAL, _RUN))
    return start, n, kind
