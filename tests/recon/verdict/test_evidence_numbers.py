"""Evidence by its definitions: PSFs that meet themselves, details on a ring, what is lit, what changes."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.solvers.base import IterationRecord, StoppingRules, StopReason
from recon.verdict import evidence
from recon.verdict.evidence import (
    DIVERGED,
    Evidence,
    Observation,
    averaged,
    evidence_of,
    lit_and_edges,
    measure,
    observations,
    unsettled_by,
)

RNG = np.random.default_rng(8)


def autocorrelation(psf: np.ndarray, down: int, right: int) -> float:
    """Return the product of a PSF with itself moved, by a plain sum, over that of it unmoved."""
    height, width = psf.shape
    total = sum(
        psf[y, x] * psf[y - down, x - right]
        for y in range(height)
        for x in range(width)
        if 0 <= y - down < height and 0 <= x - right < width
    )
    return float(total / np.sum(psf**2))


def test_a_psfs_autocorrelation_is_by_the_sum_and_counts_shifts_to_the_left_from_the_end() -> None:
    psf = RNG.random((6, 9))
    found = evidence._autocorrelation(psf)
    assert found.shape[0] == 6
    for down in range(6):
        for right in range(-8, 9):
            assert found[down, right] == pytest.approx(autocorrelation(psf, down, right), abs=1e-6)
    assert not evidence._autocorrelation(np.zeros((4, 5))).any()


@pytest.mark.parametrize(
    ("cut", "bar", "place"),
    [
        ([1.0, 0.8, 0.4, 0.2], 0.6, 1.5),
        ([1.0, 0.6, 0.4, 0.2], 0.5, 1.5),
        ([1.0, 0.2, 0.9, 0.1], 0.6, 0.5),  # the first time
        ([1.0, 0.9, 0.8], 0.5, 0.0),
        ([1.0, 0.5, 0.25], 0.4, 1.4),
    ],
)
def test_a_cut_falls_to_a_bar_between_its_pixels(cut: list[float], bar: float, place: float) -> None:
    assert evidence._crossing(np.array(cut), bar) == pytest.approx(place)


def spots(places: list[tuple[int, int]], size: int = 64, width_px: float = 1.2) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    return np.asarray(sum(np.exp(-((y - r) ** 2 + (x - c) ** 2) / (2 * width_px**2)) for r, c in places))


@pytest.mark.parametrize(
    ("places", "share"),
    [
        ([(30, 20), (30, 40)], 0.5),
        ([(20, 30), (40, 30)], 0.5),
        ([(20, 45), (44, 20)], 0.5),  # down and to the left
        ([(20, 20), (44, 45)], 0.5),
        ([(10, 10), (10, 30), (10, 50)], 2 / 3),
        ([(30, 30)], 0.0),
        ([(10, 12), (25, 40), (50, 22)], 1 / 3),
    ],
)
def test_ambiguous_is_what_meets_itself_again_when_it_is_moved(
    places: list[tuple[int, int]], share: float
) -> None:
    assert evidence._ambiguity(evidence._autocorrelation(spots(places))) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("width_px", [1.2, 3.0])
def test_shifts_within_a_psfs_own_width_are_not_ambiguous(width_px: float) -> None:
    """A spot's autocorrelation is wider than it by the root of two; twice its half width is left out."""
    correlation = evidence._autocorrelation(spots([(32, 32)], width_px=width_px))
    half_px = 2 * width_px * np.log(2) ** 0.5
    expected = np.exp(-((2 * np.ceil(half_px) + 1) ** 2) / (4 * width_px**2))
    assert evidence._ambiguity(correlation) == pytest.approx(expected, rel=0.05, abs=2e-3)
    pixel = np.zeros((12, 12))
    pixel[5, 5] = pixel[5, 7] = pixel[5, 8] = 1
    # Three pixels: one, two and three apart. The first two shifts are its own sharpness.
    assert evidence._ambiguity(evidence._autocorrelation(pixel)) == pytest.approx(1 / 3)
    pixel[5, 8] = 0
    assert evidence._ambiguity(evidence._autocorrelation(pixel)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("down", [0, 1, 2, 3])
@pytest.mark.parametrize("right", [-3, -2, 0, 2, 3])
def test_two_pixels_are_ambiguous_once_they_are_more_than_two_apart(down: int, right: int) -> None:
    psf = np.zeros((12, 12))
    psf[4, 6] = psf[4 + down, 6 + right] = 1
    far = max(down, abs(right)) > 2
    assert evidence._ambiguity(evidence._autocorrelation(psf)) == pytest.approx(0.5 if far else 0, abs=1e-6)


def test_a_spot_is_as_wide_as_the_mean_of_both_axes() -> None:
    y, x = np.mgrid[:64, :64]
    psf = np.exp(-((y - 30) ** 2) / (2 * 2.0**2) - (x - 30) ** 2 / (2 * 4.0**2))
    # exp(-d^2 / 4 sigma^2) = 0.7 along each axis
    expected = 2 * (-np.log(0.7)) ** 0.5 * (2.0 * 4.0) ** 0.5
    assert evidence._spot_px(evidence._autocorrelation(psf)) == pytest.approx(expected, rel=0.02)
    sharp = evidence._spot_px(evidence._autocorrelation(spots([(32, 32)], width_px=1.2)))
    assert sharp == pytest.approx(2 * 1.2 * (-np.log(0.7)) ** 0.5, rel=0.05)


def one_pixel(size: int = 60) -> np.ndarray:
    psf = np.zeros((1, size, size), np.float32)
    psf[0, 30, 30] = 1
    return psf


def grating(period_px: float, size: int = 60) -> np.ndarray:
    return np.asarray(np.cos(2 * np.pi * np.mgrid[:size, :size][1] / period_px)[None], np.float32)


def test_details_are_of_two_to_five_resolved_distances() -> None:
    """Of the grating alone: its power over the ring's frequencies, a pixel and a noise of deviation one."""

    def detail(volume: np.ndarray, spot_px: float = 2.0, noise: float = 1.0, count: int = 3600) -> float:
        return evidence._detail(volume, one_pixel(), noise, count, spot_px)

    strong = detail(grating(6))
    assert strong > 5 * detail(grating(3))  # finer than two of two pixels
    assert strong > 4 * detail(grating(15))  # coarser than five
    assert detail(grating(15), spot_px=4.0) > 4 * detail(grating(6), spot_px=4.0)
    assert detail(grating(6), spot_px=1.0) == pytest.approx(strong), "no pixel resolves less than two"
    assert detail(grating(6), noise=0.5) == pytest.approx(2 * strong)
    assert detail(grating(6), count=900) == pytest.approx(2 * strong)
    assert detail(np.ones((1, 1, 1), np.float32)[:, :1, :1], spot_px=1e6) == 0
    narrow = evidence._detail(grating(6), one_pixel()[:, :, 20:40], 1.0, 3600, 2.0)
    assert narrow == pytest.approx(strong, rel=0.05), "the PSF's own file need not be a square"
    shape = np.fft.rfft2(grating(6)[0], (120, 120))
    y, x = np.fft.fftfreq(120)[:, None], np.fft.rfftfreq(120)
    ring = (2 * np.hypot(y, x) > 0.2) & (2 * np.hypot(y, x) < 0.5)
    assert strong == pytest.approx(np.sqrt(np.mean(np.abs(shape[ring]) ** 2) / 3600), rel=1e-3)


def test_details_of_planes_are_of_what_they_throw_together() -> None:
    volume = np.concatenate([grating(6), -grating(6)])
    psfs = np.concatenate([one_pixel(), one_pixel()])
    assert evidence._detail(volume, psfs, 1.0, 3600, 2.0) == pytest.approx(0, abs=1e-3)
    same = np.concatenate([grating(6), grating(6)])
    alone = evidence._detail(grating(6), one_pixel(), 1.0, 3600, 2.0)
    assert evidence._detail(same, psfs, 1.0, 3600, 2.0) == pytest.approx(2 * alone)


def test_neighbouring_depths_are_as_alike_as_their_angle_and_as_dim_as_the_dimmest() -> None:
    psfs = np.zeros((3, 1, 4))
    psfs[0, 0, 0] = 4.0
    psfs[1, 0, :2] = 1.0  # 45 degrees from the first
    psfs[2, 0, 1:3] = 3.0  # 60 from the second, 90 from the first
    assert evidence._similarity(psfs) == pytest.approx(0.5**0.5)
    assert evidence._similarity(psfs[:1]) == 0
    assert evidence._similarity(psfs[1:]) == pytest.approx(0.5)
    assert evidence._dimming(psfs) == pytest.approx(2**0.5 / 18**0.5)
    assert evidence._similarity(psfs[:2]) == pytest.approx(0.5**0.5)
    assert evidence._dimming(np.zeros((2, 3, 3))) == 1
    np.testing.assert_allclose(evidence._norms(psfs), [4, 2**0.5, 18**0.5])


def test_voxels_are_lit_above_a_twentieth_of_the_brightest_and_edges_are_steps_of_as_much() -> None:
    volume = np.zeros((2, 6, 8))
    volume[0, 2:4, 3:6] = 1.0
    volume[1, 2, 3] = 0.06
    volume[1, 5, 7] = 0.04
    lit, edges = lit_and_edges(volume)
    assert lit == 7 / 96
    # In the first plane: 3 above, 3 below, 2 left, 2 right, a corner both; the step from plane to plane: 6.
    expected = np.zeros((2, 6, 8), bool)
    for z in range(2):
        for y in range(6):
            for x in range(8):
                ahead = [
                    volume[place]
                    for place in ((z, y + 1, x), (z, y, x + 1), (z + 1, y, x))
                    if place[0] < 2 and place[1] < 6 and place[2] < 8
                ]
                expected[z, y, x] = any(abs(volume[z, y, x] - other) > 0.05 for other in ahead)
    assert edges == expected.sum() / 96
    assert lit_and_edges(np.zeros((1, 4, 4))) == (0, 0)
    assert lit_and_edges(-np.ones((1, 4, 4))) == (0, 0)
    assert lit_and_edges(np.ones((2, 4, 5))) == (1, 0)
    dim = np.full((1, 10, 20), 0.1)
    dim[0, 3, 4] = 10.0  # brighter than 99.5 % of all: it does not make the others dark
    assert lit_and_edges(dim)[0] == 1
    few = np.zeros((1, 40, 40))
    few[0, 7, 9] = 2.0  # fewer than half a per cent
    assert lit_and_edges(few) == (1 / 1600, 3 / 1600)


def test_of_much_a_sample_tells_what_is_bright(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "MOST_SAMPLES", 10)
    volume = np.zeros((1, 10, 10))
    volume[0, :, 0] = 1.0  # every tenth: all of the sample
    volume[0, 3, 4] = 0.04
    assert lit_and_edges(volume)[0] == 10 / 100
    volume[0, :, 0], volume[0, 3, 4] = 0.0, 1.0  # none of it
    assert lit_and_edges(volume)[0] == 1 / 100


def seen(data: np.ndarray, *, noise: float = 1.0, valid: Any = True, saturated: float = 0.0) -> Observation:
    return Observation(data, np.broadcast_to(valid, data.shape), noise, saturated)


def test_signal_misfit_load_and_pixels_are_by_their_sums() -> None:
    data = 3 * RNG.normal(size=(20, 30))
    valid = RNG.random((20, 30)) < 0.7
    volume = np.zeros((2, 24, 32))
    volume[1, 4:9, 4:9] = 1
    psfs = np.concatenate([one_pixel(), 0.5 * one_pixel()])
    found = measure(seen(data, valid=valid, saturated=0.25), volume, psfs, 40.0, unsettled=0.7)
    n, variance = valid.sum(), np.var(data[valid])
    assert found.signal == pytest.approx(np.sqrt(variance - 1))
    assert found.unexplained == pytest.approx(np.sqrt((1600 / n - 1) / (variance - 1)))
    assert found.erased == pytest.approx(1 - n / 600)
    lit, edges = lit_and_edges(volume)
    assert edges != lit
    assert found.load == pytest.approx(min(lit, edges) * 2 * 24 * 32 / n)
    assert (found.lit, found.edges, found.planes) == (lit, edges, 2)
    assert (found.saturated, found.unsettled, found.dimming) == (0.25, 0.7, 0.5)
    assert found.peaks is None
    quiet = measure(seen(0.1 * data), volume, psfs, 5.0, unsettled=0.0)
    assert (quiet.signal, quiet.unexplained) == (0.01, 0.0)


def test_the_middle_depth_tells_how_ambiguous_and_how_sharp_the_optics_are() -> None:
    twice = np.zeros((1, 60, 60), np.float32)
    twice[0, 20, 30] = twice[0, 40, 30] = 1
    data, volume = 3 * RNG.normal(size=(20, 30)), np.zeros((4, 24, 32))
    for place, share in ((2, 0.5), (1, 0.0), (3, 0.0)):
        psfs = np.concatenate([twice if z == place else one_pixel() for z in range(4)])
        assert measure(seen(data), volume, psfs, 40.0, unsettled=0).ambiguity == pytest.approx(
            share, abs=1e-6
        )


def test_points_stand_above_the_noise_by_their_planes_own_psf() -> None:
    volume = np.zeros((3, 24, 32), np.float32)
    volume[1, 10, 10] = 4.0
    psfs = np.concatenate([one_pixel(), 3 * one_pixel(), one_pixel()])
    data = np.zeros((20, 30))
    at_two, at_one = (
        measure(seen(data, noise=n), volume, psfs, 5.0, unsettled=0, points=True) for n in (2.0, 1.0)
    )
    assert at_one.height == pytest.approx(2 * at_two.height)
    assert at_one.peaks == pytest.approx(1000 / 600)
    assert at_one.ends == 0
    faint = evidence.points_of(1e-6 * volume, np.array([1.0, 3.0, 1.0]), 600)
    assert faint.peaks == at_one.peaks
    assert evidence.points_of(0 * volume, np.ones(3), 600) == evidence.Points(0.0, 0.0, 1.0)
    single = np.zeros((9, 9))
    single[4, 4] = 12.0
    assert at_one.height == pytest.approx(gaussian_filter(single, 0.7).max(), rel=1e-4)


def told(**numbers: float) -> Evidence:
    names = [field.name for field in fields(Evidence) if field.name not in ("height", "peaks", "ends")]
    every = dict.fromkeys(names, 1.0) | {"planes": 3} | numbers
    return Evidence(**every)  # type: ignore[arg-type]


def test_channels_are_told_by_their_mean_and_by_the_worst_of_what_may_not_average() -> None:
    one = told(signal=1.0, detail=4.0, unexplained=0.1, saturated=0.4, unsettled=0.0, load=0.2, erased=0.1)
    other = told(signal=3.0, detail=8.0, unexplained=0.3, saturated=0.0, unsettled=2.0, load=0.1, erased=0.3)
    found = averaged([one, other])
    assert (found.signal, found.detail, found.erased) == (2.0, 6.0, pytest.approx(0.2))
    assert (found.unexplained, found.saturated, found.unsettled, found.load) == (0.3, 0.4, 2.0, 0.2)
    assert (found.planes, type(found.planes), found.height) == (3, int, None)
    assert "height" not in found.as_json()
    volumes = averaged(
        [replace(one, height=2.0, peaks=1.0, ends=0.0), replace(other, height=4.0, peaks=1, ends=0)]
    )
    assert volumes.as_json()["height"] == 3


def test_each_channel_is_measured_with_its_own_data_volume_psf_and_residual() -> None:
    counts = RNG.integers(0, 200, (20, 30, 2)).astype(np.uint8)
    counts[:10, :, 1] = 255
    valid = np.ones((2, 20, 30), bool)
    valid[0, :5] = False
    data = np.stack([2 * RNG.normal(size=(20, 30)), 4 * RNG.normal(size=(20, 30))])
    channels = observations(counts, data, valid, np.array([1.5, 2.5]))
    assert [one.noise for one in channels] == [1.5, 2.5]
    assert [one.saturated for one in channels] == [0, 0.5]
    assert [one.valid.sum() for one in channels] == [450, 600]
    volume = np.zeros((1, 24, 32, 2))
    volume[0, 4:9, 4:9, 0], volume[0, 4:6, 4:9, 1] = 1, 1
    psfs = np.stack([one_pixel()[0], 2 * one_pixel()[0]])[None]
    whole = evidence_of(channels, volume, psfs, [40.0, 130.0], 0.3)
    parts = [
        measure(one, volume[..., c], psfs[:, c], (40.0, 130.0)[c], unsettled=0.3)
        for c, one in enumerate(channels)
    ]
    assert whole == averaged(parts)
    assert parts[0].detail != parts[1].detail
    together = evidence_of(channels, volume[..., 0], psfs[:, :1], [100.0], 0.3)
    halves = [measure(one, volume[..., 0], psfs[:, 0], 100 / 2**0.5, unsettled=0.3) for one in channels]
    assert together == averaged(halves)
    assert evidence_of(channels[:1], volume[..., 0], psfs[:, :1], [40.0], 0.3, points=True).peaks is not None


def history(*changes: float, unrest: float = 0.0) -> tuple[IterationRecord, ...]:
    return tuple(IterationRecord(n, 1.0, primal_residual=unrest, change=c) for n, c in enumerate(changes))


@pytest.mark.parametrize("reason", [StopReason.ITERATIONS, StopReason.TIME, StopReason.CANCELLED])
def test_a_limit_leaves_what_the_last_iteration_changed(reason: StopReason) -> None:
    calm = StoppingRules().patience
    long = history(*[9.0] * (calm - 1), 0.02)
    assert unsettled_by(long, reason, 1e-3, started=False) == pytest.approx(2)
    assert unsettled_by(long, reason, 0.0, started=False) == 0
    assert unsettled_by(long, reason, 2.0, started=False) == pytest.approx(1e-3)
    assert unsettled_by((), reason, 1e-3, started=False) == 0
    assert unsettled_by(long, None, 1e-3, started=False) == 0
    short = history(*[9.0] * (calm - 2), 0.02)
    assert unsettled_by(short, reason, 1e-3, started=False) == pytest.approx(100), "as if all had changed"
    assert unsettled_by(history(5.0), reason, 1e-3, started=False) == pytest.approx(500)
    restless = history(*[9.0] * (calm - 2), 0.02, unrest=0.3)
    assert unsettled_by(restless, reason, 1e-3, started=True) == pytest.approx(3)
    assert unsettled_by(restless, reason, 1e-3, started=False) == pytest.approx(100)
    assert unsettled_by(short, reason, 1e-3, started=True) == pytest.approx(2)
    empty = history(*[9.0] * (calm - 2), 0.0)
    assert unsettled_by(empty, reason, 1e-3, started=True) == pytest.approx(100), "nothing is known"
    wild = history(*[1.0] * calm, np.inf)
    assert unsettled_by(wild, reason, 1e-3, started=False) == DIVERGED
    assert unsettled_by(history(*[1e9] * calm), reason, 1e-3, started=False) == DIVERGED
