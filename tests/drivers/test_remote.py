"""Devices on another computer: the contract suites over loopback."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.device import Device
from drivers.remote.camera import RemoteCamera
from drivers.remote.light_and_motion import RemoteLedArray, RemoteSlm, RemoteStage
from drivers.remote.options import RemoteOptions
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from drivers.testing.slm import SlmContract
from drivers.testing.stage import StageContract
from instrument.bench.config_file import parse_config

BENCH = """
[simulated]
preset = "tiny"
time_scale = 0.05
scene = "none"
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[slm]
driver = "simulated"
shape = [60, 80]
"""
TOKEN = "a-token-for-tests"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RemoteOptions]:
    pytest.importorskip("aiohttp", reason='pip install "diffuserbench[remote]"')
    from instrument.serve.server import BenchServer, Serving

    file = tmp_path_factory.mktemp("served") / "token"
    file.write_text(f"{TOKEN}\n")
    with BenchServer(parse_config(BENCH, None), Serving(token=TOKEN, port=0)) as server:
        yield RemoteOptions(url=server.url, token_file=str(file))


class Over:
    """Makes devices of a server on loopback."""

    driver: type[Device]

    @pytest.fixture(autouse=True)
    def _served(self, served: RemoteOptions) -> None:
        self._options = served

    def make(self) -> Device:
        return self.driver(self._options)


class TestCamera(Over, CameraContract):
    driver = RemoteCamera


class TestStage(Over, StageContract):
    driver = RemoteStage


class TestLedArray(Over, LedArrayContract):
    driver = RemoteLedArray


class TestSlm(Over, SlmContract):
    driver = RemoteSlm
