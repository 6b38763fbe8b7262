"""Arrays of numbers in MATLAB files of version 5 to 7 ("MAT-File Format", MathWorks, chapter 1).

Our own reader, as scipy.io's ends the program with a segmentation fault where such a file is damaged
(scipy 1.17, found by fuzzing). Of text, cells, structures, objects and sparse matrices it knows the names.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from instrument.files import reading
from recon.arrays import Array

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Kinds of stored numbers. MATLAB stores those of any class as the smallest kind that holds them all."""
_NUMBERS = range(6, 16)
"""Classes of arrays that are numbers: double, single, and integers of 8 to 64 bits."""
_OTHERS = {1: "a cell", 2: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix"}
_COMPLEX = 0x800
_PIECE = 1 << 20
_MOST_PARTS = 10_000
_DESCRIPTION = 1 << 16
"""Bytes of a compressed array in which its shape and name stand."""


class _Element(NamedTuple):
    kind: int
    at: int
    """Where its data begin."""
    n_bytes: int
    after: int
    """Where the next one begins."""


@dataclass(frozen=True)
class MatlabArray:
    """An array of numbers in a file."""

    name: str
    shape: tuple[int, ...]
    is_complex: bool
    element: _Element
    """As it lies in the file."""


def arrays_in(path: Path) -> dict[str, MatlabArray]:
    """Return the arrays of numbers by name; of several of one name the last, as MATLAB does.

    Raises ValueError, EOFError or zlib.error when the file is damaged; OSError when it cannot be read.
    """
    return {name: array for name, array in contents(path).items() if isinstance(array, MatlabArray)}


def contents(path: Path) -> dict[str, MatlabArray | str]:
    """Return what a file holds by name: arrays of numbers, and what others are in words; as arrays_in."""
    found: dict[str, MatlabArray | str] = {}
    with path.open("rb") as file:
        order = _order(file)
        for element in _elements(file, order, _HEADER, path.stat().st_size):
            if element.kind not in (_MATRIX, _COMPRESSED) or not element.n_bytes:
                continue
            with _matrix(file, order, element, _DESCRIPTION) as content:
                described = _described(content, order)
            if described is not None:
                name, shape, is_complex, _, other = described
                found[name] = other or MatlabArray(name, shape, is_complex, element)
    return found


def read_array(path: Path, array: MatlabArray) -> Array:
    """Read an array, with the kind of number that it is stored as; errors as :func:`arrays_in`.

    Raises FileError when it says to be far more than the file can hold.
    """
    parts = 2 if array.is_complex else 1
    most = parts * 8 * math.prod(array.shape)
    reading.require_plausible(path, most, reading.stored_bytes(path))
    with path.open("rb") as file:
        order = _order(file)
        with _matrix(file, order, array.element, _DESCRIPTION + most) as content:
            described = _described(content, order)
            if described is None or described.other:
                raise ValueError(f"{array.name} is no array of numbers any more")
            at = described.at
            numbers = []
            for _ in range(parts):
                part = _element(content, order, at)
                if part.kind not in _STORED:
                    raise ValueError(f"{array.name} is stored as kind {part.kind}, which is no number")
                dtype = np.dtype(order + _STORED[part.kind])
                if part.n_bytes != dtype.itemsize * math.prod(array.shape):
                    raise ValueError(f"{array.name} is {array.shape} and has {part.n_bytes} bytes")
                stored = np.frombuffer(_data(content, part), dtype)
                numbers.append(stored.astype(dtype.newbyteorder("=")).reshape(array.shape, order="F"))
                at = part.after
    return numbers[0] if parts == 1 else numbers[0] + 1j * numbers[1]


def _order(file: IO[bytes]) -> str:
    file.seek(_HEADER - 2)
    return "<" if file.read(2) == b"IM" else ">"


def _elements(file: IO[bytes], order: str, at: int, end: int) -> Iterator[_Element]:
    for _ in range(_MOST_PARTS):
        if at + 8 > end:
            return
        element = _element(file, order, at)
        if element.at + element.n_bytes > end:
            raise EOFError(f"it ends within a part of {element.n_bytes} bytes")
        yield element
        at = element.after
    raise ValueError(f"it has more than {_MOST_PARTS} parts")


def _element(file: IO[bytes], order: str, at: int) -> _Element:
    """Return the element that begins at a byte; a small one has its data in its tag."""
    file.seek(at)
    tag = file.read(8)
    if len(tag) < 8:
        raise EOFError("it ends within a tag")
    kind, n_bytes = struct.unpack(f"{order}II", tag)
    if kind >> 16:
        if kind >> 16 > 4:
            raise ValueError(f"it has a small part of {kind >> 16} bytes; four are the most")
        return _Element(kind & 0xFFFF, at + 4, kind >> 16, at + 8)
    filled = n_bytes if kind == _COMPRESSED else -(-n_bytes // 8) * 8
    return _Element(kind, at + 8, n_bytes, at + 8 + filled)


def _data(file: IO[bytes], element: _Element) -> bytes:
    file.seek(element.at)
    data = file.read(element.n_bytes)
    if len(data) < element.n_bytes:
        raise EOFError(f"it ends within a part of {element.n_bytes} bytes")
    return data


def _matrix(file: IO[bytes], order: str, element: _Element, most: int) -> IO[bytes]:
    """Return what an array consists of, or the first ``most`` bytes of it; empty when it is none."""
    if element.kind == _MATRIX:
        return io.BytesIO(_data(file, element._replace(n_bytes=min(element.n_bytes, most))))
    packed, content, left = zlib.decompressobj(), b"", element.n_bytes
    file.seek(element.at)
    while len(content) < most and left > 0 and not packed.eof and (piece := file.read(min(left, _PIECE))):
        content += packed.decompress(piece, most - len(content))
        left -= len(piece)
    inner = _element(io.BytesIO(content), order, 0)
    return io.BytesIO(content[inner.at :] if inner.kind == _MATRIX else b"")


class _Described(NamedTuple):
    name: str
    shape: tuple[int, ...]
    is_complex: bool
    at: int
    """Where its numbers begin."""
    other: str
    """What it is in words where it is no array of numbers, else empty."""


def _described(content: IO[bytes], order: str) -> _Described | None:
    """Return what a matrix says of itself; None where its kind is not known."""
    flags = _element(content, order, 0)
    (word,) = struct.unpack(f"{order}I", _data(content, flags)[:4])
    kind = word & 0xFF
    if kind not in _NUMBERS and kind not in _OTHERS:
        return None
    sides = _element(content, order, flags.after)
    name = _element(content, order, sides.after)
    shape = tuple(int(n) for n in np.frombuffer(_data(content, sides), f"{order}i4"))
    if not 2 <= len(shape) <= 32 or min(shape) < 0:
        raise ValueError(f"it has an array of the shape {shape}")
    text = _data(content, name).decode("latin-1")
    return _Described(text, shape, bool(word & _COMPLEX), name.after, _OTHERS.get(kind, ""))
