"""What all simulated devices share: a world with a sensor and a clock in it, opening, identity, faults."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from datetime import UTC, datetime, timedelta
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from drivers.device import Device, DeviceIdentity, DriverOptions, SharedPart
from drivers.errors import DeviceError, DeviceNotOpenError
from drivers.simulated.faults import FaultOptions, with_late_hot
from drivers.simulated.wire import WireFaults, Wires
from recon.arrays import Float32Array
from recon.optics.sensor import FixedPattern, SensorSpec, fixed_pattern


class Clock:
    """Waits ``time_scale`` real seconds for every simulated second (1: real time, 0: no waiting)."""

    def __init__(self, time_scale: float) -> None:
        self.time_scale = time_scale
        self._began, self._began_utc = time.monotonic(), datetime.now(UTC)
        self._skipped_s = 0.0

    @property
    def now_s(self) -> float:
        """Simulated seconds since the world began, those that nobody waited for included."""
        if self.time_scale == 0:
            return self._skipped_s
        return (time.monotonic() - self._began) / self.time_scale

    @property
    def ticks_ns(self) -> int:
        """The clock of the devices: nanoseconds, those that nobody waited for included."""
        if self.time_scale:
            return time.monotonic_ns()
        return round(1e9 * (self._began + self._skipped_s))

    def read_s(self, ticks_ns: int) -> float:
        """Return the simulated seconds since the world began at a reading of :attr:`ticks_ns`."""
        return (1e-9 * ticks_ns - self._began) / (self.time_scale or 1.0)

    @property
    def utc(self) -> datetime:
        """The time of day; where nothing is waited for, as if it had been."""
        return datetime.now(UTC) if self.time_scale else self._began_utc + timedelta(seconds=self._skipped_s)

    def wait(self, seconds: float, cancelled: threading.Event) -> bool:
        """Wait; returns False as soon as ``cancelled`` is set."""
        self.skip(seconds)
        return not cancelled.wait(max(seconds, 0.0) * self.time_scale)

    def skip(self, seconds: float) -> None:
        """Let time pass that is not waited for where nothing is."""
        if self.time_scale == 0:
            self._skipped_s += max(seconds, 0.0)

    def elapsed_since(self, start: float) -> float:
        """Return the simulated seconds since ``start``, a reading of ``time.monotonic()``.

        Infinite when nothing is waited for.
        """
        if self.time_scale == 0:
            return float("inf")
        return (time.monotonic() - start) / self.time_scale


class CommonOptions(FaultOptions):
    """What the options of every simulated world have."""

    seed: int = Field(0, ge=0, description="The same seed gives the same optics, sensor and noise.")
    time_scale: float = Field(
        1.0,
        ge=0,
        description="Real seconds per simulated second of motion, exposure, settling; 0: no waiting.",
    )
    noise: float = Field(1.0, ge=0, description="Scale of all temporal noise: 1 is physical, 0 is none.")
    fixed_pattern: bool = Field(
        True, description="Whether camera pixels differ (response, offset, hot, dead)."
    )
    pulse_jitter_us: float = Field(
        0.0, ge=0, description="Standard deviation by which trigger pulses come late; they never come early."
    )
    missed_pulses: float = Field(0.0, ge=0, le=1, description="Share of trigger pulses that are lost.")
    extra_pulses: float = Field(
        0.0, ge=0, le=1, description="Trigger pulses that nobody sent, per pulse that was sent."
    )


class Surroundings(SharedPart):
    """A simulated world with a sensor in it, devices whose plugs can be pulled, and a clock."""

    options: CommonOptions
    _pattern: FixedPattern | None = None
    _unplugged: frozenset[str] = frozenset()

    def __init__(self, options: CommonOptions, sensor: SensorSpec) -> None:
        self.options = options
        self.clock = Clock(options.time_scale)
        self.sensor = sensor
        self.scene_lit = False
        """Whether the scene glows."""
        self._lock = threading.RLock()
        faults = WireFaults(1e-6 * options.pulse_jitter_us, options.missed_pulses, options.extra_pulses)
        self.wires = Wires(options.time_scale, faults, options.seed)
        """From LED array and SLM to the camera."""

    @abstractmethod
    def photons_per_s(self, weights: tuple[float, float, float], binning: int = 1) -> Float32Array | None:
        """Photons a second on every binned pixel now, or None when all is dark.

        Parameters
        ----------
        weights : tuple of float
            Sensitivity to red, green and blue. The fixed pattern is not included, the angular response is.
        """

    def coarse_photons_per_s(
        self, weights: tuple[float, float, float], binning: int = 1
    ) -> tuple[Float32Array, int] | None:
        """Return :meth:`photons_per_s` coarsely where that takes seconds, and how many pixels are one."""
        del weights, binning
        return None

    def awaits_light(self, weights: tuple[float, float, float], binning: int = 1) -> bool:
        """Whether :meth:`photons_per_s` would take seconds now, and only once."""
        del weights, binning
        return False

    @abstractmethod
    def light_key(self) -> tuple[Any, ...]:
        """Something that changes whenever :meth:`photons_per_s` does."""

    @property
    def late_hot(self) -> bool:
        """Whether those pixels that turn hot late are hot now."""
        return self.options.late_hot_pixels > 0 and self.clock.now_s >= self.options.late_hot_after_s

    def fixed_pattern(self, *, late: bool = False) -> FixedPattern:
        """Return the sensor's pixels: response, dark current, offset; ``late``: those that turn hot are."""
        if self._pattern is None:
            if self.options.fixed_pattern:
                self._pattern = fixed_pattern(self.sensor, self.options.seed + 1)
            else:
                ones = np.ones(self.sensor.shape, np.float32)
                dark = np.float32(self.sensor.dark_current_e_per_s) * ones
                self._pattern = FixedPattern(ones, dark, np.zeros_like(ones))
        return with_late_hot(self._pattern, self.options, self.options.seed) if late else self._pattern

    # Faults, for tests ---
    def unplug(self, kind: str) -> None:
        """Pull the plug of a device (``"camera"``, ``"stage"``, ``"led_array"``, ``"slm"``)."""
        self._unplugged |= {kind}

    def plug_in(self, kind: str) -> None:
        """Plug a device in again."""
        self._unplugged -= {kind}

    def is_plugged(self, kind: str) -> bool:
        """Whether a device's plug is in."""
        return kind not in self._unplugged

    def check_plugged(self, kind: str, name: str) -> None:
        """Raise :class:`DeviceError` when the device is unplugged."""
        if not self.is_plugged(kind):
            raise DeviceError(name, "was unplugged.", "Plug it in, then open it again.")


class SimulatedDevice(Device):
    """Mix-in for the simulated drivers; the interface's class comes second in the bases."""

    Shared: ClassVar[type[Surroundings]]
    kind: ClassVar[str]
    model: ClassVar[str]
    world: Surroundings
    _is_open = False

    @classmethod
    def claims(cls, _options: DriverOptions) -> tuple[str, ...]:
        """Claim nothing: every program has a simulated world of its own."""
        return ()

    def _join(self, shared: SharedPart | None) -> None:
        if not isinstance(shared, self.Shared):
            raise TypeError(
                f"{self.name} needs the bench's {self.Shared.__name__}, not {type(shared).__name__}."
            )
        self.world = shared

    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return f"{self.kind} (simulated)"

    @property
    def is_open(self) -> bool:
        """Whether the device is connected."""
        return self._is_open

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device says it is."""
        self._require()
        return DeviceIdentity(
            kind=self.kind,
            driver="simulated",
            vendor="diffuserbench",
            model=self._model(),
            serial_number=f"SIM-{self.world.options.seed}",
            firmware="1",
            simulated=True,
        )

    def _model(self) -> str:
        return self.model

    def _require(self) -> None:
        """Raise unless the device is open and plugged in."""
        if not self._is_open:
            raise DeviceNotOpenError(self.name)
        self.world.check_plugged(self.kind, self.name)
