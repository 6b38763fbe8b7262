"""Raw frames of colour mosaics, from the file to the colour picture."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.signal import fftconvolve

from instrument.cli import main
from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, read_image, write_image
from instrument.reconstruction.job import job_with
from instrument.reconstruction.mosaic import mosaic_named, mosaic_of, reduce_mosaic, require_mosaic
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.video_files import VideoPictures
from recon.camera.factors import PATTERNS
from recon.errors import InputError
from recon.types import Calibration
from tests.mocks.recordings import write_recording

HEIGHT, WIDTH = 36, 48
COLOURS = np.array([1.0, 0.5, 0.2])


def sites(pattern):
    """Index of every pixel's colour."""
    index = np.empty((HEIGHT, WIDTH), int)
    for k, colour in enumerate(pattern):
        index[k // 2 :: 2, k % 2 :: 2] = "RGB".index(colour)
    return index


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("crop", "binning"), [(None, 1), ("3,5,20,30", 1), (None, 4), ("3,5,21,30", 2)])
def test_every_colour_is_the_mean_of_its_own_pixels(pattern, crop, binning):
    raw = (10.0 * (1 + sites(pattern))).astype(np.float32)
    window = None if crop is None else Crop.parse(crop)
    image, known = reduce_mosaic(raw, pattern, window, binning)
    assert image.shape[:2] == tuple(
        n // binning for n in ((20, 30) if crop and binning == 1 else (21, 30) if crop else raw.shape)
    )
    for c in range(3):
        assert np.all(image[..., c][known[..., c]] == 10 * (c + 1))
    assert np.array_equal(known.sum(axis=2), np.full(image.shape[:2], 1 if binning == 1 else 3))


def test_an_odd_binning_and_a_colour_file_are_refused():
    with pytest.raises(BenchError, match="take an even number"):
        reduce_mosaic(np.zeros((6, 6), np.float32), "RGGB", None, 3)
    with pytest.raises(InputError, match="choose one of RGGB"):
        mosaic_named("RGBG")
    with pytest.raises(FileError, match="a raw RGGB frame is grey"):
        require_mosaic(ImageFile("x.tif", np.zeros((4, 4, 3), np.uint8)), "RGGB")


def test_pixels_of_which_an_odd_number_make_one_of_the_calibrations_are_refused_by_what_they_are():
    psf = np.random.default_rng(0).random((1, 1, 12, 16)).astype(np.float32)
    calibration = Calibration(psf, np.full((1, 3), np.nan))
    raw = ImageFile(Path("raw.tif"), np.arange(36 * 48, dtype=np.uint16).reshape(36, 48))
    with pytest.raises(FileError, match="3 x 3 of its pixels make one") as refused:
        job_with(calibration, Path("cal"), raw, InputOptions(mosaic="RGGB"))
    assert "--bin" not in str(refused.value)
    assert job_with(calibration, Path("cal"), raw, InputOptions(mosaic=None)).measurement.shape == (12, 16)


def test_metadata_name_the_mosaic():
    grey = np.zeros((4, 4), np.uint16)
    assert mosaic_of(ImageFile("a", grey, metadata={"pixel_format": "BayerGB12"})) == "GBRG"
    assert mosaic_of(ImageFile("a", grey, metadata={"pixel_format": "Mono12"})) is None
    assert mosaic_of(ImageFile("a", grey)) is None


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(0)
    psf = np.zeros((HEIGHT, WIDTH))
    psf[tuple(rng.integers(8, 28, (2, 25)))] = 1
    psf = fftconvolve(psf, np.outer(*2 * [[0.25, 0.6, 1, 0.6, 0.25]]), "same")
    scene = np.zeros((HEIGHT, WIDTH))
    scene[14:22, 20:28] = 1
    light = np.maximum(fftconvolve(scene, psf, "same"), 0)
    light = 2000 * light / light.max() * COLOURS[sites("GRBG")]
    write_image(tmp_path / "raw.tif", rng.poisson(light).astype(np.uint16), {"pixel_format": "BayerGR12"})
    tifffile.imwrite(tmp_path / "psf.tif", (2000 * psf / psf.max()).astype(np.uint16))
    tifffile.imwrite(tmp_path / "psfs.tif", np.stack([(2000 * psf / psf.max()).astype(np.uint16)] * 2))
    return tmp_path


@pytest.mark.parametrize(("bayer", "binning"), [("auto", 1), ("GRBG", 2)])
def test_a_raw_frame_gives_a_picture_in_its_colours(files, bayer, binning, capsys):
    out = files / "out.tif"
    arguments = [
        "-p",
        files / "psf.tif",
        "-i",
        files / "raw.tif",
        "--dark",
        0,
        "--bin",
        binning,
        "--bayer",
        bayer,
    ]
    assert main(["reconstruct", *map(str, arguments), "-o", str(out)]) == 0
    assert "GRBG" in capsys.readouterr().out
    image = read_image(out).pixels
    assert image.shape == (HEIGHT // binning, WIDTH // binning, 3)
    square = image[15 // binning : 21 // binning, 21 // binning : 27 // binning].mean(axis=(0, 1))
    assert square / square[0] == pytest.approx(COLOURS, abs=0.05)
    assert json.loads(out.with_suffix(".json").read_text())["inputs"]["mosaic"] == "GRBG"


def test_a_volume_takes_a_raw_frame_too(files):
    arguments = ["--volume", files / "psfs.tif", "-i", files / "raw.tif", "--dark", 0, "-n", 2]
    assert main(["reconstruct", *map(str, arguments), "-o", str(files / "v.tif")]) == 0
    assert tifffile.imread(files / "v.tif").shape == (2, 3, HEIGHT, WIDTH)  # OME's order: z, channel, y, x


@pytest.mark.parametrize("binning", [1, 2])
def test_a_recording_of_raw_frames_becomes_a_video_in_colour(files, binning):
    """Every frame, not only the first that settles everything."""
    raw = tifffile.imread(files / "raw.tif")
    run = write_recording(files, {0: raw // 2, 1: raw}, pixel_format="BayerGR12")
    arguments = ["--video", "-p", files / "psf.tif", "--dark", 0, "--bin", binning, "-n", 40, "--no-mp4"]
    assert main(["reconstruct", str(run), *map(str, arguments), "-o", str(files / "v.ome.zarr")]) == 0
    image = VideoPictures(files / "v.ome.zarr").flat(1)
    assert image.shape == (HEIGHT // binning, WIDTH // binning, 3)
    square = image[15 // binning : 21 // binning, 21 // binning : 27 // binning].mean(axis=(0, 1))
    assert square / square[0] == pytest.approx(COLOURS, abs=0.05)


def test_none_takes_the_frame_as_grey(files):
    arguments = ["-p", files / "psf.tif", "-i", files / "raw.tif", "--dark", 0, "-n", 2, "--bayer", "none"]
    assert main(["reconstruct", *map(str, arguments), "-o", str(files / "g.tif")]) == 0
    assert tifffile.imread(files / "g.tif").ndim == 2
