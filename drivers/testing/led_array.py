"""What every LED array must do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.errors import LimitError
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.testing.device import DeviceContract, check_sequences


class LedArrayContract(DeviceContract):
    """Tests for every LED array; ``make`` gives a closed one."""

    kind = "led_array"

    @pytest.fixture
    def leds(self) -> Iterator[LedArray]:
        device = self.make()
        assert isinstance(device, LedArray)
        with device:
            yield device

    def test_dark_after_opening_and_after_closing(self) -> None:
        device = self.make()
        assert isinstance(device, LedArray)
        with device:
            assert device.pattern.is_dark
            device.set_pattern(device.single(0))
            assert not device.pattern.is_dark
        with device:
            assert device.pattern.is_dark

    def test_places_and_angles_belong_together(self, leds: LedArray) -> None:
        places, angles = leds.led_positions_mm, leds.led_na
        assert places.shape == (len(places), 3)
        assert angles.shape == (len(places), 2)
        assert np.all(np.hypot(*angles.T) < 1)
        # The farther out an LED, the more oblique its light, towards the same side.
        order = np.argsort(np.hypot(places[:, 0], places[:, 1]))
        assert np.all(np.diff(np.hypot(*angles.T)[order]) > -1e-9)
        assert np.all(places[:, :2] * angles >= -1e-12)

    def test_wavelengths_are_red_green_blue(self, leds: LedArray) -> None:
        red, green, blue = leds.wavelengths_nm
        assert 700 > red > green > blue > 400

    def test_shows_what_it_is_asked_for(self, leds: LedArray) -> None:
        count = len(leds.led_positions_mm)
        for pattern in (
            leds.single(count - 1, (10, 20, 30)),
            _inside(leds, 0.3),
            LedPattern.of_mask("left", leds.led_na[:, 0] < 0, (255, 255, 255)),
            LedPattern("two", ((0, (255, 0, 0)), (count // 2, (0, 0, 255)))),
        ):
            assert leds.set_pattern(pattern) == pattern == leds.pattern

    def test_off_is_dark(self, leds: LedArray) -> None:
        leds.set_pattern(_inside(leds, 0.5))
        leds.off()
        assert leds.pattern.is_dark
        leds.off()

    @pytest.mark.parametrize("rgb", [(256, 0, 0), (0, -1, 0)])
    def test_wrong_levels_are_refused_and_the_pattern_stays(
        self, leds: LedArray, rgb: tuple[int, int, int]
    ) -> None:
        shown = leds.set_pattern(leds.single(0))
        with pytest.raises(LimitError, match="level"):
            leds.set_pattern(LedPattern("wrong", ((0, rgb),)))
        assert leds.pattern == shown

    def test_wrong_leds_are_refused_and_the_pattern_stays(self, leds: LedArray) -> None:
        shown = leds.set_pattern(leds.single(0))
        for index in (-1, len(leds.led_positions_mm)):
            with pytest.raises(LimitError, match=f"LED {index}"):
                leds.set_pattern(LedPattern("wrong", ((index, (1, 1, 1)),)))
        assert leds.pattern == shown

    def test_a_sequence_ends_dark_and_wrong_ones_are_refused(self, leds: LedArray) -> None:
        patterns = [leds.single(0), OFF, leds.single(0)]
        check_sequences(leds, patterns)
        if leds.sequence_limits is not None:
            assert leds.pattern.is_dark


def _inside(leds: LedArray, na: float) -> LedPattern:
    return LedPattern.of_mask(f"inside {na:g}", np.hypot(*leds.led_na.T) <= na, (255, 255, 255))
