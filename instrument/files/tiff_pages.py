"""Opening TIFFs whose pages end: a file may say that its last page is followed by an earlier one."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import IO, TYPE_CHECKING

from instrument.files.errors import FileError
from instrument.files.pieces import bound_tiff_pieces

if TYPE_CHECKING:
    import tifffile

_ORDERS = {b"II": "<", b"MM": ">"}
_CLASSIC, _BIG = 42, 43


_MOST_PAGES = 30_000


def open_tiff(path: Path) -> tifffile.TiffFile:
    """Open a TIFF.

    Raises FileError when its pages never end, or are beyond counting; as ``tifffile.TiffFile`` when it is
    damaged otherwise.
    """
    import tifffile

    with path.open("rb") as file:
        if _goes_round(file):
            raise FileError(
                path,
                f"is a damaged TIFF: its pages follow one another in a circle, or are over {_MOST_PAGES}.",
            )
    bound_tiff_pieces(tifffile)
    return tifffile.TiffFile(path)


def _goes_round(file: IO[bytes]) -> bool:
    """Whether a page is followed by one before it (TIFF 6.0, section 2); False where the chain breaks."""
    seen: set[int] = set()
    try:
        order = _ORDERS[file.read(2)]
        (version,) = struct.unpack(f"{order}H", file.read(2))
        is_big = version == _BIG
        count, entry, offset = ("Q", 20, "Q") if is_big else ("H", 12, "I")
        if is_big:
            file.seek(8)
        elif version != _CLASSIC:
            return False
        while place := _number(file, order + offset):
            if place in seen or len(seen) > _MOST_PAGES:
                return True
            seen.add(place)
            file.seek(place)
            file.seek(_number(file, order + count) * entry, io.SEEK_CUR)
    except (KeyError, struct.error, OSError, OverflowError, ValueError):
        pass  # what is wrong there is found by who reads it
    return False


def _number(file: IO[bytes], kind: str) -> int:
    (number,) = struct.unpack(kind, file.read(struct.calcsize(kind)))
    return int(number)
