"""What every spatial light modulator must do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.errors import LimitError
from drivers.slm import Slm
from drivers.testing.device import DeviceContract, check_sequences


class SlmContract(DeviceContract):
    """Tests for every SLM; ``make`` gives a closed one."""

    kind = "slm"

    @pytest.fixture
    def slm(self) -> Iterator[Slm]:
        device = self.make()
        assert isinstance(device, Slm)
        with device:
            yield device

    def test_blank_after_opening(self) -> None:
        device = self.make()
        assert isinstance(device, Slm)
        with device:
            assert not device.displayed.any()
            device.display(np.full(device.shape, 7, np.uint8))
        with device:
            assert not device.displayed.any()

    def test_shows_every_level_exactly(self, slm: Slm) -> None:
        levels = (np.arange(np.prod(slm.shape)) % 256).astype(np.uint8).reshape(slm.shape)
        slm.display(levels)
        np.testing.assert_array_equal(slm.displayed, levels)
        assert not slm.displayed.flags.writeable

    def test_keeps_its_own_copy(self, slm: Slm) -> None:
        levels = np.full(slm.shape, 9, np.uint8)
        slm.display(levels)
        levels[:] = 0
        assert np.all(slm.displayed == 9)

    def test_wrong_images_are_refused_and_the_old_one_stays(self, slm: Slm) -> None:
        slm.display(np.full(slm.shape, 5, np.uint8))
        height, width = slm.shape
        for wrong in (
            np.zeros((height, width + 1), np.uint8),
            np.zeros((height, width, 3), np.uint8),
            np.zeros((height, width), np.float32),
        ):
            with pytest.raises(LimitError, match="uint8"):
                slm.display(wrong)  # type: ignore[arg-type]
        assert np.all(slm.displayed == 5)

    def test_blank_shows_zeros(self, slm: Slm) -> None:
        slm.display(np.full(slm.shape, 5, np.uint8))
        slm.blank()
        assert not slm.displayed.any()

    def test_a_sequence_ends_with_what_was_shown_and_wrong_ones_are_refused(self, slm: Slm) -> None:
        slm.display(np.full(slm.shape, 5, np.uint8))
        check_sequences(slm, [np.full(slm.shape, level, np.uint8) for level in (0, 255)])
        assert np.all(slm.displayed == 5)

    def test_pitch_and_settling_are_given(self, slm: Slm) -> None:
        assert slm.pixel_pitch_um > 0
        assert slm.settle_ms >= 0
