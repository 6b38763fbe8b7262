"""Resolution, field of view and sampling against closed forms and the dissertation's own arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from recon.analysis import correlation
from recon.analysis.correlation import (
    FieldPoint,
    autocorrelate,
    autocorrelation_cut,
    convolution_holds_deg,
    correlate,
    critical_scales,
    field_of_view,
    similarity,
)
from recon.analysis.resolution import (
    AxialResolution,
    axial_resolution,
    axial_spacing_per_um,
    gaussian_response,
    lateral_resolution,
    lateral_spacing_um,
    voxel_grid,
)
from recon.camera.registration import rescaled
from recon.errors import InputError


def gaussian(sigma: float, size: int = 65, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    y, x = np.mgrid[:size, :size] - size // 2
    return np.exp(-((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / (2 * sigma**2))


def spots(seed: int = 0, size: int = 129, count: int = 60, sigma: float = 1.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.3, 0.3, (count, 2)) * size
    return np.sum([gaussian(sigma, size, (y, x)) for y, x in places], axis=0)


@pytest.mark.parametrize("sigma", [3.0, 5.0])
@pytest.mark.parametrize("level", [0.7, 0.8])
def test_half_width_of_a_gaussian(sigma: float, level: float) -> None:
    """The autocorrelation of a Gaussian is a Gaussian, root two wider."""
    expected = np.sqrt(2) * sigma * np.sqrt(-2 * np.log(level))
    found = lateral_resolution(gaussian(sigma), level)
    assert found.half_width_px == pytest.approx((expected, expected), rel=0.01)


def test_the_angle_is_that_of_the_shift_on_the_sensor() -> None:
    found = lateral_resolution(gaussian(3.0), 0.7)
    assert found.angle_deg(6.5, 8800.0) == pytest.approx(
        np.rad2deg(np.arctan(found.mean_px * 6.5 / 8800.0)), rel=1e-9
    )
    assert found.object_um(6.5, 8900.0, 17800.0) == pytest.approx(2 * 6.5 * found.mean_px)


def test_correlation_is_the_inner_product_at_every_shift() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.random((2, 9, 12))
    correlated = correlate(first, second)
    norm = np.linalg.norm(first) * np.linalg.norm(second)
    assert correlated.values[8 + 2, 11 - 3] == pytest.approx(np.vdot(first[2:, :-3], second[:-2, 3:]) / norm)
    assert correlate(first, first).peak == (0, 0)
    assert autocorrelate(first).maximum == pytest.approx(1.0)
    for axis in (0, 1):
        np.testing.assert_allclose(
            autocorrelation_cut(first, axis), autocorrelate(first).profile(axis), atol=1e-12
        )


@pytest.mark.parametrize(("samples", "within"), [(6_000, 0.03), (400_000, 0.01)])
def test_the_critical_scale_has_the_similarity_asked_for(
    monkeypatch: pytest.MonkeyPatch, samples: int, within: float
) -> None:
    monkeypatch.setattr(correlation, "SAMPLES", samples)
    psf = spots()
    (scale,) = critical_scales(psf, 0.8)
    centre = tuple(float(np.average(np.arange(129), weights=psf.sum(axis=1 - a))) for a in (0, 1))
    assert similarity(psf, rescaled(psf, 1 / scale, centre=centre)) == pytest.approx(0.8, abs=within)


def test_axial_resolution_does_not_depend_on_the_depth_it_was_measured_at() -> None:
    """A nearer source casts a larger pattern, which needs less scale: c of Eq. 4.7 stays."""
    far = spots()
    near = rescaled(far, 1 / 1.25)
    d = 8900.0
    z_near = d / (1.25 * (1 + d / 300e3) - 1)
    first = axial_resolution(far, 300e3, d, 0.8)
    second = axial_resolution(near, z_near, d, 0.8)
    # The enlarged features are 1.25 times as wide, and so is the step they allow.
    assert second.step_per_um == pytest.approx(1.25 * first.step_per_um, rel=0.05)


def test_depth_of_field_ends_at_the_hyperfocal_distance() -> None:
    axial = AxialResolution(0.7, 1.01, 0.01 / 8900.0)
    assert axial.hyperfocal_um == pytest.approx(890e3)
    near, far = axial.depth_of_field_um(100e3)
    assert 1 / (100e3 - near) - 1 / 100e3 == pytest.approx(axial.step_per_um)
    assert 1 / 100e3 - 1 / (100e3 + far) == pytest.approx(axial.step_per_um)
    assert axial.depth_of_field_um(900e3)[1] == np.inf


def test_the_dissertations_field_of_view() -> None:
    """Chapters 3 and 4: 42 and 30.5 degrees, both limited by the pixels."""
    d = 8900.0
    x = field_of_view(2560 * 6.5, 7500.0, d, deflection_deg=0.5, cutoff_deg=41.5)
    y = field_of_view(2160 * 6.5, 5500.0, d, deflection_deg=0.5, cutoff_deg=30.0)
    assert (x.half_deg, y.half_deg) == pytest.approx((42.0, 30.5))
    assert x.limited_by == "the pixels' angular response"
    wide = field_of_view(2560 * 6.5, 7500.0, d, deflection_deg=0.5)
    assert wide.half_deg == pytest.approx(0.5 + np.rad2deg(np.arctan((16.64 + 7.5) / 2 / 8.9)))
    with pytest.raises(InputError, match="positive"):
        field_of_view(0.0, 1.0, 1.0, deflection_deg=0.5)


def test_the_dissertations_sampling_of_the_microscope() -> None:
    """Sec. 6.4: every 400 um across, 33 per metre along."""
    assert lateral_spacing_um(gaussian_response(13.0), 1700.0) == pytest.approx(400.0, rel=0.05)
    assert 1e6 * axial_spacing_per_um(250.0, 0.52) == pytest.approx(33.3, rel=0.01)


def test_lateral_spacing_grows_with_depth_and_width() -> None:
    near = lateral_spacing_um(gaussian_response(13.0), 1000.0)
    assert lateral_spacing_um(gaussian_response(13.0), 2000.0) == pytest.approx(2 * near)
    assert lateral_spacing_um(gaussian_response(20.0), 1000.0) > near
    assert lateral_spacing_um(lambda angles: np.ones_like(angles), 1000.0) == np.inf


def test_the_voxel_grid_is_even_in_inverse_depth_and_nyquist() -> None:
    grid = voxel_grid(
        resolution_px=4.3, step_per_um=2e-6, z_range_um=(20e3, 40e3), pitch_um=6.5, distance_um=8900.0
    )
    steps = -np.diff(1 / np.array(grid.z_um))
    assert grid.binning == 2
    assert steps == pytest.approx(np.full(len(steps), steps[0]))
    assert steps[0] <= 1e-6 * (1 + 1e-9)
    assert grid.z_um[0] == pytest.approx(20e3)
    assert grid.z_um[-1] == pytest.approx(40e3)
    assert grid.lateral_um[0] == pytest.approx(2 * 6.5 * 20e3 / 8900.0)
    one = voxel_grid(resolution_px=1.0, step_per_um=1.0, z_range_um=(5e3, 5e3), pitch_um=1.0, distance_um=1e3)
    assert one.z_um == (5e3,)
    huge = voxel_grid(
        resolution_px=1.0, step_per_um=1e-9, z_range_um=(5e3, 50e3), pitch_um=1.0, distance_um=1e3
    )
    assert not huge.complete


def test_the_convolution_model_holds_up_to_the_last_angle_before_a_wide_spot() -> None:
    def point(angle: float, spot: float) -> FieldPoint:
        return FieldPoint(0.0, 0.0, 1e4, angle, 0.9, spot)

    ring = (point(0.0, 1.0), point(10.0, 1.02), point(16.0, 1.0), point(16.01, 1.3), point(20.0, 1.05))
    assert convolution_holds_deg(ring) == 10.0
    assert convolution_holds_deg(ring[:3]) == 16.0
    assert convolution_holds_deg(ring[:1]) is None
