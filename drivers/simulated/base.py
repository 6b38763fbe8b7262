"""What all simulated devices share: opening, closing, identity, faults."""

from __future__ import annotations

from typing import ClassVar

from drivers.device import Device, DeviceIdentity, DriverOptions, SharedPart
from drivers.errors import DeviceNotOpenError
from drivers.simulated.surroundings import Surroundings
from drivers.simulated.world import SimulatedWorld

FIRMWARE = "1"


class SimulatedDevice(Device):
    """Mix-in for the simulated drivers; the interface's class comes second in the bases."""

    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    kind: ClassVar[str]
    model: ClassVar[str]
    world: Surroundings
    _is_open = False

    @classmethod
    def claims(cls, _options: DriverOptions) -> tuple[str, ...]:
        """Claim nothing: every program has a simulated world of its own."""
        return ()

    def _connect(self, shared: SharedPart | None) -> None:
        if not isinstance(shared, self.Shared):
            raise TypeError(
                f"{self.name} needs the bench's {self.Shared.__name__}, not {type(shared).__name__}."
            )
        self.world = shared

    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return f"{self.kind} (simulated)"

    @property
    def is_open(self) -> bool:
        """Whether the device is connected."""
        return self._is_open

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device says it is."""
        self._require()
        return DeviceIdentity(
            kind=self.kind,
            driver="simulated",
            vendor="diffuserbench",
            model=self._model(),
            serial_number=f"SIM-{self.world.options.seed}",
            firmware=FIRMWARE,
            simulated=True,
        )

    def _model(self) -> str:
        return self.model

    def _require(self) -> None:
        """Raise unless the device is open and plugged in."""
        if not self._is_open:
            raise DeviceNotOpenError(self.name)
        self.world.check_plugged(self.kind, self.name)
