"""A stage of Zaber axes on one serial port, and how its devices are asked."""

from __future__ import annotations

import itertools
import logging
import math
import threading
from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from drivers.common.framing import Belongs
from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import MRAD_PER_DEG, AxisMap, AxisName, AxisOptions
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, SharedPart, port_claim
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.registry.buses import lasting_name, serial_ports
from drivers.stage import StageAxis
from drivers.zaber.protocol import (
    FAULTS,
    NO_REFERENCE,
    REJECTIONS,
    SPEED_FACTOR,
    Message,
    command,
    flag_words,
    parse,
)

_NUMBERS = 100
_ATTEMPTS = 3
_REPLY_S = 0.5


class Chain(SerialTransport):
    """The devices behind one serial port.

    Every command carries a message number, so that no reply is taken for another's, and a checksum. A command
    whose reply is lost or damaged is sent again: all that are used here may be (absolute moves, settings).

    Parameters
    ----------
    port, device : str
        Serial port, and the stage as error messages name it.
    baud_rate : int
    """

    def __init__(self, port: str, device: str, baud_rate: int) -> None:
        super().__init__(port, device, baud_rate=baud_rate, timeout_s=_REPLY_S, on_message=self._unasked)
        self._numbers = itertools.cycle(range(_NUMBERS))
        self._counting = threading.Lock()
        self._checksummed: set[int] = set()
        """Devices that were told to send checksums: what comes without is torn."""

    def open(self) -> None:
        """Open the port."""
        self._checksummed.clear()
        super().open()

    def ask(self, text: str, device: int, axis: int = 0) -> Message:
        """Send a command to one device or axis and return its reply.

        Raises DeviceTimeoutError when no whole reply came; DeviceError when the device rejects the command
        (with its reason in words), or the port failed.
        """
        for attempt in range(_ATTEMPTS):
            with self._counting:
                number = next(self._numbers)
            try:
                reply = self._ask_once(text, device, axis, number)
            except DeviceTimeoutError as error:
                if attempt == _ATTEMPTS - 1:
                    raise DeviceTimeoutError(
                        self.device,
                        f"device {device} did not answer {text!r} on {self.port}.",
                        "Check its power, the cable, its number and the baud rate (Zaber's software shows "
                        "both).",
                    ) from error
                _log.info("%s: no whole answer to %r, asking again", self.device, text)
                continue
            if reply.accepted:
                return reply
            reason = REJECTIONS.get(reply.data.split(" ")[0], "")
            raise DeviceError(
                self.device,
                f"device {device} axis {axis} rejects {text!r}: {reason or 'it says'} ({reply.data})"
                + (f"; {flag_words(reply.flag)}." if reply.flag != "--" else "."),
            )
        raise AssertionError("unreachable")

    def number(self, text: str, device: int, axis: int = 0) -> float:
        """Ask for one number; errors as ``ask``, and when the answer is none."""
        return _number(self.device, text, self.ask(text, device, axis).data)

    def have_checksums(self, device: int) -> bool:
        """Have a device send checksums from now on; return whether it did before.

        Raises DeviceError when its firmware cannot.
        """
        before = self.number("get comm.checksum", device) != 0
        if not before:
            self.ask("set comm.checksum 1", device)
        self._checksummed.add(device)
        return before

    def no_checksums(self, device: int) -> None:
        """Have a device send no checksums, as it was found."""
        self._checksummed.discard(device)
        self.ask("set comm.checksum 0", device)

    def stop(self) -> None:
        """Stop every axis of every device at once, whatever reply is awaited; callable from any thread."""
        self.send_now(command("stop"))

    def _ask_once(self, text: str, device: int, axis: int, number: int) -> Message:
        def judge(line: bytes) -> Belongs:
            message = self._parsed(line)
            if message is None or (message.kind, message.device, message.number) != ("@", device, number):
                return Belongs.OTHER
            return Belongs.END

        lines = self.request(command(text, device, axis, number), judge)
        message = self._parsed(lines[-1])
        if message is None:
            raise AssertionError("a reply that was matched can be parsed")
        return message

    def _parsed(self, line: bytes) -> Message | None:
        message = parse(line)
        if message is not None and message.device in self._checksummed:
            return parse(line, need_checksum=True)
        return message

    def _unasked(self, line: bytes) -> None:
        """Take note of alerts, of replies to STOP and of garbage."""
        message = self._parsed(line)
        if message is None:
            _log.info("%s: sent %r, which is no message", self.device, line[:80])
        elif message.flag != "--":
            level = logging.WARNING if message.flag in FAULTS else logging.INFO
            _log.log(level, "%s: device %d: %s", self.device, message.device, flag_words(message.flag))


def _number(device: str, text: str, data: str) -> float:
    try:
        return float(data)
    except ValueError:
        raise DeviceError(device, f"answers {data!r} to {text!r}; a number is expected.") from None


_log = logging.getLogger(__name__)
_SETTLING_UM = 1.0
_SETTLING_MRAD = 0.02


class ZaberAxis(AxisOptions):
    """One axis of a Zaber device, in the unit its name ends in."""

    device: int = Field(1, ge=1, le=99, description="Number of the device on the chain.")
    axis: int = Field(1, ge=1, le=9, description="Number of the axis on the device.")
    microstep_um: float | None = Field(
        None, gt=0, description="Size of a microstep (product page), of an axis in micrometres."
    )
    microstep_deg: float | None = Field(
        None, gt=0, description="Size of a microstep (product page), degrees, of an axis in milliradians."
    )
    speed_per_s: float | None = Field(
        None, gt=0, description="Speed of moves, units a second; left out: as set in the device."
    )

    def axis_map(self, name: str) -> AxisMap:
        """Return how microsteps become the bench's unit."""
        size = self.microstep_um if name.endswith("_um") else (self.microstep_deg or 0.0) * MRAD_PER_DEG
        label = f"device {self.device} axis {self.axis}"
        return AxisMap(name, label, -(size or 0.0) if self.reverse else (size or 0.0))


class ZaberOptions(DriverOptions):
    """Zaber devices over the ASCII protocol."""

    port: str = Field(min_length=1, description='Serial port, e.g. "/dev/ttyUSB0".')
    baud_rate: int = Field(115_200, ge=9600, description="As set in the devices; 115200 unless changed.")
    axes: dict[AxisName, ZaberAxis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which axis of which device is which."
    )

    @model_validator(mode="after")
    def _axes_make_sense(self) -> Self:
        places: dict[tuple[int, int], str] = {}
        for name, axis in self.axes.items():
            wanted, other = ("microstep_um", "microstep_deg")[:: 1 if name.endswith("_um") else -1]
            if getattr(axis, wanted) is None or getattr(axis, other) is not None:
                raise ValueError(f"axes.{name} needs {wanted} (the product page says it), and not {other}")
            place = (axis.device, axis.axis)
            if place in places:
                raise ValueError(
                    f"axes.{name} and axes.{places[place]} are both device {place[0]} axis {place[1]}"
                )
            places[place] = name
        return self


class ZaberStage(PolledStage):
    """Axes of one or several Zaber devices on one chain, moved together.

    On opening, checksums are asked of every device (and put back on closing), limits and speeds are read.
    Faults (stall, driver disabled, encoder) end moves with an error in words; after a stall the stage must be
    homed again.
    """

    Options = ZaberOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = options = ZaberOptions.of(options)
        self._maps = {name: axis.axis_map(name) for name, axis in options.axes.items()}
        self._chain = Chain(options.port, self.name, options.baud_rate)
        self._without_checksums: set[int] = set()
        """Devices that were found without and have not been put back, over lost connections too."""
        self._lost_reference: set[str] = set()

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the serial port."""
        return (port_claim(ZaberOptions.of(options).port),)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the serial ports whose USB device says that Zaber made it."""
        return tuple(
            _found(port.address, port.description, port.serial_number, port.usb_id)
            for port in serial_ports()
            if "zaber" in port.vendor.lower()
        )

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Ask whether a Zaber device answers at 115200 baud."""
        chain = Chain(port, f"port {port}", 115_200)
        chain.open()
        try:
            device_id = chain.number("get deviceid", 1)
        except DeviceError:
            return None
        finally:
            chain.close()
        return _found(port, f"Zaber device {device_id:.0f}")

    @property
    def name(self) -> str:
        """The stage as error messages name it."""
        return f"stage (zaber, {self.options.port})"

    # The protocol ----------------------------------------------------------------------------------
    @property
    def _is_connected(self) -> bool:
        return self._chain.is_open

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._chain.open()
        devices = sorted({axis.device for axis in self.options.axes.values()})
        for device in devices:
            if not self._chain.have_checksums(device):
                self._without_checksums.add(device)
        axes = tuple(self._axis(name, axis) for name, axis in self.options.axes.items())
        return self._identify(devices), axes

    def _disconnect(self) -> None:
        if self._chain.is_open:
            for device in sorted(self._without_checksums):
                try:
                    self._chain.no_checksums(device)
                except DeviceError as error:
                    _log.warning("%s: device %d goes on sending checksums: %s", self.name, device, error)
                else:
                    self._without_checksums.remove(device)
        self._chain.close()

    def _identify(self, devices: list[int]) -> DeviceIdentity:
        def all_of(setting: str) -> str:
            return " + ".join(self._chain.ask(f"get {setting}", device).data for device in devices)

        return DeviceIdentity(
            kind="stage",
            driver="zaber",
            vendor="Zaber",
            model=f"device {all_of('deviceid')}",
            serial_number=all_of("system.serial"),
            firmware=all_of("version"),
            simulated=False,
        )

    def _axis(self, name: str, axis: ZaberAxis) -> StageAxis:
        where = (axis.device, axis.axis)
        if axis.speed_per_s is not None:
            self._set_speed(name, axis, axis.speed_per_s)
        return self._maps[name].stage_axis(
            self.name,
            axis,
            ends=(self._chain.number("get limit.min", *where), self._chain.number("get limit.max", *where)),
            speed_per_s=self._chain.number("get maxspeed", *where) / SPEED_FACTOR,
            resolution=1.0,
        )

    def _set_speed(self, name: str, axis: ZaberAxis, speed_per_s: float) -> None:
        """Set the speed unless it is set already: the device keeps it for good, and its memory wears."""
        where = (axis.device, axis.axis)
        wanted = round(abs(self._maps[name].to_controller(speed_per_s)) * SPEED_FACTOR)
        if self._chain.number("get maxspeed", *where) == wanted:
            return
        try:
            self._chain.ask(f"set maxspeed {wanted}", *where)
        except DeviceError as error:
            error.add_note(f"The speed is speed_per_s = {speed_per_s:g} of [stage.axes.{name}].")
            raise

    def _state(self) -> StageState:
        position, moving, homed, faults = {}, False, True, []
        for name, axis in self.options.axes.items():
            reply = self._chain.ask("get pos", axis.device, axis.axis)
            steps = _integer(reply.data)
            if steps is None:
                raise DeviceError(self.name, f"{self._maps[name].label} says it is at {reply.data!r}.")
            position[name] = self._maps[name].to_bench(steps)
            moving |= reply.busy
            flags = self._flags(axis) if reply.flag != "--" else frozenset[str]()
            homed &= not flags & NO_REFERENCE
            if serious := sorted(flags & FAULTS.keys()):
                self._lost_reference.add(name)
                faults.append(f"{name} ({self._maps[name].label}): {', '.join(map(flag_words, serious))}")
        return StageState(position, moving, homed and not self._lost_reference, tuple(faults))

    def _flags(self, axis: ZaberAxis) -> frozenset[str]:
        """Return all flags of an axis; a reply carries only the most serious."""
        return frozenset(self._chain.ask("warnings", axis.device, axis.axis).data.split()[1:])

    def _start(self, target: Mapping[str, float]) -> None:
        for name, place in target.items():
            axis = self.options.axes[name]
            steps = math.floor(self._maps[name].to_controller(place) + 0.5)
            self._chain.ask(f"move abs {steps}", axis.device, axis.axis)

    def _start_homing(self) -> None:
        for axis in self.options.axes.values():
            self._chain.ask("warnings clear", axis.device, axis.axis)
            self._chain.ask("home", axis.device, axis.axis)
        self._lost_reference.clear()

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may rest: steppers are exact, direct drives settle."""
        return max(1.01 * axis.resolution, _SETTLING_UM if axis.unit == "um" else _SETTLING_MRAD)

    def _halt(self) -> None:
        self._chain.stop()


def _integer(data: str) -> int | None:
    try:
        return int(data)
    except ValueError:
        return None


def _found(port: str, description: str, serial_number: str = "", usb_id: str = "") -> FoundDevice:
    """Return a device with options that lack one thing, which checking ``bench.toml`` then asks for."""
    axes = {"x_um": {"device": 1, "axis": 1, "microstep_um": 0.0}}
    return FoundDevice(
        bus="serial",
        address=port,
        description=description,
        vendor="Zaber",
        serial_number=serial_number,
        usb_id=usb_id,
        driver="zaber",
        kind="stage",
        options={"port": lasting_name(port), "axes": axes},
        note="fill in microstep_um (the stage's product page says it), and add the other axes like this one",
    )
