"""Real data: a hand in front of a diffuser camera must come out as a bright hand on black."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from recon import reconstruct

DATA = (
    Path(os.environ.get("DIFFUSERBENCH_DATA", Path(__file__).parents[2] / "../shared/data"))
    / "diffusercam_hand"
)

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the measured hand is not there: {DATA} (set DIFFUSERBENCH_DATA to its parent)"
)


def load(name: str, binning: int) -> np.ndarray:
    image = tifffile.imread(DATA / name).astype(np.float32)
    image -= image[5:15, 5:15].mean()
    height, width = (n // binning for n in image.shape)
    return image.reshape(height, binning, width, binning).mean(axis=(1, 3))


@pytest.mark.parametrize("binning", [4, pytest.param(2, marks=pytest.mark.slow)])
def test_hand_with_five_fingers_on_black(binning):
    result = reconstruct(
        load("rawdata_hand_sample.tif", binning), load("psf_sample.tif", binning), iterations=100
    )
    image = result.image / np.percentile(result.image, 99.9)
    assert image.shape == (1200 // binning, 1600 // binning)

    # The hand is one bright region in the middle; the rest is black.
    bright = ndimage.binary_opening(image > 0.08, iterations=4 // binning)
    labels, count = ndimage.label(bright)
    sizes = ndimage.sum_labels(bright, labels, range(1, count + 1))
    hand = labels == 1 + int(np.argmax(sizes))
    assert 0.02 < hand.mean() < 0.12
    assert np.median(image[~ndimage.binary_dilation(hand, iterations=20 // binning)]) < 0.005
    corners = [image[:40, :40], image[:40, -40:], image[-40:, :40], image[-40:, -40:]]
    assert max(c.mean() for c in corners) < 0.02

    # Five fingers: the thumb crosses a row above the palm once, the others a column right of it four times.
    thumb = image[320 // binning, 600 // binning : 1200 // binning]
    fingers = image[360 // binning : 960 // binning, 1140 // binning : 1180 // binning].mean(axis=1)
    assert runs(ndimage.uniform_filter1d(thumb, 12 // binning) > 0.08) == 1
    assert runs(ndimage.uniform_filter1d(fingers, 12 // binning) > 0.05) == 4


def runs(mask: np.ndarray) -> int:
    return int(np.count_nonzero(np.diff(np.concatenate([[0], mask.astype(int)])) == 1))
