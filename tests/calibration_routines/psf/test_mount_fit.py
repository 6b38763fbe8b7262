"""An axial sweep tells by itself how far off its record the source stands; a large pinhole is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration_routines.psf.mount_fit import fit_mount, off_middle
from calibration_routines.psf.psf_quality import PsfQuality
from calibration_routines.psf.sweep_plan import size_findings
from recon.types import Geometry

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


def test_a_pinhole_wider_than_the_resolution_is_said() -> None:
    (words,) = size_findings(1500.0, GEOMETRY, 60e3)
    assert "17.1 pixels" in words
    assert size_findings(150.0, GEOMETRY, 60e3) == size_findings(None, GEOMETRY, 60e3) == ()


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
