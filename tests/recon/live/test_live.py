"""Live pictures: as good as converged while the scene is still, coarser rather than later."""

from __future__ import annotations

import numpy as np
import pytest

from recon import reconstruct
from recon.base.metrics import psnr
from recon.streams.stillness import SceneState
from tests.recon.live.streams import AMPLE_MS, NOISE, SHAPE, iterated, live, photograph, spots_psf


def test_a_still_scene_converges_to_the_reconstruction() -> None:
    reconstructor = live(average=1)
    frame = photograph(0, 1)
    first = iterated(reconstructor, frame)
    assert first.scene is SceneState.NEW
    assert (first.binning, first.method, first.frames) == (1, "admm-sensor", 1)
    reference = reconstruct(
        frame, spots_psf(), solver="admm-sensor", background=20.0, noise=NOISE, iterations=200, tolerance=0
    ).image
    picture = first
    for _ in range(200):
        picture = reconstructor.refine() or picture
    assert picture.settled
    assert picture.total_iterations > first.iterations or first.settled
    assert reconstructor.refine() is None
    assert psnr(picture.image, reference) > 45
    assert "settled" in picture.quality


def test_averaging_frames_of_a_still_scene_lessens_noise() -> None:
    clean = reconstruct(
        np.mean([photograph(0, seed) for seed in range(100, 140)], axis=0) - 20.0,
        spots_psf(),
        solver="admm-sensor",
        noise=NOISE,
        iterations=300,
    ).image
    alone, averaging = live(average=1), live(average=8)
    for seed in range(12):
        one, many = (r.feed(photograph(0, seed)) for r in (alone, averaging))
    # To the end, however little time this machine had for each.
    for _ in range(100):
        one, many = alone.refine() or one, averaging.refine() or many
    assert (one.frames, many.frames) == (1, 8)
    assert many.scene is SceneState.STILL
    assert psnr(many.image, clean) > psnr(one.image, clean) + 1


def test_warm_start_follows_a_moving_scene() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    moved = reconstructor.feed(photograph(0.5, 1))
    assert (moved.scene, moved.frames, moved.method) == (SceneState.MOVING, 1, "admm-sensor")
    assert moved.total_iterations > moved.iterations
    assert np.unravel_index(np.argmax(moved.image), SHAPE)[1] >= 22


def test_a_cut_is_shown_by_a_wiener_filter_at_once_then_iterated_from_the_start() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    cut = reconstructor.feed(photograph(0, 2)[:, ::-1])
    assert (cut.scene, cut.method, cut.iterations) == (SceneState.NEW, "wiener", 0)
    assert "Wiener filter" in cut.quality
    after = reconstructor.feed(photograph(0, 3)[:, ::-1])
    assert (after.scene, after.method) == (SceneState.STILL, "admm-sensor")
    assert after.total_iterations == after.iterations
    # Scene after scene: only the first is a filter's.
    reconstructor.feed(photograph(0, 4))
    again = reconstructor.feed(photograph(0, 5)[::-1])
    assert (again.scene, again.method) == (SceneState.NEW, "admm-sensor")


def test_refining_goes_on_from_the_wiener_picture_of_the_newest_frame() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    rough = reconstructor.feed(photograph(0, 2)[:, ::-1])
    better = reconstructor.refine()
    assert better is not None
    assert better.method == "admm-sensor"
    assert better.total_iterations == better.iterations
    for _ in range(100):
        better = reconstructor.refine() or better
    reference = reconstruct(
        photograph(0, 2)[:, ::-1], spots_psf(), solver="admm-sensor", background=20.0, noise=NOISE,
        iterations=200, tolerance=0,
    ).image  # fmt: skip
    assert psnr(better.image, reference) > psnr(rough.image, reference) + 6


def test_brightness_does_not_depend_on_binning() -> None:
    pictures = [iterated(live(finest=b, coarsest=b, budget_ms=AMPLE_MS), photograph(0, 0)) for b in (1, 2, 4)]
    sums = [float(p.image.sum()) * p.binning**2 for p in pictures]
    assert sums == pytest.approx([sums[0]] * 3, rel=0.1)


def test_one_frame_is_not_called_an_average() -> None:
    reconstructor = live(budget_ms=AMPLE_MS, average=1)
    iterated(reconstructor, photograph(0, 0))
    still = reconstructor.feed(photograph(0, 1))
    assert (still.scene, still.frames) == (SceneState.STILL, 1)
    assert ", still" in still.quality
    assert "averaged" not in still.quality
