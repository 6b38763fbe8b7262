"""picamera2's cameras, their sensors' modes, and the raw formats that hold the sensors' own counts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.camera import Roi
from drivers.common.pixels import Bytes, PixelFormat, Pixels, unpack
from drivers.device import FoundDevice
from drivers.errors import DeviceError

_FORMAT = re.compile(r"(?:S([RGB]{4})|[RY])(\d+)(_CSI2P)?")
"""libcamera's names: ``SRGGB12_CSI2P``, ``SBGGR16``, ``R10``; others (``..._PISP_COMP1``) are compressed with
loss."""
_LINES_LOOKED_AT = 64
_MODEL = Path("/proc/device-tree/model")


def picamera2(device: str) -> Any:
    """Return picamera2's class for a camera.

    Raises DeviceError, naming ``device``, when it is not installed.
    """
    try:
        from picamera2 import Picamera2
    except ImportError as error:
        raise DeviceError(
            device,
            f"needs picamera2, which cannot be imported: {error}.",
            "On the Raspberry Pi: sudo apt install python3-picamera2, and a virtual environment made with "
            "--system-site-packages.",
        ) from error
    return Picamera2


def found_cameras() -> tuple[FoundDevice, ...]:
    """Return the cameras on the CSI connectors; none where this is no Raspberry Pi.

    Raises DeviceError when picamera2 is not installed.
    """
    if not (_MODEL.exists() and "Raspberry Pi" in _MODEL.read_text("utf-8", "replace")):
        return ()
    return tuple(
        FoundDevice(
            bus="CSI",
            address=f"camera {number}",
            description=str(info.get("Model", "camera")),
            driver="raspberry",
            kind="camera",
            options={"index": number},
        )
        for number, info in enumerate(picamera2("CSI").global_camera_info())
    )


@dataclass(frozen=True, slots=True)
class RawFormat:
    """A raw format as a camera sends it.

    Attributes
    ----------
    name : str
        GenICam name, with ``(MIPI)`` where it is packed as it comes from the sensor.
    asked : str
        The format to ask picamera2 for, which may not be what it sends.
    pixels : PixelFormat
        What is sent, at the sensor's own depth.
    shift : int
        How far the counts are moved up in their words: a Raspberry Pi 5 fills 16 bits.
    """

    name: str
    asked: str
    pixels: PixelFormat
    shift: int


def raw_format(asked: str, sent: str, bit_depth: int) -> RawFormat | None:
    """Return the format that comes as ``sent`` when ``asked`` is asked for; None for one that is not raw.

    ``bit_depth`` is the sensor's.
    """
    match = _FORMAT.fullmatch(sent)
    if match is None:
        return None
    bayer, depth, packed = match[1], int(match[2]), match[3] is not None
    shift = depth - bit_depth if depth == 16 else 0
    bits = depth - shift
    name = f"Bayer{bayer[:2]}{bits}" if bayer else f"Mono{bits}"
    if packed and bits in (10, 12):
        return RawFormat(f"{name} (MIPI)", asked, PixelFormat(name, bits, f"mipi {bits}"), 0)  # type: ignore[arg-type]
    if packed or shift < 0:
        return None
    return RawFormat(name, asked, PixelFormat(name, bits, "bytes" if depth == 8 else "words"), shift)


def sizes(modes: Iterable[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """Return the ``(height, width)`` of a sensor's modes, the largest first."""
    found = {(int(mode["size"][1]), int(mode["size"][0])) for mode in modes if "size" in mode}
    return sorted(found, key=lambda size: size[0] * size[1], reverse=True)


def ask_for(camera: Any, asked: str, whole: Roi, n_buffers: int, device: str) -> None:
    """Configure a camera for a raw format; what comes of it, ``camera_configuration`` says.

    Raises DeviceError when it refuses.
    """
    size = (whole.width, whole.height)
    config = camera.create_video_configuration(
        raw={"format": asked, "size": size}, buffer_count=n_buffers, queue=False, display=None, encode=None
    )
    try:
        camera.configure(config)
    except RuntimeError as error:
        raise DeviceError(device, f"cannot send {asked} {size}: {error}.") from error


def offered_formats(
    camera: Any, modes: Iterable[Mapping[str, Any]], whole: Roi, device: str
) -> list[RawFormat]:
    """Ask for each format that a sensor's modes may have; returns those that come as raw counts.

    Raises DeviceError when there are none.
    """
    found: dict[str, RawFormat] = {}
    for mode in sorted(modes, key=lambda mode: mode["bit_depth"], reverse=True):
        for asked in (str(mode["unpacked"]), str(mode["format"])):
            ask_for(camera, asked, whole, 2, device)
            sent = str(camera.camera_configuration()["raw"]["format"])
            known = raw_format(asked, sent, int(mode["bit_depth"]))
            if known is not None:
                found.setdefault(known.name, known)
    if not found:
        raise DeviceError(device, "sends no raw format that can be unpacked.", "Choose another size.")
    return list(found.values())


def decode(data: Bytes, wanted: RawFormat, line_bytes: int, out: Pixels, device: str) -> bool:
    """Write a frame's counts into ``out``; False when the bytes are too few.

    Raises DeviceError when words that should be moved up are not: their low bits would be lost.
    """
    if not unpack(data, wanted.pixels.packing, out, line_bytes):
        return False
    if wanted.shift:
        if np.bitwise_or.reduce(out[::_LINES_LOOKED_AT], axis=None) & ((1 << wanted.shift) - 1):
            raise DeviceError(
                device,
                f"sends {wanted.pixels.bits} bits in 16 otherwise than a Raspberry Pi 5 does: their lowest "
                f"{wanted.shift} bits should be 0.",
                "Choose a pixel format with (MIPI), and report this.",
            )
        np.right_shift(out, wanted.shift, out=out)
    return True
