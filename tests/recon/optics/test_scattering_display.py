"""The simulated display against what is known in closed form, and against a plain far field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.optics.scattering_display import DisplaySpec, MaskPose, ScatteringDisplay

SHAPE = (32, 40)  # SLM pixels; four mask pixels each way
BITS = np.random.default_rng(0).integers(0, 2, (128, 160))
PHASE = np.random.default_rng(1).uniform(0, 2 * np.pi, SHAPE)
# The field of view is 5775 um wide; 160 camera pixels cover it.
SPEC = DisplaySpec(
    slm_pitch_um=16.0, focal_mm=35.0, sensor_shape=(128, 160), sensor_pitch_um=5775 / 160, oversampling=2
)


def see(spec=SPEC, pose=None, phase=PHASE):
    return ScatteringDisplay(spec, np.pi * BITS).irradiance(phase, pose or MaskPose())


@pytest.mark.parametrize("per_field", [1280, 320, 160, 53.3, 21.7])
def test_a_camera_pixel_integrates_the_far_field_of_mask_times_slm(per_field):
    """Against an explicit transform at 5 x 5 to 41 x 41 places a pixel, small pixels to large ones."""
    spec = replace(
        SPEC,
        sensor_shape=(16, 12),
        sensor_pitch_um=SPEC.field_um / per_field,
        sensor_offset_um=(-310.0, 55.0),
    )
    field = np.repeat(np.repeat(np.exp(1j * PHASE), 4, 0), 4, 1) * np.exp(1j * np.pi * BITS)
    count = int(np.ceil(1280 / per_field)) // 2 * 2 + 5
    waves = []
    for cells, pixels, offset in zip(field.shape, spec.sensor_shape, spec.sensor_offset_um, strict=True):
        inside = (np.arange(count * pixels) + 0.5) / count - pixels / 2
        nu = inside / per_field + offset / SPEC.field_um
        waves.append(np.exp(-2j * np.pi * np.outer(nu, np.arange(cells))) * np.sinc(nu)[:, None])
    far = np.abs(waves[0] @ field @ waves[1].T) ** 2 / field.size
    expected = far.reshape(16, count, 12, count).mean(axis=(1, 3))
    error = see(spec) - expected
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.sqrt(np.mean(expected**2))


def test_light_is_neither_made_nor_lost_but_for_the_envelope():
    seen = see(replace(SPEC, sensor_shape=(160, 160)))
    expected = (np.sinc(np.linspace(-0.5, 0.5, 1001)) ** 2).mean() ** 2
    assert seen.mean() == pytest.approx(expected, rel=0.02)


def test_a_mask_shift_of_whole_slm_pixels_is_a_shift_of_the_pattern():
    phase = np.zeros(SHAPE)
    phase[8:24, 8:32] = PHASE[8:24, 8:32]
    moved = np.roll(phase, (-1, 2), axis=(0, 1))
    a = see(pose=MaskPose(shift_x_um=-32.0, shift_y_um=16.0), phase=phase)
    b = see(phase=moved)
    unmoved = see(phase=phase)
    # The patterns differ only at the border, where one has left the mask.
    right, wrong = (np.corrcoef(x.ravel(), b.ravel())[0, 1] for x in (a, unmoved))
    assert right > 0.8 > wrong + 0.3


@pytest.mark.parametrize(
    "pose",
    [
        MaskPose(shift_x_um=6.0),
        MaskPose(roll_mrad=40.0),
        MaskPose(z_um=600.0),
        MaskPose(pitch_mrad=500.0),
        MaskPose(yaw_mrad=500.0),
    ],
)
def test_every_misalignment_changes_what_is_seen(pose):
    assert np.corrcoef(see(pose=pose).ravel(), see().ravel())[0, 1] < 0.97


def test_free_space_keeps_the_energy_and_can_be_undone():
    optics = ScatteringDisplay(SPEC, np.pi * BITS)
    here = optics._on_mask(PHASE, MaskPose())
    there = optics._on_mask(PHASE, MaskPose(z_um=500.0))
    assert np.sum(np.abs(there) ** 2) == pytest.approx(np.sum(np.abs(here) ** 2), rel=1e-4)
    back = np.fft.ifft2(np.fft.fft2(there) * np.exp(1j * 0.5 * np.add.outer(*optics._f2)))
    np.testing.assert_allclose(back, here, atol=1e-3)


def test_a_decentred_relay_distorts_about_its_own_axis():
    """A dark pixel at the relay's axis stays where it is; elsewhere it moves by the cube of the distance."""
    spec = replace(SPEC, relay_distortion_um=40.0, relay_centre_um=(120.0, -80.0))
    y, x = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    row, column = np.abs(y * 16 + 80).argmin(), np.abs(x * 16 - 120).argmin()

    def place(at, spec):
        phase = np.zeros(SHAPE)
        phase[row, at] = np.pi
        field = ScatteringDisplay(spec, np.pi * BITS)._on_mask(phase, MaskPose())
        weight = np.abs(field - 1)[30:-30, 30:-30].sum(axis=0)  # the SLM's border moves too
        return 2.0 * float(weight @ np.arange(len(weight)) / weight.sum())

    straight = replace(spec, relay_distortion_um=0.0)
    assert place(column, spec) == pytest.approx(place(column, straight), abs=0.02)
    corner_um = 0.5 * 4.0 * np.hypot(128, 160)
    # The cells that see the pixel lie closer to the axis, 160 um to the right of it.
    moved = place(column - 10, spec) - place(column - 10, straight)
    assert moved == pytest.approx(40.0 * 160**3 / corner_um**3, rel=0.1)


def test_a_tilt_is_another_distance_at_each_place():
    optics = ScatteringDisplay(SPEC, np.pi * BITS)
    tilted = optics._on_mask(PHASE, MaskPose(yaw_mrad=8.0))
    column = 280
    z_um = 8e-3 * (column - 159.5) * 2.0
    straight = optics._on_mask(PHASE, MaskPose(z_um=z_um))
    flat = optics._on_mask(PHASE, MaskPose())
    error = np.abs(tilted[20:-20, column] - straight[20:-20, column]).mean()
    assert error < 0.2 * np.abs(flat[20:-20, column] - straight[20:-20, column]).mean()


def test_offset_and_distortion_move_the_picture_on_the_camera():
    offset = see(replace(SPEC, sensor_offset_um=(0.0, 3 * SPEC.sensor_pitch_um)))
    np.testing.assert_allclose(offset[:, :-4], see()[:, 3:-1], rtol=1e-2, atol=1e-2)
    assert np.abs(see(replace(SPEC, lens_distortion=0.05)) - see()).max() > 0.1


def test_partly_coherent_light_is_the_sum_of_its_sources_pictures():
    """Each point of the source shows the far field elsewhere: a camera that is moved sees the same."""
    angles, weights = np.polynomial.hermite_e.hermegauss(7)
    weights /= weights.sum()
    moved_um = 0.5e-3 * SPEC.focal_mm * 1e3 * angles
    expected = sum(
        wy * wx * see(replace(SPEC, sensor_offset_um=(y, x)))
        for wy, y in zip(weights, moved_um, strict=True)
        for wx, x in zip(weights, moved_um, strict=True)
    )
    partly = see(replace(SPEC, source_mrad=0.5))
    inside = (slice(5, -5), slice(5, -5))  # beyond the field's border is only as much as is read there
    assert partly[inside] == pytest.approx(expected[inside], abs=0.01)
    assert partly.std() < 0.9 * see().std()
    assert partly.mean() == pytest.approx(see().mean(), rel=0.02)
