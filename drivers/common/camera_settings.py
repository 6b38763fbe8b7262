"""What camera drivers share about settings: refused, read back, made again when a lost device is back."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

from drivers.camera import Camera, Roi, TriggerEdge, TriggerMode
from drivers.device import DeviceIdentity
from drivers.errors import DeviceError, DeviceLostError, LimitError

GainUnit = Literal["dB", "factor", "steps"]


@dataclass(frozen=True, slots=True)
class GainScale:
    """What a camera's gain number means.

    Attributes
    ----------
    unit : str
        ``"dB"``: the number times ``per_count`` is decibels of the signal, ``factor = 10**(dB/20)``;
        ``"factor"``: the number times ``per_count`` is the factor; ``"steps"``: the meaning is not known, and
        the factor reported is ``1 + (number - lowest) * per_count``: it orders settings, no more.
    per_count : float
    lowest : float
        The smallest number that the camera takes.
    """

    unit: GainUnit
    per_count: float
    lowest: float

    def factor(self, number: float) -> float:
        """Return the factor that a number stands for."""
        match self.unit:
            case "dB":
                return float(10 ** (number * self.per_count / 20))
            case "factor":
                return number * self.per_count
            case "steps":
                return 1 + (number - self.lowest) * self.per_count

    def number(self, factor: float) -> float:
        """Return the number that stands for a factor."""
        match self.unit:
            case "dB":
                return 20 * math.log10(factor) / self.per_count if factor > 0 else -math.inf
            case "factor":
                return factor / self.per_count
            case "steps":
                return self.lowest + (factor - 1) / self.per_count


_ORDER = (
    *("pixel_format", "binning", "roi", "black_level", "gain", "exposure_ms"),
    *("trigger_line", "trigger_edge", "trigger_mode"),
)
"""The order in which settings are brought back: each may change the limits of those after it."""
_OWN = "own "
OFF, ONCE = "Off", "Once"
"""Of automatics: what is set by itself now, after which the feature reads "Off" (SFNC)."""


class KeptSettings(Camera):
    """Settings as the device last reported them; a driver gives limits and the ``_write_...`` methods.

    What was set comes back when the device is opened again after it was lost.
    """

    _identity: DeviceIdentity
    _exposure_ms: float
    _gain: float
    _roi: Roi
    _trigger_mode: TriggerMode = "free_run"
    _trigger_line: str = ""
    _trigger_edge: TriggerEdge = "rising"
    no_binning: ClassVar[str] = "It does not bin."
    """What an operator of a camera without binning is told."""

    def __init__(self) -> None:
        self._remembered: dict[str, Callable[[], object]] = {}

    # What a driver gives --------------------------------------------------------------------------
    @abstractmethod
    def _require(self) -> None:
        """Raise unless the device is connected and not lost."""

    @abstractmethod
    def _require_idle(self, what: str) -> None:
        """Raise while a sequence runs, too: no new ``what`` now."""

    @abstractmethod
    def _write_exposure(self, exposure_ms: float) -> float:
        """Set the exposure, within its limits; returns what the device made of it."""

    @abstractmethod
    def _write_gain(self, gain: float) -> float:
        """Set the gain, within its limits; returns what the device made of it."""

    @property
    @abstractmethod
    def _black_limits(self) -> tuple[float, float]:
        """Smallest and largest offset that the device takes; both 0 of one that has none."""

    @abstractmethod
    def _write_black(self, black_level: float) -> None:
        """Set the offset, within its limits."""

    def _write_trigger(self, mode: TriggerMode) -> None:
        """Choose what starts an exposure, where the device is to know; line and edge are set by then."""

    # The settings ---------------------------------------------------------------------------------
    @property
    def identity(self) -> DeviceIdentity:
        """Who the device says it is."""
        self._require()
        return self._identity

    @property
    def exposure_ms(self) -> float:
        """Exposure time."""
        self._require()
        return self._exposure_ms

    def set_exposure_ms(self, exposure_ms: float) -> float:
        """Set the exposure; returns what the device made of it."""
        limits = self.exposure_limits_ms
        problem = f"cannot expose {exposure_ms:g} ms."
        self._require_within(exposure_ms, limits, problem, "Its exposure", " ms")
        self._exposure_ms = self._write_exposure(exposure_ms)
        self._remember("exposure_ms", lambda: self.set_exposure_ms(exposure_ms))
        return self._exposure_ms

    @property
    def gain(self) -> float:
        """Gain as a factor, by the options ``gain_unit`` and ``gain_per_count``; 1 where it has none."""
        self._require()
        return self._gain

    def set_gain(self, gain: float) -> float:
        """Set the gain factor; returns what the device made of it."""
        self._require_within(gain, self.gain_limits, f"has no gain {gain:g}.", "Its gain")
        self._gain = self._write_gain(gain)
        self._remember("gain", lambda: self.set_gain(gain))
        return self._gain

    def set_black_level(self, black_level: float) -> float:
        """Set the offset; where there is none only 0 is taken."""
        self._require_idle("black level")
        low, high = self._black_limits
        problem = f"has no black level {black_level:g}."
        self._require_within(black_level, (max(low, 0), high), problem, "It", " counts")
        self._write_black(black_level)
        self._remember("black_level", lambda: self.set_black_level(black_level))
        return self.black_level

    @property
    def roi(self) -> Roi:
        """Region of interest."""
        self._require()
        return self._roi

    @property
    def binning(self) -> int:
        """Sensor pixels summed along each axis: 1, but of drivers that say otherwise."""
        return 1

    @property
    def binnings(self) -> tuple[int, ...]:
        """The binning factors that the camera offers: 1 alone, but of drivers that say otherwise."""
        return (1,)

    def set_binning(self, binning: int) -> int:
        """Take 1, refuse everything else."""
        self._require_idle("binning")
        if binning != 1:
            raise LimitError(self.name, f"has no binning {binning}.", self.no_binning)
        return 1

    @property
    def trigger_mode(self) -> TriggerMode:
        """What starts an exposure."""
        return self._trigger_mode

    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        """Choose what starts an exposure."""
        self._require_idle("trigger mode")
        self._require_offered("trigger mode", mode, self.trigger_modes)
        self._make_trigger(mode)
        self._trigger_mode = mode
        self._remember("trigger_mode", lambda: self.set_trigger_mode(mode))
        return mode

    @property
    def trigger_line(self) -> str:
        """The input that a hardware trigger comes in on."""
        return self._trigger_line

    def set_trigger_line(self, line: str) -> str:
        """Choose the input of the hardware trigger."""
        self._require_idle("trigger line")
        self._require_offered("trigger line", line, self.trigger_lines)
        before, self._trigger_line = self._trigger_line, line
        self._trigger_again(lambda: setattr(self, "_trigger_line", before))
        self._remember("trigger_line", lambda: self.set_trigger_line(line))
        return line

    @property
    def trigger_edge(self) -> TriggerEdge:
        """The edge of a pulse that starts an exposure."""
        return self._trigger_edge

    def set_trigger_edge(self, edge: TriggerEdge) -> TriggerEdge:
        """Choose the edge that starts an exposure."""
        self._require_idle("trigger edge")
        self._require_offered("trigger edge", edge, self.trigger_edges)
        before, self._trigger_edge = self._trigger_edge, edge
        self._trigger_again(lambda: setattr(self, "_trigger_edge", before))
        self._remember("trigger_edge", lambda: self.set_trigger_edge(edge))
        return edge

    def _trigger_again(self, back: Callable[[], object]) -> None:
        """Make the hardware trigger again with another line or edge, where it is in force."""
        if self._trigger_mode == "hardware":
            self._make_trigger("hardware", back)

    def _make_trigger(self, mode: TriggerMode, back: Callable[[], object] = lambda: None) -> None:
        """Write a trigger; where that fails ``back`` undoes what it had, and the last one is made.

        That this fails too becomes a note.
        """
        try:
            self._write_trigger(mode)
        except BaseException as error:
            back()
            try:
                self._write_trigger(self._trigger_mode)
            except DeviceError as another:
                if not isinstance(error, DeviceLostError):
                    error.add_note(f"Nor could trigger mode {self._trigger_mode} be made again: {another}")
            raise

    # A device that was lost -----------------------------------------------------------------------
    def _remember(self, name: str, again: Callable[[], object]) -> None:
        """Keep how a setting is made again after a reconnection; the latest counts."""
        self._remembered[name] = again

    def _remember_own(self, name: str, value: str, choices: tuple[str, ...] = ()) -> None:
        """Keep one of the device's own settings, too; they come back first, in the order they were set in.

        What is done once, now, is not done again: of it comes back that it is off, where it can be.
        """
        self._forget(key := f"{_OWN}{name}")
        if value == ONCE in choices:
            if OFF not in choices:
                return
            value = OFF
        self._remember(key, lambda: self.set_own(name, value))

    def _forget(self, name: str) -> None:
        """Let a setting be as after opening: another one has undone it."""
        self._remembered.pop(name, None)

    def _bring_back(self) -> None:
        """Make all settings again; where one fails, all stay remembered."""
        remembered = dict(self._remembered)  # bringing one back may forget another, or rename it meanwhile
        try:
            own = [name for name in remembered if name.startswith(_OWN)]
            for name in (*own, *_ORDER):
                if name in remembered:
                    remembered[name]()
        except BaseException:
            self._remembered = remembered
            raise
