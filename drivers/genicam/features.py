"""Features of a GenICam camera by name, whichever library reaches it; errors in words."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from typing import Literal

from drivers.common.camera_settings import OFF, ONCE
from drivers.errors import DeviceError, LimitError

SWITCHED = {"true": True, "false": False, "1": True, "0": False}
FeatureValue = str | bool | int | float
FeatureKind = Literal["number", "choice", "switch", "command", "text"]

EXPOSURE = ("ExposureTime", "ExposureTimeAbs")
"""SFNC's name and the one of cameras before it; both count microseconds."""
GAIN = ("Gain", "GainAbs", "GainRaw")
BLACK_LEVEL = ("BlackLevel", "BlackLevelAbs", "BlackLevelRaw")
FRAME_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
FRAME_RATE_ENABLE = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
FRAME_TRIGGERS = ("FrameStart", "FrameTrigger", "AcquisitionStart")
FIRMWARE = ("DeviceFirmwareVersion", "DeviceVersion")
AUTOMATICS = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto")
STEADY = (
    *((name, OFF) for name in AUTOMATICS),
    ("AcquisitionMode", "Continuous"),
    ("ExposureMode", "Timed"),
)
"""What features are on opening, where they can be: no exposure lasts as long as a pulse."""
DRIVERS_OWN = {*EXPOSURE, *GAIN, *BLACK_LEVEL, *FRAME_RATE, *FRAME_RATE_ENABLE, *AUTOMATICS}
DRIVERS_OWN |= {"AcquisitionMode", "ExposureMode", "PixelFormat", "Width", "Height", "OffsetX", "OffsetY"}
DRIVERS_OWN |= {"BinningHorizontal", "BinningVertical", "TriggerSelector", "TriggerMode", "TriggerSource"}
DRIVERS_OWN |= {"TriggerActivation"}
"""What the driver itself sets and remembers."""


class Features(ABC):
    """Reads and writes features of an open device; a library's own class gives what it takes.

    Attributes
    ----------
    name : str
        The device as error messages name it.
    listed_by : str
        What lists a camera's features, for the refusal of one that it does not have.
    """

    listed_by: str

    def __init__(self, name: str) -> None:
        self.name = name

    # What a library gives --------------------------------------------------------------------------
    @abstractmethod
    def words(self, doing: str) -> AbstractContextManager[None]:
        """Turn the library's errors into DeviceError: "it did not ``doing``"."""

    @abstractmethod
    def find(self, *names: str) -> str | None:
        """Return the first of some names that the camera has now; None when it has none of them."""

    @abstractmethod
    def kind(self, name: str) -> FeatureKind | None:
        """Return what a feature is; None when the camera's description knows none of this name."""

    @abstractmethod
    def number(self, name: str) -> float:
        """Read a whole or real number."""

    @abstractmethod
    def bounds(self, name: str) -> tuple[float, float]:
        """Return the smallest and largest value that a number takes now."""

    @abstractmethod
    def increment(self, name: str) -> int:
        """Return the steps of a whole number; 0 of a real one."""

    @abstractmethod
    def _write_number(self, name: str, value: float) -> None:
        """Write a number that fits its limits and steps."""

    @abstractmethod
    def unit(self, name: str) -> str:
        """Return the unit that the camera's description gives a number; empty where it gives none."""

    @abstractmethod
    def text(self, name: str) -> str:
        """Read a feature of any kind as text."""

    @abstractmethod
    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries that an enumeration offers now."""

    @abstractmethod
    def _write_text(self, name: str, value: str) -> None:
        """Write a text, or the entry of an enumeration."""

    @abstractmethod
    def _write_switch(self, name: str, value: bool) -> None:
        """Write a boolean."""

    @abstractmethod
    def _execute(self, name: str) -> None:
        """Execute a command."""

    # What is made of it ----------------------------------------------------------------------------
    def set_number(self, name: str, value: float) -> float:
        """Set a number to the nearest that it takes, within its limits; returns what it reads afterwards."""
        with self.words(f"take {value:g} for its {name}"):
            low, high = self.bounds(name)
            value = min(max(value, low), high)  # a limit in other units and back is off by a rounding
            if (step := self.increment(name)) == 1:
                value = round(value)
            elif step:
                value = int(low) + min(round((value - low) / step), int(high - low) // step) * step
            self._write_number(name, value)
        return self.number(name)

    def choose(self, name: str, entry: str) -> str:
        """Choose the entry of an enumeration; returns what it reads afterwards.

        Raises LimitError when it is not on offer; DeviceError when it reads another afterwards.
        """
        offered = self.entries(name)
        if entry not in offered:
            raise LimitError(
                self.name, f"has no {name} {entry!r}.", f"It offers {', '.join(offered) or 'none'}."
            )
        with self.words(f"take {entry} for its {name}"):
            self._write_text(name, entry)
        if (said := self.text(name)) != entry and entry != ONCE:
            raise DeviceError(self.name, f"was told {name} = {entry} and has {said}.", "See its firmware.")
        return said

    def execute(self, name: str) -> None:
        """Execute a command."""
        with self.words(f"execute {name}"):
            self._execute(name)

    def set_any(self, name: str, value: FeatureValue) -> None:
        """Set a feature of any kind by what its description says it is.

        Raises LimitError: no such feature, or a value it does not take.
        """
        kind = self.kind(name)
        if kind is None:
            raise LimitError(self.name, f"has no feature {name!r}.", f"{self.listed_by} lists them.")
        if kind == "choice":
            self.choose(name, str(value))
        elif kind == "command":
            self.execute(name)
        elif kind == "switch":
            if (text := str(value).lower()) not in SWITCHED:
                problem = f"takes no {name} {value!r}."
                raise LimitError(self.name, problem, f"It takes {', '.join(list(SWITCHED)[:2])}.")
            with self.words(f"take {value} for its {name}"):
                self._write_switch(name, SWITCHED[text])
        elif kind == "number" and not isinstance(value, str):
            low, high = self.bounds(name)
            if not low <= value <= high:
                raise LimitError(self.name, f"takes no {name} {value:g}.", f"It takes {low:g} to {high:g}.")
            self.set_number(name, value)
        else:
            with self.words(f"take {value!r} for its {name}"):
                self._write_text(name, str(value))
