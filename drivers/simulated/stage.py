"""The simulated motion stage; the point source rides on it."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.common.stage_axes import AXIS_NAMES, check_target, trapezoid_duration_s
from drivers.device import DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.simulated.mechanics import AxisSpec, Carriage
from drivers.simulated.options import NotNegative, Positive
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.world import SimulatedWorld
from drivers.stage import Stage, StageAxis

POLL_S = 0.002
REFERENCE_S = 1.0


class AxisOptions(BaseModel):
    """One axis, in the unit its name ends in; what is left out comes from the preset."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lower_limit: float | None = Field(default=None, description="Lower soft limit.")
    upper_limit: float | None = Field(default=None, description="Upper soft limit.")
    home: float | None = Field(default=None, description="Where homing ends.")
    speed_per_s: Positive | None = Field(default=None, description="Highest speed, units a second.")
    acceleration_per_s2: Positive | None = Field(
        default=None, description="Acceleration, units a second squared."
    )
    resolution: Positive | None = Field(default=None, description="Smallest step.")
    backlash: NotNegative | None = Field(default=None, description="Play when the direction turns.")
    repeatability: NotNegative | None = Field(
        default=None, description="Standard deviation of where a move to one place ends."
    )


class StageOptions(DriverOptions):
    """Options of the simulated stage in ``bench.toml``."""

    axis_names: tuple[str, ...] = Field(
        ("x_um", "y_um", "z_um"),
        description="One to six of x_um, y_um, z_um, roll_mrad, pitch_mrad, yaw_mrad.",
    )
    axes: dict[str, AxisOptions] = Field(
        default_factory=dict, description="How single axes differ from the preset, by name."
    )
    mount_offset_um: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="True source position minus stage reading, x, y, z."
    )

    @model_validator(mode="after")
    def _axes_are_known(self) -> Self:
        if not self.axis_names or len(set(self.axis_names)) != len(self.axis_names):
            raise ValueError("axis_names holds one to six different names")
        for name in self.axis_names:
            if name not in AXIS_NAMES:
                raise ValueError(f"unknown axis {name!r}; choose from {', '.join(AXIS_NAMES)}")
        for name in self.axes:
            if name not in self.axis_names:
                raise ValueError(f"axes.{name} is not among axis_names {self.axis_names}")
        return self


class CarriageStage(SimulatedDevice, Stage):
    """A stage of one to six axes that takes its time, has play, and carries something.

    What its axes are and what it carries is the subclasses' business. Before homing, moves are refused.
    """

    kind = "stage"
    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    Options = StageOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self._connect(shared)
        self.options = options = StageOptions.of(options)
        specs = tuple(
            self._axis_spec(name, options.axes.get(name, AxisOptions())) for name in options.axis_names
        )
        self.carriage = Carriage(specs, self.world.clock, self.world.options.seed + 2)
        self._axes = tuple(
            StageAxis(s.name, s.lower_limit, s.upper_limit, s.speed_per_s, s.resolution) for s in specs
        )
        self._stop = threading.Event()
        self._lock = threading.RLock()
        self._homed = False
        self._homing = False
        self._commanded = self.carriage.reported()

    @abstractmethod
    def _axis_spec(self, name: str, options: AxisOptions) -> AxisSpec:
        """Return an axis with what the options leave out filled in."""

    # Device ---
    def open(self) -> None:
        """Connect; nothing moves, and nothing may move before homing."""
        self.world.check_plugged(self.kind, self.name)
        self._is_open = True

    def close(self) -> None:
        """Stop any motion and disconnect."""
        if self._is_open:
            self._halt()
            self._is_open = False

    def settings(self) -> Mapping[str, Setting]:
        """Read position, limits and speeds."""
        self._require()
        settings: dict[str, Setting] = {"homed": self._homed}
        return settings | self._common_settings(self.position())

    # Stage ---
    @property
    def axes(self) -> tuple[StageAxis, ...]:
        """The stage's axes."""
        return self._axes

    def position(self) -> dict[str, float]:
        """Where the stage says it is."""
        self._require()
        return self.carriage.reported()

    def commanded_position(self) -> dict[str, float]:
        """Return the last target asked for."""
        self._require()
        return dict(self._commanded)

    @property
    def is_homed(self) -> bool:
        """Whether positions refer to a known reference."""
        return self._homed

    @property
    def is_moving(self) -> bool:
        """Whether any axis moves."""
        self._require()
        return self.carriage.is_moving

    def home(self) -> None:
        """Run every axis to its reference mark, and slowly onto it."""
        self._require()
        with self._lock:
            self._homed = False
            self._homing = True
            self._begin({spec.name: spec.home for spec in self.carriage.axes.values()})
        try:
            self.wait()
            self.world.clock.wait(REFERENCE_S, self._stop)
            with self._lock:
                if self._stop.is_set():
                    raise StoppedError(self.name, "homing was stopped.", "Home again before the next move.")
                self.carriage.find_reference()
                self._commanded = self.carriage.reported()
                self._homed = True
        finally:
            self._homing = False

    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        """Move the named axes to absolute positions."""
        self._require()
        check_target(self.name, self._axes, target, self._homed)
        with self._lock:
            self._begin(target)
        if wait:
            self.wait()
        return self.position()

    def wait(self, timeout_s: float | None = None) -> None:
        """Block until a running move has ended."""
        self._require()
        waited = 0.0
        while not self._stop.is_set() and self.carriage.is_moving:
            jammed = self.carriage.jammed_axes()
            if jammed:
                self.carriage.halt()
                self._homed = False
                raise DeviceTimeoutError(
                    self.name, f"axis {', '.join(jammed)} does not move.", "Free it and home again."
                )
            if timeout_s is not None and waited >= timeout_s:
                raise DeviceTimeoutError(
                    self.name, f"still moves after {timeout_s:g} s.", "Wait longer or stop."
                )
            self._stop.wait(POLL_S)
            waited += POLL_S
            self._require()
        if self._stop.is_set():
            raise StoppedError(self.name, "the move was stopped.", "Check the position before going on.")
        tripped = self.carriage.tripped_switches()
        if tripped:
            self.carriage.halt()
            self._homed = False
            raise DeviceError(
                self.name, f"axis {', '.join(tripped)} ran into its limit switch.", "Home again."
            )

    def stop(self) -> None:
        """Stop every axis at once."""
        self._require()
        self._halt()

    def move_duration_s(self, start: Mapping[str, float], target: Mapping[str, float]) -> float:
        """Seconds for a move, with acceleration; axes move together, so the slowest counts."""
        specs = self.carriage.axes
        return max(
            (
                trapezoid_duration_s(
                    target[name] - start[name], specs[name].speed_per_s, specs[name].acceleration_per_s2
                )
                for name in target
                if name in start and name in specs
            ),
            default=0.0,
        )

    def _begin(self, target: Mapping[str, float]) -> None:
        self._stop.clear()
        self._commanded = self._commanded | dict(target)
        self.carriage.start(target)

    def _halt(self) -> None:
        with self._lock:
            if self.carriage.is_moving or self._homing:
                self._stop.set()
            self.carriage.halt()
            self._commanded = self.carriage.reported()


class SimulatedStage(CarriageStage):
    """The stage that carries the point source.

    Axes that are missing leave the source on the optical axis, at the preset's distance; rotations do not
    move it.
    """

    model = "stepper stage"
    world: SimulatedWorld

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.world.carry_source(self.source_position_um)

    def source_position_um(self) -> tuple[float, float, float]:
        """Where the point source truly is."""
        true = self.carriage.true()
        resting = {"x_um": 0.0, "y_um": 0.0, "z_um": 1e3 * self.world.preset.source_distance_mm}
        x, y, z = (
            true.get(name, resting[name]) + offset
            for name, offset in zip(AXIS_NAMES[:3], self.options.mount_offset_um, strict=True)
        )
        return x, y, z

    def _axis_spec(self, name: str, options: AxisOptions) -> AxisSpec:
        """Fill in what the options leave out: a stepper stage that suits the preset's size."""
        preset = self.world.preset
        half_x, half_y, farthest = (1e3 * side for side in preset.travel_mm)
        if name == "z_um":
            return axis_spec(
                name, options, 1e3 * preset.nearest_z_mm, farthest, 1e3 * preset.source_distance_mm
            )
        if name.endswith("_um"):
            reach = half_x if name == "x_um" else half_y
            return axis_spec(name, options, -reach, reach, 0.0)
        return axis_spec(name, options, -50.0, 50.0, 0.0)


def axis_spec(name: str, options: AxisOptions, low: float, high: float, home: float) -> AxisSpec:
    """Fill in what the options leave out of an axis: a stepper with the given range."""
    travel = high - low
    linear = name.endswith("_um")

    def given(value: float | None, otherwise: float) -> float:
        return otherwise if value is None else value

    return AxisSpec(
        name=name,
        lower_limit=given(options.lower_limit, low),
        upper_limit=given(options.upper_limit, high),
        home=given(options.home, home),
        speed_per_s=given(options.speed_per_s, travel / 5),
        acceleration_per_s2=given(options.acceleration_per_s2, travel / 2),
        resolution=given(options.resolution, 0.1 if linear else 0.01),
        backlash=given(options.backlash, min(3.0, travel * 2e-5) if linear else 0.05),
        repeatability=given(options.repeatability, min(0.5, travel * 4e-6) if linear else 0.01),
        hard_margin=travel * 0.01,
    )
