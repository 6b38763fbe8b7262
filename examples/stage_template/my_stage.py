"""A stage with one axis behind a serial port: copy this, change the protocol, run the tests.

Its controller takes lines and counts in steps:

    V       MYSTAGE 1.0 SN123       who it is, its version, its serial number
    ?       IDLE 1 20000            IDLE or MOVE or FAULT, whether it was homed, where it is
    L       0 50000 4000            its ends, and its speed in steps a second
    G 1234  OK                      go there
    H       OK                      find the reference
    !                               stop at once; no answer
"""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from drivers.common.framing import reply_line
from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.serial_transport import SerialTransport
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, SharedPart, port_claim
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.stage import StageAxis

WHO = (b"V\n", reply_line(rb"MYSTAGE [\d.]+ \S+"))


class MyStageOptions(DriverOptions):
    """The keys of [stage] in bench.toml, beside driver = "my_stage"; units are in their names."""

    port: str = Field(min_length=1, description='Serial port, e.g. "/dev/ttyUSB0".')
    um_per_step: float = Field(0.5, gt=0, description="Travel of one step.")


class MyStage(PolledStage):
    """What is particular to this controller; ``PolledStage`` moves, waits, stops and checks."""

    Options = MyStageOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        assert isinstance(options, MyStageOptions)
        self.options = options
        # The probe is a command without effect: after a time-out it tells late replies from new ones.
        self._port = SerialTransport(options.port, self.name, baud_rate=115_200, probe=WHO)

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Only one program at a time may have the port."""
        assert isinstance(options, MyStageOptions)
        return (port_claim(options.port),)

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Recognise the controller for ``diffuserbench devices --probe``."""
        transport = SerialTransport(port, "my stage", baud_rate=115_200)
        transport.open()
        try:
            _, version, serial_number = _words(transport.request(*WHO, timeout_s=0.5))
        except DeviceTimeoutError:
            return None
        finally:
            transport.close()
        return FoundDevice(
            "serial",
            port,
            f"my stage, version {version}",
            serial_number=serial_number,
            driver="my_stage",
            kind="stage",
            options={"port": port},
        )

    @property
    def name(self) -> str:
        """How errors name it: the kind, the driver, the port."""
        return f"stage (my_stage, {self.options.port})"

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._port.open()
        _, version, serial_number = _words(self._port.request(*WHO))
        low, high, speed = map(int, _words(self._port.request(b"L\n", reply_line(rb"-?\d+ -?\d+ \d+"))))
        um = self.options.um_per_step
        axis = StageAxis("x_um", low * um, high * um, speed * um, resolution=um)
        identity = DeviceIdentity(
            kind="stage",
            driver="my_stage",
            vendor="me",
            model="my stage",
            serial_number=serial_number,
            firmware=version,
            simulated=False,
        )
        return identity, (axis,)

    def _disconnect(self) -> None:
        self._port.close()

    @property
    def _is_connected(self) -> bool:
        return self._port.is_open

    def _state(self) -> StageState:
        state, homed, steps = _words(self._port.request(b"?\n", reply_line(rb"(IDLE|MOVE|FAULT) [01] -?\d+")))
        if state == "FAULT":
            raise DeviceError(self.name, "reports a fault.", "Free the axis and switch it off and on.")
        return StageState({"x_um": int(steps) * self.options.um_per_step}, state == "MOVE", homed == "1")

    def _start(self, target: Mapping[str, float]) -> None:
        for position_um in target.values():
            steps = round(position_um / self.options.um_per_step)
            self._port.request(b"G %d\n" % steps, reply_line(rb"OK"))

    def _start_homing(self) -> None:
        self._port.request(b"H\n", reply_line(rb"OK"))

    def _halt(self) -> None:
        self._port.overtake(b"!\n")  # ahead of whatever waits for its reply


def _words(reply: list[bytes]) -> list[str]:
    return reply[-1].decode("ascii").split()
