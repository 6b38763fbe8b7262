"""Image files: what is written comes back bit by bit; what is no image is refused in words."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tifffile

from instrument.files.errors import FileError
from instrument.files.images import read, read_image, read_stack, write_image

RNG = np.random.default_rng(7)


def sample(dtype: str, *, colour: bool) -> npt.NDArray[np.generic]:
    shape = (13, 17, 3) if colour else (13, 17)
    values = RNG.random(shape) * (1.0 if dtype == "float32" else np.iinfo(dtype).max)
    return values.astype(dtype)


@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(s, d) for s in (".tif", ".png", ".npy") for d in ("uint8", "uint16", "float32")
     if (s, d) != (".png", "float32")],
)  # fmt: skip
def test_what_is_written_comes_back(tmp_path: Path, suffix: str, dtype: str, colour: bool) -> None:
    image = sample(dtype, colour=colour)
    path = tmp_path / f"image{suffix}"
    write_image(path, image)
    back = read_image(path)
    assert back.pixels.dtype == image.dtype
    np.testing.assert_array_equal(back.pixels, image)
    assert back.is_colour == colour
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_colours_are_red_green_blue_in_every_format(tmp_path: Path) -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    for suffix in (".png", ".bmp", ".jpg"):
        cv2.imwrite(str(tmp_path / f"red{suffix}"), red[..., ::-1])
        pixels = read_image(tmp_path / f"red{suffix}").pixels
        assert pixels[8, 8, 0] > 190
        assert pixels[8, 8, 2] < 10
    write_image(tmp_path / "own.png", red)
    assert cv2.imread(str(tmp_path / "own.png"))[8, 8].tolist() == [0, 0, 200]


def test_alpha_is_left_out_and_said(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((4, 5, 4), 9, np.uint8))
    image = read_image(tmp_path / "a.png")
    assert image.pixels.shape == (4, 5, 3)
    assert any("alpha" in note for note in image.notes)


def test_the_content_tells_the_format_not_the_name(tmp_path: Path) -> None:
    image = sample("uint16", colour=False)
    tifffile.imwrite(tmp_path / "lies.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "lies.png").pixels, image)


@pytest.mark.parametrize(
    ("array", "dtype"),
    [
        (np.full((4, 4), 70000, np.int32), "float32"),
        (np.full((4, 4), 4095, np.int64), "uint16"),
        (np.full((4, 4), -1, np.int16), "float32"),
        (np.full((4, 4), 0.5, np.float64), "float32"),
        (np.full((4, 4), 5, ">u2"), "uint16"),
        (np.ones((4, 4), bool), "uint8"),
        (np.ones((1, 4, 4, 1), np.uint8), "uint8"),
    ],
)
def test_unusual_arrays_keep_their_values(tmp_path: Path, array: npt.NDArray[np.generic], dtype: str) -> None:
    np.save(tmp_path / "a.npy", array)
    pixels = read_image(tmp_path / "a.npy").pixels
    assert pixels.dtype == dtype
    np.testing.assert_array_equal(pixels, array.reshape(4, 4))


def test_a_channels_first_array_is_colour(tmp_path: Path) -> None:
    image = sample("uint16", colour=True)
    np.save(tmp_path / "a.npy", np.moveaxis(image, -1, 0))
    np.testing.assert_array_equal(read_image(tmp_path / "a.npy").pixels, image)


def test_one_array_in_an_npz_is_read_and_of_two_the_one_that_is_named(tmp_path: Path) -> None:
    image = sample("uint8", colour=False)
    np.savez(tmp_path / "one.npz", psf=image)
    np.testing.assert_array_equal(read_image(tmp_path / "one.npz").pixels, image)
    np.savez(tmp_path / "two.npz", a=image, b=image)
    with pytest.raises(FileError, match=r"2 arrays \(a, b\)"):
        read_image(tmp_path / "two.npz")
    np.testing.assert_array_equal(read_image(f"{tmp_path / 'two.npz'}::b").pixels, image)
    with pytest.raises(FileError, match="holds no array called c; there are: a, b"):
        read_image(f"{tmp_path / 'two.npz'}::c")


def test_planar_and_compressed_tiffs(tmp_path: Path) -> None:
    image = sample("uint8", colour=True)
    tifffile.imwrite(tmp_path / "planar.tif", np.moveaxis(image, -1, 0), planarconfig="separate",
                     photometric="rgb", compression="zlib")  # fmt: skip
    np.testing.assert_array_equal(read_image(tmp_path / "planar.tif").pixels, image)
    cv2.imwrite(str(tmp_path / "lzw.tif"), image[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    np.testing.assert_array_equal(read_image(tmp_path / "lzw.tif").pixels, image)


def test_stacks_from_pages_arrays_and_folders(tmp_path: Path) -> None:
    stack = (RNG.random((5, 6, 7)) * 60000).astype(np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", stack, photometric="minisblack")
    np.save(tmp_path / "s.npy", stack)
    folder = tmp_path / "psfs"
    folder.mkdir()
    for i, image in enumerate(stack):
        write_image(folder / f"psf{i:02}.tif", image)
    for path in (tmp_path / "s.tif", tmp_path / "s.npy", folder):
        np.testing.assert_array_equal(read_stack(path).pixels, stack)
    for given in (tmp_path / "s.tif", read_stack(tmp_path / "s.tif")):
        with pytest.raises(FileError, match=r"5 images; a single one .* mean\. PSFs go by --volume"):
            read_image(given, several="PSFs go by --volume.")
    write_image(folder / "psf99.tif", stack[0, :3])
    with pytest.raises(FileError, match=r"psf99\.tif: is 3 x 7 .* psf00\.tif is 6 x 7"):
        read_stack(folder)


def test_metadata_travels_with_the_image(tmp_path: Path) -> None:
    image, metadata = sample("uint16", colour=False), {"exposure_ms": 5.0}
    write_image(tmp_path / "a.tif", image, metadata)
    write_image(tmp_path / "b.png", image, metadata)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        assert json.loads(tiff.pages[0].description) == metadata
    assert json.loads((tmp_path / "b.json").read_text()) == metadata


def test_a_folder_of_one_image_stands_for_it(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "today_photograph"
    (run / "frames.ome.zarr").mkdir(parents=True)
    (run / "state.json").write_text("{}")
    with pytest.raises(FileError, match=r"a file is expected, and it holds no images\.$"):
        read_image(run)
    write_image(run / "photograph.tif", np.eye(5, dtype=np.uint16))
    assert read_image(run).path == read(run).path == run / "photograph.tif"
    with pytest.raises(FileError, match=r"Folders in it that do: .*today_photograph"):
        read_image(tmp_path / "runs")
    write_image(run / "b.tif", np.eye(5, dtype=np.uint16))
    with pytest.raises(FileError, match=r"a file is expected\. Images in it: b.tif, photograph.tif\."):
        read_image(run)


def make_bad_files(folder: Path) -> None:
    (folder / "empty.tif").write_bytes(b"")
    (folder / "text.png").write_text("this is no image, though its name says so")
    good = folder / "good.tif"
    tifffile.imwrite(good, np.zeros((50, 50), np.uint16))
    (folder / "cut.tif").write_bytes(good.read_bytes()[:200])
    np.save(folder / "good.npy", np.zeros((50, 50)))
    (folder / "cut.npy").write_bytes((folder / "good.npy").read_bytes()[:300])
    np.save(folder / "nan.npy", np.array([[0.0, np.nan], [np.inf, 1.0]]))
    np.save(folder / "complex.npy", np.ones((3, 3), complex))
    np.save(folder / "objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(folder / "line.npy", np.zeros(9))
    np.save(folder / "void.npy", np.zeros((0, 4)))
    (folder / "no.npz").write_bytes(b"PK\x03\x04 nonsense")
    cv2.imwrite(str(folder / "good.png"), np.zeros((64, 64), np.uint8) + 3)
    (folder / "folder.tif").mkdir()
    (folder / "table.csv").write_text("1,2\n3,4\n")
    (folder / "canon.cr2").write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(200))
    (folder / "canon.cr3").write_bytes(b"\0\0\0\x18ftypcrx " + bytes(200))
    thumbnail, sensor = np.full((8, 8), 9, np.uint8), np.full((64, 64), 900, np.uint16)
    with tifffile.TiffWriter(folder / "nikon.nef") as tiff:  # as NEF, DNG and ARW: the pixels lie further in
        tiff.write(thumbnail, subfiletype=1, subifds=1, metadata=None)
        tiff.write(sensor, metadata=None)


BAD = {
    "absent.tif": "no such file",
    "folder.tif": "is a folder",
    "empty.tif": "empty",
    "text.png": "no image",
    "cut.tif": "damaged",
    "cut.npy": "damaged",
    "nan.npy": r"2 values that are no finite numbers \(the first, nan, at index \(0, 1\)\)",
    "complex.npy": "complex128",
    "objects.npy": "plain",
    "line.npy": r"shape \(9,\)",
    "void.npy": "empty array",
    "no.npz": "npz",
    "table.csv": "text, no image.*loadtxt",
    "canon.cr2": "camera's raw file.*16-bit TIFF",
    "canon.cr3": "camera's raw file.*16-bit TIFF",
    "nikon.nef": "camera's raw file.*16-bit TIFF",
}


@pytest.mark.parametrize(("name", "pattern"), BAD.items())
def test_what_is_no_image_is_refused_in_words(tmp_path: Path, name: str, pattern: str) -> None:
    make_bad_files(tmp_path)
    with pytest.raises(FileError, match=pattern) as caught:
        read_image(tmp_path / name)
    assert name in str(caught.value)


def test_a_damaged_picture_is_told_of_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cut.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(FileError, match="damaged"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "image", "pattern"),
    [
        ("a.jpg", np.zeros((4, 4), np.uint8), r"'\.jpg' is no format to write.*\.tif"),
        ("a", np.zeros((4, 4), np.uint8), "no suffix"),
        ("a.png", np.zeros((4, 4), np.float32), "uint8 or uint16, not float32"),
        ("absent/a.tif", np.zeros((4, 4), np.uint8), "does not exist"),
    ],
)
def test_what_cannot_be_written_is_refused_before_a_file_appears(
    tmp_path: Path, name: str, image: npt.NDArray[np.generic], pattern: str
) -> None:
    with pytest.raises(FileError, match=pattern):
        write_image(tmp_path / name, image)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file_and_no_remains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.tif"
    write_image(path, np.ones((4, 4), np.uint8))
    before = path.read_bytes()

    def full_disk(*_args: object, **_more: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space") as caught:
        write_image(path, np.zeros((4, 4), np.uint8))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]
