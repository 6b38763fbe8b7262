"""PSF and photograph of different binnings or colours come to the same pixels, and that is said."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instrument.files.errors import FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.job import Job, job_from_files, job_with
from instrument.reconstruction.matching import (
    MEAN_COLOUR,
    check_pair,
    matched,
    matched_calibration,
    whole_binnings,
)
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.preparation import Crop, darkest_corner
from recon import reconstruct
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.evaluation.scene import make_scene

Pixels = Array


@pytest.fixture(scope="module")
def pair() -> tuple[Pixels, Pixels]:
    """A PSF and a photograph through it, counts on an offset of 100, every 2 x 2 of them alike."""
    scene = make_scene("sparse-picture", size=48)
    psf, photograph = (
        (100 + 40_000 * np.clip(image / image.max(), 0, 1)).astype(np.uint16)
        for image in (scene.calibration.psfs[0, 0], np.asarray(scene.measurement))
    )
    return fine(psf), fine(photograph)


def fine(pixels: Pixels) -> Pixels:
    return np.repeat(np.repeat(pixels, 2, axis=0), 2, axis=1)


def job(psf: Pixels, photograph: Pixels, **inputs: Any) -> Job:
    asked = InputOptions(**{"binning": 1, "erasures": "none", "dark": 100.0} | inputs)
    return job_from_files(ImageFile(Path("psf.tif"), psf), ImageFile(Path("raw.tif"), photograph), asked)


def test_whichever_has_more_pixels_is_binned_and_that_is_said(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = pair
    both = job(psf, photograph, binning=2)
    for ours, theirs, which in (
        (psf, photograph[::2, ::2], "PSF"),
        (psf[::2, ::2], photograph, "photograph"),
    ):
        made = job(ours, theirs)
        np.testing.assert_allclose(made.measurement, both.measurement, rtol=1e-5)
        np.testing.assert_allclose(made.calibration.psfs, both.calibration.psfs, rtol=1e-5)
        assert f"the {which} is binned 2 x 2" in made.warnings[0]
    assert made.provenance["image_binning"] == 2  # its noise is less
    assert not both.warnings


def test_the_window_is_on_the_pixels_that_both_come_to(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = pair
    window = Crop(8, 4, 24, 32)
    made = job(psf[::2, ::2], photograph, crop=window)
    assert made.measurement.shape == made.calibration.psfs.shape[-2:] == (24, 32)
    np.testing.assert_allclose(made.measurement, photograph[::2, ::2][8:32, 4:36] - 100.0)


def test_a_dark_frame_of_the_photograph_leaves_the_psf_its_own_level(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = pair
    for ours, theirs in ((psf, photograph[::2, ::2]), (psf[::2, ::2], photograph)):
        made = job(ours, theirs, dark=ImageFile(Path("dark.tif"), np.full_like(theirs, 60)))
        np.testing.assert_allclose(made.measurement, photograph[::2, ::2] - 60.0)
        assert made.calibration.psfs.min() == 0
        assert "from the PSF" in made.notes["Dark"]


@pytest.mark.parametrize("srgb", ["none", "psf"])
def test_a_dark_frame_given_leaves_the_psf_light_that_grows_across_it(
    pair: tuple[Pixels, Pixels], srgb: str
) -> None:
    psf, photograph = pair
    psf = (psf + np.linspace(0, 8000, psf.shape[1])).astype(np.uint16)
    theirs = photograph if srgb == "psf" else photograph[::2, ::2]
    dark = ImageFile(Path("dark.tif"), np.full_like(theirs, 60))
    noted = job(psf, theirs, dark=dark, srgb=srgb).notes["Dark"]
    told = re.search(r"([\d.]+) from the PSF \(its upper left corner\)", noted)
    assert told is not None
    counts, name = darkest_corner(psf)  # straightened, it is darker
    assert name == "upper left"
    assert 0 < float(told[1]) <= round(counts, 1)
    asked = job(psf, theirs, dark="auto").notes["Dark"]  # which a plane is for
    assert "grows across" in asked


def test_a_binned_pixel_is_erased_where_one_of_its_pixels_is_saturated(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = pair
    bright = photograph.copy()
    bright[10, 20:23] = 65535
    made = job(psf[::2, ::2], bright, erasures="saturated")
    assert made.valid is not None
    assert [tuple(int(n) for n in place) for place in np.argwhere(~made.valid)] == [(5, 10), (5, 11)]


def test_of_a_psf_with_colours_a_grey_photograph_takes_the_mean(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = pair
    grey = job(psf, photograph)
    tinted = np.stack([100 + (psf - 100.0) * gain for gain in (1.0, 0.6, 0.2)], axis=-1).astype(np.uint16)
    made = job(tinted, photograph)
    np.testing.assert_allclose(made.calibration.psfs, 0.6 * grey.calibration.psfs, atol=1)
    assert "their mean is taken" in made.warnings[0]
    image = ImageFile(Path("raw.tif"), photograph)
    calibration = replace(grey.calibration, psfs=np.concatenate([grey.calibration.psfs] * 3, axis=1))
    by_folder = job_with(calibration, Path("cal"), image, InputOptions(binning=1))
    assert by_folder.calibration.psfs.shape[1] == 1
    assert "their mean is taken" in by_folder.warnings[0]


def test_three_planes_that_may_be_depths_are_no_psf_of_a_grey_photograph(
    pair: tuple[Pixels, Pixels], tmp_path: Path
) -> None:
    psf, photograph = pair
    file = tmp_path / "psf.npy"
    np.save(file, np.stack([psf, np.roll(psf, 3, axis=0), np.roll(psf, 5, axis=1)]))
    image = ImageFile(Path("raw.tif"), photograph)
    asked = InputOptions(binning=1, erasures="none", dark=100.0)
    with pytest.raises(FileError, match=r"nothing tells whether .* given by --volume"):
        job_from_files(file, image, asked)
    colour = ImageFile(Path("raw.tif"), np.stack([photograph] * 3, axis=-1))
    made = job_from_files(file, colour, asked)
    assert made.calibration.psfs.shape[1] == 3
    assert "its three planes taken as colours" in made.notes["PSF"]
    (tmp_path / "psf.json").write_text('{"depths_um": [1e4, 2e4, 3e4]}')
    with pytest.raises(FileError, match=r"holds 3 images; .* --volume"):
        job_from_files(file, colour, asked)


@pytest.mark.parametrize(
    ("psf", "image", "binnings"),
    [
        ((60, 80), (60, 80), (1, 1)),
        ((61, 81), (30, 40), (2, 1)),
        ((20, 26), (61, 80), (1, 3)),
        ((60, 80), (30, 80), None),
        ((60, 80), (40, 60), None),
        ((900, 900), (100, 100), None),
    ],
)
def test_binnings_are_whole_and_few(psf: Any, image: Any, binnings: Any) -> None:
    assert whole_binnings(psf, image) == binnings


def of_shape(*shape: int, dtype: type = np.uint16) -> ImageFile:
    return ImageFile(Path("a.tif"), np.zeros(shape, dtype))


@pytest.mark.parametrize("colours", [(), (3,)])
def test_what_no_whole_binning_brings_together_is_refused(colours: tuple[int, ...]) -> None:
    for fits in ((60, 80), (30, 40), (180, 241)):
        check_pair(of_shape(*fits, *colours), of_shape(60, 80, *colours))
    with pytest.raises(FileError, match="a whole multiple of the other's") as refused:
        check_pair(of_shape(60, 80, *colours), of_shape(50, 80, *colours))
    assert "rotated" not in str(refused.value)
    with pytest.raises(FileError, match="One of them may be rotated"):
        check_pair(of_shape(60, 80, *colours), of_shape(80, 60, *colours))


def test_pixels_of_a_mosaic_are_not_averaged() -> None:
    check_pair(of_shape(60, 80), of_shape(60, 80), mosaic=True)
    with pytest.raises(FileError, match=r"must have one shape\.") as refused:
        check_pair(of_shape(30, 40), of_shape(60, 80), mosaic=True)
    assert "multiple" not in str(refused.value)


def test_one_of_two_bit_depths_was_converted() -> None:
    for other in (np.uint16, np.float32):  # of numbers that are no counts nobody knows
        check_pair(of_shape(4, 4, dtype=other), of_shape(4, 4))
        check_pair(of_shape(4, 4), of_shape(4, 4, dtype=other))
    eight = of_shape(4, 4, dtype=np.uint8)
    with pytest.raises(FileError, match=r"PSF has 8 bit, but the image a\.tif has 16 bit"):
        check_pair(eight, of_shape(4, 4))
    check_pair(eight, of_shape(4, 4), allow_mixed_depth=True)


def test_a_colour_pair_keeps_its_colours(pair: tuple[Pixels, Pixels]) -> None:
    psf, photograph = (np.stack([image, image // 2, image // 4], axis=-1) for image in pair)
    made = job(psf, photograph[::2, ::2], dark=0.0)
    assert made.measurement.shape == photograph[::2, ::2].shape
    assert made.calibration.psfs.shape == (1, 3, *photograph[::2, ::2].shape[:2])
    assert len(made.warnings) == 1
    grey, colour = of_shape(4, 4), of_shape(4, 4, 3)
    assert not matched(grey, colour, mosaic=False).warnings
    assert matched(colour, grey, mosaic=True).psf.is_colour
    lit = replace(made.calibration, background=np.ones((3, *made.calibration.psfs.shape[-2:]), np.float32))
    for image, mosaic in ((colour, False), (grey, True)):
        assert matched_calibration(lit, image, mosaic=mosaic) == (lit, "")
    one, words = matched_calibration(lit, grey, mosaic=False)
    assert (one.psfs.shape[1], words) == (1, MEAN_COLOUR)
    assert one.background is not None
    np.testing.assert_array_equal(one.background, np.ones((1, *lit.psfs.shape[-2:])))
    assert matched_calibration(one, grey, mosaic=False) == (one, "")
    assert matched_calibration(replace(one, background=None), grey, mosaic=False)[0].background is None


def test_a_dark_frame_of_both_is_taken_off_both_and_one_of_colours_by_colour(
    pair: tuple[Pixels, Pixels],
) -> None:
    psf, photograph = pair
    dark = ImageFile(Path("dark.tif"), np.full_like(photograph, 60))
    made = job(psf, photograph, dark=dark)
    np.testing.assert_allclose(made.measurement, photograph - 60.0)
    np.testing.assert_allclose(made.calibration.psfs[0, 0], psf - 60.0)
    assert "from the PSF" not in made.notes["Dark"]
    colours = [np.stack([image] * 3, axis=-1) for image in pair]
    made = job(*colours, dark=ImageFile(Path("dark.tif"), np.full_like(colours[1], 60)))
    np.testing.assert_allclose(made.calibration.psfs[0, 2], psf - 60.0)


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)
def test_a_region_of_interest_that_was_taken_for_a_binned_photograph_is_not_called_reliable() -> None:
    psfs, photograph = measured_set("hand")
    psf, raw = (np.maximum(block_mean(a, 16), 0) for a in (psfs[0], photograph))
    made = job(psf, raw[19:56, 25:75], dark=0.0)
    verdict = reconstruct(made.as_measurement(None), made.calibration).verdict
    assert verdict is not None
    assert not verdict.sentences[0].startswith("reliable"), verdict.sentences
