from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon import InputError
from recon.base.blocks import block_sum
from recon.evaluation.measured_camera import measured_camera
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.evaluation.scene import make_scene

there = pytest.mark.skipif(
    not (data_folder() / "diffusercam_usaf3d").is_dir() or not (data_folder() / "diffusercam_hand").is_dir(),
    reason=f"the measured sets are not in {data_folder()} (DIFFUSERBENCH_DATA may name their folder)",
)


@there
def test_a_point_on_the_axis_casts_the_measured_psf_and_another_one_casts_it_shifted():
    camera = measured_camera((54, 64), "usaf", (4.0, 12.0), plane=None)
    z = 4 * camera.distance_um
    axis = camera.light([[0, 0, z, 1.0]])
    measured = block_sum(measured_set("usaf")[0][0], 5)
    np.testing.assert_allclose(axis / axis.sum(), measured / measured.sum(), atol=1e-6)
    to_scene = -camera.pitch_um * z / camera.distance_um
    moved = camera.light([[-3 * to_scene, 5 * to_scene, z, 2.0]])
    np.testing.assert_allclose(moved[5:, :-3], 2 * axis[:-5, 3:], atol=1e-5 * axis.max())
    # A fifth of a pixel is a pixel of the finer ones.
    finer = camera.light([[0.2 * to_scene, 0, z, 1.0]])
    assert np.abs(finer - axis).max() > 0.02 * axis.max()
    assert finer.sum() == pytest.approx(axis.sum(), rel=1e-3)


@there
def test_depths_are_those_of_the_set_and_the_nearest_is_the_largest():
    scene = make_scene("beads", optics="usaf", size=(54, 64), depths=4, calibration_photons=1e6)
    psfs = scene.calibration.psfs[:, 0]
    measured = block_sum(measured_set("usaf")[0][[0, 14, 29, 43]], 5)
    for mine, theirs in zip(psfs, measured, strict=True):
        assert np.corrcoef(mine.ravel(), theirs.ravel())[0, 1] > 0.999


@there
def test_drift_aberration_and_fall_off_change_what_they_say():
    still = measured_camera((54, 64), "usaf", (6.0, 6.0), plane=0.5)
    z = 6 * still.distance_um
    side = [[0.3 * 64 * still.pitch_um * 6, 0, z, 1.0]]
    assert still.moved((2, 0)).light([[0, 0, z, 1.0]])[2:] == pytest.approx(
        still.light([[0, 0, z, 1.0]])[:-2], abs=1e-6
    )
    dim, grown = (
        measured_camera((54, 64), "usaf", (6.0, 6.0), plane=0.5, **change)
        for change in ({"fall_off_deg": 15.0}, {"aberration": 0.5})
    )
    assert dim.light(side).sum() < 0.6 * still.light(side).sum()
    assert np.abs(grown.light(side) - still.light(side)).max() > 0.2 * still.light(side).max()
    np.testing.assert_allclose(dim.light([[0, 0, z, 1.0]]), still.light([[0, 0, z, 1.0]]), atol=1e-7)


@there
def test_stray_light_lies_as_on_the_photograph():
    scene = make_scene("text", optics="hand", size=(48, 64), background=0.5)
    assert scene.background.std() > 0.1 * scene.background.mean()
    light = (scene.measurement - scene.background).mean()
    assert scene.background.mean() / light == pytest.approx(0.5, rel=0.03)


def test_what_is_not_there_is_said(monkeypatch, tmp_path: Path):
    measured_set.cache_clear()
    monkeypatch.setenv("DIFFUSERBENCH_DATA", str(tmp_path))
    with pytest.raises(InputError, match="DIFFUSERBENCH_DATA"):
        make_scene("text", optics="usaf", size=46)


@there
def test_the_hand_has_one_depth_and_no_room_for_more_pixels():
    with pytest.raises(InputError, match="one depth"):
        make_scene("beads", optics="hand", size=48, depths=3)
    with pytest.raises(InputError, match="no room"):
        make_scene("text", optics="usaf", size=400)
