"""Pattern images as the controller takes them: header (section 2.4.2) and compression (section 2.4.3).

A pattern has up to 8 bits a pixel, an image 24. Each pixel's level is written to all three bytes, so that
the pattern is the same from whichever of the image's bits it is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

_SIGNATURE = b"Spld"
_UNCOMPRESSED, _RLE, _ENHANCED_RLE = 0, 1, 2
_MAX_RLE_RUN = 255
_END_OF_LINE = b"\x00\x00"

Levels = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.intp]


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
    width = levels.shape[1]
    pixels = levels.ravel()
    out = bytearray()
    segments = _segments(levels, np.zeros(levels.shape, bool))
    for start, n, kind in zip(*(part.tolist() for part in segments), strict=True):
        for at in range(start, start + n, _MAX_RLE_RUN):
            count = min(_MAX_RLE_RUN, start + n - at)
            # A literal of one pixel does not exist: its code ends the image.
            is_run = kind == _RUN or count == 1
            out += bytes([count]) if is_run else bytes([0, count])
            out += np.repeat(pixels[at : at + (1 if is_run else count)], 3).tobytes()
        if (start + n) % width == 0:
            out += _END_OF_LINE
            out += bytes(-len(out) % 4)
    return bytes(out) + b"\x00\x01"


def _enhanced_rle(levels: Levels) -> bytes:
    """Compress by runs of any length, and by runs of the line above (section 2.4.3.2).

    A copy of n pixels from above is ``00 01 n``, a run ``n pixel``, a literal ``00 n pixels``; n is one byte
    below 128, else two: its low seven bits with a mark, then the rest. All segments are written at once.
    """
    above = np.zeros(levels.shape, bool)
    above[1:] = levels[1:] == levels[:-1]
    start, n, kind = _segments(levels, above)
    pixels = levels.ravel()
    head = np.array([0, 1, 2])[kind]  # bytes before the length, by kind
    long = n >= 128
    n_pixels = np.where(kind == _COPY, 0, np.where(kind == _LITERAL, n, 1))
    ends_line = (start + n) % levels.shape[1] == 0
    size = head + 1 + long + 3 * n_pixels + len(_END_OF_LINE) * ends_line
    stop = np.cumsum(size)
    out = np.zeros(int(stop[-1]), np.uint8)
    at = stop - size
    out[at[kind == _COPY] + 1] = 1
    at += head
    out[at] = np.where(long, n & 0x7F | 0x80, n)
    out[at[long] + 1] = n[long] >> 7
    at += 1 + long
    # Every pixel that is written out, by its number within its segment.
    within = np.arange(int(n_pixels.sum())) - np.repeat(np.cumsum(n_pixels) - n_pixels, n_pixels)
    place = np.repeat(at, n_pixels) + 3 * within
    values = pixels[np.repeat(start, n_pixels) + within]
    for color in range(3):
        out[place + color] = values
    return out.tobytes() + b"\x00\x01\x00"


_COMPRESSIONS: Mapping[str, tuple[int, Callable[[Levels], bytes]]] = {
    "none": (_UNCOMPRESSED, _uncompressed),
    "rle": (_RLE, _rle),
    "enhanced_rle": (_ENHANCED_RLE, _enhanced_rle),
}


_RUN, _LITERAL, _COPY = range(3)


def _segments(levels: Levels, copied: npt.NDArray[np.bool_]) -> tuple[Numbers, Numbers, Numbers]:
    """Cut an image into runs of one level, literals, and copies of what is above, none beyond its line.

    Returns
    -------
    start, n, kind : ndarray
        First pixel, counted along the lines; number of pixels; ``_RUN``, ``_LITERAL`` or ``_COPY``.
    """
    width = levels.shape[1]
    pixels, copy = levels.ravel(), copied.ravel()
    # A border lies before a pixel where a line begins, its level changes, or whether it is copied.
    border = np.ones(pixels.size, bool)
    border[1:] = (copy[1:] != copy[:-1]) | (~copy[1:] & (pixels[1:] != pixels[:-1]))
    border[::width] = True
    start = np.flatnonzero(border)
    single = (np.diff(start, append=pixels.size) == 1) & ~copy[start]
    # Single pixels beside each other in a line become one literal.
    joins = np.zeros(start.size, bool)
    joins[1:] = single[1:] & single[:-1] & (start[1:] % width != 0)
    kept = np.flatnonzero(~joins)
    start, single = start[kept], single[kept]
    n = np.diff(start, append=pixels.size)
    kind = np.where(copy[start], _COPY, np.where(single & (n > 1), _LITERAL, _RUN))
    return start, n, kind
