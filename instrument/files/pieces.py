"""Compressed pieces of arrays, held against what they may hold: a few of zeros inflate a thousandfold.

Headers say how large an array is, and are checked before memory is taken (:mod:`instrument.files.reading`).
How large a piece of it becomes says only the piece itself, or who inflates it: TIFF, HDF5 and Zarr have it
inflated whole, whatever the array says.
"""

from __future__ import annotations

import io
import lzma
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import IO, Any

import numpy as np

from instrument.files.errors import FileError, size

_SLACK_BYTES = 1 << 20
_HARMLESS_BYTES = 512
"""A piece so small inflates to some megabytes at most, whatever it is."""
_DEFLATES = 1040
"""By how much deflate shrinks zeros, at most (1032)."""
_LZF = 32000
"""HDF5's number of h5py's own filter."""
_SZIP, _FLETCHER32 = 4, 3
_LZF_SHRINKS = 88
"""By how much LZF shrinks zeros, at most: 264 bytes in three."""
MOST_LZF_EXPANSION = 40
"""No photograph shrinks so much under LZF."""
_BLOCK_BYTES = 1 << 16
_ZSTD_BLOCK_BYTES = 1 << 17
_UNTOLD_BYTES = 1 << 28
"""What blocks may come to that tell their sizes as bounds only: a writer may have cut them short."""
_ZSTD, _GZIP, _BLOSC_VERSIONS = b"\x28\xb5\x2f\xfd", b"\x1f\x8b", (1, 2)
_DEFLATE, _LZMA = (8, 32946, 50013), 34925
"""Numbers of TIFF's compressions."""


def piece_bytes(*arrays: Any) -> int:
    """Return what a piece of HDF5 or Zarr arrays holds at most: a chunk, or a shard of several."""
    shapes = ((getattr(array, "shards", None) or array.chunks, array.dtype) for array in arrays)
    return max(math.prod(map(int, shape)) * int(dtype.itemsize) for shape, dtype in shapes)


def require_pieces(
    path: Path,
    pieces: Iterable[tuple[int, Callable[[], IO[bytes]]]],
    holds_bytes: int,
    *,
    error: type[FileError] = FileError,
) -> None:
    """Refuse a file of which a piece inflates to far more than the array's pieces hold.

    Parameters
    ----------
    path : Path
        Named in the error.
    pieces : iterable of (int, callable)
        Bytes that each has as it is stored, and what opens it.
    holds_bytes : int
        What one holds, inflated.
    """
    most = 2 * holds_bytes + _SLACK_BYTES
    for stored, opened in pieces:
        if stored <= _HARMLESS_BYTES:
            continue
        with opened() as piece:
            if inflates_beyond(piece, stored, most):
                raise _beyond(path, most, holds_bytes, error)


def _beyond(path: Path, most: int, holds_bytes: int, error: type[FileError]) -> FileError:
    return error(
        path,
        f"holds a piece that inflates to over {size(most)}, for {size(holds_bytes)} of numbers: "
        "it is damaged, or made to fill the memory.",
    )


def lzf_place(stored: Any) -> int | None:
    """Return which of an HDF5 dataset's filters is LZF; None where none is."""
    numbers = _filters(stored)
    return numbers.index(_LZF) if _LZF in numbers else None


def _filters(stored: Any) -> list[int]:
    """Return HDF5's numbers of a dataset's filters, in the order in which they were applied."""
    plist = stored.get_create_plist()
    return [int(plist.get_filter(n)[0]) for n in range(plist.get_nfilters())]


def require_szip_pieces(path: Path, stored: Any, holds_bytes: int) -> None:
    """Refuse an HDF5 dataset with a szip chunk that becomes far more than a chunk holds; as `require_pieces`.

    Its first four bytes tell what becomes of it, and it becomes no more (HDF5, H5Zszip.c).
    """
    numbers, most = [n for n in _filters(stored) if n != _FLETCHER32], 2 * holds_bytes + _SLACK_BYTES
    if numbers[-1:] != [_SZIP]:
        return
    place = _filters(stored).index(_SZIP)
    chunks: list[Any] = []
    stored.chunk_iter(chunks.append)
    for chunk in chunks:
        if not chunk.filter_mask >> place & 1:
            data = stored.read_direct_chunk(chunk.chunk_offset)[1]
            if int.from_bytes(data[:4], "little") > most:
                raise _beyond(path, most, holds_bytes, FileError)


def require_lzf_pieces(path: Path, stored: Any, holds_bytes: int) -> None:
    """Refuse an HDF5 dataset with an LZF chunk that becomes far more than a chunk holds; as `require_pieces`.

    Chunks that cannot become more than 256 MB, by their size or :func:`_lzf_most`, are not walked through,
    and others as far as what follows could make that much: it is slower than to inflate them.
    """
    place, most = lzf_place(stored), max(2 * holds_bytes + _SLACK_BYTES, _UNTOLD_BYTES)
    chunks: list[Any] = []
    if place is not None:
        stored.chunk_iter(chunks.append)
    for chunk in chunks:
        could = not chunk.filter_mask >> place & 1 and chunk.size * _LZF_SHRINKS > most
        if not could:
            continue
        data = stored.read_direct_chunk(chunk.chunk_offset)[1]
        left = _lzf_most(data)
        if left[0] > most and _lzf_beyond(data, most, left):
            raise _beyond(path, most, holds_bytes, FileError)


def _lzf_most(data: bytes) -> list[int]:
    """Return what LZF data become at most from each block on, wherever in them runs and copies begin.

    Of two bytes at one. A run is shorter than it is stored. A copy of two bytes is longer by its first byte's
    upper bits, one of three by 6 and its second byte.
    """
    each = []
    for start in range(0, len(data), _BLOCK_BYTES):
        block = np.frombuffer(data[start : start + _BLOCK_BYTES + 1].ljust(_BLOCK_BYTES + 1, b"\0"), "u1")
        longer = np.where(block[:-1] < 224, block[:-1] >> 5, block[1:].astype(np.uint16) + 6)
        each.append(min(_BLOCK_BYTES, len(data) - start) + int(np.maximum(longer[::2], longer[1::2]).sum()))
    return list(accumulate(reversed(each)))[::-1]


def _lzf_beyond(data: bytes, most: int, left: Sequence[int]) -> bool:
    """Add up what the runs and copies of LZF data say of their lengths (liblzf, lzf_d.c).

    ``left``: what they become at most from each block on (:func:`_lzf_most`).
    """
    at = n_bytes = 0
    for block, rest in enumerate(left):
        if n_bytes + rest <= most:
            return False
        end = min(len(data), (block + 1) * _BLOCK_BYTES)
        while at < end and n_bytes <= most:
            if data[at] < 32:  # so many bytes as they are, and one
                n_bytes += data[at] + 1
                at += data[at] + 2
            elif data[at] < 224:
                n_bytes += (data[at] >> 5) + 2
                at += 2
            else:
                n_bytes += 9 + (data[at + 1] if at + 1 < len(data) else 0)
                at += 3
    return n_bytes > most


def hdf5_pieces(stored: Any) -> Iterator[tuple[int, Callable[[], IO[bytes]]]]:
    """Yield the chunks of an HDF5 dataset, ``h5py.h5d.DatasetID``, as they are stored."""
    chunks: list[Any] = []
    stored.chunk_iter(chunks.append)  # asked one by one the index is walked for each
    for chunk in chunks:
        yield chunk.size, lambda: io.BytesIO(stored.read_direct_chunk(chunk.chunk_offset)[1])  # noqa: B023


def inflates_beyond(piece: IO[bytes], stored: int, most: int) -> bool:
    """Whether a compressed piece becomes more than so many bytes; False for what is not compressed.

    Blosc tells it in its beginning (c-blosc, README_HEADER), Zstandard there or by its blocks (RFC 8878,
    3.1.1), deflate (zlib, gzip) only while it is inflated.
    """
    head = piece.read(16)
    piece.seek(0)
    if head.startswith(_ZSTD):
        return _zstd_beyond(piece, most)
    if head.startswith(_GZIP) or (head[:1] == b"\x78" and int.from_bytes(head[:2]) % 31 == 0):
        return stored * _DEFLATES > most and _deflated_beyond(piece, most)
    if len(head) == 16 and head[0] in _BLOSC_VERSIONS:
        n_bytes, _, with_head = struct.unpack("<III", head[4:])
        return bool(with_head == stored and n_bytes > most)
    return False


def _zstd_beyond(piece: IO[bytes], most: int) -> bool:
    """Look at each frame: its header may tell its size; else its blocks tell what they are at most."""
    n_bytes = blocks = 0
    while piece.read(4) == _ZSTD and len(begins := piece.read(1)) == 1:
        single, has_sum = begins[0] >> 5 & 1, begins[0] >> 2 & 1
        piece.seek(1 - single + (0, 1, 2, 4)[begins[0] & 3], io.SEEK_CUR)  # window, dictionary
        length = (single, 2, 4, 8)[begins[0] >> 6]
        n_bytes += int.from_bytes(piece.read(length), "little") + (256 if length == 2 else 0)
        last = 0
        while not last and len(head := piece.read(3)) == 3:
            number = int.from_bytes(head, "little")
            last, kind, said = number & 1, number >> 1 & 3, number >> 3
            blocks += 0 if length else said if kind < 2 else _ZSTD_BLOCK_BYTES
            piece.seek(1 if kind == 1 else said, io.SEEK_CUR)
        piece.seek(4 * has_sum, io.SEEK_CUR)
    return n_bytes > most or blocks > max(most, _UNTOLD_BYTES)


def _deflated_beyond(piece: IO[bytes], most: int) -> bool:
    inflater, n_bytes = zlib.decompressobj(47), 0  # either header
    try:
        while block := piece.read(_BLOCK_BYTES):
            while block:
                n_bytes += len(inflater.decompress(block, 1 << 20))
                if n_bytes > most:
                    return True
                block = inflater.unconsumed_tail
    except zlib.error:  # not deflated, or damaged: who reads it says so
        pass
    return False


def bound_tiff_pieces(tifffile: Any) -> None:
    """Have a TIFF's strips and tiles inflated as far as they are to hold, not to their ends.

    The library's own decoders, where ``imagecodecs`` is not installed, do not look at the size they are told.
    """
    decoders = tifffile.TIFF.DECOMPRESSORS._codecs
    for number in _DEFLATE:
        decoders[number] = _inflated
    decoders[_LZMA] = _unpacked


def _inflated(data: bytes, /, *, out: int | None = None) -> bytes:
    inflater = zlib.decompressobj()
    made = inflater.decompress(data, 0 if out is None else out + 1)  # the checksum is behind the last byte
    if not inflater.eof and (out is None or len(made) <= out):
        raise zlib.error("incomplete or truncated stream")
    return made[:out]


def _unpacked(data: bytes, /, *, out: int | None = None) -> bytes:
    return lzma.LZMADecompressor().decompress(data, -1 if out is None else out)
