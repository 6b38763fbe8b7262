"""What a result holds is measured as it was put in."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter

from recon.verdict.evidence import FOUND, SMOOTH_PX, STRONG, points_of

RNG = np.random.default_rng(5)


def volume_of(points: dict[tuple[int, int, int], float], planes: int = 4, size: int = 40) -> np.ndarray:
    volume = np.zeros((planes, size, size), np.float32)
    for place, value in points.items():
        volume[place] = value
    return volume


def test_points_are_counted_and_their_height_is_in_units_of_the_noise() -> None:
    volume = volume_of({(0, 10, 10): 1.0, (1, 10, 30): 1.0, (3, 30, 20): 1.0})
    found = points_of(volume, np.full(4, 50.0), 1000)
    assert found.peaks == 3
    # A point smoothed by 0.7 pixels keeps a third of its height.
    assert found.height == pytest.approx(50 * gaussian_filter(volume[0], SMOOTH_PX).max(), rel=1e-5)
    assert points_of(volume, np.full(4, 100.0), 1000).height == pytest.approx(2 * found.height, rel=1e-5)
    # Empty space around them changes nothing.
    wide = np.pad(volume, ((0, 0), (30, 30), (30, 30)))
    assert points_of(wide, np.full(4, 50.0), 1000).height == pytest.approx(found.height, rel=1e-5)
    assert points_of(wide, np.full(4, 50.0), 2000).peaks == 1.5


def test_a_point_on_two_planes_is_one_peak() -> None:
    volume = volume_of({(1, 10, 10): 1.0, (2, 10, 10): 0.7, (2, 11, 10): 0.6})
    assert points_of(volume, np.ones(4), 1000).peaks == 1


def test_light_at_the_ends_is_measured_against_an_even_share() -> None:
    even = np.ones((5, 20, 20), np.float32)
    assert points_of(even, np.ones(5), 400).ends == pytest.approx(1)
    haze = even.copy()
    haze[0] = 3
    assert points_of(haze, np.ones(5), 400).ends == pytest.approx(2 / (7 / 5))
    assert points_of(volume_of({(1, 5, 5): 1, (2, 5, 5): 1}), np.ones(4), 400).ends == 0
    assert points_of(np.zeros((3, 20, 20), np.float32), np.ones(3), 400).height == 0


@pytest.mark.parametrize("planes", [1, 2, 3, 6])
def test_planes_one_by_one_give_what_the_whole_volume_does(planes: int) -> None:
    volume = RNG.random((planes, 30, 26)).astype(np.float32) ** 6
    norms = RNG.uniform(1, 3, planes)
    seen = volume * norms[:, None, None].astype(np.float32)
    smooth = np.stack([gaussian_filter(p, SMOOTH_PX) for p in seen])
    peaks = smooth[smooth == maximum_filter(smooth, 3, mode="constant")]
    level = float((smooth.astype(float) ** 2).sum() / seen.astype(float).sum())
    found = points_of(volume, norms, 100)
    assert found.peaks == pytest.approx(10 * np.count_nonzero(peaks > STRONG * level))
    assert found.height == pytest.approx(np.median(peaks[peaks > FOUND * level]), rel=1e-4)


def test_a_volume_is_never_copied_whole() -> None:
    volume = RNG.random((40, 64, 64)).astype(np.float32)
    tracemalloc.start()
    try:
        points_of(volume, np.ones(40), 4096)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < volume.nbytes / 2
