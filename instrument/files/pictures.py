"""PNG, JPEG and BMP pictures, decoded by OpenCV after a look at what their headers promise."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files import reading
from instrument.files.errors import FileError

Decoded = tuple[npt.NDArray[Any], tuple[str, ...]]
"""An array as its file has it, stack first and colour last, and what was noticed in words."""
READABLE = "TIFF, PNG, JPEG, BMP, .npy, .npz, HDF5, MATLAB, OME-Zarr"
MOST_BYTES = 1 << 28
"""Of a compressed picture's file."""
LOSSY = "JPEG is lossy and usually gamma-coded: prefer raw frames"
ALPHA = "alpha channel left out"
ORIENTATION = 274
"""The tag of TIFF and Exif."""
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8"
MAGIC = (_PNG_MAGIC, _JPEG_MAGIC, b"BM")
_MOST_EXIF = 1 << 16
_GREY_AND_ALPHA = 4
"""A PNG's colour type that OpenCV makes a colour picture of."""


def decode_picture(path: Path) -> Decoded:
    """Return a PNG's, JPEG's or BMP's array, in the order red, green, blue.

    Raises FileError when it is damaged, or says to be more than its file can hold.
    """
    data = reading.read_bytes(path, MOST_BYTES)
    if data.startswith(_PNG_MAGIC) and not _png_is_whole(data):
        raise FileError(path, "is a damaged PNG: its parts are longer than the file, or out of order.")
    shape = _shape_by_header(data)
    if shape is not None:
        reading.require_plausible(path, 8 * math.prod(shape), len(data))
    with quiet_opencv():
        try:
            array = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except (cv2.error, MemoryError):
            array = None
    if array is None:
        raise FileError(path, f"is no image that can be read, or is damaged. Readable: {READABLE}.")
    array = rgb(array)
    notes = []
    if data.startswith(_PNG_MAGIC) and data[25] == _GREY_AND_ALPHA:
        array = array[..., 0]
        notes.append(ALPHA)
    if data.startswith(_JPEG_MAGIC):
        notes.append(LOSSY)
    if 2 <= (turned := _exif_orientation(data)) <= 8:
        array = upright(array, turned, "YXS"[: array.ndim])
        notes.append(turned_in_words(turned))
    return array, tuple(notes)


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV silent: a damaged file is told of once, in our words."""
    loudness = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(loudness)


def rgb(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an image of OpenCV's with its colours the other way round."""
    if array.ndim == 3 and array.shape[-1] >= 3:
        array = array[..., [2, 1, 0, *range(3, array.shape[-1])]]
    return array


def turned_in_words(orientation: int) -> str:
    """Say that an image was turned, for its notes."""
    return f"turned upright as its orientation ({orientation}) says"


def upright(array: npt.NDArray[Any], orientation: int, axes: str) -> npt.NDArray[Any]:
    """Turn and mirror images so that the first row is at the top (TIFF 6.0, tag 274)."""
    y, x = axes.index("Y"), axes.index("X")
    if orientation >= 5:
        array = np.swapaxes(array, y, x)
    down = orientation in (3, 4, 7, 8)
    left = orientation in (2, 3, 6, 7)
    return np.flip(array, tuple(axis for axis, flips in ((y, down), (x, left)) if flips))


def _exif_orientation(data: bytes) -> int:
    """Return how a JPEG or PNG says that it stands, as a TIFF's tag 274; 1 where it says nothing."""
    mark = b"Exif\0\0" if data.startswith(_JPEG_MAGIC) else b"eXIf"
    place = data.find(mark) if data.startswith((_JPEG_MAGIC, _PNG_MAGIC)) else -1
    if place < 0:
        return 1
    from PIL import Image  # of Matplotlib's own needs; OpenCV turns only what it also changes otherwise

    exif = Image.Exif()
    try:
        exif.load(b"Exif\0\0" + data[place + len(mark) : place + len(mark) + _MOST_EXIF])
        return int(exif.get(ORIENTATION, 1))
    except Exception:  # noqa: BLE001 - a damaged note beside a whole picture raises nearly anything
        return 1


def _png_is_whole(data: bytes) -> bool:
    """Whether a PNG's parts fit into it: OpenCV takes memory for what each says it has."""
    place = len(_PNG_MAGIC)
    first = True
    while place + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        if first != (kind == b"IHDR") or place + 12 + length > len(data):
            return False
        if kind == b"IEND":
            return True
        first, place = False, place + 12 + length
    return False


def _shape_by_header(data: bytes) -> tuple[int, int] | None:
    """Return the sides that a PNG, BMP or JPEG says it has; None where it says none."""
    if data.startswith(_PNG_MAGIC):
        width, height = struct.unpack(">II", data[16:24].ljust(8, b"\0"))
        return width, height
    if data.startswith(b"BM"):
        width, height = struct.unpack("<ii", data[18:26].ljust(8, b"\0"))
        return abs(width), abs(height)
    return _sides_of_jpeg(data) if data.startswith(_JPEG_MAGIC) else None


def _sides_of_jpeg(data: bytes) -> tuple[int, int] | None:
    """Return the sides in the frame header (SOFn) of a JPEG, found from part to part (ITU T.81, B.1)."""
    place = len(_JPEG_MAGIC)
    while place + 9 <= len(data) and data[place] == 0xFF:
        kind = data[place + 1]
        if kind == 0xFF:  # a fill byte
            place += 1
            continue
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return height, width
        if kind in (0xD9, 0xDA):  # the end, or pixels before any frame header
            return None
        place += (
            2 if 0xD0 <= kind <= 0xD8 or kind == 1 else 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        )
    return None
