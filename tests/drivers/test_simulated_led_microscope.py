"""The devices of the simulated LED array microscope keep the contracts, and its images the laws of optics."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.device import Device
from drivers.simulated.camera_settings import CameraOptions
from drivers.simulated.led_microscope import (
    LedMicroscopeOptions,
    LedMicroscopeWorld,
    MicroscopeCamera,
    MicroscopeLedArray,
    MicroscopeLedOptions,
    led_image,
)
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from instrument.plan.led_shapes import HalfCircle


def small_world(time_scale: float = 0.0) -> LedMicroscopeWorld:
    return LedMicroscopeWorld(LedMicroscopeOptions(pixels=64, time_scale=time_scale))


class TestMicroscopeCamera(CameraContract):
    def make(self) -> Device:
        world = small_world(0.1)
        world.light_leds(np.zeros((1, 2)), np.ones((1, 3)))
        return MicroscopeCamera(CameraOptions(), world)


class TestMicroscopeLedArray(LedArrayContract):
    def make(self) -> Device:
        return MicroscopeLedArray(MicroscopeLedOptions(), small_world())


def test_bright_field_is_even_and_dark_field_dark_without_relief() -> None:
    flat = np.zeros((48, 64))
    sines = np.array([[0.0, 0.0], [0.05, -0.05], [0.2, 0.0]])
    image = led_image(flat, 1.6, sines, np.array([1.0, 2.0, 4.0]), wavelength_nm=515.0, na=0.1)
    np.testing.assert_allclose(image, 3.0, rtol=1e-5)


def test_a_prism_sends_the_light_towards_its_slope() -> None:
    """A phase that rises along +x deflects light towards +x, into or out of the pupil."""
    x = np.arange(128) * 1.6
    prism = np.tile(2 * np.pi * 6 / (128 * 1.6) * x, (32, 1))  # six whole waves: periodic
    tangent = 6 / (128 * 1.6) * 0.515
    edge = 0.1 - tangent / 2
    towards, away = (
        led_image(prism, 1.6, np.array([[side, 0.0]]), np.ones(1), wavelength_nm=515.0, na=0.1).mean()
        for side in (edge, -edge)
    )
    assert towards == pytest.approx(1.0, rel=1e-4)  # its light goes towards -x, and is brought back
    assert away == pytest.approx(0.0, abs=1e-6)


def test_the_array_lights_the_sample() -> None:
    world = small_world()
    array = MicroscopeLedArray(MicroscopeLedOptions(), world)
    array.open()
    assert world.photons_per_s((1.0, 1.0, 1.0)) is None
    array.set_pattern(HalfCircle("left", 0.13).on(array, (0, 255, 0)))
    left = world.photons_per_s((1.0, 1.0, 1.0))
    array.set_pattern(HalfCircle("right", 0.13).on(array, (0, 255, 0)))
    right = world.photons_per_s((1.0, 1.0, 1.0))
    assert left is not None
    assert right is not None
    slope = np.gradient(world.true_height_um(), axis=1)
    assert np.corrcoef((right - left).ravel(), slope.ravel())[0, 1] > 0.9
    array.close()
    assert world.photons_per_s((1.0, 1.0, 1.0)) is None
