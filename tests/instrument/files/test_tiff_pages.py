"""TIFFs whose pages never end."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from instrument.files.errors import FileError
from instrument.files.images import image_metadata, read_image, read_stack
from instrument.files.ome_tiff import depths_um
from instrument.files.tiff_pages import open_tiff
from instrument.volumes.opening import open_volume

PAGES = np.arange(3 * 8 * 8, dtype=np.uint16).reshape(3, 8, 8)


def round_and_round(path: Path, *, bigtiff: bool) -> Path:
    """Write pages of which the last is followed by the second."""
    tifffile.imwrite(path, PAGES, bigtiff=bigtiff, metadata=None, photometric="minisblack")
    with tifffile.TiffFile(path) as file:
        second, last = (file.pages[i].offset for i in (1, 2))  # type: ignore[union-attr]
    data = bytearray(path.read_bytes())
    count, entry, offset = ("<Q", 20, "<Q") if bigtiff else ("<H", 12, "<I")
    (n,) = struct.unpack_from(count, data, last)
    struct.pack_into(offset, data, last + struct.calcsize(count) + n * entry, second)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("read", [read_image, read_stack, open_volume])
def test_pages_in_a_circle_are_refused(tmp_path: Path, read: Callable[[Path], Any], *, bigtiff: bool) -> None:
    path = round_and_round(tmp_path / "round.tif", bigtiff=bigtiff)
    with pytest.raises(FileError, match="its pages follow one another in a circle"):
        read(path)
    assert image_metadata(path) == {}


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_pages_that_end_are_read(tmp_path: Path, byteorder: str, *, bigtiff: bool) -> None:
    path = tmp_path / "sound.tif"
    kind: dict[str, Any] = {"bigtiff": bigtiff, "byteorder": byteorder, "photometric": "minisblack"}
    tifffile.imwrite(path, PAGES, metadata=None, **kind)
    with open_tiff(path) as file:
        np.testing.assert_array_equal(file.asarray(), PAGES)


def test_planes_that_a_damaged_description_promises_are_not_counted() -> None:
    described = '<OME><Pixels SizeZ="{}" PhysicalSizeZ="2"/></OME>'
    assert depths_um(described.format(3)) == [0.0, 2.0, 4.0]
    assert depths_um(described.format(10**14)) == []
    with pytest.raises(ValueError, match="no XML"):
        depths_um("{}")
