"""Background removal by DCT, and block means."""

from __future__ import annotations

import numpy as np
import pytest

from calibration_routines.psf.psf_quality import remove_low_frequencies
from recon.base.blocks import block_mean


def test_a_slow_gradient_under_sharp_spots_goes_and_the_spots_stay() -> None:
    y, x = np.mgrid[:128, :160] / 160.0
    stray = 50.0 + 30.0 * np.cos(np.pi * x) + 20.0 * np.cos(2 * np.pi * y)
    spots = np.zeros((128, 160))
    spots[8::16, 10::20] = 1000.0
    cleaned, background = remove_low_frequencies(spots + stray, 10)
    assert cleaned.dtype == np.float32
    assert cleaned.min() == 0.0
    assert np.median(cleaned) < 2.0
    assert cleaned[8::16, 10::20].mean() == pytest.approx(1000.0, rel=0.01)
    assert np.abs(background - stray).max() < 12.0  # the spots' own low frequencies


def test_the_lowest_coefficients_are_zero_before_clipping() -> None:
    image = np.random.default_rng(0).random((2, 40, 50)).astype(np.float32)
    _, background = remove_low_frequencies(image, 3)
    from scipy.fft import dctn

    rest = dctn(image - background, axes=(-2, -1), norm="ortho")
    assert np.abs(rest[..., :3, :3]).max() < 1e-4
    assert np.abs(rest[..., 3:, 3:]).max() > 0.1


def test_order_zero_only_clips_negative_values() -> None:
    cleaned, background = remove_low_frequencies(np.array([[-1.0, 2.0], [3.0, -4.0]]), 0)
    assert cleaned.tolist() == [[0.0, 2.0], [3.0, 0.0]]
    assert not background.any()


@pytest.mark.parametrize("order", [-1, 5])
def test_an_order_larger_than_the_image_is_refused(order: int) -> None:
    with pytest.raises(ValueError, match="between 0 and 4"):
        remove_low_frequencies(np.zeros((4, 6)), order)


def test_block_means_cut_what_fills_no_block() -> None:
    image = np.arange(35.0).reshape(5, 7)
    assert block_mean(image, 2).tolist() == [[4.0, 6.0, 8.0], [18.0, 20.0, 22.0]]
    assert block_mean(image[None], 5).tolist() == [[[float(image[:, :5].mean())]]]
    with pytest.raises(ValueError, match="cannot be binned by 6"):
        block_mean(image, 6)
