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
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from instrument.files.errors import FileError, size

_SLACK_BYTES = 1 << 20
_HARMLESS_BYTES = 512
"""A piece so small inflates to some megabytes at most, whatever it is."""
_DEFLATES = 1040
"""By how much deflate shrinks zeros, at most (1032)."""
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
                raise error(
                    path,
                    f"holds a piece that inflates to over {size(most)}, for {size(holds_bytes)} of numbers: "
                    "it is damaged, or made to fill the memory.",
                )


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
