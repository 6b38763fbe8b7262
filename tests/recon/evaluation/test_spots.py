"""Points lost or made up, on their own and in crowds."""

from __future__ import annotations

import numpy as np
import pytest

from recon.evaluation.scene_trial import spot_severity

Floats = np.ndarray


def severity(found: Floats, truth: Floats, places: Floats, reach_planes: float = 1.5) -> float:
    return spot_severity(found, truth, places, resolved_px=2.0, reach_planes=reach_planes)


def on_grid(places: Floats, light: Floats, shape: tuple[int, int, int]) -> Floats:
    """Share every point's light among its eight nearest voxels."""
    volume = np.zeros(shape)
    corner = np.floor(places).astype(int)
    for offset in np.ndindex(2, 2, 2):
        share = np.prod(np.where(offset, places - corner, 1 - (places - corner)), axis=1)
        index = np.minimum(corner + offset, np.array(shape) - 1)
        np.add.at(volume, tuple(index.T), light * share)
    return volume


def crowd(seed: int, count: int, shape: tuple[int, int, int] = (4, 64, 64)) -> tuple[Floats, Floats]:
    """Points anywhere, of brightness 0.5 to 1.5: too many for any to be on its own."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.05, 0.95, (count, 3)) * (np.array(shape) - 1)
    return places, on_grid(places, rng.uniform(0.5, 1.5, count), shape)


def test_points_are_lost_made_up_or_found() -> None:
    places = np.array([[0, 10, 10], [0, 10, 30], [0, 30, 10], [0, 30, 30]], float)
    found = np.zeros((1, 41, 41))
    for _, row, column in places.astype(int):
        found[0, row, column + 1] = 1.0  # a pixel off is found
    assert severity(found, found, places) == 0
    lost = found.copy()
    lost[0, 30, 31] = 0
    assert severity(lost, found, places) == pytest.approx(0.25 / 0.1)
    made_up = found.copy()
    made_up[0, 20, 20] = 1
    assert severity(made_up, found, places) == pytest.approx(0.2 / 0.1)
    assert severity(np.zeros((1, 41, 41)), found, places) > 1


def test_depth_has_a_reach_of_its_own() -> None:
    found = np.zeros((7, 21, 21))
    found[5, 10, 10] = 1
    places = np.array([[2.0, 10, 10]])
    assert severity(found, found, places) > 1
    assert severity(found, found, places, reach_planes=3) == 0


@pytest.mark.parametrize("count", [120, 400, 900])
def test_a_perfect_reconstruction_of_a_crowd_has_lost_nothing(count: int) -> None:
    """Points nearer than any method separates, or hidden by others on the grid, are not asked for."""
    places, truth = crowd(0, count)
    assert severity(truth, truth, places) == 0
    faint = truth + np.random.default_rng(1).random(truth.shape) * 0.02
    assert severity(faint, truth, places) < 0.5


@pytest.mark.parametrize("count", [120, 400, 900])
def test_what_has_nothing_to_do_with_a_crowd_finds_none_of_it(count: int) -> None:
    """Peaks so many that one is near half of all points by chance: they are not found for that."""
    places, truth = crowd(0, count)
    other = [severity(crowd(seed, count)[1], truth, places) for seed in (1, 2, 3, 4)]
    assert np.mean(other) == pytest.approx(10, rel=0.25)


@pytest.mark.parametrize("count", [120, 400])
def test_the_share_that_is_lost_of_a_crowd_is_told_whatever_lies_near(count: int) -> None:
    shares = []
    for seed in range(4):
        places, truth = crowd(seed, count)
        kept = np.random.default_rng([seed, 9]).random(count) < 0.6
        found = on_grid(places[kept], np.ones(kept.sum()), truth.shape)
        shares.append(severity(found, truth, places) / 10)
    # 40 % are gone, though some of these have a neighbour's peak within reach.
    assert np.mean(shares) == pytest.approx(0.4, abs=0.06)


def test_two_points_nearer_than_the_resolution_are_not_asked_for_one_by_one() -> None:
    rng = np.random.default_rng(0)
    first = np.stack(np.meshgrid([0.0], np.arange(6, 58, 5.0), np.arange(6, 58, 5.0)), axis=-1).reshape(-1, 3)
    places = np.concatenate([first, first + np.array([0, 1.2, 0])])
    single = rng.permutation(len(first))[:40]
    places = np.concatenate([places, first[single] + np.array([0, 0.5, 2.5])])
    truth = on_grid(places, np.ones(len(places)), (1, 64, 64))
    merged = on_grid(first + np.array([0, 0.6, 0]), np.full(len(first), 2.0), (1, 64, 64))
    merged += on_grid(first[single] + np.array([0, 0.5, 2.5]), np.ones(40), (1, 64, 64))
    assert severity(merged, truth, places) < 1


def test_where_no_point_can_be_told_apart_none_is_asked_for() -> None:
    places = np.column_stack([np.zeros(200), 20 + np.arange(200) * 0.05, 20 + np.arange(200) % 7 * 0.2])
    truth = on_grid(places, np.ones(200), (1, 41, 41))
    assert severity(truth, truth, places) == 0
