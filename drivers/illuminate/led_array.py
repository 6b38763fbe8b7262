"""The driver of Illuminate LED arrays."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from math import ceil

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart, port_claim
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, LimitError, StoppedError
from drivers.illuminate.geometry import ArrayGeometry, read_geometry
from drivers.illuminate.link import SAFE_LINE, Link
from drivers.illuminate.sequencer import MOST_PATTERNS, Sequencer
from drivers.led_array import OFF, LedArray, LedPattern, Rgb
from drivers.registry.buses import lasting_name
from drivers.sequence import SequenceLimits

_log = logging.getLogger(__name__)
_OVERTAKE_S = 0.2
"""What is still busy so long after ``off`` began to send after it was cancelled, and is cancelled again."""
_MAY_BE_ON = "The light may be on: look, and pull its supply if so; then check its cable and reconnect."


class IlluminateOptions(DriverOptions):
    """Options of an Illuminate LED array in ``bench.toml``."""

    port: str = Field(min_length=1, description='Serial port, e.g. "/dev/ttyACM0".')
    distance_mm: float | None = Field(
        None,
        gt=0,
        description="From LED 0 to the sample along the axis; left out: what the array has stored.",
    )
    brightness: int = Field(
        255, ge=1, le=255, description="Every level is scaled by this over 255 on its way to the LEDs."
    )
    wavelengths_nm: tuple[float, float, float] | None = Field(
        None, description="Red, green and blue, where the array does not say."
    )
    longest_line: int = Field(
        SAFE_LINE,
        ge=32,
        le=8192,
        description="Longest line in bytes for firmware 2. More holds more LEDs in a sequence's pattern, but "
        "some builds (2.32) lose bytes behind the 64th and light other LEDs: raise it only after looking.",
    )


class IlluminateLedArray(LedArray):
    """An LED array with Illuminate firmware 1.16 or later, or 2.x.

    Patterns go to the array as lists of LEDs, checked here: the firmware does not check them, and writes
    beyond its memory. ``off`` overtakes, also a running sequence; when it returns the array has confirmed.
    """

    Options = IlluminateOptions
    reply_s = 1.0
    """What a reply may take."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = options = IlluminateOptions.of(options)
        self.link = Link(options.port, self.name, self.reply_s, options.longest_line)
        self.commanding = threading.RLock()
        self._darkenings = 0
        self._confirming = False
        """Whether ``off`` asks for its confirmation: another ``off`` need not cancel that."""
        self._geometry: ArrayGeometry | None = None
        self._pattern = OFF
        self._color: Rgb | None = None
        self._auto_clear: bool | None = None
        self._brightness = options.brightness
        self._restorers: dict[str, Callable[[], object]] = {}
        self._armed: tuple[int, int] | None = None
        self.sequencer = Sequencer(self)
        """Hardware-timed sequences and the trigger lines."""

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the serial port."""
        return (port_claim(IlluminateOptions.of(options).port),)

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Ask for the firmware's version and the array's name; the light is off afterwards."""
        array = cls(IlluminateOptions.model_validate({"port": port}))
        try:
            array.open()
        except DeviceTimeoutError:
            return None
        try:
            found = array.identity
        finally:
            array.close()
        return FoundDevice(
            "serial",
            port,
            f"{found.model}, Illuminate firmware {found.firmware}",
            product=found.model,
            serial_number=found.serial_number,
            driver="illuminate",
            kind="led_array",
            options={"port": lasting_name(port)},
        )

    # Device ---------------------------------------------------------------------------------------
    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return f"led_array (illuminate, {self.options.port})"

    def open(self) -> None:
        """Connect, turn the light off, read who it is and where its LEDs are.

        After a lost connection the settings made since the first ``open`` are brought back.
        """
        if self.is_open:
            return
        with self.commanding:
            self.link.close()
            self._pattern, self._color, self._auto_clear = OFF, None, None
            self.link.connect()
            try:
                for words in (b"machine", *self.link.dialect.prepare):
                    self.link.command(words)
                self._geometry = read_geometry(self.link, self.options.distance_mm)
                if self._geometry.wavelengths_nm is None and self.options.wavelengths_nm is None:
                    raise DeviceError(
                        self.name, "does not say its wavelengths.", "Set wavelengths_nm in bench.toml."
                    )
                for restore in self._restorers.values():
                    restore()
            except BaseException:
                self._geometry = None
                self.link.close()
                raise

    def close(self) -> None:
        """Turn every LED off and disconnect; of a lost array only the connection is closed."""
        if self._geometry is None:
            return
        try:
            if self.link.is_open:
                self.off()
        finally:
            self._geometry = None
            self._pattern = OFF
            self._restorers.clear()
            self.sequencer.forget()
            self._armed = None
            self._brightness = self.options.brightness
            self.link.close()

    @property
    def is_open(self) -> bool:
        """Whether the array is connected and was not lost."""
        return self._geometry is not None and self.link.is_open

    @property
    def identity(self) -> DeviceIdentity:
        """Who the array says it is."""
        geometry = self.geometry
        return DeviceIdentity(
            kind="led_array",
            driver="illuminate",
            vendor="Illuminate",
            model=geometry.model,
            serial_number=geometry.serial_number,
            firmware=str(self.link.version),
            simulated=False,
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read the pattern, the array's build, its objective NA and trigger outputs."""
        geometry = self.geometry
        with self.commanding:
            (na_hundredths, *_) = self.link.setting(b"na", "NA")
        return {
            "pattern": self._pattern.description,
            "leds": len(geometry.positions_mm),
            "wavelengths_nm": self.wavelengths_nm,
            "distance_mm": float(geometry.positions_mm[0, 2]),
            "brightness": self._brightness,
            "objective_na": na_hundredths / 100,
            "trigger_outputs": geometry.outputs,
            "trigger_inputs": geometry.inputs,
        }

    # LedArray -------------------------------------------------------------------------------------
    @property
    def geometry(self) -> ArrayGeometry:
        """What the array said of itself; needs an open array."""
        if self._geometry is None:
            raise DeviceNotOpenError(self.name)
        return self._geometry

    @property
    def led_positions_mm(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 3)`` positions, millimetres; z is the distance to the sample."""
        return self.geometry.positions_mm.copy()

    @property
    def led_na(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 2)`` sines of the illumination angle in x and y; NaN for LEDs without one."""
        return self.geometry.na.copy()

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Centre wavelengths of red, green and blue."""
        wavelengths = self.options.wavelengths_nm or self.geometry.wavelengths_nm
        assert wavelengths is not None, "open refuses an array without"
        return wavelengths

    @property
    def pattern(self) -> LedPattern:
        """The pattern shown now."""
        return self._pattern

    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        """Show a pattern; returns once the array has confirmed.

        LEDs of one colour light together; a pattern of several colours, or of more LEDs than a line holds,
        builds up over some milliseconds, from dark.
        """
        self.check(pattern)
        groups: dict[Rgb, list[int]] = {}
        for led, rgb in dict(pattern.levels).items():
            scaled = self.scaled(rgb)
            if scaled != (0, 0, 0):
                groups.setdefault(scaled, []).append(led)
        with self.commanding:
            began = self._darkenings
            parts = [
                (rgb, words) for rgb, leds in groups.items() for words in self.link.dialect.led_lists(leds)
            ]
            try:
                if len(parts) != 1:
                    self.link.command(b"x")
                    self._pattern = OFF
                if parts:
                    self._set_auto_clear(len(parts) == 1)
                for rgb, words in parts:
                    self.set_color(rgb)
                    self.link.command(words)
                if self._darkenings != began:
                    raise StoppedError(self.name, "the light was turned off meanwhile.")
            except BaseException as error:
                self.darken_after(error)
                raise
            self._pattern = pattern
        return pattern

    def off(self) -> None:
        """Turn every LED off, ahead of whatever is running; returns when the array has confirmed.

        Raises DeviceError when it does not confirm, or was lost: the light may be on.
        """
        if self._geometry is None:
            raise DeviceNotOpenError(self.name)
        try:
            self._darken()
        except (DeviceNotOpenError, StoppedError):  # closed meanwhile, and darkened by that
            raise
        except DeviceError as error:
            raise DeviceError(self.name, error.problem, _MAY_BE_ON) from error

    def _darken(self) -> None:
        self._darkenings += 1
        self.link.darken_at_once()
        while not self.commanding.acquire(timeout=_OVERTAKE_S):
            if not self._confirming:
                self.link.darken_at_once()
        try:
            self._confirming = True
            self._confirm_darkness()
            self._pattern = OFF
            self._color = self._auto_clear = None
        finally:
            self._confirming = False
            self.commanding.release()

    def _confirm_darkness(self) -> None:
        while True:
            try:
                self.link.command(b"x")
            except StoppedError:
                if not self.link.is_open:
                    raise
                continue  # another thread turned it off meanwhile, and overtook this question
            except DeviceTimeoutError as error:
                raise DeviceError(self.name, f"does not confirm that it is off ({error.problem})") from error
            return

    # Sequences --------------------------------------------------------------------------------------
    @property
    def sequence_limits(self) -> SequenceLimits | None:
        """What sequences with a pulse for each pattern it plays; None of an array without trigger output."""
        outputs = self.geometry.outputs
        least_ms = max(1, self.link.dialect.shortest_interval_ms)
        return SequenceLimits(MOST_PATTERNS, least_ms, outputs) if outputs else None

    def arm(self, patterns: Sequence[LedPattern], period_ms: float, output: int = 0) -> float:
        """Store a sequence, of one colour; its period is whole milliseconds."""
        self._check_sequence(len(patterns), period_ms, output)
        if not self.sequencer.holds(patterns):
            self.sequencer.load(patterns)
        self._armed = (ceil(period_ms), output)
        return float(self._armed[0])

    def play(self) -> None:
        """Show the armed sequence once, with a pulse for each pattern; dark when this returns."""
        if self._armed is None:
            raise DeviceError(self.name, "has no sequence to play.", "Arm one first.")
        interval_ms, output = self._armed
        self.sequencer.run(interval_ms, outputs=[*[0] * output, 1])

    # More than the interface ------------------------------------------------------------------------
    def set_brightness(self, brightness: int) -> int:
        """Scale all levels by ``brightness`` over 255, and show the present pattern so."""
        if not 1 <= brightness <= 255:
            raise LimitError(self.name, f"has no brightness {brightness}.", "Brightness is 1 to 255.")
        with self.commanding:
            self._brightness = brightness
            if not self._pattern.is_dark:
                self.set_pattern(self._pattern)
        return brightness

    def set_objective_na(self, na: float) -> float:
        """Store the objective's NA (0.01 to 1.00) for the array's own patterns; returns what it has now."""
        hundredths = round(100 * na) if np.isfinite(na) else 0
        if not 1 <= hundredths <= 100:
            raise LimitError(self.name, f"takes no NA {na:g}.", "Its NA is 0.01 to 1.00.")

        def send() -> float:
            # Always two digits: the firmware takes na.4 for 0.40.
            return self.link.setting(b"na.%02d" % hundredths, "NA")[0] / 100

        _ = self.geometry
        with self.commanding:
            stored = send()
            self.remember("objective_na", send)
        return stored

    def check(self, pattern: LedPattern) -> None:
        """Refuse a pattern that the array cannot show, also one of colours where it has one only."""
        super().check(pattern)
        for led, rgb in pattern.levels:
            if self.geometry.channels == 1 and len(set(rgb)) > 1:
                raise LimitError(
                    self.name,
                    f"cannot show level {rgb} on LED {led}: its LEDs have one colour.",
                    "Give the same level three times.",
                )

    def set_color(self, rgb: Rgb) -> None:
        """Have the LEDs that are lit next, or by a sequence, shine with these levels."""
        if rgb in (self._color, (0, 0, 0)):  # no LED is lit with the latter
            return
        self._color = None
        self.link.set_color(rgb, self.geometry.channels)
        self._color = rgb

    def darken_after(self, error: BaseException) -> None:
        """Turn off what may shine since a command failed; that this fails too becomes a note."""
        self._color = self._auto_clear = None  # who knows which commands arrived
        try:
            self.off()
        except DeviceError as another:
            error.add_note(f"Nor could the light be turned off: {another}")

    def remember(self, setting: str, restore: Callable[[], object]) -> None:
        """Keep how to bring a setting back when a lost array is opened again."""
        self._restorers[setting] = restore

    def showing(self, pattern: LedPattern) -> None:
        """Take note of what the array shows by itself (a sequence)."""
        self._pattern = pattern

    def scaled(self, rgb: Rgb) -> Rgb:
        """Return levels as they are sent, with the brightness."""
        # What is lit stays lit: a level above zero is at least one.
        red, green, blue = (max(min(level, 1), round(level * self._brightness / 255)) for level in rgb)
        return red, green, blue

    def _set_auto_clear(self, auto_clear: bool) -> None:
        """Say whether each list of LEDs replaces the one before (then nothing is dark in between)."""
        if self._auto_clear != auto_clear:
            self.link.command(b"ac.%d" % auto_clear)
            self._auto_clear = auto_clear
