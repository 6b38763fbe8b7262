"""Files that other programs wrote: in their order, with their axes, turned and packed as they are."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from PIL import Image

from instrument.files.errors import FileError
from instrument.files.images import read, read_image, read_stack, write_image
from instrument.files.orientation import Orientation
from instrument.reconstruction.mosaic import mosaic_of, suspected_mosaic
from instrument.reconstruction.stored_result import export_result, open_result
from recon.camera.factors import PATTERNS, split_bayer

RNG = np.random.default_rng(3)
STACK = RNG.integers(0, 4096, (5, 8, 6)).astype(np.uint16)
PICTURE = STACK[0]


@pytest.mark.parametrize(
    ("names", "depths_um"),
    [
        ([f"psf_{n}.tif" for n in range(1, 13)], ()),
        (["z60mm.tif", "z60.5mm.tif", "z68mm.tif", "z115mm.tif"], (6e4, 6.05e4, 6.8e4, 1.15e5)),
        (["psf z-50um.tif", "psf z-8um.tif", "psf z0um.tif", "psf z10um.tif"], (-50.0, -8.0, 0.0, 10.0)),
        (["2026-11-02_a.tif", "2026-11-10_a.tif"], ()),
        (["z-20.tif", "z-2.5.tif", "z0.tif", "z2.5.tif"], ()),
        (["psf-1.tif", "psf-2.tif", "psf-10.tif"], ()),
        (["psf_0p9mm.tif", "psf_1p10mm.tif", "psf_1p2mm.tif"], (900.0, 1100.0, 1200.0)),
        (["9,8mm.tif", "10,2mm.tif"], (9800.0, 10200.0)),
        (["1e2um.tif", "3e1um.tif"], ()),
        (["1e+06nm.tif", "1e-35um.tif"], ()),
        (["t=5,100um.tif", "t=4,300um.tif"], (100.0, 300.0)),
        (["pos1,2,5um.tif", "pos1,2,50um.tif", "step1p200um.tif"], (5.0, 50.0, 200.0)),
        (["10x_1mm.tif", "10x_2mm.tif", "10x_10mm.tif"], (1e3, 2e3, 1e4)),
        ([f"day3.{n}.tif" for n in range(1, 12)], ()),
        (["v1.125.tif", "v1.25.tif", "v1.5.tif"], ()),
        ([f"run.1.{n}.tif" for n in range(5, 13)], ()),
        (["b01.tif", "b1.tif", "z0.5.tif", "z0.75.tif", "z0.9.tif"], ()),
    ],
)  # fmt: skip
def test_a_folder_is_read_in_the_order_that_people_mean(
    tmp_path: Path, names: list[str], depths_um: tuple[float, ...]
) -> None:
    for number in RNG.permutation(len(names)):
        write_image(tmp_path / names[number], np.full((4, 4), number, np.uint8))
    stack = read_stack(tmp_path)
    assert stack.pixels[:, 0, 0].tolist() == list(range(len(names)))
    assert stack.metadata == {"files": names, "depths_um": pytest.approx(list(depths_um))}
    assert names[-1] in stack.notes[0]


def test_micro_managers_z_positions_give_the_order(tmp_path: Path) -> None:
    noted = {"Summary": {"ZStep_um": 5}}
    for number, z in enumerate((10.0, 0.0, -10.0)):
        name = f"img_channel000_position000_time000000000_z{number:03d}.tif"
        tifffile.imwrite(tmp_path / name, np.full((4, 4), number, np.uint16))
        noted[f"Metadata-Default/{name}"] = {"ZPositionUm": z, "FileName": f"Default/{name}"}
    (tmp_path / "metadata.txt").write_text(json.dumps(noted))
    stack = read_stack(tmp_path)
    assert stack.pixels[:, 0, 0].tolist() == [2, 1, 0]
    assert stack.metadata["depths_um"] == [-10.0, 0.0, 10.0]


def test_a_film_of_micro_manager_stays_in_time_though_its_focus_wanders(tmp_path: Path) -> None:
    noted = {}
    for number, z in enumerate((3.0, 1.0, 2.0)):
        name = f"img_channel000_position000_time{number:09d}_z000.tif"
        tifffile.imwrite(tmp_path / name, np.full((4, 4), number, np.uint16))
        noted[f"Metadata-Default/{name}"] = {"ZPositionUm": z, "FileName": f"Default/{name}"}
    (tmp_path / "metadata.txt").write_text(json.dumps(noted))
    film = read_stack(tmp_path)
    assert film.pixels[:, 0, 0].tolist() == [0, 1, 2]
    assert film.metadata["depths_um"] == []


@pytest.mark.parametrize(
    "name", ["img_channel{}_position000_time000000000_z{:03d}.tif", "img_000000000_{}_{:03d}.tif"]
)
def test_micro_managers_channels_are_no_depths(tmp_path: Path, name: str) -> None:
    for number in range(6):
        tifffile.imwrite(tmp_path / name.format(("DAPI", "FITC")[number % 2], number // 2), PICTURE)
    with pytest.raises(FileError, match=r"holds images in 2 .channel. x 3 .z.; one stack is expected"):
        read_stack(tmp_path)


def test_colour_of_floats_is_imagejs_and_comes_back(tmp_path: Path) -> None:
    picture = RNG.random((8, 6, 3), np.float32)
    picture[0, 0] = 0.97, 0.98, 0.99
    said = {"simulated": True, "pitch": "5 µm"}
    write_image(tmp_path / "p.tif", np.rot90(picture), said)
    with tifffile.TiffFile(tmp_path / "p.tif") as tiff:
        told = tiff.imagej_metadata
        assert told is not None
        assert (told["mode"], told["channels"]) == ("composite", 3)
        assert json.loads(told["Info"]) == said
        assert told["Ranges"][::2] == (0, 0, 0)
        assert 0.9 < min(told["Ranges"][1::2]) <= max(told["Ranges"][1::2]) <= 1
        assert tiff.series[0].axes == "CYX"
        np.testing.assert_array_equal(tiff.asarray(), np.moveaxis(np.rot90(picture), -1, 0))
    assert read_image(tmp_path / "p.tif").metadata == said
    tifffile.imwrite(tmp_path / "old.tif", np.rot90(picture), photometric="rgb", metadata=None)
    for name in ("p", "old"):
        result = open_result(tmp_path / f"{name}.tif")
        assert result.image is not None
        np.testing.assert_array_equal(result.image, np.rot90(picture))
        export_result(result, tmp_path / f"{name}-turned.tif", orientation=Orientation(quarters=3))
        np.testing.assert_array_equal(read_image(tmp_path / f"{name}-turned.tif").pixels, picture)
    for odd in (np.stack([picture, 2 * picture]), picture[:, :1], picture.astype(np.float64)):
        write_image(tmp_path / "odd.tif", odd)
        np.testing.assert_array_equal(read(tmp_path / "odd.tif").pixels, odd.astype(np.float32))
    write_image(tmp_path / "counts.tif", (255 * picture).astype(np.uint8))
    with tifffile.TiffFile(tmp_path / "counts.tif") as tiff:
        assert (tiff.is_imagej, tiff.series[0].axes) == (False, "YXS")


def test_a_folder_of_one_stack_is_that_stack(tmp_path: Path) -> None:
    (tmp_path / "psf_MMStack_Pos0_metadata.txt").write_text("{}")
    said = {"PositionZ": [4.0, 2.0, 0.0, -2.0, -4.0], "PositionZUnit": ["µm"] * 5}
    tifffile.imwrite(
        tmp_path / "psf_MMStack_Pos0.ome.tif", STACK, ome=True, metadata={"axes": "ZYX", "Plane": said}
    )
    write_image(tmp_path / "photo.tif", PICTURE)
    stack = read_stack(tmp_path, leave_out=tmp_path / "photo.tif")
    np.testing.assert_array_equal(stack.pixels, STACK)
    assert stack.metadata == {"depths_um": said["PositionZ"]}


def test_depths_that_a_stack_tells_are_said_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, STACK, imagej=True, metadata={"axes": "ZYX", "spacing": 0.5, "unit": "mm"})
    stack = read_stack(path)
    assert stack.metadata == {"depths_um": [0.0, 500.0, 1000.0, 1500.0, 2000.0]}
    assert stack.notes == ("planes every 500 um as it says",)
    places = [2000.0, 2250.0, 2571.4, 3000.0, 3600.0]
    said = {"PositionZ": places, "PositionZUnit": ["µm"] * 5}
    tifffile.imwrite(path, STACK, ome=True, metadata={"axes": "ZYX", "PhysicalSizeZ": 250, "Plane": said})
    stack = read_stack(path)
    assert stack.metadata == {"depths_um": places}
    assert stack.notes == ("planes at 2 to 3.6 mm as it says, not evenly spaced",)
    said["PositionZ"] = [2000.0, 3600.0, 2250.0, 2571.4, 3000.0]
    tifffile.imwrite(path, STACK, ome=True, metadata={"axes": "ZYX", "Plane": said})
    assert read_stack(path).notes == ("planes at 2 to 3.6 mm as it says, not in the order of depths",)
    tifffile.imwrite(
        path, STACK, ome=True, metadata={"axes": "ZYX", "PhysicalSizeZ": 5, "PhysicalSizeZUnit": "nm"}
    )
    assert read_stack(path).metadata == {"depths_um": pytest.approx([0, 0.005, 0.01, 0.015, 0.02])}
    tifffile.imwrite(path, STACK, ome=True, metadata={"axes": "TYX", "TimeIncrement": 1.0})
    assert (read_stack(path).metadata, read_stack(path).notes) == ({"frame_period_s": 1.0}, ())


def test_a_photograph_called_ome_tif_is_one(tmp_path: Path) -> None:
    ome_types = pytest.importorskip("ome_types")
    facts = {
        "camera": "12345",
        "light": "true",
        "simulated": True,
        "exposure_ms": 2.5,
        "pixel_format": "BayerRG12",
        "significant_bits": 12,
        "black_level": 32.5,
        "utc": "2026-11-25T21:37:19.647770+00:00",
        "stage_position": {"x_um": 1.0, "z_um": -2.0},
        "noise": {"read_noise_counts": 0.5},
        "pixel_pitch_um": 6.5,
    }
    path = tmp_path / "photo.ome.tif"
    write_image(path, PICTURE, facts)
    read_back = read_image(path)
    np.testing.assert_array_equal(read_back.pixels, PICTURE)
    assert read_back.metadata == facts
    assert mosaic_of(read_back) == "RGGB"
    image = ome_types.from_tiff(path).images[0]
    assert (image.pixels.significant_bits, image.pixels.physical_size_x) == (12, 6.5)
    assert (image.pixels.planes[0].exposure_time, image.pixels.planes[0].position_z) == (0.0025, -2.0)
    assert str(image.acquisition_date) == "2026-11-25 21:37:19"
    colour = RNG.random((8, 6, 3), np.float32)
    write_image(path, colour, {"simulated": True})
    with tifffile.TiffFile(path) as tiff:
        assert tiff.series[0].axes == "CYX"
    channels = ome_types.from_tiff(path).images[0].pixels.channels
    assert [channel.name for channel in channels] == ["red", "green", "blue"]
    np.testing.assert_array_equal(read_image(path).pixels, colour)
    assert read_image(path).is_simulated


@pytest.mark.parametrize("name", ["photo.tif", "photo.ome.tif"])
def test_a_photograph_tells_its_pixels_size_to_who_knows_no_ome(tmp_path: Path, name: str) -> None:
    write_image(tmp_path / name, PICTURE, {"pixel_pitch_um": 5.0})
    with tifffile.TiffFile(tmp_path / name) as tiff:
        assert tiff.pages.first.get_resolution("MICROMETER") == pytest.approx((0.2, 0.2))


def _lying(upright: npt.NDArray[np.uint8], orientation: int) -> npt.NDArray[np.uint8]:
    """Return an image of 5 x 7 as one of this orientation is stored (TIFF 6.0, page 36)."""
    rows, columns = np.mgrid[:5, :7]
    down, right = 4 - rows, 6 - columns
    stored = {1: (rows, columns), 2: (rows, right), 3: (down, right), 4: (down, columns),
              5: (columns, rows), 6: (right, rows), 7: (right, down), 8: (columns, down)}  # fmt: skip
    image = np.empty((7, 5, 3) if orientation > 4 else (5, 7, 3), np.uint8)
    image[stored[orientation]] = upright
    return image


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["tif", "png", "jpg"])
def test_an_orientation_is_followed(tmp_path: Path, suffix: str, orientation: int) -> None:
    upright = RNG.integers(0, 255, (5, 7, 3)).astype(np.uint8)
    image, path = _lying(upright, orientation), tmp_path / f"a.{suffix}"
    if suffix == "tif":
        tifffile.imwrite(path, image, extratags=[(274, "H", 1, orientation, True)])
    else:
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(image).save(path, exif=exif, quality=100, subsampling=0)
    read = read_image(path)
    np.testing.assert_allclose(read.pixels.astype(float), upright, atol=8 if suffix == "jpg" else 0)
    assert any("orientation" in note for note in read.notes) == (orientation > 1)


def test_a_damaged_note_beside_a_whole_picture_costs_the_picture_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(np.full((8, 8), 100, np.uint8)).save(path, exif=b"Exif\0\0MM\0*\xff\xff\xff\xff")
    read = read_image(path)
    assert read.pixels.shape == (8, 8)
    assert not any("orientation" in note for note in read.notes)


def test_numbers_that_look_like_a_jpegs_header_are_no_size(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 65536, (256, 256)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.tif"), noise)  # OpenCV's own default is LZW
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, noise)
    # Nor are those of a note in front of a JPEG's own header.
    note = b"\xff\xc0\0\x11\x08" + 8 * b"\xff"
    Image.fromarray(np.full((8, 8), 100, np.uint8)).save(tmp_path / "a.jpg", comment=note)
    assert read_image(tmp_path / "a.jpg").pixels.shape == (8, 8)


def test_a_jpeg_that_says_it_is_huge_is_refused_undecoded(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(np.full((8, 8), 100, np.uint8)).save(path)
    data = path.read_bytes()
    size = data.index(b"\xff\xc0") + 5
    path.write_bytes(data[:size] + b"\xff\xff\xff\xff" + data[size + 4 :])
    with pytest.raises(FileError, match="made to fill the memory"):
        read_image(path)


def test_a_raw_frame_of_a_mosaic_is_recognised_or_asked_about(tmp_path: Path) -> None:
    scene = 100.0 + RNG.random(90).cumsum() + RNG.random((80, 90))  # grey, whatever the draw
    for pattern in PATTERNS:
        seen = split_bayer(scene, pattern)[0] @ np.array([0.5, 1.0, 0.7])
        raw = seen.astype(np.uint16)
        path = tmp_path / "raw.tif"
        tifffile.imwrite(path, raw)
        assert f"--bayer {pattern}" in suspected_mosaic(read_image(path))
        told = bytes("RGB".index(colour) for colour in pattern)
        tifffile.imwrite(path, raw, extratags=[(33422, "B", 4, told, True)])
        assert mosaic_of(read_image(path)) == pattern
    for rows, columns in ((1.0, 1.0), (1.1, 1.0), (1.0, 1.1)):  # grey; sensors read out by two amplifiers
        grey = scene.copy()
        grey[::2] *= rows
        grey[:, ::2] *= columns
        tifffile.imwrite(path, grey.astype(np.uint16))
        assert suspected_mosaic(read_image(path)) == ""
        grey[7, 8:20] = np.nan
        tifffile.imwrite(path, grey.astype(np.float32))
        assert suspected_mosaic(read_image(path, holes=True)) == ""


def test_a_folder_of_folders_names_the_one_with_images(tmp_path: Path) -> None:
    (tmp_path / "Pos0").mkdir()
    write_image(tmp_path / "Pos0" / "a.tif", PICTURE)
    with pytest.raises(FileError, match=r"holds no images.*Pos0"):
        read_stack(tmp_path)
