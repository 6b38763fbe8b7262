"""Offsets that whole rows or columns share: taken off where a camera made them, not where light may have."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from recon import reconstruct
from recon.arrays import Float32Array, Float64Array
from recon.base import shared_lines as module
from recon.base.blocks import block_mean
from recon.base.shared_lines import SharedLines, shared_lines
from recon.evaluation.measured_sets import data_folder, measured_pairs, measured_set
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose

SHAPE = (96, 128)
NOISE = 10.0

hand_is_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)
usaf_is_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_usaf3d").is_dir(), reason=f"the USAF target is not in {data_folder()}"
)
pairs_are_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_pairs").is_dir(),
    reason=f"the measured pairs are not in {data_folder()}",
)


def broad_psf() -> Float32Array:
    """Return a blurred caustic over much of the sensor."""
    spots = np.random.default_rng(1).random(SHAPE) > 0.98
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    psf = fftconvolve(spots, np.exp(-(y[:, None] ** 2 + x**2) / 0.01), mode="same")
    return np.asarray(np.maximum(psf, 0) * np.exp(-(y[:, None] ** 2 + x**2) / 0.3), np.float32)


def photograph(psf: Float32Array) -> Float32Array:
    """Return some things on black through a PSF, with each pixel's noise."""
    scene = np.zeros(SHAPE)
    scene[30:50, 40:44] = scene[60:63, 30:90] = 1
    light = fftconvolve(scene, psf, mode="same")
    light *= 2000 / light.mean()
    return np.asarray(light + NOISE * np.random.default_rng(2).standard_normal(SHAPE), np.float32)


def of_lines(deviation: float, axis: int, seed: int = 3) -> Float32Array:
    """Return an offset for each row (axis 1 is one pixel wide) or column."""
    shape = (SHAPE[0], 1) if axis == 1 else (1, SHAPE[1])
    offsets = np.random.default_rng(seed).normal(0, deviation, shape)
    return np.asarray(np.broadcast_to(offsets, SHAPE), np.float32)


def through(scene: Float64Array, psf: Float32Array, seed: int = 2) -> Float32Array:
    """Return a scene through a PSF, of 2000 electrons a pixel, with their noise."""
    light = np.maximum(fftconvolve(scene, psf, mode="same"), 0)
    light *= 2000 / light.mean()
    return np.asarray(
        light + np.sqrt(light) * np.random.default_rng(seed).standard_normal(light.shape), np.float32
    )


def found_in(photograph: Float32Array, psf: Float32Array) -> SharedLines | None:
    """Return what is found in a photograph with the noise that is estimated of it."""
    problem = Problem.of(photograph, psf)
    counts = problem.measurement.counts()
    return shared_lines(counts.data[0], counts.valid[0], float(problem.noise[0]), problem.depths.central)


@pytest.mark.parametrize("axis", [0, 1])
def test_most_of_what_lines_share_is_found(axis: int) -> None:
    psf, offsets = broad_psf(), of_lines(50, axis)
    found = shared_lines(photograph(psf) + offsets, np.ones(SHAPE, bool), NOISE, psf)
    assert found is not None
    assert (found.image - offsets).std() < 0.6 * offsets.std()
    assert list(found.deviations) == [("columns", "rows")[axis]]
    small = shared_lines((photograph(psf) + offsets) / 1e5, np.ones(SHAPE, bool), NOISE / 1e5, psf)
    assert small is not None
    assert small.deviations == pytest.approx({name: value / 1e5 for name, value in found.deviations.items()})


def test_rows_and_columns_are_told_apart() -> None:
    psf = broad_psf()
    shared = of_lines(60, 1) + of_lines(40, 0, seed=4)
    found = shared_lines(photograph(psf) + shared, np.ones(SHAPE, bool), NOISE, psf)
    assert found is not None
    assert (found.image - shared).std() < 0.6 * shared.std()
    assert found.deviations["rows"] > found.deviations["columns"] > 20


@pytest.mark.parametrize("axis", [0, 1])
def test_erased_lines_and_pixels_do_not_hinder(axis: int) -> None:
    psf, offsets = broad_psf(), of_lines(50, axis)
    valid = np.random.default_rng(0).random(SHAPE) > 0.02
    valid[:, 50] = valid[30] = False
    data = np.where(valid, photograph(psf) + offsets, 0)
    found = shared_lines(data, valid, NOISE, psf)
    assert found is not None
    assert (found.image - offsets)[valid].std() < 0.6 * offsets.std()
    assert not found.columns[50]
    assert not found.rows[30]


@pytest.mark.parametrize(("rows", "columns"), [(12, 128), (96, 3)])
def test_a_few_lines_tell_nothing(rows: int, columns: int) -> None:
    psf, part = broad_psf(), (slice(rows), slice(columns))
    even = 2000 + of_lines(200, 1)[part] + NOISE * np.random.default_rng(2).standard_normal((rows, columns))
    assert shared_lines(even, np.ones(even.shape, bool), NOISE, psf[part]) is None


@pytest.mark.parametrize("columns", [4, 128])
def test_thirteen_lines_are_enough(columns: int) -> None:
    psf = broad_psf()
    noise = NOISE * np.random.default_rng(2).standard_normal((13, columns))
    even = 2000 + of_lines(200, 1)[:13, :columns] + noise
    assert shared_lines(even, np.ones(even.shape, bool), NOISE, psf) is not None


def test_a_photograph_of_one_value_has_no_lines() -> None:
    assert shared_lines(np.full(SHAPE, 1 / 3), np.ones(SHAPE, bool), 0.0, broad_psf()) is None


@pytest.mark.parametrize("noise", [1.0, 10.0])
def test_light_is_the_curve_of_least_bending_that_cross_validation_asks_for(noise: float) -> None:
    """As dense matrices: of second differences, mirrored at the ends."""
    n = 40
    line = 20 * np.cos(np.arange(n) / 5) + noise * np.random.default_rng(1).standard_normal(n)
    second = np.diff(np.eye(n), axis=0).T @ np.diff(np.eye(n), axis=0)
    hats = [np.linalg.inv(np.eye(n) + stiff * second @ second) for stiff in module.STIFFNESS]
    scores = [np.sum((line - hat @ line) ** 2) / (n - np.trace(hat)) ** 2 for hat in hats]
    best = int(np.argmin(scores))
    assert 0 < best < len(hats) - 1
    np.testing.assert_allclose(module._smooth(line), hats[best] @ line, atol=1e-6)


@pytest.mark.parametrize("n", [5, 6])
def test_rows_of_the_scene_cast_what_a_convolution_does_also_from_beyond_the_sensor(n: int) -> None:
    """The centre pixel of n is n // 2; of a mosaic's colour the sensor has some rows only."""
    line, rows = np.random.default_rng(0).random(n) + 0.1, np.array([3, 5, 7, 9])
    scenes = np.eye(30)  # a lit row each, from -10 on
    sums = np.array([np.convolve(scene, line)[n // 2 : n // 2 + 30][rows + 10] for scene in scenes]).T
    np.testing.assert_allclose(module._cast(line, rows), sums[:, sums.any(axis=0)])


def test_nothing_is_found_where_each_pixel_has_its_own_noise() -> None:
    psf = broad_psf()
    assert shared_lines(photograph(psf), np.ones(SHAPE, bool), NOISE, psf) is None


@pytest.mark.parametrize("dark_level", [0, 400])
def test_stripes_that_an_object_may_cast_are_left(dark_level: int) -> None:
    """Through a sharp PSF bars come as bars, also where too much was subtracted."""
    sharp = np.zeros(SHAPE, np.float32)
    sharp[SHAPE[0] // 2, SHAPE[1] // 2] = 1
    bars = 1000 * np.broadcast_to(np.random.default_rng(5).random((SHAPE[0], 1)) > 0.5, SHAPE)
    noisy = bars + NOISE * np.random.default_rng(2).standard_normal(SHAPE)
    assert shared_lines(noisy - dark_level, np.ones(SHAPE, bool), NOISE, sharp) is None
    assert shared_lines(noisy, np.ones(SHAPE, bool), NOISE, broad_psf()) is not None
    assert shared_lines(noisy / 1e5, np.ones(SHAPE, bool), NOISE / 1e5, sharp) is None
    sharp[SHAPE[0] // 2] = np.random.default_rng(6).random(SHAPE[1])  # along the bars it need not be
    both = np.stack([broad_psf(), sharp, 0 * sharp])  # of depths, one without light
    for order in (both, both[::-1]):
        assert shared_lines(noisy, np.ones(SHAPE, bool), NOISE, order) is None
        columns = shared_lines(noisy.T.copy(), np.ones(SHAPE[::-1], bool), NOISE, np.swapaxes(order, 1, 2))
        assert columns is None


def test_one_bright_row_is_light_where_the_psf_is_a_point() -> None:
    """One line of n deviates by sqrt(n - 1) times their mean: no bound by the mean is above that."""
    sharp = np.zeros(SHAPE, np.float32)
    sharp[SHAPE[0] // 2, SHAPE[1] // 2] = 1
    for scene in (np.eye(*SHAPE)[:, [40]] * np.ones(SHAPE), np.eye(*SHAPE)[[40]] * np.ones(SHAPE)):
        assert shared_lines(through(scene + 0.1, sharp), np.ones(SHAPE, bool), 45.0, sharp) is None


@usaf_is_here
@pytest.mark.parametrize("binning", [1, 2, 3, 4, 6, 10])
def test_a_measured_psf_is_no_noise_of_lines_as_a_photograph(binning: int) -> None:
    """Of a point, which it is: through itself, and through the PSF of the depth beside it."""
    psfs, _ = measured_set("usaf")
    for k in range(0, 44, 3):
        psf, beside = (block_mean(psfs[z], binning) for z in (k, k + 1))
        assert found_in(psf, psf) is None, k
        assert found_in(psf, beside) is None, k


@usaf_is_here
@pytest.mark.parametrize("depth", [0, 22, 43])
def test_slits_and_lines_of_a_spectrum_are_light(depth: int) -> None:
    psf = np.maximum(block_mean(measured_set("usaf")[0][depth], 2), 0)
    height, width = psf.shape
    slit, cross, spectrum = (np.zeros(psf.shape) for _ in range(3))
    slit[height // 2] = cross[height // 2] = cross[:, width // 2] = 1
    at = [width // 4, width // 4 + 9, width // 2, width // 2 + 3, 3 * width // 4]
    spectrum[height // 5 : 4 * height // 5, at] = [1, 0.4, 0.7, 0.2, 0.9]
    for scene in (slit, cross, spectrum):
        assert found_in(through(scene, psf), psf) is None


@pytest.mark.parametrize(("deviation", "is_told"), [(7, False), (14, True)])
def test_lines_that_differ_by_less_than_a_pixels_noise_are_left(deviation: float, *, is_told: bool) -> None:
    even = 2000 + NOISE * np.random.default_rng(2).standard_normal(SHAPE)
    found = shared_lines(even + of_lines(deviation, 1), np.ones(SHAPE, bool), NOISE, broad_psf())
    assert (found is not None) == is_told


def test_offsets_of_next_to_nothing_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where cross-validation follows the lines nearly all the way nothing is worth a warning."""
    monkeypatch.setattr(module, "_smooth", lambda line: 0.92 * line + 0.08 * line.mean())
    psf = broad_psf()
    even = 2000 + NOISE * np.random.default_rng(2).standard_normal(SHAPE)
    assert shared_lines(even + of_lines(50, 1), np.ones(SHAPE, bool), NOISE, psf) is None
    assert shared_lines(even + of_lines(100, 1), np.ones(SHAPE, bool), NOISE, psf) is not None


def test_offsets_that_neighbouring_rows_share_may_be_light() -> None:
    """As of a PSF that is not this one."""
    psf, own = broad_psf(), of_lines(50, 1)
    shared = own + 0.4 * np.roll(own, 1, axis=0)
    assert shared_lines(photograph(psf) + shared, np.ones(SHAPE, bool), NOISE, psf) is None


def test_what_rounding_leaves_of_an_estimated_noise_is_a_pixels() -> None:
    """A JPEG's noise is next to none, its lines differ by less than the step of its counts."""
    psf = broad_psf()
    noise = 0.3 * np.random.default_rng(2).standard_normal(SHAPE)
    rounded = np.round(200 + of_lines(0.24, 1) + noise)  # 0.29 is a step's share
    assert shared_lines(rounded, np.ones(SHAPE, bool), 0.05, psf) is None
    assert shared_lines(rounded / 64, np.ones(SHAPE, bool), 0.05 / 64, psf) is None
    assert shared_lines(rounded + of_lines(1, 1).round(), np.ones(SHAPE, bool), 0.05, psf) is not None


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
    again = chosen.with_data(other)
    np.testing.assert_allclose(again.data[0], other / chosen.noise[0], rtol=1e-5)
    assert "shared_lines_counts" in chosen.measurement.found
    assert again.measurement.found == {}
    assert any("Whole lines" in words for words in chosen.warnings)
    assert not any("Whole lines" in words for words in again.warnings)


def test_lines_that_somebody_gave_are_taken_off_other_photographs_as_well() -> None:
    psf, lines = broad_psf(), of_lines(50, 1)
    given = Problem.of(Measurement(photograph(psf) + lines, lines=lines), psf)
    other = photograph(psf)
    again = given.with_data(other + lines)
    np.testing.assert_allclose(again.data[0], other / given.noise[0], rtol=1e-4, atol=1e-3)
    assert again.measurement.lines is not None


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


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_light_may_have_come_through_the_first_depth_or_the_last(count: int) -> None:
    rng = np.random.default_rng(5)
    psfs = rng.random((count, 9, 7)) ** 6
    rows = np.arange(30)
    for psf in (psfs[0], psfs[-1]):
        means = module._cast(psf.sum(axis=1), rows) @ (rng.random(38) * (rng.random(38) > 0.7))
        left = module._left_by_light(means, rows, psfs)
        assert left is not None
        assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(means)


def test_no_less_noise_is_taken_than_rounding_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[float] = []

    def offsets(image: Float32Array, _valid: object, noise: float, _psfs: object) -> Float32Array:
        taken.append(noise)
        return np.zeros(len(image), np.float32)

    monkeypatch.setattr(module, "_offsets", offsets)
    counts = 6.0 * np.random.default_rng(1).integers(0, 99, SHAPE)
    for noise in (0.1, 7.0):
        assert shared_lines(counts, np.ones(SHAPE, bool), noise, broad_psf()) is None
    uniform = np.random.default_rng(2).uniform(-3, 3, 100_000).std()
    assert taken == [pytest.approx(uniform, rel=0.01), pytest.approx(uniform, rel=0.01), 7, 7]
