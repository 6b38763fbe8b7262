"""Camera, six-axis stage and SLM of the simulated holographic display."""

from __future__ import annotations

from pydantic import Field

from drivers.common.stage_axes import AXIS_NAMES
from drivers.device import DriverOptions, SharedPart
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.display_world import DisplayWorld
from drivers.simulated.mechanics import AxisSpec
from drivers.simulated.slm import SimulatedSlm, SlmOptions
from drivers.simulated.stage import AxisOptions, CarriageStage, StageOptions, axis_spec


class DisplayStageOptions(StageOptions):
    """Options of the simulated stage that carries the mask."""

    axis_names: tuple[str, ...] = Field(
        AXIS_NAMES, description="One to six of x_um, y_um, z_um, roll_mrad, pitch_mrad, yaw_mrad."
    )


class DisplayStage(CarriageStage):
    """The stage that carries the mask: a flexure stage with goniometers, zero where homing ends."""

    Shared = DisplayWorld
    Options = DisplayStageOptions
    model = "six-axis stage"
    world: DisplayWorld

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.world.mount_mask(self.carriage.true)

    def _axis_spec(self, name: str, options: AxisOptions) -> AxisSpec:
        linear = name.endswith("_um")
        own = options.model_dump(exclude_none=True)
        fine = {"resolution": 0.05, "backlash": 1.0, "repeatability": 0.1}
        if not linear:
            fine = {"resolution": 0.002, "backlash": 0.03, "repeatability": 0.005}
        reach = 2000.0 if linear else 20.0
        return axis_spec(name, AxisOptions(**(fine | own)), -reach, reach, 0.0)


class DisplaySlm(SimulatedSlm):
    """The SLM whose image falls onto the mask."""

    Shared = DisplayWorld
    world: DisplayWorld
    options: SlmOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.world.mount_slm(lambda: self.phase_rad, self.options.pixel_pitch_um)


class DisplayCamera(SimulatedCamera):
    """The camera behind the Fourier lens."""

    Shared = DisplayWorld
