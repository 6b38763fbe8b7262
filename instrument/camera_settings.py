"""A camera's settings: as configured, read, and brought back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from drivers.camera import Camera, Roi
from drivers.errors import DeviceError
from instrument.config import CameraTable


def camera_settings(camera: Camera) -> dict[str, Any]:
    """Return format, region, binning, black level, gain and exposure as the camera reports them."""
    return {
        "pixel_format": camera.pixel_format,
        "binning": camera.binning,
        "roi": list(camera.roi.as_tuple()),
        "black_level": camera.black_level,
        "gain": camera.gain,
        "exposure_ms": camera.exposure_ms,
    }


def restore_camera(camera: Camera, wanted: Mapping[str, Any]) -> None:
    """Bring a camera back to what :func:`camera_settings` returned.

    Raises
    ------
    DeviceError
        Naming the settings that the camera did not take.
    """
    now = camera_settings(camera)
    if now["pixel_format"] != wanted["pixel_format"]:
        camera.set_pixel_format(wanted["pixel_format"])
    if now["binning"] != wanted["binning"]:
        camera.set_binning(wanted["binning"])
    if now["roi"] != list(wanted["roi"]):
        camera.set_roi(Roi(*wanted["roi"]))
    if not _same(camera.black_level, wanted["black_level"]):
        camera.set_black_level(wanted["black_level"])
    if not _same(now["gain"], wanted["gain"]):
        camera.set_gain(wanted["gain"])
    if not _same(now["exposure_ms"], wanted["exposure_ms"]):
        camera.set_exposure_ms(wanted["exposure_ms"])
    now = camera_settings(camera)
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
    """Bring a camera to its configured settings, in the order in which they depend on each other."""
    if wanted.pixel_format is not None:
        camera.set_pixel_format(wanted.pixel_format)
    if wanted.binning is not None:
        camera.set_binning(wanted.binning)
    if wanted.roi is not None:
        camera.set_roi(Roi(*wanted.roi))
    if wanted.black_level is not None:
        camera.set_black_level(wanted.black_level)
    if wanted.gain is not None:
        camera.set_gain(wanted.gain)
    if wanted.exposure_ms is not None:
        camera.set_exposure_ms(wanted.exposure_ms)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) or isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9)
    return bool(list(a) == list(b) if isinstance(a, (list, tuple)) else a == b)
