"""Displacement by sections: from the brightness of spots to shift, rotation, scale and a smooth rest."""

from __future__ import annotations

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import Display, random_mask
from recon.holography.pose import NODES, Pose, nodes_of
from recon.holography.sections import (
    POWERS,
    Sections,
    SectionShifts,
    fit_field,
    fit_shifts,
    hypotheses,
    response,
    split_field,
)
from recon.holography.spots import Spot, SpotMaker

SHAPE, K = (72, 120), 4
DISPLAY = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=2))
MASK_SHAPE = DISPLAY.mask.shape
SECTIONS = Sections(SHAPE)


def decentred(size: float = 0.8):
    """A third-order distortion about a point beside the middle: all orders up to the third."""
    y, x = (n / MASK_SHAPE[1] * 2 for n in nodes_of(MASK_SHAPE))
    y, x = y - 0.3, x + 0.2
    return size * (y**2 + x**2)[..., None] * np.stack([y, x], axis=-1)


def section_means(field):
    """Means of a displacement field over the sections, from the nodes, plainly."""
    v, u = (np.linspace(0, 1, n) for n in NODES)
    found = []
    for rows, columns in SECTIONS.slices():
        y = (np.arange(rows.start, rows.stop) + 0.5) / SHAPE[0]
        x = (np.arange(columns.start, columns.stop) + 0.5) / SHAPE[1]
        part = [
            np.mean([np.interp(x, u, [np.interp(at, v, c) for c in field[..., axis].T]) for at in y])
            for axis in range(2)
        ]
        found.append(part)
    return np.array(found)


def test_sections_cover_the_slm_once():
    covered = np.zeros(SHAPE, int)
    for part in SECTIONS.slices():
        covered[part] += 1
    assert (covered == 1).all()
    with pytest.raises(InputError, match="at least 2 along each axis"):
        Sections((10, 100), (3, 5))


def test_the_basis_is_the_mean_of_each_monomial():
    y, x = (n / MASK_SHAPE[1] * 2 for n in nodes_of(MASK_SHAPE))
    n = POWERS.index((2, 1))
    field = np.stack([y**2 * x, x * 0], axis=-1)
    np.testing.assert_allclose(SECTIONS.basis()[:, n], section_means(field)[:, 0], atol=3e-3)


def test_the_spots_of_sections_tell_their_shifts_and_the_field_through_them():
    """The true field bends within sections too; amplitudes come from the spots' fields themselves."""
    true = decentred()
    pose = Pose(shift_x=0.4, shift_y=-0.3, roll_mrad=1.0, scale=0.001)
    there, here = SpotMaker(DISPLAY), SpotMaker(DISPLAY)
    there.rest = true
    tried = np.broadcast_to(hypotheses(0.45 * K), (1, len(SECTIONS), 5, 2))
    amplitudes = np.zeros((1, len(SECTIONS), 5))
    for s, part in enumerate(SECTIONS.slices()):
        field = there.field(Spot(3, 5, pose, part))
        for h, (dy, dx) in enumerate(hypotheses(0.45 * K)):
            moved = pose.with_(shift_x=pose.shift_x + dx, shift_y=pose.shift_y + dy)
            amplitudes[0, s, h] = abs(
                np.vdot(field, np.exp(1j * np.angle(here.field(Spot(3, 5, moved, part)))))
            )
    noise = 0.02 * amplitudes.max()
    amplitudes += np.random.default_rng(0).normal(0, noise, amplitudes.shape)
    found = fit_shifts(amplitudes, tried, noise, response(here), limit=1.5 * K)
    wrong = found.shift - section_means(true)
    assert np.sqrt(np.mean(wrong**2)) < 0.15
    assert np.sqrt(np.mean((wrong / found.error) ** 2)) < 2.0
    smooth = fit_field(found, SECTIONS, MASK_SHAPE)
    whole = Pose().plus(smooth.change).displacement(MASK_SHAPE) + smooth.rest
    before = np.sqrt(np.mean(np.sum(true**2, axis=-1)))
    after = np.sqrt(np.mean(np.sum((true - whole) ** 2, axis=-1)))
    assert after < 0.3 * before
    predicted = np.sqrt((smooth.modes**2).sum(axis=(0, 3)).mean())
    assert 0.3 < after / predicted < 2.5


def test_a_rest_brightens_spots_only_where_the_mask_is_bent_like_that():
    bent, straight = SpotMaker(DISPLAY), SpotMaker(DISPLAY)
    bent.rest = decentred(2.5)
    field = bent.field(Spot(3, 5, Pose()))
    right, wrong = (
        abs(np.vdot(field, np.exp(1j * np.angle(m.field(Spot(3, 5, Pose())))))) for m in (bent, straight)
    )
    assert wrong < 0.9 * right


def test_a_dark_section_is_not_found_and_too_many_of_them_are_an_error():
    amplitudes = np.full((1, 15, 5), 0.5)
    amplitudes[:, :10] = [20.0, 12.0, 12.0, 12.0, 12.0]
    tried = np.broadcast_to(hypotheses(1.6), (1, 15, 5, 2))
    falling = (np.array([0.0, 4.0, 6.0]), np.array([1.0, 0.0, 0.0]))
    found = fit_shifts(amplitudes, tried, 0.7, falling, limit=6.0)
    assert np.isfinite(found.error[:10]).all()
    assert np.isinf(found.error[10:]).all()
    assert (found.amplitude[10:] == 0).all()
    np.testing.assert_allclose(found.shift[:10], 0, atol=0.05)
    fit_field(found, SECTIONS, MASK_SHAPE)
    error = found.error.copy()
    error[5:] = np.inf
    with pytest.raises(InputError, match="5 of 15 sections"):
        fit_field(SectionShifts(found.shift, error, found.amplitude), SECTIONS, MASK_SHAPE)


def test_sections_that_scatter_more_than_their_noise_are_stated_as_uncertain():
    """Also of shifts four times as far off as is stated, 68 % lie within one uncertainty (and not 20 %)."""
    generator, pulls = np.random.default_rng(4), []
    stated = np.full((len(SECTIONS), 2), 0.02)
    for size in (1.0, 4.0):
        of = []
        for _ in range(200):
            shift = generator.normal(0, size * stated)
            field = fit_field(SectionShifts(shift, stated, np.ones(len(SECTIONS))), SECTIONS, MASK_SHAPE)
            of.append(field.change[:2] / field.error[:2])
        pulls.append(np.mean(np.abs(of) < 1))
    assert pulls == pytest.approx([0.68, 0.68], abs=0.1)


def test_shift_rotation_and_scale_leave_no_rest():
    pose = Pose(shift_x=0.5, shift_y=-0.7, roll_mrad=0.8, scale=-0.0006)
    change, rest = split_field(pose.displacement(MASK_SHAPE), MASK_SHAPE)
    np.testing.assert_allclose(change[:4], pose.vector()[:4], rtol=1e-3)
    assert np.abs(rest).max() < 1e-3
    again, none = split_field(decentred() - split_field(decentred(), MASK_SHAPE)[1], MASK_SHAPE)
    assert np.abs(none).max() < 1e-9
    assert np.abs(again[:4]).max() > 0
