"""Places that nothing explains are left out where they are all that is wrong, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from recon import reconstruct
from recon.arrays import Float32Array
from recon.base.blocks import block_mean, blocks_about_axis
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.reconstruction.mending.odd_places import LONGEST_PX, MOST, odd_places, on_pixels
from recon.reconstruction.mending.restored_light import LOOKED, _on_blocks
from recon.reconstruction.problem import Problem

hand_is_here = pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)


def hand() -> tuple[Float32Array, Float32Array]:
    """Return the hand's PSF and photograph in coarse pixels."""
    psfs, photograph = measured_set("hand")
    return block_mean(psfs[0], 16), block_mean(photograph, 16)


def discs(shape: tuple[int, ...], places: int, radius: float) -> Float32Array:
    """Return 1 in some discs, at places that are always the same, with soft edges."""
    y, x = (np.arange(n) for n in shape)
    at = np.random.default_rng(8).random((places, 2)) * shape
    far = [np.hypot(y[:, None] - row, x - column) for row, column in at]
    return np.asarray(1 / (1 + np.exp(4 * (np.min(far, axis=0) - radius))), np.float32)


def found(photograph: Float32Array, psf: Float32Array) -> bool:
    """Return whether places are found that are all that is wrong."""
    small, _ = _on_blocks(Problem.of(photograph, psf), LONGEST_PX)
    assert small is not None
    return odd_places(small.channels, 1 + small.usual2, LOOKED) is not None


@pytest.mark.parametrize(("factor", "n"), [(2, 8), (2, 9), (3, 10), (4, 31)])
def test_blocks_are_pixels_again_about_the_axis(factor: int, n: int) -> None:
    first, count = blocks_about_axis(n, factor)
    blocks = np.zeros((count, count), bool)
    blocks[count // 2, 0] = True
    pixels = on_pixels(blocks, factor, (n, n))
    assert np.array_equal(block_mean(pixels, factor, about_axis=True) == 1, blocks)
    assert pixels[n // 2, :first].all()


@hand_is_here
@pytest.mark.parametrize(
    ("places", "radius", "gain"), [(4, 2.0, -0.6), (8, 1.0, -0.6), (1, 3.0, 1.0)], ids=str
)
def test_the_hand_with_dust_or_a_lamp_is_as_good_as_without(places: int, radius: float, gain: float) -> None:
    psf, clean = hand()
    spots = discs(clean.shape, places, radius)
    spoilt = clean * (1 + gain * spots) if gain < 0 else clean + gain * clean.max() * spots
    result = reconstruct(spoilt, psf, judged=False)
    whole = reconstruct(clean, psf, judged=False)
    assert any("left out" in said for said in result.warnings)
    assert np.corrcoef(result.image.ravel(), whole.image.ravel())[0, 1] > 0.99


@hand_is_here
def test_nothing_is_left_out_of_what_is_wrong_everywhere() -> None:
    psf, clean = hand()
    assert not found(clean, psf)
    assert not found(np.ascontiguousarray(clean[:, ::-1]), psf)
    assert not found(np.ascontiguousarray(clean[::-1, ::-1]), psf)


@hand_is_here
def test_many_places_stay() -> None:
    psf, clean = hand()
    spots = discs(clean.shape, 90, 2.5)
    assert spots.mean() > MOST
    assert not found(clean * (1 - 0.6 * spots), psf)


@hand_is_here
def test_no_background_leaves_them() -> None:
    psf, clean = hand()
    spoilt = clean * (1 - 0.6 * discs(clean.shape, 4, 2.0))
    result = reconstruct(spoilt, psf, estimate_background=False, judged=False, iterations=5)
    assert not any("left out" in said for said in result.warnings)
