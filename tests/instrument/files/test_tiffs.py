"""TIFFs of other programs: packed, compressed, white-is-zero, with thumbnails, in several files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from instrument.files.errors import FileError
from instrument.files.images import read_image, read_stack
from recon.arrays import Array

RNG = np.random.default_rng(3)
STACK = RNG.integers(0, 4096, (5, 8, 6)).astype(np.uint16)
PICTURE = STACK[0]


def _compressed(path: Path, image: Array, **tags: int) -> Path:
    """Write a TIFF by LZW, which OpenCV reads, and overwrite tags that its writer knows no other way."""
    Image.fromarray(image).save(path, compression="tiff_lzw")
    with tifffile.TiffFile(path, mode="r+b") as tiff:
        for name, value in tags.items():
            tiff.pages.first.tags[name].overwrite(value)
    return path


def test_compressed_pixels_keep_their_values_or_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    grey = PICTURE.astype(np.uint8)
    for image, inverted in ((PICTURE, ~PICTURE), (grey, ~grey)):
        read = read_image(_compressed(path, image, PhotometricInterpretation=0))
        np.testing.assert_array_equal(read.pixels, inverted)
        assert "white-is-zero TIFF inverted" in read.notes
    for photometric in (0, 1):
        read = read_image(_compressed(path, PICTURE > 2000, PhotometricInterpretation=photometric))
        np.testing.assert_array_equal(read.pixels, PICTURE > 2000)
    colour = np.stack([grey, grey // 2, grey // 3, 0 * grey + 255], -1)
    np.testing.assert_array_equal(read_image(_compressed(path, colour)).pixels, colour[..., :3])
    colour[..., 3] = 100  # by which OpenCV multiplies the others
    for image in (colour, colour[..., 2:]):  # the latter grey with alpha, of which it takes 8 bits
        with pytest.raises(FileError, match=r"has pixels uint8 .* compressed as LZW, which are not read"):
            read_image(_compressed(path, image))
    tifffile.imwrite(path, colour, photometric="separated")
    with pytest.raises(FileError, match="colours of the kind SEPARATED, which are no light"):
        read_image(path)


def test_pixels_are_neither_a_thumbnails_nor_a_look_up_tables(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(PICTURE[::2, ::2], subfiletype=1, metadata=None)
        tiff.write(PICTURE, metadata=None)
    read = read_image(path)
    np.testing.assert_array_equal(read.pixels, PICTURE)
    assert read.notes == ("the number 2 of its 2 image series taken",)
    grey = PICTURE.astype(np.uint8)
    tifffile.imwrite(path, grey, imagej=True, colormap=RNG.integers(0, 65536, (3, 256)).astype(np.uint16))
    np.testing.assert_array_equal(read_image(path).pixels, grey)
    Image.fromarray(np.stack([grey, grey], -1), "LA").save(tmp_path / "a.png")
    read = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(read.pixels, grey)
    assert read.notes == ("alpha channel left out",)
    tifffile.imwrite(path, np.moveaxis(STACK, 0, -1), photometric="minisblack", planarconfig="contig")
    np.testing.assert_array_equal(read_stack(path).pixels, STACK)


def test_an_ome_tiff_of_several_files_is_whole_or_refused(tmp_path: Path) -> None:
    ids = [f"urn:uuid:00000000-0000-0000-0000-00000000000{z}" for z in range(5)]
    data = "".join(
        f'<TiffData FirstZ="{z}" IFD="0"><UUID FileName="z{z}.ome.tif">{ids[z]}</UUID></TiffData>'
        for z in range(5)
    )
    pixels = 'DimensionOrder="XYZCT" Type="uint16" SizeX="6" SizeY="8" SizeZ="5" SizeC="1" SizeT="1"'
    pixels += ' PhysicalSizeZ="4"'
    for z in range(5):
        said = f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{ids[z]}">'
        said += f'<Image ID="Image:0"><Pixels ID="Pixels:0" {pixels}>{data}</Pixels></Image></OME>'
        tifffile.imwrite(tmp_path / f"z{z}.ome.tif", STACK[z], description=said, metadata=None)
    stack = read_stack(tmp_path)
    np.testing.assert_array_equal(stack.pixels, STACK)
    assert stack.metadata == {"depths_um": [0.0, 4.0, 8.0, 12.0, 16.0]}
    (tmp_path / "z3.ome.tif").unlink()
    for path in (tmp_path, tmp_path / "z0.ome.tif"):
        with pytest.raises(FileError, match="has 4 of the 5 images that it tells of"):
            read_stack(path)


def test_a_compression_that_nothing_here_knows_is_named(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", PICTURE)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+b") as tiff:
        tiff.pages.first.tags["Compression"].overwrite(50000)
    with pytest.raises(FileError, match="compressed as ZSTD"):
        read_image(tmp_path / "a.tif")


def test_packed_pixels_keep_their_values(tmp_path: Path) -> None:
    path = tmp_path / "packed.tif"
    for bits in (10, 12, 14):
        values = RNG.integers(0, 1 << bits, (9, 7)).astype(np.uint16)
        rows = ["".join(f"{value:0{bits}b}" for value in row) for row in values]
        packed = b"".join(int(r + "0" * (-len(r) % 8), 2).to_bytes(-(-len(r) // 8), "big") for r in rows)
        tifffile.imwrite(path, np.zeros((9, 14), np.uint8), metadata=None)
        with tifffile.TiffFile(path, mode="r+b") as tiff:  # as one that says what it packs
            page = tiff.pages.first
            for tag, value in ((258, bits), (256, 7), (279, len(packed))):
                page.tags[tag].overwrite(value)
            offset = page.dataoffsets[0]
        data = bytearray(path.read_bytes())
        data[offset : offset + len(packed)] = packed
        path.write_bytes(data)
        read = read_image(path)
        np.testing.assert_array_equal(read.pixels, values)
        assert read.notes == (f"{bits}-bit pixels unpacked",)


def test_compressed_stacks_are_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    pages = [Image.fromarray(page) for page in STACK]
    pages[0].save(path, save_all=True, append_images=pages[1:], compression="tiff_lzw")
    np.testing.assert_array_equal(read_stack(path).pixels, STACK)
    cv2.imwritemulti(str(path), list(STACK))  # LZW as well
    np.testing.assert_array_equal(read_stack(path).pixels, STACK)
    pages[0].save(path, compression="tiff_lzw", tiffinfo={274: 3})
    upright = read_image(path)
    np.testing.assert_array_equal(upright.pixels, PICTURE[::-1, ::-1])
    assert any("orientation (3)" in note for note in upright.notes)
    colours = RNG.integers(0, 255, (3, 8, 6, 3)).astype(np.uint8)
    pages = [Image.fromarray(page) for page in colours]
    pages[0].save(path, save_all=True, append_images=pages[1:], compression="tiff_lzw")
    np.testing.assert_array_equal(read_stack(path).pixels, colours)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(FileError):
        read_stack(path)


def test_only_the_series_that_is_taken_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "stack.tif"
    cv2.imwritemulti(str(path), [*STACK, np.zeros((400, 400), STACK.dtype)])
    decoded = []
    decode = cv2.imdecodemulti
    monkeypatch.setattr(cv2, "imdecodemulti", lambda *a, **k: decoded.append(decode(*a, **k)) or decoded[-1])
    np.testing.assert_array_equal(read_stack(path).pixels, STACK)
    assert [len(images) for _, images in decoded] == [len(STACK)]


def test_axes_of_imagej_and_ome(tmp_path: Path) -> None:
    colours = RNG.integers(0, 255, (5, 3, 8, 6)).astype(np.uint8)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, colours, imagej=True, metadata={"axes": "ZCYX"})
    np.testing.assert_array_equal(read_stack(path).pixels, np.moveaxis(colours, 1, -1))
    tifffile.imwrite(path, STACK[:, None], imagej=True, metadata={"axes": "TCYX"})
    np.testing.assert_array_equal(read_stack(path).pixels, STACK)
    tifffile.imwrite(path, colours[0], imagej=True, metadata={"axes": "CYX"})
    np.testing.assert_array_equal(read_image(path).pixels, np.moveaxis(colours[0], 0, -1))
    tifffile.imwrite(path, STACK[:4].reshape(2, 2, 8, 6), ome=True, metadata={"axes": "TZYX"})
    with pytest.raises(FileError, match=r"holds images in 2 \(T\) x 2 \(Z\); one stack is expected"):
        read_stack(path)
    tifffile.imwrite(path, STACK[:2], ome=True, metadata={"axes": "CYX"})
    assert "its 2 channels taken as the images of a stack" in read_stack(path).notes


def test_compressed_images_in_several_files_are_not_taken_from_one(tmp_path: Path) -> None:
    """OpenCV reads the named file alone: the first image came three times."""
    pieces = "".join(
        f'<TiffData FirstZ="{z}" PlaneCount="1"><UUID FileName="a{z}.ome.tif">urn:uuid:{z}</UUID></TiffData>'
        for z in range(3)
    )
    for z in range(3):
        words = (
            f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:{z}">'
            '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint8" '
            'SizeX="40" SizeY="32" SizeZ="3" SizeC="1" SizeT="1">'
            f"{pieces}</Pixels></Image></OME>"
        )
        image = Image.fromarray(np.full((32, 40), 10 * (z + 1), np.uint8))
        image.save(tmp_path / f"a{z}.ome.tif", compression="tiff_lzw", tiffinfo={270: words})
    with tifffile.TiffFile(tmp_path / "a0.ome.tif") as tiff:
        assert tiff.series[0].shape == (3, 32, 40)
    with pytest.raises(FileError, match="compressed as LZW, which are not read"):
        read_stack(tmp_path / "a0.ome.tif")
