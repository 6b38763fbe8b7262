"""pylon: loaded when asked for; its cameras, and their features by name, errors in words."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from drivers.device import DeviceIdentity, FoundDevice
from drivers.errors import DeviceError, DeviceLostError
from drivers.genicam.features import FIRMWARE, FeatureKind, Features
from drivers.registry.claim import DeviceBusyError

_REMEDY = 'pip install "diffuserbench[basler]"; see docs/how-to/devices/basler.md.'
_MISSING = "Is it on, connected, and in this computer's subnet? pylon Viewer shows what pylon finds."
_EMULATED = "BaslerCamEmu"
GIGE = "BaslerGigE"
"""Device class of GigE Vision cameras."""


def load(device: str) -> Any:
    """Return the library's module ``pypylon.pylon``.

    Parameters
    ----------
    device : str
        Who asks, for the error.

    Raises DeviceError when it is not installed.
    """
    try:
        # Its import warns of its own types; where warnings are errors that would crash the process.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from pypylon import pylon
    except ImportError as error:
        raise DeviceError(device, f"pypylon cannot be loaded ({error}).", _REMEDY) from error
    return pylon


def find_camera(pylon: Any, device: str, serial_number: str | None) -> Any:
    """Return the library's camera of a serial number; of None the only one there is.

    Raises DeviceError when it is not found, or there are several; DeviceBusyError when another program has
    it.
    """
    factory = pylon.TlFactory.GetInstance()
    there = {info.GetSerialNumber(): info for info in factory.EnumerateDevices()}
    if serial_number is None and len(there) == 1:
        serial_number = next(iter(there))
    if serial_number is None or serial_number not in there:
        found = f"{', '.join(sorted(there)) or 'none'}"
        if serial_number is None:
            raise DeviceError(
                device,
                f"{len(there)} Basler cameras were found: {found}.",
                "Name one by serial_number." if there else _MISSING,
            )
        raise DeviceError(device, f"was not found; found: {found}.", _MISSING)
    camera = pylon.InstantCamera()
    try:
        camera.Attach(factory.CreateDevice(there[serial_number]))
        camera.Open()
    except _error() as error:
        if not factory.IsDeviceAccessible(there[serial_number]):
            raise DeviceBusyError(device, "is controlled by another program.", "Close that one.") from error
        raise DeviceError(device, f"cannot be opened: {_said(error)}.", _MISSING) from error
    return camera


def found_cameras() -> tuple[FoundDevice, ...]:
    """Return the Basler cameras on the network and on USB.

    Raises DeviceError when pypylon is not installed.
    """
    factory = load("Basler").TlFactory.GetInstance()
    return tuple(
        FoundDevice(
            bus="GenICam",
            address=info.GetFriendlyName(),
            description=f"Basler {info.GetModelName()} ({info.GetDeviceClass()})",
            vendor="Basler",
            product=info.GetModelName(),
            serial_number=info.GetSerialNumber(),
            driver="basler",
            kind="camera",
            options={"serial_number": info.GetSerialNumber()},
            note="pixel_pitch_um = (micrometres, if the camera does not say it: its data sheet does)",
        )
        for info in factory.EnumerateDevices()
    )


def identity_of(camera: Any, features: Features) -> DeviceIdentity:
    """Return who an open camera says it is."""
    info = camera.GetDeviceInfo()
    firmware = features.find(*FIRMWARE)
    return DeviceIdentity(
        kind="camera",
        driver="basler",
        vendor=info.GetVendorName() or "Basler",
        model=info.GetModelName(),
        serial_number=info.GetSerialNumber(),
        firmware=features.text(firmware) if firmware else "",
        simulated=info.GetDeviceClass() == _EMULATED,
    )


class PylonFeatures(Features):
    """Features through pylon.

    Parameters
    ----------
    camera
        The library's open camera.
    name : str
        The device as error messages name it.
    on_lost : callable
        Called with the error when the device turns out to be gone.
    """

    listed_by = "pylon Viewer"

    def __init__(self, camera: Any, name: str, on_lost: Callable[[DeviceLostError], None]) -> None:
        super().__init__(name)
        from pypylon import genicam

        self._genicam: Any = genicam
        self._camera = camera
        self._nodes = camera.GetNodeMap()
        self._on_lost = on_lost

    @contextlib.contextmanager
    def words(self, doing: str) -> Iterator[None]:
        """Turn the library's errors into DeviceError: "it did not ``doing``"."""
        try:
            yield
        except _error() as error:
            self.raise_if_removed(error)
            raise DeviceError(self.name, f"did not {doing}: {_said(error)}.") from error

    def raise_if_removed(self, error: Exception | None = None) -> None:
        """Raise DeviceLostError when the camera is gone."""
        if self._camera.IsCameraDeviceRemoved():
            lost = DeviceLostError(
                self.name,
                "is gone: unplugged or switched off.",
                "Check cable and power, then open it again.",
            )
            self._on_lost(lost)
            raise lost from error

    def find(self, *names: str) -> str | None:
        """Return the first of some names that the camera has now; None when it has none of them."""
        with self.words(f"say whether it has {names[0]}"):
            return next(
                (name for name in names if self._genicam.IsAvailable(self._nodes.GetNode(name))), None
            )

    def kind(self, name: str) -> FeatureKind | None:
        """Return what a feature is."""
        if self.find(name) is None:
            return None
        genicam = self._genicam
        kinds: dict[int, FeatureKind] = {
            genicam.intfIEnumeration: "choice",
            genicam.intfICommand: "command",
            genicam.intfIBoolean: "switch",
            genicam.intfIFloat: "number",
            genicam.intfIInteger: "number",
        }
        return kinds.get(self._interface(name), "text")

    def _interface(self, name: str) -> int:
        return int(self._nodes.GetNode(name).Node.GetPrincipalInterfaceType())

    def number(self, name: str) -> float:
        """Read a whole or real number."""
        with self.words(f"say its {name}"):
            return float(self._nodes.GetNode(name).GetValue())

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the smallest and largest value that a number takes now."""
        with self.words(f"say the limits of its {name}"):
            node = self._nodes.GetNode(name)
            return float(node.GetMin()), float(node.GetMax())

    def increment(self, name: str) -> int:
        """Return the steps of a whole number; 0 of a real one."""
        with self.words(f"say the steps of its {name}"):
            if self._interface(name) != self._genicam.intfIInteger:
                return 0
            return max(1, int(self._nodes.GetNode(name).GetInc()))

    def _write_number(self, name: str, value: float) -> None:
        whole = self._interface(name) == self._genicam.intfIInteger
        self._nodes.GetNode(name).SetValue(int(value) if whole else float(value))

    def unit(self, name: str) -> str:
        """Return the unit that the camera's description gives a number; empty where it gives none."""
        return str(self._nodes.GetNode(name).GetUnit())

    def text(self, name: str) -> str:
        """Read a feature of any kind as text."""
        with self.words(f"say its {name}"):
            return str(self._nodes.GetNode(name).ToString())

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries that an enumeration offers now."""
        with self.words(f"say what its {name} offers"):
            return tuple(self._nodes.GetNode(name).Symbolics)

    def _write_text(self, name: str, value: str) -> None:
        self._nodes.GetNode(name).FromString(value)

    def _write_switch(self, name: str, value: bool) -> None:
        self._nodes.GetNode(name).SetValue(value)

    def _execute(self, name: str) -> None:
        self._nodes.GetNode(name).Execute()


def _error() -> type[Exception]:
    """Return the exception that pylon's calls end with; only after :func:`load`."""
    from pypylon import genicam

    error: type[Exception] = genicam.GenericException
    return error


def _said(error: Exception) -> str:
    """Return the library's own words, without where in its source they were said."""
    return str(error).split(" : ")[0].strip().rstrip(".")
