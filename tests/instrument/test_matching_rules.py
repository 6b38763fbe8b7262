"""A PSF and a photograph on common pixels, step by step: binnings, words, colours, what is dark in which."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instrument.files.errors import FileError
from instrument.files.images import PLANES_AS_COLOURS, ImageFile
from instrument.reconstruction.matching import (
    MEAN_COLOUR,
    MOST_TIMES,
    binned_words,
    check_pair,
    matched,
    matched_calibration,
    matched_dark,
    whole_binnings,
)
from instrument.reconstruction.preparation import Dark, bin_image, dark_level
from recon.arrays import Array
from recon.types import Calibration

RNG = np.random.default_rng(2)


def file(pixels: Array, name: str = "a.tif", **facts: Any) -> ImageFile:
    return ImageFile(Path(name), pixels, **facts)


def image(*shape: int) -> ImageFile:
    return file(RNG.integers(0, 999, shape).astype(np.uint16))


def test_at_most_eight_pixels_are_one() -> None:
    assert whole_binnings((80, 160), (10, 20)) == (MOST_TIMES, 1) == (8, 1)
    assert whole_binnings((10, 20), (87, 167)) == (1, 8)
    assert whole_binnings((90, 180), (10, 20)) is None
    assert whole_binnings((10, 20), (20, 40)) == (1, 2)
    assert whole_binnings((10, 20), (5, 20)) is None
    assert whole_binnings([10, 20], (10, 20)) == (1, 1)


@pytest.mark.parametrize(("psf", "photograph"), [((13, 18), (6, 9)), ((6, 9), (13, 18)), ((6, 9), (6, 9))])
def test_a_psf_is_binned_and_a_photograph_is_left_to_be(
    psf: tuple[int, int], photograph: tuple[int, int]
) -> None:
    given, other = image(*psf), image(*photograph)
    found = matched(given, other, mosaic=False)
    ours, theirs = 1 + (psf > photograph), 1 + (psf < photograph)
    assert (found.psf_binning, found.image_binning) == (ours, theirs)
    np.testing.assert_allclose(found.psf.pixels, bin_image(given.pixels, 2) if ours == 2 else given.pixels)
    words = binned_words(psf, photograph, ours, theirs)
    assert found.warnings == ((words,) if ours != theirs else ())


def test_it_is_said_which_is_binned_and_how_often() -> None:
    assert binned_words((13, 18, 3), (6, 9), 2, 1).startswith(
        "The PSF has 13 x 18 pixels and the photograph 6 x 9: the PSF is binned 2 x 2. That is right where"
    )
    assert ": the photograph is binned 3 x 3." in binned_words((6, 9), (20, 28), 1, 3)


def test_colours_that_the_photograph_lacks_become_their_mean_before_it_is_binned() -> None:
    colours, grey = image(12, 18, 3), image(6, 9)
    found = matched(colours, grey, mosaic=False)
    np.testing.assert_allclose(found.psf.pixels, bin_image(colours.pixels.mean(axis=-1), 2), rtol=1e-6)
    assert [words == MEAN_COLOUR for words in found.warnings] == [True, False]
    assert matched(image(6, 9, 3), grey, mosaic=False).warnings == (MEAN_COLOUR,)
    for other, mosaic in ((image(6, 9, 3), False), (grey, True)):
        kept = image(6, 9, 3)
        assert matched(kept, other, mosaic=mosaic).psf is kept
        assert matched(kept, other, mosaic=mosaic).warnings == ()


def test_planes_that_may_be_depths_pass_where_there_are_colours() -> None:
    guessed = file(RNG.random((6, 9, 3)), "planes.npy", notes=(PLANES_AS_COLOURS,))
    with pytest.raises(FileError, match=r"planes\.npy.*nothing tells whether these are colours or depths"):
        check_pair(guessed, image(6, 9))
    check_pair(guessed, image(6, 9), mosaic=True)
    check_pair(guessed, image(6, 9, 3))


@pytest.mark.parametrize("background", [None, RNG.random((3, 6, 9)).astype(np.float32)])
def test_a_calibrations_colours_become_their_mean_with_its_background(background: Any) -> None:
    psfs = RNG.random((2, 3, 6, 9)).astype(np.float32)
    given = Calibration(psfs, np.full((2, 3), np.nan), background=background)
    found, words = matched_calibration(given, image(6, 9), mosaic=False)
    assert words == MEAN_COLOUR
    np.testing.assert_allclose(found.psfs, psfs.mean(axis=1, keepdims=True))
    if background is None:
        assert found.background is None
    else:
        np.testing.assert_allclose(found.background, background.mean(axis=0)[None], rtol=1e-6)


@pytest.mark.parametrize(
    ("channels", "photograph", "mosaic"),
    [(3, (6, 9, 3), False), (3, (6, 9), True), (1, (6, 9), False), (1, (6, 9, 3), False)],
)
def test_where_there_is_nothing_to_mix_a_calibration_stays(
    channels: int, photograph: tuple[int, ...], *, mosaic: bool
) -> None:
    given = Calibration(RNG.random((2, channels, 6, 9)), np.full((2, 3), np.nan))
    found, words = matched_calibration(given, image(*photograph), mosaic=mosaic)
    assert found is given
    assert words == ""


def dark(psf: ImageFile, photograph: ImageFile, level: Any, **how: bool) -> Dark:
    pair = matched(psf, photograph, mosaic=False)
    choice = level if isinstance(level, float | str) else file(level, "dark.tif")
    return matched_dark(choice, psf, photograph, pair, **how)


def test_a_number_is_dark_in_both() -> None:
    found = dark(image(12, 18), image(6, 9), 40.0)
    assert (found.image, found.psf) == (40, 40)


def test_a_frame_of_both_is_dark_in_both_where_they_have_the_same_pixels() -> None:
    frame = RNG.integers(0, 99, (6, 9)).astype(np.uint16)
    found = dark(image(6, 9), image(6, 9), frame)
    np.testing.assert_array_equal(found.image, frame)
    np.testing.assert_array_equal(found.psf, frame)
    assert "from the PSF" not in found.reason
    colours = np.stack([frame, 2 * frame, 6 * frame], axis=-1)
    grey_dark = dark(image(6, 9, 3), image(6, 9), frame)
    np.testing.assert_array_equal(grey_dark.psf, frame)
    mixed = dark(file(RNG.integers(0, 999, (6, 9, 3)).astype(np.uint16)), image(6, 9, 3), colours)
    np.testing.assert_array_equal(mixed.psf, colours)


@pytest.mark.parametrize(
    ("psf", "photograph"), [((48, 52), (24, 26)), ((24, 26), (48, 52)), ((24, 26), (24, 26))]
)
def test_a_frame_of_the_photograph_alone_leaves_the_psf_the_level_of_its_own_corner(
    psf: tuple[int, int], photograph: tuple[int, int]
) -> None:
    pixels = RNG.integers(500, 999, psf).astype(np.uint16)
    pixels[: psf[0] // 2, psf[1] // 2 :] = 70
    frame = RNG.integers(0, 99, photograph).astype(np.uint16)
    found = dark(file(pixels), image(*photograph), frame, apart=True)
    np.testing.assert_allclose(found.image, bin_image(frame, 2) if photograph > psf else frame)
    assert found.psf == 70
    assert found.reason.endswith("from the image, 70 from the PSF (its upper right corner)")
    if psf != photograph:
        assert dark(file(pixels), image(*photograph), frame).reason == found.reason


@pytest.mark.parametrize("colours", [(), (3,)])
@pytest.mark.parametrize("times", [1, 2])
def test_light_that_grows_across_a_psf_is_taken_off_where_it_is_binned_and_mixed(
    colours: tuple[int, ...], times: int
) -> None:
    x = np.linspace(100, 900, 80).reshape(80, *[1 for _ in colours])
    pixels = np.broadcast_to(x, (60, 80, *colours)) * np.array([1, 0.7, 1.2])[: 3 if colours else 1]
    pixels = pixels + RNG.normal(size=pixels.shape)
    y = np.arange(60)[:, None] - 30.0
    spot = 2e4 * np.exp(-(y**2 + (np.arange(80) - 40.0) ** 2) / 18)
    psf = file((pixels + spot.reshape(60, 80, *[1 for _ in colours])).astype(np.uint16))
    photograph = image(60 // times, 80 // times)
    whole = dark_level("auto", psf, photograph).psf
    assert isinstance(whole, np.ndarray)
    assert whole.shape == (60, 80, *colours)
    grey = whole.mean(axis=-1) if colours else whole
    np.testing.assert_allclose(dark(psf, photograph, "auto").psf, bin_image(grey, times), rtol=1e-5)
