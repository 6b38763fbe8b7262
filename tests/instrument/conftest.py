"""The mock drivers, registered for a test as an installed package's would be."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from drivers.registry import registry

MOCK_DRIVERS = {
    "mock.camera": "tests.mocks.devices:MockCamera",
    "mock.stage": "tests.mocks.devices:MockStage",
    "mock.led_array": "tests.mocks.devices:MockLedArray",
    "mock.slm": "tests.mocks.devices:MockSlm",
    "absent.stage": "a_package_that_is_not_installed:Stage",
}


@pytest.fixture
def mock_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = registry._points()
    points = tuple(EntryPoint(name, value, registry.GROUP) for name, value in MOCK_DRIVERS.items())
    monkeypatch.setattr(registry, "_points", lambda: installed + points)
