"""A stage of ASI's axes: MS-2000 and Tiger controllers (ASI serial command set).

A command is a line of letters: ``M X=12345``, places in tenths of micrometres; the answer begins with ``:A``,
or ``:N-`` and the number of an error. ``/`` asks whether anything moves: ``B`` or ``N``.
"""

from __future__ import annotations

import re
from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.common.framing import reply_line
from drivers.common.port_stage import AxisState, PortOptions, PortStage, distinct
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DeviceIdentity, DriverOptions, SharedPart
from drivers.errors import DeviceError
from drivers.stage import StageAxis

_TENTHS_PER_MM = 1e4
_ERRORS = {
    1: "it does not know the command",
    2: "it has no such axis",
    3: "a value is missing",
    4: "the value is out of range",
    5: "it failed",
    6: "it cannot do that now",
    21: "it was stopped",
}
_SETTLING_UM = 0.5


class AsiAxis(AxisOptions):
    """One axis of the controller, micrometres."""

    letter: Annotated[str, Field(pattern="^[A-Z]$")] = Field("X", description="Letter of the axis.")
    home_at_um: float = Field(
        0.0,
        description="What it reads at the end of homing: where HOME leads it (SETHM), its limit switch.",
    )


class AsiOptions(PortOptions):
    """ASI controllers over their serial commands."""

    baud_rate: int = Field(115_200, ge=9600, description="115200 (Tiger), or 9600 (MS-2000 as delivered).")
    axes: dict[AxisName, AsiAxis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which letter is which axis."
    )

    @model_validator(mode="after")
    def _letters_differ(self) -> Self:
        distinct({name: axis.letter for name, axis in self.axes.items()}, "axis")
        if turning := [name for name in self.axes if not name.endswith("_um")]:
            raise ValueError(f"axes.{turning[0]}: this driver moves axes in micrometres only")
        return self


class AsiStage(PortStage):
    """Axes of one ASI controller, moved together.

    The controller has no reference of its own: homing drives each axis to its HOME place and has it read
    ``home_at_um`` there. Its limits are places of the hardware, whose numbers change by that: they are asked
    for again, and only then may ``lower_limit`` and ``upper_limit`` narrow them.
    """

    Options = AsiOptions
    driver = "asi"
    vendor = "ASI"
    probed_axis = {"letter": "X"}  # noqa: RUF012

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        options = AsiOptions.of(options)
        self.axis_options = options.axes
        name = f"stage (asi, {options.port})"
        super().__init__(options, SerialTransport(options.port, name, baud_rate=options.baud_rate))

    def _query(self, words: str, reply: str = "") -> str:
        """Send a command; returns what follows ``:A``.

        Raises DeviceError with the controller's reason when it refuses.
        """
        matcher = reply_line(rf":A ?{reply}\s*|:N-\d+\s*".encode())
        line = self._link.request(f"{words}\r".encode(), matcher)[-1].decode("ascii").strip()
        if line.startswith(":N"):
            number = int(line[3:])
            reason = _ERRORS.get(number, "it says")
            raise DeviceError(self.name, f"refuses {words!r}: {reason} (error {number}).")
        return line[2:].strip()

    def _value(self, words: str, letter: str) -> float:
        """Ask for one setting of an axis, ``"SL X?"``."""
        found = self._query(f"{words} {letter}?", rf"{letter}=[-+.\d]+")
        return float(found.split("=")[1])

    def _letter(self, name: str) -> str:
        return self.axis_options[name].letter  # type: ignore[attr-defined,no-any-return]

    def _identify(self) -> tuple[str, str, str]:
        version = self._query("V", r"\s*.*").removeprefix("Version:").strip()
        return "controller", "unknown", version

    def _read_axis(self, name: str) -> tuple[AxisMap, StageAxis]:
        options, letter = self.axis_options[name], self._letter(name)
        if name not in self._homed:  # its numbers are those of wherever it was switched on
            options = options.model_copy(update={"lower_limit": None, "upper_limit": None})
        tenth_um = UM_PER_MM / _TENTHS_PER_MM
        axis_map = AxisMap(name, f"axis {letter}", -tenth_um if options.reverse else tenth_um)
        return axis_map, axis_map.stage_axis(
            self.name,
            options,
            ends=(_TENTHS_PER_MM * self._value("SL", letter), _TENTHS_PER_MM * self._value("SU", letter)),
            speed_per_s=_TENTHS_PER_MM * self._value("S", letter),
            resolution=1.0,
        )

    def _axis_state(self, name: str) -> AxisState:
        letter = self._letter(name)
        moving = self._link.request(b"/\r", reply_line(rb":?[BN]\s*"))[-1].strip()[-1:] == b"B"
        if self._came_home(name, moving=moving):
            self._call_home(name, letter)
        place = self._query(f"W {letter}", r"[-+.\d]+(?: [-+.\d]+)*")
        found = re.match(r"[-+.\d]+", place)
        assert found is not None, "the matcher lets nothing else through"
        return AxisState(float(found[0]), moving, name in self._homed)

    def _call_home(self, name: str, letter: str) -> None:
        """Have an axis that came home read what is configured, and ask for its limits as seen from there."""
        options = self.axis_options[name]
        assert isinstance(options, AsiAxis)
        try:
            self._query(f"H {letter}={round(self._maps[name].to_controller(options.home_at_um))}")
            self._homed.add(name)
            _, axis = self._read_axis(name)
        except DeviceError:
            self._homed.discard(name)
            self._homing[name] = 0.0  # who waits for the homing is told, too, whoever asked
            raise
        self._axes = tuple(axis if old.name == name else old for old in self._axes)

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._homed.clear()
        return super()._connect()

    def _send_move(self, name: str, place: float) -> None:
        self._query(f"M {self._letter(name)}={round(place)}")

    def _send_home(self, name: str) -> None:
        self._query(f"! {self._letter(name)}")

    def _halt(self) -> None:
        self._homing.clear()
        self._link.overtake(b"\\\r", answered=True)

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may rest: the controller's finish error."""
        return max(1.01 * axis.resolution, _SETTLING_UM)
