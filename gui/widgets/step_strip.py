"""The strip below the devices: what is done, what comes next, one button that leads there."""

from __future__ import annotations

from dataclasses import replace

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QFrame, QSizePolicy, QWidget

from gui.background import NewestOnly
from gui.jobs import Job
from gui.journey import EXPOSING, Facts, Made, Step, after_all, facts_of, made_in, next_of, steps_of
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import after_rest, button, every, fill, label

_LOOK_MS = 500
_REST_MS = 400
"""Rest after a job before the folder is read again."""


class StepStrip(QFrame):
    """Says what is done and what comes next on this bench.

    Signals
    -------
    wanted : str, object
        A panel's name and what it is to work with (empty: nothing).
    """

    wanted = Signal(str, object)

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setObjectName("strip")
        self._session = session
        self._made = Made()
        self.step: Step | None = None
        """The one that the button leads to."""
        self.marks = label()
        self.marks.setAccessibleName("Steps")
        self.words = label(yields=True)
        self.words.setAccessibleName("Next step")
        self.button = button("", clicked=self.go_on, primary=True)
        for part in (self.marks, self.button):
            part.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Preferred)
        self._light = "unknown"
        """Of the newest frame that no run took: a run's dark frames say nothing of the scene."""
        keeps = self.button.sizePolicy()
        keeps.setRetainSizeWhenHidden(True)  # what lies below stays where it is
        self.button.setSizePolicy(keeps)
        fill(self, self.marks, (self.words, 1), self.button, across=True, margins=(9, 3, 8, 3), spacing=12)
        self._reader = NewestOnly(session.jobs, "Looking what is there")
        self._rest = after_rest(self, _REST_MS, self._read)
        session.run_finished.connect(lambda _: self._rest.start())
        session.device_changed.connect(lambda _: self.look())
        session.jobs.job_ended.connect(self._job_ended)
        every(self, _LOOK_MS, self.look)
        self._read()
        self.look()

    def look(self) -> None:
        """Show how things stand; to be called now and then."""
        if self._session.is_closing:
            return
        facts = facts_of(self._session, self._made)
        if (self._running or facts.light in ("held", "unknown")) and self._light != "unknown":
            facts = replace(facts, light=self._light)  # which says nothing against it
        self._light = facts.light
        self.show_facts(facts)

    @property
    def _running(self) -> str:
        """What is under way, in words; empty: nothing that the next step has to wait for."""
        return next((job.title for job in self._session.jobs.jobs if _is_run(job)), "")

    def show_facts(self, facts: Facts) -> None:
        """Show the way, the next step in words, and the button that leads there."""
        steps = steps_of(self._session.config, facts)
        step = next_of(steps)
        self.step = step or after_all(self._session.config, facts)
        marks = "&nbsp;&nbsp; ".join(_mark(one, one is step) for one in steps)
        if self.marks.text() != marks:
            self.marks.setText(marks)
        running = self._running
        waits = self.step.panel == "reconnect" and not self.step.what
        self.words.setText(f"{running} is under way …" if running else self.step.words)
        self.button.setToolTip(self.step.words)
        if self.button.text() != self.step.answer:
            self.button.setText(self.step.answer)
        self.button.setVisible(bool(self.step.answer) and not running and not waits)
        layout = self.layout()
        assert layout is not None
        layout.activate()  # never a word cut off for a moment

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        self.marks.setText("")
        self.look()

    def go_on(self) -> None:
        """Go where the next step is taken, by its button or its keys."""
        if self.step is not None and not self.button.isHidden():
            self.wanted.emit(self.step.panel, self.step.what)

    def _read(self) -> None:
        runs = self._session.runs_folder
        self._reader.ask(lambda: made_in(runs), self._take)

    def _take(self, made: Made) -> None:
        self._made = made
        self.look()

    def _job_ended(self, job: Job) -> None:
        if not job.quiet:
            self._rest.start()


def _is_run(job: Job) -> bool:
    return not job.quiet and (job.exclusive or not job.lanes or job.title == EXPOSING)


def _mark(step: Step, is_next: bool) -> str:
    """Return a step as rich text: what is done and what is next is told by signs and weight, too."""
    now = colours()
    if is_next:
        return f'<b style="color: {now.accent}">▸&nbsp;{step.name}</b>'
    if step.done:
        return f'<span style="color: {now.ok}">✓&nbsp;{step.name}</span>'
    return f'<span style="color: {now.dim}">○&nbsp;{step.name}</span>'
