"""Jobs: results, progress, errors and cancelling reach the window's thread."""

from __future__ import annotations

import threading

import pytest
from PySide6.QtCore import QThread
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from drivers.errors import LimitError
from gui.jobs import BusyError, JobContext, JobRunner, JobState
from instrument.files.errors import BenchError

WAIT_MS = 60_000


@pytest.fixture
def jobs(qapp: QApplication) -> JobRunner:
    return JobRunner(qapp)


def test_a_result_arrives_in_the_windows_thread(qtbot: QtBot, jobs: JobRunner) -> None:
    here = QThread.currentThread()
    seen: list[object] = []
    job = jobs.compute("sum", lambda _: (sum(range(10)), threading.current_thread()))
    job.succeeded.connect(lambda result: seen.append((result, QThread.currentThread())))
    with qtbot.waitSignal(job.ended, timeout=WAIT_MS):
        pass
    ((total, thread), where), *_ = seen  # type: ignore[misc]
    assert total == 45
    assert thread is not threading.main_thread()
    assert where is here
    assert job.state is JobState.SUCCEEDED
    assert jobs.jobs == ()


def test_progress_keeps_only_the_newest(qtbot: QtBot, jobs: JobRunner) -> None:
    def work(context: JobContext) -> None:
        for i in range(1000):
            context.report(i)

    reports: list[object] = []
    job = jobs.compute("loop", work)
    job.progressed.connect(reports.append)
    with qtbot.waitSignal(job.ended, timeout=WAIT_MS):
        pass
    assert reports[-1] == 999
    assert len(reports) < 1000


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (BenchError("the disk is full"), "the disk is full"),
        (LimitError("stage", "x is too far."), "stage: x is too far."),
        (ZeroDivisionError("oops"), "please report"),
    ],
)
def test_an_error_becomes_words(qtbot: QtBot, jobs: JobRunner, error: Exception, words: str) -> None:
    def work(_: JobContext) -> None:
        raise error

    job = jobs.compute("fails", work)
    with qtbot.waitSignal(job.failed, timeout=WAIT_MS) as told:
        pass
    assert words in told.args[0]
    assert job.error is error


def test_cancelling_ends_work_that_reports(qtbot: QtBot, jobs: JobRunner) -> None:
    def work(context: JobContext) -> None:
        while True:
            context.report(None)

    job = jobs.compute("endless", work)
    with qtbot.waitSignal(job.progressed, timeout=WAIT_MS):
        pass
    with qtbot.waitSignal(job.cancelled, timeout=WAIT_MS):
        job.cancel()


def test_cancelling_calls_what_the_work_asked_for(qtbot: QtBot, jobs: JobRunner) -> None:
    gate = threading.Event()

    def work(context: JobContext) -> str:
        context.on_cancel(gate.set)
        gate.wait(20)
        return "ended by itself"

    job = jobs.compute("blocks", work)
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    with qtbot.waitSignal(job.succeeded, timeout=WAIT_MS):
        job.cancel()


def test_jobs_of_one_device_take_turns_and_those_of_another_do_not_wait(
    qtbot: QtBot, jobs: JobRunner
) -> None:
    gate = threading.Event()
    order: list[str] = []
    jobs.device("slow", lambda _: (gate.wait(20), order.append("slow")), {"stage"})
    after = jobs.device("after", lambda _: order.append("after"), {"stage"})
    other = jobs.device("other", lambda _: order.append("other"), {"camera"})
    with qtbot.waitSignal(other.ended, timeout=WAIT_MS):
        pass
    gate.set()
    with qtbot.waitSignal(after.ended, timeout=WAIT_MS):
        pass
    assert order == ["other", "slow", "after"]


def test_an_exclusive_job_holds_every_device(qtbot: QtBot, jobs: JobRunner) -> None:
    gate = threading.Event()
    run = jobs.exclusive("A sweep", lambda _: gate.wait(20))
    with pytest.raises(BusyError, match="A sweep is running"):
        jobs.device("jog", lambda _: None, {"stage"})
    with pytest.raises(BusyError, match="A sweep is running"):
        jobs.exclusive("another", lambda _: None)
    free = jobs.compute("free", lambda _: 1)
    with qtbot.waitSignal(free.ended, timeout=WAIT_MS):
        pass
    assert not run.is_over
    with qtbot.waitSignal(run.ended, timeout=WAIT_MS):
        gate.set()


def test_a_held_key_cannot_fill_a_queue(qtbot: QtBot, jobs: JobRunner) -> None:
    gate = threading.Event()
    first = jobs.device("slow", lambda _: gate.wait(20), {"stage"})
    qtbot.waitUntil(lambda: first.state is JobState.RUNNING, timeout=WAIT_MS)
    for _ in range(16):
        jobs.device("jog", lambda _: None, {"stage"})
    with pytest.raises(BusyError, match="waiting already"):
        jobs.device("jog", lambda _: None, {"stage"})
    gate.set()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)


def test_nothing_waits_behind_what_has_no_end(qtbot: QtBot, jobs: JobRunner) -> None:
    show = jobs.device("Showing a face", lambda c: c.cancel.wait(20), {"slm"}, endless=True)
    with pytest.raises(BusyError, match="Showing a face"):
        jobs.exclusive("A sweep", lambda _: None)
    with pytest.raises(BusyError, match="Showing a face"):
        jobs.device("blank", lambda _: None, {"slm"})
    free = jobs.device("jog", lambda _: None, {"stage"})
    with qtbot.waitSignal(free.ended, timeout=WAIT_MS):
        pass
    show.cancel()
    sweep = jobs.exclusive("A sweep", lambda _: None)
    with qtbot.waitSignal(sweep.succeeded, timeout=WAIT_MS):
        pass


def test_a_job_that_waits_can_be_withdrawn(qtbot: QtBot, jobs: JobRunner) -> None:
    gate = threading.Event()
    first = jobs.device("slow", lambda _: gate.wait(20), {"stage"})
    run = jobs.exclusive("A sweep", lambda _: None)
    qtbot.waitUntil(lambda: first.state is JobState.RUNNING, timeout=WAIT_MS)
    assert jobs.before(run) == (first,)
    assert jobs.withdraw(run)
    assert run.state is JobState.CANCELLED
    assert not jobs.withdraw(first)
    gate.set()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)
    assert first.state is JobState.SUCCEEDED


def test_no_job_that_waits_begins_while_those_before_it_are_cancelled(qtbot: QtBot, jobs: JobRunner) -> None:
    gate = threading.Event()
    begun: list[str] = []
    first = jobs.device("first", lambda _: gate.wait(WAIT_MS / 1000), {"camera"})
    qtbot.waitUntil(lambda: first.state is JobState.RUNNING, timeout=WAIT_MS)
    waiting = [
        jobs.device("second", lambda _: begun.append("second"), {"camera", "led_array"}),
        jobs.device("third", lambda _: begun.append("third"), {"led_array"}),
    ]
    for job in waiting:
        job.started.connect(lambda job=job: begun.append(job.title))
    jobs.cancel_device_jobs()
    assert [job.state for job in waiting] == [JobState.CANCELLED] * 2
    gate.set()
    qtbot.waitUntil(lambda: first.is_over, timeout=WAIT_MS)
    assert jobs.join(WAIT_MS / 1000)
    assert begun == []


def test_stop_leaves_what_uses_no_device_though_it_was_asked_for_just_now(
    qtbot: QtBot, jobs: JobRunner
) -> None:
    """The opening of a panel, or a reconstruction, begun in the turn in which STOP is pressed."""
    moved: list[str] = []
    move = jobs.device("move", lambda _: moved.append("moved"), {"stage"})
    opening, computing = jobs.watch("open", lambda _: "panel"), jobs.compute("solve", lambda _: "picture")
    jobs.cancel_device_jobs()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)
    assert (move.state, moved) == (JobState.CANCELLED, [])
    assert [job.state for job in (opening, computing)] == [JobState.SUCCEEDED] * 2


def test_jobs_end_without_a_word_once_what_shows_them_is_gone(jobs: JobRunner, qtbot: QtBot) -> None:
    go_on = threading.Event()
    heard: list[object] = []
    running = jobs.compute("looking", lambda _: go_on.wait(20))
    running.succeeded.connect(heard.append)
    qtbot.waitUntil(lambda: running.state is JobState.RUNNING, timeout=WAIT_MS)
    jobs.silence()
    later = jobs.compute("looking again", lambda _: 1)
    later.ended.connect(lambda: heard.append("ended"))
    go_on.set()
    qtbot.waitUntil(lambda: running.is_over and later.is_over, timeout=WAIT_MS)
    assert heard == []
    assert not jobs.jobs


def test_a_start_may_withdraw_what_waits_behind_it(qtbot: QtBot, jobs: JobRunner) -> None:
    """As STOP does that is pressed, or a signal of the system that comes, while jobs are started."""
    first = jobs.device("first", lambda _: None, {"camera"})
    second = jobs.device("second", lambda _: None, {"stage"})
    first.started.connect(lambda: jobs.withdraw(second))
    with qtbot.waitSignal(first.ended, timeout=WAIT_MS):
        pass
    assert second.state is JobState.CANCELLED
    assert jobs.jobs == ()


def test_what_a_start_has_let_begin_holds_its_device(qtbot: QtBot, jobs: JobRunner) -> None:
    """A withdrawal while jobs are started starts others: what comes behind those waits for them."""
    gate = threading.Event()
    first = jobs.device("first", lambda _: None, {"camera"})
    second = jobs.device("second", lambda _: gate.wait(WAIT_MS / 1000), {"stage"})
    third = jobs.device("third", lambda _: None, {"light"})
    fourth = jobs.device("fourth", lambda _: None, {"stage"})
    first.started.connect(lambda: jobs.withdraw(third))
    together: list[JobState] = []
    fourth.started.connect(lambda: together.append(second.state))
    with qtbot.waitSignal(first.ended, timeout=WAIT_MS):
        pass
    gate.set()
    qtbot.waitUntil(lambda: fourth.is_over, timeout=WAIT_MS)
    assert together == [JobState.SUCCEEDED]


def test_a_thread_that_cannot_be_had_fails_its_job_and_no_other(
    qtbot: QtBot, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as without:
        without.setattr(threading.Thread, "start", none_left)
        job = jobs.device("first", lambda _: None, {"camera"})
        with qtbot.waitSignal(job.ended, timeout=WAIT_MS):
            pass
    assert job.state is JobState.FAILED
    later = jobs.device("second", lambda _: None, {"camera"})
    with qtbot.waitSignal(later.succeeded, timeout=WAIT_MS):
        pass
