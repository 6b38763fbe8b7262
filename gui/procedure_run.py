"""A procedure that is carried out for a panel: started, paused, ended, looked at by a timer; its buttons."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from PySide6.QtCore import QObject, Qt, Signal
from PySide6.QtWidgets import QWidget

from calibration_routines.display.spot_camera import SpotLook
from calibration_routines.plan_procedures import ResumeProcedure, unfinished
from calibration_routines.planned import place_of
from calibration_routines.procedure import Listener, Outcome, Procedure
from calibration_routines.psf.sweep_plan import SweepExposures
from calibration_routines.psf.sweep_procedure import event_lines, exposure_lines
from calibration_routines.psf.sweep_watch import SweepEvent
from calibration_routines.purpose import RunEndedError
from gui.jobs import Job, JobContext
from gui.panel import on_bench
from gui.session import BenchSession
from gui.widgets.building import button, every, fill, in_row, label, share_bar
from gui.widgets.tab_order import take_turns
from instrument.bench.photograph import Snapshot
from instrument.files.errors import duration
from instrument.plan import Plan
from instrument.plan.model import plan_toml
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.runner import RunState, RunStatus
from recon.base.as_python import Imports, expression

_LOOK_MS = 100


@dataclass(frozen=True, slots=True)
class Situation:
    """How a procedure goes on, to be shown.

    Attributes
    ----------
    step : str
        What it does now.
    done, total : float
        Of the step; total 0: not known.
    seconds_left : float
        Of the step; None: not known.
    at_most : bool
        Whether it usually ends long before ``total``: then ``seconds_left`` is a bound, no estimate.
    paused : bool
        Whether it really waits.
    newest : Snapshot or None
        The last frame.
    place : mapping or None
        Where the source (``x_um``, ``y_um``, ``z_um``) or the stage is, as planned.
    """

    step: str = ""
    done: float = 0.0
    total: float = 0.0
    at_most: bool = False
    seconds_left: float | None = None
    paused: bool = False
    newest: Snapshot | None = None
    place: Mapping[str, float] | None = None


class _Mailbox(Listener):
    """Keeps the newest situation, in the job's thread, and what must not get lost until it is fetched."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._situation = Situation()
        self._began_s = time.monotonic()
        self._lines: list[str] = []
        self._events: list[SweepEvent] = []
        self._looks: list[SpotLook] = []
        self.left: Path | None = None
        """The run that can go on, of a procedure that a fault or STOP ended."""

    # In the job's thread -------------------------------------------------------------------------
    def step(self, words: str) -> None:
        with self._lock:
            self._began_s = time.monotonic()
            self._situation = Situation(step=words, newest=self._situation.newest)

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        seconds = time.monotonic() - self._began_s
        left = seconds * (total - done) / done if done > 0 else None
        with self._lock:
            self._situation = replace(
                self._situation, done=done, total=total, at_most=at_most, seconds_left=left
            )

    def said(self, words: str) -> None:
        with self._lock:
            self._lines.append(words)

    def exposures(self, exposures: SweepExposures) -> None:
        with self._lock:
            self._lines += exposure_lines(exposures)

    def frame(self, status: RunStatus) -> None:
        with self._lock:
            self._situation = replace(
                self._situation,
                done=status.done,
                total=status.total,
                seconds_left=status.seconds_left,
                paused=status.state is RunState.PAUSED,
                newest=status.newest or self._situation.newest,
                place=None if status.step is None else place_of(status.step),
            )

    def event(self, event: SweepEvent) -> None:
        with self._lock:
            self._events.append(event)
            self._lines += event_lines(event)

    def look(self, look: SpotLook) -> None:
        with self._lock:
            self._looks.append(look)

    # In the window's thread ----------------------------------------------------------------------
    @property
    def situation(self) -> Situation:
        with self._lock:
            return self._situation

    def fetch(self) -> tuple[list[str], list[SweepEvent], list[SpotLook]]:
        with self._lock:
            fetched = self._lines, self._events, self._looks
            self._lines, self._events, self._looks = [], [], []
        return fetched


@dataclass(frozen=True, slots=True)
class Ended:
    """A procedure that was aborted or stopped, or that a fault ended.

    Attributes
    ----------
    words : str
        What is left, in words.
    run : Path or None
        A run that can go on.
    """

    words: str
    run: Path | None = None


class ProcedureRun(QObject):
    """Carries out one procedure after the other on a session's bench, and logs what is said of it.

    Signals
    -------
    looked : Situation
        Ten times a second while it goes on, and once at its end.
    judged : PointTaken or SourceVisit
    look : SpotLook
    succeeded : Outcome
    ended_early : Ended
        Somebody aborted or stopped it.
    failed : Ended
    over
        After one of these three.
    """

    looked = Signal(object)
    judged = Signal(object)
    look = Signal(object)
    succeeded = Signal(object)
    ended_early = Signal(object)
    failed = Signal(object)
    over = Signal()

    def __init__(self, session: BenchSession, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._session = session
        self._job: Job | None = None
        self._control = RunControl()
        self._mailbox = _Mailbox()
        self._timer = every(self, _LOOK_MS, self._look)
        self._timer.stop()

    @property
    def is_running(self) -> bool:
        """Whether a procedure goes on."""
        return self._job is not None

    def start(self, title: str, procedure: Procedure) -> Job:
        """Carry out a procedure, in a job.

        Raises BusyError when something else holds the bench.
        """
        control, mailbox, bench = RunControl(), _Mailbox(), self._session.bench
        resumed = procedure.run if isinstance(procedure, ResumeProcedure) else None
        mailbox.left = resumed  # until it has begun: it may be refused, for want of room say, or withdrawn

        def work(context: JobContext) -> Outcome | Ended:
            context.on_cancel(lambda: threading.Thread(target=control.stop, name="STOP").start())
            try:
                return procedure.carry_out(bench, control=control, listener=mailbox)
            except RunEndedError as error:
                words = "\n".join([error.words, *getattr(error, "__notes__", ())])
                return Ended(words, unfinished(error.run.path))
            except EndedEarlyError as error:
                words = "\n".join([str(error), *getattr(error, "__notes__", ())])
                return Ended(words, unfinished(control.run or resumed))
            except BaseException:
                mailbox.left = unfinished(control.run or resumed)
                raise

        self._job = job = self._session.exclusive_job(title, work)
        self._control, self._mailbox = control, mailbox
        self._job.succeeded.connect(self._succeeded)
        self._job.failed.connect(self._failed)
        self._job.cancelled.connect(self._cancelled)
        self._job.ended.connect(self._over)
        self._timer.start()
        return job

    def pause(self) -> None:
        """Wait before the next step, light off."""
        self._control.pause()

    def resume(self) -> None:
        """Go on."""
        self._control.resume()

    def abort(self) -> None:
        """End before the next step; at once where it still waits for other jobs."""
        self._control.abort()
        if self._job is not None:
            self._session.jobs.withdraw(self._job)

    def _look(self) -> None:
        lines, events, looks = self._mailbox.fetch()
        for line in lines:
            self._session.log("info", line)
        for event in events:
            self.judged.emit(event)
        for look in looks:
            self.look.emit(look)
        before = () if self._job is None else self._session.jobs.before(self._job)
        if before:
            self.looked.emit(Situation(step=f"waiting for: {', '.join(job.title for job in before)}"))
        else:
            self.looked.emit(self._mailbox.situation)

    def _succeeded(self, result: Outcome | Ended) -> None:
        self._look()
        if isinstance(result, Ended):
            if self._job is not None:
                self._job.became = "ended early"
            self._ended_early(result)
            return
        for path in dict.fromkeys((*result.runs, *([result.calibration] if result.calibration else []))):
            self._session.run_finished.emit(path)
        for line in result.verdict:
            self._session.log("info" if result.good else "warning", line)
        self.succeeded.emit(result)

    def _ended_early(self, ended: Ended) -> None:
        self._session.log("info", ended.words)
        self._leave(ended)
        self.ended_early.emit(ended)

    def _failed(self, why: str) -> None:
        self._look()
        ended = Ended(why, self._mailbox.left)
        self._leave(ended)
        self.failed.emit(ended)

    def _cancelled(self, words: str) -> None:
        self._look()
        self._ended_early(Ended(words, self._mailbox.left))

    def _leave(self, ended: Ended) -> None:
        if ended.run is not None:
            self._session.run_finished.emit(ended.run)

    def _over(self) -> None:
        self._timer.stop()
        self._job = None
        self.over.emit()


_STEPS = 1000
_TIPS = (
    "Wait before the next frame, light off; press again to go on",
    "End before the next frame; what was taken is kept and can be resumed",
)


class Pausable(Protocol):
    """What is carried out, as far as its buttons see it."""

    looked: Any

    def pause(self) -> None:
        """Wait at the next step."""

    def resume(self) -> None:
        """Go on."""

    def abort(self) -> None:
        """End."""


class RunBar(QWidget):
    """The buttons of a procedure and its progress.

    Signals
    -------
    start
        To be carried out.

    Parameters
    ----------
    run : ProcedureRun or TaskRun
        Is paused and aborted by the buttons, and shown.
    words : str
        On the start button.
    tips : (str, str)
        Of the buttons that pause and abort.
    small : bool
        Whether progress has no place before something is carried out.
    """

    start = Signal()

    def __init__(
        self, run: Pausable, words: str, tips: tuple[str, str] = _TIPS, *, small: bool = False
    ) -> None:
        super().__init__()
        self.start_button = button(words, clicked=self.start, shortcut="Ctrl+Return", primary=True)
        self.pause_button = button("Pause", tips[0], checkable=True)
        self.pause_button.clicked.connect(lambda on: run.pause() if on else run.resume())
        self.abort_button = button("Abort", tips[1], self._abort)
        self._run = run
        self._ending = False
        """Whether it was aborted, and goes on to where it can end."""
        self.bar = share_bar(_STEPS)
        self.words = label(role="dim", wraps=True, yields=True)
        self.words.setMinimumHeight(2 * self.words.fontMetrics().lineSpacing() + 2)  # the buttons stay
        self.words.setAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        buttons = in_row((self.start_button, 2), self.pause_button, self.abort_button)
        fill(self, buttons, self.bar, self.words, margins=(0, 4, 0, 0))
        run.looked.connect(self.show_situation)
        self._why_not = ""
        self._when_paused = ", light off" if tips is _TIPS else ""
        self._small = small
        self.set_running(False)
        self._show_start(running=False)
        self._give_place()

    def _abort(self) -> None:
        self._ending = True
        self.abort_button.setEnabled(False)
        self._run.abort()

    def set_startable(self, why_not: str = "") -> None:
        """Let the start button be pressed, or say why not."""
        self._why_not = why_not
        self._show_start(running=self.pause_button.isEnabled())

    def set_running(self, running: bool) -> None:
        """Show the buttons for a procedure that runs, or for none."""
        self._ending = False
        ends = (self.pause_button, self.abort_button)
        start = () if self._why_not else (self.start_button,)
        take_turns(*((ends, (self.start_button,)) if running else (start, ends)))
        self.pause_button.setChecked(False)
        if running:
            self.bar.setValue(0)
            self.words.setText("Beginning")
            self._give_place()

    def show_situation(self, now: Situation) -> None:
        """Show how far it is."""
        self.bar.setRange(0, _STEPS if now.total else 0)
        if now.total:
            self.bar.setValue(round(_STEPS * now.done / now.total))
        words = [now.step[:1].upper() + now.step[1:]]
        if now.total > 1:
            words.append(f"{now.done:.0f} of {'at most ' if now.at_most else ''}{now.total:.0f}")
        elif now.total:
            words.append(f"{now.done / now.total:.0%}")
        if self._ending:
            words.append("ENDING as soon as it can")
        elif now.paused:
            words.append(f"PAUSED{self._when_paused}")
        elif self.pause_button.isChecked():
            words.append("WILL PAUSE as soon as it can")
        elif now.seconds_left is not None:
            words.append(f"{'at most ' if now.at_most else ''}{duration(now.seconds_left)} left")
        self.words.setText(", ".join(filter(None, words)))

    def clear(self) -> None:
        """Show nothing of what was carried out before."""
        self.bar.reset()
        self.words.clear()
        self._give_place()

    def _give_place(self) -> None:
        """Give progress and its words their place."""
        for each in (self.bar, self.words):
            each.setVisible(not self._small or bool(self.words.text()))

    def show_end(self, words: str, *, complete: bool) -> None:
        """Show how it ended."""
        self.bar.setRange(0, _STEPS)
        self.bar.setValue(_STEPS if complete else self.bar.value())
        self.words.setText(words)
        self._give_place()

    def _show_start(self, *, running: bool) -> None:
        self.start_button.setEnabled(not running and not self._why_not)
        self.start_button.setToolTip(self._why_not or "Begin (Ctrl+Enter)")


def script(procedure: Procedure, bench: Path | None) -> str:
    """Return lines that open the bench, say what the procedure will do, and carry it out.

    ``bench`` is its bench.toml; None: the built-in simulated bench.
    """
    imports = Imports()
    made = expression(procedure, imports, special={Plan: _plan_lines})
    lines = ["print(*procedure.outlook(bench).reasons, sep='\\n')", "done = procedure.carry_out(bench)"]
    opened = on_bench(bench, lines, imports, [f"procedure = {made}"])
    return f"{opened}print(*done.verdict, sep='\\n')\n"


def _plan_lines(plan: Plan, imports: Imports) -> str:
    imports.names.add(("instrument.plan", "Plan"))
    imports.modules.add("tomllib")
    return f"Plan.checked(tomllib.loads({plan_toml(plan)!r}))"
