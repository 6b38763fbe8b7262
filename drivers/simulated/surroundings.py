"""What a simulated camera needs of the world it looks at, whatever that world is, and the world's time."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.device import SharedPart
from drivers.errors import DeviceError
from recon.optics.sensor import FixedPattern, SensorSpec, fixed_pattern


class Clock:
    """Waits ``time_scale`` real seconds for every simulated second (1: real time, 0: no waiting)."""

    def __init__(self, time_scale: float) -> None:
        self.time_scale = time_scale

    def wait(self, seconds: float, cancelled: threading.Event) -> bool:
        """Wait; returns False as soon as ``cancelled`` is set."""
        return not cancelled.wait(max(seconds, 0.0) * self.time_scale)

    def elapsed_since(self, start: float) -> float:
        """Return the simulated seconds since ``start``, a reading of ``time.monotonic()``.

        Infinite when nothing is waited for.
        """
        if self.time_scale == 0:
            return float("inf")
        return (time.monotonic() - start) / self.time_scale


class CommonOptions(Protocol):
    """What the options of every simulated world have."""

    @property
    def seed(self) -> int:
        """The same seed gives the same world."""

    @property
    def noise(self) -> float:
        """Scale of all temporal noise."""

    @property
    def fixed_pattern(self) -> bool:
        """Whether pixels differ."""


class Surroundings(SharedPart):
    """A simulated world with a sensor in it, devices whose plugs can be pulled, and a clock."""

    options: CommonOptions
    clock: Clock
    sensor: SensorSpec
    _pattern: FixedPattern | None = None
    _unplugged: frozenset[str] = frozenset()

    @abstractmethod
    def photons_per_s(
        self, weights: tuple[float, float, float], binning: int = 1
    ) -> npt.NDArray[np.float32] | None:
        """Photons a second on every binned pixel now, or None when all is dark.

        Parameters
        ----------
        weights : tuple of float
            Sensitivity to red, green and blue. The fixed pattern is not included, the angular response is.
        """

    @abstractmethod
    def light_key(self) -> tuple[Any, ...]:
        """Something that changes whenever :meth:`photons_per_s` does."""

    def fixed_pattern(self) -> FixedPattern:
        """Return the sensor's pixels: response, dark current, offset."""
        if self._pattern is None:
            if self.options.fixed_pattern:
                self._pattern = fixed_pattern(self.sensor, self.options.seed + 1)
            else:
                ones = np.ones(self.sensor.shape, np.float32)
                dark = np.float32(self.sensor.dark_current_e_per_s) * ones
                self._pattern = FixedPattern(ones, dark, np.zeros_like(ones))
        return self._pattern

    # Faults, for tests ---
    def unplug(self, kind: str) -> None:
        """Pull the plug of a device (``"camera"``, ``"stage"``, ``"led_array"``, ``"slm"``)."""
        self._unplugged |= {kind}

    def plug_in(self, kind: str) -> None:
        """Plug a device in again."""
        self._unplugged -= {kind}

    def check_plugged(self, kind: str, name: str) -> None:
        """Raise :class:`DeviceError` when the device is unplugged."""
        if kind in self._unplugged:
            raise DeviceError(name, "was unplugged.", "Plug it in and open the bench again.")
