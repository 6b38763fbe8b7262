"""The simulated motion stage; the point source rides on it."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.stage_axes import AXIS_NAMES
from drivers.device import DeviceIdentity, DriverOptions, SharedPart
from drivers.simulated.mechanics import AxisSpec, Carriage
from drivers.simulated.options import NotNegative, Positive
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.world import SimulatedWorld
from drivers.stage import StageAxis

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
    scale: Positive = Field(default=1.0, description="True way over the way that it reports.")
    slip: float = Field(default=0.0, description="Steps lost, once: how far it is off from then on.")
    slip_at_move: int = Field(default=0, ge=0, description="At which of its moves, from 1; 0: never.")


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
    mount_tilt_mrad: tuple[float, float] = Field(
        (0.0, 0.0), description="How far the stage's z axis leans towards x and y."
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


class CarriageStage(SimulatedDevice, PolledStage):
    """A stage of one to six axes that takes its time, has play, and carries something.

    What its axes are and what it carries is the subclasses' business. Before homing, moves are refused.
    """

    kind = "stage"
    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    Options = StageOptions

    poll_s = 0.002
    grace_s = 0.0

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self._join(shared)
        self.options = options = StageOptions.of(options)
        specs = tuple(
            self._axis_spec(name, options.axes.get(name, AxisOptions())) for name in options.axis_names
        )
        self.carriage = Carriage(specs, self.world.clock, self.world.options.seed + 2)
        self._axes = tuple(
            StageAxis(s.name, s.lower_limit, s.upper_limit, s.speed_per_s, s.resolution) for s in specs
        )
        self.stuck_s *= max(1.0, self.world.clock.time_scale)  # on its reference mark it stays for a while
        self._lock = threading.RLock()
        self._homed = False
        self._referenced_after_s: float | None = None
        """While homing: simulated seconds from ``_began_s`` until the axes have found their references."""
        self._began_s = 0.0

    @abstractmethod
    def _axis_spec(self, name: str, options: AxisOptions) -> AxisSpec:
        """Return an axis with what the options leave out filled in."""

    # The protocol ---
    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self.world.check_plugged(self.kind, self.name)
        self._is_open = True
        return self.identity, self._axes

    def _disconnect(self) -> None:
        self._is_open = False

    @property
    def _is_connected(self) -> bool:
        return self._is_open and self.world.is_plugged(self.kind)

    def _state(self) -> StageState:
        with self._lock:
            jammed, tripped = self.carriage.jammed_axes(), self.carriage.tripped_switches()
            if self._referenced_after_s is None:
                self._homed = self._homed and not (jammed or tripped)
            elif not jammed and self.world.clock.elapsed_since(self._began_s) >= self._referenced_after_s:
                self.carriage.find_reference()
                self._homed, self._referenced_after_s = True, None
            faults = [f"axis {', '.join(jammed)} does not move"] if jammed else []
            if tripped:
                faults.append(f"axis {', '.join(tripped)} ran into its limit switch")
            moving = self.carriage.is_moving or self._referenced_after_s is not None
            return StageState(self.carriage.reported(), moving, self._homed, tuple(faults))

    def _start(self, target: Mapping[str, float]) -> None:
        self.carriage.start(target)

    def _start_homing(self) -> None:
        """Run every axis to its reference mark, and slowly onto it."""
        with self._lock:
            self._homed = False
            self._began_s = time.monotonic()
            way_s = self.carriage.start({spec.name: spec.home for spec in self.carriage.axes.values()})
            self._referenced_after_s = way_s + REFERENCE_S
            self.world.clock.skip(REFERENCE_S)

    def _halt(self) -> None:
        with self._lock:
            self._referenced_after_s = None
            self.carriage.halt()

    def _acceleration_per_s2(self, name: str) -> float:
        return self.carriage.axes[name].acceleration_per_s2


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
        lean_x, lean_y = self.options.mount_tilt_mrad
        return x + 1e-3 * lean_x * z, y + 1e-3 * lean_y * z, z

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
        scale=options.scale,
        slip=options.slip,
        slip_at_move=options.slip_at_move,
    )
