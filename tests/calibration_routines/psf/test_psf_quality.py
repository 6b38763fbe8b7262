"""The quality check finds what is wrong with a plane or a sweep, and nothing in a good one."""

from __future__ import annotations

import numpy as np
import pytest

from calibration_routines.psf.psf_quality import judge_next, judge_sweep, measure_psf, temporal_noise
from recon.arrays import Float32Array

D_UM = 8_900.0
SHAPE = (256, 320)
Z_UM = 1.0 / np.linspace(1 / 80e3, 1 / 400e3, 6)


def pattern(
    z_um: float, *, shift_px: tuple[float, float] = (0.0, 0.0), scale: float = 1.0, noise: float = 1.0
) -> Float32Array:
    """An aperture's shadow, 90 x 120 pixels for a source at infinity, filled with bright lines."""
    magnification = scale * (1 + D_UM / z_um)
    rows, columns = (
        (np.arange(n) + 0.5 - n / 2 - s) / magnification for n, s in zip(SHAPE, shift_px, strict=True)
    )
    y, x = np.meshgrid(rows, columns, indexing="ij")
    lines = 1.0 + np.sin(0.5 * x + 0.3 * y) * np.sin(0.4 * y - 0.2 * x + 1.0)
    image = 400.0 * lines * (np.abs(y) < 45) * (np.abs(x) < 60)
    image += np.random.default_rng(int(z_um)).normal(0.0, noise, SHAPE)
    return image[None].astype(np.float32)


def test_a_good_sweep_has_no_findings() -> None:
    planes = [measure_psf(pattern(z), z_um=z, noise=1.0) for z in Z_UM]
    judged = judge_sweep(planes, D_UM)
    assert all(not plane.findings for plane in judged)
    assert max(abs(plane.scale_error) for plane in judged) < 0.01
    # the shadow's root-mean-square radius is known in closed form
    expected = (1 + D_UM / Z_UM[0]) * np.sqrt((90**2 + 120**2) / 12)
    assert planes[0].radius_px == pytest.approx(expected, rel=0.03)
    assert planes[0].signal == pytest.approx(400.0, rel=0.1)


def test_a_source_off_axis_and_a_tilted_rail_are_no_steps() -> None:
    shifts = [(-1e6 / z - 3.0, 5e5 / z + 4.0) for z in Z_UM]
    planes = [
        measure_psf(pattern(z, shift_px=s), z_um=z, noise=1.0) for z, s in zip(Z_UM, shifts, strict=True)
    ]
    judged = judge_sweep(planes, D_UM)
    assert all(not plane.findings for plane in judged)
    assert planes[0].centroid_px == pytest.approx(shifts[0], abs=1.0)


def test_a_slip_of_the_stage_is_found_and_retaken() -> None:
    planes = [
        measure_psf(pattern(z, shift_px=(0.0, 6.0 if i == 2 else 0.0)), z_um=z, noise=1.0)
        for i, z in enumerate(Z_UM)
    ]
    judged = judge_sweep(planes, D_UM)
    assert [i for i, plane in enumerate(judged) if plane.findings] == [2]
    assert judged[2].retake
    assert judged[2].step_px == pytest.approx(6.0, abs=1.0)
    assert "slipped" in judged[2].findings[0]


def test_a_wrong_distance_shows_in_the_scale() -> None:
    planes = [
        measure_psf(pattern(z, scale=1.06 if i == 3 else 1.0), z_um=z, noise=1.0) for i, z in enumerate(Z_UM)
    ]
    judged = judge_sweep(planes, D_UM)
    assert [i for i, plane in enumerate(judged) if plane.findings] == [3]
    assert judged[3].scale_error == pytest.approx(0.06, abs=0.01)
    assert not judged[3].retake


def test_without_d_a_support_that_grows_with_distance_is_found() -> None:
    planes = [
        measure_psf(pattern(z, scale=1.1 if i == 3 else 1.0), z_um=z, noise=1.0) for i, z in enumerate(Z_UM)
    ]
    assert [i for i, plane in enumerate(judge_sweep(planes, None)) if plane.findings] == [3]


def test_a_pattern_cut_by_the_edge_is_found() -> None:
    quality = measure_psf(pattern(100e3, shift_px=(0.0, 110.0)), z_um=100e3, noise=1.0)
    assert quality.clipped > 0.05
    assert "edge" in quality.findings[0]


def test_noise_saturation_and_darkness_are_found() -> None:
    noisy = measure_psf(pattern(100e3, noise=100.0), z_um=100e3, noise=100.0)
    assert noisy.snr < 10
    assert "times the noise" in noisy.findings[0]
    saturated = measure_psf(pattern(100e3), z_um=100e3, noise=1.0, saturated_pixels=12)
    assert saturated.retake
    assert "12 pixels saturate" in saturated.findings[0]
    dark = measure_psf(np.zeros((1, *SHAPE), np.float32), z_um=100e3, noise=1.0)
    assert "no light" in dark.findings[0]
    assert judge_sweep([dark, dark], D_UM)[0].findings == dark.findings


def test_temporal_noise_is_that_of_the_average() -> None:
    random = np.random.default_rng(0)
    light = np.zeros((100, 100))
    light[:40] = 1000.0
    frames = light + np.where(light > 0, 30.0, 2.0) * random.normal(size=(8, 100, 100))
    assert temporal_noise(frames) == pytest.approx(30.0 / np.sqrt(8), rel=0.05)
    with pytest.raises(ValueError, match="at least two"):
        temporal_noise(frames[:1])


def test_the_next_plane_may_lie_as_far_off_as_the_line_through_the_others_is_unsure() -> None:
    z_um = (60e3, 75e3, 100e3, 150e3)  # the last one far beyond the others in 1/z
    three = [measure_psf(pattern(z), z_um=z, noise=1.0) for z in z_um[:3]]
    for shift_px, slipped in ((2.5, False), (6.0, True)):
        last = measure_psf(pattern(z_um[3], shift_px=(shift_px, 0.0)), z_um=z_um[3], noise=1.0)
        assert bool(judge_next(three, last, D_UM).findings) == slipped
    inside = measure_psf(pattern(67e3, shift_px=(2.8, 0.0)), z_um=67e3, noise=1.0)
    assert judge_next(three, inside, D_UM).findings
