"""Offsets that whole rows or columns share: taken off where a camera made them, not where light may have."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import fftconvolve

from recon import reconstruct
from recon.base.blocks import block_mean
from recon.base.shared_lines import shared_lines
from recon.evaluation.measured_sets import data_folder, measured_pairs, measured_set
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose

Image = npt.NDArray[np.float32]
SHAPE = (96, 128)
NOISE = 10.0

hand_is_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)
pairs_are_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_pairs").is_dir(),
    reason=f"the measured pairs are not in {data_folder()}",
)


def broad_psf() -> Image:
    """Return a blurred caustic over much of the sensor."""
    spots = np.random.default_rng(1).random(SHAPE) > 0.98
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    psf = fftconvolve(spots, np.exp(-(y[:, None] ** 2 + x**2) / 0.01), mode="same")
    return np.asarray(np.maximum(psf, 0) * np.exp(-(y[:, None] ** 2 + x**2) / 0.3), np.float32)


def photograph(psf: Image) -> Image:
    """Return some things on black through a PSF, with each pixel's noise."""
    scene = np.zeros(SHAPE)
    scene[30:50, 40:44] = scene[60:63, 30:90] = 1
    light = fftconvolve(scene, psf, mode="same")
    light *= 2000 / light.mean()
    return np.asarray(light + NOISE * np.random.default_rng(2).standard_normal(SHAPE), np.float32)


def of_lines(deviation: float, axis: int, seed: int = 3) -> Image:
    """Return an offset for each row (axis 1 is one pixel wide) or column."""
    shape = (SHAPE[0], 1) if axis == 1 else (1, SHAPE[1])
    offsets = np.random.default_rng(seed).normal(0, deviation, shape)
    return np.asarray(np.broadcast_to(offsets, SHAPE), np.float32)


@pytest.mark.parametrize("axis", [0, 1])
def test_most_of_what_lines_share_is_found(axis: int) -> None:
    psf, offsets = broad_psf(), of_lines(50, axis)
    found = shared_lines(photograph(psf) + offsets, np.ones(SHAPE, bool), NOISE, psf)
    assert found is not None
    assert (found.image - offsets).std() < 0.6 * offsets.std()
    assert list(found.deviations) == [("columns", "rows")[axis]]


def test_rows_and_columns_are_told_apart() -> None:
    psf = broad_psf()
    shared = of_lines(60, 1) + of_lines(40, 0, seed=4)
    found = shared_lines(photograph(psf) + shared, np.ones(SHAPE, bool), NOISE, psf)
    assert found is not None
    assert (found.image - shared).std() < 0.6 * shared.std()
    assert found.deviations["rows"] > found.deviations["columns"] > 20


def test_erased_lines_and_pixels_do_not_hinder() -> None:
    psf, offsets = broad_psf(), of_lines(50, 1)
    valid = np.random.default_rng(0).random(SHAPE) > 0.02
    valid[:, 50] = False
    data = np.where(valid, photograph(psf) + offsets, 0)
    found = shared_lines(data, valid, NOISE, psf)
    assert found is not None
    assert (found.image - offsets).std() < 0.6 * offsets.std()


def test_nothing_is_found_where_each_pixel_has_its_own_noise() -> None:
    psf = broad_psf()
    assert shared_lines(photograph(psf), np.ones(SHAPE, bool), NOISE, psf) is None


def test_stripes_that_an_object_may_cast_are_left() -> None:
    """Through a sharp PSF bars come as bars."""
    sharp = np.zeros(SHAPE, np.float32)
    sharp[SHAPE[0] // 2, SHAPE[1] // 2] = 1
    bars = 1000 * np.broadcast_to(np.random.default_rng(5).random((SHAPE[0], 1)) > 0.5, SHAPE)
    noisy = bars + NOISE * np.random.default_rng(2).standard_normal(SHAPE)
    assert shared_lines(noisy, np.ones(SHAPE, bool), NOISE, sharp) is None


def test_rows_in_turn_of_two_colours_are_no_noise() -> None:
    """A grey file of a sensor with a mosaic: every other row is brighter."""
    psf = broad_psf()
    turns = np.broadcast_to(50.0 * (np.arange(SHAPE[0]) % 2)[:, None], SHAPE)
    assert shared_lines(photograph(psf) + turns, np.ones(SHAPE, bool), NOISE, psf) is None


def test_it_is_told_recorded_and_left_where_that_is_asked() -> None:
    psf = broad_psf()
    striped = photograph(psf) + of_lines(50, 1)
    chosen = choose(Problem.of(striped, psf))
    assert any("Whole lines of the photograph" in words for words in chosen.warnings)
    result = reconstruct(striped, psf, iterations=3, judged=False)
    told = result.provenance["fitted_to_the_photograph"]["shared_lines_counts"]
    assert 20 < told["rows"] < 60
    left = choose(Problem.of(striped, psf, ReconstructionOptions(estimate_background=False)))
    assert left.measurement.lines is None
    plain = reconstruct(photograph(psf), psf, iterations=3, judged=False)
    assert "fitted_to_the_photograph" not in plain.provenance


def test_another_photograph_of_the_same_problem_has_no_lines_of_the_first() -> None:
    psf = broad_psf()
    chosen = choose(
        Problem.of(photograph(psf) + of_lines(50, 1), psf, ReconstructionOptions(model="convolution"))
    )
    assert chosen.measurement.lines is not None
    other = photograph(psf)
    np.testing.assert_allclose(chosen.with_data(other).data[0], other / chosen.noise[0], rtol=1e-5)


def test_each_colour_has_lines_of_its_own() -> None:
    psf = broad_psf()
    colour = np.stack([photograph(psf) + of_lines(50, 1), photograph(psf)], axis=-1)
    lines = np.asarray(choose(Problem.of(Measurement(colour), psf)).measurement.lines)
    assert lines[..., 0].std() > 25
    assert not lines[..., 1].any()


@hand_is_here
def test_the_measured_hand_under_row_noise_is_nearly_as_good_as_without() -> None:
    psfs, raw = measured_set("hand")
    psf, clean = block_mean(psfs[0], 8), block_mean(raw, 8)
    rows = np.random.default_rng(4).normal(0, 400, (len(raw), 1))
    striped = block_mean((raw + rows).astype(np.float32), 8)
    reference = reconstruct(clean, psf, judged=False).image
    error = reconstruct(striped, psf, judged=False).image - reference
    decibels = 20 * np.log10(float(reference.max()) / float(np.sqrt(np.mean(error**2))))
    assert decibels > 45  # 40.5 with the rows as they are


@hand_is_here
@pytest.mark.parametrize("binning", [2, 4, 8, 16])
def test_the_measured_hand_as_it_is_has_none(binning: int) -> None:
    psfs, raw = measured_set("hand")
    problem = Problem.of(block_mean(raw, binning), block_mean(psfs[0], binning))
    assert shared_lines(problem.data[0], problem.valid[0], 1.0, problem.depths.central) is None


@pairs_are_here
@pytest.mark.parametrize("binning", [1, 4, 6, 8])
def test_the_measured_pairs_have_none_whatever_their_psf(binning: int) -> None:
    _, photographs, _ = measured_pairs()
    for channels in photographs:
        measurement = Measurement(np.moveaxis(block_mean(channels, binning, about_axis=True), 0, -1))
        counts = measurement.counts()
        noises = measurement.deviations(counts)
        psf = np.ones(counts.data.shape[1:])  # lets nothing fine through: the photographs alone decide
        for data, valid, noise in zip(counts.data, counts.valid, noises, strict=True):
            assert shared_lines(data, valid, float(noise), psf) is None
