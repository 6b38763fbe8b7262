"""The mask's place from all light of photographs, made by optics that share no code with the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import Display, random_mask
from recon.holography.camera_map import CameraMap
from recon.holography.learn import Look
from recon.holography.place import FittedPlace, fit_place
from recon.holography.pose import NODES, Pose
from recon.holography.target import band_of
from recon.optics.scattering_display import DisplaySpec, MaskPose, ScatteringDisplay

SHAPE, K = (40, 56), 4
DISPLAY = Display(
    SHAPE,
    random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=3),
    mask_fill=1.0,
    focal_mm=35.0,
)
TRUE = Pose(shift_x=0.9, shift_y=-0.6, roll_mrad=2.0, scale=0.002, z_um=25.0, pitch_mrad=3.0)
PITCH_UM = 40.0
REST = np.zeros((*NODES, 2))


def looks(count: int, *, noise: float = 0.0, shake_px: float = 0.0, **errors: float) -> list[Look]:
    """Photograph random phases; the picture's place on the camera changes by ``shake_px``."""
    rng = np.random.default_rng(1)
    spec = DisplaySpec(
        slm_pitch_um=DISPLAY.slm_pitch_um,
        mask_pitch_um=DISPLAY.mask_pitch_um,
        magnification=TRUE.scale,
        dc_power=0.1,
        dc_phase_rad=0.6,
        sensor_shape=(180, 180),
        sensor_pitch_um=PITCH_UM,
        **errors,
    )
    place = MaskPose(
        TRUE.shift_x * DISPLAY.mask_pitch_um,
        TRUE.shift_y * DISPLAY.mask_pitch_um,
        TRUE.z_um,
        TRUE.roll_mrad,
        TRUE.pitch_mrad,
        TRUE.yaw_mrad,
    )
    band = band_of(DISPLAY)
    found = []
    for _ in range(count):
        phases = rng.uniform(0, 2 * np.pi, SHAPE)
        offset = tuple(PITCH_UM * shake_px * rng.normal(size=2))
        optics = ScatteringDisplay(
            replace(spec, sensor_offset_um=offset), np.pi * DISPLAY.mask.levels.astype(float)
        )
        frame = optics.irradiance(phases, place)
        frame = frame + noise * rng.normal(size=frame.shape)
        camera = CameraMap(frame.shape, spec.field_um / PITCH_UM, np.zeros((10, 2)))
        found.append(Look(np.exp(1j * phases), camera.lags(frame, band)))
    return found


def pulls(found: FittedPlace) -> np.ndarray:
    """Return errors of depth and tilts, and of the mean shift, over their uncertainties."""
    deep = np.array([found.pose.z_um - TRUE.z_um, found.pose.pitch_mrad - TRUE.pitch_mrad])
    return np.concatenate([deep / found.deep_error[:2], left(found)[:2] / found.field.error[:2]])


def left(found: FittedPlace) -> np.ndarray:
    """Return what is left of the start's error, in a pose's vector."""
    return START.vector() + found.field.change - TRUE.vector()


START = Pose(shift_x=0.5, shift_y=-0.35, roll_mrad=1.0, scale=0.001)


@pytest.mark.parametrize(("noise", "shake_px"), [(0.0, 0.0), (0.1, 0.3)])
def test_it_is_found_to_a_hundredth_of_a_pixel_and_the_uncertainty_holds(noise: float, shake_px: float):
    found = fit_place(DISPLAY, looks(3, noise=noise, shake_px=shake_px), START, REST)
    assert found.after < 0.5 * found.before
    assert np.abs(left(found)[:2]).max() < 0.04
    assert np.abs(pulls(found)).max() < 4
    assert abs(found.dc) == pytest.approx(np.sqrt(0.1 / 0.9), abs=0.04)
    assert np.angle(found.dc) == pytest.approx(0.6, abs=0.1)


def test_steps_go_on_until_none_moves_by_what_it_is_uncertain_by():
    """Three steps, whatever they moved, ended up to 9 uncertainties off."""
    seen = looks(3, noise=0.02)
    found = fit_place(DISPLAY, seen, START.with_(z_um=-30.0), REST)
    again = fit_place(DISPLAY, seen, found.pose.plus(found.field.change), REST + found.field.rest)
    moved = [
        getattr(again.pose, name) - getattr(found.pose, name) for name in ("z_um", "pitch_mrad", "yaw_mrad")
    ]
    assert (np.abs(moved) < 0.2 * found.deep_error).all()


def test_another_display_is_not_explained():
    other = replace(DISPLAY, mask=random_mask(DISPLAY.mask.shape, seed=4))
    assert fit_place(other, looks(2), START, REST).after > 0.7  # what shade the field has, any does


def test_one_photograph_tells_no_uncertainty():
    with pytest.raises(InputError, match="at least 2 photographs, not 1"):
        fit_place(DISPLAY, looks(1), START, REST)
