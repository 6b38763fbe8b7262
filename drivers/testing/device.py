"""What every device must do, whatever its kind. Subclass, say how to make one, run: done."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from drivers.device import Device
from drivers.errors import DeviceError, DeviceNotOpenError, LimitError
from drivers.sequence import PlaysSequences


class DeviceContract:
    """Tests for every device; subclasses give ``make`` and ``kind``."""

    kind: str

    def make(self) -> Device:
        """Construct a closed device, ready to be opened."""
        raise NotImplementedError

    def test_constructing_opens_nothing(self) -> None:
        device = self.make()
        assert not device.is_open
        assert self.kind in device.name

    def test_a_closed_device_refuses_in_words(self) -> None:
        device = self.make()
        with pytest.raises(DeviceNotOpenError, match=self.kind):
            device.settings()
        with pytest.raises(DeviceNotOpenError):
            _ = device.identity

    def test_opens_and_closes_as_often_as_one_likes(self) -> None:
        device = self.make()
        device.close()
        for _ in range(2):
            device.open()
            device.open()
            assert device.is_open
            device.close()
            device.close()
            assert not device.is_open

    def test_context_manager_closes_after_an_error(self) -> None:
        device = self.make()
        assert _fails_inside(device)
        assert not device.is_open

    def test_identity_is_complete(self) -> None:
        with self.make() as device:
            identity = device.identity
        assert identity.kind == self.kind
        assert all((identity.driver, identity.vendor, identity.model))
        assert identity.simulated == ("SIMULATED" in str(identity))

    def test_settings_have_plain_values(self) -> None:
        with self.make() as device:
            settings = device.settings()
        assert settings
        for name, value in settings.items():
            assert isinstance(value, str | int | float | bool | tuple | None), name


def _fails_inside(device: Device) -> bool:
    try:
        with device:
            assert device.is_open
            raise RuntimeError("on purpose")
    except RuntimeError as error:
        return str(error) == "on purpose"


def check_sequences(device: PlaysSequences[Any], patterns: Sequence[Any]) -> None:
    """Hold a device to what it says of its sequences; one that plays none refuses them."""
    limits = device.sequence_limits
    if limits is None:
        with pytest.raises(LimitError, match="plays no sequences"):
            device.arm(patterns, 100.0)
        return
    with pytest.raises(DeviceError, match="no sequence"):
        device.play()
    with pytest.raises(LimitError):
        device.arm([], 100.0)
    with pytest.raises(LimitError):
        device.arm(patterns, limits.shortest_ms / 2)
    with pytest.raises(LimitError):
        device.arm(patterns, 100.0, limits.outputs)
    period_ms = max(5.0, limits.shortest_ms)
    assert device.arm(patterns, period_ms) >= period_ms
    device.play()
    device.play()
