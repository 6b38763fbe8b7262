"""Where an array's LEDs are, as the array itself says."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import DeviceError
from drivers.illuminate.link import Link
from drivers.illuminate.protocol import parse_properties, parse_table

_log = logging.getLogger(__name__)
_SLOW_S = 10.0  # a thousand lines at 115,200 baud
_NA_DIGITS = 2e-3  # pledposna prints three decimals
_LONGEST_NM = 1e5
_MICROMETRES_END = 10.0  # wavelengths below are in micrometres, above in nanometres


@dataclass(frozen=True)
class ArrayGeometry:
    """What the driver needs to know of an array.

    Attributes
    ----------
    positions_mm : ndarray
        ``(n_leds, 3)``, float64; z is the distance along the axis to the sample.
    na : ndarray
        ``(n_leds, 2)`` direction cosines; NaN for LEDs that have none.
    wavelengths_nm : tuple of float or None
        Red, green, blue; None when the array does not say.
    channels : int
        Colours an LED has: 3, or 1.
    outputs, inputs : int
        Trigger lines.
    model, serial_number : str
    """

    positions_mm: npt.NDArray[np.float64]
    na: npt.NDArray[np.float64]
    wavelengths_nm: tuple[float, float, float] | None
    channels: int
    outputs: int
    inputs: int
    model: str
    serial_number: str


def read_geometry(link: Link, distance_mm: float | None) -> ArrayGeometry:
    """Ask an array for its properties and its LEDs' places.

    Parameters
    ----------
    link : Link
    distance_mm : float, optional
        From the LED with index 0 to the sample, where the array's own setting is not to be believed.

    Raises DeviceError when a reply is incomplete or contradicts another: no geometry is better than a wrong
    one.
    """
    properties = parse_properties(link.command(link.dialect.properties, _SLOW_S))
    if properties is None:
        raise DeviceError(
            link.device, f"sent no JSON for {link.dialect.properties.decode()!r}.", "Reopen it."
        )
    positions = parse_table(link.command(b"pledpos", _SLOW_S), 3)
    reported_na = parse_table(link.command(b"pledposna", _SLOW_S), 2)
    count = _whole(properties, "led_count", None if positions is None else len(positions))
    for what, table in (("pledpos", positions), ("pledposna", reported_na)):
        if table is None or len(table) != count:
            found = "no complete table" if table is None else f"{len(table)} LEDs"
            raise DeviceError(
                link.device, f"sent {found} for {what!r}; {count} LEDs were expected.", "Open it again."
            )
    assert positions is not None
    assert reported_na is not None
    names = properties.get("color_channels")
    channels = _whole(properties, "color_channel_count", len(names) if isinstance(names, list) else 3)
    if channels not in (1, 3):
        raise DeviceError(link.device, f"has LEDs of {channels} colours; 1 or 3 can be driven.")
    if distance_mm is not None:
        positions[:, 2] += distance_mm - positions[0, 2]
        na = _cosines(positions)
    else:
        na = _agreed(link.device, _cosines(positions), reported_na)
    na[np.hypot(reported_na[:, 0], reported_na[:, 1]) >= 1] = (
        np.nan
    )  # how the firmware marks LEDs without angle
    return ArrayGeometry(
        positions,
        na,
        _wavelengths(properties, channels),
        channels,
        _whole(properties, "trigger_output_count", 0),
        _whole(properties, "trigger_input_count", 0),
        str(properties.get("device_name") or "LED array"),
        str(properties.get("serial_number", "")),
    )


def _cosines(positions_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return x/r and y/r: the sine of atan(x / hypot(y, z)), as the firmware computes it."""
    distance = np.sqrt((positions_mm**2).sum(axis=1))
    return np.asarray(positions_mm[:, :2] / np.where(distance > 0, distance, np.inf)[:, None])


def _agreed(
    device: str, computed: npt.NDArray[np.float64], reported: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the computed angles, which have more digits, or the array's where the two contradict."""
    known = np.hypot(reported[:, 0], reported[:, 1]) < 1
    worst = float(np.abs(computed - reported)[known].max(initial=0.0))
    if worst <= _NA_DIGITS:
        return computed
    _log.warning(
        "%s: its NAs and its LED positions differ by up to %.3g; its NAs are used. Set distance_mm in "
        "bench.toml to go by positions.",
        device,
        worst,
    )
    return reported.copy()


def _whole(properties: Mapping[str, Any], key: str, otherwise: int | None) -> int:
    value = properties.get(key, otherwise)
    return value if isinstance(value, int) and value >= 0 else (otherwise or 0)


def _wavelengths(properties: Mapping[str, Any], channels: int) -> tuple[float, float, float] | None:
    """Return the centre wavelengths in nanometres, the longest (red) first."""
    reported = properties.get("color_channel_center_wavelengths")
    if not isinstance(reported, dict) or len(reported) != channels:
        return None
    values = [v for v in reported.values() if isinstance(v, int | float) and 0 < v < _LONGEST_NM]
    nm = sorted((1e3 * v if v < _MICROMETRES_END else float(v) for v in values), reverse=True)
    if len(nm) == 1:
        return nm[0], nm[0], nm[0]
    return (nm[0], nm[1], nm[2]) if len(nm) == 3 else None
