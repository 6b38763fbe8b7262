"""Work that must not block the window: done in threads, reported in the window's own thread.

Every signal of a :class:`Job` and of the :class:`JobRunner` is emitted in the thread of the window, whatever
thread the work is done in. Cancelling is what Ctrl-C is on the command line: :class:`JobCancelledError` is a
``KeyboardInterrupt``, so that routines tidy up and say what is left as they do there.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
import time
import traceback
from collections.abc import Callable, Collection
from enum import Enum
from typing import Any, NamedTuple

from PySide6.QtCore import QObject, Qt, Signal
from shiboken6 import isValid

from drivers.errors import StoppedError
from instrument.files.errors import BenchError, in_words

_log = logging.getLogger(__name__)

DEVICE_LANES = frozenset({"camera", "stage", "led_array", "slm", "light"})
"""Jobs on different devices run side by side; on the same device one after the other."""
_MOST_WAITING = 16
"""Device jobs that may wait for their turn; more are refused: a held key must not fill a queue."""


_SHOWN_S = 0.5
"""What there is so far is shown this often, at most."""
_SHARE = 0.1
"""At most this part of the time goes into making pictures on the way."""


class JobCancelledError(KeyboardInterrupt):
    """A job was cancelled; raised by :meth:`JobContext.check` in the job's thread."""


class BusyError(BenchError):
    """A device job was refused, because another holds the devices."""


class JobState(Enum):
    """What became of a job."""

    WAITING = "waiting"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class _Mail(NamedTuple):
    """A message from a job's thread."""

    number: int
    kind: str
    value: Any


class _Post(QObject):
    """Carries messages into the window's thread; lives as long as its runner."""

    arrived = Signal(object)


class JobContext:
    """What the work of a job is called with: how it reports, and how it sees that it is cancelled."""

    def __init__(self, number: int, post: _Post) -> None:
        self._number = number
        self._post = post
        self._lock = threading.Lock()
        self._newest: list[Any] = []
        self._on_cancel: list[Callable[[], object]] = []
        self._next_s = 0.0
        """From then on there may be another picture of what there is so far, seconds."""
        self.cancel = threading.Event()
        """Set when the job is cancelled; solvers take it as their ``cancel``."""

    def report(self, value: object) -> None:
        """Tell how far it is (``Job.progressed``); of several in quick succession only the newest arrives.

        Raises JobCancelledError when the job was cancelled, so that work which reports can be cancelled.
        """
        with self._lock:
            first, self._newest = not self._newest, [value]
        self._next_s = time.monotonic() + _SHOWN_S
        if first:
            self._send("progress", None)
        self.check()

    def offer(self, make: Callable[[], object]) -> None:
        """Report what ``make`` returns, now and then; for solvers, which see the end by themselves.

        Nothing is made a moment after the last report, nor so often that it takes much of the time.
        """
        began_s = time.monotonic()
        if began_s < self._next_s or self.cancel.is_set():
            return
        with contextlib.suppress(JobCancelledError):
            self.report(make())
            now_s = time.monotonic()
            self._next_s = now_s + max(_SHOWN_S, (now_s - began_s) / _SHARE)

    def check(self) -> None:
        """Raise JobCancelledError when the job was cancelled."""
        if self.cancel.is_set():
            raise JobCancelledError

    def on_cancel(self, action: Callable[[], object]) -> None:
        """Have ``action`` called from another thread when the job is cancelled; at once if it was already.

        For what blocks without reporting, e.g. ``Runner.abort``. It must not block itself.
        """
        with self._lock:
            self._on_cancel.append(action)
            late = self.cancel.is_set()
        if late:
            action()

    def _cancel(self) -> None:
        with self._lock:
            self.cancel.set()
            actions = list(self._on_cancel)
        for action in actions:
            try:
                action()
            except Exception as error:  # noqa: BLE001 - the other actions, jobs and STOP go on
                _log.error("Cancelling a job: %s", words_for(error))

    def _take_newest(self) -> list[Any]:
        with self._lock:
            newest, self._newest = self._newest, []
        return newest

    def _send(self, kind: str, value: object) -> None:
        with contextlib.suppress(RuntimeError):  # the window is gone
            self._post.arrived.emit(_Mail(self._number, kind, value))


Work = Callable[[JobContext], Any]


class Job(QObject):
    """A piece of work in a thread of its own; made by :class:`JobRunner`.

    Signals, all in the window's thread: ``started``; ``progressed`` with the newest report; then one of
    ``succeeded`` with the result, ``failed`` with a text for the user, and ``cancelled`` with what is left,
    in words; and last ``ended``.
    """

    started = Signal()
    progressed = Signal(object)
    succeeded = Signal(object)
    failed = Signal(str)
    cancelled = Signal(str)
    ended = Signal()

    def __init__(
        self, title: str, work: Work, context: JobContext, lanes: frozenset[str], *, exclusive: bool
    ) -> None:
        super().__init__()
        self.title = title
        self.lanes = lanes
        self.exclusive = exclusive
        self.quiet = False
        """Whether it is too small to be shown as running: a value read back every few seconds."""
        self.endless = False
        """Whether it goes on until it is cancelled."""
        self.state = JobState.WAITING
        self.error: BaseException | None = None
        self.became = "done"
        """What is said of one that succeeded; set before it has ended."""
        self._work: Work | None = work
        self._context = context

    @property
    def is_over(self) -> bool:
        """Whether it succeeded, failed or was cancelled."""
        return self.state not in (JobState.WAITING, JobState.RUNNING)

    def cancel(self) -> None:
        """Ask the work to end; callable from any thread, returns at once."""
        self._context._cancel()

    @property
    def is_cancelling(self) -> bool:
        """Whether it was asked to end."""
        return self._context.cancel.is_set()


class JobRunner(QObject):
    """Starts jobs: device jobs one at a time for each device, compute jobs at once.

    Signals
    -------
    job_started, job_ended : Job
    """

    job_started = Signal(object)
    job_ended = Signal(object)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._post = _Post(self)
        self._post.arrived.connect(self._receive, Qt.ConnectionType.QueuedConnection)
        self._numbers = itertools.count()
        self._jobs: dict[int, Job] = {}
        self._waiting: list[int] = []
        self._threads: list[threading.Thread] = []
        self._silent = False

    def silence(self) -> None:
        """Have jobs end without a word from now on: whatever showed them is being deleted."""
        self._silent = True
        for job in self._jobs.values():
            if isValid(job):  # Qt may delete it before what showed it
                job.blockSignals(True)

    # Starting ------------------------------------------------------------------------------------
    def device(
        self, title: str, work: Work, lanes: Collection[str], *, quiet: bool = False, endless: bool = False
    ) -> Job:
        """Run a short job on some devices, after those before it that use one of them.

        One that is ``endless`` goes on until it is cancelled: nothing may wait behind it.

        Raises BusyError when a job that holds the whole bench runs or waits, an endless one holds a device,
        or too many jobs wait.
        """
        self._require_free(lanes)
        if len(self._waiting) >= _MOST_WAITING:
            raise BusyError(f"{title}: {_MOST_WAITING} commands are waiting already. Wait a moment.")
        job = self._add(title, work, frozenset(lanes), exclusive=False)
        job.quiet, job.endless = quiet, endless
        return job

    def exclusive(self, title: str, work: Work) -> Job:
        """Run a job that needs the whole bench: a sweep, a run, a calibration.

        Raises BusyError when another such job runs or waits, or an endless one holds a device.
        """
        self._require_free(DEVICE_LANES)
        return self._add(title, work, DEVICE_LANES, exclusive=True)

    def compute(self, title: str, work: Work) -> Job:
        """Run a job that touches no device, at once."""
        return self._add(title, work, frozenset(), exclusive=False)

    def watch(self, title: str, work: Work) -> Job:
        """Run a quiet look at a device, at once and whatever holds it: what drivers allow from any thread."""
        job = self.compute(title, work)
        job.quiet = True
        return job

    # What runs -----------------------------------------------------------------------------------
    @property
    def jobs(self) -> tuple[Job, ...]:
        """Jobs that run or wait."""
        return tuple(self._jobs.values())

    @property
    def exclusive_job(self) -> Job | None:
        """The job that holds the whole bench, or waits for it."""
        return next((job for job in self._jobs.values() if job.exclusive), None)

    @property
    def device_jobs(self) -> tuple[Job, ...]:
        """Jobs on devices that run or wait."""
        return tuple(job for job in self._jobs.values() if job.lanes)

    def is_busy(self, lane: str) -> bool:
        """Whether a job on a device runs or waits."""
        return any(lane in job.lanes for job in self._jobs.values())

    def before(self, job: Job) -> tuple[Job, ...]:
        """Return the jobs that one waits for; none where it runs."""
        if job.state is not JobState.WAITING:
            return ()
        earlier = itertools.takewhile(lambda other: other is not job, self._jobs.values())
        return tuple(other for other in earlier if other.lanes & job.lanes)

    def withdraw(self, job: Job) -> bool:
        """End a job that still waits, as cancelled; returns whether it did. For the window's thread."""
        number = next((n for n in self._waiting if self._jobs[n] is job), None)
        if number is None:
            return False
        self._finish(number, "cancelled", JobCancelledError())
        return True

    def cancel_device_jobs(self) -> None:
        """Ask every device job to end; those that wait end at once. For the window's thread."""
        for job in self.device_jobs:
            job.cancel()
        waiting = [number for number in self._waiting if self._jobs[number].lanes]
        # None of them begins when the one before it ends. What uses no device waits for its turn only.
        self._waiting = [number for number in self._waiting if number not in waiting]
        for number in waiting:
            self._finish(number, "cancelled", JobCancelledError())
        for job in self.device_jobs:  # what an end has asked for
            job.cancel()

    def join(self, timeout_s: float) -> bool:
        """Wait for the threads of all jobs; returns whether they ended in time. Blocks: for the very end.

        Also for those that have sent their last message: an interpreter that ends meanwhile aborts in Qt.
        """
        return joined(self._threads, timeout_s)

    # Inside --------------------------------------------------------------------------------------
    def _require_free(self, lanes: Collection[str]) -> None:
        """Raise BusyError where a job would wait for the whole bench, or for an endless one."""
        if (holder := self.exclusive_job) is not None:
            raise BusyError(f"{holder.title} is running. Wait for its end, or stop it (Esc).")
        for job in self._jobs.values():
            if job.endless and not job.is_cancelling and not job.lanes.isdisjoint(lanes):
                raise BusyError(f"{job.title} goes on until it is stopped. Stop it first, there or with Esc.")

    def _add(self, title: str, work: Work, lanes: frozenset[str], *, exclusive: bool) -> Job:
        number = next(self._numbers)
        job = Job(title, work, JobContext(number, self._post), lanes, exclusive=exclusive)
        job.blockSignals(self._silent)
        self._jobs[number] = job
        self._waiting.append(number)
        # Not before the caller has connected its signals.
        self._post.arrived.emit(_Mail(number, "start", None))
        return job

    def _start_what_can(self) -> None:
        taken: set[str] = set()
        for number, job in self._jobs.items():
            if number not in self._waiting:
                taken |= job.lanes
        for number in list(self._waiting):
            if number not in self._jobs:
                continue  # withdrawn by what the start of one before it has led to
            job = self._jobs[number]
            if number in self._waiting and not (job.lanes & taken):
                self._waiting.remove(number)
                self._start(number, job)
            taken |= job.lanes  # who comes later does not overtake

    def _start(self, number: int, job: Job) -> None:
        job.state = JobState.RUNNING
        thread = threading.Thread(
            target=_do, args=(job._work, job._context), name=f"job: {job.title}", daemon=True
        )
        # What the work holds (a recording's buffers) goes with its thread, not with whoever keeps the job.
        job._work = None
        try:
            thread.start()
        except RuntimeError as error:  # the system has no more: its devices are for others
            self._finish(number, "failed", error)
            return
        self._threads = [*(t for t in self._threads if t.is_alive()), thread]
        job.started.emit()
        self.job_started.emit(job)

    def _receive(self, mail: _Mail) -> None:
        job = self._jobs.get(mail.number)
        if job is None:
            return
        if mail.kind == "start":
            self._start_what_can()
            return
        for value in job._context._take_newest():
            job.progressed.emit(value)
        if mail.kind != "progress":
            self._finish(mail.number, mail.kind, mail.value)

    def _finish(self, number: int, kind: str, value: Any) -> None:
        job = self._jobs.pop(number)
        if number in self._waiting:
            self._waiting.remove(number)
        if kind == "succeeded":
            job.state = JobState.SUCCEEDED
            job.succeeded.emit(value)
        elif kind == "cancelled":
            job.state, job.error = JobState.CANCELLED, value
            job.cancelled.emit("\n".join(getattr(value, "__notes__", ())) or f"{job.title}: stopped.")
        else:
            job.state, job.error = JobState.FAILED, value
            job.failed.emit(words_for(value))
        job.ended.emit()
        self.job_ended.emit(job)
        self._start_what_can()


def joined(threads: Collection[threading.Thread], timeout_s: float) -> bool:
    """Wait for threads; returns whether all ended in time."""
    deadline_s = time.monotonic() + timeout_s
    for thread in threads:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)


def words_for(error: BaseException) -> str:
    """Return an error as the user reads it: a sentence where it is known, else its traceback."""
    text = in_words(error)
    if text is None:
        text = "An error in the program itself; please report it.\n" + "".join(
            traceback.format_exception(error)
        )
        return text.rstrip()
    return "\n".join([text, *getattr(error, "__notes__", ())])


def _do(work: Work, context: JobContext) -> None:
    """Do the work of a job, in the job's thread. Holds no Qt object: those die in the window's thread."""
    try:
        context.check()
        result = work(context)
    except (KeyboardInterrupt, SystemExit) as error:
        context._send("cancelled", error)
    except BaseException as error:  # noqa: BLE001 - whatever it is, the window shows it
        stopped = context.cancel.is_set() and isinstance(error, StoppedError)
        context._send("cancelled" if stopped else "failed", error)
    else:
        context._send("succeeded", result)
