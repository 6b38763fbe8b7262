"""Baseline, dF/F and regions against plain definitions and known activity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from recon import InputError
from recon.streams.activity import (
    aligned,
    baseline,
    change,
    fading,
    find_regions,
    floor_of,
    local_correlation,
    motion,
)

SHAPE = (40, 48)
PLACES = ((10, 12), (12, 34), (29, 20))


def courses(count: int, seed: int = 0) -> np.ndarray:
    """Transients that rise at once and decay, one row a cell."""
    rng = np.random.default_rng(seed)
    spikes = rng.random((len(PLACES), count)) < 0.03
    decay = np.exp(-np.arange(60) / 12)
    return np.array([np.convolve(s, decay)[:count] for s in spikes.astype(float)])


def cells(count: int = 240, noise: float = 0.05, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spots = np.array([np.exp(-((y - r) ** 2 + (x - c) ** 2) / (2 * 2.0**2)) for r, c in PLACES])
    active = courses(count)
    frames = 0.3 + np.tensordot((1 + active).T, spots, axes=1)
    frames = frames + noise * np.random.default_rng(seed).standard_normal(frames.shape)
    return frames.astype(np.float32), active


def test_baseline_is_the_percentile_where_it_is_anchored_and_follows_bleaching() -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((100, 3, 4)).astype(np.float32)
    whole = baseline(frames, 1000)
    np.testing.assert_allclose(
        whole, np.broadcast_to(np.percentile(frames, 20, axis=0), whole.shape), rtol=1e-5
    )
    sliding = baseline(frames, 20)
    np.testing.assert_allclose(sliding[50], np.percentile(frames[40:60], 20, axis=0), rtol=1e-5)
    bleached = (np.exp(-np.arange(400) / 200)[:, None, None] * np.ones((1, 2, 2))).astype(np.float32)
    assert np.abs(baseline(bleached, 40) / bleached - 1)[20:-20].max() < 0.08
    assert baseline(bleached[:2], 3).shape == (2, 2, 2)


def test_fading_is_found_under_activity_and_taken_out_of_the_baseline() -> None:
    frames, active = cells(noise=0.02)
    fade = 0.2 ** (np.arange(len(frames)) / (len(frames) - 1))
    found = fading((frames * fade[:, None, None]).astype(np.float32))
    assert found[0] == 1
    assert found[-1] == pytest.approx(0.2, rel=0.1)
    assert fading(frames)[-1] == pytest.approx(1, abs=0.1)
    bleached = (frames * fade[:, None, None]).astype(np.float32)
    correlations = []
    for given in (None, found):
        level = baseline(bleached, 100, 20, given)[:, 10, 12]
        trace = bleached[:, 10, 12] / level - 1
        correlations.append(float(np.corrcoef(trace, active[0])[0, 1]))
    assert correlations[0] < 0.9
    assert correlations[1] > 0.97


def test_a_step_that_stays_is_not_told_as_twice_itself() -> None:
    frames, _ = cells(noise=0.02)
    step = np.where(np.arange(len(frames)) < 0.65 * len(frames), 1.0, 2.0)
    # Of frames half the video apart nearly all lie on both sides of it: 3.8 where the light ends at 2.
    assert 1 < fading((frames * step[:, None, None]).astype(np.float32))[-1] < 2
    longer = 0.2 ** (np.arange(1203) / 1202)
    assert fading((longer[:, None, None] * np.ones((1, 2, 2))).astype(np.float32))[-1] == pytest.approx(0.2)


@pytest.mark.parametrize("frames", [np.zeros((4, 3, 3)), -np.ones((4, 3, 3)), np.ones((1, 3, 3))])
def test_fading_of_what_does_not_shine_is_none(frames: np.ndarray) -> None:
    assert (fading(frames.astype(np.float32)) == 1).all()


def test_change_is_relative_where_it_shines_and_small_where_it_is_dark() -> None:
    base = np.full((5, 10, 10), 100.0, np.float32)
    base[:, :, :5] = 0.01
    dff = change(base * 1.5 + 0.01, base, floor_of(base))
    assert dff[:, :, 5:] == pytest.approx(0.5, abs=1e-3)
    assert np.abs(dff[:, :, :5]).max() < 0.01
    with pytest.raises(InputError, match="dark"):
        floor_of(np.zeros((3, 4, 4), np.float32))


@pytest.mark.parametrize("settings", [{"window": 2}, {"window": 10, "percentile": 101}])
def test_impossible_baselines_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(InputError):
        baseline(np.ones((5, 2, 2), np.float32), **settings)  # type: ignore[arg-type]


def test_local_correlation_is_the_mean_over_the_neighbours() -> None:
    frames = np.random.default_rng(1).standard_normal((20, 5, 6)).astype(np.float32)
    found = local_correlation(frames)
    for row, column in ((2, 3), (0, 0), (4, 2)):
        near = [
            np.corrcoef(frames[:, row, column], frames[:, row + dy, column + dx])[0, 1]
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
            if (dy, dx) != (0, 0) and 0 <= row + dy < 5 and 0 <= column + dx < 6
        ]
        assert found[row, column] == pytest.approx(np.mean(near), abs=1e-5)


def test_cells_are_found_with_their_courses_and_nothing_else() -> None:
    frames, active = cells()
    base = baseline(frames, 100)
    regions = find_regions(change(frames, base, floor_of(base)))
    assert len(regions) == 3
    for place, course in zip(PLACES, active, strict=True):
        own = min(regions, key=lambda region: np.hypot(*np.subtract(region.centre, place)))
        assert np.hypot(*np.subtract(own.centre, place)) < 1
        assert np.corrcoef(own.trace(frames), course)[0, 1] > 0.97


def test_noise_alone_has_no_regions() -> None:
    frames = 1 + 0.1 * np.random.default_rng(0).standard_normal((150, *SHAPE)).astype(np.float32)
    assert find_regions(frames) == []


def test_noise_that_is_flat_in_patches_has_no_regions() -> None:
    patches = np.random.default_rng(0).standard_normal((150, 10, 12)).astype(np.float32)
    frames = 1 + 0.1 * np.kron(patches, np.ones((1, 4, 4), np.float32))
    assert local_correlation(frames).max() > 0.9
    assert find_regions(frames) == []


def test_neighbours_with_other_courses_stay_apart() -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spots = np.array([np.exp(-((y - 20) ** 2 + (x - c) ** 2) / 8) for c in (20, 27)])
    frames = 0.5 + np.tensordot((1 + courses(240)[:2]).T, spots, axes=1)
    frames = (frames + 0.03 * np.random.default_rng(0).standard_normal(frames.shape)).astype(np.float32)
    regions = find_regions(frames)
    assert sorted(round(region.centre[1]) for region in regions) == pytest.approx([20, 27], abs=1)


def test_motion_is_found_and_taken_out() -> None:
    still, _ = cells(40, noise=0.01)
    way = np.cumsum(np.random.default_rng(0).uniform(-0.3, 0.3, (40, 2)), axis=0)
    moved = np.stack([ndimage.shift(f, s, order=3, mode="nearest") for f, s in zip(still, way, strict=True)])
    assert motion(still).is_still
    found = motion(moved)
    assert not found.is_still
    np.testing.assert_allclose(found.shifts, way - np.median(way, axis=0), atol=0.15)
    there = aligned(moved, found)
    assert motion(there).largest_px < 0.3
    truth = ndimage.shift(still[5], np.median(way, axis=0), order=3, mode="nearest")
    before, after = (np.abs(video[5] - truth)[4:-4, 4:-4].mean() for video in (moved, there))
    assert after < 0.3 * before
