"""Over a pseudo-terminal: garbage, half and late replies, silence, STOP, a pulled cable."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from drivers.common.framing import Belongs, LineFramer, reply_line, reply_until
from drivers.common.serial_transport import SerialTransport
from drivers.device import port_claim
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, StoppedError
from drivers.registry.claim import Claim
from tests.mocks.pty_device import Answer, PtyDevice

PONG = reply_line(rb"PONG")
PROBE = (b"PING\n", PONG)


def value(line: bytes) -> list[Answer]:
    """A device that repeats a number: ``GET 7`` is answered by ``VALUE 7``."""
    if line == b"PING":
        return [b"PONG\n"]
    if line.startswith(b"GET "):
        return [b"VALUE " + line[4:] + b"\r\n"]
    return []


def get(port: SerialTransport, number: int, timeout_s: float | None = None) -> bytes:
    return port.request(b"GET %d\n" % number, reply_line(rb"VALUE \d+"), timeout_s)[0]


@pytest.fixture
def device(tmp_path: Path) -> Iterator[PtyDevice]:
    device = PtyDevice(tmp_path, value)
    yield device
    device._stopping.set()


@pytest.fixture
def port(device: PtyDevice) -> Iterator[SerialTransport]:
    port = SerialTransport(str(device.link), "stage (test)", probe=PROBE, timeout_s=5.0)
    port.open()
    yield port
    port.close()


def test_each_reply_belongs_to_its_command_whatever_thread_asks(port: SerialTransport) -> None:
    wrong: list[tuple[int, bytes]] = []

    def ask(first: int) -> None:
        for number in range(first, first + 30):
            if (reply := get(port, number)) != b"VALUE %d" % number:
                wrong.append((number, reply))

    threads = [threading.Thread(target=ask, args=(1000 * k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert port.unmatched == 0


def test_a_late_reply_is_not_taken_for_the_next_commands(device: PtyDevice, port: SerialTransport) -> None:
    device.answer = lambda line: [0.3, *value(line)] if line == b"GET 1" else value(line)
    with pytest.raises(DeviceTimeoutError, match=r"stage \(test\): did not answer 'GET 1"):
        get(port, 1, timeout_s=0.1)
    assert get(port, 2) == b"VALUE 2"
    assert get(port, 3) == b"VALUE 3"
    assert port.unmatched == 1  # the late one


def test_a_reply_after_ctrl_c_is_not_taken_for_the_next_commands(
    device: PtyDevice, port: SerialTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert get(port, 0) == b"VALUE 0"
    device.answer = lambda line: [0.3, *value(line)] if line == b"GET 1" else value(line)

    def interrupted(*_: object) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(port._changed, "wait_for", interrupted)
        with pytest.raises(KeyboardInterrupt):
            get(port, 1)
    assert get(port, 2) == b"VALUE 2"
    assert get(port, 3) == b"VALUE 3"


def test_a_driver_that_chokes_on_a_message_is_told_of_at_once(device: PtyDevice) -> None:
    def choke(message: bytes) -> None:
        float(message)

    port = SerialTransport(str(device.link), "stage (test)", timeout_s=20.0, on_message=choke)
    port.open()
    device.answer = lambda _: [b"no number\n"]
    began = time.monotonic()
    with pytest.raises(DeviceError, match="no number"):
        get(port, 1)
    assert time.monotonic() - began < 15
    port.close()


def test_a_port_that_is_lost_while_bytes_drain_is_named(
    port: SerialTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drain() -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(port._serial, "flush", drain)
    with pytest.raises(DeviceError, match="was lost on"):
        get(port, 1)
    assert not port.is_open


def test_silence_is_a_timeout_that_says_what_came_so_far(device: PtyDevice, port: SerialTransport) -> None:
    device.answer = lambda line: [b"part one\npart tw"] if line == b"LIST" else value(line)
    with pytest.raises(DeviceTimeoutError, match=r"so far: 'part one'.*Check its power, cable"):
        port.request(b"LIST\n", reply_until(rb"ok"), 0.2)
    assert get(port, 4) == b"VALUE 4"  # the half line is forgotten


def test_garbage_between_replies_is_passed_over(device: PtyDevice, port: SerialTransport) -> None:
    device.answer = lambda line: [b"\xff\x00\xfe\n*** boot ***\r\n", *value(line)]
    assert [get(port, n) for n in (1, 2)] == [b"VALUE 1", b"VALUE 2"]
    assert port.unmatched >= 4


def test_messages_of_no_command_are_handed_on(device: PtyDevice) -> None:
    heard: list[bytes] = []
    port = SerialTransport(str(device.link), "stage (test)", on_message=heard.append)
    port.open()
    try:
        device.send(b"ALARM:1\r\n")
        assert get(port, 5) == b"VALUE 5"
        assert heard == [b"ALARM:1"]
    finally:
        port.close()


def test_a_device_that_never_stops_talking_is_an_error_not_a_hang(
    device: PtyDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "drivers.common.serial_transport._QUIET_S", 1.0
    )  # no pause of a busy machine is that long
    port = SerialTransport(str(device.link), "stage (test)", probe=PROBE, timeout_s=0.2)
    port.open()
    babbling = threading.Event()

    def babble() -> None:
        while not babbling.wait(0.01):
            device.send(b"x" * 10)

    thread = threading.Thread(target=babble)
    thread.start()
    try:
        with pytest.raises(DeviceTimeoutError, match="sends without end"):
            get(port, 1)
    finally:
        babbling.set()
        thread.join()
        port.close()


def test_stop_overtakes_a_reply_that_is_awaited(device: PtyDevice, port: SerialTransport) -> None:
    device.answer = lambda line: [] if line == b"MOVE" else value(line)
    caught: list[BaseException] = []

    def move() -> None:
        try:
            port.request(b"MOVE\n", reply_line(rb"ok"), 60)
        except DeviceError as error:
            caught.append(error)

    thread = threading.Thread(target=move)
    thread.start()
    while b"MOVE" not in device.received:
        time.sleep(0.005)
    waiting = threading.Thread(target=move)  # behind the first
    waiting.start()
    time.sleep(0.05)
    port.overtake(b"!\n")
    thread.join(10)
    waiting.join(10)
    assert not thread.is_alive()
    assert [type(error) for error in caught] == [StoppedError, StoppedError]
    assert device.received.count(b"MOVE") == 1
    assert get(port, 6) == b"VALUE 6"
    assert b"!" in device.received


def test_a_pulled_cable_is_named_and_reconnecting_restores_the_settings(
    device: PtyDevice, port: SerialTransport
) -> None:
    settings: list[bytes] = []

    def answer(line: bytes) -> list[Answer]:
        if line.startswith(b"SET "):
            settings.append(line)
            return [] if line == b"SET b" and len(settings) > 2 else [b"ok\n"]
        return value(line)

    device.answer = answer

    def setting(name: bytes) -> None:
        port.request(b"SET " + name + b"\n", reply_line(rb"ok"), 0.3)

    for name in (b"a", b"b"):
        setting(name)
        port.remember(name.decode(), lambda name=name: setting(name))
    device.unplug()
    with pytest.raises(DeviceError, match=r"was lost on .*ttyTEST.*reconnect"):
        get(port, 1)
    assert not port.is_open
    with pytest.raises(DeviceError, match="no port"):
        port.reconnect()
    device.plug_in()
    assert port.reconnect() == ("b",)
    assert settings[2:] == [b"SET a", b"SET b"]
    assert get(port, 7) == b"VALUE 7"


def test_a_cable_pulled_while_a_reply_is_awaited_ends_the_wait(
    device: PtyDevice, port: SerialTransport
) -> None:
    get(port, 1)
    device.answer = lambda _: []
    timer = threading.Timer(0.1, device.unplug)
    timer.start()
    began = time.monotonic()
    with pytest.raises(DeviceError) as caught:
        get(port, 2, timeout_s=60)
    assert not isinstance(caught.value, DeviceTimeoutError)
    assert time.monotonic() - began < 30
    timer.join()


HOLDER = """
import sys
from drivers.registry.claim import Claim
claim = Claim(sys.argv[1], "stage")
print("held", flush=True)
sys.stdin.read()
"""


def test_a_port_has_one_owner_and_the_second_is_told_whose_it_is(
    device: PtyDevice, port: SerialTransport
) -> None:
    second = SerialTransport(str(device.link), "led_array (test)")
    with pytest.raises(DeviceError, match="another program"):
        second.open()
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, port_claim(str(device.link))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DeviceError, match=rf"in use by .*process {holder.pid}"):
            second.open()
    finally:
        holder.kill()
        holder.communicate()
    port.close()
    second.open()
    second.close()


@pytest.mark.parametrize("how", ["lock", "TIOCEXCL"])
def test_a_port_that_this_program_has_claimed_but_another_holds_is_not_blamed_on_this_one(
    device: PtyDevice, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    mine = SerialTransport(str(device.link), "stage (test)")
    claim = Claim(port_claim(str(device.link)), "stage")
    other = os.open(device.link, os.O_RDWR | os.O_NOCTTY)
    try:
        if how == "lock":
            fcntl.flock(other, fcntl.LOCK_EX)
        else:  # which does not keep root out: so what the kernel tells everybody else

            def busy(*_: object, **__: object) -> None:
                raise serial.SerialException(errno.EBUSY, "could not open port: Device or resource busy")

            monkeypatch.setattr(serial, "Serial", busy)
        with pytest.raises(DeviceError, match=r"in use by another program.*fuser") as caught:
            mine.open()
        assert "this program" not in str(caught.value)
    finally:
        os.close(other)
        claim.release()


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    port = SerialTransport(str(tmp_path / "ttyNONE"), "stage (test)")
    with pytest.raises(DeviceError, match=r"no port .*ttyNONE.*plugged in"):
        port.open()
    with pytest.raises(DeviceNotOpenError):
        port.send_now(b"!")
    port.close()


def test_closing_ends_a_wait_and_leaves_no_thread(device: PtyDevice, port: SerialTransport) -> None:
    get(port, 0)
    device.answer = lambda _: []
    timer = threading.Timer(0.1, port.close)
    timer.start()
    with pytest.raises(StoppedError):
        get(port, 1, timeout_s=60)
    timer.join()
    assert not [t for t in threading.enumerate() if t.name.startswith("reader of")]


def test_lines_are_cut_wherever_the_bytes_fall() -> None:
    data = b"\r\none\r\n\r\ntwo\nthr"
    for step in range(1, len(data) + 1):
        framer = LineFramer()
        lines = [line for i in range(0, len(data), step) for line in framer.feed(data[i : i + step])]
        assert lines == [b"one", b"two"]
        assert framer.feed(b"ee\n") == [b"three"]


def test_a_line_without_end_is_dropped_whole() -> None:
    framer = LineFramer(longest=10)
    assert framer.feed(b"x" * 8) == []
    assert framer.feed(b"x" * 8) == []
    assert framer.feed(b"tail\ngood\n") == [b"good"]


def test_replies_of_many_lines() -> None:
    matcher = reply_until(rb"ok|error:\d+", rb"\[.*\]")
    assert [matcher(m) for m in (b"[VER]", b"<Idle>", b"ok", b"error:9")] == [
        Belongs.PART,
        Belongs.OTHER,
        Belongs.END,
        Belongs.END,
    ]


def test_the_reply_to_an_overtaking_command_is_nobodys(device: PtyDevice, port: SerialTransport) -> None:
    device.answer = lambda line: [0.05, b"VALUE 99\r\n"] if line == b"OFF" else value(line)
    assert get(port, 1) == b"VALUE 1"
    port.overtake(b"OFF\n", answered=True)
    assert [get(port, n) for n in (2, 3)] == [b"VALUE 2", b"VALUE 3"]
    assert port.unmatched == 1


def test_replies_to_probes_that_came_late_are_not_taken_for_the_next_commands(device: PtyDevice) -> None:
    slow = [True]

    def answer(line: bytes) -> list[Answer]:
        # As a board that boots: what it was sent meanwhile is answered all at once.
        if slow[0] and line == b"PING":
            slow[0] = False
            return [0.5, b"PONG\n"]
        return value(line)

    device.answer = answer
    port = SerialTransport(str(device.link), "stage (test)", probe=PROBE, timeout_s=0.2)
    port.open()
    try:
        assert port.request(b"PING\n", PONG) == [b"PONG"]
        assert port.unmatched == 2  # of the three attempts
        assert get(port, 5) == b"VALUE 5"
    finally:
        port.close()
