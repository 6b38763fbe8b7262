"""How cameras lay pixels into bytes, by GenICam's names (PFNC), and how to get them out again."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Bytes = npt.NDArray[np.uint8]
Packing = Literal[
    "bytes", "words", "big words", "lsb 10", "lsb 12", "gige 10", "gige 12", "mipi 10", "mipi 12"
]

_NAME = re.compile(r"(Mono|Bayer(?:RG|GR|GB|BG))(8|10|12|14|16)(p|Packed)?")
_COLOUR = {"RGB8": "RGB8", "RGB8Packed": "RGB8", "BGR8": "BGR8", "BGR8Packed": "BGR8"}
_PACKED: dict[tuple[int, str], Packing] = {
    (10, "p"): "lsb 10",
    (12, "p"): "lsb 12",
    (10, "Packed"): "gige 10",
    (12, "Packed"): "gige 12",
}

_GROUPS: dict[Packing, tuple[int, int]] = {
    "bytes": (1, 1),
    "words": (2, 1),
    "big words": (2, 1),
    "lsb 10": (5, 4),
    "lsb 12": (3, 2),
    "gige 10": (3, 2),
    "gige 12": (3, 2),
    "mipi 10": (5, 4),
    "mipi 12": (3, 2),
}
"""Bytes and pixels of the smallest group that begins and ends on a byte."""


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """What a pixel format is.

    Attributes
    ----------
    name : str
        GenICam name, e.g. ``"Mono12p"``.
    bits : int
        Bits that carry signal.
    packing : str
        ``"bytes"``: one byte each; ``"words"`` and ``"big words"``: 16-bit words, little and big endian,
        signal in the low bits; ``"lsb"``: PFNC's ``p``, a stream of bits, lowest first; ``"gige"``: the
        ``Packed`` of GigE Vision 1; ``"mipi"``: CSI-2 RAW10 and RAW12, high bytes first, then the low bits.
    channels : int
        1, or 3 for interleaved colours.
    """

    name: str
    bits: int
    packing: Packing
    channels: int = 1

    @property
    def dtype(self) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
        """Type of the unpacked counts."""
        return np.dtype(np.uint8) if self.bits <= 8 else np.dtype(np.uint16)

    @property
    def bayer(self) -> bool:
        """Whether each pixel saw one colour of a mosaic."""
        return self.name.startswith("Bayer")

    def line_bytes(self, width: int) -> int:
        """Return the bytes of a line of ``width`` pixels without padding."""
        n_bytes, n_pixels = _GROUPS[self.packing]
        return -(-width * self.channels // n_pixels) * n_bytes


def genicam_format(name: str) -> PixelFormat | None:
    """Return the format of a GenICam name; None for one that cannot be unpacked here.

    Knows Mono and Bayer of 8 to 16 bits, unpacked, packed by GigE Vision 1 (``Packed``) and by PFNC (``p``),
    RGB8 and BGR8.
    """
    if name in _COLOUR:
        return PixelFormat(_COLOUR[name], 8, "bytes", 3)
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    bits, packed = int(match[2]), match[3]
    if packed is None:
        return PixelFormat(name, bits, "bytes" if bits == 8 else "words")
    packing = _PACKED.get((bits, packed))
    return None if packing is None else PixelFormat(name, bits, packing)


def unpack(data: Bytes, packing: Packing, out: Pixels, line_bytes: int | None = None) -> bool:
    """Write the pixels of an image's bytes into ``out``.

    Parameters
    ----------
    data : ndarray
        (n,) uint8; may be longer than the image.
    packing : str
        See :class:`PixelFormat`.
    out : ndarray
        (height, width) or (height, width, 3), contiguous; uint8 for ``"bytes"``, else uint16.
    line_bytes : int, optional
        Bytes from line to line; None when lines follow each other without padding, even inside a byte.

    Returns
    -------
    bool
        False, with ``out`` undefined, when the bytes do not suffice for the image.
    """
    lines = out.reshape(out.shape[0], -1) if line_bytes is not None else out.reshape(1, -1)
    n_lines, width = lines.shape
    group_bytes, group_pixels = _GROUPS[packing]
    n_groups = -(-width // group_pixels)
    used = n_groups * group_bytes
    pitch = used if line_bytes is None else line_bytes
    if pitch < used or len(data) < (n_lines - 1) * pitch + _needed(packing, width):
        return False
    if len(data) < n_lines * pitch:  # padding of the last line that was not sent
        data = np.concatenate([data, np.zeros(n_lines * pitch - len(data), np.uint8)])
    rows = data[: n_lines * pitch].reshape(n_lines, pitch)
    if packing == "bytes":
        lines[...] = rows[:, :used]
    elif packing in ("words", "big words"):
        lines[...] = np.ascontiguousarray(rows[:, :used]).view("<u2" if packing == "words" else ">u2")
    else:
        from drivers.common.unpacking import KERNELS  # numba takes a while to import: only where it is needed

        rows.flags.writeable = False  # always: else numba would compile once more for those that are not
        KERNELS[packing](rows, lines)  # type: ignore[arg-type]  # packed formats are all of 16 bits
    return True


def _needed(packing: Packing, width: int) -> int:
    """Bytes of a last line without the unused end of its last group."""
    group_bytes, group_pixels = _GROUPS[packing]
    rest = width % group_pixels
    whole = width // group_pixels * group_bytes
    if rest == 0:
        return whole
    bits = {"lsb 10": 10, "lsb 12": 12}.get(packing)
    return whole + (group_bytes if bits is None else -(-rest * bits // 8))


def compile_kernels(packing: Packing) -> None:
    """Have what unpacks a packing ready, so that the first frame need not wait for its compilation."""
    if packing not in ("bytes", "words", "big words"):
        unpack(np.zeros(8, np.uint8), packing, np.empty((1, 4), np.uint16))
