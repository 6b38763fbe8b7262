"""Registration of PSFs: displaced, scaled, aberrated, cut by the sensor's edge; truth from wave optics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.arrays import Float32Array
from recon.camera.depth_mixture import paraxial_scale
from recon.camera.registration import aligned, displacement, expected_shift, register, rescaled
from recon.errors import InputError
from recon.optics.diffuser import microlens_diffuser, smooth_diffuser
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.wave import WavePropagator

D_UM, PITCH_UM = 8900.0, 13.0
GRID = PixelGrid((240, 320), PITCH_UM)
LIGHT = GREEN.samples(1)


@pytest.fixture(scope="module")
def camera() -> WavePropagator:
    return WavePropagator(smooth_diffuser((1500.0, 2000.0), 5.0, seed=3), D_UM)


def photograph(camera: WavePropagator, source_um: tuple[float, float, float], seed: int) -> Float32Array:
    """Four averaged frames of 20,000 electrons at the 99.9th percentile, read noise 3."""
    light = camera.psf(source_um, GRID, LIGHT)
    electrons = light * np.float32(20_000 / np.quantile(light, 0.999))
    rng = np.random.default_rng(seed)
    frames = [rng.poisson(electrons) + rng.normal(0, 3, light.shape) for _ in range(4)]
    return np.mean(frames, axis=0, dtype=np.float32)


def at_angle(degrees: float, azimuth: float, z_um: float) -> tuple[float, float, float]:
    radius = np.tan(np.deg2rad(degrees)) * z_um
    return float(radius * np.cos(azimuth)), float(radius * np.sin(azimuth)), z_um


@pytest.mark.parametrize("degrees", [0.2, 4.0, 8.0, 10.5])
def test_shift_is_found_to_a_tenth_of_a_pixel(camera: WavePropagator, degrees: float) -> None:
    z = 100e3
    reference = photograph(camera, (0.0, 0.0, z), 1)
    for azimuth in (0.3, 2.8, 5.0):
        source = at_angle(degrees, azimuth, z)
        found = register(photograph(camera, source, 2), reference)
        truth = expected_shift(source, D_UM, PITCH_UM)
        assert np.hypot(found.rows - truth[0], found.columns - truth[1]) < 0.1
        assert found.reliable
        assert found.similarity > 0.9


@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_aberrated_psfs_are_registered(camera: WavePropagator, degrees: float) -> None:
    z = 100e3
    source = at_angle(degrees, 0.4, z)
    truth = expected_shift(source, D_UM, PITCH_UM)
    offset = (round(truth[0]) * PITCH_UM, round(truth[1]) * PITCH_UM)  # a sensor large enough to see it
    beside = PixelGrid(GRID.shape, PITCH_UM, (offset[1], offset[0]))
    found = register(camera.psf(source, beside, LIGHT), camera.psf((0.0, 0.0, z), GRID, LIGHT))
    rest = truth[0] - round(truth[0]), truth[1] - round(truth[1])
    assert np.hypot(found.rows - rest[0], found.columns - rest[1]) < 0.5
    assert found.similarity < 0.95  # they do differ
    assert found.reliable


def test_a_pattern_half_off_the_sensor_is_found_where_it_is(camera: WavePropagator) -> None:
    z = 100e3
    source = (24e3, 0.0, z)  # shifted by 164 pixels: the middle of the pattern is at the sensor's edge
    found = register(photograph(camera, source, 5), photograph(camera, (0.0, 0.0, z), 6))
    truth = expected_shift(source, D_UM, PITCH_UM)
    assert np.hypot(found.rows - truth[0], found.columns - truth[1]) < 0.3


def test_a_pattern_off_the_sensor_is_not_relied_on(camera: WavePropagator) -> None:
    z = 100e3
    dark = np.random.default_rng(1).normal(0, 3, GRID.shape)
    assert not register(dark, photograph(camera, (0.0, 0.0, z), 6)).reliable


def test_a_regular_array_needs_to_know_where_to_look() -> None:
    lenslets = WavePropagator(
        microlens_diffuser((1500.0, 1500.0), 2.5, lenslet_um=250.0, focal_length_um=3000.0, regular=True),
        3000.0,
    )
    grid = PixelGrid((240, 320), 6.5)
    z = 30e3
    source = (6e3, 0.0, z)  # 92 pixels, more than two periods
    images = [lenslets.psf(s, grid, LIGHT) for s in (source, (0.0, 0.0, z))]
    assert not register(images[0], images[1]).reliable
    truth = expected_shift(source, 3000.0, 6.5)
    found = register(images[0], images[1], near=(truth[0] + 3, truth[1] - 4), within_px=12)
    assert np.hypot(found.rows - truth[0], found.columns - truth[1]) < 0.1


@pytest.mark.parametrize("z_um", [40e3, 70e3, 250e3])
def test_scale_follows_the_depth(camera: WavePropagator, z_um: float) -> None:
    reference = photograph(camera, (0.0, 0.0, 100e3), 1)
    source = (1.5e3, -0.8e3, z_um)
    image = photograph(camera, source, 2)
    expected = paraxial_scale(100e3, z_um, D_UM)
    found = register(image, reference, scale=None)
    assert found.scale == pytest.approx(expected, rel=2e-3)
    known = register(image, reference, scale=expected)
    truth = expected_shift(source, D_UM, PITCH_UM)
    for one in (found, known):
        assert np.hypot(one.rows - truth[0], one.columns - truth[1]) < 0.3
        assert one.reliable


def test_alignment_brings_the_pattern_onto_the_reference(camera: WavePropagator) -> None:
    reference = camera.psf((0.0, 0.0, 100e3), GRID, LIGHT)
    image = camera.psf((2.03e3, -1.07e3, 60e3), GRID, LIGHT)
    back = aligned(image, register(image, reference, scale=paraxial_scale(100e3, 60e3, D_UM)))
    middle = (slice(60, 180), slice(80, 240))
    unit = [i[middle] / np.linalg.norm(i[middle]) for i in (back, reference)]
    assert float(np.vdot(*unit)) > 0.97
    assert back.min() >= 0


@settings(max_examples=25, deadline=None)
@given(
    rows=st.floats(-20, 20),
    columns=st.floats(-20, 20),
    seed=st.integers(0, 1000),
)
def test_band_limited_images_are_registered_to_a_hundredth(rows: float, columns: float, seed: int) -> None:
    shape = (96, 128)
    ky, kx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])
    noise = np.fft.fft2(np.random.default_rng(seed).normal(size=shape))
    noise *= np.exp(-0.5 * (np.hypot(ky, kx) / 0.12) ** 2)
    window = np.hanning(shape[0])[:, None] ** 2 * np.hanning(shape[1]) ** 2
    still = np.fft.ifft2(noise).real * window
    there = np.fft.ifft2(np.fft.fft2(still) * np.exp(-2j * np.pi * (ky * rows + kx * columns))).real
    found = register(there, still)
    assert (found.rows, found.columns) == pytest.approx((rows, columns), abs=0.02)
    # The nearest whole pixels; about halfway between two of them either: slopes of the peak tell which
    # (0.529 at most on 250 draws).
    assert displacement(there, still) == pytest.approx((rows, columns), abs=0.6)


def test_scaling_keeps_the_light_and_the_centre() -> None:
    y, x = np.mgrid[:81, :101]
    blob = np.exp(-0.5 * (((y - 40) / 6) ** 2 + ((x - 50) / 6) ** 2)).astype(np.float32)
    for factor in (0.7, 1.4):
        larger = rescaled(blob, 1 / factor) / factor**2
        assert larger.sum() == pytest.approx(blob.sum(), rel=2e-3)
        assert np.unravel_index(int(larger.argmax()), larger.shape) == (40, 50)


def test_what_cannot_be_registered_is_refused() -> None:
    with pytest.raises(InputError, match="one shape"):
        register(np.ones((4, 5)), np.ones((5, 4)))
    with pytest.raises(InputError, match="PSF to register is constant"):
        register(np.ones((40, 50)), np.random.default_rng(0).random((40, 50)))
