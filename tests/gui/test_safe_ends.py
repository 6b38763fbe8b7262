"""STOP and the end: safe whatever a job or a device does meanwhile."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from drivers.errors import DeviceTimeoutError
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.slm import SimulatedSlm
from gui.jobs import JobContext, JobState
from gui.session import BenchSession
from gui.session_news import OperatorRequest

WAIT_MS = 60_000


def test_what_a_job_lights_in_the_middle_of_stop_is_turned_off(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = session.bench
    light_is_off, job_is_over = threading.Event(), threading.Event()
    stop = bench.stop

    def slowly() -> None:
        stop()  # the light first; a stage and a camera take their time
        light_is_off.set()
        assert job_is_over.wait(WAIT_MS / 1000)

    def work(_: JobContext) -> None:
        assert light_is_off.wait(WAIT_MS / 1000)
        bench.source_on()

    monkeypatch.setattr(bench, "stop", slowly)
    job = session.jobs.device("between two commands", work, {"stage"})
    job.ended.connect(job_is_over.set)
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.stop()
    assert not bench.source_lit


def test_stop_goes_on_until_a_late_job_has_ended(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.session._STOP_WAIT_S", 0.1)
    lines: list[str] = []
    session.logged.connect(lambda _, text: lines.append(text))
    go_on = threading.Event()

    def work(_: JobContext) -> None:
        assert go_on.wait(WAIT_MS / 1000)
        session.bench.source_on()

    job = session.jobs.device("Slow device", work, {"stage"})
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.stop()
        qtbot.waitUntil(lambda: any("Slow device has not ended" in line for line in lines), timeout=WAIT_MS)
        go_on.set()
    assert job.is_over
    assert not session.bench.source_lit


def test_what_fails_in_the_midst_of_stop_keeps_nothing_from_being_safe(
    qtbot: QtBot, session: BenchSession
) -> None:
    def broken() -> None:
        raise OSError("the callback's own error")

    def gone() -> None:
        raise RuntimeError("the question is gone")

    lines: list[str] = []
    session.logged.connect(lambda _, text: lines.append(text))
    requests: list[OperatorRequest] = []
    session.asked.connect(requests.append)
    goes_on, over = threading.Event(), threading.Event()

    def first(context: JobContext) -> None:
        context.on_cancel(broken)
        context.on_cancel(over.set)
        goes_on.set()
        assert over.wait(WAIT_MS / 1000)
        context.check()

    job = session.jobs.device("with a broken callback", first, {"stage"})
    asking = session.jobs.device("by hand", lambda _: session._ask("Please light the scene."), {"slm"})
    qtbot.waitUntil(lambda: goes_on.is_set() and bool(requests), timeout=WAIT_MS)
    requests[0].withdrawn = gone
    session.bench.source_on()
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.stop()
    assert job.state is asking.state is JobState.CANCELLED
    assert not session.bench.source_lit
    qtbot.waitUntil(lambda: any("the callback's own error" in line for line in lines), timeout=WAIT_MS)
    assert any("the question is gone" in line for line in lines)


@pytest.mark.parametrize("end", ["stop", "close"])
def test_what_is_asked_just_after_the_end_is_refused_and_not_shown(
    qtbot: QtBot, session: BenchSession, end: str
) -> None:
    asked: list[OperatorRequest] = []
    session.asked.connect(asked.append)
    ended = threading.Event()

    def work(_: JobContext) -> None:
        assert ended.wait(WAIT_MS / 1000)
        session._ask("Please light the scene.")

    job = session.jobs.device("by hand", work, {"slm"})
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    getattr(session, end)()
    ended.set()
    qtbot.waitUntil(lambda: job.is_over or bool(asked), timeout=WAIT_MS)
    assert not asked
    assert job.state is JobState.CANCELLED


def test_a_device_that_never_answers_does_not_keep_the_bench_open(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.session._STOP_WAIT_S", 0.2)
    answers = threading.Event()
    lines: list[str] = []
    session.logged.connect(lambda _, text: lines.append(text))
    job = session.camera_job("Region", lambda _: answers.wait(WAIT_MS / 1000), idle=True)
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    session.bench.source_on()
    with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
        session.close()
    assert not any(device.is_open for device in session.bench.devices.values())
    assert any("does not answer" in line for line in lines)
    answers.set()


def test_a_device_that_does_not_answer_stops_everything(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    slm, answers = session.bench.slm, threading.Event()
    assert slm is not None
    monkeypatch.setattr(SimulatedSlm, "display", lambda *_: answers.wait(WAIT_MS / 1000))
    monkeypatch.setattr(type(slm), "longest_call_s", 0.05)
    lines: list[str] = []
    session.logged.connect(lambda _, text: lines.append(text))
    session.bench.source_on()
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.jobs.device("A picture", lambda _: slm.display(np.zeros(slm.shape, np.uint8)), {"slm"})
    assert not session.bench.source_lit
    assert "STOP: the SLM does not answer." in lines
    assert session.state("slm").condition == "failed"
    answers.set()


def test_a_look_that_is_answered_late_ends_nothing(qtbot: QtBot, session: BenchSession) -> None:
    goes_on = threading.Event()
    run = session.jobs.exclusive("A run of hours", lambda _: goes_on.wait(WAIT_MS / 1000))
    stage = session.bench.stage
    assert stage is not None

    def late(_: JobContext) -> None:
        raise DeviceTimeoutError(stage.name, "did not answer within 1 s.", "Look at its cable.")

    looks = [session.jobs.watch("Reading the stage", late)]
    qtbot.waitUntil(lambda: looks[0].is_over, timeout=WAIT_MS)
    assert session.state("stage").condition == "failed"
    assert run.state is JobState.RUNNING
    assert not run.is_cancelling
    goes_on.set()
    qtbot.waitUntil(lambda: run.is_over, timeout=WAIT_MS)
    assert run.state is JobState.SUCCEEDED


def test_a_camera_that_hangs_in_the_live_view_is_named_and_the_light_put_out(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, stream = threading.Event(), session.live.stream
    assert stream is not None
    monkeypatch.setattr(SimulatedCamera, "next_frame", lambda *_: answers.wait(WAIT_MS / 1000))
    stream._answer_limit_s = 0.5
    session.bench.source_on()
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        pass
    assert not session.bench.source_lit
    state = session.state("camera")
    assert state.condition == "failed"
    assert "camera (simulated): hangs" in state.text
    answers.set()


def test_an_unforeseen_error_does_not_keep_the_bench_open(
    qtbot: QtBot, session: BenchSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> None:
        raise OSError("the driver's own error")

    lines: list[str] = []
    session.logged.connect(lambda _, text: lines.append(text))
    monkeypatch.setattr(session.live, "stop", broken)
    with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
        session.close()
    assert not any(device.is_open for device in session.bench.devices.values())
    assert any("the driver's own error" in line for line in lines)
