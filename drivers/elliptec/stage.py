"""A stage of Thorlabs Elliptec modules on one bus (ELLx protocol).

A command is an address (0 to F), two letters and hexadecimal digits: ``0ma00001000``. A module answers with
its address and two capital letters: ``0PO00001000`` (a place) or ``0GS09`` (a status: busy). It answers to a
move when the move has ended, unasked.
"""

from __future__ import annotations

import re
from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.common.framing import reply_line
from drivers.common.port_stage import AxisState, PortOptions, PortStage, distinct
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError
from drivers.stage import StageAxis

_BUSY = 9
_STATUS = {
    1: "communication timed out",
    2: "it did not reach its place in time (blocked, or too heavy a load)",
    3: "it does not know the command",
    4: "the value is out of its range",
    5: "it is isolated",
    7: "it did not initialise",
    8: "it is too hot",
    10: "its sensor failed",
    11: "its motor failed",
    12: "out of its range",
    13: "too much current",
}
_ROTARY = frozenset({8, 14, 16, 18, 21, 22})
"""Types that turn: their pulses are counted for a whole turn."""
_SPEED = {"um": 60_000.0, "mrad": 5_000.0}
"""Roughly, of a resonant motor, which has no speed to set."""
_SETTLING = {"um": 10.0, "mrad": 1.0}


class ElliptecAxis(AxisOptions):
    """One module, in the unit its name ends in."""

    address: Annotated[str, Field(pattern="^[0-9A-F]$")] = Field(
        "0", description="Address of the module on its bus, 0 to F."
    )


class ElliptecOptions(PortOptions):
    """Elliptec modules over their serial protocol."""

    axes: dict[AxisName, ElliptecAxis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which module is which axis."
    )

    @model_validator(mode="after")
    def _addresses_differ(self) -> Self:
        distinct({name: axis.address for name, axis in self.axes.items()}, "address")
        return self


class ElliptecStage(PortStage):
    """Elliptec modules, moved together. They know no speed, and their reference only once they were homed."""

    Options = ElliptecOptions
    driver = "elliptec"
    vendor = "Thorlabs"
    probed_axis = {"address": "0"}  # noqa: RUF012

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        options = ElliptecOptions.of(options)
        self.axis_options = options.axes
        name = f"stage (elliptec, {options.port})"
        link = SerialTransport(options.port, name, baud_rate=9600, on_message=self._unasked)
        super().__init__(options, link)
        self._faults: dict[str, str] = {}

    def _query(self, address: str, words: str, reply: str) -> str:
        """Send a command to a module; returns what follows the letters of its reply."""
        matcher = reply_line(f"{address}{reply}".encode())
        return self._link.request(f"{address}{words}".encode(), matcher)[-1].decode("ascii")[1:]

    def _information(self, address: str) -> tuple[int, str, str, int, int]:
        """Return type, serial number, firmware, travel (mm, degrees) and pulses in a millimetre or a turn."""
        found = re.fullmatch(
            r"IN(?P<kind>..)(?P<serial>.{8})(?P<year>.{4})(?P<firmware>..)(?P<hardware>..)"
            r"(?P<travel>.{4})(?P<pulses>.{8})",
            self._query(address, "in", "IN.{30}"),
        )
        assert found is not None, "the matcher lets nothing else through"
        try:
            kind, travel, pulses = (int(found[part], 16) for part in ("kind", "travel", "pulses"))
        except ValueError:
            raise DeviceError(self.name, f"module {address} describes itself as {found[0]!r}.") from None
        return kind, found["serial"], found["firmware"], travel, pulses

    def _identify(self) -> tuple[str, str, str]:
        found = [self._information(axis.address) for axis in self.axis_options.values()]  # type: ignore[attr-defined]
        return (
            " + ".join(f"ELL{kind}" for kind, *_ in found),
            " + ".join(serial for _, serial, *_ in found),
            " + ".join(firmware for *_, firmware, _, _ in found),
        )

    def _read_axis(self, name: str) -> tuple[AxisMap, StageAxis]:
        options = self.axis_options[name]
        assert isinstance(options, ElliptecAxis)
        self._homed.discard(name)
        kind, _, _, travel, pulses = self._information(options.address)
        turns = kind in _ROTARY
        if turns != name.endswith("_mrad") or pulses <= 0:
            raise DeviceError(
                self.name,
                f"module {options.address} is an ELL{kind}, which {'turns' if turns else 'does not turn'} "
                f"({pulses} pulses), and cannot be {name}.",
                "Give it an axis of its kind.",
            )
        per_unit = pulses / 360 if turns else pulses
        scale = (MRAD_PER_DEG if turns else UM_PER_MM) / per_unit
        axis_map = AxisMap(name, f"module {options.address}", -scale if options.reverse else scale)
        return axis_map, axis_map.stage_axis(
            self.name,
            options,
            ends=(0.0, travel * per_unit),
            speed_per_s=_SPEED[name.rsplit("_", 1)[-1]] / scale,
            resolution=1.0,
        )

    def _axis_state(self, name: str) -> AxisState:
        address = self._maps[name].label[-1]
        moving = self._note(address, self._query(address, "gs", "GS[0-9A-F]{2}"))
        reply = self._query(address, "gp", "(PO[0-9A-F]{8}|GS[0-9A-F]{2})")
        if reply.startswith("GS"):  # some firmware tells no place while it moves; or a move failed just now
            self._note(address, reply)
            return AxisState(self._last(name), True, name in self._homed, self._faults.get(name, ""))
        if self._came_home(name, moving=moving) and name not in self._faults:
            self._homed.add(name)
        place = int(reply[2:], 16)
        return AxisState(
            place - (1 << 32 if place >> 31 else 0), moving, name in self._homed, self._faults.get(name, "")
        )

    def _last(self, name: str) -> float:
        return self._maps[name].to_controller(self._commanded.get(name, 0.0))

    def _send_move(self, name: str, place: float) -> None:
        self._faults.pop(name, None)
        address = self._maps[name].label[-1]
        self._link.send_now(f"{address}ma{round(place) & 0xFFFFFFFF:08X}".encode())

    def _send_home(self, name: str) -> None:
        self._faults.pop(name, None)
        self._link.send_now(f"{self._maps[name].label[-1]}ho0".encode())

    def _halt(self) -> None:
        self._homing.clear()
        addresses = [axis.address for axis in self.axis_options.values()]  # type: ignore[attr-defined]
        self._link.overtake("".join(f"{address}st" for address in addresses).encode(), answered=True)

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may rest: the motors settle within microns."""
        return max(1.01 * axis.resolution, _SETTLING[axis.unit])

    def _unasked(self, line: bytes) -> None:
        """Keep the failure that a move ended with."""
        if re.fullmatch(rb"[0-9A-F]GS[0-9A-F]{2}", line):
            self._note(chr(line[0]), line[1:].decode())

    def _note(self, address: str, reply: str) -> bool:
        """Keep the failure that a status says, until the next move; returns whether the module is busy."""
        status = int(reply[2:], 16)
        if status not in (0, _BUSY):
            for name, axis_map in self._maps.items():
                if axis_map.label[-1] == address:
                    self._faults[name] = f"{_STATUS.get(status, 'unknown status')} (status {status})"
        return status == _BUSY
