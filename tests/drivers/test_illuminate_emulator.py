"""The Illuminate emulator under Ramona Optics' client (pyilluminate, BSD), which speaks to firmware 1."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.mocks.illuminate_emulator import IlluminateEmulator


def test_pyilluminate_lights_it(tmp_path: Path) -> None:
    library: Any = pytest.importorskip("pyilluminate", reason="pip install pyilluminate (pulls in pandas)")
    emulator = IlluminateEmulator(tmp_path, "1.32")
    array = library.Illuminate(serial_number="12", reboot_on_start=False, use_lock=False, open_device=False)
    array.serial.port = str(emulator.link)  # it would look for a USB device otherwise
    try:
        array.open()
        assert array.version == "1.32"
        assert array.led_count == 257
        assert json.loads(array.parameters_json)["device_name"] == "sci-round"
        np.testing.assert_allclose(array.led_positions[100, 2], emulator.places_mm[100, 0] / 1e3)
        array.color = (200, 100, 7)
        array.led = [3, 5, 256]
        assert emulator.lit.sum(axis=1).nonzero()[0].tolist() == [3, 5, 256]
        assert emulator.lit[5].tolist() == [200, 100, 7]
        array.ask("na.30")
        assert emulator.na == 0.3
        array.ask("ssl.4")
        assert emulator.sequence_length == 4
        with pytest.raises(NotImplementedError, match="not implemented yet"):
            array.ask("warp")
        array.clear()
        assert not emulator.lit.any()
    finally:
        array.close()
        emulator.unplug()
    assert emulator.corrupted == []
