"""A second program that opens the same devices is refused with the name and process of the first."""

from __future__ import annotations

import errno
import json
import os
import secrets
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.common.checked import given_up
from drivers.device import Device, DriverOptions, port_claim
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.registry.claim import PLACE_VARIABLE, Claim, DeviceBusyError, holder_of
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template
from instrument.bench.safety import StepsFailedError
from tests.mocks.devices import MockDevice, MockStage, MockWorld

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
    monkeypatch.setenv(PLACE_VARIABLE, str(tmp_path / "locks"))


def bench_on(*ports: str) -> Bench:
    kinds = ("camera", "stage", "led_array")
    text = "".join(f'[{k}]\ndriver = "mock"\nport = "{p}"\n' for k, p in zip(kinds, ports, strict=True))
    return Bench(parse_config(text, None))


def other_program(resource: str, **environment: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, resource],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
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


@pytest.mark.parametrize("name", ["home", "close"])
def test_a_device_whose_call_hangs_is_not_opened_anew_before_it_ends(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """By another bench of this program neither: what comes back late would stop what that one has begun."""
    port, let_go = "/dev/ttyMOCK7", threading.Event()
    bench = bench_on("none", port, "none").open()
    stage = bench.devices["stage"]
    with monkeypatch.context() as hangs:
        hangs.setattr("drivers.common.checked.call_limit_s", lambda _, call: 0.05 if call == name else 30.0)
        if name == "close":
            hangs.setattr("instrument.bench.bench.STOP_ANSWER_S", 0.05)
        hangs.setattr(MockStage, name, lambda _: let_go.wait(20))
        with pytest.raises((DeviceTimeoutError, StepsFailedError), match=r"hangs: (home|closing)"):
            bench.stage.home() if name == "home" and bench.stage else bench.close()
        if name == "home":
            bench.close()
    for _ in range(2):
        with pytest.raises(DeviceTimeoutError, match=r"^stage \(mock\): still hangs: (home|closing) has not"):
            bench_on("none", port, "none").open()
    with pytest.raises(DeviceBusyError):  # as another program would be told
        Claim(port_claim(port), "stage")
    let_go.set()
    for call in given_up(stage):
        call.join(5)
    with bench_on("none", port, "none").open() as again:
        assert again.stage is not None
        assert again.stage.is_open
    Claim(port_claim(port), "stage").release()


def test_programs_know_of_each_other_whatever_folder_for_temporary_files_they_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PLACE_VARIABLE)
    resource = f"port of this test {secrets.token_hex(8)}"
    (tmp_path / "other").mkdir()
    holder = other_program(resource, TMPDIR=str(tmp_path / "other"))
    try:
        with pytest.raises(DeviceBusyError, match=f"process {holder.pid}"):
            Claim(resource, "stage")
    finally:
        holder.kill()
        holder.communicate()
    Claim(resource, "stage").release()  # what a killed program leaves keeps nobody out


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("first_is_other", [True, False])
def test_two_users_exclude_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first_is_other: bool
) -> None:
    """In the machine's own folder of locks, each with its own ``TMPDIR``, whoever made the lock's file."""
    monkeypatch.delenv(PLACE_VARIABLE)
    resource = f"port of two users {secrets.token_hex(8)}"
    nobody = 65534
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\nimport os, encodings.idna, socket\n" + (
        "from drivers.registry.claim import Claim, DeviceBusyError\n"
        f"os.setgid({nobody}); os.setuid({nobody})\n"
        "try:\n    claim = Claim(sys.argv[1], 'stage')\nexcept DeviceBusyError as error:\n"
        "    print(error, flush=True)\nelse:\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )

    def other() -> tuple[subprocess.Popen[str], str]:
        process = subprocess.Popen(
            [sys.executable, "-c", code, resource],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        )
        assert process.stdout is not None
        return process, process.stdout.readline()

    if first_is_other:
        holder, said = other()
        try:
            assert said == "held\n"
            with pytest.raises(DeviceBusyError, match=f"process {holder.pid}"):
                Claim(resource, "stage")
        finally:
            holder.kill()
            holder.communicate()
        Claim(resource, "stage").release()  # what a killed program of somebody else leaves keeps nobody out
    else:
        claim = Claim(resource, "stage")
        process, said = other()
        process.communicate()
        assert f"process {os.getpid()}" in said
        claim.release()
        process, said = other()  # the file is still the first one's
        process.communicate()
        assert said == "held\n"


def test_who_holds_a_device_is_said_when_it_is_a_child_of_a_program_that_ended_or_elsewhere(
    tmp_path: Path,
) -> None:
    claim = Claim("port a", "stage")
    (path,) = (tmp_path / "locks").iterdir()
    for change, words in (
        ({"pid": 2**22 + 1}, "which has ended"),
        ({"host": "box"}, "process [0-9]+ on box"),
    ):
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
        with pytest.raises(DeviceBusyError, match=words):
            Claim("port a", "stage")
    claim.release()


def test_a_folder_of_locks_that_cannot_serve_is_said(tmp_path: Path) -> None:
    (tmp_path / "locks").touch()
    with pytest.raises(DeviceError, match=r"cannot be kept in .*locks: not a folder.*chmod 1777"):
        Claim("port a", "stage")


@pytest.mark.parametrize("puts", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/etc/passwd")])
def test_what_another_user_puts_in_a_locks_place_is_said_and_not_waited_for(
    tmp_path: Path, puts: Callable[[Path], object]
) -> None:
    Claim("port /dev/x", "stage").release()
    (path,) = (tmp_path / "locks").iterdir()
    path.unlink()
    puts(path)
    with pytest.raises(DeviceError, match=rf"cannot be kept in {path}: .*that holds nothing else"):
        Claim("port /dev/x", "stage")
    assert holder_of("port /dev/x") is None


def test_a_holder_who_does_not_say_who_it_is_is_another_program(tmp_path: Path) -> None:
    half = {"program": "x", "host": "h", "since": "now"}
    with other_program("port /dev/x"):
        (path,) = (tmp_path / "locks").iterdir()
        for signed in (
            "[1]",
            "[" * 100_000,
            half,
            half | {"pid": "7"},
            half | {"pid": 7, "host": "\x1b[31m"},
        ):
            path.write_text(signed if isinstance(signed, str) else json.dumps(signed))
            with pytest.raises(DeviceBusyError, match="in use by another program, which has just begun"):
                Claim("port /dev/x", "stage")


def test_a_claim_that_cannot_be_signed_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        with pytest.raises(DeviceError, match=r"cannot be kept in .*\.lock: No space left"):
            Claim("port /dev/x", "stage")
    Claim("port /dev/x", "stage").release()


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


def test_a_device_opened_alone_is_claimed_and_each_of_its_resources(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_on("none", "/dev/ttyMOCK3", "none")
    bench.open_device("stage")
    with pytest.raises(DeviceBusyError):
        Claim(port_claim("/dev/ttyMOCK3"), "another")
    bench.close()
    shared = {"camera": ("one",), "stage": ("one", "two"), "led_array": ()}
    monkeypatch.setattr(
        MockDevice,
        "claims",
        classmethod(lambda cls, _: shared[cls.kind]),  # a bus, and a line of its own
    )
    with bench_on("none", "none", "none").open() as bench:
        assert [claim.resource for claim in bench._claims] == ["one", "two"]
