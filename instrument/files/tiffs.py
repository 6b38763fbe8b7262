"""TIFFs of all kinds, to a plain array: packed, compressed, turned, white-is-zero, of several files."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from instrument.files import reading
from instrument.files.errors import FileError
from instrument.files.named_arrays import Expect, ordered, outline
from instrument.files.ome_tiff import SECONDS, imagej_time_unit
from instrument.files.pictures import (
    LOSSY,
    MOST_BYTES,
    ORIENTATION,
    Decoded,
    quiet_opencv,
    rgb,
    turned_in_words,
    upright,
)
from instrument.files.tiff_pages import open_tiff

RAW = (
    "is a camera's raw file, whose pixels are not read (a thumbnail at most). Make a linear 16-bit TIFF "
    "of it: dcraw -D -4 -T FILE, or rawpy.imread(FILE).raw_image, saved by numpy.save."
)
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
_PHOTOMETRIC = tifffile.PHOTOMETRIC
_LIGHT = {
    getattr(_PHOTOMETRIC, name)
    for name in ("MINISWHITE", "MINISBLACK", "RGB", "PALETTE", "YCBCR", "CFA", "LINEAR_RAW")
}
"""What pixels may be; others are inks (CMYK) or colours as an eye weighs them (Lab)."""
_WHOLE_BYTES = (1, 8, 16, 32, 64)


def decode_tiff(path: Path, expect: Expect) -> Decoded:
    """Return the array of a TIFF's first image or stack that is no thumbnail; ``expect`` is asked before.

    Raises FileError when it is damaged, parts of it are missing, or it is of a kind that is not read.
    """
    try:
        with _quiet_tifffile(), open_tiff(path) as tiff:
            return _decode(path, tiff, expect)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged TIFF raises nearly anything
        if "imagecodecs" in str(error) or isinstance(error, ImportError):  # OpenCV knows more compressions
            with _quiet_tifffile(), open_tiff(path) as tiff:
                return _with_opencv(path, tiff, _main_series(path, tiff))
        raise FileError(path, f"is a damaged or unusual TIFF: {error}.") from None


def files_of(path: Path) -> set[str]:
    """Return the names of all files that an OME-TIFF says its first series is kept in; its own alone else."""
    try:
        with _quiet_tifffile(), open_tiff(path) as tiff:
            pages = tiff.series[0].pages if tiff.is_ome else ()
            return {path.name, *(page.parent.filename for page in pages if page is not None)}
    except Exception:  # noqa: BLE001 - what is wrong there is said by who decodes it
        return {path.name}


@contextlib.contextmanager
def _quiet_tifffile() -> Iterator[None]:
    """Keep tifffile silent: what is missing is told once, in our words."""
    log = logging.getLogger("tifffile")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


def _main_series(path: Path, tiff: tifffile.TiffFile) -> Any:
    """Return the first series that is no thumbnail of another one.

    Raises FileError where there is none, it cannot be in so small a file, or parts of it are missing.
    """
    if not tiff.series:
        raise FileError(path, "is a TIFF without an image.")
    series: Any = tiff.series[0]
    if series.keyframe.is_reduced and series.keyframe.subifds:  # DNG, NEF, ARW: the pixels lie further in
        raise FileError(path, RAW)
    series = next((one for one in tiff.series if not one.keyframe.is_reduced), series)
    reading.require_plausible(path, series.size * series.dtype.itemsize, reading.stored_bytes(path))
    _require_whole(path, series)
    if series.keyframe.photometric not in _LIGHT:
        kind = _PHOTOMETRIC(series.keyframe.photometric).name
        raise FileError(
            path, f"has colours of the kind {kind}, which are no light.", "Save it as grey or RGB."
        )
    return series


def _decode(path: Path, tiff: tifffile.TiffFile, expect: Expect) -> Decoded:
    series = _main_series(path, tiff)
    page = series.keyframe
    expect(ordered(path, outline(series.shape, series.dtype), series.axes)[0])
    notes = []
    if page.photometric == _PHOTOMETRIC.PALETTE and not tiff.is_imagej:
        return _with_opencv(path, tiff, series)
    if page.bitspersample in _WHOLE_BYTES:
        array = series.asarray()
    else:
        array = _unpacked(path, series, tiff.filehandle)
        notes.append(f"{page.bitspersample}-bit pixels unpacked")
    if page.photometric == _PHOTOMETRIC.PALETTE:
        notes.append("its look-up table left out, by which ImageJ shows its pixels")
    if page.photometric == _PHOTOMETRIC.MINISWHITE and array.dtype.kind == "u":
        array = (1 << page.bitspersample) - 1 - array if page.bitspersample < 16 else ~array
        notes.append(_INVERTED)
    notes += [*_which(tiff, series), *_untimed(tiff)]
    turned = int(page.tags.valueof(ORIENTATION, 1))
    if 2 <= turned <= 8:
        array = upright(array, turned, series.axes)
        notes.append(turned_in_words(turned))
    array, said = ordered(path, array, series.axes)
    return array, (*notes, *said)


_INVERTED = "white-is-zero TIFF inverted"


def _which(tiff: tifffile.TiffFile, series: Any) -> list[str]:
    """Say which of several series is taken."""
    number = tiff.series.index(series)
    which = "first" if number == 0 else f"number {number + 1}"
    return [f"the {which} of its {len(tiff.series)} image series taken"] if len(tiff.series) > 1 else []


def _untimed(tiff: tifffile.TiffFile) -> list[str]:
    """Say where the time from frame to frame is counted in what nobody knows."""
    stack, unit = tiff.imagej_metadata or {}, imagej_time_unit(tiff)
    if stack.get("frames", 0) < 2 or not stack.get("finterval") or stack.get("fps") or unit in SECONDS:
        return []
    return [f"its unit of time, {unit!r}, is not known: its time from frame to frame left out"]


def _with_opencv(path: Path, tiff: tifffile.TiffFile, series: Any) -> Decoded:
    """Decode a compression that OpenCV knows, all images of the series; it turns them upright itself."""
    page = series.keyframe
    pages = [page.index for page in series.pages]
    kind = tifffile.COMPRESSION(page.compression)
    if kind not in _OPENCV_KNOWS:
        raise FileError(
            path, f"is compressed as {kind.name}, which is not read.", "Save it as LZW, or plain."
        )
    if page.bitspersample not in _WHOLE_BYTES:  # it stretches those of 9 to 15 bits to 16 without a word
        raise FileError(
            path,
            f"has {page.bitspersample}-bit pixels that are compressed.",
            "Convert it to 16 bit without compression.",
        )
    odd = FileError(
        path,
        f"has pixels {page.dtype} {page.shape} compressed as {kind.name}, which are not read.",
        "Save it without compression.",
    )
    is_palette = page.photometric == _PHOTOMETRIC.PALETTE
    separate = page.samplesperpixel > 1 and page.planarconfig != 1
    differences = page.predictor != 1 and kind is tifffile.COMPRESSION.PACKBITS  # which it takes for pixels
    elsewhere = any(one.parent is not tiff for one in series.pages)  # images of an OME-TIFF in several files
    if elsewhere or separate or differences or page.samplesperpixel not in (1, 3, 4):  # two it cuts to 8 bits
        raise odd
    data = reading.read_bytes(path, MOST_BYTES)
    with quiet_opencv():
        try:
            first, end = min(pages), max(pages) + 1  # other series may be of any size
            encoded = np.frombuffer(data, np.uint8)
            images = cv2.imdecodemulti(encoded, cv2.IMREAD_UNCHANGED, range=(first, end))[1]
            stack = np.stack([rgb(images[page - first]) for page in pages])
        except (cv2.error, MemoryError, ValueError, IndexError, TypeError):
            raise odd from None
    if page.dtype == np.bool_:
        stack = (stack > 0) ^ (page.photometric == _PHOTOMETRIC.MINISWHITE)  # as they are stored
    elif stack.dtype != page.dtype and not is_palette:
        raise odd
    notes = [LOSSY] if kind is tifffile.COMPRESSION.JPEG else []
    if page.photometric == _PHOTOMETRIC.MINISWHITE and page.dtype == np.uint16:  # 8 bits it has inverted
        stack = ~stack
    if page.photometric == _PHOTOMETRIC.MINISWHITE and page.dtype.kind == "u":
        notes.append(_INVERTED)
    if stack.shape[-1] == 4 and stack.dtype == np.uint8 and stack[..., 3].min() < 255:
        raise odd  # it has multiplied the colours by their alpha
    notes += [*_which(tiff, series), *_untimed(tiff)]
    if 2 <= (turned := int(page.tags.valueof(ORIENTATION, 1))) <= 8:
        notes.append(turned_in_words(turned))
    axes = series.axes + "S" if is_palette and stack.ndim == 4 else series.axes
    array, said = ordered(path, stack.reshape(*series.shape[: -page.ndim], *stack.shape[1:]), axes)
    return array, (*notes, *said)


def _require_whole(path: Path, series: Any) -> None:
    """Refuse what would be read as dark: pages that are not there, strips or tiles that have no place."""
    if missing := sum(page is None for page in series.pages):
        raise FileError(
            path,
            f"has {len(series.pages) - missing} of the {len(series.pages)} images that it tells of; "
            "the others are in files that are not beside it, or were never written.",
            "Put them beside it, or save those that are there as a TIFF of their own.",
        )
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
