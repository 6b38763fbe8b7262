"""Binning: block means and sums against reshaped arrays, and where blocks lie."""

import numpy as np
import pytest

from recon.base.blocks import block_mean, block_sum, blocks_about_axis, whole_blocks
from recon.base.noise import NoiseModel, averaged_noise


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
@pytest.mark.parametrize("shape", [(31, 47), (2, 20, 30), (2, 3, 5, 6)])
def test_means_are_of_whole_blocks_from_the_first_pixel(factor, shape):
    image = np.random.default_rng(0).integers(0, 65536, shape).astype(np.uint16)
    height, width = (n // factor for n in shape[-2:])
    cut = image[..., : height * factor, : width * factor].astype(float)
    tiles = cut.reshape(*shape[:-2], height, factor, width, factor)
    found = block_mean(image, factor)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, tiles.mean(axis=(-3, -1)), rtol=1e-6)
    np.testing.assert_allclose(block_sum(image, factor), tiles.sum(axis=(-3, -1)), rtol=1e-6)


@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("n", [12, 13, 14, 15, 16, 17])
def test_blocks_about_the_axis_keep_its_pixel(n, factor):
    first, count = blocks_about_axis(n, factor)
    assert first >= 0
    assert first + count * factor <= n
    assert first + (count // 2) * factor == n // 2
    image = np.zeros((n, n))
    image[n // 2, n // 2] = factor**2
    found = block_mean(image, factor, about_axis=True)
    assert found.shape == (count, count)
    assert found[count // 2, count // 2] == 1
    assert found.sum() == 1


def test_an_image_smaller_than_a_block_is_refused():
    with pytest.raises(ValueError, match="cannot be binned by 6"):
        block_mean(np.zeros((4, 7)), 6)


def test_a_mean_of_pixels_has_less_noise():
    assert averaged_noise(NoiseModel(4.0, 2.0), 4) == NoiseModel(2.0, 0.5)
    assert averaged_noise(6.0, 9) == 2.0
    assert averaged_noise(None, 4) is None


def test_blocks_stay_large_where_few_pixels_are_erased():
    valid = np.ones((1, 600, 800), bool)
    assert whole_blocks(valid, 9) == 9
    valid[0, [100, 300], [200, 400]] = False  # hot pixels
    assert whole_blocks(valid, 9) == 9
    valid[0, :150, :200] = False  # a bright corner
    assert whole_blocks(valid, 9) == 9
    few = np.random.default_rng(0).random(valid.shape) < 0.98
    assert whole_blocks(few, 9) == 2
    assert whole_blocks(np.random.default_rng(0).random(valid.shape) < 0.6, 9) == 1
