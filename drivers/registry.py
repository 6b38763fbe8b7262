"""Find a driver by the name that the configuration gives it.

Drivers register in the entry point group ``diffuserbench.drivers`` under ``NAME.KIND``, where KIND is
``camera``, ``stage``, ``led_array`` or ``slm``: built-in ones in this project's ``pyproject.toml``, others in
the package that brings them. A driver is imported only when it is asked for.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from drivers.device import Device
from drivers.errors import DeviceError

GROUP = "diffuserbench.drivers"
KINDS = ("camera", "stage", "led_array", "slm")


def driver_names(kind: str) -> tuple[str, ...]:
    """Names of the drivers registered for a kind of device, sorted."""
    suffix = f".{kind}"
    return tuple(
        sorted({point.name.removesuffix(suffix) for point in _points() if point.name.endswith(suffix)})
    )


def load_driver(kind: str, name: str) -> type[Device]:
    """Import and return the driver class registered as ``NAME.KIND``.

    Raises
    ------
    DeviceError
        When no such driver is registered or its module cannot be imported (the text says what is missing).
    """
    for point in _points():
        if point.name == f"{name}.{kind}":
            try:
                driver = point.load()
            except ImportError as error:
                raise DeviceError(
                    f"{kind} ({name})", f"its driver cannot be imported: {error}.", "Install what it names."
                ) from error
            if not (isinstance(driver, type) and issubclass(driver, Device)):
                raise DeviceError(f"{kind} ({name})", f"entry point {point.value!r} is no device driver.")
            return driver
    raise DeviceError(
        f"{kind} ({name})",
        "no such driver is registered.",
        f"Available: {', '.join(driver_names(kind)) or 'none'}.",
    )


def _points() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))
