"""Files for the eye are straightened by the option that the verdict offers, and only then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from instrument.files.errors import FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.job import job_from_files
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.straightened import SrgbChoice, straightened

SHAPE = (40, 60)


def file(pixels: npt.NDArray[np.generic], name: str = "photo.png") -> ImageFile:
    return ImageFile(Path(name), pixels)


def coded(light: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
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
