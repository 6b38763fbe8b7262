"""``diffuserbench devices --probe``: a serial device is recognised for what it is, by no other driver."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from drivers.apt.stage import AptStage
from drivers.grbl.stage import GrblStage
from drivers.illuminate.led_array import IlluminateLedArray
from drivers.registry import buses, registry
from drivers.registry.registry import list_devices
from drivers.zaber.stage import ZaberStage
from instrument.bench.config_file import load_config
from instrument.files.errors import ConfigError
from tests.mocks.grbl_controller import GrblController
from tests.mocks.illuminate_emulator import IlluminateEmulator
from tests.mocks.pty_device import PtyDevice
from tests.mocks.zaber_chain import ZaberChain

DRIVERS = {"apt": AptStage, "grbl": GrblStage, "zaber": ZaberStage, "illuminate": IlluminateLedArray}
"""In the order in which they are asked."""


def grbl(folder: Path) -> PtyDevice:
    return GrblController(folder)


def illuminate(folder: Path) -> PtyDevice:
    return IlluminateEmulator(folder)


def zaber(folder: Path) -> PtyDevice:
    return ZaberChain(folder).port


def modem(folder: Path) -> PtyDevice:
    """What is no device of ours: it echoes, and complains."""
    return PtyDevice(folder, lambda line: [line + b"\r\n", b"ERROR\r\n"])


@pytest.fixture
def plugged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., PtyDevice]]:
    with ExitStack() as stack:

        def plug_in(make: Callable[[Path], PtyDevice]) -> PtyDevice:
            device = make(tmp_path)
            stack.callback(device.unplug)
            port = SimpleNamespace(
                device=str(device.link),
                description="n/a",
                manufacturer=None,
                product=None,
                serial_number=None,
                vid=None,
                pid=None,
            )
            monkeypatch.setattr(list_ports, "comports", lambda: [port])
            # Those that take part; starting Qt to look at displays takes longer than all probes.
            monkeypatch.setattr(registry, "_drivers", lambda _: iter(DRIVERS.items()))
            return device

        yield plug_in


@pytest.mark.parametrize("make", [grbl, illuminate, zaber], ids=lambda make: make.__name__)
def test_each_device_is_recognised_for_what_it_is(
    plugged_in: Callable[..., PtyDevice], make: Callable[[Path], PtyDevice]
) -> None:
    device = plugged_in(make)
    (found,) = (found for found in list_devices(probe=True).found if found.bus == "serial")
    assert found.driver == make.__name__
    assert f'port = "{device.link}"' in found.bench_lines()
    assert ":" not in found.description


@pytest.mark.parametrize("make", [grbl, illuminate, zaber], ids=lambda make: make.__name__)
def test_the_lines_name_the_port_as_it_stays_and_pass_the_check_or_say_what_to_fill_in(
    plugged_in: Callable[..., PtyDevice],
    make: Callable[[Path], PtyDevice],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = tmp_path / "by-id" / "usb-Maker_Board_12345-if00"
    link.parent.mkdir()
    link.symlink_to(plugged_in(make).link)
    monkeypatch.setattr(buses, "_LASTING_LINKS", (link.parent,))
    (found,) = (found for found in list_devices(probe=True).found if found.bus == "serial")
    lines = found.bench_lines()
    assert f'port = "{link}"' in lines
    bench = tmp_path / "bench.toml"
    bench.write_text(f'[camera]\ndriver = "simulated"\n{lines}\n')
    if found.note:
        with pytest.raises(ConfigError, match="microstep_um"):
            load_config(bench)
        assert "# fill in microstep_um" in lines
        bench.write_text(bench.read_text().replace("microstep_um = 0.0", "microstep_um = 0.05"))
    load_config(bench)


def test_another_device_is_nobodys(plugged_in: Callable[..., PtyDevice]) -> None:
    plugged_in(modem)
    listed = list_devices(probe=True)
    (found,) = (found for found in listed.found if found.bus == "serial")
    assert found.driver is None
    assert [sentence for sentence in listed.unavailable if "ttyTEST" in sentence] == []
