"""The kernel's pixel formats (four-character codes) and their GenICam names; decoding into images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.common.pixels import Bytes, Packing, PixelFormat, Pixels, unpack
from drivers.v4l2.api import fourcc

Coding = Literal["plain", "YUYV", "UYVY", "NV12", "MJPG"]

_JPEG_END = b"\xff\xd9"


@dataclass(frozen=True, slots=True)
class V4l2Format:
    """A pixel format as this driver offers it.

    Attributes
    ----------
    name : str
        GenICam name, followed by the code where the image is computed: ``"RGB8 (MJPG)"``, ``"Mono8 (YUYV)"``.
    code : int
        The kernel's four-character code.
    pixels : PixelFormat
        What the image is, after decoding.
    coding : str
        How to get there: luma into images of one channel, colours into those of three.
    """

    name: str
    code: int
    pixels: PixelFormat
    coding: Coding = "plain"


def _plain(code: str, name: str, bits: int, packing: Packing, channels: int = 1) -> V4l2Format:
    return V4l2Format(name, fourcc(code), PixelFormat(name, bits, packing, channels))


def _table() -> tuple[V4l2Format, ...]:
    found = [
        _plain("GREY", "Mono8", 8, "bytes"),
        _plain("Y10 ", "Mono10", 10, "words"),
        _plain("Y12 ", "Mono12", 12, "words"),
        _plain("Y14 ", "Mono14", 14, "words"),
        _plain("Y16 ", "Mono16", 16, "words"),
        V4l2Format("Mono16 (big endian)", fourcc("Y16 ", True), PixelFormat("Mono16", 16, "big words")),
        _plain("Y10P", "Mono10 (MIPI)", 10, "mipi 10"),
        _plain("Y12P", "Mono12 (MIPI)", 12, "mipi 12"),
        _plain("RGB3", "RGB8", 8, "bytes", 3),
        _plain("BGR3", "BGR8", 8, "bytes", 3),
    ]
    # Order of each: 8, 10, 12, 14, 16 bits, MIPI 10, MIPI 12.
    bayer = {
        "RG": ("RGGB", "RG10", "RG12", "RG14", "RG16", "pRAA", "pRCC"),
        "GR": ("GRBG", "BA10", "BA12", "GR14", "GR16", "pgAA", "pgCC"),
        "GB": ("GBRG", "GB10", "GB12", "GB14", "GB16", "pGAA", "pGCC"),
        "BG": ("BA81", "BG10", "BG12", "BG14", "BYR2", "pBAA", "pBCC"),
    }
    for order, (c8, c10, c12, c14, c16, p10, p12) in bayer.items():
        found.append(_plain(c8, f"Bayer{order}8", 8, "bytes"))
        words = ((c10, 10), (c12, 12), (c14, 14), (c16, 16))
        found.extend(_plain(code, f"Bayer{order}{bits}", bits, "words") for code, bits in words)
        found.append(_plain(p10, f"Bayer{order}10 (MIPI)", 10, "mipi 10"))
        found.append(_plain(p12, f"Bayer{order}12 (MIPI)", 12, "mipi 12"))
    mono, colour = PixelFormat("Mono8", 8, "bytes"), PixelFormat("RGB8", 8, "bytes", 3)
    codings: tuple[Coding, ...] = ("YUYV", "UYVY", "NV12", "MJPG")
    for coding in codings:
        found.append(V4l2Format(f"Mono8 ({coding})", fourcc(coding), mono, coding))
        found.append(V4l2Format(f"RGB8 ({coding})", fourcc(coding), colour, coding))
    # The best for measuring first: many bits, unpacked, one sample a pixel, uncompressed.
    return tuple(
        sorted(
            found,
            key=lambda f: (
                f.coding != "plain",
                f.pixels.channels,
                -f.pixels.bits,
                f.coding == "MJPG",
                "(" in f.name,
            ),
        )
    )


FORMATS = _table()
"""All formats that can be decoded, the best for measuring first."""


def code_text(code: int) -> str:
    """Return a four-character code as text."""
    text = (code & 0x7FFFFFFF).to_bytes(4, "little").decode("ascii", "replace").strip()
    return text + (" big endian" if code >> 31 else "")


def decode(data: Bytes, wanted: V4l2Format, line_bytes: int, out: Pixels) -> bool:
    """Write an image's pixels into ``out``.

    Parameters
    ----------
    data : ndarray
        (n,) uint8: what the driver said is used of the buffer.
    wanted : V4l2Format
    line_bytes : int
        Bytes from line to line; of no meaning for MJPG.
    out : ndarray
        (height, width) or (height, width, 3) of the format's type.

    Returns
    -------
    bool
        False when the bytes are too few, or no whole JPEG image of that size.
    """
    match wanted.coding:
        case "plain":
            return unpack(data, wanted.pixels.packing, out, line_bytes)
        case "YUYV" | "UYVY":
            return _pairs(data, line_bytes, out, luma=wanted.coding.index("Y"))
        case "NV12":
            return _planes(data, line_bytes, out)
        case "MJPG":
            return _jpeg(data, out)


def _pairs(data: Bytes, line_bytes: int, out: Pixels, luma: int) -> bool:
    """Decode pixels of two bytes, luma in byte ``luma`` and half of a chroma in the other."""
    height, width = out.shape[:2]
    pairs = np.empty((height, width * 2), np.uint8)
    if not unpack(data, "bytes", pairs, line_bytes):
        return False
    if out.ndim == 2:
        out[...] = pairs[:, luma::2]
    else:
        import cv2

        order = cv2.COLOR_YUV2RGB_UYVY if luma else cv2.COLOR_YUV2RGB_YUYV
        cv2.cvtColor(pairs.reshape(height, width, 2), order, dst=out)
    return True


def _planes(data: Bytes, line_bytes: int, out: Pixels) -> bool:
    """Decode the luma of all pixels, and behind it the chroma of each two by two."""
    height, width = out.shape[:2]
    lines = np.empty((height + (height + 1) // 2, width), np.uint8)
    if height % 2 or width % 2 or not unpack(data, "bytes", lines, line_bytes):
        return False
    if out.ndim == 2:
        out[...] = lines[:height]
    else:
        import cv2

        cv2.cvtColor(lines, cv2.COLOR_YUV2RGB_NV12, dst=out)
    return True


def _jpeg(data: Bytes, out: Pixels) -> bool:
    import cv2

    # Cameras pad with zeros; a JPEG without its end mark was cut off, and would be decoded as far as it goes.
    if not data.tobytes().rstrip(b"\x00").endswith(_JPEG_END):
        return False
    flag = cv2.IMREAD_GRAYSCALE if out.ndim == 2 else cv2.IMREAD_COLOR
    image = cv2.imdecode(data, flag)
    if image is None or image.shape != out.shape:
        return False
    if out.ndim == 2:
        out[...] = image
    else:
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=out)
    return True
