"""An axial sweep tells by itself how far off its record the source stands; a large pinhole is said."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration_routines.psf.mount_fit import MountFit, fit_mount, off_middle, with_pitch
from calibration_routines.psf.psf_quality import PsfQuality
from calibration_routines.psf.stage_fit import StageFit
from calibration_routines.psf.structure import fit_structure
from calibration_routines.psf.sweep_plan import size_findings
from calibration_routines.routine import routines
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from recon.camera.depth_mixture import paraxial_scale
from recon.camera.registration import moved, rescaled
from recon.types import Geometry

BENCH = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
source_diameter_um = {diameter_um}
"""
GEOMETRY = Geometry(pixel_pitch_um=13.0, diffuser_distance_mm=8.9, aperture_mm=(1.5, 2.0))
DEPTHS = 1 / np.linspace(1 / 60e3, 1 / 150e3, 7)
RNG = np.random.default_rng(1)


def planes(x_um: float = 0.0, y_um: float = 0.0, farther_um: float = 0.0) -> list[PsfQuality]:
    found = []
    for z in DEPTHS:
        way = -8.9e3 / (z + farther_um) / 13.0
        centroid = (y_um * way + RNG.normal(0, 0.05), 3.0 + x_um * way + RNG.normal(0, 0.05))
        found.append(PsfQuality(z, 0, 100.0, 50.0, centroid, 50.0, 0.0))
    return found


def light(farther_um: float = 0.0) -> np.ndarray:
    return 1e9 / (DEPTHS + farther_um) ** 2 * (1 + 0.001 * RNG.normal(size=len(DEPTHS)))


def test_a_source_that_stands_elsewhere_is_found_with_its_uncertainty() -> None:
    right = fit_mount(planes(), light(), GEOMETRY)
    assert right is not None
    assert right.findings == ()
    off = fit_mount(planes(400, -300, 4000), light(4000), GEOMETRY)
    assert off is not None
    assert off.farther_um == pytest.approx(4000, abs=4 * off.farther_error_um)
    assert off.farther_error_um < 300
    assert off.beside_um == pytest.approx((400, -300), abs=60)
    assert "mm farther than recorded" in off.findings[0]
    assert "beside the axis" in off.findings[1]
    slipped = light()
    slipped[4:] *= 0.94
    found = fit_mount(planes(), slipped, GEOMETRY)
    assert found is not None
    assert any("square" in words for words in found.findings)
    assert fit_mount(planes()[:3], light()[:3], GEOMETRY) is None


def test_a_lamp_that_flickers_is_no_wrong_mount() -> None:
    unsteady = light() * (1 + 0.05 * RNG.normal(size=len(DEPTHS)))
    found = fit_mount(planes(), unsteady, GEOMETRY, brightness_error=0.05)
    assert found is not None
    assert found.findings == ()


def test_a_wrong_distance_is_told_by_the_patterns_growth_whatever_the_pitch() -> None:
    spots = np.zeros((120, 160), np.float32)
    spots[tuple(RNG.integers(20, n - 20, 60) for n in spots.shape)] = RNG.uniform(1, 3, 60)
    sharp = rescaled(spots, 0.98)
    patterns = []
    for number, z in enumerate(DEPTHS):
        grown = rescaled(sharp, 1 / paraxial_scale(DEPTHS[-1], z, 8.9e3))
        noisy = moved(grown, 0.3 * number, -0.2 * number) + RNG.normal(0, 0.002, spots.shape)
        patterns.append(noisy.astype(np.float32)[None])

    def told(d_mm: float, pitch_um: float = 13.0, farther_um: float = 0.0) -> tuple[float, str]:
        geometry = replace(GEOMETRY, diffuser_distance_mm=d_mm, pixel_pitch_um=pitch_um)
        recorded = [replace(plane, z_um=plane.z_um - farther_um) for plane in planes()]
        found = fit_mount(recorded, light(), geometry, psfs=patterns)
        assert found is not None
        assert found.distance is not None
        return found.distance[0] * d_mm, " ".join(w for w in found.findings if "grows" in w)

    for d_mm in (8.9, 1.3 * 8.9):
        found_mm, words = told(d_mm)
        assert found_mm == pytest.approx(8.9, rel=0.02)
        assert ("check diffuser_distance_mm" in words) == (d_mm != 8.9)
    assert told(8.9, pitch_um=26.0)[1] == ""
    assert told(8.9, farther_um=4e3)[1] == ""  # the light tells that the source stands elsewhere
    wide = [replace(plane, radius_px=70.0) for plane in planes()]  # light that was bent that far tells less
    lenslets = fit_mount(wide, light(), GEOMETRY, psfs=patterns)
    assert lenslets is not None
    assert lenslets.distance is not None
    assert lenslets.distance[1] > 0.1
    alike = [patterns[0]] * len(patterns)
    grown = fit_mount(planes(), light(), GEOMETRY, psfs=alike)  # a pattern that does not grow tells no d
    assert grown is not None
    assert grown.distance is None


@pytest.mark.parametrize(("d", "pitch", "farther_um"), [(1.0, 1.0, 0.0), (1.1, 1.0, 0.0), (1.0, 1.1, 2e3)])
def test_shifts_tell_the_pixel_pitch_once_growth_has_told_d(
    d: float, pitch: float, farther_um: float
) -> None:
    """``d`` and ``pitch`` are what is configured over what is true."""
    seen = MountFit(farther_um, 100.0, None, 0.0, 0.0, (1 / d, 0.015))
    stages = [
        StageFit(z, 9, z / (z + farther_um) * pitch / d - 1, 0.0, 0.1, 0.2, (), 5e-4) for z in (60e3, 90e3)
    ]
    geometry = Geometry(pixel_pitch_um=13.0 * pitch, diffuser_distance_mm=8.9 * d, aperture_mm=(1.5, 2.0))
    found = with_pitch(seen, stages, geometry)
    assert found is not None
    assert found.pitch is not None
    assert found.pitch[0] == pytest.approx(1 / pitch, abs=1e-6)
    assert found.pitch[1] == pytest.approx(0.015 / pitch, rel=0.2)
    said = " ".join(found.findings)
    assert ("those of pixels of 13 +- 0.2 um, not 14.3: check pixel_pitch_um" in said) == (pitch != 1)
    assert re.search(rf"; pixels of 13 \+- 0\.\d+ um, {13 * pitch:g} configured", found.line(geometry))
    unknown = replace(seen, distance=None)
    assert with_pitch(unknown, stages, geometry) == unknown
    assert with_pitch(seen, [], geometry) == seen


def test_where_light_or_noise_does_not_tell_no_distance_is_accused() -> None:
    rng = np.random.default_rng(11)
    spots = np.zeros((60, 80), np.float32)
    spots[tuple(rng.integers(12, n - 12, 25) for n in spots.shape)] = rng.uniform(1, 3, 25)
    sharp = rescaled(spots, 0.98)

    def patterns(depths: np.ndarray, noise: float) -> list[np.ndarray]:
        grown = [rescaled(sharp, 1 / paraxial_scale(depths[-1], z, 8.9e3)) for z in depths]
        return [(g + rng.normal(0, noise, g.shape)).astype(np.float32)[None] for g in grown]

    seven = patterns(DEPTHS, 0.002)
    dimmed = light()
    dimmed[3:] *= 0.7
    lamp = fit_mount(planes(), dimmed, GEOMETRY, psfs=seven)
    assert lamp is not None
    assert lamp.distance is None
    assert not any("grows" in words for words in lamp.findings)
    beyond = fit_mount(planes(), 1e9 / np.maximum(DEPTHS - 61e3, 2e3) ** 2, GEOMETRY, psfs=seven)
    assert beyond is not None
    assert beyond.farther_um < -DEPTHS.min()
    assert beyond.distance is None  # the nearest plane would stand behind the diffuser
    far = fit_mount(planes(), light(), replace(GEOMETRY, diffuser_distance_mm=3.0), psfs=seven)
    assert far is not None
    assert far.distance is None or abs(far.distance[0] - 8.9 / 3) < 3 * far.distance[1]
    for near, farthest in ((100e3, 125e3), (300e3, 400e3)):
        depths = 1 / np.linspace(1 / near, 1 / farthest, 5)
        five = [replace(plane, z_um=z) for plane, z in zip(planes(), depths, strict=False)]
        for _ in range(3):
            shone = 1e9 / depths**2 * (1 + 0.001 * rng.normal(size=5))
            found = fit_mount(five, shone, GEOMETRY, psfs=patterns(depths, 0.1 * float(sharp.max())))
            assert found is not None
            assert not any("grows" in words for words in found.findings)
            assert found.distance is None or found.distance[1] < 0.5 * found.distance[0]


def test_a_pinhole_wider_than_the_resolution_is_said() -> None:
    (words,) = size_findings(1500.0, GEOMETRY, 60e3)
    assert "17.1 pixels" in words
    assert size_findings(150.0, GEOMETRY, 60e3) == size_findings(None, GEOMETRY, 60e3) == ()


def test_a_pinhole_of_unknown_size_is_told_by_structure_that_widens_as_its_image() -> None:
    image_px = 300.0 * 8.9e3 / DEPTHS / 13.0  # of 300 um
    widths = np.hypot(2.3, image_px) * (1 + 0.01 * RNG.normal(size=len(DEPTHS)))
    found = fit_structure(DEPTHS, widths, GEOMETRY)
    assert found is not None
    assert found.source_um == pytest.approx(300, rel=0.1)
    assert found.widened_px == pytest.approx(image_px[0], abs=3 * found.error_px)
    assert "whose size is not configured" in found.line(None, 0.0)
    assert "not 30 as configured" in found.line(30.0, 0.3)
    assert found.line(300.0, float(image_px[0])) == ""
    for near, far in ((2.34, 2.28), (4.04, 3.92), (7.5, 7.2)):  # of smooth diffusers under small sources
        plain = fit_structure(DEPTHS, np.linspace(near, far, len(DEPTHS)), GEOMETRY)
        assert plain is not None
        assert plain.line(30.0, 0.3) == ""
        assert plain.least_um is not None
        said = plain.line(None, 0.0)
        assert "or more would have been told" in said
        assert "e+" not in said
        larger = np.hypot(np.linspace(near, far, len(DEPTHS)), 1.2 * plain.least_um * 8.9e3 / DEPTHS / 13.0)
        told = fit_structure(DEPTHS, larger, GEOMETRY)
        assert told is not None
        assert "widens from" in told.line(None, 0.0)
    two = fit_structure(DEPTHS[:2], widths[:2], GEOMETRY)
    assert two is not None
    assert "two depths do not tell" in two.line(None, 0.0)
    assert two.line(30.0, 0.3) == ""
    matters = f"A pinhole of {0.5 * 13.0 * DEPTHS[0] / 8.9e3:.2g} um would be half a pixel wide"
    for width, size_um, said in ((4.9, None, "one depth does not tell it from"), (2.3, None, matters)):
        one = fit_structure(DEPTHS[:1], [width], GEOMETRY)
        assert one is not None
        assert said in one.line(size_um, 0.0)
        assert one.line(30.0, 0.0) == ""
    assert fit_structure(DEPTHS, widths, replace(GEOMETRY, pixel_pitch_um=None)) is None


@pytest.mark.parametrize("diameter_um", [30, 400])
def test_a_sweep_tells_a_large_source_that_nobody_configured(tmp_path: Path, diameter_um: int) -> None:
    text = BENCH.format(diameter_um=diameter_um)
    with open_bench(parse_config(text, None)) as bench:
        asked = {"z_min_um": 60e3, "z_max_um": 150e3, "planes": 4, "average": 2}
        done = routines["axial"].asked(asked).carry_out(bench, tmp_path)
    said = [line for line in done.verdict if "the pattern's finest structure widens" in line]
    assert bool(said) == (diameter_um == 400)


def test_a_rail_that_leans_or_a_diffuser_beside_the_middle_is_said() -> None:
    def moved_by(columns: float, x_um: float = 0.0) -> list[PsfQuality]:
        made = planes(x_um)
        return [replace(q, centroid_px=(q.centroid_px[0], q.centroid_px[1] + columns)) for q in made]

    assert off_middle(moved_by(-3.0), GEOMETRY) == off_middle(moved_by(-3.0, 400.0), GEOMETRY) == ""
    moved = moved_by(-3.0 - 10.0 * 8.9 / 13.0, 400.0)  # 10 mrad
    words = off_middle(moved, GEOMETRY)
    assert float(words.split("lies ")[1].split(",")[0]) == pytest.approx(-6.85, abs=0.5)
    assert 9 < float(words.split("leans by ")[1].split()[0]) < 11
    # One depth does not tell a source's place from that; where it is recorded to stand off the axis is known.
    assert "or the source stands" in off_middle(moved[:1], GEOMETRY)
    assert off_middle([replace(moved_by(-3.0, 5e3)[0], x_um=5e3)], GEOMETRY) == ""
    assert off_middle(moved, replace(GEOMETRY, pixel_pitch_um=None)) == ""
