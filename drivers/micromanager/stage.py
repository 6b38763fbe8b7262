"""A stage made of Micro-Manager's stage devices: XY stages and single axes (its focus drives) together."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.stage_axes import AxisMap, AxisName, AxisOptions
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError
from drivers.micromanager.core import MicroManagerDevice, Part
from drivers.stage import StageAxis

_log = logging.getLogger(__name__)
_XY_STAGE, _STAGE = 6, 5
_NO_COMMAND = "Unsupported device command"
"""How Micro-Manager's core says that an adapter has no such command (its error 11)."""


class MicroManagerAxis(AxisOptions):
    """One axis. Micro-Manager knows neither limits nor speed: both are said here."""

    device: str | None = Field(
        None,
        min_length=1,
        description=(
            "Label of the stage device; left out: the XY stage of Micro-Manager's configuration for x_um and "
            "y_um, its focus drive for others."
        ),
    )
    axis: Literal["x", "y"] | None = Field(
        None, description="Which axis of an XY stage; left out: x for x_um, y for y_um."
    )
    lower_limit: float = Field(description="Lower soft limit.")
    upper_limit: float = Field(description="Upper soft limit.")
    speed_per_s: float = Field(1000.0, gt=0, description="Units a second, for estimates of time alone.")
    resolution: float = Field(0.1, gt=0, description="How near to its target a move ends.")
    per_unit: float = Field(
        1.0,
        gt=0,
        description="Units of this axis in one of Micro-Manager's (which are um; 17.453 for degrees).",
    )


class MicroManagerStageOptions(DriverOptions):
    """Stage devices of Micro-Manager as one stage."""

    axes: dict[AxisName, MicroManagerAxis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which device is which axis, its limits."
    )


class MicroManagerStage(MicroManagerDevice, PolledStage):
    """XY stages and single axes of Micro-Manager, together as one stage of up to six axes."""

    Options = MicroManagerStageOptions
    kind = "stage"

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = MicroManagerStageOptions.of(options)
        self._share(shared)
        self._maps: dict[str, AxisMap] = {}
        self._parts: dict[str, Part] = {}
        """Stage devices by label."""
        self._places: dict[str, tuple[str, Literal["x", "y"] | None]] = {}
        """Label of the device of each axis, and which of its axes, None of a single one."""
        self._homed = False

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the stage devices by their labels."""
        axes = MicroManagerStageOptions.of(options).axes
        labels = {axis.device or f"(the default for {name})" for name, axis in axes.items()}
        return tuple(f"Micro-Manager stage {label}" for label in sorted(labels))

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return nothing: the camera's driver lists the installation."""
        return ()

    @property
    def name(self) -> str:
        """The stage as error messages name it."""
        return "stage (micromanager)"

    # Connection ------------------------------------------------------------------------------------
    @property
    def _is_connected(self) -> bool:
        return self._core is not None

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._acquire()
        self._parts, self._places, self._maps, self._homed = {}, {}, {}, False
        axes = tuple(self._axis(name, axis) for name, axis in self.options.axes.items())
        taken: dict[tuple[str, str | None], str] = {}
        for name, place in self._places.items():
            if place in taken:
                raise DeviceError(
                    self.name,
                    f"{name} and {taken[place]} are the same axis of {place[0]!r}.",
                    "Name another one.",
                )
            taken[place] = name
        identities = [part.identity("stage") for part in self._parts.values()]
        return (
            DeviceIdentity(
                kind="stage",
                driver="micromanager",
                vendor=", ".join(dict.fromkeys(identity.vendor for identity in identities)),
                model=" + ".join(identity.model for identity in identities),
                serial_number=" + ".join(identity.serial_number for identity in identities),
                firmware=identities[0].firmware,
                simulated=any(identity.simulated for identity in identities),
            ),
            axes,
        )

    def _axis(self, name: str, options: MicroManagerAxis) -> StageAxis:
        part = self._part(options.device, "XYStage" if name in ("x_um", "y_um") else "Focus")
        self._parts.setdefault(part.label, part)
        kind = int(part.call("say what it is", "getDeviceType"))
        if kind not in (_XY_STAGE, _STAGE):
            raise DeviceError(self.name, f"{part.label!r} ({name}) is no stage.", "Name a stage device.")
        which: Literal["x", "y"] | None = None
        if kind == _XY_STAGE:
            which = options.axis or {"x_um": "x", "y_um": "y"}.get(name)  # type: ignore[assignment]
            if which is None:
                raise DeviceError(
                    self.name, f"{name}: {part.label!r} is an XY stage.", f'Say axis = "x" or "y" for {name}.'
                )
        self._places[name] = (part.label, which)
        label = f"{part.label} {which}" if which else part.label
        axis_map = AxisMap(name, label, -options.per_unit if options.reverse else options.per_unit)
        self._maps[name] = axis_map
        ends = sorted(axis_map.to_controller(end) for end in (options.lower_limit, options.upper_limit))
        return axis_map.stage_axis(
            self.name,
            options,
            ends=(ends[0], ends[1]),
            speed_per_s=options.speed_per_s / options.per_unit,
            resolution=options.resolution / options.per_unit,
        )

    def _disconnect(self) -> None:
        self._release()

    def settings(self) -> Mapping[str, Setting]:
        """Read position, limits, and every property of every device."""
        made = dict(super().settings())
        for label, part in self._parts.items():
            made |= {f"{label}.{key}": value for key, value in part.settings().items()}
        return made

    # Motion ----------------------------------------------------------------------------------------
    def _read(self) -> dict[str, float]:
        """Return every axis' place, in Micro-Manager's units."""
        read: dict[tuple[str, str | None], float] = {}
        for label, part in self._parts.items():
            if any(place == (label, None) for place in self._places.values()):
                read[label, None] = float(part.call("say where it is", "getPosition"))
            else:
                x, y = part.call("say where it is", "getXYPosition")
                read[label, "x"], read[label, "y"] = float(x), float(y)
        return {name: read[place] for name, place in self._places.items()}

    def _state(self) -> StageState:
        if self._core is None:
            raise self._not_connected()
        moving = any(part.call("say whether it moves", "deviceBusy") for part in self._parts.values())
        position = {name: self._maps[name].to_bench(place) for name, place in self._read().items()}
        return StageState(position, moving, self._homed)

    def _start(self, target: Mapping[str, float]) -> None:
        wanted = {name: self._maps[name].to_controller(place) for name, place in target.items()}
        commanded = {name: self._maps[name].to_controller(place) for name, place in self._commanded.items()}
        for label, part in self._parts.items():
            own: dict[str | None, float] = {
                self._places[name][1]: place
                for name, place in wanted.items()
                if self._places[name][0] == label
            }
            if not own:
                continue
            if None in own:
                part.call("move", "setPosition", own[None])
                continue
            # An axis that is not asked to move goes where it was last sent, not to where it is read.
            x, y = part.call("say where it is", "getXYPosition")
            here: dict[str | None, float] = {"x": x, "y": y}
            for name, place in commanded.items():
                if self._places[name][0] == label:
                    here[self._places[name][1]] = place
            here |= own
            part.call("move", "setXYPosition", here["x"], here["y"])

    def _start_homing(self) -> None:
        for label, part in self._parts.items():
            try:
                part.call("home", "home")
            except DeviceError as error:
                if _NO_COMMAND not in error.problem:
                    raise
                # Most of Micro-Manager's stages have no such command: their own count is the reference.
                _log.warning(
                    "%s: %s keeps its own count as the reference: %s", self.name, label, error.problem
                )
        self._homed = True

    def _halt(self) -> None:
        errors = []
        for part in self._parts.values():
            try:
                part.call("stop", "stop")
            except DeviceError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _not_connected(self) -> DeviceError:
        return DeviceError(self.name, "is not connected.", "Open it.")
