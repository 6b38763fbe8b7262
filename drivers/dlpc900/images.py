"""Pattern images as the controller takes them: header (section 2.4.2) and compression (section 2.4.3).

A pattern has up to 8 bits a pixel, an image 24. Each pixel's level is written to all three bytes, so that
the pattern is the same from whichever of the image's bits it is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

HEADER_BYTES = 48
_SIGNATURE = b"Spld"
_UNCOMPRESSED, _RLE, _ENHANCED_RLE = 0, 1, 2
_MAX_RLE_RUN = 255
_END_OF_LINE = b"\x00\x00"

Levels = npt.NDArray[np.uint8]


def encode(levels: Levels, compression: str = "auto") -> bytes:
    """Return an image with its header.

    Parameters
    ----------
    levels : ndarray
        (height, width) uint8; of a board with two controllers, one of the halves.
    compression : str
        ``"none"``, ``"rle"``, ``"enhanced_rle"``, or ``"auto"``: the shortest of them.
    """
    if compression == "auto":
        return min((encode(levels, name) for name in ("enhanced_rle", "none")), key=len)
    code, compress = _COMPRESSIONS[compression]
    data = compress(levels)
    data += bytes(-len(data) % 4)
    height, width = levels.shape
    header: bytes = (
        _SIGNATURE
        + width.to_bytes(2, "little")
        + height.to_bytes(2, "little")
        + len(data).to_bytes(4, "little")
        + b"\xff" * 8
        + bytes(4)  # background colour
        + bytes([0, code, 1])
        + bytes(21)
    )
    return header + data


def _uncompressed(levels: Levels) -> bytes:
    return np.repeat(levels[..., None], 3, axis=2).tobytes()


def _rle(levels: Levels) -> bytes:
    """Compress by runs of up to 255 pixels; lines begin at multiples of four bytes (section 2.4.3.1)."""
    out = bytearray()
    for row in levels:
        for start, stop, is_run in _segments(row, np.zeros(row.size, bool)):
            for at in range(start, stop, _MAX_RLE_RUN):
                n = min(_MAX_RLE_RUN, stop - at)
                # A literal of one pixel does not exist: its code ends the image.
                head = bytes([n]) if is_run or n == 1 else bytes([0, n])
                out += head + _pixels(row[at : at + (1 if is_run else n)])
        out += _END_OF_LINE
        out += bytes(-len(out) % 4)
    return bytes(out) + b"\x00\x01"


def _enhanced_rle(levels: Levels) -> bytes:
    """Compress by runs of any length, and by runs of the line above (section 2.4.3.2)."""
    out = bytearray()
    above = None
    for row in levels:
        copied = np.zeros(row.size, bool) if above is None else row == above
        for start, stop, is_run in _segments(row, copied):
            n = stop - start
            if copied[start]:
                out += b"\x00\x01" + _length(n)
            elif is_run or n == 1:
                out += _length(n) + _pixels(row[start : start + 1])
            else:
                out += b"\x00" + _length(n) + _pixels(row[start:stop])
        out += _END_OF_LINE
        above = row
    return bytes(out) + b"\x00\x01\x00"


_COMPRESSIONS: Mapping[str, tuple[int, Callable[[Levels], bytes]]] = {
    "none": (_UNCOMPRESSED, _uncompressed),
    "rle": (_RLE, _rle),
    "enhanced_rle": (_ENHANCED_RLE, _enhanced_rle),
}


def _segments(row: Levels, copied: npt.NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Cut a line into ``(start, stop, is_run)``: pixels copied from above, runs of one level, the rest.

    A segment is all copied or not at all; a run has at least two pixels that are not copied.
    """
    size = row.size
    # A border lies before a pixel where its level changes, or whether it is copied.
    changes = np.ones(size + 1, bool)
    same_kind = copied[1:] == copied[:-1]
    changes[1:-1] = ~(same_kind & (copied[1:] | (row[1:] == row[:-1])))
    borders = np.flatnonzero(changes)
    starts, lengths = borders[:-1], np.diff(borders)
    # Single pixels in a row become one literal.
    single = (lengths == 1) & ~copied[starts]
    joins = np.zeros(starts.size, bool)
    joins[1:] = single[1:] & single[:-1]
    kept = np.flatnonzero(~joins)
    stops = np.append(starts[kept[1:]], size)
    return list(zip(starts[kept].tolist(), stops.tolist(), (~single[kept]).tolist(), strict=True))


def _length(n: int) -> bytes:
    """Return a length as one byte below 128, else as two: low seven bits with a mark, then the rest."""
    return bytes([n]) if n < 128 else bytes([(n & 0x7F) | 0x80, n >> 7])


def _pixels(levels: Levels) -> bytes:
    return np.repeat(levels, 3).tobytes()
