"""A PSF that the sensor cut off is told where a picture needs what it lacks, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from recon import reconstruct
from recon.base.blocks import block_mean
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import judged, lacking
from recon.reconstruction.result import window_of
from recon.reconstruction.selection import choose
from recon.reconstruction.solve import solve
from recon.verdict.judge import Region


def windowed(image: np.ndarray, share: float, down: float, across: float) -> np.ndarray:
    """Return a window of a share of both sides, at a place between 0 and 1."""
    sides = [round(share * n / 2) * 2 for n in image.shape]
    starts = [int((n - m) * at) for n, m, at in zip(image.shape, sides, (down, across), strict=True)]
    return np.ascontiguousarray(image[tuple(slice(s, s + m) for s, m in zip(starts, sides, strict=True))])


@pytest.mark.parametrize(("down", "across"), [(-3, 5), (4, -6), (0, 0), (2, 0)])
def test_what_lacks_is_what_moves_onto_the_sensor_from_beyond_the_edges(down: int, across: int) -> None:
    rng = np.random.default_rng(0)
    psf = rng.random((12, 16)).astype(np.float32)  # one pixel is 4 % of a side here
    psf[4:8, 4:10] = 0
    options = ReconstructionOptions(model="convolution", estimate_background=False, iterations=1)
    problem = Problem.of(rng.random((12, 16)).astype(np.float32), psf, options)
    result = solve(problem)
    assert result.state is not None
    found = np.zeros_like(result.state)
    (rows, columns), axis = window_of("sensor", psf.shape, psf.shape)
    found[0, 0, rows.start + axis[0] + down, columns.start + axis[1] + across] = 1.0
    lacks = lacking(replace(result, state=found), problem)
    assert lacks is not None
    moved = np.zeros((36, 48))
    moved[12 + down : 24 + down, 16 + across : 32 + across] = psf
    lost = abs(down) * 16 * psf[0 if down > 0 else -1].mean()
    lost += abs(across) * 12 * psf[:, 0 if across > 0 else -1].mean()
    assert lacks.of_all == pytest.approx(lost / moved[12:24, 16:32].sum(), rel=1e-5)
    assert lacks.inside == lacks.of_all


@pytest.mark.parametrize(("noise", "pedestal"), [(0.03, 0.0), (0.0, 0.02), (0.02, 0.02)])
def test_noise_and_an_even_pedestal_of_a_psf_that_is_whole_are_no_light_beyond_its_edges(
    noise: float, pedestal: float
) -> None:
    rng = np.random.default_rng(3)
    shape = (96, 128)
    y, x = np.mgrid[-1:1:96j, -1:1:128j]
    psf = np.where(y**2 + x**2 < 0.4, rng.random(shape) < 0.01, 0.0)
    psf = gaussian_filter(psf, 1.0)
    psf /= psf.max()
    scene = np.zeros(shape)
    scene[rng.integers(20, 76, 40), rng.integers(36, 92, 40)] = rng.uniform(0.3, 1, 40)
    seen = np.maximum(fftconvolve(scene, psf, mode="same"), 0)
    photograph = rng.poisson(2e4 * seen / seen.max()) + 3 * rng.standard_normal(shape)
    given = (psf + pedestal + noise * rng.standard_normal(shape)).astype(np.float32)
    problem = choose(Problem.of(photograph.astype(np.float32), given))
    result = judged(solve(problem), problem)
    lacks = lacking(result, problem)
    assert lacks is not None
    assert lacks.of_all < 0.1
    assert result.verdict is not None
    assert "beyond the sensor" not in result.verdict.sentences[0]


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the hand is not in {data_folder()}"
)
@pytest.mark.parametrize(
    ("share", "down", "across", "is_good"),
    [(1, 0.5, 0.5, True), (0.85, 0.5, 0.5, True), (0.7, 1, 0, True), (0.5, 0.5, 0.5, False)]
    + [(0.5, down, across, False) for down in (0, 0.5, 1) for across in (0, 1)],
)
def test_the_hand_through_a_psf_cut_in_half_is_not_reliable_and_a_good_one_is(
    share: float, down: float, across: float, is_good: bool
) -> None:
    psfs, photograph = measured_set("hand")
    photograph, psf = (windowed(block_mean(a, 8), share, down, across) for a in (photograph, psfs[0]))
    verdict = reconstruct(photograph, psf).verdict
    assert verdict is not None
    assert (verdict.region is Region.INSIDE) is is_good
    if not is_good and verdict.failing is not None and verdict.failing < 0.05:
        assert "seems to go on beyond the sensor's edges" in verdict.sentences[0]
