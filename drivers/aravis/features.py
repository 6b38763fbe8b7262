"""The Aravis library: loaded when asked for; its cameras and their features by name, errors in words."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from drivers.common.drops import FrameNumberCounter
from drivers.device import DeviceIdentity, FoundDevice
from drivers.errors import DeviceError, DeviceLostError
from drivers.genicam.features import FIRMWARE, FeatureKind, Features

REMEDY = (
    "Debian: sudo apt install gir1.2-aravis-0.8 python3-gi, then .ci/link-gi; see "
    "docs/how-to/devices/aravis.md. "
    'Elsewhere: Aravis 0.8, and pip install "diffuserbench[aravis]".'
)
FAKE_PREFIX = "Fake_"
"""Ids of the cameras that Aravis itself makes up, for tests."""

_FAKES = {("Aravis", "Fake"), ("vitavision.dev", "VivaCam Fake")}
_MISSING = "Is it on, connected, and in this computer's subnet? arv-tool-0.8 lists what Aravis finds."

_lock = threading.Lock()


def load(device: str) -> Any:
    """Return Aravis' namespace.

    Parameters
    ----------
    device : str
        Who asks, for the error.

    Raises DeviceError when PyGObject or Aravis is not installed, saying which.
    """
    with _lock:
        try:
            import gi
        except ImportError as error:
            raise DeviceError(device, f"PyGObject cannot be loaded ({error}).", REMEDY) from error
        try:
            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis
        except (ValueError, ImportError) as error:
            raise DeviceError(device, f"Aravis 0.8 cannot be loaded ({error}).", REMEDY) from error
        return Aravis


def library_error() -> type[Exception]:
    """Return the exception that Aravis' calls end with; only after :func:`load`."""
    from gi.repository import GLib

    error: type[Exception] = GLib.Error
    return error


def find_camera(aravis: Any, device: str, wanted: str | None) -> Any:
    """Return the library's camera of an id or network address; of None the only one there is.

    Raises DeviceError when it is not found, or there are several.
    """
    if wanted is not None and wanted.startswith(FAKE_PREFIX):
        aravis.enable_interface("Fake")
    if wanted is None:
        aravis.update_device_list()
        ids = [aravis.get_device_id(i) for i in range(aravis.get_n_devices())]
        if len(ids) != 1:
            raise DeviceError(
                device,
                f"{len(ids)} GenICam cameras were found{': ' if ids else ''}{', '.join(ids)}.",
                "Name one by device_id." if ids else _MISSING,
            )
        wanted = ids[0]
    try:
        return aravis.Camera.new(wanted)
    except library_error() as error:
        message = error.message  # type: ignore[attr-defined]
        raise DeviceError(device, f"was not found: {message}.", _MISSING) from error


def found_cameras() -> tuple[FoundDevice, ...]:
    """Return the GenICam cameras on the network and on USB."""
    aravis = load("GenICam")
    aravis.update_device_list()
    found = []
    for i in range(aravis.get_n_devices()):
        vendor, model = aravis.get_device_vendor(i) or "", aravis.get_device_model(i) or ""
        found.append(
            FoundDevice(
                bus="GenICam",
                address=aravis.get_device_address(i) or aravis.get_device_id(i),
                description=f"{vendor} {model} ({aravis.get_device_protocol(i)})",
                vendor=vendor,
                product=model,
                serial_number=aravis.get_device_serial_nbr(i) or "",
                driver="aravis",
                kind="camera",
                options={"device_id": aravis.get_device_id(i)},
                note="pixel_pitch_um = (micrometres, if the camera does not say it: its data sheet does)",
            )
        )
    return tuple(found)


class AravisFeatures(Features):
    """Features through Aravis.

    Parameters
    ----------
    aravis
        The library's namespace.
    device
        Its device.
    name : str
        The device as error messages name it.
    on_lost : callable
        Called with the error when the device turns out to be gone.
    """

    listed_by = "arv-tool-0.8 --name DEVICE_ID features"

    def __init__(
        self, aravis: Any, device: Any, name: str, on_lost: Callable[[DeviceLostError], None]
    ) -> None:
        super().__init__(name)
        self._aravis = aravis
        self._device = device
        self._error = library_error()
        self._on_lost = on_lost

    @contextlib.contextmanager
    def words(self, doing: str) -> Iterator[None]:
        """Turn the library's errors into DeviceError: "it did not ``doing``"."""
        try:
            yield
        except self._error as error:
            raise self._in_words(error, doing) from error

    def _in_words(self, error: Any, doing: str) -> DeviceError:
        codes = self._aravis.DeviceError
        here = error.domain == "arv-device-error-quark"
        if here and error.code in (
            codes.TIMEOUT,
            codes.NOT_CONNECTED,
            codes.TRANSFER_ERROR,
            codes.NOT_CONTROLLER,
        ):
            lost = DeviceLostError(
                self.name,
                f"does not answer any more ({error.message}).",
                "Check cable and power; another program may have taken it over. Then open it again.",
            )
            self._on_lost(lost)
            return lost
        if here and error.code == codes.PROTOCOL_ERROR_ACCESS_DENIED:
            return DeviceError(
                self.name,
                f"did not {doing}: access denied ({error.message}).",
                "Another program controls it: close that one.",
            )
        return DeviceError(self.name, f"did not {doing}: {error.message}.")

    def find(self, *names: str) -> str | None:
        """Return the first of some names that the camera has now; None when it has none of them."""
        for name in names:
            try:
                if self._device.get_feature(name) is not None and self._device.is_feature_available(name):
                    return name
            except self._error as error:
                lost = self._in_words(error, f"say whether it has {name}")
                if isinstance(lost, DeviceLostError):
                    raise lost from error
        return None

    def kind(self, name: str) -> FeatureKind | None:
        """Return what a feature is."""
        node, aravis = self._device.get_feature(name), self._aravis
        if node is None:
            return None
        kinds: tuple[tuple[Any, FeatureKind], ...] = (
            (aravis.GcEnumeration, "choice"),
            (aravis.GcCommand, "command"),
            (aravis.GcBoolean, "switch"),
            (aravis.GcFloat | aravis.GcInteger, "number"),
        )
        return next((kind for node_type, kind in kinds if isinstance(node, node_type)), "text")

    def _is_float(self, name: str) -> bool:
        return isinstance(self._device.get_feature(name), self._aravis.GcFloat)

    def number(self, name: str) -> float:
        """Read a whole or real number."""
        with self.words(f"say its {name}"):
            if self._is_float(name):
                return float(self._device.get_float_feature_value(name))
            return float(self._device.get_integer_feature_value(name))

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the smallest and largest value that a number takes now."""
        with self.words(f"say the limits of its {name}"):
            if self._is_float(name):
                low, high = self._device.get_float_feature_bounds(name)
            else:
                low, high = self._device.get_integer_feature_bounds(name)
        return float(low), float(high)

    def increment(self, name: str) -> int:
        """Return the steps of a whole number; 0 of a real one."""
        if self._is_float(name):
            return 0
        with self.words(f"say the steps of its {name}"):
            return max(1, int(self._device.get_integer_feature_increment(name)))

    def _write_number(self, name: str, value: float) -> None:
        if self._is_float(name):
            self._device.set_float_feature_value(name, value)
        else:
            self._device.set_integer_feature_value(name, int(value))

    def unit(self, name: str) -> str:
        """Return the unit that the camera's description gives a number; empty where it gives none."""
        return self._device.get_feature(name).get_unit() or ""

    def text(self, name: str) -> str:
        """Read a feature of any kind as text."""
        with self.words(f"say its {name}"):
            return str(self._device.get_feature(name).get_value_as_string())

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries that an enumeration offers now."""
        with self.words(f"say what its {name} offers"):
            return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def _write_text(self, name: str, value: str) -> None:
        self._device.set_string_feature_value(name, value)

    def _write_switch(self, name: str, value: bool) -> None:
        self._device.set_boolean_feature_value(name, value)

    def _execute(self, name: str) -> None:
        self._device.execute_command(name)


def identity_of(camera: Any, features: Features) -> DeviceIdentity:
    """Return who an open camera says it is."""
    with features.words("say who it is"):
        vendor, model = camera.get_vendor_name(), camera.get_model_name()
        serial = camera.get_device_serial_number()
    firmware = features.find(*FIRMWARE)
    return DeviceIdentity(
        kind="camera",
        driver="aravis",
        vendor=vendor or "unknown",
        model=model or "unknown",
        serial_number=serial or "",
        firmware=features.text(firmware) if firmware else "",
        simulated=(vendor, model) in _FAKES,
    )


class Underruns(FrameNumberCounter):
    """Counts for Aravis' camera in process, which does not number the frames that found no free buffer."""

    def __init__(self, stream: Any, modulus: int) -> None:
        super().__init__(modulus, 1)
        self._stream = stream
        self._counted: int | None = None

    def lost(self, number: int) -> int:
        """Return the frames lost before this one."""
        underruns = int(self._stream.get_info_uint64_by_name("n_underruns"))
        before, self._counted = self._counted, underruns
        return super().lost(number) + (0 if before is None else underruns - before)


def stream_statistics(stream: Any) -> dict[str, int]:
    """Return the library's counts of a stream: ``n_missing_packets``, ``n_resent_packets`` ..."""
    names = (stream.get_info_name(i) for i in range(stream.get_n_infos()))
    return {
        name: stream.get_info_uint64_by_name(name)
        for name in names
        if name.startswith("n_") and "ratio" not in name
    }
