"""Points along the axis and sixteen in x and z, as default volumes tell them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from instrument.evaluation.analysis_figure import facts
from recon.analysis import AnalysisSettings, analyse
from recon.analysis.points import PointGrid
from recon.analysis.stated_distance import InVolumes
from recon.evaluation import points_in_volumes
from recon.evaluation.points_in_volumes import in_volumes
from recon.types import Calibration, Geometry

STEP = 1e-6
"""1 / um, between patterns of which the inner product is 0.8."""


@pytest.fixture
def calibration() -> Calibration:
    """Caustics of 40 x 50 pixels in 96 x 128."""
    lines = np.maximum(ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(96, 128)), 1.0), 0) ** 2
    lines[:28], lines[68:], lines[:, :39], lines[:, 89:] = 0, 0, 0, 0
    psfs = np.asarray(lines / lines.max(), np.float32)[None, None]
    return Calibration(psfs, np.array([[0.0, 0.0, 50e3]]), geometry=Geometry(10.0, 5.0))


@pytest.mark.parametrize("sixteen_at", [1.6, 9.0])
def test_the_distances_are_those_from_which_groups_are_told_apart(
    calibration: Calibration, monkeypatch: pytest.MonkeyPatch, sixteen_at: float
) -> None:
    def told_apart(_self: object, grids: list[PointGrid], places: np.ndarray, _rng: object) -> list[bool]:
        assert len(grids) == len(places)
        needed = {2: 2.0 * 1.3, 4: 2.0 * sixteen_at}
        return [one.separation_planes > needed[one.planes] for one in grids]

    monkeypatch.setattr(points_in_volumes._Volume, "told_apart", told_apart)
    found = in_volumes(calibration, 50e3, 2.0, 2.0 * STEP / 2, STEP)
    assert found.along_per_um == pytest.approx(2.0 * 1.3 * STEP / 2, rel=0.2)
    assert found.along_per_um > 2.0 * 1.3 * STEP / 2
    # 17 planes have room for 2.5 times the optics' distances.
    assert found.sixteen_factor == (None if sixteen_at > 2.5 else pytest.approx(sixteen_at, rel=0.2))


def test_the_page_tells_what_volumes_reach_and_under_which_conditions(calibration: Calibration) -> None:
    found = InVolumes(2e-6, None, 17, 1.0)
    analysis = analyse(
        replace(calibration, psfs=calibration.psfs[..., 24:72, 36:92]),
        AnalysisSettings(volumes=True),
        reach_in_volumes=lambda *_: found,
    )
    said = dict(facts(analysis))
    if analysis.in_volumes is None:  # no distance along the axis to begin with
        assert any("Volumes were not tried" in note for note in analysis.notes)
    else:
        assert said["two points along, volume"] == "2 /m, 5 mm"
        assert said["16 points, volume"] == "not told apart as far as 17 planes go"
        assert any("default volumes of planes half an axial step apart" in note for note in analysis.notes)
