"""A stage of Newport SMC100 controllers on one chain (SMC100CC and SMC100PP, ASCII commands).

A command is the controller's number, two letters and a value: ``1PA1.5``; questions are answered with the
same letters: ``1TP1.49988``. Commands that set answer nothing: ``1TE`` says whether the last one was taken.
"""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from drivers.common.framing import reply_line
from drivers.common.port_stage import AxisState, PortOptions, PortStage, distinct
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.stage import StageAxis

_NUMBER = r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?"
_NOT_REFERENCED = frozenset(range(0x0A, 0x12)) | {0x14}
_HOMING = frozenset({0x1E, 0x1F})
_MOVING = frozenset({0x28, 0x46, 0x47})
_DISABLED = frozenset({0x3C, 0x3D, 0x3E})
_ERROR_BITS = (
    (0x0001, "negative end of run"),
    (0x0002, "positive end of run"),
    (0x0004, "peak current limit"),
    (0x0008, "RMS current limit"),
    (0x0010, "short circuit"),
    (0x0020, "following error"),
    (0x0040, "homing timed out"),
    (0x0080, "wrong ESP stage"),
    (0x0100, "DC voltage too low"),
    (0x0200, "80 W output power exceeded"),
)
_REFUSALS = {
    "A": "it does not know the command",
    "B": "its address is wrong",
    "C": "the value is missing or out of range",
    "D": "it cannot be done now",
    "E": "homing has already begun",
    "F": "it does not know its stage",
    "G": "the target is out of its limits",
    "H": "it is not referenced",
    "I": "it is being configured",
    "J": "it is disabled",
    "K": "it is ready already",
    "L": "it is homing",
    "M": "it is moving",
    "N": "it is beyond its software limits",
    "P": "it is tracking",
    "S": "communication timed out",
    "U": "its memory failed",
    "V": "the command failed",
    "W": "an SMC100PP does not know it",
    "X": "an SMC100CC does not know it",
}
_SETTLING = {"um": 1.0, "mrad": 0.05}


class Smc100Axis(AxisOptions):
    """One controller, in the unit its name ends in; it counts millimetres, or degrees."""

    number: int = Field(1, ge=1, le=31, description="Number of the controller on its chain.")


class Smc100Options(PortOptions):
    """SMC100 controllers over their ASCII protocol."""

    axes: dict[AxisName, Smc100Axis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which controller is which axis."
    )

    @model_validator(mode="after")
    def _numbers_differ(self) -> Self:
        distinct({name: axis.number for name, axis in self.axes.items()}, "controller")
        return self


class Smc100Stage(PortStage):
    """SMC100 controllers, moved together; homing of an axis that has its reference goes to its zero."""

    Options = Smc100Options
    driver = "smc100"
    vendor = "Newport"
    probed_axis = {"number": 1}  # noqa: RUF012

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        options = Smc100Options.of(options)
        self.axis_options = options.axes
        name = f"stage (smc100, {options.port})"
        super().__init__(options, SerialTransport(options.port, name, baud_rate=57_600))

    def _query(self, name: str, words: str, reply: str, question: str = "") -> str:
        """Ask a controller; returns what follows number and letters."""
        number = self.axis_options[name].number  # type: ignore[attr-defined]
        head = f"{number}{words}"
        matcher = reply_line(f"{head}({reply})".encode())
        return self._link.request(f"{head}{question}\r\n".encode(), matcher)[-1].decode("ascii")[len(head) :]

    def _value(self, name: str, words: str, question: str = "") -> float:
        return float(self._query(name, words, _NUMBER, question))

    def _tell(self, name: str, words: str) -> None:
        """Send a command, and ask whether it was taken.

        The controller keeps a refusal until it is asked: an older one, of a STOP at rest, is asked for first.

        Raises DeviceError with the controller's reason when it was not.
        """
        number = self.axis_options[name].number  # type: ignore[attr-defined]
        self._query(name, "TE", "[@A-Z]")
        self._link.send_now(f"{number}{words}\r\n".encode())
        refusal = self._query(name, "TE", "[@A-Z]")
        if refusal != "@":
            reason = _REFUSALS.get(refusal, "it says")
            raise DeviceError(self.name, f"controller {number} refuses {words!r}: {reason} ({refusal}).")

    def _status(self, name: str) -> tuple[int, int]:
        """Return the error bits and the state of an axis."""
        found = self._query(name, "TS", "[0-9A-F]{6}")
        return int(found[:4], 16), int(found[4:], 16)

    def _identify(self) -> tuple[str, str, str]:
        stages = [self._query(name, "ID", ".*", "?").strip() for name in self.axis_options]
        versions = dict.fromkeys(self._query(name, "VE", ".*").strip() for name in self.axis_options)
        return "SMC100 with " + " + ".join(stages), "unknown", ", ".join(versions)

    def _read_axis(self, name: str) -> tuple[AxisMap, StageAxis]:
        options = self.axis_options[name]
        assert isinstance(options, Smc100Axis)
        size = UM_PER_MM if name.endswith("_um") else MRAD_PER_DEG
        axis_map = AxisMap(name, f"controller {options.number}", -size if options.reverse else size)
        return axis_map, axis_map.stage_axis(
            self.name,
            options,
            ends=(self._value(name, "SL", "?"), self._value(name, "SR", "?")),
            speed_per_s=self._value(name, "VA", "?"),
            resolution=self._resolution(name),
        )

    def _resolution(self, name: str) -> float:
        """Return the smallest step: an encoder's, or a stepping motor's, whose SMC100PP has no SU."""
        try:
            return self._value(name, "SU", "?")
        except DeviceTimeoutError:  # a question that is refused is not answered
            return self._value(name, "FRS", "?") / self._value(name, "FRM", "?")

    def _axis_state(self, name: str) -> AxisState:
        errors, state = self._status(name)
        words = [text for bit, text in _ERROR_BITS if errors & bit]
        homing = state in _HOMING
        return AxisState(
            place=self._value(name, "TP"),
            moving=homing or state in _MOVING,
            homed=not homing and state not in _NOT_REFERENCED,
            fault=", ".join(words),
        )

    def _send_move(self, name: str, place: float) -> None:
        if self._status(name)[1] in _DISABLED:
            self._tell(name, "MM1")
        self._tell(name, f"PA{place:.6f}")

    def _send_home(self, name: str) -> None:
        if self._status(name)[1] in _NOT_REFERENCED:
            self._tell(name, "OR")
        else:
            self._send_move(name, 0.0)

    def _halt(self) -> None:
        numbers = [axis.number for axis in self.axis_options.values()]  # type: ignore[attr-defined]
        self._link.overtake("".join(f"{number}ST\r\n" for number in numbers).encode())

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may rest: a servo's dead band."""
        return max(1.01 * axis.resolution, _SETTLING[axis.unit])
