"""Files for the eye are straightened by the option that the verdict offers, and only then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.job import job_from_files, job_with, source_record
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import volume_job
from instrument.reconstruction.straightened import SrgbChoice, straightened
from recon.arrays import Float64Array
from recon.types import Calibration

SHAPE = (40, 60)


def file(pixels: npt.NDArray[np.generic], name: str = "photo.png") -> ImageFile:
    return ImageFile(Path(name), pixels)


def coded(light: Float64Array) -> Float64Array:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(("kind", "most"), [(np.uint8, 255), (np.uint16, 65535)])
def test_integers_become_light_as_16_bit_with_their_full_scale(kind: type[np.integer], most: int) -> None:
    light = np.linspace(0, 1, 300).reshape(15, 20)
    found = straightened(file(np.round(most * coded(light)).astype(kind))).pixels
    assert found.dtype == np.uint16
    assert found.max() == 65535
    np.testing.assert_allclose(found / 65535, light, atol=max(1.2 / most, 3e-5))


def test_fractions_become_light_and_other_numbers_are_refused() -> None:
    light = np.linspace(0, 1, 300).reshape(15, 20)
    np.testing.assert_allclose(straightened(file(coded(light).astype(np.float32))).pixels, light, atol=1e-5)
    with pytest.raises(FileError, match="from 0 to 1"):
        straightened(file(np.full((4, 4), 3.0, np.float32)))


@pytest.mark.parametrize("which", ["none", "photograph", "psf", "both"])
def test_what_is_named_is_straightened_and_told(which: SrgbChoice) -> None:
    rng = np.random.default_rng(0)
    light = rng.integers(0, 255, (2, *SHAPE)) / 255
    psf, image = (np.round(255 * coded(a)).astype(np.uint8) for a in light)
    job = job_from_files(file(psf, "psf.png"), file(image), InputOptions(dark=0.0, binning=1, srgb=which))
    for name, found, given in (
        ("photograph", job.measurement, light[1]),
        ("psf", job.calibration.psfs[0, 0], light[0]),
    ):
        likeness = float(np.corrcoef(found.ravel(), given.ravel())[0, 1])
        assert (likeness > 0.9999) is (which in (name, "both"))
    assert ("sRGB" in job.notes) is (which != "none")
    assert job.provenance["srgb"] == which


@pytest.mark.parametrize("which", ["none", "photograph", "psf", "both"])
def test_a_volume_of_coded_files_is_straightened_as_a_picture_is(which: SrgbChoice) -> None:
    rng = np.random.default_rng(2)
    pixels = rng.integers(0, 255, (3, *SHAPE)).astype(np.uint8)
    psfs, image = ImageFile(Path("psfs.tif"), pixels[:2]), file(pixels[2])
    options = InputOptions(dark=0.0, erasures="none")
    job = volume_job(psfs, image, replace(options, srgb=which))
    by_hand = volume_job(
        straightened(psfs) if which in ("psf", "both") else psfs,
        straightened(image) if which in ("photograph", "both") else image,
        options,
    )
    np.testing.assert_array_equal(job.measurement, by_hand.measurement)
    np.testing.assert_array_equal(job.calibration.psfs, by_hand.calibration.psfs)
    assert ("sRGB" in job.notes) is (which != "none")
    assert job.provenance["srgb"] == which


def pair() -> tuple[ImageFile, ImageFile]:
    rng = np.random.default_rng(1)
    psf, image = (rng.integers(40, 255, SHAPE).astype(np.uint8) for _ in range(2))
    return file(psf, "psf.png"), file(image)


@pytest.mark.parametrize("which", ["photograph", "psf", "both"])
def test_counts_that_a_straightened_file_does_not_have_are_refused(which: SrgbChoice) -> None:
    with pytest.raises(BenchError, match=f"--dark 12 is in counts, which --srgb {which} changes"):
        job_from_files(*pair(), InputOptions(dark=12.0, srgb=which))
    if which != "psf":
        with pytest.raises(BenchError, match="--noise is in counts"):
            job_from_files(*pair(), InputOptions(noise=3.0, srgb=which))


@pytest.mark.parametrize("which", ["photograph", "psf", "both"])
def test_a_dark_frame_is_straightened_with_its_photograph_and_the_record_is_of_the_file(
    which: SrgbChoice,
) -> None:
    psf, image = pair()
    image = replace(image, metadata={"noise": {"read_noise_counts": 2, "counts_per_electron": 0.1}})
    dark = file(np.full(SHAPE, 40, np.uint8), "dark.png")
    job = job_from_files(psf, image, InputOptions(dark=dark, binning=1, srgb=which))
    seen = [straightened(f).pixels.astype(np.float64) for f in (image, dark)]
    light = image.pixels - 40.0 if which == "psf" else seen[0] - seen[1]
    np.testing.assert_allclose(job.measurement, light, atol=1)
    assert (job.known_noise is None) is (which != "psf")
    assert job.provenance["image"] == source_record(image)
    assert "uint8" in job.notes["Image"]
    assert ("from the PSF (its" in job.notes["Dark"]) is (which != "both")
    with pytest.raises(FileError, match="the dark frame has 16 bit"):
        job_from_files(psf, image, InputOptions(dark=file(np.ones(SHAPE, np.uint16)), srgb=which))


def test_a_photograph_that_is_straightened_for_a_calibration_is_told_too() -> None:
    psf, image = pair()
    calibration = Calibration(psf.pixels[None, None].astype(np.float32), np.full((1, 3), np.nan))
    job = job_with(calibration, Path("cal"), image, InputOptions(srgb="photograph"))
    assert job.notes["sRGB"] == "photograph: made proportional to the light"
