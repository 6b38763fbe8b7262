"""A camera's settings: as configured, read, and brought back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from drivers.camera import Camera, Roi, TriggerEdge, TriggerMode
from drivers.device import Setting
from drivers.errors import DeviceError, LimitError
from instrument.bench.config import CameraTable
from recon.base.declare import option
from recon.errors import InputError


def _roi(text: str) -> Roi:
    """Read ``TOP, LEFT, HEIGHT, WIDTH``."""
    words = text.replace(",", " ").split()
    if len(words) != 4 or not all(word.isdecimal() for word in words):
        raise InputError("a region is four whole numbers, top, left, height, width.")
    return Roi(*map(int, words))


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """What is set on a camera by hand; limits and words to choose from are the camera's own."""

    exposure_ms: float = option(help="Exposure time.", unit="ms", label="Exposure")
    gain: float = option(help="Electronic gain as a factor; 1 is the base gain.", unit="×")
    black_level: float = option(help="Offset that the camera adds.", unit="counts", least=0)
    binning: int = option(help="Sensor pixels summed along each axis.")
    pixel_format: str = option(help="Pixel format by its GenICam name.", label="Format")
    trigger_mode: TriggerMode = option(help="What starts an exposure.", label="Trigger")
    trigger_line: str = option(help="Input that a hardware trigger comes in on.", label="Trigger line")
    trigger_edge: TriggerEdge = option(
        help="Edge of the pulse that starts an exposure.", label="Trigger edge"
    )
    roi: Roi = option(
        help="Region of interest in sensor pixels before binning: top, left, height, width.",
        metavar="TOP, LEFT, HEIGHT, WIDTH",
        parse=_roi,
        label="Region",
    )


@dataclass(frozen=True, slots=True)
class CameraState:
    """What a camera says of itself now, and what it offers."""

    exposure_ms: float
    gain: float
    black_level: float
    binning: int
    roi: Roi
    pixel_format: str
    trigger_mode: TriggerMode
    trigger_line: str
    trigger_edge: TriggerEdge
    """As read back."""
    exposure_limits_ms: tuple[float, float]
    gain_limits: tuple[float, float]
    binnings: tuple[int, ...]
    pixel_formats: tuple[str, ...]
    trigger_modes: tuple[TriggerMode, ...]
    trigger_lines: tuple[str, ...]
    trigger_edges: tuple[TriggerEdge, ...]
    sensor_shape: tuple[int, int]
    """What it offers."""
    temperature_c: float | None
    """Of the sensor or the camera, where it has a thermometer; degrees Celsius."""
    settings: Mapping[str, Setting]
    """All of its settings, by name."""


def read_camera(camera: Camera) -> CameraState:
    """Ask a camera for everything; takes as long as the camera needs to answer."""
    settings = camera.settings()
    temperature = next(
        (v for k, v in settings.items() if "temperature" in k.lower() and isinstance(v, int | float)), None
    )
    asked = [field.name for field in fields(CameraState) if field.name not in ("temperature_c", "settings")]
    return CameraState(
        **{name: getattr(camera, name) for name in asked},
        temperature_c=None if temperature is None else float(temperature),
        settings=dict(settings),
    )


def camera_settings(camera: Camera) -> dict[str, Any]:
    """Return format, region, binning, black level, gain, exposure and trigger as the camera reports them."""
    return {
        "pixel_format": camera.pixel_format,
        "binning": camera.binning,
        "roi": list(camera.roi.as_tuple()),
        "black_level": camera.black_level,
        "gain": camera.gain,
        "exposure_ms": camera.exposure_ms,
        "trigger_line": camera.trigger_line,
        "trigger_edge": camera.trigger_edge,
        "trigger_mode": camera.trigger_mode,
    }


def restore_camera(camera: Camera, wanted: Mapping[str, Any]) -> None:
    """Bring a camera back to what :func:`camera_settings` returned, in a version that may have known less.

    Raises DeviceError naming the settings that the camera did not take.
    """
    for name, set_to in _setters(camera).items():
        if name in wanted and not _same(camera_settings(camera)[name], wanted[name]):
            set_to(wanted[name])
    now = {name: value for name, value in camera_settings(camera).items() if name in wanted}
    different = [
        f"{name} is {now[name]}, was {wanted[name]}" for name in now if not _same(now[name], wanted[name])
    ]
    if different:
        raise DeviceError(
            camera.name,
            f"does not take the settings that the run began with: {'; '.join(different)}.",
            "Is it the same camera?",
        )


def apply_table(wanted: CameraTable, camera: Camera) -> None:
    """Bring a camera to its configured settings, in the order in which they depend on each other.

    Raises LimitError naming every setting that the camera refuses; the others are set.
    """
    refused = []
    for name, set_to in _setters(camera).items():
        value = getattr(wanted, name)
        if value is None:
            continue
        try:
            set_to(value)
        except LimitError as error:
            refused.append((name, error))
    if len(refused) == 1:
        raise refused[0][1]
    if refused:
        listed = "".join(f"\n  {name}: {error.problem} {error.remedy}".rstrip() for name, error in refused)
        raise LimitError(camera.name, f"does not take {len(refused)} of its configured settings:{listed}")


def _setters(camera: Camera) -> dict[str, Callable[[Any], object]]:
    """Return what sets each setting, in the order in which they depend on each other."""
    return {
        "pixel_format": camera.set_pixel_format,
        "binning": camera.set_binning,
        "roi": lambda roi: camera.set_roi(Roi(*roi)),
        "black_level": camera.set_black_level,
        "gain": camera.set_gain,
        "exposure_ms": camera.set_exposure_ms,
        "trigger_line": camera.set_trigger_line,
        "trigger_edge": camera.set_trigger_edge,
        "trigger_mode": camera.set_trigger_mode,
    }


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) or isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9)
    return bool(list(a) == list(b) if isinstance(a, (list, tuple)) else a == b)
