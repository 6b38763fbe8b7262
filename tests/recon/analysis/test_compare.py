"""Comparing calibrations: what was done to the simulated camera is what is found."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.compare import compare, compare_psfs
from recon.analysis.pattern_change import Change
from recon.analysis.what_moved import Seen, moved_across
from recon.arrays import Float64Array
from recon.base.blocks import block_mean
from recon.errors import InputError
from recon.types import Calibration, Geometry

GREEN = (0.0, 1.0, 0.0)
DEPTHS_UM = (60e3, 120e3)


def world(**options: float) -> SimulatedWorld:
    return SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0, **options))  # type: ignore[arg-type]


PSF = world().psf((0.0, 0.0, 100e3), GREEN)


def noisy(psf: np.ndarray, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    counts = np.maximum(psf, 0) * (3000 / psf.max())
    return np.maximum(rng.poisson(counts) + rng.normal(0, 2, psf.shape), 0).astype(np.float32)


def calibration(
    camera: SimulatedWorld, *, x_um: float = 0.0, seed: int = 0, exposure: float = 1.0
) -> Calibration:
    psfs = np.stack([noisy(camera.psf((x_um, 0.0, z), GREEN), seed) for z in DEPTHS_UM])[:, None]
    return Calibration(
        psfs * np.float32(exposure),
        np.array([(0.0, 0.0, z) for z in DEPTHS_UM]),
        geometry=camera.geometry,
        provenance={"reference_exposure_ms": exposure},
    )


@pytest.mark.parametrize("angle_deg", [0.4, -0.8])
def test_shift_scale_and_rotation_are_found(angle_deg: float) -> None:
    """The pattern is turned, enlarged and moved by interpolation; the comparison fits blocks."""
    scale, shift, angle = 1.004, np.array([2.3, -4.6]), np.deg2rad(angle_deg)
    # From the right (columns) towards the bottom (rows).
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    inverse = np.linalg.inv(scale * turn)
    centre = (np.array(PSF.shape) - 1) / 2
    moved = ndimage.affine_transform(PSF, inverse, centre - inverse @ (centre + shift), order=3)
    change = compare_psfs(noisy(moved), noisy(PSF, 1))
    assert (change.rows, change.columns) == pytest.approx(tuple(shift), abs=0.1)
    assert change.scale == pytest.approx(scale, abs=3e-4)
    assert change.rotation_deg == pytest.approx(angle_deg, abs=0.02)
    assert change.aligned > change.as_is
    assert change.aligned > 0.98


def test_nothing_happened() -> None:
    shares: list[float] = []
    found = compare(calibration(world()), calibration(world(), seed=5), shares.append)
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] == 1
    assert not found.due
    assert "still serves" in found.reasons[0]
    assert all(c.spot < 1.05 and c.brightness == pytest.approx(1, abs=0.02) for c in found.changes)


def test_a_diffuser_that_moved_away_is_named_with_its_distance() -> None:
    """0.15 mm farther from the sensor: the pattern grows by d'/z over d/z, which refocusing cannot undo."""
    found = compare(calibration(world()), calibration(world(diffuser_distance_mm=9.05), seed=1))
    changes = found.changes[0]
    assert changes.scale == pytest.approx((1 + 9.05 / 60) / (1 + 8.9 / 60), abs=8e-4)
    shifted_only = compare(calibration(world()), calibration(world(), x_um=500.0, seed=2))
    assert shifted_only.due  # the shift differs between depths: the source's line moved
    (moved,) = (words for words in shifted_only.reasons if "differs" in words)
    assert "The source moved across by (+" in moved
    assert float(moved.split("(+")[1].split(",")[0]) == pytest.approx(500, rel=0.03)
    (size,) = (words for words in found.reasons if "in size" in words)
    assert "The diffuser moved, it is about" in size
    assert "source" not in size
    assert float(size.split("it is about ")[1].split(" um")[0]) == pytest.approx(150, rel=0.2)
    alone = compare(_first(calibration(world())), _first(calibration(world(), x_um=500.0, seed=2)))
    assert "One depth does not tell" in " ".join(alone.reasons)


def test_one_depth_says_what_may_have_moved_and_what_it_does_not_see() -> None:
    """A diffuser 0.05 mm farther moves the edge by a tenth of a pixel; a lamp that drifts, nothing."""
    old = _first(calibration(world()))
    found = compare(old, _first(calibration(world(diffuser_distance_mm=8.95), seed=1)))
    assert not found.due
    (size,) = (words for words in found.reasons if "in size" in words)
    assert float(size.split("diffuser moved, it is ")[1].split(" um")[0]) == pytest.approx(50, rel=0.25)
    assert "the light does not tell" in size
    assert "turned" not in size
    same = compare(old, _first(calibration(world(), seed=5)))
    assert len(same.reasons) == 2
    assert "any drift of the lamp" in same.reasons[1]
    source_mm = float(same.reasons[1].split("along the axis by less than ")[1].split(" um")[0]) / 1e3
    assert 0.1 < source_mm < 0.3  # at 60 mm 0.18 mm move the edge by a twentieth of a pixel
    several = compare(calibration(world()), calibration(world(), seed=5))
    assert "drift of the lamp during a sweep by less than 3%" in several.reasons[-1]
    unknown = replace(old, geometry=replace(old.geometry, diffuser_distance_mm=None))
    assert "by less than 0.05 pixels" in compare(unknown, unknown).reasons[-1]


def _first(made: Calibration) -> Calibration:
    return made.part([0])


@pytest.mark.parametrize(
    ("across", "part"), [(lambda z: 1 + 8900 / z, "diffuser"), (lambda z: 0 * z + 1, "sensor")]
)
def test_what_moved_across_is_told_by_how_the_shift_goes_with_depth(
    across: Callable[[Float64Array], Float64Array], part: str
) -> None:
    """And among what it is not known where the shifts are not known well enough."""
    z_um = np.array([60e3, 90e3, 150e3])
    for error_px, told in ((0.02, 1), (0.5, 2)):
        shifts = 6.0 * across(z_um)
        seen = [Seen(z, 0.0, by, 0.0, error_px, 1e-5, 100) for z, by in zip(z_um, shifts, strict=True)]
        found = moved_across(seen, 8900.0, 13.0)
        assert found is not None
        assert len(found.parts) == told
        assert part in found.sentence
        assert "source" not in found.sentence
    assert moved_across(seen[:1], 8900.0, 13.0) is None
    torn = [replace(each, columns=by, place_error_px=0.02) for each, by in zip(seen, (5, -9, 5), strict=True)]
    found = moved_across(torn, 8900.0, 13.0)
    assert found is not None
    assert "more than one did" in found.sentence


FINE = Geometry(pixel_pitch_um=2.0, diffuser_distance_mm=3.0)


def change(
    z_mm: float,
    columns: float = 0.0,
    *,
    grown_px: float = 0.0,
    turned_deg: float = 0.0,
    errors_px: tuple[float, float] = (0.001, 0.001),
) -> Change:
    """A pattern 200 pixels from its middle to its corner; errors of its shift and of where its edge is."""
    scale = 1 + grown_px / 200
    edge_px = abs(scale * np.exp(1j * np.deg2rad(turned_deg)) - 1) * 200
    known = dict(zip(("place_error_px", "scale_error"), np.array(errors_px) / (1, 200), strict=True))
    alike = {"as_is": 1.0, "aligned": 1.0, "spot": 1.0, "decoy": 0.3, "brightness": 1.0}
    return Change(
        1e3 * z_mm, 0.0, columns, scale, turned_deg, edge_px=edge_px, extent_px=200.0, **alike, **known
    )


@pytest.mark.parametrize(
    ("changes", "geometry", "says", "not_said"),
    [
        pytest.param(
            [change(60, grown_px=0.45, errors_px=(0.001, 0.1)), change(90, grown_px=0.2)],
            FINE,
            r"\+0.10% in size, 0.2 pixels at its edge\. Which part moved cannot be told",
            "0.45",
            id="the clear one of two depths sees a size",
        ),
        pytest.param(
            [change(60, grown_px=0.6, errors_px=(0.001, 0.2)), change(90, grown_px=0.2)],
            Geometry(),
            r"^The pattern is \+0.30% in size, 0.6 pixels",
            "still serves",
            id="what a recalibration is due for is named",
        ),
        pytest.param(
            [change(60, 0.3, errors_px=(0.1, 0.001)), change(90)],
            Geometry(),
            "The old calibration still serves. This comparison",
            "moved by",
            id="noise of one depth is no shift",
        ),
        pytest.param(
            [change(60, 0.3, errors_px=(0.1, 0.001)), change(90, 0.2)],
            Geometry(),
            r"The pattern moved by 0\.2 pixels\.",
            r"0\.3",
            id="the shift that is seen is named",
        ),
        pytest.param(
            [change(60, 0.06), change(90, 0.06)],
            FINE,
            r"the sensor, .* moved across by \(-0\.1, \+0\.0\) um",
            r"by \(.0, .0\)",
            id="small pixels, across",
        ),
        pytest.param(
            [change(0.2, grown_px=0.06), change(0.3, grown_px=0.06 * 0.25 / 0.35)],
            Geometry(pixel_pitch_um=0.3, diffuser_distance_mm=0.05),
            r"the diffuser moved, it is about 0\.0[78] um farther",
            "about 0 um",
            id="a short camera, along",
        ),
        *(
            pytest.param(
                [change(z, grown_px=0.04, turned_deg=0.2) for z in depths],
                FINE,
                r"The pattern is turned by \+0\.20 degrees, 0\.7 pixels at its edge\. This comparison",
                "in size|farther",
                id=f"a turn alone, {len(depths)} depths",
            )
            for depths in ((90,), (60, 90, 150))
        ),
        pytest.param(
            [change(60, turned_deg=0.4), change(90, grown_px=0.3)],
            FINE,
            r"turned by \+0\.40 degrees, 1\.4 pixels at its edge\. At 90 mm it is \+0\.15% in size, "
            r"0\.3 pixels at its edge\. No single part",
            "60 mm it is",
            id="turned at one depth, grown at the other",
        ),
        pytest.param(
            [change(60, grown_px=0.9), change(90, turned_deg=0.2)],
            FINE,
            r"\+0\.45% in size, 0\.9 pixels at its edge\. At 90 mm it is turned by \+0\.20 degrees, "
            r"0\.7 pixels at its edge\. No single part",
            "60 mm it is",
            id="grown at one depth, turned at the other",
        ),
        pytest.param(
            [change(90, turned_deg=0.01)],
            FINE,
            r"still serves\. .* or it or the sensor turned by less than 0\.014 degrees; any drift",
            "is turned",
            id="a turn that is not seen",
        ),
        pytest.param(
            [change(90, 0.9, errors_px=(np.inf, np.inf))],
            FINE,
            "not see what moves the pattern by less than 1 pixel, nor what moved along the axis or turned",
            "um",
            id="not recognised",
        ),
    ],
)
def test_each_depth_is_held_against_what_it_is_known_to(
    changes: list[Change], geometry: Geometry, says: str, not_said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    places_um = np.array([(0.0, 0.0, each.z_um) for each in changes])
    one = Calibration(np.ones((len(changes), 1, 8, 8), np.float32), places_um, geometry=geometry)
    given = {each.z_um: each for each in changes}
    monkeypatch.setattr("recon.analysis.compare.compare_psfs", lambda new, old, z_um, *_: given[z_um])
    said = " ".join(compare(one, one).reasons)
    assert re.search(says, said)
    assert not re.search(not_said, said)


def test_another_diffuser_is_another_calibration() -> None:
    found = compare(calibration(world()), calibration(world(diffuser_seed=9)))
    assert found.due
    assert "different patterns" in found.reasons[0]


def test_a_pattern_that_is_its_own_half_turn_is_no_other_one() -> None:
    psf = np.zeros((160, 180))
    psf[30:-20:20, 30:-20:20] = 1.0
    psf = ndimage.gaussian_filter(psf, 1.5)
    one = replace(
        calibration(world()), psfs=noisy(psf)[None, None], source_positions_um=np.array([(0, 0, 6e4)])
    )
    found = compare(one, replace(one, psfs=noisy(np.roll(psf, 3, axis=0), 1)[None, None]))
    assert not found.due
    assert "moved by 3 pixels" in " ".join(found.reasons)


def test_a_source_that_stands_nearer_is_told_by_its_light() -> None:
    seen = np.stack([noisy(PSF, 3)] * 2)[:, None]  # at 100 mm, and recorded at 120 mm
    counts = 3000 / PSF.max()
    old = counts * world().psf((0.0, 0.0, 120e3), GREEN)
    places = np.array([(0.0, 0.0, 120e3)])
    one = replace(calibration(world()), psfs=old[None, None].astype(np.float32), source_positions_um=places)
    (size,) = (w for w in compare(one, replace(one, psfs=seen[:1])).reasons if "in size" in w)
    assert "it was the source" in size
    assert 99 < float(size.split("stands at ")[1].split()[0]) < 101


def test_brightness_is_compared_at_equal_exposure() -> None:
    same = compare(calibration(world()), calibration(world(), exposure=2.0))
    assert same.changes[0].brightness == pytest.approx(1.0, rel=0.02)
    dim = calibration(world())
    dimmed = Calibration(
        dim.psfs * np.float32(0.5), dim.source_positions_um, geometry=dim.geometry, provenance=dim.provenance
    )
    found = compare(calibration(world()), dimmed)
    assert not found.due
    assert any("0.50 times" in reason for reason in found.reasons)


def test_depths_that_the_old_one_lacks_are_refocused() -> None:
    old = calibration(world())
    psfs = noisy(world().psf((0.0, 0.0, 80e3), GREEN))[None, None]
    new = Calibration(psfs, np.array([(0.0, 0.0, 80e3)]), geometry=old.geometry)
    found = compare(old, new)
    assert found.changes[0].aligned > 0.95


def test_sizes_must_agree() -> None:
    old = calibration(world())
    small = Calibration(old.psfs[..., :100, :100].copy(), old.source_positions_um, geometry=old.geometry)
    with pytest.raises(InputError, match="region of interest"):
        compare(old, small)


@pytest.mark.parametrize(("adds", "pitch_known"), [(1.0, True), (9.0, False)])
def test_another_binning_is_told_and_the_rest_compared(adds: float, pitch_known: bool) -> None:
    old, new = calibration(world()), calibration(world(diffuser_distance_mm=9.05), seed=1)
    geometry = replace(new.geometry, pixel_pitch_um=3 * 13.0 if pitch_known else None)
    binned = replace(new, psfs=block_mean(new.psfs, 3) * np.float32(adds), geometry=geometry)
    unbinned = compare(old, new)
    assert "Another binning" not in " ".join(unbinned.reasons)
    for found, sign in ((compare(old, binned), 1), (compare(binned, old), -1)):
        assert "Another binning" in found.reasons[0]
        assert "3 times" in found.reasons[0]
        assert found.changes[0].brightness == pytest.approx(unbinned.changes[0].brightness ** sign, rel=0.02)
        assert found.changes[0].scale == pytest.approx(unbinned.changes[0].scale ** sign, abs=1e-3)


def test_another_camera_of_as_many_pixels_is_named() -> None:
    old = calibration(world())
    other = replace(old, geometry=replace(old.geometry, pixel_pitch_um=6.5))
    with pytest.raises(InputError, match=r"cameras or their settings differ: .* of 13 um.* of 6.5 um"):
        compare(old, other)
