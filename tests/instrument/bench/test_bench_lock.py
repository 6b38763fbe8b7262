"""A second program that opens the same devices is refused with the name and process of the first."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from drivers.device import Device, DriverOptions, port_claim
from drivers.registry.claim import Claim, DeviceBusyError
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template
from tests.mocks.devices import MockWorld

pytestmark = pytest.mark.usefixtures("mock_drivers", "own_locks")

ROOT = Path(__file__).parents[3]
HOLDER = """
import sys
from drivers.registry.claim import Claim
claim = Claim(sys.argv[1], "stage")
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def bench_on(*ports: str) -> Bench:
    kinds = ("camera", "stage", "led_array")
    text = "".join(f'[{k}]\ndriver = "mock"\nport = "{p}"\n' for k, p in zip(kinds, ports, strict=True))
    return Bench(parse_config(text, None))


def other_program(resource: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, resource],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_program_is_refused_before_it_touches_anything() -> None:
    holder = other_program(port_claim("/dev/ttyMOCK1"))
    try:
        bench = bench_on("none", "/dev/ttyMOCK1", "none")
        with pytest.raises(DeviceBusyError) as caught:
            bench.open()
        assert f"process {holder.pid}" in str(caught.value)
        assert "/dev/ttyMOCK1" in str(caught.value)
        assert "stage (mock)" in str(caught.value)
        world = bench.shared["mock"]
        assert isinstance(world, MockWorld)
        assert not [call for call in world.calls if call.endswith(".open")]
    finally:
        holder.kill()
        holder.communicate()
    with bench_on("none", "/dev/ttyMOCK1", "none").open():
        pass


def test_two_benches_of_one_program_exclude_each_other_too(tmp_path: Path) -> None:
    port = tmp_path / "ttyMOCK"
    port.touch()
    link = tmp_path / "by-id"
    link.symlink_to(port)
    with bench_on("none", str(port), "none").open():
        with pytest.raises(DeviceBusyError, match="this program"):
            bench_on("none", str(link), "none").open()
        with bench_on("/dev/ttyOTHER", "none", "none").open():
            pass
    with bench_on("none", str(link), "none").open():
        pass


def test_a_bench_that_fails_to_open_gives_its_devices_free() -> None:
    text = '[camera]\ndriver = "mock"\nport = "/dev/ttyMOCK2"\nfail = ["open"]\n'
    for _ in range(2):
        with pytest.raises(Exception, match="open failed"):
            Bench(parse_config(text, None)).open()
    Claim(port_claim("/dev/ttyMOCK2"), "camera").release()


def test_devices_are_claimed_by_driver_and_options_unless_the_driver_knows_better() -> None:
    class Options(DriverOptions):
        serial: str

    class Some(Device):
        pass

    same = [Some.claims(Options(serial=serial)) for serial in ("a", "a", "b")]
    assert same[0] == same[1] != same[2]
    simulated = parse_config(template(), None)
    assert all(device.driver.claims(device.options) == () for device in simulated.devices.values())
