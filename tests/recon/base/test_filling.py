"""Erased pixels filled, against Gaussians written as matrices."""

import numpy as np
import pytest

from recon.base.filling import fill_smoothly


def test_erased_pixels_are_like_their_neighbours_and_the_others_stay():
    y, x = np.mgrid[:40, :50]
    image = 3 + np.sin(y / 20) + x / 25
    weight = np.ones_like(image)
    weight[10:14, 20:25] = weight[::7, ::5] = 0
    filled = np.where(weight > 0, image, np.nan)
    fill_smoothly(filled, weight)
    assert np.array_equal(filled[weight > 0], image[weight > 0])
    assert filled == pytest.approx(image, abs=0.3)
    lonely = np.zeros((40, 50))
    lonely[3, 4] = 1
    filled = 7 * lonely
    fill_smoothly(filled, lonely)
    assert filled == pytest.approx(np.full((40, 50), 7.0))


def smoothed(image, reach):
    """By a Gaussian in the frequencies of a mirrored image, as a matrix along each side."""
    sides = []
    for n in image.shape:
        k = np.arange(n)[:, None]
        cosines = np.sqrt(np.where(k, 2, 1) / n) * np.cos(np.pi * k * (np.arange(n) + 0.5) / n)
        sides.append(cosines.T @ (np.exp(-0.5 * (reach * np.pi * k / n) ** 2) * cosines))
    return sides[0] @ image @ sides[1].T


@pytest.mark.parametrize("kind", ["a block", "a strip", "a corner", "one side"])
def test_an_erased_pixel_is_the_mean_by_the_narrowest_gaussian_that_sees_a_thousandth_of_what_is_known(kind):
    """What none of them sees that is narrower than the longer side is the mean of all that is known."""
    weight = np.zeros(
        {"a block": (22, 34), "a strip": (40, 3), "a corner": (32, 32), "one side": (8, 64)}[kind]
    )
    weight[0, 0] = 1
    if kind == "a block":
        weight[...] = 1
        weight[3:20, 2:31] = 0
    elif kind == "one side":
        weight[:2, :2] = 1
    elif kind == "a corner":
        weight[0, 1] = 1
    image = 1 + np.random.default_rng(6).random(weight.shape)
    expected, missing = image * weight, weight == 0
    for reach in (reach for reach in (1, 2, 4, 8, 16, 32, 64) if reach < max(weight.shape)):
        share = smoothed(weight, reach)
        near = missing & (share > 1e-3)
        expected[near] = smoothed(image * weight, reach)[near] / share[near]
        missing &= ~near
    assert missing.any() == (kind == "a corner")
    expected[missing] = image[weight > 0].mean()
    fill_smoothly(image, weight)
    np.testing.assert_allclose(image, expected, rtol=1e-9)


def test_where_nothing_is_known_nothing_is_filled():
    image = np.full((5, 6), np.nan)
    fill_smoothly(image, np.zeros((5, 6)))
    assert not image.any()
