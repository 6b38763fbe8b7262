"""Light that falls off where the PSF does not: the shade is found, and none where there is none."""

from __future__ import annotations

import json

import numpy as np
import pytest

from recon import reconstruct
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.base.noise import NoiseModel
from recon.camera.vignetting import shade_of
from recon.errors import InputError
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.evaluation.scene import make_scene
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.mending.restored_light import with_light_restored
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose, with_background
from recon.reconstruction.solve import solve
from recon.reconstruction.uncertainty import Replicas
from recon.streams.live import LiveReconstructor
from recon.types import Calibration

BINNING = 16

measured = pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)


@pytest.fixture(scope="module")
def hand() -> tuple[Float32Array, Float32Array]:
    """The measured hand and its PSF, binned."""
    psfs, photograph = measured_set("hand")
    return block_mean(photograph, BINNING), block_mean(psfs[0], BINNING)


def cos4(shape: tuple[int, int], corner: float) -> Float32Array:
    """Return light that falls off round about the middle, to so much in the corners."""
    y, x = ((np.arange(n) - (n - 1) / 2) for n in shape)
    r2 = (y[:, None] ** 2 + x**2) / (y[0] ** 2 + x[0] ** 2)
    return np.asarray(1 / (1 + (corner**-0.5 - 1) * r2) ** 2, np.float32)


@measured
@pytest.mark.parametrize("corner", [0.3, 0.6])
def test_the_shade_of_a_measured_photograph_is_found(
    hand: tuple[Float32Array, Float32Array], corner: float
) -> None:
    photograph, psf = hand
    shade = cos4(photograph.shape, corner)
    restored = with_light_restored(Problem.of(photograph * shade, psf))
    found = np.asarray(restored.measurement.vignetting)
    assert found.min() == pytest.approx(corner, rel=0.2)
    assert np.abs(found - shade).max() < 0.1
    assert "falls off" in restored.warnings[-1]


def test_the_shade_of_a_scene_is_found_and_where_there_is_none_none_is() -> None:
    scene = make_scene("sparse-picture", size=40, photons=3000.0, seed=4)
    shade = cos4(scene.measurement.shape[:2], 0.4)
    restored = with_light_restored(Problem.of(Measurement(scene.measurement * shade), scene.calibration))
    found = np.asarray(restored.measurement.vignetting)
    assert found.min() == pytest.approx(0.4, abs=0.15)
    clear = Problem.of(Measurement(scene.measurement), scene.calibration)
    assert with_light_restored(clear) is clear


def test_a_psf_that_stands_on_an_offset_shades_no_photograph() -> None:
    scene = make_scene("dense-picture", size=40, photons=3000.0, seed=4)
    psf = scene.calibration.psfs[0, 0]
    restored = with_light_restored(Problem.of(Measurement(scene.measurement), psf + 0.05 * psf.max()))
    assert restored.measurement.vignetting is None


@measured
def test_a_shaded_photograph_is_as_good_as_one_that_is_not(hand: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = hand
    clear = reconstruct(photograph, psf, judged=False).image
    shaded = reconstruct(photograph * cos4(photograph.shape, 0.5), psf, judged=False).image
    assert np.corrcoef(clear.ravel(), shaded.ravel())[0, 1] > 0.99


@measured
def test_what_is_clear_or_lost_its_dark_level_is_not_shaded(hand: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = hand
    for taken_off in (0.0, 0.14):
        restored = with_light_restored(
            Problem.of(photograph - np.float32(taken_off * photograph.mean()), psf)
        )
        assert restored.measurement.vignetting is None


@measured
def test_stray_light_is_a_background_and_no_shade(hand: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = hand
    y, x = (np.linspace(-1, 1, n) for n in photograph.shape)
    hill = np.exp(-((y[:, None] - 0.3) ** 2 + (x + 0.4) ** 2) / 0.3)
    stray = 0.3 * photograph.mean() * hill / hill.mean()
    chosen = choose(Problem.of((photograph + stray).astype(np.float32), psf))
    assert chosen.measurement.vignetting is None
    assert chosen.smooth


@measured
def test_a_film_is_told_of_no_shade_that_its_frames_do_not_get(
    hand: tuple[Float32Array, Float32Array],
) -> None:
    photograph, psf = hand
    shaded = Problem.of(
        photograph * cos4(photograph.shape, 0.5), psf, ReconstructionOptions(model="convolution")
    )
    calibration = Calibration(psf[None, None], np.zeros((1, 3)))
    assert with_background(shaded, calibration).measurement.vignetting is not None
    film = with_background(shaded, calibration, restoring=False)
    assert film.measurement is shaded.measurement
    assert not any("falls off" in words for words in film.warnings)


@pytest.mark.parametrize("noise", [NoiseModel(20.0, 0.0), NoiseModel(5.0, 2.0), 30.0])
def test_noise_that_is_known_grows_with_the_division(noise: NoiseModel | float) -> None:
    shade = cos4((120, 160), 0.25)
    light = 500 * shade
    model = noise if isinstance(noise, NoiseModel) else NoiseModel(noise, 0.0)
    sigma = np.sqrt(model.read_noise**2 + model.counts_per_electron * light)
    counts = light + sigma * np.random.default_rng(0).standard_normal(light.shape)
    measurement = Measurement(counts.astype(np.float32), noise, vignetting=shade)
    told = measurement.deviations(measurement.counts())[0]
    assert told == pytest.approx(np.std(counts / shade - 500), rel=0.03)


def test_a_live_view_takes_no_shade() -> None:
    with pytest.raises(InputError, match="vignetting"):
        LiveReconstructor(np.eye(16, dtype=np.float32), vignetting=0.5)


def test_a_known_shade_is_divided_by_and_none_is_looked_for() -> None:
    rng = np.random.default_rng(0)
    image, psf = rng.random((2, 24, 32), np.float32)
    shade = cos4(image.shape, 0.5)
    counts = Measurement(image + 2, background=2.0, vignetting=shade).counts().data[0]
    np.testing.assert_allclose(counts, image / shade, rtol=1e-4)
    problem = Problem.of(Measurement(image, vignetting=shade), psf)
    assert with_light_restored(problem) is problem
    np.testing.assert_allclose(problem.with_data(image).data, problem.data, rtol=1e-5)
    with pytest.raises(InputError, match="above 0"):
        Problem.of(Measurement(image, vignetting=0.0), psf)


def test_a_shade_is_brightest_where_it_is_1_and_the_same_on_coarser_pixels() -> None:
    numbers = np.array([0.3, 0.4, 0.1, 0.2, -0.1])
    fine, coarse = shade_of(numbers, (60, 80)), shade_of(numbers, (15, 20))
    assert fine.max() == 1
    np.testing.assert_allclose(block_mean(fine, 4), coarse, rtol=0.02)


@measured
def test_a_shade_and_stray_light_are_both_found(hand: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = hand
    lit = photograph * cos4(photograph.shape, 0.25) + np.float32(0.3 * photograph.mean())
    chosen = choose(Problem.of(lit, psf))
    assert chosen.smooth
    assert 0.2 < np.min(np.asarray(chosen.measurement.vignetting)) < 0.9


@measured
def test_numbers_of_a_shade_are_recorded_and_make_it_again(hand: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = hand
    restored = with_light_restored(Problem.of(photograph * cos4(photograph.shape, 0.4), psf))
    found = json.loads(json.dumps(restored.provenance()))["fitted_to_the_photograph"]
    again = shade_of(np.array(found["shade"]), photograph.shape)
    np.testing.assert_allclose(again, restored.measurement.vignetting, rtol=1e-5)


def test_repetitions_have_more_noise_where_a_shade_was_divided_by() -> None:
    scene = make_scene("dense-picture", size=48, photons=3000.0, seed=4)
    shade = cos4(scene.measurement.shape[:2], 0.2)
    problem = Problem.of(Measurement(scene.measurement * shade, vignetting=shade), scene.calibration)
    chosen = choose(problem)
    result = solve(chosen)
    small = result.basis[1] if result.basis else result
    replicas = Replicas(chosen, small)
    nothing = np.zeros_like(small.volume)
    rng = np.random.default_rng(0)
    several = np.stack([replicas._photograph(nothing, rng) for _ in range(12)])
    replicas.close()
    spread = several.std(axis=0)[0]
    dark, bright = shade < 0.4, shade > 0.8
    assert spread[dark].mean() > 1.8 * spread[bright].mean()
