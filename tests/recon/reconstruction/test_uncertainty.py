"""Standard deviations of a picture: what they hold, how they are gathered, when they are refused."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon import InputError, Measurement, Options, Problem, reconstruct, solve
from recon.camera.points import FieldFunctions, PointImages, Points
from recon.evaluation.scene import make_scene
from recon.reconstruction.point_errors import points_of, points_problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.uncertainty import (
    REPEATS,
    Mosaic,
    Replicas,
    Uncertainty,
    _missing,
    _power_ratio,
    _rings,
)


@pytest.fixture(scope="module")
def scene():
    # A narrow field: seen through one PSF, light from far off the axis falls off.
    return make_scene("dense-picture", size=48, seed=3, field=0.6)


@pytest.fixture(scope="module")
def result(scene):
    return reconstruct(
        scene.measurement, scene.calibration, noise=scene.noise, model="convolution", uncertainty=True
    )


def test_intervals_hold_a_truth_that_the_own_model_did_not_make(scene, result) -> None:
    low, high = result.uncertainty.interval(result.volume)
    lit = scene.truth > 0.02 * scene.truth.max()
    held = (low[0] <= scene.truth) & (scene.truth <= high[0])
    assert 0.88 < held[lit].mean() < 0.995
    assert result.uncertainty.trusted


def test_a_wider_interval_holds_more_and_none_reaches_below_what_light_can_be(result) -> None:
    low, high = result.uncertainty.interval(result.volume, 0.5)
    wide_low, wide_high = result.uncertainty.interval(result.volume)
    assert (wide_low <= low).all()
    assert (high <= wide_high).all()
    assert wide_low.min() >= 0
    with pytest.raises(InputError, match="between 0 and 1"):
        result.uncertainty.interval(result.volume, 1.0)


@pytest.mark.parametrize("shape", [(8, 12), (9, 11)])
def test_a_mosaic_is_gathered_where_its_parts_came_from(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    for _ in range(4):
        mosaic = Mosaic.drawn(rng, shape, 2)
        coarse = rng.random((1, shape[0] // 2, shape[1] // 2))
        picture = np.repeat(np.repeat(coarse, 2, axis=1), 2, axis=2)
        picture = np.pad(picture, [(0, 0), (0, shape[0] % 2), (0, shape[1] % 2)], mode="edge")
        moved = np.roll(picture, mosaic.first, axis=(1, 2))
        np.testing.assert_allclose(mosaic.gathered(mosaic.laid(moved)), moved, rtol=1e-6)


def test_a_wrong_calibration_makes_deviations_that_are_not_to_be_trusted(scene) -> None:
    mirrored = replace(scene.calibration, psfs=np.ascontiguousarray(scene.calibration.psfs[..., ::-1]))
    options = {"noise": scene.noise, "model": "convolution", "iterations": 20, "uncertainty": True}
    # A background would explain what the PSF does not: then the residual does not tell, the verdict does.
    for background, judged in ((False, False), (None, True)):
        found = reconstruct(
            scene.measurement, mirrored, estimate_background=background, judged=judged, **options
        )
        assert not found.uncertainty.trusted
        assert any("not to be trusted" in said for said in found.warnings)
    assert found.uncertainty.wrong_calibration


def test_an_interruption_leaves_the_picture_and_says_what_is_missing(scene) -> None:
    cancel, done = threading.Event(), []

    def stop(share: float, what: str) -> None:
        if what.startswith("uncertainty"):
            done.append(share)
            cancel.set()

    found = reconstruct(
        scene.measurement,
        scene.calibration,
        iterations=3,
        uncertainty=True,
        cancel=cancel,
        on_stage=stop,
        judged=False,
    )
    assert len(done) == 1
    assert 0 < done[0] < 1
    assert found.uncertainty is None
    assert "No uncertainty" in found.warnings[-1]


def test_an_interruption_within_the_last_repetition_is_one(scene, monkeypatch) -> None:
    cancel, count = threading.Event(), 0

    def solved(problem: Problem, **known: Any) -> Reconstruction:
        nonlocal count
        count += 1
        if count == REPEATS:
            cancel.set()
        return solve(problem, **known)

    monkeypatch.setattr("recon.reconstruction.uncertainty.solve", solved)
    options = {"iterations": 3, "uncertainty": True, "judged": False}
    assert reconstruct(scene.measurement, scene.calibration, cancel=cancel, **options).uncertainty is None


def test_repetitions_have_noise_where_the_photograph_has_pixels(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    image, psf = rng.normal(0, 1, (32, 32)), rng.random((32, 32)).astype(np.float32)
    erasures = rng.random(image.shape) < 0.75
    problem = Problem.of(Measurement(image, 1.0, erasures=erasures), psf, Options(iterations=2, judged=False))
    result = solve(problem)
    seen = []

    def solved(problem: Problem, **_: object) -> Reconstruction:
        seen.append(problem.data[problem.valid].std())
        return result

    monkeypatch.setattr("recon.reconstruction.uncertainty.solve", solved)
    Replicas(problem, result).squared_error(0, 2)
    assert seen == pytest.approx([1.0], abs=0.2)


def test_colours_have_deviations_each() -> None:
    colour = make_scene("dense-picture", size=32, seed=3, channels=3, colourful=True)
    found = reconstruct(colour.measurement, colour.calibration, iterations=3, uncertainty=True, judged=False)
    assert found.uncertainty.deviation.shape == found.volume.shape == (1, 32, 32, 3)
    assert not np.allclose(*(found.uncertainty.deviation[..., c] for c in (0, 2)))


def test_what_has_no_uncertainty_is_refused_before_the_work() -> None:
    volume = make_scene("beads", size=16, depths=2)
    with pytest.raises(InputError, match="for pictures"):
        reconstruct(volume.measurement, volume.calibration, uncertainty=True)


def test_sentences_say_how_to_read_it() -> None:
    found = Uncertainty(np.ones((1, 2, 2), np.float32), 6, 1.0, 0.0, 2.0, 1.5, 0.5)
    assert "1.96" in found.sentences[0]
    assert found.trusted
    for other, why in (
        ({"misfit": 3.0}, "3.0 times the noise"),
        ({"resolved_px": 5.8}, "resolves 5.8 pixels"),
        ({"resolved_px": np.nan}, "Bin the images"),
        ({"steepness": 2.0}, "points of light"),
    ):
        (doubt,) = replace(found, **other).doubt
        assert why in doubt


def test_points_have_error_bars_that_hold_their_places_and_light() -> None:
    scene = make_scene("beads", size=64, depths=1, layers=(0.5, 0.5), seed=3, density=0.4, photons=100)
    problem = Problem.of(
        Measurement(scene.measurement, scene.noise),
        scene.calibration,
        Options(prior="l1", model="convolution", judged=False),
    )
    result = solve(problem)
    own = points_problem(problem)
    assert own is not None
    points = points_of(result, own)
    to_pixels = -scene.camera.distance_um / scene.points[:, 2] / scene.camera.pitch_um
    true = scene.points[:, 1::-1] * to_pixels[:, None] + result.grid.centre
    distance = np.linalg.norm(points.places[:, None] - true, axis=2)
    assert len(points.light) == len(true)
    assert distance.min(axis=1).max() < 0.5
    error = points.places - true[distance.argmin(axis=1)]
    assert (np.abs(error) <= 1.96 * points.deviations[:, :2]).mean() > 0.75
    assert np.abs(error).max() > 0.2 * np.median(points.deviations[:, :2])
    assert f"{len(true)}, placed to" in points.words


def test_a_faint_point_among_bright_ones_is_one_and_does_not_spoil_their_error_bars() -> None:
    rng = np.random.default_rng(0)
    psf = np.zeros((48, 48), np.float32)
    psf.flat[rng.choice(psf.size, 60, replace=False)] = 1
    psf = gaussian_filter(psf, 1)
    camera = PointImages(psf[None], FieldFunctions(0, np.zeros((1, 2))), psf.shape)
    places = np.array([[-8.0, -6.0], [5.3, -7.2], [-6.4, 8.1], [7.0, 7.3], [0.2, 0.4]])
    image = camera.image(Points(places, np.array([1000.0, 1000.0, 1000.0, 1000.0, 100.0])))
    image += rng.normal(0, 2, image.shape).astype(np.float32)
    problem = Problem.of(image, psf, Options(prior="l1", model="convolution", judged=False))
    result = solve(problem)
    own = points_problem(problem)
    assert own is not None
    points = points_of(result, own)
    assert len(points.light) == len(places)
    found = points.places - result.grid.centre
    error = found - places[np.linalg.norm(found[:, None] - places, axis=2).argmin(axis=1)]
    assert (np.abs(error) < 4 * points.deviations[:, :2]).all()


def test_a_black_picture_has_no_points() -> None:
    rng = np.random.default_rng(0)
    psf = rng.random((16, 16)).astype(np.float32)
    options = Options(prior="l1", model="convolution", judged=False, iterations=2, tau=10.0)
    problem = Problem.of(rng.normal(0, 1, (16, 16)).astype(np.float32), psf, options)
    own = points_problem(problem)
    assert own is not None
    assert len(points_of(solve(problem), own).light) == 0
    assert points_problem(Problem.of(psf, psf, Options(prior="tv"))) is None


def test_an_empty_picture_explains_nothing_and_nothing_is_divided_by_it() -> None:
    dark, noise = np.zeros((32, 32)), np.random.default_rng(0).standard_normal((32, 32))
    for seen in (noise, dark):
        ratio, last = _power_ratio(_rings(seen), _rings(dark))
        assert np.isfinite(ratio).all()
        assert np.isfinite(_missing(ratio, last, dark))
