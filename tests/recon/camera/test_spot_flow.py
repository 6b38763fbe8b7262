"""Spots of two sizes become spots of the size between, not both of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from recon.analysis.correlation import similarity
from recon.camera.registration import displacement, rescaled
from recon.camera.spot_flow import met
from recon.errors import InputError
from recon.evaluation.measured_sets import measured_set

ROWS, COLUMNS = np.mgrid[:96, :120]
PLACES = np.random.default_rng(2).uniform((10, 10), (86, 110), (30, 2))


def rings(radius: float) -> np.ndarray:
    """Return rings (1, 96, 120) as lenslets out of focus show them, all as bright in sum."""
    away = np.hypot(ROWS - PLACES[:, :1, None], COLUMNS - PLACES[:, 1:, None])
    return np.float32(np.exp(-0.5 * ((away - radius) / 1.2) ** 2).sum(axis=0)[None] / radius)


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_light_of_two_sizes_meets_between_them(share: float) -> None:
    small, large, true = rings(4.0), rings(6.0), rings(4.0 + 2 * share)
    shown = np.ones(small.shape[1:], bool)
    first, second = met(small, large, share, shown)
    mixed = (1 - share) * small + share * large
    moved = (1 - share) * first + share * second
    assert 1 - similarity(moved, true) < 0.75 * (1 - similarity(mixed, true))
    assert moved.sum() == pytest.approx(true.sum(), rel=0.02)


def test_what_one_alone_shows_and_what_is_alike_stays() -> None:
    small, large = rings(4.0), rings(5.0)
    hidden = np.zeros(small.shape[1:], bool)
    np.testing.assert_allclose(met(small, large, 0.5, hidden)[0], small, atol=1e-6)
    for same in met(small, small, 0.3, ~hidden):
        np.testing.assert_allclose(same, small, atol=0.02 * small.max())


def test_patterns_in_which_no_light_can_be_followed_stay() -> None:
    """Alike but for fine structure of their own, which leads the flow astray."""
    rng = np.random.default_rng(3)
    smooth = np.hypot(ROWS - 48, COLUMNS - 60) < 40
    own = [gaussian_filter(rng.normal(0, 1, smooth.shape), 1.5) for _ in range(2)]
    first, second = (np.float32(smooth * (1 + fine))[None] for fine in own)
    shown = np.ones(smooth.shape, bool)
    assert similarity(first, second) > 0.9
    assert all(
        np.array_equal(*pair) for pair in zip(met(first, second, 0.5, shown), (first, second), strict=True)
    )


@pytest.mark.parametrize("depth", [8, 16, 32])
def test_measured_patterns_of_depths_left_out_lose_nothing(depth: int) -> None:
    """Planes four apart on both sides, each put onto the measured one between them."""
    try:
        psfs = measured_set("usaf")[0]
    except InputError as absent:
        pytest.skip(str(absent))
    middle = psfs[depth]

    def put_onto_it(psf: np.ndarray) -> np.ndarray:
        put = []
        for scale in np.linspace(0.97, 1.03, 7):
            brought = rescaled(psf, float(scale))
            put.append(shift(brought, [-v for v in displacement(brought, middle)]))
        return np.asarray(max(put, key=lambda one: alike(one, middle)), np.float32)

    both = [put_onto_it(psfs[depth + step])[None] for step in (-4, 4)]
    moved = met(both[0], both[1], 0.5, np.ones(middle.shape, bool))
    inner = np.s_[20:-20, 20:-20]
    mixed, now = (alike(sum(pair)[0][inner], middle[inner]) for pair in (both, moved))
    print(f"{mixed:.4f} mixed, {now:.4f} moved")
    assert now > mixed - 5e-4
    assert now > 0.96


def alike(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.corrcoef(found.ravel(), truth.ravel())[0, 1])
