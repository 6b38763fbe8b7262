"""Outer lines of one value, where no light was measured: erased up to a step, not where light fades."""

from __future__ import annotations

import numpy as np
import pytest

from recon import reconstruct
from recon.arrays import Array, Float32Array
from recon.base.blocks import block_mean
from recon.base.unseen import seen_window, unseen_lines
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.reconstruction.problem import Problem

SHAPE = (60, 80)


def lit(mean: float = 500.0, narrow: float = 2.0) -> Float32Array:
    """Return a photograph that is dim towards its edges, of photons."""
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    light = mean * np.exp(-narrow * (y[:, None] ** 2 + x**2))
    return np.asarray(np.random.default_rng(1).poisson(light), np.float32)


def erased(image: Array, valid: Array | None = None) -> Array:
    """Return what is erased of one channel."""
    known = np.ones(image.shape, bool) if valid is None else valid
    return unseen_lines(np.asarray(image, np.float32)[None], known[None])[0]


def framed(image: Float32Array, top: int, bottom: int, left: int, right: int, value: float) -> Float32Array:
    """Return a photograph under a frame of one value."""
    height, width = image.shape
    frame = np.full_like(image, value)
    kept = np.s_[top : height - bottom, left : width - right]
    frame[kept] = image[kept]
    return frame


@pytest.mark.parametrize("sides", [(5, 5, 7, 7), (0, 9, 0, 0), (0, 0, 40, 0), (3, 0, 0, 11)])
@pytest.mark.parametrize("value", [0.0, 4095.0])
def test_a_frame_is_erased_with_the_line_beside_it(sides: tuple[int, int, int, int], value: float) -> None:
    top, bottom, left, right = sides
    inner = [s + (s > 0) for s in sides]
    expected = np.ones(SHAPE, bool)
    expected[inner[0] : SHAPE[0] - inner[1], inner[2] : SHAPE[1] - inner[3]] = False
    assert np.array_equal(erased(framed(lit(), top, bottom, left, right, value)), expected)


def test_bars_of_two_values_are_erased() -> None:
    image = framed(framed(lit(), 0, 0, 6, 6, 34.0), 5, 5, 0, 0, 0.0)
    assert np.count_nonzero(~erased(image)) == (SHAPE[0] - 12) * (SHAPE[1] - 14)


@pytest.mark.parametrize("mean", [0.05, 1.0, 20.0, 1000.0])
def test_a_photograph_that_fades_into_zeros_stays(mean: float) -> None:
    image = lit(mean, narrow=16.0)
    assert not image[0].any()
    assert not erased(image).any()


def test_constant_and_whole_photographs_stay() -> None:
    assert not erased(np.full(SHAPE, 7.0)).any()
    assert not erased(lit()).any()
    assert seen_window(np.full(SHAPE, 7.0, np.float32)) == (slice(0, 60), slice(0, 80))


def test_pixels_that_are_erased_already_are_not_counted_again() -> None:
    image = framed(lit(), 5, 5, 5, 5, 0.0)
    assert not (erased(image, image > 0) & (image == 0)).any()


def test_a_colour_of_a_mosaic_keeps_its_lines() -> None:
    known = np.zeros(SHAPE, bool)
    known[::2, ::2] = True
    assert not erased(np.where(known, lit() + 100, 0), known).any()


def test_a_problem_says_so() -> None:
    psf = lit()
    problem = Problem.of(framed(lit(900.0), 6, 6, 6, 6, 0.0), psf)
    assert problem.valid.mean() == pytest.approx(46 * 66 / 4800)
    assert any("outer rows and columns" in said for said in problem.warnings)


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)
def test_the_hand_in_a_frame_is_as_good_as_without() -> None:
    psfs, photograph = measured_set("hand")
    psf, seen = block_mean(psfs[0], 16), block_mean(photograph, 16)
    whole = reconstruct(seen, psf, judged=False).image
    found = reconstruct(framed(seen, 6, 6, 8, 8, 0.0), psf, judged=False).image
    assert np.corrcoef(whole.ravel(), found.ravel())[0, 1] > 0.99
