"""The commands that the driver uses, and what the controller's numbers mean in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum


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
