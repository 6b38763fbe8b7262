"""The sensor against its photon-transfer model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from recon.arrays import Float64Array
from recon.base.blocks import block_sum
from recon.optics.sensor import FixedPattern, Readout, SensorSpec, expose, fixed_pattern

SHAPE = (200, 200)
READOUT = Readout(
    electrons_per_count=0.5,
    gain=1.0,
    black_level=100.0,
    full_scale=65535,
    full_well_e=30_000.0,
    read_noise_e=3.0,
)
SPEC = SensorSpec(
    name="test",
    shape=(400, 400),
    pitch_um=5.0,
    quantum_efficiency=(0.5, 0.5, 0.5),
    full_well_e=30_000.0,
    read_noise_e=3.0,
    dark_current_e_per_s=5.0,
    prnu=0.02,
    dsnu_e=4.0,
    bits=16,
    hot_fraction=1e-3,
    dead_fraction=1e-3,
)


def uniform(dark_e_per_s: float = 0.0, response: float = 1.0) -> FixedPattern:
    ones = np.ones(SHAPE, np.float32)
    return FixedPattern(ones * np.float32(response), ones * np.float32(dark_e_per_s), 0 * ones)


def frame(
    electrons_per_s: float, exposure_s: float, readout: Readout = READOUT, seed: int = 0, dark: float = 0.0
) -> Float64Array:
    light = np.full(SHAPE, electrons_per_s, np.float32)
    return expose(light, uniform(dark), exposure_s, readout, seed).astype(np.float64)


@pytest.mark.parametrize("mean_e", [0.0, 0.3, 4.0, 25.0, 35.0, 900.0, 20_000.0])
def test_mean_and_variance_follow_photon_transfer(mean_e: float) -> None:
    counts = frame(mean_e / 0.01, 0.01)
    assert counts.mean() == pytest.approx(100 + mean_e / 0.5, abs=5 * np.sqrt(mean_e + 9) / 0.5 / 200 + 0.01)
    variance = (mean_e + 9.0) / 0.5**2 + 1 / 12
    # The variance of a sample of n normal deviates scatters by sqrt(2 / n).
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))


def test_slope_of_variance_over_mean_is_the_conversion() -> None:
    levels = np.array([500.0, 1500.0, 5000.0, 15_000.0])
    frames = [frame(level, 1.0, seed=int(level)) for level in levels]
    slope = np.polyfit([f.mean() for f in frames], [f.var() for f in frames], 1)[0]
    assert 1 / slope == pytest.approx(READOUT.electrons_per_count, rel=0.02)


@pytest.mark.parametrize("mean_e", [0.5, 8.0, 29.0, 31.0, 100.0])
def test_charge_is_poisson(mean_e: float) -> None:
    # Without read noise and at one electron a count, the counts are the charge.
    plain = replace(READOUT, electrons_per_count=1.0, black_level=0.0, read_noise_e=0.0)
    counts = frame(mean_e, 1.0, plain, seed=3).astype(int).ravel()
    edges = np.unique(stats.poisson.ppf(np.linspace(0.05, 0.95, 10), mean_e)).astype(int)
    observed = np.histogram(counts, np.concatenate([[-1], edges, [100_000]]) + 0.5)[0]
    expected = np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean_e), [1]])) * counts.size
    assert stats.chisquare(observed, expected).pvalue > 1e-3


def test_noise_is_normal_out_to_its_tails() -> None:
    plain = replace(READOUT, electrons_per_count=0.001, black_level=30_000.0, read_noise_e=2.0)
    noise = (frame(0.0, 1.0, plain, seed=9).ravel() - 30_000) / 2000
    assert stats.kstest(noise, "norm").pvalue > 1e-3
    # Beyond 3.44 the ziggurat has a way of its own.
    many = np.concatenate([frame(0.0, 1.0, plain, seed=seed).ravel() for seed in range(100, 160)])
    noise = (many - 30_000) / 2000
    for sign in (-1, 1):
        assert (sign * noise > 3.8).mean() == pytest.approx(stats.norm.sf(3.8), rel=0.3)


def test_gain_scales_signal_and_noise_alike() -> None:
    one, four = frame(1000.0, 1.0), frame(1000.0, 1.0, replace(READOUT, gain=4.0))
    assert four.mean() - 100 == pytest.approx(4 * (one.mean() - 100), rel=0.01)
    assert four.std() == pytest.approx(4 * one.std(), rel=0.03)


def test_dark_current_grows_with_exposure() -> None:
    short, long = frame(0.0, 1.0, dark=20.0), frame(0.0, 10.0, dark=20.0)
    assert short.mean() == pytest.approx(140, abs=0.5)
    assert long.mean() == pytest.approx(500, abs=1.0)


def test_charge_stops_at_the_full_well_and_counts_at_full_scale() -> None:
    full = frame(1e6, 1.0)
    assert full.mean() == pytest.approx(100 + 30_000 / 0.5, abs=1)
    eight_bit = frame(1e6, 1.0, replace(READOUT, full_scale=255, electrons_per_count=30_000 / 255))
    assert np.all(eight_bit == 255)


def test_noise_can_be_scaled_and_turned_off() -> None:
    none = frame(1000.0, 1.0, replace(READOUT, noise_scale=0.0))
    assert np.all(none == 2100)
    half = frame(1000.0, 1.0, replace(READOUT, noise_scale=0.5))
    assert half.std() == pytest.approx(0.5 * frame(1000.0, 1.0).std(), rel=0.03)


def test_the_same_seed_repeats_a_frame_and_another_one_does_not() -> None:
    first, again, other = (frame(500.0, 1.0, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    correlation = np.corrcoef(first.ravel(), other.ravel())[0, 1]
    assert abs(correlation) < 0.03
    # Rows and neighbours are independent too.
    noise = first - first.mean()
    for a, b in ((noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1]), (noise[2:], noise[:-2])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.03


def test_frames_seeded_next_to_each_other_share_no_rows() -> None:
    first, second = (frame(500.0, 1.0, seed=seed) for seed in (0, 1))
    matches = (first[:, None, :] == second[None, :, :]).mean(axis=2)
    assert matches.max() < 0.2


def test_fixed_pattern_has_the_spreads_of_its_data_sheet() -> None:
    pattern = fixed_pattern(SPEC, seed=1)
    live = pattern.response > 0
    assert pattern.response[live].std() == pytest.approx(0.02, rel=0.03)
    assert (~live).mean() == pytest.approx(1e-3, rel=0.4)
    assert pattern.offset_e.std() == pytest.approx(4.0, rel=0.15)
    hot = pattern.dark_e_per_s > 100
    assert hot.mean() == pytest.approx(0.9e-3, rel=0.4)
    assert pattern.dark_e_per_s[~hot].mean() == pytest.approx(5.0, rel=0.05)
    np.testing.assert_array_equal(pattern.response, fixed_pattern(SPEC, seed=1).response)
    assert not np.array_equal(pattern.response, fixed_pattern(SPEC, seed=2).response)


def test_binning_sums_pixels() -> None:
    image = np.arange(30, dtype=np.float32).reshape(5, 6)
    np.testing.assert_array_equal(block_sum(image, 2), [[14, 22, 30], [62, 70, 78]])
    pattern = fixed_pattern(SPEC, seed=1)
    binned = pattern.binned(2)
    assert binned.response.mean() == pytest.approx(pattern.response.mean(), rel=1e-4)
    assert binned.dark_e_per_s.mean() == pytest.approx(4 * pattern.dark_e_per_s.mean(), rel=1e-4)
    assert binned.response.std() == pytest.approx(pattern.response.std() / 2, rel=0.05)
