"""The DLPC900 as a spatial light modulator that shows one pattern without end, or a sequence once."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.dlpc900 import commands
from drivers.dlpc900.commands import Board, Command, encode
from drivers.dlpc900.link import HidLink, found_controllers
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, LimitError, StoppedError
from drivers.sequence import SequenceLimits
from drivers.slm import Slm, read_only

_log = logging.getLogger(__name__)
_START_S = 2.0
_POLL_S = 0.01
_FULL = 255


class Dlpc900Options(DriverOptions):
    """Options of a TI LightCrafter 6500 or 9000 (DLPC900) on USB."""

    serial_number: str | None = Field(
        None, min_length=1, description="USB serial number; left out: the only one connected."
    )
    bit_depth: Literal[1, 8] = Field(
        8, description="8: grey levels, by mirrors that flip during the exposure; 1: levels 0 and 255 only."
    )
    exposure_us: int = Field(
        10_000,
        le=commands.MAX_EXPOSURE_US,
        description="Time that the pattern is shown before it is repeated: from 105 with 1 bit, 4046 with 8.",
    )
    dark_us: int = Field(0, ge=0, le=commands.MAX_EXPOSURE_US, description="Dark time after each exposure.")
    led: Literal["off", "red", "green", "yellow", "blue", "magenta", "cyan", "white"] = Field(
        "white", description="LED enable outputs that are on during the exposure."
    )
    compression: Literal["auto", "none", "rle", "enhanced_rle"] = Field(
        "auto", description="Of uploaded images; auto takes the shortest."
    )
    settle_ms: float = Field(
        20.0, ge=0, description="From the sequence running to settled optics: one exposure and dark time."
    )

    @model_validator(mode="after")
    def _exposure_fits_the_depth(self) -> Self:
        shortest = commands.MIN_EXPOSURE_US[self.bit_depth]
        if self.exposure_us < shortest:
            raise ValueError(f"exposure_us must be at least {shortest} with bit_depth = {self.bit_depth}")
        return self


@dataclass(frozen=True, slots=True)
class _Armed:
    """A sequence."""

    patterns: tuple[npt.NDArray[np.uint8], ...]
    exposure_us: int
    output: int


class Dlpc900Slm(Slm):
    """A DMD that shows patterns in pattern-on-the-fly mode.

    ``display`` stops the sequence, defines the pattern, uploads its image (of a DLP9000 in two halves),
    starts the sequence and returns when the controller says that it runs. An upload takes from a tenth of a
    second (blank) to minutes (noise that does not compress): USB HID carries 64 bytes a millisecond at most.
    """

    Options = Dlpc900Options
    mirrors = True

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = options = Dlpc900Options.of(options)
        self._link = HidLink(self.name, options.serial_number)
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._blanked = 0
        """How often ``blank`` was called; uploads begun before it end."""
        self._blanking = 0
        """How many calls of ``blank`` are under way; uploads begun meanwhile end."""
        self._counting = threading.Lock()
        self._board: Board | None = None
        self._firmware = ""
        self._tag = ""
        self._displayed: npt.NDArray[np.uint8] | None = None
        self._uploaded: npt.NDArray[np.uint8] | None = None
        """What ``start`` shows again, while it is stopped."""
        self._armed: _Armed | None = None
        self._before: npt.NDArray[np.uint8] | None = None
        """What was shown when the armed sequence was uploaded; None while the controller has another one."""

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the controller by its serial number, or the only one."""
        return (f"DLPC900 {Dlpc900Options.of(options).serial_number or 'on USB'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the controllers that are connected, told by their USB id."""
        return tuple(
            replace(
                device,
                driver="dlpc900",
                kind="slm",
                options={"serial_number": device.serial_number} if device.serial_number else {},
            )
            for device in found_controllers()
        )

    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return "slm (dlpc900)"

    # Opening and closing ---------------------------------------------------------------------------
    def open(self) -> None:
        """Connect, check the hardware, and show a blank pattern.

        Raises DeviceError when the controller is missing, faulty, or drives a DMD that this driver does not
        know.
        """
        with self._lock:
            if self.is_open:
                return
            self._closing.clear()
            self._link.open()
            try:
                self._board = self._identify()
                self._check_hardware(self._board)
                self._link.write(Command.START_STOP, bytes([commands.STOP]))
                self._link.write(Command.DISPLAY_MODE, bytes([commands.PATTERN_ON_THE_FLY]))
                self._wait_for_mode()
                self._show(np.zeros(self._board.shape, np.uint8))
            except BaseException:
                self._link.close()
                raise

    def close(self) -> None:
        """Stop the sequence, so that nothing is shown, and disconnect; an upload ends with a StoppedError."""
        self._closing.set()
        with self._lock:
            if self._link.is_open:
                try:
                    self._link.write(Command.START_STOP, bytes([commands.STOP]))
                except DeviceError as error:
                    _log.warning("%s: was not stopped: %s", self.name, error)
                self._link.close()
            self._displayed = self._uploaded = self._armed = self._before = None

    @property
    def is_open(self) -> bool:
        """Whether the controller is connected."""
        return self._link.is_open

    def _identify(self) -> Board:
        version = self._link.read(Command.FIRMWARE_VERSION, 4)
        self._firmware = f"{version[3]}.{version[2]}.{int.from_bytes(version[:2], 'little')}"
        hardware = self._link.read(Command.HARDWARE, 1 + 31)
        self._tag = hardware[1:].split(b"\0")[0].decode("ascii", errors="replace").strip()
        board = commands.BOARDS.get(hardware[0])
        if board is None:
            what = commands.OTHER_BOARDS.get(hardware[0], f"hardware of unknown kind {hardware[0]}")
            known = ", ".join(board.model for board in commands.BOARDS.values())
            raise DeviceError(self.name, f"drives a {what}.", f"This driver knows {known}.")
        return board

    def _check_hardware(self, board: Board) -> None:
        status = self._link.read(Command.HARDWARE_STATUS, 1)[0]
        if faults := commands.hardware_faults(status, board.controllers):
            raise DeviceError(
                self.name,
                f"reports: {'; '.join(faults)} (hardware status 0x{status:02X}).",
                "Switch it off and on again.",
            )

    def _wait_for_mode(self) -> None:
        """Wait until the controller says that it changed its mode (section 2.4.1)."""
        deadline_s = time.monotonic() + _START_S
        while (mode := self._mode()) != commands.PATTERN_ON_THE_FLY:
            if time.monotonic() > deadline_s:
                raise DeviceError(
                    self.name,
                    f"stays in {commands.MODES[mode]} mode instead of pattern on the fly.",
                    "Switch it off and on again.",
                )
            time.sleep(_POLL_S)

    def _mode(self) -> int:
        return self._link.read(Command.DISPLAY_MODE, 1)[0] & 0x03

    # Identity and settings -------------------------------------------------------------------------
    @property
    def identity(self) -> DeviceIdentity:
        """What the controller reports."""
        board = self._require()
        found = self._link.found
        return DeviceIdentity(
            kind="slm",
            driver="dlpc900",
            vendor="Texas Instruments",
            model=f"DLPC900 with {board.model}",
            serial_number=(found.serial_number if found else "") or "unknown",
            firmware=f"{self._firmware} {self._tag}".strip(),
            simulated=False,
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read mode and status from the controller, with the configured times."""
        self._require()
        return {
            "shape": self.shape,
            "pixel_pitch_um": self.pixel_pitch_um,
            "settle_ms": self.settle_ms,
            "mode": commands.MODES[self._mode()],
            "status": commands.main_status_words(self._link.read(Command.MAIN_STATUS, 1)[0]),
            "bit_depth": self.options.bit_depth,
            "exposure_us": self.options.exposure_us,
            "dark_us": self.options.dark_us,
            "led": self.options.led,
        }

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` of the DMD, mirrors."""
        return self._require().shape

    @property
    def pixel_pitch_um(self) -> float:
        """Mirror pitch, micrometres."""
        return self._require().pitch_um

    @property
    def settle_ms(self) -> float:
        """Time from the sequence running to settled optics."""
        return self.options.settle_ms

    # Showing ---------------------------------------------------------------------------------------
    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Upload and show grey levels; running and settled when this returns.

        Raises LimitError when shape or dtype do not fit, or with ``bit_depth = 1`` a level is neither 0 nor
        255; StoppedError when ``close`` or ``blank`` was called meanwhile; DeviceError when the controller
        refuses or was unplugged; what is shown is then unknown.
        """
        self._require_levels(levels)
        self._show(levels.copy())
        self._closing.wait(self.settle_ms * 1e-3)

    def _require_levels(self, levels: npt.NDArray[np.uint8]) -> None:
        self._check(levels)
        if self.options.bit_depth == 1 and np.any((levels != 0) & (levels != _FULL)):
            raise LimitError(
                self.name,
                "cannot show grey levels with bit_depth = 1.",
                "Give uint8 levels 0 and 255 only, or set bit_depth = 8.",
            )

    def blank(self) -> None:
        """Show all zeros, ahead of an upload that is under way: that ends with a StoppedError."""
        board = self._require()
        with self._counting:
            self._blanked += 1
            self._blanking += 1
        try:
            self._show(np.zeros(board.shape, np.uint8), gives_way=False)
        finally:
            with self._counting:
                self._blanking -= 1
        self._closing.wait(self.settle_ms * 1e-3)

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels shown now, read only."""
        self._require()
        if self._displayed is None:
            raise DeviceError(self.name, "what it shows is unknown after a failed upload.", "Display again.")
        return read_only(self._displayed)

    # Sequences -------------------------------------------------------------------------------------
    @property
    def sequence_limits(self) -> SequenceLimits:
        """What the controller's memory holds, and its shortest exposure with the dark time."""
        depth = self.options.bit_depth
        shortest_us = commands.MIN_EXPOSURE_US[depth] + self.options.dark_us
        return SequenceLimits(
            commands.MOST_PATTERNS[depth], 1e-3 * shortest_us, outputs=commands.TRIGGER_OUTPUTS
        )

    def arm(self, patterns: Sequence[npt.NDArray[np.uint8]], period_ms: float, output: int = 0) -> float:
        """Upload a sequence, 24 bits of patterns an image; dark until it is played.

        Output 0 is TRIG_OUT_1, high during each exposure; 1 is TRIG_OUT_2, a pulse as each begins. Errors as
        ``display`` and as the interface says; then what is shown is unknown, unless nothing was sent.
        """
        self._require()
        self._check_sequence(len(patterns), period_ms, output)
        for levels in patterns:
            self._require_levels(levels)
        exposure_us = min(ceil(1e3 * period_ms - 1e-6) - self.options.dark_us, commands.MAX_EXPOSURE_US)
        self._armed = _Armed(tuple(levels.copy() for levels in patterns), exposure_us, output)
        self._upload_sequence(self._armed)
        return 1e-3 * (exposure_us + self.options.dark_us)

    def play(self) -> None:
        """Show the armed sequence once, and then what was shown before it was armed.

        That is uploaded again unless it was blank; the sequence then is too, when it is played again.

        Raises DeviceError when nothing is armed, or the controller does not end it; StoppedError when
        ``blank`` or ``close`` did.
        """
        self._require()
        armed = self._armed
        if armed is None:
            raise DeviceError(self.name, "has no sequence to play.", "Arm one first.")
        if self._before is None:
            self._upload_sequence(armed)
        with self._lock:
            board = self._require()
            before, began = self._before, self._blanked
            if before is None:
                raise StoppedError(self.name, "was blanked before its sequence.")
            self._link.write(Command.START_STOP, bytes([commands.START]))
        whole_s = 1e-6 * len(armed.patterns) * (armed.exposure_us + self.options.dark_us)
        began_s = time.monotonic()
        deadline_s = began_s + 1.5 * whole_s + _START_S
        while began == self._blanked and (left_s := began_s + whole_s - time.monotonic()) > 0:
            if self._closing.wait(min(left_s, _POLL_S)):
                break
        while self._runs(began):
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    self.name, f"did not end its sequence of {whole_s:.3g} s.", "Blank it, and play it again."
                )
            self._closing.wait(_POLL_S)
        self._check_hardware(board)
        if before.any():
            self._show(before)

    def _runs(self, began: int) -> bool:
        """Return whether the sequence still runs; StoppedError when ``blank`` or ``close`` ended it."""
        with self._lock:
            if self._closing.is_set() or began != self._blanked:
                raise StoppedError(self.name, "was blanked or closed during its sequence.")
            self._require()
            return bool(self._link.read(Command.MAIN_STATUS, 1)[0] & commands.SEQUENCER_RUNS)

    def _upload_sequence(self, armed: _Armed) -> None:
        """Store a sequence in the controller, which is dark from then on."""
        board, depth = self._require(), self.options.bit_depth
        before, began = self.displayed, self._blanked
        if self._before is not None:
            before = self._before
        images, per_image = self._encoded(armed.patterns), commands.IMAGE_BITS // depth
        definitions = [
            self._definition(armed.exposure_us, number, per_image, pulses=armed.output == 1)
            for number in range(len(armed.patterns))
        ]
        with self._lock:
            self._load(images, definitions, len(definitions), began)
            self._displayed, self._before = np.zeros(board.shape, np.uint8), before

    # More than the interface ----------------------------------------------------------------------
    def stop(self) -> None:
        """Stop the sequence: nothing is shown until ``start`` or the next pattern. Waits for an upload."""
        with self._lock:
            board = self._require()
            self._link.write(Command.START_STOP, bytes([commands.STOP]))
            if self._displayed is not None and self._uploaded is None and self._before is None:
                self._uploaded, self._displayed = self._displayed, np.zeros(board.shape, np.uint8)

    def start(self) -> None:
        """Show the pattern that ``stop`` ended again, from its beginning, without another upload.

        Raises DeviceError when no pattern was stopped, or the controller does not start it.
        """
        with self._lock:
            self._require()
            if self._uploaded is None:
                raise DeviceError(self.name, "has no stopped pattern to start.", "Display one.")
            self._link.write(Command.START_STOP, bytes([commands.START]))
            self._wait_until_running()
            self._displayed, self._uploaded = self._uploaded, None

    def _show(self, levels: npt.NDArray[np.uint8], *, gives_way: bool = True) -> None:
        """Show one pattern without end; ``gives_way``: StoppedError when ``blank`` is called meanwhile."""
        self._require()
        began = self._blanked if gives_way else None
        images = self._encoded([levels])
        with self._lock:
            self._load(images, [self._definition(self.options.exposure_us)], 0, began)
            self._link.write(Command.START_STOP, bytes([commands.START]))
            self._wait_until_running()
            self._displayed = levels

    def _encoded(self, patterns: Sequence[npt.NDArray[np.uint8]]) -> list[list[bytes]]:
        """Return the images that hold patterns, each for every controller."""
        board, depth = self._require(), self.options.bit_depth
        per_image = commands.IMAGE_BITS // depth
        groups = [patterns[first : first + per_image] for first in range(0, len(patterns), per_image)]
        return [
            [
                encode(half, self.options.compression)
                for half in np.hsplit(commands.image_of(group, depth), board.controllers)
            ]
            for group in groups
        ]

    def _load(
        self, images: Sequence[Sequence[bytes]], definitions: Sequence[bytes], shown: int, began: int | None
    ) -> None:
        """Stop, define, configure, load (section 5.3); ``shown``: patterns until the end, or 0."""
        self._require()
        self._displayed = self._uploaded = self._before = None
        self._link.write(Command.START_STOP, bytes([commands.STOP]))
        for definition in definitions:
            self._link.write(Command.PATTERN_DEFINITION, definition)
        self._link.write(
            Command.PATTERN_CONFIGURATION, _configuration(patterns=len(definitions), shown=shown)
        )
        # The last image first, and the other half: the primary controller then has its first image last.
        for number in reversed(range(len(images))):
            for half in reversed(range(len(images[number]))):
                self._upload(number, images[number][half], half, began)

    def _definition(
        self, exposure_us: int, number: int = 0, per_image: int = 1, *, pulses: bool = True
    ) -> bytes:
        """Return a pattern's definition (section 2.4.4.3.5); ``pulses``: on trigger output 2."""
        o = self.options
        flags = (o.bit_depth - 1) << 1 | commands.LED_BITS[o.led] << 4
        image, place = divmod(number, per_image)
        return (
            number.to_bytes(2, "little")
            + exposure_us.to_bytes(3, "little")
            + bytes([flags])
            + o.dark_us.to_bytes(3, "little")
            + bytes([0 if pulses else 1])  # no extended bit depth
            + (image | place * o.bit_depth << 11).to_bytes(2, "little")
        )

    def _upload(self, number: int, image: bytes, half: int, began: int | None) -> None:
        initialise, load = _LOAD[half]
        self._link.write(initialise, number.to_bytes(2, "little") + len(image).to_bytes(4, "little"))
        for start in range(0, len(image), commands.LOAD_BYTES):
            blanked = began is not None and (self._blanking or began != self._blanked)
            if self._closing.is_set() or blanked:
                raise StoppedError(self.name, "was closed or blanked during an upload.")
            part = image[start : start + commands.LOAD_BYTES]
            self._link.write(load, len(part).to_bytes(2, "little") + part)

    def _wait_until_running(self) -> None:
        board = self._require()
        deadline_s = time.monotonic() + _START_S
        while not self._link.read(Command.MAIN_STATUS, 1)[0] & commands.SEQUENCER_RUNS:
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    self.name, f"did not start its sequence within {_START_S:g} s.", "Display again."
                )
            time.sleep(_POLL_S)
        self._check_hardware(board)

    def _require(self) -> Board:
        if not self._link.is_open or self._board is None:
            raise DeviceNotOpenError(self.name)
        return self._board


_LOAD = (
    (Command.INITIALISE_PRIMARY_IMAGE, Command.LOAD_PRIMARY_IMAGE),
    (Command.INITIALISE_SECONDARY_IMAGE, Command.LOAD_SECONDARY_IMAGE),
)


def _configuration(*, patterns: int, shown: int) -> bytes:
    """Return how many patterns there are, and how many are shown; 0: without end (section 2.4.4.3.3)."""
    return patterns.to_bytes(2, "little") + shown.to_bytes(4, "little")
