"""A stage of axes of one Newport ESP controller (ESP100, ESP300, ESP301; ASCII commands).

A command is the axis' number, two letters and a value: ``1PA1.5``; questions end in ``?`` and are answered by
the value alone. Commands that set answer nothing: errors wait in a queue that ``TB?`` reads one by one,
``"108, 451322, MOTOR NOT ENABLED"`` for axis 1, ``"0, 451322, NO ERROR DETECTED"`` when there is none left.
"""

from __future__ import annotations

import math
import threading
from typing import Self

from pydantic import Field, model_validator

from drivers.common.framing import reply_line
from drivers.common.port_stage import AxisState, PortOptions, PortStage, distinct
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError
from drivers.stage import StageAxis

_NUMBER = rb" *[-+]?\d*\.?\d+(?:[eE][-+]?\d+)? *"
_ERROR = rb" *\d+ *,.*"
_VERSION = (b"VE?\r", reply_line(rb" *ESP.*"))
_UM_PER_INCH = 25_400.0
_UNITS = {
    2: ("um", UM_PER_MM),
    3: ("um", 1.0),
    4: ("um", _UM_PER_INCH),
    5: ("um", 1e-3 * _UM_PER_INCH),
    6: ("um", 1e-6 * _UM_PER_INCH),
    7: ("mrad", MRAD_PER_DEG),
    8: ("mrad", 0.9 * MRAD_PER_DEG),
    9: ("mrad", 1e3),
    10: ("mrad", 1.0),
    11: ("mrad", 1e-3),
}
"""What the answer to ``SN?`` stands for: the bench's unit, and how many of it one is; 0 and 1 are counts."""
_SETTLING = {"um": 1.0, "mrad": 0.05}
_PROBE_S = 0.5
"""For the version: a port without a controller is given up within 2 s."""
_QUEUE = 12
"""The controller keeps ten errors."""


class Esp301Axis(AxisOptions):
    """One axis of the controller, in the unit its name ends in."""

    number: int = Field(1, ge=1, le=6, description="Number of the axis on its controller.")


class Esp301Options(PortOptions):
    """Newport ESP controllers over their ASCII protocol."""

    baud_rate: int = Field(921_600, ge=9600, description="921600 (ESP301), or 19200 (ESP100, ESP300).")
    axes: dict[AxisName, Esp301Axis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which number is which axis."
    )

    @model_validator(mode="after")
    def _numbers_differ(self) -> Self:
        distinct({name: axis.number for name, axis in self.axes.items()}, "axis")
        return self


class Esp301Stage(PortStage):
    """Axes of one ESP controller, moved together; it does not tell whether an axis was homed before."""

    Options = Esp301Options
    driver = "esp301"
    vendor = "Newport"
    faults_last = False
    probed_axis = {"number": 1}  # noqa: RUF012

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        options = Esp301Options.of(options)
        self.axis_options = options.axes
        self._errors: dict[int, list[str]] = {}
        """What the controller has said of each axis, 0: of none, and nobody was told."""
        self._hearing = threading.RLock()
        """Held from a command until its refusal was asked for: no other thread's question takes it."""
        name = f"stage (esp301, {options.port})"
        link = SerialTransport(options.port, name, baud_rate=options.baud_rate, probe=_VERSION)
        link.probe_s = _PROBE_S
        super().__init__(options, link)

    def _number(self, name: str) -> int:
        return self.axis_options[name].number  # type: ignore[attr-defined,no-any-return]

    def _value(self, name: str, words: str) -> float:
        question = f"{self._number(name)}{words}?\r".encode()
        return float(self._link.request(question, reply_line(_NUMBER))[-1])

    def _heard_of(self, number: int) -> list[str]:
        """Empty the controller's queue of errors; returns those of an axis, and of none."""
        with self._hearing:
            self._hear_errors()
            return self._errors.pop(number, []) + self._errors.pop(0, [])

    def _hear_errors(self) -> None:
        for _ in range(_QUEUE):
            line = self._link.request(b"TB?\r", reply_line(_ERROR))[-1].decode("ascii", "replace")
            code, *rest = (word.strip() for word in line.split(","))
            if int(code) == 0:
                return
            text = f"{rest[-1].lower()} (error {code})" if rest else f"error {code}"
            self._errors.setdefault(int(code) // 100, []).append(text)

    def _tell(self, name: str, words: str) -> None:
        """Send a command, and ask whether it was taken.

        Raises DeviceError with the controller's words when it was not.
        """
        number = self._number(name)
        with self._hearing:
            self._link.send_now(f"{number}{words}\r".encode())
            said = self._heard_of(number)
        if said:
            raise DeviceError(self.name, f"axis {number} refuses {words!r}: {', '.join(said)}.")

    def _identify(self) -> tuple[str, str, str]:
        model, _, version = self._link.request(*_VERSION)[-1].decode("ascii").strip().partition(" ")
        return model, "unknown", version.removeprefix("Version").strip()

    def _read_axis(self, name: str) -> tuple[AxisMap, StageAxis]:
        options, number = self.axis_options[name], self._number(name)
        self._errors.clear()
        self._homed.discard(name)
        unit, size = _UNITS.get(round(self._value(name, "SN")), ("counts", math.nan))
        if not name.endswith(f"_{unit}"):
            kinds = {"um": "moves along a line", "mrad": "turns"}
            raise DeviceError(
                self.name,
                f"axis {number} {kinds.get(unit, 'counts in steps')}: it cannot be {name}.",
                "Name the axis that it is, or set its unit (SN) to millimetres or degrees.",
            )
        axis_map = AxisMap(name, f"axis {number}", -size if options.reverse else size)
        return axis_map, axis_map.stage_axis(
            self.name,
            options,
            ends=(self._value(name, "SL"), self._value(name, "SR")),
            speed_per_s=self._value(name, "VA"),
            resolution=self._value(name, "SU"),
        )

    def _axis_state(self, name: str) -> AxisState:
        moving = self._value(name, "MD") == 0
        said = self._heard_of(self._number(name))
        if said:  # whoever asked: the controller says it once, and this homing found no reference
            self._homing.pop(name, None)
        if self._came_home(name, moving=moving):
            self._homed.add(name)
        return AxisState(self._value(name, "TP"), moving, name in self._homed, ", ".join(said))

    def _send_move(self, name: str, place: float) -> None:
        self._enable(name)
        self._tell(name, f"PA{place:.6f}")

    def _send_home(self, name: str) -> None:
        self._enable(name)
        self._tell(name, "OR")

    def _enable(self, name: str) -> None:
        if self._value(name, "MO") == 0:
            self._tell(name, "MO")

    def _halt(self) -> None:
        self._homing.clear()
        numbers = [self._number(name) for name in self.axis_options]
        self._link.overtake("".join(f"{number}ST\r" for number in numbers).encode())

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may rest: a servo's dead band."""
        return max(1.01 * axis.resolution, _SETTLING[axis.unit])
