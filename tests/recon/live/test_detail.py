"""What live pictures hold where time is short: which planes stay, how much they explain, in what order."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.streams.detail import SENSOR_WORK, Detail, _held_by_pixels, _held_by_planes, _spread, ladder

Z_UM = np.array([10e3, 11.14e3, 12e3, 14e3])


@pytest.mark.parametrize(
    ("planes", "z_um", "words"),
    [
        ((0, 1, 2, 3), Z_UM, "4 depths"),
        ((0, 3), Z_UM, "2 of 4 depths (10, 14 mm)"),
        ((0, 3), np.array([1.0, np.nan, 2.0, 3.0]), "2 of 4 depths (0, 3)"),
        (tuple(range(6)), 1e3 * np.arange(7.0), "6 of 7 depths (0, 1, 2, 3, 4, 5 mm)"),
        (tuple(range(7)), 1e3 * np.arange(8.0), "7 of 8 depths (0, 1, ..., 6 mm)"),
    ],
)
def test_depths_are_named_in_millimetres_where_they_are_known(
    planes: tuple[int, ...], z_um: np.ndarray, words: str
) -> None:
    assert Detail(2, planes).depths(z_um) == words
    whole = len(planes) == len(z_um)
    assert Detail(2, planes).words(z_um) == "binned 2 x 2" + ("" if whole else f", {words}")


@pytest.mark.parametrize(
    ("count", "plane", "kept"),
    [
        (4, None, (0, 3, 6, 9)),
        (4, 6, (0, 3, 6, 9)),
        (4, 4, (0, 4, 6, 9)),
        (4, 5, (0, 3, 5, 9)),
        (4, 1, (0, 1, 6, 9)),
        (2, None, (0, 9)),
        (2, 4, (0, 4, 9)),
    ],
)
def test_planes_are_spread_from_the_first_to_the_last_with_the_one_that_is_shown(
    count: int, plane: int | None, kept: tuple[int, ...]
) -> None:
    assert _spread(10, count, plane) == kept


def test_what_binned_pixels_hold_is_the_contrast_that_is_left() -> None:
    fine, coarse = (
        np.indices((8, 8)).sum(axis=0) % 2,
        np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.ones((2, 2))),
    )
    assert _held_by_pixels(coarse[None].astype(np.float32), 1) == 1
    assert _held_by_pixels(fine[None].astype(np.float32), 2) < 0.3


def test_what_planes_hold_is_what_the_nearest_explains_of_each() -> None:
    rng = np.random.default_rng(0)
    flat = rng.normal(3, 1, (3, 1, 6, 7))
    assert _held_by_planes(flat, (0, 1, 2)) == pytest.approx(1)
    correlation = np.corrcoef(flat[0].ravel(), flat[1].ravel())[0, 1]
    last = np.corrcoef(flat[0].ravel(), flat[2].ravel())[0, 1]
    expected = (1 + max(correlation, 0) ** 2 + max(last, 0) ** 2) / 3
    assert _held_by_planes(flat, (0,)) == pytest.approx(expected)
    assert _held_by_planes(np.stack([flat[0], 2 * flat[0] + 1, -flat[0]]), (0,)) == pytest.approx(2 / 3)


def alike(depths: int, likeness: float = 0.999) -> np.ndarray:
    rng = np.random.default_rng(1)
    planes = [rng.normal(0, 1, (1, 16, 16))]
    for _ in range(depths - 1):
        planes.append(likeness * planes[-1] + (1 - likeness**2) ** 0.5 * rng.normal(0, 1, (1, 16, 16)))
    return np.array(planes, np.float32)


def test_of_two_planes_none_is_left_out_and_of_three_one_may_be() -> None:
    assert [d.planes for d in ladder(alike(2), (1, 3), None).values()] == [(0, 1), (0, 1)]
    assert list(ladder(alike(2), (1, 3), None)) == [1.0, 3.0]
    offered = list(ladder(alike(3), (1,), None).values())
    assert offered[0] == Detail(1, (0, 1, 2), 1.0)


def test_a_rung_costs_four_fifths_at_most_and_is_the_best_at_its_price() -> None:
    offered = ladder(alike(64), (1, 2), None)
    assert list(offered) == [detail.coarseness for detail in offered.values()] == sorted(offered)
    for detail in offered.values():
        work = (SENSOR_WORK + len(detail.planes)) / (SENSOR_WORK + 64)
        assert detail.coarseness == pytest.approx(detail.binning / work**0.5)
    assert all((a / b) ** 2 <= 0.8 for a, b in itertools.pairwise(offered))
    counts = [(detail.binning, len(detail.planes)) for detail in offered.values()]
    assert counts[:4] == [(1, 64), (1, 32), (1, 16), (1, 8)], "planes that are hardly told apart go first"
    assert counts[-1] == (2, 4), "two planes more spare less than a fifth"
    apart = [(d.binning, len(d.planes)) for d in ladder(alike(64, 0.1), (1, 2), None).values()]
    assert apart[0] == (1, 64)
    assert (2, 64) in apart


def test_planes_that_are_the_same_go_before_pixels_but_never_of_two() -> None:
    halves = np.repeat((np.indices((16, 16))[1] % 8 < 4)[None, None].astype(np.float32), 4, axis=0)
    for depths, planes in ((2, (0, 1)), (3, (0, 2)), (4, (0, 3))):
        offered = list(ladder(halves[:depths], (1, 2), None).values())
        assert [(d.binning, d.planes) for d in offered] == [(1, tuple(range(depths))), (2, planes)]


def test_pixels_are_judged_by_the_depth_in_the_middle() -> None:
    rng = np.random.default_rng(0)
    fine = rng.random((1, 16, 16)).astype(np.float32)
    coarse = gaussian_filter(rng.random((1, 16, 16)), (0, 3, 3), mode="wrap").astype(np.float32)
    for middle, planes_first in ((coarse, False), (fine, True)):
        planes = np.array([fine, fine, coarse, middle, coarse, fine, fine])
        planes[[0, 1, 2, 4, 5, 6]] += 0.01 * rng.random((6, 1, 16, 16)).astype(np.float32)
        offered = [(d.binning, d.planes) for d in ladder(planes, (1, 2), None).values()]
        assert ((1, (0, 6)) in offered) == planes_first


def test_binned_pixels_lie_about_the_axis() -> None:
    psf = np.zeros((1, 6, 6), np.float32)
    psf[0, :, 0] = 1
    assert _held_by_pixels(psf, 2) == 0, "half a block's column is left out at each side"
