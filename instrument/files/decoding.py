"""Decoding what an image file holds, to a plain array: TIFF, PNG, JPEG, BMP, NumPy, HDF5, MATLAB.

And where the images of a stack lie, by arrays beside it, its side-car or its format: one check for all.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from instrument.files import matlab, reading
from instrument.files.errors import FileError, os_reason, size
from instrument.files.named_arrays import Expect, is_hdf5, is_matlab, outline, read_hdf5, read_matlab
from instrument.files.pictures import MAGIC, READABLE, Decoded, decode_picture
from instrument.files.tiffs import RAW, decode_tiff
from recon.arrays import Array

_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_MOST_BYTES = 1 << 35
_BEGINNING = 4200
"""Bytes in which each format says what it is; HDF5 after a block of its user's."""
_MOST_HEADER, _MOST_LISTING = 1 << 16, 1 << 20


_RAW_SUFFIXES = (".arw", ".cr2", ".cr3", ".crw", ".dng", ".nef", ".orf", ".pef", ".raf", ".raw", ".rw2")
_ZARR_MARKS = {"zarr.json", ".zgroup", ".zarray"}
_TEXT_SUFFIXES = (".csv", ".dat", ".tsv", ".txt")
_LOSSY = "which is made for the eye and not read. Take the camera's own files, or save it as PNG"
_AS_STACK = "which is not read. Export it as OME-TIFF (in Fiji: Bio-Formats)"
_FILM = (
    "is a compressed film: its frames are no measurement any more. Take a recording, or images that are not "
    "compressed."
)
_AVI = (
    "is an AVI film, which is not read, compressed or not. Of frames that are not compressed make a TIFF "
    "stack (in Fiji: open it, save it as Tiff); compressed ones are no measurement any more."
)
_OTHERS: tuple[tuple[int, bytes, str], ...] = (
    (8, b"WEBP", f"is a WebP picture, {_LOSSY}."),
    (4, b"ftypheic", f"is a HEIC picture, {_LOSSY}."),
    (4, b"ftypmif1", f"is a HEIC picture, {_LOSSY}."),
    (4, b"ftypavif", f"is an AVIF picture, {_LOSSY}."),
    (4, b"ftyp", _FILM),
    (8, b"AVI ", _AVI),
    (0, b"\x1aE\xdf\xa3", _FILM),
    (0, b"GIF8", f"is a GIF picture of 256 colours, {_LOSSY}."),
    (0, b"v/1\x01", "is an OpenEXR picture, which is not read. Save it as 32-bit TIFF."),
    (
        0,
        b"SIMPLE  =",
        "is a FITS file. Make an array of it: numpy.save('NAME.npy', astropy.io.fits.getdata(FILE)).",
    ),
    (0, b"ZISRAWFILE", f"is a Zeiss CZI file, {_AS_STACK}."),
    (0, b"\xda\xce\xbe\n", f"is a Nikon ND2 file, {_AS_STACK}."),
    (0, b"\x70\0\0\0", f"is a Leica LIF file, {_AS_STACK}."),
)
"""Where others' files say what they are, and what to do; the first that fits counts."""


def _unreadable(path: Path, beginning: bytes) -> str:
    """Say of a file that begins as none which is read what it may be, and what to do."""
    suffix = path.suffix.lower()
    if suffix in _RAW_SUFFIXES:
        return RAW
    for at, mark, words in _OTHERS:
        if beginning[at:].startswith(mark):
            return words
    if suffix in _TEXT_SUFFIXES:
        return "is text, no image. Make an array of its numbers: numpy.save('NAME.npy', numpy.loadtxt(FILE))."
    if suffix == ".mat":
        return "is damaged, or a MATLAB file before version 5. Save it anew: save('NAME.mat', '-v7')."
    return f"is no image that can be read, or is damaged. Readable: {READABLE}."


_PACKED = (".docx", ".pptx", ".xlsx", ".odt", ".odp", ".ods")
"""Of files that are packed as .npz files are, and hold other things."""


def decode(path: Path, inside: str, expect: Expect) -> Decoded:
    """Return a file's array; its content, not its name, tells the format.

    ``inside`` names one of several arrays of an HDF5, MATLAB or .npz file. ``expect`` refuses what is not
    wanted, before it is read: it is given an array of its shape that takes no memory.

    Raises FileError.
    """
    try:
        n_bytes = reading.require_file(path, _MOST_BYTES)
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING)
    except FileNotFoundError:
        raise FileError(path, "there is no such file.") from None
    except OSError as failure:
        raise FileError(path, f"cannot be read: {os_reason(failure)}") from None
    if not n_bytes:
        raise FileError(path, "is empty (0 bytes).")
    if is_hdf5(beginning):
        return read_hdf5(path, inside, of_matlab=beginning.startswith(b"MATLAB"), expect=expect)
    if is_matlab(beginning):
        return read_matlab(path, inside, expect=expect)
    if beginning.startswith(b"PK") and path.suffix.lower() not in _PACKED:
        return _decode_npz(path, inside, expect)
    if inside:
        raise FileError(path, f"is no HDF5, MATLAB or .npz file, so that nothing in it is called {inside}.")
    known = (b"\x93NUMPY", *_TIFF_MAGIC, *MAGIC)
    if beginning and not beginning.startswith(known):  # before its size, which may be huge, is read
        raise FileError(path, _unreadable(path, beginning))
    if beginning[8:10] == b"CR" and beginning[:4] in _TIFF_MAGIC:  # Canon's, a TIFF of its thumbnail
        raise FileError(path, RAW)
    if beginning.startswith(b"\x93NUMPY"):
        require_npy(path)
        with path.open("rb") as file:
            return _decode_npy(path, file, n_bytes, expect)
    if beginning[:4] in _TIFF_MAGIC:
        return decode_tiff(path, expect)
    return decode_picture(path)


def require_npy(path: Path) -> None:
    """Refuse an array of NumPy's that is damaged, or says to be far more than its file holds.

    Raises FileError.
    """
    n_bytes = reading.require_file(path)
    with path.open("rb") as file:
        promised = _npy_outline(path, file, n_bytes).nbytes
    reading.require_plausible(path, promised, reading.stored_bytes(path))


def _npy_outline(path: Path, file: IO[bytes], n_bytes: int) -> Array:
    """Read a .npy header; return the outline of what it says follows in the file's ``n_bytes``.

    Raises FileError.
    """
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
        if dtype.hasobject:
            raise ValueError("it holds objects of Python's")
        told = outline(shape, dtype)
    except Exception as error:  # noqa: BLE001 - the header is Python text, whose parser raises nearly anything
        raise FileError(path, f"is damaged or no plain .npy array: {error!s:.200}.") from None
    return told


def _decode_npy(path: Path, file: IO[bytes], n_bytes: int, expect: Expect) -> Decoded:
    expect(_npy_outline(path, file, n_bytes))
    file.seek(0)
    try:
        array: Array = np.load(file, allow_pickle=False)
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


def _decode_npz(path: Path, inside: str, expect: Expect) -> Decoded:
    _require_listing(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if _ZARR_MARKS & {name.rpartition("/")[2] for name in archive.namelist()}:
                raise FileError(path, "is a zipped Zarr, which is not read.", "Unpack it to a folder.")
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
                told = _npy_outline(path, member, said)
            if told.nbytes + _MOST_HEADER < said:
                raise FileError(path, f"is damaged: its array has not the {size(said)} that it says.")
            expect(told)
            with archive.open(members[0]) as member:
                content = member.read(said + 1)
            if len(content) > said:
                raise FileError(path, "is damaged: it holds more than it says.")
            return _decode_npy(path, io.BytesIO(content), said, expect)
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None
    except (NotImplementedError, RuntimeError) as error:  # another compression, a password
        raise FileError(path, f"is no .npz with one plain array: {error}.") from None


# Where the images of a stack lie --------------------------------------------------------------------
_UNITS_UM = {
    f"{what}_{unit}": um for what in ("depths", "depth", "z") for unit, um in (("um", 1.0), ("mm", 1e3))
}
"""Names of arrays that tell where the images of their file's stack lie, and their unit."""

_LIKE_DEPTHS = re.compile(r"(?:z|depth|distance|focus|position|pos)s?(?:_?(?:nm|um|mm|cm|m))?", re.IGNORECASE)
"""Names that somebody may have given to depths."""
_KINDS = {"b": "booleans", "c": "complex numbers", "U": "text", "S": "text", "O": "objects of Python's"}
_OF_FORMAT = "depths_um of its metadata"
_SAME = 1e-6
"""Depths that agree to this part of the farthest are the same: single precision, millimetres."""


class DepthsError(FileError):
    """An array that tells where images lie does not."""


def depths_told(path: Path, count: int, of_format: Any) -> tuple[list[float], tuple[str, ...]]:
    """Return where so many images of a stack lie, micrometres, and what to say; empty where nothing tells.

    ``of_format`` is what the file's format, or its side-car, tells as ``depths_um``; what cannot be taken of
    it is said, as who has the file seldom wrote it. Arrays of an HDF5, MATLAB or .npz file tell by their
    names; one of as many depths as another stack of the file has images is of that stack. A depth may be 0 or
    below, and twice the same, as a stage counts: who takes depths for distances looks at that.

    Raises DepthsError where an array has another number of depths, or anything but finite real numbers,
    or two disagree.
    """
    if count < 2:
        return [], ()
    said: tuple[str, ...] = ()
    found: dict[str, list[float]] = {}
    held = _held(path)
    shapes = {name: shape for name, shape in held.items() if not isinstance(shape, str)}
    n_told = len(of_format) if isinstance(of_format, list) else int(of_format is not None)
    if n_told and not _of_another_stack(n_told, shapes, count):
        try:
            found[_OF_FORMAT] = _checked(path, _OF_FORMAT, of_format, count)
        except DepthsError as error:
            said = (f"{error.problem.rstrip('.')}: not taken",)
    for name, um in _UNITS_UM.items():
        n_told = math.prod(shapes.get(name, (0,)))
        if isinstance(other := held.get(name), str):
            raise _refused(path, f"array {name}", f"is {other}", count)
        if n_told == 1:
            said = (*said, f"its array {name} is one number for {count} images: not taken")
        elif name in shapes and not _of_another_stack(n_told, shapes, count):
            what = f"array {name}"
            found[what] = _checked(path, what, _read(path, name, count), count, um)
    if not found:
        return [], (*said, *_perhaps_depths(held, count))
    first, *others = found
    for other in others:
        apart_um = np.abs(np.subtract(found[first], found[other]))
        if apart_um.max() > _SAME * np.abs(found[first]).max():
            at = int(apart_um.argmax())
            raise DepthsError(
                path,
                f"its {first} and its {other} disagree about where its images lie: image {at} is at "
                f"{found[first][at]:g} um by the one, at {found[other][at]:g} um by the other.",
                "Leave out, or call otherwise, the one that is wrong.",
            )
    return found[first], said


def _perhaps_depths(held: Mapping[str, tuple[int, ...] | str], count: int) -> Iterator[str]:
    """Say which arrays could tell depths and do not, as their names are not those that do."""
    for name, shape in held.items():
        if name in _UNITS_UM or not _LIKE_DEPTHS.fullmatch(name):
            continue
        if isinstance(shape, str) or count in (math.prod(shape), *shape[:1]):
            found = f" is {shape} and" if isinstance(shape, str) else ""
            yield f"its {name}{found} tells no depths: numbers are taken that are called z_mm or z_um"


def _checked(path: Path, what: str, told: Any, count: int, um: float = 1.0) -> list[float]:
    """Return depths in micrometres; raises DepthsError where they are none of so many images."""
    try:
        values = np.asarray(told)
        kind = values.dtype.kind
        in_words = _KINDS.get(kind, f"values of type {values.dtype}")
    except ValueError:  # rows of unequal length
        raise _refused(path, what, "holds no array", count) from None
    if kind not in "uif":
        raise _refused(path, what, f"holds {in_words}", count)
    if values.size != count or max(values.shape) != count:
        shape = " x ".join(map(str, values.shape)) or "1"
        raise _refused(path, what, f"has {shape} of them", count)
    with np.errstate(over="ignore"):
        depths_um = um * values.astype(np.float64).ravel()
    if not (finite := np.isfinite(depths_um)).all():
        at = int(np.argmin(finite))
        raise _refused(path, what, f"says {values.ravel()[at]:g} for image {at}", count)
    return [float(depth) for depth in depths_um]


def _refused(path: Path, what: str, found: str, count: int) -> DepthsError:
    return DepthsError(
        path,
        f"its {what} tells where the images lie, {count} finite numbers are expected, and it {found}.",
        "Save it anew, or under another name where it is of something else.",
    )


def _read(path: Path, name: str, count: int) -> Any:
    """Return an array of the file; raises DepthsError where it is none of numbers."""
    try:
        return decode(path, name, lambda _shape: None)[0]
    except FileError as error:
        found = f"cannot be read as such: {error.problem.rstrip('.')}"
        raise _refused(path, f"array {name}", found, count) from None


def _of_another_stack(n_told: int, shapes: Mapping[str, tuple[int, ...]], count: int) -> bool:
    """Whether so many depths are those of another stack of the file."""
    stacks = [shape for shape in shapes.values() if sum(side > 1 for side in shape) >= 3]
    return n_told != count and any(n_told in (shape[0], shape[-1]) for shape in stacks)


def _held(path: Path) -> dict[str, tuple[int, ...] | str]:
    """Return the shapes of a file's arrays by their names, or what they are in words where that is no array.

    Empty for files of one array.
    """
    if not path.is_file():
        return {}
    with path.open("rb") as file:
        beginning = file.read(_BEGINNING)
    if is_hdf5(beginning):
        return _of_hdf5(path)
    if is_matlab(beginning):
        found = matlab.contents(path)
        return {name: one if isinstance(one, str) else one.shape for name, one in found.items()}
    return _of_npz(path) if beginning.startswith(b"PK") else {}


_MATLAB_CLASSES = {"char": "text", "cell": "a cell", "struct": "a structure", "string": "text"}


def _of_hdf5(path: Path) -> dict[str, tuple[int, ...] | str]:
    import h5py  # the stack was read with it

    found: dict[str, tuple[int, ...] | str] = {}

    def note(name: str, entry: Any) -> None:
        kind = entry.attrs.get("MATLAB_class", b"")  # of version 7.3
        if other := _MATLAB_CLASSES.get(kind.decode() if isinstance(kind, bytes) else str(kind)):
            found[name] = other
        elif isinstance(entry, h5py.Dataset):
            found[name] = entry.shape or ()

    with h5py.File(path, "r") as file:
        file.visititems(note)
    return found


def _of_npz(path: Path) -> dict[str, tuple[int, ...] | str]:
    found: dict[str, tuple[int, ...] | str] = {}
    with zipfile.ZipFile(path) as archive:
        for one in archive.infolist():
            name = one.filename.removesuffix(".npy")
            found[name] = (0,)  # objects of Python's, or damaged
            with contextlib.suppress(FileError), archive.open(one) as member:
                found[name] = _npy_outline(path, member, one.file_size).shape
    return found
