"""PNG, JPEG and BMP pictures, decoded by OpenCV after a look at what their headers promise.

And what an array of any file is as a picture: which of its axes are colours, numbers as the program has them.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files import reading
from instrument.files.errors import FileError
from recon.arrays import Array, Float32Array

Decoded = tuple[Array, tuple[str, ...]]
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


def rgb(array: Array) -> Array:
    """Return an image of OpenCV's with its colours the other way round."""
    if array.ndim == 3 and array.shape[-1] >= 3:
        array = array[..., [2, 1, 0, *range(3, array.shape[-1])]]
    return array


def turned_in_words(orientation: int) -> str:
    """Say that an image was turned, for its notes."""
    return f"turned upright as its orientation ({orientation}) says"


def upright(array: Array, orientation: int, axes: str) -> Array:
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


# Which axes are colours, and which numbers ---------------------------------------------------------
Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | Float32Array

MOST_LIGHT = 1e15
"""No light has more counts; their squares are summed."""

PLANES_AS_COLOURS = "its three planes taken as colours"
"""Said of an array of NumPy's or MATLAB's of whose axes nothing tells whether they are colours or images."""

PLANES_AS_IMAGES = "its three planes taken as images"


def several_images(path: Path, count: int, further: str) -> FileError:
    """Return what refuses a stack where an image is expected; ``further`` is what else helps."""
    remedy = f"Give one of them, or their mean. {further}".rstrip()
    return FileError(path, f"holds {count} images; a single one is expected.", remedy)


def one_image(path: Path, array: Array, several: str = "") -> tuple[Array, tuple[str, ...]]:
    """Return an array's only image, its colours last and without transparency, and that in words.

    Raises FileError where it has several, or none.
    """
    notes: tuple[str, ...] = ()
    while array.ndim > 2 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 3 and array.shape[0] == 3 and array.shape[-1] not in (1, 2, 3, 4) and _is_npy(path):
        array, notes = np.moveaxis(array, 0, -1), (PLANES_AS_COLOURS,)
    if array.ndim == 3 and array.shape[-1] in (1, 2, 3, 4):
        array, dropped = drop_alpha(array)
        array = array[..., 0] if array.shape[-1] == 1 else array
        notes += dropped
    elif array.ndim == 3:
        raise several_images(path, len(array), several)
    elif array.ndim != 2:
        raise FileError(path, f"holds an array of shape {array.shape}; an image is expected.")
    if 0 in array.shape:
        raise FileError(path, f"holds an empty array of shape {array.shape}.")
    return array, notes


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() in (".npy", ".npz")


def drop_alpha(array: Array) -> tuple[Array, tuple[str, ...]]:
    """Return an image (..., channels) without its transparency, the second or fourth, and that in words."""
    if array.shape[-1] in (2, 4):
        return array[..., :-1], (ALPHA,)
    return array, ()


def standard_dtype(path: Path, array: Array, *, holes: bool = False) -> tuple[Pixels, tuple[str, ...]]:
    """Return the pixels as uint8, uint16 or float32, unscaled, and what was converted."""
    if array.dtype == np.bool_:
        return array.astype(np.uint8), ("true and false taken as 1 and 0",)
    if array.dtype.kind not in "uif":
        raise FileError(path, f"holds {array.dtype} values; real numbers are expected.")
    native = array.astype(array.dtype.newbyteorder("="), copy=False)
    if native.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(native), ()
    if native.dtype.kind == "f":
        refuse_non_finite(path, native, holes=holes)
    elif native.size and native.min() >= 0 and native.max() <= 0xFFFF:
        return native.astype(np.uint16), (f"{native.dtype} taken as uint16",)
    with np.errstate(over="ignore"):
        pixels = np.ascontiguousarray(native, np.float32)
    refuse_non_finite(path, pixels, holes=holes)
    if (largest := float(np.nanmax(np.abs(pixels), initial=0))) > MOST_LIGHT:
        raise FileError(
            path, f"holds values up to {largest:.3g}; no light has more than {MOST_LIGHT:g} counts."
        )
    return pixels, () if native.dtype == np.float32 else (f"{native.dtype} taken as float32",)


def refuse_non_finite(path: Path, array: Array, *, holes: bool) -> None:
    """Refuse values that are no finite numbers; with ``holes`` some may be NaN. Raises FileError."""
    finite = np.isfinite(array)
    if holes and finite.any():
        finite |= np.isnan(array)
    if not finite.all():
        where, count = tuple(int(i) for i in np.argwhere(~finite)[0]), array.size - int(finite.sum())
        them = (
            "a value that is no finite number" if count == 1 else f"{count} values that are no finite numbers"
        )
        first = (
            f"{array[where]} at index {where}"
            if count == 1
            else f"the first, {array[where]}, at index {where}"
        )
        raise FileError(path, f"holds {them} ({first}).", "Replace it, e.g. by the mean of its neighbours.")
