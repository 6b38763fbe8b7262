"""Decoding what an image file holds, to a plain array: TIFF, PNG, JPEG, BMP, NumPy, HDF5, MATLAB."""

from __future__ import annotations

import contextlib
import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from instrument.files import reading
from instrument.files.errors import FileError, size
from instrument.files.named_arrays import is_hdf5, is_matlab, ordered, read_hdf5, read_matlab
from instrument.files.tiff_pages import open_tiff

READABLE = "TIFF, PNG, JPEG, BMP, .npy, .npz, HDF5, MATLAB, OME-Zarr"
Decoded = tuple[npt.NDArray[Any], tuple[str, ...]]
"""An array as its file has it, stack first and colour last, and what was noticed in words."""
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8"
_OPENCV_MAGIC = (_PNG_MAGIC, _JPEG_MAGIC, b"BM")
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_MOST_BYTES = 1 << 35
_MOST_PICTURE_BYTES = 1 << 28
"""Of a PNG, JPEG or BMP."""
_MOST_HEADER, _MOST_LISTING = 1 << 16, 1 << 20


_RAW = (
    "is a camera's raw file, whose pixels are not read (a thumbnail at most). Make a linear 16-bit TIFF "
    "of it: dcraw -D -4 -T FILE, or rawpy.imread(FILE).raw_image, saved by numpy.save."
)
_RAW_SUFFIXES = (".arw", ".cr2", ".cr3", ".crw", ".dng", ".nef", ".orf", ".pef", ".raf", ".raw", ".rw2")
_TEXT_SUFFIXES = (".csv", ".dat", ".tsv", ".txt")


def _unreadable(path: Path) -> str:
    """Say of a file that begins as none which is read what it may be, and what to do."""
    suffix = path.suffix.lower()
    if suffix in _RAW_SUFFIXES:
        return _RAW
    if suffix in _TEXT_SUFFIXES:
        return "is text, no image. Make an array of its numbers: numpy.save('NAME.npy', numpy.loadtxt(FILE))."
    return f"is no image that can be read, or is damaged. Readable: {READABLE}."


def decode(path: Path, inside: str = "") -> Decoded:
    """Return a file's array; its content, not its name, tells the format.

    ``inside`` names one of several arrays of an HDF5, MATLAB or .npz file.

    Raises FileError.
    """
    try:
        n_bytes = reading.require_file(path, _MOST_BYTES)
        with path.open("rb") as file:
            beginning = file.read(1024)
    except FileNotFoundError:
        raise FileError(path, "there is no such file.") from None
    if not n_bytes:
        raise FileError(path, "is empty (0 bytes).")
    if is_hdf5(beginning):
        return read_hdf5(path, inside, of_matlab=beginning.startswith(b"MATLAB"))
    if is_matlab(beginning):
        return read_matlab(path, inside)
    if beginning.startswith(b"PK"):
        return _decode_npz(path, inside)
    if inside:
        raise FileError(path, f"is no HDF5, MATLAB or .npz file, so that nothing in it is called {inside}.")
    known = (b"\x93NUMPY", *_TIFF_MAGIC, *_OPENCV_MAGIC)
    if beginning and not beginning.startswith(known):  # before its size, which may be huge, is read
        raise FileError(path, _unreadable(path))
    if beginning[8:10] == b"CR" and beginning[:4] in _TIFF_MAGIC:  # Canon's, a TIFF of its thumbnail
        raise FileError(path, _RAW)
    if beginning.startswith(b"\x93NUMPY"):
        require_npy(path)
        with path.open("rb") as file:
            return _decode_npy(path, file, n_bytes)
    if beginning[:4] in _TIFF_MAGIC:
        return _decode_tiff(path)
    return _decode_with_opencv(path, reading.read_bytes(path, _MOST_PICTURE_BYTES))


def require_npy(path: Path) -> None:
    """Refuse an array of NumPy's that is damaged, or says to be far more than its file holds.

    Raises FileError.
    """
    n_bytes = reading.require_file(path)
    with path.open("rb") as file:
        promised = _npy_bytes(path, file, n_bytes)
    reading.require_plausible(path, promised, reading.stored_bytes(path))


def _npy_bytes(path: Path, file: IO[bytes], n_bytes: int) -> int:
    """Read a .npy header; return the bytes of the numbers that it says follow in the file's ``n_bytes``."""
    try:
        version = np.lib.format.read_magic(file)
        length = file.read(2 if version == (1, 0) else 4)
        if int.from_bytes(length, "little") > _MOST_HEADER:
            raise ValueError("its header has no end")
        header = io.BytesIO(length + file.read(int.from_bytes(length, "little")))
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(header)
        promised = int(math.prod(shape) * dtype.itemsize)
        if promised > n_bytes - 8 - header.tell():
            raise ValueError(f"it says {dtype} {shape}, which are more bytes than it has")
    except Exception as error:  # noqa: BLE001 - the header is Python text, whose parser raises nearly anything
        raise FileError(path, f"is damaged or no plain .npy array: {error!s:.200}.") from None
    return promised


def _decode_npy(path: Path, file: IO[bytes], n_bytes: int) -> Decoded:
    _npy_bytes(path, file, n_bytes)
    file.seek(0)
    try:
        array: npt.NDArray[Any] = np.load(file, allow_pickle=False)
    except Exception as error:  # noqa: BLE001 - as above
        raise FileError(path, f"is damaged or no plain .npy array: {error!s:.200}.") from None
    return array, ()


def _require_listing(path: Path) -> None:
    """Refuse an archive whose list of members, which is read as a whole, is no list of one."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - (1 << 16) - 200))
        tail = file.read()
    places = ((tail.rfind(b"PK\5\6"), 12, 4), (tail.rfind(b"PK\6\6"), 40, 8))
    for at, field, width in places:
        listed = int.from_bytes(tail[at + field : at + field + width], "little")
        if at >= 0 and _MOST_LISTING < listed != 0xFFFFFFFF:
            raise FileError(path, f"is a damaged .npz: its list of members has {size(listed)}.")


def _decode_npz(path: Path, inside: str) -> Decoded:
    _require_listing(path)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
            listed = ", ".join(list(arrays)[:8]) or "none"
            if inside and inside not in arrays:
                raise FileError(path, f"holds no array called {inside}; there are: {listed}.")
            if not inside and len(arrays) != 1:
                remedy = f"Name one: {path}::NAME." if arrays else ""
                problem = f"holds {len(arrays)} arrays ({listed}); one image is expected."
                raise FileError(path, problem, remedy)
            members = [arrays[inside]] if inside else list(arrays.values())
            said = members[0].file_size
            reading.require_plausible(path, said, reading.stored_bytes(path))
            with archive.open(members[0]) as member:
                if _npy_bytes(path, member, said) + _MOST_HEADER < said:
                    raise FileError(path, f"is damaged: its array has not the {size(said)} that it says.")
            with archive.open(members[0]) as member:
                content = member.read(said + 1)
            if len(content) > said:
                raise FileError(path, "is damaged: it holds more than it says.")
            return _decode_npy(path, io.BytesIO(content), said)
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None
    except (NotImplementedError, RuntimeError) as error:  # another compression, a password
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None


_OPENCV_KNOWS = {
    tifffile.COMPRESSION[name]
    for name in (
        "NONE",
        "CCITTRLE",
        "CCITTFAX3",
        "CCITTFAX4",
        "LZW",
        "JPEG",
        "ADOBE_DEFLATE",
        "PACKBITS",
        "DEFLATE",
    )
}
_LOSSY = "JPEG is lossy and usually gamma-coded: prefer raw frames"
_WHOLE_BYTES = (1, 8, 16, 32, 64)
_ORIENTATION = 274


def _decode_tiff(path: Path) -> Decoded:
    try:
        with open_tiff(path) as tiff:
            if not tiff.series:
                raise FileError(path, "is a TIFF without an image.")
            series = tiff.series[0]
            reading.require_plausible(path, series.size * series.dtype.itemsize, reading.stored_bytes(path))
            page: Any = series.keyframe
            _require_parts(path, series)
            if page.is_reduced and page.subifds:  # DNG, NEF, ARW: the sensor's pixels lie further in
                raise FileError(path, _RAW)
            notes = []
            if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
                return _decode_with_opencv(path, reading.read_bytes(path, _MOST_PICTURE_BYTES))
            if page.bitspersample in _WHOLE_BYTES:
                array = series.asarray()
            else:
                array = _unpacked(path, series, tiff.filehandle)
                notes.append(f"{page.bitspersample}-bit pixels unpacked")
            if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and array.dtype.kind == "u":
                array = (1 << page.bitspersample) - 1 - array if page.bitspersample < 16 else ~array
                notes.append("white-is-zero TIFF inverted")
            if len(tiff.series) > 1:
                notes.append(f"the first of its {len(tiff.series)} image series taken")
            turned = int(page.tags.valueof(_ORIENTATION, 1))
            if 2 <= turned <= 8:
                array = _upright(array, turned, series.axes)
                notes.append(_turned(turned))
            array, said = ordered(path, array, series.axes)
            return array, (*notes, *said)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged TIFF raises nearly anything
        if "imagecodecs" in str(error) or isinstance(error, ImportError):  # OpenCV knows more compressions
            return _decode_compressed(path)
        raise FileError(path, f"is a damaged or unusual TIFF: {error}.") from None


def _decode_compressed(path: Path) -> Decoded:
    """Decode a TIFF in a compression that OpenCV knows, all images of its first series."""
    with open_tiff(path) as tiff:
        series: Any = tiff.series[0]
        pages = [page.index for page in series.pages if page is not None]
        axes, lead = series.axes, series.shape[: -series.keyframe.ndim]
        turned = int(series.keyframe.tags.valueof(_ORIENTATION, 1))
        kind = tifffile.COMPRESSION(series.keyframe.compression)
    said: tuple[str, ...] = (_turned(turned),) if 2 <= turned <= 8 else ()  # OpenCV turns it
    said += (_LOSSY,) if kind is tifffile.COMPRESSION.JPEG else ()
    data = reading.read_bytes(path, _MOST_PICTURE_BYTES)
    if kind not in _OPENCV_KNOWS:
        raise FileError(
            path, f"is compressed as {kind.name}, which is not read.", "Save it as LZW, or plain."
        )
    if len(pages) == 1:
        array, notes = _decode_with_opencv(path, data)
        return array, (*notes, *said)
    _refuse_odd_bits(path)
    with _quiet_opencv():
        try:
            first, end = min(pages), max(pages) + 1  # other series may be of any size
            encoded = np.frombuffer(data, np.uint8)
            images = cv2.imdecodemulti(encoded, cv2.IMREAD_UNCHANGED, range=(first, end))[1]
            stack = np.stack([_rgb(images[page - first]) for page in pages])
            array = stack.reshape(*lead, *stack.shape[1:])
        except (cv2.error, MemoryError, ValueError, IndexError, TypeError) as error:
            raise FileError(path, f"is a damaged or unusual TIFF: {error!s:.200}.") from None
    array, more = ordered(path, array, axes)
    return array, (*said, *more)


def _require_parts(path: Path, series: Any) -> None:
    """Refuse pages that name fewer strips or tiles than they have: the others would be read as dark."""
    needed = math.prod(series.keyframe.chunked)
    for page in series.pages:
        if page is not None and not page.is_contiguous and len(page.dataoffsets) < needed:
            raise FileError(
                path,
                f"is a damaged TIFF: a page has {needed} strips or tiles and names {len(page.dataoffsets)}.",
            )


def _unpacked(path: Path, series: Any, file: Any) -> npt.NDArray[np.uint16]:
    """Return pixels of 2 to 15 bits that stand without gaps, the highest bit first, rows at whole bytes."""
    page = series.keyframe
    bits, fill = int(page.bitspersample), page.tags.valueof("FillOrder", 1)
    if page.compression != 1 or page.is_tiled or page.planarconfig != 1 or fill != 1 or not 1 < bits < 16:
        raise FileError(
            path,
            f"has {bits}-bit pixels, compressed, tiled or in an unusual order.",
            "Convert it to 16 bit without compression.",
        )
    values = page.imagewidth * page.samplesperpixel
    row_bytes = -(-values * bits // 8)
    pages = []
    for one in series.pages:
        packed = b""
        for offset, count in zip(one.dataoffsets, one.databytecounts, strict=True):
            file.seek(offset)
            packed += file.read(min(count, page.imagelength * row_bytes))
        rows = np.frombuffer(packed, np.uint8, page.imagelength * row_bytes).reshape(-1, row_bytes)
        pixels = np.unpackbits(rows, axis=1)[:, : values * bits].reshape(len(rows), values, bits)
        filled = np.pad(pixels, ((0, 0), (0, 0), (16 - bits, 0)))
        pages.append(np.packbits(filled, axis=2).view(">u2")[..., 0].astype(np.uint16))
    return np.stack(pages).reshape(series.shape)


def _upright(array: npt.NDArray[Any], orientation: int, axes: str) -> npt.NDArray[Any]:
    """Turn and mirror images so that the first row is at the top (TIFF 6.0, tag 274)."""
    y, x = axes.index("Y"), axes.index("X")
    if orientation >= 5:
        array = np.swapaxes(array, y, x)
    down = orientation in (3, 4, 7, 8)
    left = orientation in (2, 3, 6, 7)
    return np.flip(array, tuple(axis for axis, flips in ((y, down), (x, left)) if flips))


def _decode_with_opencv(path: Path, data: bytes) -> Decoded:
    if data[:4] in _TIFF_MAGIC:
        _refuse_odd_bits(path)
    if data.startswith(_PNG_MAGIC) and not _png_is_whole(data):
        raise FileError(path, "is a damaged PNG: its parts are longer than the file, or out of order.")
    shape = _shape_by_header(data)
    if shape is not None:
        reading.require_plausible(path, 8 * math.prod(shape), len(data))
    with _quiet_opencv():
        try:
            array = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except (cv2.error, MemoryError):
            array = None
    if array is None:
        raise FileError(path, f"is no image that can be read, or is damaged. Readable: {READABLE}.")
    array = _rgb(array)
    notes = []
    if data.startswith(_JPEG_MAGIC):
        notes.append(_LOSSY)
    if 2 <= (turned := _exif_orientation(data)) <= 8:
        array = _upright(array, turned, "YXS")
        notes.append(_turned(turned))
    return array, tuple(notes)


@contextlib.contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV silent: a damaged file is told of once, in our words."""
    loudness = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(loudness)


def _rgb(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an image of OpenCV's with its colours the other way round."""
    if array.ndim == 3 and array.shape[-1] >= 3:
        array = array[..., [2, 1, 0, *range(3, array.shape[-1])]]
    return array


def _turned(orientation: int) -> str:
    return f"turned upright as its orientation ({orientation}) says"


def _exif_orientation(data: bytes) -> int:
    """Return how a JPEG or PNG says that it stands, as a TIFF's tag 274; 1 where it says nothing."""
    mark = b"Exif\0\0" if data.startswith(_JPEG_MAGIC) else b"eXIf"
    place = data.find(mark) if data.startswith((_JPEG_MAGIC, _PNG_MAGIC)) else -1
    if place < 0:
        return 1
    from PIL import Image  # of Matplotlib's own needs; OpenCV turns only what it also changes otherwise

    exif = Image.Exif()
    try:
        exif.load(b"Exif\0\0" + data[place + len(mark) : place + len(mark) + _MOST_HEADER])
        return int(exif.get(_ORIENTATION, 1))
    except Exception:  # noqa: BLE001 - a damaged note beside a whole picture raises nearly anything
        return 1


def _refuse_odd_bits(path: Path) -> None:
    """OpenCV stretches pixels of 9 to 15 bits to 16 without a word."""
    with open_tiff(path) as tiff:
        bits = tiff.pages.first.bitspersample
    if bits not in _WHOLE_BYTES:
        raise FileError(
            path, f"has {bits}-bit pixels that are compressed.", "Convert it to 16 bit without compression."
        )


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
