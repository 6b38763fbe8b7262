"""Image files: TIFF, PNG, JPEG, BMP, NumPy, 8 to 16 bit and float, grey and colour, single and stacked.

Arrays are ``(height, width)`` or ``(height, width, 3)`` in the order red, green, blue; stacks have one more
axis in front. The dtype is the file's own (uint8, uint16 or float32) and pixel values are never rescaled.
"""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from instrument.files import reading
from instrument.files.atomic import whole_file, write_text
from instrument.files.errors import FileError
from instrument.files.seen import as_seen, png_bytes

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

READABLE = "TIFF, PNG, JPEG, BMP, .npy, or .npz with one array"
WRITABLE = (".tif", ".tiff", ".png", ".npy")
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_OPENCV_MAGIC = (_PNG_MAGIC, b"\xff\xd8", b"BM")
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class ImageFile:
    """What was read from an image file: NumPy takes it as an array, a notebook shows it."""

    path: Path
    pixels: Pixels
    """One image, or a stack with the images along the first axis; see the module."""
    notes: tuple[str, ...] = ()
    """What reading left out or converted, in sentences without full stop."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """What :func:`write_image` kept with the image; empty for images from elsewhere."""

    @property
    def is_simulated(self) -> bool:
        """Whether its metadata say that no hardware took it."""
        return bool(self.metadata.get("simulated"))

    @property
    def is_colour(self) -> bool:
        """Whether a single image has three channels."""
        return self.pixels.ndim == 3

    @property
    def is_stack(self) -> bool:
        """Whether it holds several images."""
        return self.pixels.ndim == 4 or (self.pixels.ndim == 3 and self.pixels.shape[-1] != 3)

    def describe(self) -> str:
        """Return size, channels and dtype in words, e.g. ``"1200 x 1600 grey uint16"``."""
        height, width = self.pixels.shape[:2]
        return f"{height} x {width} {'colour' if self.is_colour else 'grey'} {self.pixels.dtype}"

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return the pixels."""
        return np.array(self.pixels, dtype, copy=copy)

    def __repr__(self) -> str:
        """Say in a line what it is."""
        if self.is_stack:
            return f"<{self.path}: {len(self.pixels)} images {self.pixels.shape[1:]} {self.pixels.dtype}>"
        return f"<{self.path}: {self.describe()}>"

    def _repr_png_(self) -> bytes | None:
        return None if self.is_stack else png_bytes(as_seen(self.pixels, raw=True))


def read_image(path: Path | str | ImageFile, *, holes: bool = False) -> ImageFile:
    """Read one image; one that was read already is returned. With ``holes`` it may have NaN pixels.

    Raises FileError when the file is missing, a folder, empty, unreadable, no image, several images, or holds
    values that are no finite numbers.
    """
    if isinstance(path, ImageFile):
        _refuse_non_finite(path.path, path.pixels, holes=holes)
        return path
    path = Path(path)
    array, notes = _decode(path)
    array, more = _one_image(path, array)
    pixels, converted = _standard_dtype(path, array, holes=holes)
    return ImageFile(path, pixels, (*notes, *more, *converted), _metadata(path))


def read_stack(path: Path | str, *, leave_out: Path | None = None) -> ImageFile:
    """Read a stack of images: a multi-page TIFF, an array with one more axis, or a folder of images.

    The images of a folder are taken in the order of their names, all but the file ``leave_out``, and must
    agree in shape and dtype. A single image is a stack of one. Errors as :func:`read_image`.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, leave_out)
    array, notes = _decode(path)
    if array.ndim == 2 or (array.ndim == 3 and array.shape[-1] in (3, 4) and not _is_npy(path)):
        array, more = _one_image(path, array)
        array = array[None]
    elif array.ndim == 4:
        array, more = _drop_alpha(array)
    elif array.ndim == 3:
        more = ()
    else:
        raise FileError(path, f"holds an array of shape {array.shape}; a stack of images is expected.")
    pixels, converted = _standard_dtype(path, array)
    return ImageFile(path, pixels, (*notes, *more, *converted))


def read(path: Path | str) -> ImageFile:
    """Read what a file holds, or a folder: one image, or a stack. Errors as :func:`read_image`."""
    if Path(path).is_dir():
        return read_stack(path)
    try:
        return read_image(path, holes=True)
    except FileError:
        try:
            return read_stack(path)
        except FileError:
            pass
        raise


def write_image(path: Path | str, image: npt.NDArray[Any], metadata: Mapping[str, Any] | None = None) -> None:
    """Write one image (or, as TIFF or .npy, a stack), whole or not at all.

    The suffix chooses the format: ``.tif`` and ``.npy`` keep any dtype, ``.png`` takes uint8 and uint16.
    ``metadata`` goes into a TIFF's description, otherwise into a JSON file beside the image.

    Raises FileError when the suffix or the dtype does not fit, or the folder cannot be written to; OSError
    when the disk is full.
    """
    path = Path(path)
    check_suffix(path)
    text = json.dumps(metadata, indent=1, default=str) if metadata is not None else None
    suffix = path.suffix.lower()
    if suffix == ".png" and (image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3)):
        raise FileError(path, f"PNG holds one image of uint8 or uint16, not {image.dtype} {image.shape}.")
    with whole_file(path) as temporary:
        if suffix == ".npy":
            np.save(temporary, image, allow_pickle=False)
        elif suffix == ".png":
            _write_png(temporary, image)
        else:
            is_rgb = image.ndim >= 3 and image.shape[-1] == 3
            tifffile.imwrite(
                temporary,
                np.ascontiguousarray(image),
                photometric="rgb" if is_rgb else "minisblack",
                description=text,
                metadata=None,
            )
    if text is not None and suffix in (".png", ".npy"):
        write_text(side_car(path), text + "\n")


def side_car(path: Path | str) -> Path:
    """Return the JSON file that goes with an image file."""
    return Path(path).with_suffix(".json")


def check_suffix(path: Path | str) -> None:
    """Refuse a file name whose suffix is no format that can be written.

    Raises FileError.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITABLE:
        found = f"{suffix!r} is no format to write images in" if suffix else "the name has no suffix"
        raise FileError(path, f"{found}; choose one of {', '.join(WRITABLE)}.")


def _metadata(path: Path) -> dict[str, Any]:
    """Return the metadata kept with an image; empty where there are none of ours."""
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            with tifffile.TiffFile(path) as tiff:
                text = tiff.pages.first.description
        else:
            text = reading.read_bytes(side_car(path)).decode()
        metadata = reading.parse_json(text)
    except (OSError, ValueError, FileError, tifffile.TiffFileError):
        return {}  # another program's description, or none: the pixels were read all the same
    return metadata if isinstance(metadata, dict) else {}


# Reading -----------------------------------------------------------------------------------------
MOST_IMAGE_BYTES = 1 << 35


def read_bytes(path: Path) -> bytes:
    """Return a file's content; every failure is a FileError that says what is wrong."""
    try:
        data = reading.read_bytes(path, MOST_IMAGE_BYTES)
    except FileNotFoundError:
        raise FileError(path, "there is no such file.") from None
    if not data:
        raise FileError(path, "is empty (0 bytes).")
    return data


def _decode(path: Path) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """Return the file's array as it stands; its content, not its name, tells the format."""
    data = read_bytes(path)
    if data.startswith(b"\x93NUMPY"):
        return _decode_npy(path, data)
    if data.startswith(b"PK"):
        return _decode_npz(path, data)
    if data[:4] in _TIFF_MAGIC:
        return _decode_tiff(path, data)
    if not data.startswith(_OPENCV_MAGIC):
        raise FileError(path, f"is no image that can be read, or is damaged. Readable: {READABLE}.")
    return _decode_with_opencv(path, data)


def _decode_npy(path: Path, data: bytes) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    try:
        file = io.BytesIO(data)
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(file)
        if math.prod(shape) * dtype.itemsize > len(data) - file.tell():
            raise ValueError(f"it says {dtype} {shape}, which are more bytes than it has")
        array: npt.NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # noqa: BLE001 - the header is Python text, whose parser raises nearly anything
        raise FileError(path, f"is damaged or no plain .npy array: {error!s:.200}.") from None
    return array, ()


def _decode_npz(path: Path, data: bytes) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) != 1:
                listed = ", ".join(member.filename.removesuffix(".npy") for member in members[:8]) or "none"
                raise FileError(path, f"holds {len(members)} arrays ({listed}); one image is expected.")
            said = members[0].file_size
            reading.require_plausible(path, said, len(data))
            with archive.open(members[0]) as member:
                content = member.read(said + 1)
            if len(content) > said:
                raise FileError(path, "is damaged: it holds more than it says.")
            return _decode_npy(path, content)
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None
    except (NotImplementedError, RuntimeError) as error:  # another compression, a password
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None


def _decode_tiff(path: Path, data: bytes) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            if not tiff.series:
                raise FileError(path, "is a TIFF without an image.")
            series = tiff.series[0]
            reading.require_plausible(path, series.size * series.dtype.itemsize, len(data))
            array = series.asarray()
            page = series.keyframe
            axes, notes = series.axes, []
            if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and array.dtype.kind == "u":
                array = np.iinfo(array.dtype).max - array
                notes.append("white-is-zero TIFF inverted")
            if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
                return _decode_with_opencv(path, data)
            if "S" in axes and not axes.endswith("S"):
                array = np.moveaxis(array, axes.index("S"), -1)
            if len(tiff.series) > 1:
                notes.append(f"the first of its {len(tiff.series)} image series taken")
            return array, tuple(notes)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged TIFF raises nearly anything
        if "imagecodecs" in str(error):  # a compression that only OpenCV knows here
            return _decode_with_opencv(path, data)
        raise FileError(path, f"is a damaged or unusual TIFF: {error}.") from None


def _decode_with_opencv(path: Path, data: bytes) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    if data.startswith(_PNG_MAGIC) and not _png_is_whole(data):
        raise FileError(path, "is a damaged PNG: its parts are longer than the file, or out of order.")
    shape = _shape_by_header(data)
    if shape is not None:
        reading.require_plausible(path, 8 * math.prod(shape), len(data))
    # A damaged file is told of once, in our words.
    loudness = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        array = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError):
        array = None
    finally:
        cv2.utils.logging.setLogLevel(loudness)
    if array is None:
        raise FileError(path, f"is no image that can be read, or is damaged. Readable: {READABLE}.")
    if array.ndim == 3 and array.shape[-1] >= 3:
        array = array[..., [2, 1, 0, *range(3, array.shape[-1])]]
    lossy = ("JPEG is lossy and usually gamma-coded: prefer raw frames",) if data[:2] == b"\xff\xd8" else ()
    return array, lossy


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
    found = re.search(rb"\xff[\xc0-\xc3\xc5-\xc7\xc9-\xcb\xcd-\xcf]...(..)(..)", data, re.DOTALL)
    if found is None:
        return None
    return int.from_bytes(found[1], "big"), int.from_bytes(found[2], "big")


def _read_folder(folder: Path, leave_out: Path | None) -> ImageFile:
    suffixes = {".tif", ".tiff", ".png", ".bmp", ".npy", ".jpg", ".jpeg"}
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith("."))
    if leave_out is not None:
        paths = [p for p in paths if p.resolve() != leave_out.resolve()]
    if not paths:
        raise FileError(folder, f"holds no images ({READABLE}).")
    first = read_image(paths[0])
    images = [first.pixels]
    for path in paths[1:]:
        image = read_image(path)
        if image.pixels.shape != first.pixels.shape or image.pixels.dtype != first.pixels.dtype:
            raise FileError(path, f"is {image.describe()}, but {first.path.name} is {first.describe()}.")
        images.append(image.pixels)
    stack: Pixels = np.stack(images)  # type: ignore[assignment]
    return ImageFile(
        folder, stack, (f"{len(paths)} files, {paths[0].name} to {paths[-1].name}", *first.notes)
    )


# Shapes and dtypes ---------------------------------------------------------------------------------
def _one_image(path: Path, array: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    notes: tuple[str, ...] = ()
    while array.ndim > 2 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 3 and array.shape[0] in (3, 4) and array.shape[-1] not in (1, 2, 3, 4) and _is_npy(path):
        array, notes = np.moveaxis(array, 0, -1), ("channels-first array taken as colour",)
    if array.ndim == 3 and array.shape[-1] in (1, 2, 3, 4):
        array, dropped = _drop_alpha(array)
        array = array[..., 0] if array.shape[-1] == 1 else array
        notes += dropped
    elif array.ndim == 3:
        raise FileError(path, f"holds {array.shape[0]} images; a single one is expected.")
    elif array.ndim != 2:
        raise FileError(path, f"holds an array of shape {array.shape}; an image is expected.")
    if 0 in array.shape:
        raise FileError(path, f"holds an empty array of shape {array.shape}.")
    return array, notes


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() in (".npy", ".npz")


def _drop_alpha(array: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    if array.shape[-1] in (2, 4):
        return array[..., :-1], ("alpha channel left out",)
    return array, ()


def _standard_dtype(
    path: Path, array: npt.NDArray[Any], *, holes: bool = False
) -> tuple[Pixels, tuple[str, ...]]:
    """Return the pixels as uint8, uint16 or float32, unscaled, and what was converted."""
    if array.dtype == np.bool_:
        return array.astype(np.uint8), ("true and false taken as 1 and 0",)
    if array.dtype.kind not in "uif":
        raise FileError(path, f"holds {array.dtype} values; real numbers are expected.")
    native = array.astype(array.dtype.newbyteorder("="), copy=False)
    if native.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(native), ()
    if native.dtype.kind == "f":
        _refuse_non_finite(path, native, holes=holes)
    elif native.size and native.min() >= 0 and native.max() <= 0xFFFF:
        return native.astype(np.uint16), (f"{native.dtype} taken as uint16",)
    with np.errstate(over="ignore"):
        pixels = np.ascontiguousarray(native, np.float32)
    _refuse_non_finite(path, pixels, holes=holes)
    return pixels, () if native.dtype == np.float32 else (f"{native.dtype} taken as float32",)


def _refuse_non_finite(path: Path, array: npt.NDArray[Any], *, holes: bool) -> None:
    finite = np.isfinite(array)
    if holes and finite.any():
        finite |= np.isnan(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise FileError(
            path,
            f"holds {array.size - int(finite.sum())} values that are no finite numbers "
            f"(the first, {array[where]}, at index {where}).",
            "Replace them, e.g. by the mean of their neighbours.",
        )


def _write_png(path: Path, image: npt.NDArray[Any]) -> None:
    ordered = image[..., ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".png", np.ascontiguousarray(ordered))
    if not done:
        raise FileError(path, f"could not be encoded as PNG: {image.dtype} {image.shape}.")
    path.write_bytes(data.tobytes())
