"""Baseline, dF/F and regions against plain definitions and known activity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from recon import InputError
from recon.streams.activity import baseline, change, fading, floor_of, smoothed
from recon.streams.motion import aligned, motion
from recon.streams.regions import (
    BEYOND,
    FOLLOWS,
    PASSES,
    WEAK,
    WIDE,
    find_regions,
    local_correlation,
    noise_of,
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
    regions = find_regions(frames - base, noise=noise_of(frames)).regions
    assert len(regions) == 3
    for place, course in zip(PLACES, active, strict=True):
        own = min(regions, key=lambda region: np.hypot(*np.subtract(region.centre, place)))
        assert np.hypot(*np.subtract(own.centre, place)) < 1
        assert np.corrcoef(own.trace(frames), course)[0, 1] > 0.97


def test_no_region_lies_beyond_the_outermost_calibration_points() -> None:
    frames, _ = cells()
    excess = frames - baseline(frames, 100)
    (top, left), (bottom, right) = np.min(PLACES, axis=0), np.max(PLACES, axis=0)
    assert len(find_regions(excess, field=(top - 1, left - 1, bottom + 1, right + 1)).regions) == 3
    found = find_regions(excess, field=(top + 2, left - 1, bottom + 1, right + 1))
    assert (len(found.regions), found.left_out[BEYOND]) == (2, 1)


def test_noise_alone_has_no_regions() -> None:
    frames = 1 + 0.1 * np.random.default_rng(0).standard_normal((150, *SHAPE)).astype(np.float32)
    assert find_regions(frames).regions == []


def test_noise_that_is_flat_in_patches_has_no_regions() -> None:
    patches = np.random.default_rng(0).standard_normal((150, 10, 12)).astype(np.float32)
    frames = 1 + 0.1 * np.kron(patches, np.ones((1, 4, 4), np.float32))
    assert local_correlation(frames).max() > 0.9
    assert find_regions(frames).regions == []


@pytest.mark.parametrize("count", [30, 150])
def test_a_static_scene_has_no_regions_though_its_pictures_settle_from_block_to_block(count: int) -> None:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    point = np.exp(-((y - 20) ** 2 + (x - 24) ** 2) / 4)
    speckles = np.kron(
        rng.random((20, 24)) < 0.1, np.ones((2, 2))
    )  # of the first iterations, where it is dark
    settling = np.exp(-(np.arange(count) % 32) / 4)[:, None, None]
    noise = ndimage.gaussian_filter(rng.standard_normal((count, *SHAPE)), (0, 1, 1))
    frames = (1000 * point * (1 + 0.02 * noise + 0.02 * settling) + settling * speckles).astype(np.float32)
    base = baseline(frames, 100)
    found = find_regions(frames - base, noise=noise_of(frames))
    assert found.regions == []
    assert WEAK in found.left_out
    assert np.abs(change(frames, base, floor_of(frames))).max() < 0.3


def drifting(count: int, speed: float) -> np.ndarray:
    """A sheet of random texture that moves through the field."""
    wide = SHAPE[1] + int(count * speed) + 2
    texture = ndimage.gaussian_filter(np.random.default_rng(5).standard_normal((SHAPE[0], wide)), 1.5)
    texture = 1 + 0.3 * texture / texture.std()
    frames = [
        ndimage.shift(texture, (0, -speed * t), order=1, mode="nearest")[:, : SHAPE[1]] for t in range(count)
    ]
    noise = 0.02 * np.random.default_rng(6).standard_normal((count, *SHAPE))
    return (np.array(frames) + noise).astype(np.float32)


@pytest.mark.parametrize("speed", [0.03, 0.3, 1.0])
def test_a_moving_sheet_has_no_regions(speed: float) -> None:
    frames = drifting(120, speed)
    excess = frames - baseline(frames, 300)
    found = motion(frames)
    assert not found.is_still
    told = find_regions(excess, noise=noise_of(frames), moved=found)
    assert told.regions == []
    # Where nobody tells of the motion, what passes tells itself.
    alone = find_regions(excess, noise=noise_of(frames))
    assert len(alone.regions) <= 1
    assert alone.left_out[PASSES] > 5


def test_a_sheet_that_sways_changes_as_the_frames_move() -> None:
    still = drifting(1, 0.0)[0]
    way = 2 * np.sin(2 * np.pi * np.arange(120) / 50)
    frames = np.array([ndimage.shift(still, (0, at), order=1, mode="nearest") for at in way], np.float32)
    frames += 0.02 * np.random.default_rng(0).standard_normal(frames.shape).astype(np.float32)
    told = find_regions(frames - baseline(frames, 300), noise=noise_of(frames), moved=motion(frames))
    assert told.regions == []
    assert told.left_out[FOLLOWS] > 5


def test_what_changes_everywhere_is_no_region() -> None:
    frames, _ = cells(noise=0.02)
    lamp = np.where((np.arange(len(frames)) // 40) % 2, 1.2, 1.0)[:, None, None].astype(np.float32)
    flat = np.repeat(frames[:1], len(frames), axis=0)
    noise = 0.02 * np.random.default_rng(1).standard_normal(frames.shape).astype(np.float32)
    told = find_regions(flat * lamp + noise - frames[0], noise=0.02)
    assert told.regions == []
    assert told.left_out[WIDE] >= 1


def test_neurons_in_frames_that_sway_are_found_once_moved_back() -> None:
    frames, active = cells()
    way = np.stack([0 * np.arange(len(frames)), 1.5 * np.sin(np.arange(len(frames)) / 9)], axis=1)
    moved = np.stack([ndimage.shift(f, s, order=3, mode="nearest") for f, s in zip(frames, way, strict=True)])
    found = motion(moved)
    there = aligned(moved, found)
    told = find_regions(there - baseline(there, 100), noise=noise_of(there), moved=found)
    assert len(told.regions) == len(PLACES)
    for region in told.regions:
        own = int(np.argmin([np.hypot(*np.subtract(region.centre, place)) for place in PLACES]))
        assert np.corrcoef(region.trace(there), active[own])[0, 1] > 0.9


def test_neighbours_with_other_courses_stay_apart() -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spots = np.array([np.exp(-((y - 20) ** 2 + (x - c) ** 2) / 8) for c in (20, 27)])
    frames = 0.5 + np.tensordot((1 + courses(240)[:2]).T, spots, axes=1)
    frames = (frames + 0.03 * np.random.default_rng(0).standard_normal(frames.shape)).astype(np.float32)
    regions = find_regions(frames).regions
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


def test_a_cell_of_one_pixel_whose_light_hops_is_found_by_its_width() -> None:
    rng = np.random.default_rng(3)
    light = 1 + courses(240)[0]
    frames = rng.normal(0.02, 0.01, (240, 24, 30)).clip(0).astype(np.float32)
    frames[:, 4, 4] += 1  # stands, and does not flash
    share = rng.random(240)
    frames[:, 12, 14] += light * share
    frames[:, 12, 15] += light * (1 - share)
    found = []
    for seen in (frames, smoothed(frames, 1.5)):
        above = seen - baseline(seen, 200, 20.0)
        found.append([r.centre for r in find_regions(above, noise=noise_of(seen)).regions])
    assert found == [[], [pytest.approx((12, 14.5), abs=1.0)]]


def test_noise_that_lasts_from_frame_to_frame_counts_in_full() -> None:
    rng = np.random.default_rng(0)
    fresh = rng.normal(0, 1, (200, *SHAPE)).astype(np.float32)
    lasting = np.empty_like(fresh)
    lasting[0] = fresh[0]
    for n in range(1, len(fresh)):
        lasting[n] = 0.6 * lasting[n - 1] + 0.8 * fresh[n]  # of variance 1 as well
    own, kept = noise_of(10 + fresh), noise_of(10 + lasting)
    assert own == pytest.approx(1 / 3, rel=0.05)
    assert kept > 0.85 * own  # 0.63 from frame to frame


def test_light_that_breathes_over_the_whole_field_is_no_noise() -> None:
    fresh = 10 + np.random.default_rng(3).normal(size=(80, 24, 24)).astype(np.float32)
    breath = 5 * np.sin(np.arange(80) / 8).astype(np.float32)
    assert noise_of(fresh + breath[:, None, None]) == pytest.approx(noise_of(fresh), rel=0.1)
