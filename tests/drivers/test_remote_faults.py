"""Devices on another computer over a network that breaks, and with those who may not use them."""

from __future__ import annotations

import asyncio
import base64
import io
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason='pip install "diffuserbench[remote]"')

import aiohttp
import numpy as np
import numpy.typing as npt

from drivers.errors import DeviceError, DeviceLostError, StoppedError
from drivers.led_array import LedPattern
from drivers.registry.claim import DeviceBusyError
from drivers.remote import link
from drivers.remote.camera import RemoteCamera
from drivers.remote.light_and_motion import RemoteLedArray, RemoteSlm, RemoteStage
from drivers.remote.options import RemoteOptions
from drivers.remote.wire import LONGEST_REQUEST, OPERATOR_HEADER, Values
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.bench.safety import StepsFailedError
from instrument.files.errors import BenchError
from instrument.serve import server as serving
from instrument.serve.operation import Operation, Operator
from instrument.serve.server import BenchServer, Serving
from tests.drivers.test_remote import BENCH, TOKEN
from tests.mocks.bad_network import BadNetwork
from tests.mocks.waiting import until

PATIENCE_S = 20.0
# In real time: a move is still under way when the network breaks.
CONFIG = parse_config(BENCH.replace("time_scale = 0.05", "time_scale = 0.2").partition("[slm]")[0], None)
LIT = LedPattern("LED 0", ((0, (255, 255, 255)),))


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def server(said: list[str]) -> Iterator[BenchServer]:
    with BenchServer(CONFIG, Serving(token=TOKEN, port=0, lost_after_s=1.0), said.append) as server:
        yield server


@pytest.fixture
def network(server: BenchServer) -> Iterator[BadNetwork]:
    with BadNetwork(int(server.url.rpartition(":")[2])) as network:
        yield network


@pytest.fixture
def options(network: BadNetwork, tmp_path: Any) -> RemoteOptions:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    url = f"http://127.0.0.1:{network.port}"
    return RemoteOptions(url=url, token_file=str(tmp_path / "token"), lost_after_s=1.0)


def served_bench(server: BenchServer) -> Bench:
    bench = server.operation._bench
    assert bench is not None
    return bench


def in_thread(call: Callable[[], Any]) -> tuple[threading.Thread, list[BaseException]]:
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:  # noqa: BLE001 - looked at by the test
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


def test_an_alarm_that_locks_a_stage_afar_is_told_and_unlocked(
    server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RemoteStage(options) as stage:
        assert not stage.needs_unlocking
        with pytest.raises(DeviceError, match="has no lock"):
            stage.unlock()
        locked = ["by an alarm"]
        served = type(served_bench(server).stage)
        monkeypatch.setattr(served, "needs_unlocking", property(lambda _stage: bool(locked)))
        monkeypatch.setattr(served, "unlock", lambda _stage: locked.clear())
        assert stage.needs_unlocking
        stage.unlock()
        assert not stage.needs_unlocking


@pytest.mark.parametrize("how", ["cut", "silent", "server ends"])
def test_a_lost_operator_leaves_no_light_and_no_motion(
    how: str, server: BenchServer, network: BadNetwork, options: RemoteOptions, said: list[str]
) -> None:
    camera, stage, leds = RemoteCamera(options), RemoteStage(options), RemoteLedArray(options)
    for device in (camera, stage, leds):
        device.open()
    stage.home()
    leds.set_pattern(LIT)
    camera.start_sequence()
    camera.next_frame(PATIENCE_S)
    bench = served_bench(server)
    carriage, light = bench.stage.carriage, []  # type: ignore[union-attr]
    low, high = stage.limits["x_um"]
    off = bench.led_array.off  # type: ignore[union-attr]
    bench.led_array.off = lambda: (off(), light.append(bench.led_array.pattern.is_dark))  # type: ignore
    moving, errors = in_thread(lambda: stage.move_to({"x_um": high if stage.position()["x_um"] < 0 else low}))
    assert until(lambda: carriage.is_moving)
    if how == "cut":
        network.cut()
    elif how == "silent":
        network.silent = True
    else:
        server.close()
    moving.join(PATIENCE_S)
    assert until(lambda: server.operation.operator is None)
    assert light[0]
    assert not carriage.is_moving
    assert not any(device.is_open for device in bench.devices.values())
    # Of a server that ends either comes first: what became of the move, or that the server goes.
    if isinstance(errors[0], StoppedError):
        assert how == "server ends"
    else:
        assert isinstance(errors[0], DeviceLostError)
        assert ("its server was ended" in str(errors[0])) == (how == "server ends")
    with pytest.raises(DeviceLostError):
        leds.set_pattern(LIT)
    with pytest.raises(DeviceLostError):  # after those that had come
        [camera.next_frame(1.0) for _ in range(9)]
    assert not any(device.is_open for device in (camera, stage, leds))
    assert not camera.is_streaming
    if how == "cut":
        assert any("was lost: light off, motion stopped" in sentence for sentence in said)
        leds.open()
        assert leds.pattern.is_dark
        leds.close()
    for device in (camera, stage, leds):
        device.close()


@pytest.mark.parametrize("stop", [False, True], ids=["a setting", "a stop"])
def test_a_call_that_begins_when_the_hold_was_lost_has_an_end(
    network: BadNetwork, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch, stop: bool
) -> None:
    """Nothing ended the request of a call that had been let through just before, nor that of a stop."""
    leds = RemoteLedArray(options)
    leds.open()
    held, look = leds._link, leds._link._wait

    def lost(work: Any) -> Any:
        network.silent = True
        assert until(lambda: held.failure is not None)
        return look(work)

    monkeypatch.setattr(held, "_wait", lost)
    calling, errors = in_thread(leds.off if stop else lambda: leds.set_pattern(LIT))
    calling.join(PATIENCE_S)
    monkeypatch.undo()
    assert isinstance(errors[0], DeviceLostError)
    leds.close()


@pytest.mark.parametrize(
    "failure", [DeviceError("stage", "does not answer."), OSError("Input/output error")], ids=["said", "raw"]
)
def test_a_device_that_fails_when_asked_for_its_facts_is_closed_and_told_of(
    options: RemoteOptions, said: list[str], monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    """Its connection was said to be lost, and the operator's other devices were closed with it."""

    def fails(*_: Any) -> None:
        raise failure

    leds, stage = RemoteLedArray(options), RemoteStage(options)
    leds.open()
    monkeypatch.setattr(serving, "said_facts", fails)
    with pytest.raises(DeviceError, match=r"does not answer|failed when opened: Input/output") as told:
        stage.open()
    assert not isinstance(told.value, DeviceLostError)
    leds.set_pattern(LIT)  # is held as before
    assert not any("lost" in sentence for sentence in said)
    monkeypatch.undo()
    stage.open()
    stage.close()
    leds.close()


def test_a_command_that_a_stop_has_overtaken_is_not_carried_out(
    network: BadNetwork, options: RemoteOptions
) -> None:
    with RemoteLedArray(options) as leds:
        network.held = b"POST /api/devices/led_array/set_pattern"
        late, errors = in_thread(lambda: leds.set_pattern(LIT))
        assert network.is_holding.wait(PATIENCE_S)
        leds.off()
        network.let_pass()
        late.join(PATIENCE_S)
        assert isinstance(errors[0], StoppedError)
        assert "overtaken by a stop" in str(errors[0])
        assert leds.pattern.is_dark
        leds.set_pattern(LIT)
        assert not leds.pattern.is_dark


def test_a_slow_network_loses_frames_and_counts_them_and_a_stop_does_not_wait(
    network: BadNetwork, options: RemoteOptions
) -> None:
    with RemoteCamera(options) as camera, RemoteStage(options) as stage:
        stage.home()
        camera.set_exposure_ms(1.0)
        camera.start_sequence(4)
        camera.next_frame(PATIENCE_S)
        network.bytes_per_s = 20 * camera.image_shape[0] * camera.image_shape[1]
        frames = [camera.next_frame(PATIENCE_S).metadata for _ in range(8)]
        assert sum(metadata.dropped_before for metadata in frames) > 0
        for before, metadata in pairwise(frames):
            assert metadata.frame_id == before.frame_id + 1 + metadata.dropped_before
        network.bytes_per_s = 1000.0  # the frame under way now takes longer than the test
        moving, errors = in_thread(lambda: stage.move_to({"x_um": stage.limits["x_um"][0]}))
        assert until(lambda: stage.is_moving)
        stage.stop()
        moving.join(PATIENCE_S)
        assert isinstance(errors[0], StoppedError)
        network.bytes_per_s = float("inf")


def test_the_end_of_a_sequence_is_not_that_of_the_next_one(
    server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = serving._stop_sequence

    def late(camera: Any) -> None:
        time.sleep(0.3)
        stop(camera)

    monkeypatch.setattr(serving, "_stop_sequence", late)
    with RemoteCamera(options) as camera:
        camera.set_exposure_ms(1.0)
        for _ in range(2):
            camera.start_sequence()
            camera.next_frame(PATIENCE_S)
            camera.stop_sequence()
        camera.start_sequence()
        until_s = time.monotonic() + 0.6
        while time.monotonic() < until_s:
            camera.next_frame(PATIENCE_S)
        assert camera.is_streaming
    assert until(lambda: server.operation.operator is None)


def test_pieces_that_are_none_end_the_sequence_in_words(
    options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "pieces", lambda frame, number: [b"another version's"])
    with RemoteCamera(options) as camera:
        camera.start_sequence()
        with pytest.raises(DeviceLostError, match="broke during a sequence: no piece of a frame"):
            camera.next_frame(PATIENCE_S)


def test_stop_says_what_could_not_be_made_safe_though_nobody_operates(server: BenchServer) -> None:
    server.operation.stop("somebody")
    server.operation.trouble = "The LED array: off failed."
    with pytest.raises(BenchError, match="off failed"):
        server.operation.stop("somebody")


def test_frames_are_handed_out_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever stands between: proxies may hand messages on in another order than they came."""
    from types import SimpleNamespace

    from drivers.remote.wire import pieces
    from tests.mocks.devices import MockCamera, MockOptions, MockWorld, MockWorldOptions

    class Stream:
        def __init__(self, messages: list[Any]) -> None:
            self._messages = iter(messages)

        def __aiter__(self) -> Stream:
            return self

        async def __anext__(self) -> Any:
            for message in self._messages:
                return message
            raise StopAsyncIteration

    with MockCamera(MockOptions(), MockWorld(MockWorldOptions())) as taken:
        frames = [taken.snap() for _ in range(4)]
    monkeypatch.setattr("drivers.remote.wire._PIECE_BYTES", 500)
    sent = [piece for number, frame in enumerate(frames) for piece in pieces(frame, number)]
    assert len(sent) > 12
    np.random.default_rng(3).shuffle(sent)
    messages = [SimpleNamespace(type=aiohttp.WSMsgType.BINARY, data=bytes(piece)) for piece in sent]
    camera = RemoteCamera(RemoteOptions())
    camera._link.require = lambda: None  # type: ignore[method-assign]
    camera._link.begin = lambda work: work.close()  # type: ignore[method-assign]
    camera._stream = stream = Stream(messages)  # type: ignore[assignment]
    asyncio.run(camera._receive(stream))  # type: ignore[arg-type]
    for frame in frames:
        came = camera._ring.popleft()
        assert came.metadata.frame_id == frame.metadata.frame_id
        np.testing.assert_array_equal(came.image, frame.image)


# Who may, and who may not ---
def test_there_is_one_operator_at_a_time_until_somebody_presses_stop(
    server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    leds, other = RemoteLedArray(options), RemoteStage(options)
    leds.open()
    with pytest.raises(DeviceBusyError, match="is open in this program already"):
        RemoteLedArray(options).open()
    with pytest.raises(DeviceError, match=r"there is none on .* That bench has camera, stage, led_array"):
        RemoteSlm(options).open()
    monkeypatch.setattr(link, "_OPERATOR", "another")
    with pytest.raises(
        DeviceBusyError, match=r"is operated by .*process \d+\) since .* one operator at a time"
    ):
        other.open()
    leds.set_pattern(LIT)
    server.operation.stop("somebody at the page")
    with pytest.raises(StoppedError, match="STOP was pressed by somebody at the page"):
        assert until(lambda: leds.pattern is None)
    other.open()
    other.close()
    leds.close()


def test_a_call_that_comes_after_the_stop_and_before_its_message_is_told_of_the_stop(
    server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    leds = RemoteLedArray(options)
    leds.open()
    told = threading.Event()
    parted = serving._part

    async def late(*args: Any) -> None:
        while not told.is_set():
            await asyncio.sleep(0.005)
        await parted(*args)

    monkeypatch.setattr(serving, "_part", late)
    server.operation.stop("somebody at the page")
    with pytest.raises(StoppedError, match="STOP was pressed by somebody at the page"):
        leds.set_pattern(LIT)
    told.set()
    with suppress(StoppedError):  # the message may come meanwhile
        leds.close()
    monkeypatch.undo()
    leds.open()
    leds.close()
    with pytest.raises(DeviceLostError, match="is not open for this program any more"):
        server.operation.device("led_array", link._OPERATOR)


def test_calls_that_come_after_the_stop_are_not_kept() -> None:
    operation = Operation(parse_config(BENCH, None), lambda _: None)
    operator = Operator("key", "somebody")
    operation.take("led_array", operator, lambda _: None)
    operation.stop("a hand")
    depths = []
    for _ in range(3):
        with pytest.raises(StoppedError, match="STOP was pressed by a hand") as refused:
            operation.device("led_array", "key")
        depths.append(len(list(traceback.walk_tb(refused.value.__traceback__))))
    assert depths == depths[:1] * 3, "what was raised again holds the calls before"


def test_a_server_whose_terminal_is_closed_opens_and_closes_as_ever() -> None:
    def closed(_: str) -> None:
        raise BrokenPipeError

    def gone(_: DeviceError) -> None:
        raise RuntimeError("Event loop is closed")

    operation = Operation(parse_config(BENCH, None), closed)
    operator = Operator("key", "somebody")
    device = operation.take("led_array", operator, lambda _: None)
    assert operation.operator == operator
    operation.let_go("led_array", operator)
    assert not device.is_open
    device = operation.take("led_array", operator, gone)
    with pytest.raises(RuntimeError, match="loop is closed"):
        operation.stop("a hand")
    assert not device.is_open
    assert operation.operator is None


def test_a_stop_that_fails_and_holders_who_cannot_be_told_hide_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[str] = []

    def gone(reason: DeviceError) -> None:
        told.append(reason.problem)
        raise RuntimeError("Event loop is closed")

    def stuck(_: Bench) -> None:
        raise StepsFailedError([("light off", DeviceError("led_array", "does not answer."))])

    operation = Operation(parse_config(BENCH, None), lambda _: None)
    operator = Operator("key", "somebody")
    for kind in ("led_array", "stage"):
        operation.take(kind, operator, gone)
    monkeypatch.setattr(Bench, "stop", stuck)
    with pytest.raises(RuntimeError, match="loop is closed"):
        operation.stop("a hand")
    assert told == ["STOP was pressed by a hand."] * 2
    assert "light off" in operation.trouble


@pytest.mark.parametrize("how", ["let_go", "drop"])
def test_pieces_that_come_while_their_sender_leaves_are_not_kept(
    how: str, server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    leaves = getattr(server.operation, how)

    def late(*args: Any) -> None:
        operator = server.operation.operator
        assert operator is not None
        server._uploads.add(f"{operator.key} led_array", "7", 5, 0, b"ab")
        leaves(*args)

    monkeypatch.setattr(server.operation, how, late)
    leds = RemoteLedArray(options)
    leds.open()
    if how == "drop":
        server.operation.stop("a test")
    leds.close()
    assert until(lambda: not server._uploads._waiting)


def _said_to_be(descr: str, *shape: int) -> str:
    """Return an array's file that says to be so, and has eight bytes."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return base64.b64encode(file.getvalue() + bytes(8)).decode()


def test_an_operator_who_is_long_in_leaving_does_not_end_the_next_ones_frames(
    server: BenchServer, options: RemoteOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "_CLOSING_S", 0.1)
    filming, left = threading.Event(), threading.Event()
    part, after = serving._part, server._after

    async def once_another_films(*args: Any) -> None:
        await asyncio.to_thread(filming.wait, 30)
        await part(*args)

    async def told(*args: Any) -> None:
        left.set()  # of the hold that is ended, its camera's frames too
        await after(*args)

    monkeypatch.setattr(serving, "_part", once_another_films)
    monkeypatch.setattr(server, "_after", told)

    def film() -> None:
        with RemoteCamera(options) as camera:
            camera.start_sequence(4)
            camera.next_frame(10.0)
            filming.set()
            while not left.is_set():
                camera.next_frame(10.0)
            for _ in range(30):  # more than are under way
                camera.next_frame(2.0)

    async def stopped_and_silent() -> None:
        headers = {"Authorization": f"Bearer {TOKEN}", OPERATOR_HEADER: "other"}
        async with (
            aiohttp.ClientSession(server.url, headers=headers) as session,
            session.ws_connect("/api/devices/camera/hold", protocols=("diffuserbench",)) as hold,
        ):
            await hold.receive()
            await asyncio.to_thread(server.operation.stop, "a test")
            await asyncio.to_thread(film)  # nobody answers the hold's closing

    asyncio.run(stopped_and_silent())


def test_without_the_token_nothing_is_answered(
    server: BenchServer, options: RemoteOptions, tmp_path: Any
) -> None:
    async def ask(verb: str, path: str, **named: Any) -> tuple[int, str]:
        async with (
            aiohttp.ClientSession(server.url) as session,
            session.request(verb, path, **named) as reply,
        ):
            return reply.status, await reply.text()

    with_token = {"Authorization": f"Bearer {TOKEN}", OPERATOR_HEADER: "me"}
    for verb, path in (
        ("GET", "/api/state"),
        ("POST", "/api/stop"),
        ("PUT", "/api/devices/led_array/off"),
        ("GET", "/api/devices/camera/hold"),
        ("GET", "/api/devices/camera/frames"),
    ):
        for headers in (
            {},
            {"Authorization": "Bearer wrong"},
            {"Authorization": "Bearer \udcff"},  # a byte that is no UTF-8
            {"Sec-WebSocket-Protocol": "diffuserbench"},
        ):
            status, text = asyncio.run(ask(verb, path, headers=headers))
            assert status == 401, path
            assert "needs its token" in text
    for verb, path, status, words in (
        ("GET", "/api/devices/laser/fire", 400, "is none of camera"),
        ("GET", "/api/devices/stage/move_to", 404, "takes no GET move_to"),
        ("POST", "/api/devices/stage/__init__", 404, "takes no POST __init__"),
        ("POST", "/api/devices/stage/close", 404, "takes no POST close"),
        ("GET", "/api/devices/stage/position", 404, "takes no GET position"),
        ("POST", "/api/devices/stage/position", 409, "is not open for this program"),
        ("GET", "/api/devices/camera/frames?n_buffers=4&window=0", 400, "never begins"),
        ("GET", "/api/state", 200, "simulated"),
    ):
        assert asyncio.run(ask(verb, path, headers=with_token))[0] == status, path
        assert words in asyncio.run(ask(verb, path, headers=with_token))[1]
    with RemoteLedArray(options):
        headers = with_token | {OPERATOR_HEADER: link._OPERATOR}
        for data in (b"{", b'{"pattern": 3}', b'{"colour": 1}', b"{}", b"[]"):
            status, text = asyncio.run(
                ask("POST", "/api/devices/led_array/set_pattern", headers=headers, data=data)
            )
            assert (status, "does not understand" in text) == (400, True), text
        for path, data, status, words in (
            ("led_array/set_pattern", io.BytesIO(b" " * (LONGEST_REQUEST + 1)), 413, "over the network"),
            ("led_array/set_pattern", b"[" * 100_000, 400, "nested too deep"),
        ):
            found = asyncio.run(ask("POST", f"/api/devices/{path}", headers=headers, data=data))
            assert (found[0], words in found[1]) == (status, True), found
    with pytest.raises(ValueError, match="bytes, and 8 came"):
        Values(npt.NDArray[np.uint8]).load(_said_to_be("|u1", 1 << 21, 1 << 21))
    with pytest.raises(ValueError, match="OBJECT"):
        Values(npt.NDArray[np.uint8]).load(_said_to_be("|O", 1))
    for broken in (b"{(", b"'''", b"{[]: 1}", b"-" * 9000):  # NumPy reads them as Python
        file = b"\x93NUMPY\x01\x00" + len(broken).to_bytes(2, "little") + broken
        with pytest.raises(ValueError, match="does not begin as one"):
            Values(npt.NDArray[np.uint8]).load(base64.b64encode(file))
    (tmp_path / "token").write_text("another-word-than-its")
    with pytest.raises(DeviceError, match=r"does not take the token in .*token"):
        RemoteLedArray(options).open()
    with pytest.raises(DeviceError, match=r"its token cannot be read from .*nowhere: No such file"):
        RemoteLedArray(RemoteOptions(token_file=str(tmp_path / "nowhere"))).open()
    server.close()
    with pytest.raises(DeviceError, match="no server answers at http"):
        RemoteLedArray(options).open()
