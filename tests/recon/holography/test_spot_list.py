"""Spots: where, how bright, in which plane; against plain sums and the plain judge."""

from __future__ import annotations

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    HologramOptions,
    SpotList,
    compute_spots,
    random_mask,
    spot_array,
)
from recon.holography.display import no_mask
from recon.holography.scores import intensity
from recon.holography.spot_list import SpotField, brighter_where_dim

SHAPE = (48, 64)
DC = DcTerm(0.1, 0.6)


def plain():
    return Display(SHAPE, no_mask(SHAPE), dc=DC, mask_fill=1.0)


def test_a_field_at_spots_is_a_plain_sum_and_back_is_its_adjoint():
    rng = np.random.default_rng(0)
    spots = SpotList(rng.random((5, 2)), np.ones(5), np.array([0.0, 40.0, 40.0, 0.0, 40.0]))
    bent = 0.3 * np.indices((4, 5)).transpose(1, 2, 0)
    for displacement in (None, bent):
        mask = random_mask((2 * SHAPE[0], 2 * SHAPE[1]), seed=3)
        display = Display(SHAPE, mask, displacement=displacement)
        slm = rng.normal(size=(2, *SHAPE)).astype(np.float32) @ np.eye(SHAPE[1])
        slm = np.asarray(slm[0] + 1j * slm[1], np.complex64)
        field = SpotField(display, spots)
        found = field.at_spots(slm)
        weights = rng.normal(size=5) + 1j * rng.normal(size=5)
        left = np.vdot(weights, found) * mask.levels.size
        assert left == pytest.approx(np.vdot(field.back(weights), slm), rel=1e-4)
        if displacement is not None:
            continue
        for (y, x), z_mm, value in zip(spots.places, spots.z_mm, found, strict=True):
            hy, hx = display.defocus(z_mm)
            behind = np.repeat(np.repeat(slm, 2, 0), 2, 1) * mask.field() * hy[:, None] * hx
            waves = [
                np.exp(-2j * np.pi * (v - 0.5) * (np.arange(n) - (n - 1) / 2))
                for v, n in zip((y, x), behind.shape, strict=True)
            ]
            assert value == pytest.approx(waves[0] @ behind @ waves[1] / behind.size, abs=1e-5)


@pytest.mark.parametrize("levels", [None, 16])
def test_an_array_without_a_mask_is_even_and_bright(levels):
    found, scores = compute_spots(plain(), spot_array(5, 6), HologramOptions(phase_levels=levels))
    assert scores.deviation < 0.005
    assert scores.efficiency > 0.55
    turns = np.angle(found.slm) / (2 * np.pi) * (levels or 256)
    np.testing.assert_allclose(turns, np.rint(turns), atol=2e-3)
    # The plain judge samples the field where these spots lie: eight bins apart, 24 and 40 from the axis.
    on_bins = SpotList(
        np.array([[0.5 + 24 / 96, 0.5 + 40 / 128], [0.5 - 8 / 96, 0.5]]), np.array([1.0, 3.0]), np.zeros(2)
    )
    found, _ = compute_spots(plain(), on_bins)
    seen = intensity(found.slm, plain())
    assert seen[-8, 0] / seen[24, 40] == pytest.approx(3, rel=0.01)


def test_spots_in_two_planes_through_a_mask_get_what_was_asked_for():
    rng = np.random.default_rng(1)
    asked = SpotList(rng.uniform(0.2, 0.8, (8, 2)), rng.uniform(0.5, 2, 8), np.repeat([0.0, 60.0], 4))
    display = Display(SHAPE, random_mask((96, 128)), dc=DC, mask_fill=1.0)
    found, scores = compute_spots(display, asked, frames_of(2))
    assert found.slm.shape == (2, *SHAPE)
    assert scores.deviation < 0.005
    with pytest.raises(InputError, match="A warm start is"):
        compute_spots(display, asked, frames_of(3), initial=found.slm)
    # What a camera saw too dim is asked for brighter.
    again = brighter_where_dim(asked, np.r_[0.5, np.ones(7)], gain=1.0)
    assert again.intensity[0] / asked.intensity[0] == pytest.approx(
        2 * again.intensity[1] / asked.intensity[1]
    )


def frames_of(count):
    return HologramOptions(frames=count)


@pytest.mark.parametrize(
    ("places", "intensity", "words"),
    [
        ([[0.5, 1.2]], [1.0], "0 to 1 of the field"),
        ([[0.5, 0.2]], [0.0], "above 0"),
        ([[0.5, 0.2], [0.5, 0.2]], [1.0, 1.0], "same place"),
        ([[0.5, np.nan]], [1.0], "finite"),
    ],
)
def test_what_is_no_list_of_spots_is_refused(places, intensity, words):
    with pytest.raises(InputError, match=words):
        SpotList(np.array(places), np.array(intensity), np.zeros(len(places)))
    with pytest.raises(InputError, match="phase SLM"):
        compute_spots(plain(), spot_array(2, 2), HologramOptions(complex_slm=True))
