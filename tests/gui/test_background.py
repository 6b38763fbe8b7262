"""What is read in jobs: the newest request, in a thread of its own."""

from __future__ import annotations

import threading

from PySide6.QtWidgets import QProgressBar
from pytestqt.qtbot import QtBot
from shiboken6 import delete

from gui.background import NewestOnly
from gui.jobs import JobRunner

WAIT_MS = 60_000


def test_of_quick_requests_the_newest_is_read_and_what_is_forgotten_is_not_shown(qtbot: QtBot) -> None:
    jobs = JobRunner()
    reader = NewestOnly(jobs, "reading")
    go_on, begun, shown = threading.Event(), [], []

    def reads(number: int) -> int:
        begun.append((number, threading.current_thread() is threading.main_thread()))
        go_on.wait(20)
        return number

    for number in range(5):
        reader.ask(lambda number=number: reads(number), shown.append)
    qtbot.waitUntil(lambda: len(begun) == 1, timeout=WAIT_MS)
    go_on.set()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)
    assert begun == [(0, False), (4, False)] or begun == [(4, False)]
    assert shown[-1] == 4
    go_on.clear()
    reader.ask(lambda: reads(5), shown.append)
    qtbot.waitUntil(lambda: begun[-1][0] == 5, timeout=WAIT_MS)
    reader.forget()
    reader.ask(lambda: reads(6), shown.append)
    go_on.set()
    qtbot.waitUntil(lambda: shown[-1] == 6, timeout=WAIT_MS)
    assert 5 not in shown
    assert jobs.join(10)


def test_everything_that_is_to_be_closed_is_closed(qtbot: QtBot) -> None:
    """Two volumes that follow one another while a slice of the first is read."""
    jobs = JobRunner()
    reader = NewestOnly(jobs, "reading")
    go_on, begun, closed = threading.Event(), threading.Event(), []

    def read() -> None:
        begun.set()
        go_on.wait(20)

    reader.ask(read, lambda _: None)
    qtbot.waitUntil(begun.is_set, timeout=WAIT_MS)
    reader.forget(last=lambda: closed.append("first"))
    reader.forget(last=lambda: closed.append("second"))
    reader.ask(lambda: closed.append("read"), lambda _: None)
    go_on.set()
    qtbot.waitUntil(lambda: len(closed) == 3, timeout=WAIT_MS)
    assert closed == ["first", "second", "read"]
    assert jobs.join(10)


def test_what_is_read_for_a_widget_that_was_closed_meanwhile_is_dropped(qtbot: QtBot) -> None:
    jobs = JobRunner()
    failures: list[str] = []
    reader = NewestOnly(jobs, "reading", failures.append)
    go_on, begun = threading.Event(), threading.Event()

    class Bar(QProgressBar):
        def show_value(self, value: int) -> None:
            self.setValue(value)  # raises once the widget is gone

    def read() -> int:
        begun.set()
        go_on.wait(20)
        return 1

    bar = Bar()
    reader.ask(read, bar.show_value)
    qtbot.waitUntil(begun.is_set, timeout=WAIT_MS)
    delete(bar)
    go_on.set()
    qtbot.waitUntil(lambda: not reader.is_reading, timeout=WAIT_MS)  # an exception in Qt's loop would fail it
    assert failures == []
    assert jobs.join(10)
