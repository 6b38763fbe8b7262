"""Auto-exposure: right level, no saturated pixel, few frames, and honest words when it cannot."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration_routines.psf.exposure import (
    AutoExposure,
    ExposureOutcome,
    TooDarkError,
    auto_expose,
    expose_patterns,
    hot_pixels,
    measure_exposure,
)
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import LedPattern
from recon.arrays import Float64Array

BITS = 12
FULL = (1 << BITS) - 1
BLACK = 100.0
SHAPE = (120, 160)


class LinearCamera:
    """Linear 12-bit sensor with photon and read noise in front of a given light (counts per millisecond)."""

    def __init__(
        self,
        light: Float64Array,
        exposure_ms: float = 10.0,
        limits_ms: tuple[float, float] = (0.01, 10_000.0),
        flicker: Callable[[int], float] = lambda _: 1.0,
    ) -> None:
        self.light, self._exposure_ms, self.exposure_limits_ms = light, exposure_ms, limits_ms
        self.flicker, self.frames, self.random = flicker, 0, np.random.default_rng(1)

    @property
    def exposure_ms(self) -> float:
        return self._exposure_ms

    def set_exposure_ms(self, exposure_ms: float) -> float:
        shortest, longest = self.exposure_limits_ms
        assert shortest <= exposure_ms <= longest, "the limits were not respected"
        self._exposure_ms = exposure_ms
        return exposure_ms

    def snap(self) -> Frame:
        signal = self.light * self._exposure_ms * self.flicker(self.frames)
        noisy = BLACK + signal + self.random.normal(size=SHAPE) * np.sqrt(0.2 * signal + 4.0)
        self.frames += 1
        metadata = FrameMetadata(
            frame_id=self.frames,
            device_time_ns=None,
            host_time_ns=0,
            utc=datetime.now(UTC),
            exposure_ms=self._exposure_ms,
            gain=1.0,
            pixel_format="Mono12",
            significant_bits=BITS,
            black_level=BLACK,
            roi=(0, 0, *SHAPE),
            binning=1,
        )
        return Frame(np.clip(np.round(noisy), 0, FULL).astype(np.uint16), metadata)


def caustic(peak_counts_per_ms: float = 50.0) -> Float64Array:
    """A pattern whose brightest pixels stand not far above its 99.9th percentile."""
    random = np.random.default_rng(0)
    light = random.random(SHAPE) ** 3
    return peak_counts_per_ms * light / light.max()


def assert_safe(result: AutoExposure, camera: LinearCamera) -> None:
    assert camera.exposure_ms == result.exposure_ms
    for _ in range(20):
        assert camera.snap().image.max() < FULL


@pytest.mark.parametrize("start_ms", [0.02, 1.0, 30.0, 60.0, 5_000.0])
def test_it_reaches_the_target_from_too_dark_right_and_saturated_starts(start_ms: float) -> None:
    camera = LinearCamera(caustic(), start_ms)
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.REACHED
    assert len(result.trace) <= 8
    level = (np.percentile(camera.snap().image, 99.9) - BLACK) / (FULL - BLACK)
    assert level == pytest.approx(0.7, rel=0.12)
    assert_safe(result, camera)


def test_a_linear_sensor_needs_two_frames_once_it_has_seen_signal() -> None:
    assert len(auto_expose(LinearCamera(caustic(), 20.0)).trace) == 2


def test_a_few_bright_pixels_hold_the_exposure_below_saturation() -> None:
    light = caustic()
    light[40, 50:53] = 500.0  # 3 of 19200 pixels: far above the 99.9th percentile
    camera = LinearCamera(light)
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.HELD_BY_BRIGHTEST_PIXEL
    assert result.usable
    assert 0.75 < result.trace[-1].brightest <= 0.9
    assert_safe(result, camera)


def test_the_ceiling_holds_where_the_percentile_alone_would_be_right() -> None:
    light = caustic()
    percentile = float(np.percentile(light, 99.9))
    light[40, 50:53] = 0.95 / 0.7 * percentile  # 95 % of full scale with the percentile at its target
    camera = LinearCamera(light, 0.7 * (FULL - BLACK) / percentile)
    result = auto_expose(camera)
    assert result.usable
    assert result.trace[0].level == pytest.approx(0.7, rel=0.05)
    assert result.trace[0].saturated_pixels == 0
    assert result.trace[-1].brightest <= 0.9
    assert len(result.trace) > 1


def test_known_hot_pixels_do_not_hold_the_exposure() -> None:
    light = caustic()
    dark = np.zeros(SHAPE)
    dark[3, 4] = dark[70, 80] = 1e6
    hot = hot_pixels(LinearCamera(dark, 10.0).snap().image, FULL)
    assert np.argwhere(hot).tolist() == [[3, 4], [70, 80]]
    result = auto_expose(LinearCamera(light + dark), hot=hot)
    assert result.outcome is ExposureOutcome.REACHED
    assert result.hot_pixels == 2
    assert auto_expose(LinearCamera(light + dark)).outcome is ExposureOutcome.TOO_BRIGHT


def test_a_weak_source_is_called_too_dark_at_the_longest_exposure() -> None:
    camera = LinearCamera(caustic(0.1), 10.0, (0.01, 1000.0))
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.TOO_DARK
    assert not result.usable
    assert camera.exposure_ms == 1000.0
    assert "longest exposure" in result.message


def test_a_strong_source_is_called_too_bright_at_the_shortest_exposure() -> None:
    camera = LinearCamera(caustic(1e6), 10.0)
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.TOO_BRIGHT
    assert not result.usable
    assert camera.exposure_ms == 0.01
    assert "saturate" in result.message
    assert len(result.trace) <= 8


def test_darkness_ends_at_the_longest_exposure() -> None:
    assert auto_expose(LinearCamera(np.zeros(SHAPE))).outcome is ExposureOutcome.TOO_DARK


def test_a_hot_pixel_in_the_dark_is_no_light_and_the_exposure_stays() -> None:
    dark = np.zeros(SHAPE)
    dark[60, 80] = 0.5
    camera = LinearCamera(dark, 20.0)
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.NO_LIGHT
    assert not result.usable
    assert (result.exposure_ms, camera.exposure_ms) == (20.0, 20.0)
    assert "hot" in result.message
    dark[60, 81] = 0.2  # as a spot of light has neighbours
    assert auto_expose(LinearCamera(dark, 20.0)).outcome is ExposureOutcome.HELD_BY_BRIGHTEST_PIXEL


def test_a_flickering_source_is_given_up_and_named() -> None:
    camera = LinearCamera(caustic(), flicker=lambda frame: (1.0, 0.3)[frame % 2])
    result = auto_expose(camera)
    assert result.outcome is ExposureOutcome.UNSTEADY
    assert len(result.trace) == 20


def test_colour_frames_and_masks_of_another_shape() -> None:
    frame = LinearCamera(caustic()).snap()
    colour = Frame(np.stack([frame.image] * 3, axis=-1), frame.metadata)
    assert measure_exposure(colour, 10.0) == measure_exposure(frame, 10.0)
    with pytest.raises(ValueError, match=r"mask is \(3, 3\), but the frame is \(120, 160\)"):
        measure_exposure(frame, 10.0, np.zeros((3, 3), bool))


def test_a_target_above_the_ceiling_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at most 0\.9 of full scale, not 0\.95"):
        auto_expose(LinearCamera(caustic()), target=0.95)


def test_all_patterns_have_one_exposure_by_the_brightest_of_them() -> None:
    spots, light = np.zeros((2, *SHAPE)), np.zeros(SHAPE)
    spots[0, 10:20, 10:20], spots[1, 30:40, 10:20] = 40.0, 4.0  # counts per ms
    camera = LinearCamera(light)

    class Leds:
        def set_pattern(self, pattern: LedPattern) -> None:
            light[...] = sum(spots[n] * rgb[0] / 255 for n, rgb in pattern.levels)

        def off(self) -> None:
            light[...] = 0

    bench: Any = SimpleNamespace(camera=camera, led_array=Leds(), scene_off=lambda: 0, source_off=lambda: 0)
    white = (255, 255, 255)
    bright, dim = LedPattern("bright", ((0, white),)), LedPattern("dim", ((1, white),))
    span = 4095 - BLACK
    for patterns, counts_per_ms in (([dim, bright], 40.0), ([dim], 4.0)):
        found_ms = expose_patterns(bench, patterns)
        assert found_ms * counts_per_ms / span == pytest.approx(0.7, rel=0.05)
        assert not light.any()
    spots[:] /= 1e9
    with pytest.raises(TooDarkError):
        expose_patterns(bench, [dim])
