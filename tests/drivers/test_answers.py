"""A driver that hangs is given up within a stated time and named; the light is off all the same."""

from __future__ import annotations

import inspect
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.camera import Camera
from drivers.common import answers
from drivers.common.answers import is_bounded, within
from drivers.common.checked import call_limit_s, checked, given_up, is_timed
from drivers.common.stream import FrameStream
from drivers.device import Device
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.frame import FrameMetadata
from drivers.led_array import LedArray
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.bench import Bench
from instrument.bench.photograph import photograph
from instrument.live.live import LiveView
from instrument.plan import Part, Plan
from instrument.runs.acquire import acquire
from instrument.runs.inspection import run_paths
from instrument.runs.recorder import record
from instrument.runs.run import Run, RunCondition
from recon.streams.live import LiveReconstructor
from recon.types import Calibration
from tests.instrument.conftest import mock_drivers
from tests.instrument.runs.test_recorder import bench_with
from tests.instrument.runs.test_resume import calls, open_mock_bench
from tests.mocks.devices import (
    MockCamera,
    MockLedArray,
    MockOptions,
    MockSlm,
    MockStage,
    MockWorld,
    MockWorldOptions,
)
from tests.mocks.free_running import FreeRunningCamera

__all__ = ["mock_drivers"]


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let what takes ten seconds take a quarter of one."""
    for place in ("drivers.common.stream", "instrument.bench.safety", "instrument.bench.bench"):
        monkeypatch.setattr(f"{place}.STOP_ANSWER_S", 0.25)
    for place in ("drivers.common.stream", "drivers.common.checked"):
        monkeypatch.setattr(f"{place}.CALL_MARGIN_S", 0.25)
    monkeypatch.setattr(FreeRunningCamera, "longest_silence_s", 0.1)


def test_what_a_call_returns_and_raises_comes_through_and_a_hang_is_named() -> None:
    assert within(5, "camera", "an answer", lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        within(5, "camera", "an answer", lambda: 1 // 0)

    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        within(5, "camera", "an answer", interrupted)
    ended = threading.Event()
    with pytest.raises(DeviceTimeoutError, match="camera: hangs: an answer has not ended"):
        within(0.05, "camera", "an answer", lambda: ended.wait(20))
    ended.set()


@pytest.mark.parametrize(
    "computed_s", [[0.0, 0.0], [0.0, 1.0, 2.0, 2.0], [np.nan, np.nan], [3.0, 1.0, 2.0, 2.0]]
)
def test_what_goes_on_computing_is_slow_and_does_not_hang(computed_s: list[float]) -> None:
    let_go, said = threading.Event(), iter(computed_s)
    with pytest.raises(DeviceTimeoutError, match="hangs: snap has not ended"):
        within(0.02, "camera", "snap", lambda: let_go.wait(20), computed_s=lambda: next(said))
    let_go.set()
    assert list(said) == (computed_s[2:] if computed_s[0] == 3 else [])


def test_time_when_the_program_stood_still_is_nobodys_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, looks = [0.0], list[float]()

    class StandsStill(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            looks.append(timeout or 0.0)
            now_s[0] += 1000.0 if len(looks) == 1 else timeout or 0.0
            return False

    monkeypatch.setattr(answers, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    answers._wait(StandsStill(), 30.0, answers.Computed(float))
    assert len(looks) == 29


def test_calls_that_were_given_up_are_known_and_waited_for_at_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    let_go = threading.Event()
    assert not is_bounded()
    assert within(5, "a", "b", is_bounded)
    monkeypatch.setattr(answers, "_given_up", set())
    within(5, "a", "b", lambda: 1)
    assert not answers._given_up
    with pytest.raises(DeviceTimeoutError):
        within(0.01, "a", "b", lambda: let_go.wait(20))
    (thread,) = answers._given_up
    let_go.set()
    thread.join(5)
    now_s, waited_s = [100.0], list[float]()

    class Late:
        def __init__(self, takes_s: float) -> None:
            self.takes_s = takes_s

        def is_alive(self) -> bool:
            return self.takes_s > 0

        def join(self, timeout: float) -> None:
            waited_s.append(timeout)
            now_s[0] += self.takes_s

    monkeypatch.setattr(answers, "_given_up", [Late(0), Late(1), Late(9), Late(1)])
    monkeypatch.setattr(answers, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    answers._wait_for_given_up()
    assert waited_s == [3.0, 2.0, 0.0]


@pytest.mark.parametrize("has_ended", [True, False])
def test_an_interrupted_call_is_undone_once_and_after_it(
    monkeypatch: pytest.MonkeyPatch, *, has_ended: bool
) -> None:
    class Interrupted(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            if has_ended:
                super().wait(20)
            raise KeyboardInterrupt

    let_go, undone, left = threading.Event(), [], list[threading.Thread]()
    patched = SimpleNamespace(Lock=threading.Lock, Event=Interrupted, Thread=threading.Thread)
    monkeypatch.setattr("drivers.common.answers.threading", patched)
    with pytest.raises(KeyboardInterrupt):
        within(9, "a", "b", lambda: has_ended or let_go.wait(20), undo=lambda: undone.append(1), left=left)
    assert (len(undone), len(left)) == (has_ended, not has_ended)
    let_go.set()
    for thread in left:
        assert thread.daemon
        thread.join(5)
    assert undone == [1]


class HangingCamera(FreeRunningCamera):
    """Hangs in the call for its sixth frame, until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.calls, self.let_go = 0, threading.Event()

    def next_frame_into(self, out: Any, timeout_s: float) -> FrameMetadata:
        self.calls += 1
        if self.calls > 5:
            self.let_go.wait(30)
        return super().next_frame_into(out, timeout_s)


def light_is_off(bench: Bench) -> bool:
    return bench.led_array is not None and bench.led_array.pattern.description == "off"


@pytest.mark.usefixtures("mock_drivers")
def test_a_device_that_takes_a_while_to_close_is_not_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_with(FreeRunningCamera())
    closed = threading.Event()

    def close() -> None:
        time.sleep(0.3)
        closed.set()

    monkeypatch.setattr(bench.camera, "close", close)
    bench.close()
    assert closed.is_set()


@pytest.mark.usefixtures("mock_drivers", "soon")
def test_a_camera_that_hangs_ends_a_recording_with_what_came_before(tmp_path: Path) -> None:
    camera = HangingCamera()
    bench = bench_with(camera)
    with pytest.raises(DeviceError, match="hangs: its driver has not come back") as failure:
        record(bench, tmp_path, seconds=20)
    assert any("hangs: handing out a frame" in note for note in failure.value.__notes__)
    run = Run.open(run_paths(tmp_path)[0])
    assert run.condition is RunCondition.FAILED
    assert "has not come back" in run.error
    assert run.records
    assert light_is_off(bench)
    camera.let_go.set()


@pytest.mark.usefixtures("soon")
def test_a_camera_that_hangs_ends_a_live_view_and_every_reader_that_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = HangingCamera()
    psf = np.zeros((1, 1, *camera.frame_shape), np.float32)
    psf[..., 12, 16] = 1
    stream = FrameStream(camera).start()
    view = LiveView(stream, LiveReconstructor(Calibration(psf, np.array([[0.0, 0.0, 1e5]]))))
    with pytest.raises(DeviceTimeoutError, match="hangs: its driver has not come back"):
        for _ in view:
            pass
    with pytest.raises(DeviceTimeoutError, match="hangs: its driver has not come back"):
        stream.reader().next_frame()
    with pytest.raises(DeviceTimeoutError, match="hangs: its driver has not come back"):
        stream.wait_newer(stream.newest(), 0.0)
    camera.let_go.set()
    stream.close()
    let_go, stopped = threading.Event(), threading.Event()
    monkeypatch.setattr(camera, "start_sequence", lambda _: let_go.wait(30))
    monkeypatch.setattr(camera, "stop_sequence", stopped.set)
    with pytest.raises(DeviceTimeoutError, match="hangs: starting its sequence"):
        FrameStream(camera).start()
    assert not stopped.is_set()
    let_go.set()
    assert stopped.wait(5), "a sequence that began after all runs on"


@pytest.mark.usefixtures("mock_drivers", "soon")
def test_a_camera_that_hangs_ends_a_run_and_the_other_devices_are_made_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go = threading.Event()
    bench = bench_with(checked(FreeRunningCamera)())  # type: ignore[call-arg]
    for call in ("snap", "stop_sequence"):
        monkeypatch.setattr(FreeRunningCamera, call, lambda _: let_go.wait(30))
    lit = Part.model_validate({"label": "a", "light": "source"})
    with pytest.raises(DeviceTimeoutError, match="hangs: snap") as failure:
        acquire(bench, Plan(label="p", parts=(lit,)), tmp_path)
    assert "exposure ended" in "".join(failure.value.__notes__)
    assert Run.open(run_paths(tmp_path)[0]).condition is RunCondition.FAILED
    assert light_is_off(bench)
    let_go.set()


@pytest.mark.usefixtures("soon")
def test_a_stream_that_is_given_up_lets_go_of_its_readers_and_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, let_go, shown = FreeRunningCamera(), threading.Event(), threading.Event()
    stream = FrameStream(camera)
    stream.start()
    stream.subscribe(lambda _: shown.set())
    assert shown.wait(20)
    monkeypatch.setattr(camera, "stop_sequence", lambda: let_go.wait(30))
    with pytest.raises(DeviceTimeoutError, match="ending its sequence"):
        stream.close()
    assert stream.newest() is None
    assert not any(t.name == "stream callback" for t in threading.enumerate())
    let_go.set()
    monkeypatch.undo()
    camera.stop_sequence()


HANGING: dict[Any, tuple[type[Device], str]] = {
    "stage": (MockStage, "move_to"),
    "led_array": (MockLedArray, "set_pattern"),
    "slm": (MockSlm, "display"),
    "camera": (MockCamera, "set_exposure_ms"),
}


@pytest.mark.usefixtures("mock_drivers", "soon")
@pytest.mark.parametrize("kind", HANGING)
def test_a_device_that_hangs_when_set_or_moved_is_given_up_named_and_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    image = tmp_path / "image.png"
    cv2.imwrite(str(image), np.full((4, 6), 40, np.uint8))
    positions = {"kind": "points", "points_um": [(0, 0, 10.0), (0, 0, 20.0)]}
    raw = {
        "label": "a",
        "light": "source",
        "exposure_ms": 20,
        "slm_image": str(image),
        "positions": positions,
    }
    with open_mock_bench() as bench:
        device = bench.devices[kind]
        plain, name = HANGING[kind]
        method, let_go = getattr(plain, name), threading.Event()
        limits_s = [call_limit_s(device, what) for what in ("settings", "open", name)]
        assert limits_s == [30, 120, 3000 if kind == "stage" else 30]  # three times 1 m at 1 mm/s
        monkeypatch.setattr("drivers.common.checked.call_limit_s", lambda *_: 0.25)

        def hangs(self: Device, *args: Any, **named: Any) -> Any:
            let_go.wait(20)
            return method(self, *args, **named)

        monkeypatch.setattr(plain, name, hangs)
        with pytest.raises(
            DeviceTimeoutError, match=rf"^{kind} \(mock\): hangs: {name.replace('_', ' ')} has"
        ):
            acquire(bench, Plan(label="p", parts=(Part.model_validate(raw),)), tmp_path / "runs")
        assert Run.open(run_paths(tmp_path / "runs")[0]).condition is RunCondition.FAILED
        assert light_is_off(bench)
        with pytest.raises(DeviceTimeoutError, match="still hangs"):
            device.settings()
        calls(bench).clear()
        let_go.set()
        for thread in given_up(device):
            thread.join(5)
        undone = {"stage": ["stage.stop"], "led_array": ["led_array.off"]}.get(kind, [])
        assert [call for call in calls(bench) if call in ("stage.stop", "led_array.off")] == undone
        assert light_is_off(bench)
        assert device.settings() is not None


@pytest.mark.usefixtures("mock_drivers", "soon")
@pytest.mark.parametrize("kind", ["camera", "led_array"])
def test_a_property_that_hangs_is_given_up_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    let_go = threading.Event()
    with open_mock_bench() as bench:
        plain = HANGING[kind][0]
        monkeypatch.setattr(Device, "longest_call_s", 0.25)
        monkeypatch.setattr(plain, "identity", property(lambda _: let_go.wait(20)))
        plan = Plan(label="p", parts=(Part(label="a", light=("source",)),))
        with pytest.raises(DeviceTimeoutError, match=rf"^{kind} \(mock\): hangs: reading identity has not"):
            acquire(bench, plan, tmp_path)
        assert light_is_off(bench)
        let_go.set()
        for thread in given_up(bench.devices[kind]):
            thread.join(5)


def test_a_device_is_not_read_while_a_reading_hangs_and_reads_itself_in_its_own_thread() -> None:
    lock = threading.Lock()

    class Slow(MockSlm):
        longest_call_s = 0.05

        @property
        def settle_ms(self) -> float:  # type: ignore[override]
            with lock:
                return 1.0

        def tells(self) -> float:
            return self.settle_ms

    slm = checked(Slow)(MockOptions(), MockWorld(MockWorldOptions()))
    assert slm.settle_ms == slm.tells()
    user = {"__name__": "a_users", "slm": slm}
    with lock:
        with pytest.raises(DeviceTimeoutError, match="hangs: reading settle_ms has not ended"):
            exec("slm.settle_ms", user)
        with pytest.raises(DeviceTimeoutError, match="still hangs: reading settle_ms has not"):
            exec("slm.settle_ms", user)
        assert slm.name == "slm (mock)"
        assert not slm.is_open
    for thread in given_up(slm):
        thread.join(5)
    exec("told = slm.settle_ms", user)
    assert user["told"] == slm.settle_ms


def test_every_call_of_a_device_has_an_end_or_is_known_to_have_another() -> None:
    calls = {
        name
        for interface in (Camera, Stage, LedArray, Slm)
        for name, member in vars(interface).items()
        if not name.startswith("_") and inspect.isfunction(member)
    }
    streams = {"start_sequence", "stop_sequence", "next_frame", "next_frame_into", "stream"}
    computed = {"check", "single", "move_duration_s", "settles_within", "computed_s"}
    assert {name for name in calls if not is_timed(name)} - streams - computed <= {"close", "play", "stop"}


@pytest.mark.usefixtures("mock_drivers")
def test_ctrl_c_during_a_move_stops_it_and_waits_for_its_call(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_mock_bench() as bench:
        stage, stopped = bench.stage, threading.Event()
        assert stage is not None

        def moves(*_: Any, **__: Any) -> Any:
            os.kill(os.getpid(), signal.SIGINT)  # as a terminal does: to the process
            assert stopped.wait(20)
            raise StoppedError(stage.name, "stopped.")

        monkeypatch.setattr(MockStage, "move_to", moves)
        monkeypatch.setattr(MockStage, "stop", lambda _: stopped.set())
        with pytest.raises(KeyboardInterrupt):
            stage.move_to({"x_um": 1.0})
        assert not any(thread.is_alive() for thread in given_up(stage))


@pytest.mark.parametrize("late", [True, False])
def test_an_interruption_while_a_calls_thread_starts_is_none_of_the_threads(
    monkeypatch: pytest.MonkeyPatch, *, late: bool
) -> None:
    start = threading.Thread.start
    threads: list[threading.Thread] = []
    left: list[threading.Thread] = []
    called: list[int] = []

    def interrupted(thread: threading.Thread) -> None:
        threads.append(thread)
        raise KeyboardInterrupt

    with monkeypatch.context() as during:
        during.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            within(5.0, "a stage", "moving", lambda: called.append(1), left=left)
    if late:
        start(threads[0])
        threads[0].join(5.0)
    assert (called, left) == ([], [])


@pytest.mark.usefixtures("mock_drivers")
@pytest.mark.parametrize("stops", [True, False])
def test_ctrl_c_stays_ctrl_c_where_the_stop_fails(monkeypatch: pytest.MonkeyPatch, *, stops: bool) -> None:
    """Of a photograph, too: its exposure is ended, and does not go on while the bench is closed."""
    with open_mock_bench() as bench:
        camera, stopped = bench.camera, threading.Event()

        def snap(_: Any) -> Any:
            os.kill(os.getpid(), signal.SIGINT)
            assert stopped.wait(20)
            raise StoppedError(camera.name, "stopped.")

        def stop(_: Any) -> None:
            stopped.set()
            if not stops:
                raise DeviceError(camera.name, "does not stop.")

        monkeypatch.setattr(MockCamera, "snap", snap)
        with monkeypatch.context() as patched:
            patched.setattr(MockCamera, "stop_sequence", stop)
            with pytest.raises(KeyboardInterrupt) as caught:
                photograph(camera)
            assert stopped.is_set()
            assert not any(thread.is_alive() for thread in given_up(camera))
        notes = getattr(caught.value, "__notes__", [])
        assert [note for note in notes if "does not stop" in note] == notes
        assert len(notes) == (not stops)


def test_nothing_begins_that_the_end_of_a_call_that_hangs_would_end(monkeypatch: pytest.MonkeyPatch) -> None:
    let_go = threading.Event()
    monkeypatch.setattr("drivers.common.checked.call_limit_s", lambda *_: 0.05)
    monkeypatch.setattr(FreeRunningCamera, "snap", lambda _: let_go.wait(20))
    camera = checked(FreeRunningCamera)()  # type: ignore[call-arg]
    with pytest.raises(DeviceTimeoutError, match="hangs: snap"):
        camera.snap()
    with pytest.raises(DeviceTimeoutError, match="still hangs: snap has not ended"):
        camera.stream().start()
    let_go.set()
    for thread in given_up(camera):
        thread.join(5)
    camera.stream().start().close()


def test_a_call_that_was_given_up_may_end_before_the_program_does() -> None:
    program = (
        "import threading\n"
        "from drivers.common.answers import within\n"
        "def late():\n"
        "    while threading.main_thread().is_alive():\n"  # it ends when the interpreter begins to
        "        pass\n"
        "    print('ended')\n"
        "try:\n"
        "    within(0.01, 'camera', 'an answer', late)\n"
        "except Exception as error:\n"
        "    print(error)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines()[-1] == "ended"
