"""What a misplaced mask costs: against the model where it knows, and in which direction where it does not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import DcTerm, Display, HologramModel, Target, random_mask
from recon.holography.pose import PlacedHologram, Pose
from recon.holography.scores import compare, low_pass
from recon.optics.scattering_display import DisplaySpec, MaskPose, ScatteringDisplay

SHAPE, K = (48, 64), 4
DISPLAY = Display(
    SHAPE,
    random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=3),
    dc=DcTerm(0.1, 0.6),
    mask_fill=1.0,
    focal_mm=35.0,
)
Y, X = np.mgrid[:96, :96]
TARGET = Target(np.where((Y - 40) ** 2 + (X - 52) ** 2 < 500, 1.0, 0.3), white=1.0)
POSE = Pose(shift_x=0.4, shift_y=-0.2, roll_mrad=2.0, scale=0.002)


@pytest.fixture(scope="module")
def hologram() -> PlacedHologram:
    return PlacedHologram(DISPLAY, TARGET, POSE, iterations=20)


def test_where_the_mask_is_known_it_sees_what_the_model_sees(hologram):
    model = HologramModel(replace(DISPLAY, displacement=hologram.displacement), [TARGET])
    model._field[:] = np.nan  # whatever work arrays held before
    expected = compare(model.seen(hologram.slm[None]), model.wanted(), model.peaks[0]).psnr_db
    assert hologram.psnr_db(POSE) == pytest.approx(expected, abs=0.15)


def test_what_is_not_known_costs_more_the_more_it_is(hologram):
    at = hologram.psnr_db(POSE)
    for changes in (
        [{"z_um": z} for z in (40.0, 150.0)],
        [{"z_um": -z} for z in (40.0, 150.0)],
        [{"pitch_mrad": t} for t in (60.0, 200.0)],
        [{"shift_x": POSE.shift_x + s} for s in (0.3, 0.8)],
    ):
        little, much = (hologram.psnr_db(POSE.with_(**change)) for change in changes)
        assert at > little > much
    error = np.zeros((13, 23, 2))
    error[..., 1] = 0.3
    assert hologram.psnr_db(POSE, error) == pytest.approx(hologram.psnr_db(POSE.with_(shift_x=0.7)), abs=1e-6)


@pytest.mark.parametrize(
    "pose",
    [
        POSE,
        POSE.with_(z_um=120.0),
        POSE.with_(z_um=-120.0),
        POSE.with_(z_um=60.0, pitch_mrad=60.0, yaw_mrad=-40.0),
    ],
)
def test_the_simulated_bench_shows_the_same_loss(hologram, pose):
    """Other code, twice the sampling: its picture is as good as predicted."""
    pitch = DISPLAY.mask_pitch_um
    spec = DisplaySpec(
        slm_pitch_um=16.0, focal_mm=35.0, sensor_shape=(192, 192), sensor_pitch_um=5775 / 192,
        magnification=pose.scale, dc_power=0.1, dc_phase_rad=0.6,
    )  # fmt: skip
    optics = ScatteringDisplay(spec, np.pi * DISPLAY.mask.levels)
    place = MaskPose(
        pose.shift_x * pitch, pose.shift_y * pitch, pose.z_um, pose.roll_mrad, pose.pitch_mrad, pose.yaw_mrad
    )
    seen = optics.irradiance(np.angle(hologram.slm), place)
    model = HologramModel(DISPLAY, [TARGET])
    wanted = np.asarray(model.wanted(), float)
    image = low_pass(
        np.fft.ifftshift(cv2.resize(seen, wanted.shape[::-1], interpolation=cv2.INTER_AREA)), SHAPE
    )
    found = compare(np.fft.fftshift(image), wanted, model.peaks[0]).psnr_db
    assert hologram.psnr_db(pose) == pytest.approx(found, abs=1.0)


def test_light_lost_between_slm_pixels_is_not_asked_for():
    """Half a mask pixel off, a quarter of the cells see two pixels along each axis and lose light."""
    for dc, pose in ((0.0, Pose(0.5, 0.5)), (0.2, Pose(0.5, 0.5)), (0.0, Pose(30.0, 0.0))):
        display = replace(
            DISPLAY, dc=DcTerm(dc, 0.6), mask_fill=0.0, displacement=pose.displacement(DISPLAY.mask.shape)
        )
        model = HologramModel(display, [TARGET])
        phases = np.random.default_rng(0).uniform(0, 2 * np.pi, (1, *SHAPE))
        assert model.intensity(np.exp(1j * phases)).mean() == pytest.approx(1.0, rel=0.03)
    far = replace(DISPLAY, displacement=Pose(shift_x=5000.0).displacement(DISPLAY.mask.shape))
    with pytest.raises(InputError, match="sees nothing of the SLM"):
        HologramModel(far, [TARGET])
