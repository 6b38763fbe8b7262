"""Two points as the default reconstruction tells them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from instrument.evaluation.analysis_figure import draw_analysis, facts
from recon.analysis import analyse, middle, told_apart
from recon.analysis.correlation import half_light_deg
from recon.analysis.middle import Middle
from recon.analysis.point_noise import Noise
from recon.analysis.points import smallest_dip
from recon.analysis.resolution import axial_resolution
from recon.analysis.stated_distance import Reached, TriedPair, stated_px
from recon.analysis.told_apart import Told, stated_apart
from recon.camera.camera_model import one_depth
from recon.evaluation import two_points
from recon.evaluation.two_points import _within, reached, shifted
from recon.types import Calibration, Geometry


def _caustics(shape: tuple[int, int]) -> np.ndarray:
    rough = np.random.default_rng(3).normal(size=shape)
    lines = np.maximum(ndimage.gaussian_filter(rough, 1.0), 0.0) ** 2
    y, x = (np.linspace(-1, 1, n) for n in shape)
    lines[(np.abs(y) > 0.5), :] = 0
    lines[:, np.abs(x) > 0.5] = 0
    return np.asarray(lines / lines.max(), np.float32)


def _calibration(shape: tuple[int, int], colours: int = 1) -> Calibration:
    psfs = np.repeat(_caustics(shape)[None, None], colours, axis=1)
    return Calibration(psfs, np.array([[0.0, 0.0, 50e3]]), geometry=Geometry(10.0, 5.0))


def test_the_stated_distance_is_that_of_a_curve_through_the_pairs() -> None:
    rng = np.random.default_rng(0)
    tried = [
        TriedPair(float(px), axis, bool(rng.uniform() < 1 / (1 + np.exp(-20 * np.log(px / middle)))))
        for axis, middle in enumerate((2.0, 2.6))
        for px in np.geomspace(1.2, 4.5, 80)
    ]
    beyond = (
        np.exp((np.log(9) + np.log(3 / 7)) / 20 / 2) / 0.8**0.5
    )  # the middle of 90 % there, 30 % at 0.8 of it
    for stated, centre in zip(stated_px(tried), (2.0, 2.6), strict=True):
        assert stated is not None
        assert stated == pytest.approx(centre * beyond, rel=0.08)
    assert stated_px([one for one in tried if not one.told]) == (None, None)
    wide = [one for one in tried if one.px > 4.0]
    assert stated_px(wide) == (least := min(one.px for one in wide), least)  # all were told apart
    y, x = stated_px([one for one in tried if one.axis == 1])
    assert y is None
    assert x is not None


def _tried(law: Told, axis: int, count: int) -> list[TriedPair]:
    """Return pairs at places and distances that come evenly, told apart as a law has it for each."""
    on = np.arange(count)
    px = 1.5 * (2.6 / 1.5) ** ((on + 0.5) / count)
    places = on * 0.754878 % 1
    odds = [
        told_apart._log_odds(told_apart._dips(law.sigma, *one), one[0], *law.law)
        for one in zip(px[:, None], places[:, None], strict=True)
    ]
    return [
        TriedPair(float(p), axis, bool(o > 0), float(f)) for p, f, (o,) in zip(px, places, odds, strict=True)
    ]


@pytest.mark.parametrize(("sigma", "offset", "slope"), [(0.2, 0.06, 0.8), (0.45, 0.0, 0.5)])
def test_the_stated_distance_is_that_of_the_shares_over_all_places(
    sigma: float, offset: float, slope: float
) -> None:
    """44 pairs are enough for both shares that are promised, where a curve in the distance alone was off."""
    law = Told(sigma, offset, slope, 0.02)
    found, nothing = stated_apart(_tried(law, 0, 44))
    assert nothing is None
    assert found is not None
    assert found.stated_px == pytest.approx(law.stated_px, rel=0.015)
    assert law.share(found.stated_px) >= 0.88
    assert law.share(0.8 * found.stated_px) <= 0.32
    assert law.share(1.3) < 0.01
    assert law.share(4.0) > 0.999


def test_the_dip_of_two_points_on_pixels_is_that_of_a_picture() -> None:
    rng = np.random.default_rng(0)
    px, places = rng.uniform(1.0, 4.0, 60), rng.uniform(0, 1, 60)
    t, kernel = told_apart._kernel(0.3)
    for apart, place, dip in zip(px, places, told_apart._dips(0.3, px, places), strict=True):
        pixels = np.arange(12)
        line = np.interp(pixels - 3 - place, t, kernel) + np.interp(pixels - 3 - place - apart, t, kernel)
        where = np.array([[[0.0, 3 + place], [0.0, 3 + place + apart]]])
        assert dip == pytest.approx(smallest_dip(line[None], where), abs=1e-9)


def test_pixels_alone_leave_no_distance_with_both_shares() -> None:
    """Points as narrow as pixels: half of the pairs are told apart at 0.8 of where nine in ten are."""
    sharp = Told(0.0, 0.0, 0.0, 0.02)
    assert sharp.share(sharp.stated_px) == pytest.approx(0.92, abs=0.03)
    assert sharp.share(0.8 * sharp.stated_px) > 0.4
    wide = Told(1.5, 0.0, 0.0, 0.02)
    assert wide.share(0.8 * wide.stated_px) < 0.05


def test_nothing_is_stated_beyond_what_was_tried_and_nothing_below_it() -> None:
    pairs = [TriedPair(px, 0, True, 0.3) for px in (4.0, 4.2, 4.4)]
    (law, _) = stated_apart(pairs)
    assert _within(law, pairs) == 4.0
    few = [TriedPair(px, 0, px > 1.99, 0.0) for px in (1.2, 1.4, 1.6, 2.0)]
    assert _within(stated_apart(few)[0], [one for one in few if one.px < 1.7]) is None
    assert _within(None, few) is None


def test_a_shift_between_pixels_moves_the_centre_of_light_and_keeps_it() -> None:
    psf = _caustics((48, 64))
    both = shifted(psf, np.array([[1.25, -3.5], [-1.25, 3.5]]))
    assert both.sum() == pytest.approx(2 * psf.sum(), rel=1e-4)
    one = shifted(psf, np.array([[1.25, -3.5]]))
    apart = np.subtract(ndimage.center_of_mass(one), ndimage.center_of_mass(psf.astype(float)))
    np.testing.assert_allclose(apart, (1.25, -3.5), atol=0.01)


def test_the_default_picture_reaches_a_little_less_than_the_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middle, "LARGEST_PX", 140 * 160)
    monkeypatch.setattr(two_points, "PICTURES", 3)
    found = reached(_calibration((160, 180)), 50e3, 1.2, 2e-6)
    assert all(px is not None and 1.5 < px < 3.5 for px in found.across_px)
    assert found.part < 1
    assert found.focus_um is not None
    assert 30e3 < found.focus_um[0] < 50.001e3
    assert 49.999e3 < found.focus_um[1] < 200e3


def test_between_calibrated_depths_pictures_have_the_psf_of_between() -> None:
    near = _calibration((80, 90))
    both = replace(
        near,
        psfs=np.concatenate([near.psfs, near.psfs]),
        source_positions_um=np.array([(0.0, 0.0, 40e3), (0.0, 0.0, 60e3)]),
    )
    for z_um in (48e3, 60e3):
        tests = two_points._Tests(Middle.of(both, z_um, 2e-6), z_um, Noise(), 0)
        seen = one_depth(tests.calibration, z_um)
        assert seen.source_positions_um[0, 2] == pytest.approx(z_um)
        np.testing.assert_allclose(seen.psfs[0, 0], tests.psf(z_um), atol=0.02)


def test_pairs_of_a_field_are_seen_by_the_psf_on_the_axis_that_makes_their_light() -> None:
    one = _calibration((80, 90))
    places = np.array([(x, 0.0, z) for z in (40e3, 60e3) for x in (-3e3, 0.0, 3e3)])
    psfs = np.concatenate([np.roll(one.psfs, int(x // 1e3), axis=-1) for x, _, _ in places])
    field = replace(one, psfs=psfs, source_positions_um=places)
    tests = two_points._Tests(Middle.of(field, 60e3, 2e-6), 60e3, Noise(), 0)
    np.testing.assert_array_equal(tests.calibration.source_positions_um, [(0, 0, 40e3), (0, 0, 60e3)])
    np.testing.assert_array_equal(tests.calibration.psfs, np.stack([one.psfs[0]] * 2))


def test_depths_of_the_middle_are_spread_as_its_extent_is_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _calibration((160, 180))
    step = axial_resolution(whole.psfs[0, 0], 50e3, 5e3).step_per_um
    assert Middle.of(whole, 50e3, step).spread == 1
    monkeypatch.setattr(middle, "LARGEST_PX", 60 * 60)
    part = Middle.of(whole, 50e3, step)
    np.testing.assert_array_equal(part.psf_at(50e3), whole.psfs[0, 0, 50:110, 60:120])
    # Mean distance from the middle, of 80 x 90 lit pixels and of 60 x 60.
    assert part.spread == pytest.approx(np.hypot(40, 45) / np.hypot(30, 30), rel=0.2)
    lost = np.square(whole.psfs).sum() / np.square(part.psf_at(50e3)).sum()
    dimmer = part.psf_at(50e3).max() / whole.psfs.max()
    assert part.noise(Noise(100.0, 2.0)).electrons == pytest.approx(100 * lost * dimmer, rel=1e-4)
    dark = Middle.of(whole, 50e3, step, dark_rim=True)
    assert not dark.psf_at(50e3)[:24].any()
    assert dark.spread > part.spread
    farther = Middle.of(whole, 50e3, step, reach=0.9 / 50e3)
    assert farther.part > part.part


def test_a_pattern_that_is_dark_in_the_middle_is_seen_farther_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middle, "LARGEST_PX", 60 * 60)
    ring = _calibration((160, 180))
    y, x = np.indices((160, 180))
    ring.psfs[..., np.hypot(y - 80, x - 90) < 45] = 0
    for rim in (False, True):
        found = Middle.of(ring, 50e3, 2e-6, dark_rim=rim)
        assert found.part > 0.2
        assert found.psf_at(50e3).any()
    small = replace(ring, psfs=np.where(y + x < 60, _calibration((160, 180)).psfs.max(), 0 * ring.psfs))
    assert Middle.of(small, 50e3, 2e-6).part == 1


def test_a_small_colour_sensor_has_room_for_one_pair_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_points, "MOST_PICTURES", 6)
    calibration = _calibration((40, 44), colours=3)
    assert [pair.axis for pair in reached(calibration, 50e3, 1.2, 2e-6).pairs] == [0, 1] * 3
    assert (
        two_points._focus_um(
            two_points._Tests(Middle.of(calibration, 50e3, 2e-6), 50e3, Noise(), 0), 2.0, 2e-6
        )
        is None
    )


@pytest.mark.parametrize(("step_per_um", "far_um"), [(2e-6, 50e3 / 0.7), (1e-5, float("inf"))])
def test_depths_reach_infinity_where_all_before_it_were_told_apart(
    monkeypatch: pytest.MonkeyPatch, step_per_um: float, far_um: float
) -> None:
    """With room for four depths at once, of eight."""
    monkeypatch.setattr(two_points._Tests, "told_apart", lambda _self, pairs, _light: [True] * len(pairs))
    whole = Middle.of(_calibration((96, 128)), 50e3, step_per_um)
    tests = two_points._Tests(whole, 50e3, Noise(), 0)
    found = two_points._focus_um(tests, 3.0, step_per_um)
    assert found == pytest.approx((1 / (1 / 50e3 + 3 * step_per_um), far_um))


def test_an_axis_along_which_nothing_is_told_apart_is_named_and_makes_voxels_coarser() -> None:
    tried = tuple(TriedPair(px, axis, axis == 1) for px in (2.0, 9.0) for axis in (0, 1))

    def analysed(y: float | None) -> tuple[int, str]:
        found = Reached((y, 2.0), None, tried, "", 1.0)
        analysis = analyse(_calibration((48, 56)), reach=lambda *_args, **_named: found)
        return analysis.grid.binning, dict(facts(analysis))["two points, picture"]

    none, words = analysed(None)
    assert none == analysed(9.0)[0] > analysed(2.0)[0]
    assert words.startswith("x 2.00 px, y at no distance tried")


def test_half_of_the_light_is_left_where_half_of_an_even_pattern_is_on_the_sensor() -> None:
    found = half_light_deg(np.ones((40, 60)), (100, 60), 0.001, lambda y, _x: np.ones(len(y)))
    np.testing.assert_allclose(np.tan(np.deg2rad(found)), (0.05, 0.03), atol=0.0015)


def test_nothing_on_the_page_of_an_analysis_runs_into_its_notes() -> None:
    found = Reached((2.2, 2.0), (40e3, 60e3), (TriedPair(2.0, 0, True),), "admm-sensor, tv", 1.0)
    analysis = analyse(_calibration((48, 56)), reach=lambda *_args, **_named: found)
    many = replace(analysis, notes=(*analysis.notes, *("A note that takes a line of its own. " * 4,) * 12))
    for one in (analysis, many):
        page = draw_analysis(one, "A page", simulated=True)
        height_in = page.get_size_inches()[1]
        notes = max(text.get_position()[1] for text in page.texts if text.get_text().startswith("•"))
        column = [text.get_position()[1] for text in page.texts if text.get_position()[0] == 0.745]
        assert min(column) - 0.15 / height_in > notes
    for step_per_um in (0.0, np.inf):  # no depth, or no enlargement, makes this PSF another
        page = draw_analysis(
            replace(analysis, axial=replace(analysis.axial, step_per_um=step_per_um)),
            "A page",
            simulated=True,
        )
        assert not [axes for axes in page.axes if "Depth of field" in axes.get_title(loc="left")]
