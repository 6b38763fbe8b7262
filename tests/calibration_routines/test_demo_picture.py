"""A comparison is made inside the scene, with one factor and no other help."""

from __future__ import annotations

import numpy as np
import pytest

from calibration_routines.demos.picture import compare, scene_field


def test_the_field_holds_the_pixels_that_lie_wholly_inside() -> None:
    field = scene_field((40, 60), (20, 30), (100.0, 205.0), 10.0)
    assert (field.rows, field.columns) == (slice(16, 25), slice(21, 40))
    # pixel 24's outer edge is at (4 + 0.5) * 10 = 45 <= 50 um, pixel 25's at 55 um; pixel 39's at 95 <= 102.5
    small = scene_field((10, 10), (5, 5), (1000.0, 1000.0), 10.0)
    assert (small.rows, small.columns) == (slice(0, 10), slice(0, 10))


def test_a_factor_is_fitted_and_an_offset_is_not() -> None:
    truth = np.random.default_rng(0).random((40, 60)).astype(np.float32)
    field = scene_field((40, 60), (20, 30), (300.0, 400.0), 10.0)
    assert compare(0.25 * truth, truth, field).psnr_db > 100
    assert compare(0.25 * truth, truth, field).scale == pytest.approx(4.0)
    assert compare(truth + 0.2, truth, field).psnr_db < 25


def test_what_lies_outside_the_field_does_not_count() -> None:
    truth = np.random.default_rng(0).random((40, 60)).astype(np.float32)
    field = scene_field((40, 60), (20, 30), (300.0, 400.0), 10.0)
    spoilt = np.full_like(truth, 1e6)
    spoilt[field.rows, field.columns] = truth[field.rows, field.columns]
    result = compare(spoilt, truth, field)
    assert result.ssim == pytest.approx(1.0)
    assert result.psnr_db > 100
