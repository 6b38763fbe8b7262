"""PSFs from photographs of known pictures, of photographs that another convolution made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, signal

from recon.blind.known_pictures import PicturePsf, PictureSettings, psf_from_pictures, psf_work
from recon.errors import InputError

SHAPE = (48, 56)
GAINS = (0.5, 0.8)
BRIGHTNESS = (1.1, 0.9, 1.0, 1.05, 0.95)
QUICK = PictureSettings(psf_iterations=120)
EDGE = 12  # rows and columns of scene beyond the pictures


def taken(seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return photographs, pictures and the PSF (height, width): light beyond and above the pictures' peak."""
    rng = np.random.default_rng(seed)
    psf = ndimage.gaussian_filter(rng.random((17, 19)), 1.5)
    psf = np.maximum(psf - 0.9 * psf.mean(), 0)
    psf /= psf.sum()
    whole = np.zeros(SHAPE)
    whole[SHAPE[0] // 2 - 8 : SHAPE[0] // 2 + 9, SHAPE[1] // 2 - 9 : SHAPE[1] // 2 + 10] = psf
    scenes = ndimage.gaussian_filter(
        rng.random((5, 2, SHAPE[0] + 2 * EDGE, SHAPE[1] + 2 * EDGE)), (0, 0, 1, 1)
    )
    scenes = np.maximum(scenes - 0.45, 0) * 6
    scenes[:, :, : EDGE - 6] = scenes[:, :, -EDGE:] = scenes[..., :EDGE] = scenes[..., -EDGE:] = 0
    seen = np.stack([[signal.oaconvolve(one, psf, mode="same") for one in scene] for scene in scenes])
    inside = (..., slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    data = seen[inside] * np.array(GAINS)[:, None, None] * np.array(BRIGHTNESS)[:, None, None, None]
    data += 0.02 * rng.random((5, 2, 1, 1)) + 1e-4 * rng.standard_normal(data.shape)
    return data.astype(np.float32), np.minimum(scenes[inside], 1.0).astype(np.float32), whole


@pytest.fixture(scope="module")
def found() -> tuple[PicturePsf, np.ndarray]:
    data, pictures, truth = taken()
    return psf_from_pictures(data, pictures, QUICK), truth


def _alike(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.vdot(first, second) / np.linalg.norm(first) / np.linalg.norm(second))


def test_the_psf_is_found_with_its_gains_and_each_photographs_brightness(
    found: tuple[PicturePsf, np.ndarray],
) -> None:
    result, truth = found
    assert result.psf.shape == (2, *SHAPE)
    assert (result.psf >= 0).all()
    assert _alike(result.psf[0], truth) > 0.98
    assert result.gains[0] / result.gains[1] == pytest.approx(GAINS[0] / GAINS[1], rel=0.02)
    np.testing.assert_allclose(result.brightness, BRIGHTNESS, rtol=0.05)
    assert result.misfit < 0.05


def test_light_beyond_the_pictures_and_above_their_peak_is_told_from_the_psf(
    found: tuple[PicturePsf, np.ndarray],
) -> None:
    result, truth = found
    data, pictures, _ = taken()
    ignorant = psf_from_pictures(data, pictures, replace(QUICK, beyond=0))
    assert ignorant.misfit > 2 * result.misfit
    assert 1 - _alike(ignorant.psf[0], truth) > 2 * (1 - _alike(result.psf[0], truth))


def test_progress_is_told_after_each_iteration_and_goes_with_the_work() -> None:
    """At two scales, of which the coarse one takes a fourth for each of more iterations."""
    data = np.random.default_rng(0).random((2, 1, 128, 8)).astype(np.float32)
    told: list[float] = []
    settings = PictureSettings(beyond=0, saturated=None, foreign=False, rounds=1, psf_iterations=10)
    psf_from_pictures(data, data, settings, on_progress=lambda _, done: told.append(done))
    assert told == sorted(told)
    assert told[0] == 0.0
    assert told[-1] == pytest.approx(1.0)
    coarse = (10 / 4) / (10 / 4 + 7)
    assert told[10] == pytest.approx(coarse)
    assert np.diff(told[1:11]) == pytest.approx(coarse / 10)
    assert np.diff(told[12:]) == pytest.approx((1 - coarse) / 7)
    shape = (16, 1, 240, 320)
    assert psf_work(shape, QUICK) == pytest.approx(2 * psf_work((8, *shape[1:]), QUICK))
    assert psf_work((16, 1, 480, 640), QUICK) > 4 * psf_work(shape, QUICK)


def test_black_borders_of_all_pictures_may_have_been_lit() -> None:
    data, pictures, truth = taken()
    pictures[..., :3, :] = pictures[..., :, -4:] = 0
    framed = psf_from_pictures(data, pictures, replace(QUICK, foreign=False))
    assert framed.misfit < 0.1  # 0.14 if it were taken for black
    assert _alike(framed.psf[0], truth) > 0.96


def test_a_photograph_that_does_not_show_its_picture_is_left_out_and_named(
    found: tuple[PicturePsf, np.ndarray],
) -> None:
    result, truth = found
    assert result.foreign == ()
    data, pictures, _ = taken()
    pictures[1] = pictures[1, :, ::-1]
    spoiled = psf_from_pictures(data, pictures, QUICK)
    assert spoiled.foreign == (1,)
    assert _alike(spoiled.psf[0], truth) > 0.97
    assert np.isnan(spoiled.brightness[1])
    assert np.isfinite(np.delete(spoiled.brightness, 1)).all()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda b, x: (b[:1], x[:1]), "Two or more photographs"),
        (lambda b, x: (b, x[..., 1:]), "same shape"),
        (lambda b, x: (b, x - 1), "not negative"),
        (lambda b, x: (b * np.nan, x), "not finite"),
        (lambda b, x: (b, x * 0 + 1), "Picture 1 shows nothing"),
        (lambda b, x: (b * 0, x), "Photograph 1 shows nothing"),
    ],
)
def test_what_cannot_be_solved_is_refused_in_words(spoil: object, words: str) -> None:
    data, pictures, _ = taken()
    with pytest.raises(InputError, match=words):
        psf_from_pictures(*spoil(data, pictures))  # type: ignore[operator]


def test_the_pictures_gamma_is_found() -> None:
    data, pictures, truth = taken()
    settings = replace(QUICK, rounds=3, gamma=None, saturated=None)
    found = psf_from_pictures(data, pictures ** (1 / 1.8), settings)
    assert found.gamma == pytest.approx(1.8, abs=0.15)
    assert _alike(found.psf[0], truth) > 0.95
