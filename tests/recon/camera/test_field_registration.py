"""PSFs over the field brought to lie on one another, where none was measured on the axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.camera.camera_model import sort_by_depth
from recon.camera.field_registration import NOT_ON_AXIS, filled_in, one_psf
from recon.camera.registration import Registration
from recon.evaluation.scene import SceneSpec, make_scene
from recon.evaluation.scene_trial import Options, judge, solve
from recon.types import Geometry

SPEC = SceneSpec(
    "sparse-picture", size=48, seed=1001, z_near=1.0, z_far=1.0, photons=10_000.0, fall_off_deg=40.0
)


def test_four_points_at_the_corners_serve_where_the_response_hardly_falls_off() -> None:
    """They failed at any response: the picture was centred on one of the corners."""
    scene = make_scene(SPEC, grid=2)
    result = solve(scene, "admm tv", Options(), 60)
    trial = judge(scene, result)
    assert max(trial.severities.values()) < 0.9, trial
    assert NOT_ON_AXIS in result.warnings


def test_a_grid_without_a_middle_point_is_centred_on_the_axis() -> None:
    depths = sort_by_depth(make_scene(SPEC, grid=4).calibration)
    np.testing.assert_allclose(depths.fields[0].points.mean(axis=0), 0, atol=0.2)
    assert NOT_ON_AXIS in depths.warnings


@pytest.mark.parametrize("grid", [2, 4])
def test_the_pattern_on_the_axis_is_put_together_from_what_is_seen_of_it_elsewhere(grid: int) -> None:
    photographed = make_scene(SPEC, grid=1).calibration.psfs[0, 0].astype(np.float64)
    made = one_psf(make_scene(SPEC, grid=grid).calibration)[0]
    assert np.vdot(made, photographed) > 0.9 * np.linalg.norm(made) * np.linalg.norm(photographed)


def test_a_grid_with_a_middle_point_keeps_that_point_as_it_was_photographed() -> None:
    calibration = make_scene(SPEC, grid=3).calibration
    depths = sort_by_depth(calibration)
    np.testing.assert_array_equal(depths.central[0], calibration.psfs[4])
    np.testing.assert_array_equal(depths.fields[0].points[4], 0)
    assert NOT_ON_AXIS not in depths.warnings


def test_without_a_geometry_the_nearest_point_is_the_axis() -> None:
    calibration = replace(make_scene(SPEC, grid=4, z_near=6.0, z_far=6.0).calibration, geometry=Geometry())
    depths = sort_by_depth(calibration)
    assert [0, 0] in depths.fields[0].points.tolist()
    assert NOT_ON_AXIS not in depths.warnings


def test_what_an_edge_psf_does_not_show_is_taken_from_the_central_one() -> None:
    rng = np.random.default_rng(0)
    central = rng.random((1, 40, 48)).astype(np.float32)
    brightness = np.linspace(0.4, 0.8, 48, dtype=np.float32)
    # Displaced by 10.3 columns: registered, its last 11 columns lie beyond the sensor's edge.
    photographed = central * brightness
    photographed[..., 37:] = 0
    found = Registration(0.0, 10.3, 1.0, 1.0, 10.0)
    completed = filled_in(photographed, central, found)
    np.testing.assert_allclose(completed[0, 1:-1, 1:], (central * brightness)[0, 1:-1, 1:], rtol=1e-4)
    whole = central * brightness
    np.testing.assert_allclose(filled_in(whole, central, found)[..., 1:-13], whole[..., 1:-13], rtol=1e-6)
