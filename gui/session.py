"""The bench as the windows have it: devices with their state, the live view, runs, STOP, the log."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Literal

from PySide6.QtCore import QObject, Qt, QTimer, Signal

from drivers.camera import Camera
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.frame import Frame, FrameMetadata
from gui.background import NewestOnly
from gui.jobs import BusyError, Job, JobContext, JobRunner, Work, joined, words_for
from gui.live_upkeep import LiveUpkeep
from gui.session_news import DeviceState, LogBridge, OperatorRequest, is_gone, name_of
from gui.words import in_the_log, in_the_window, quantity
from instrument.bench.bench import Bench
from instrument.bench.config import BenchConfig, Kind
from instrument.bench.kept import KeptWithBench
from instrument.bench.lit import LightState, switch_light
from instrument.files.errors import BenchError
from instrument.live.light_log import LightLog, light_words
from instrument.live.live_camera import LiveCamera

Level = Literal["debug", "info", "warning", "error"]

_STOP_REPEAT_S = 0.05
_STOP_WAIT_S = 10.0
"""A job that has not ended by then is named; STOP goes on, for the job may be about to start a move."""
_WATCH_MS = 500


class BenchSession(QObject):
    """One bench, opened device by device, so that one that fails leaves the others at work.

    Parameters
    ----------
    config : BenchConfig
    parent : QObject, optional

    Signals (all in the window's thread)
    ------------------------------------
    device_changed : str
        The kind of device whose state changed.
    logged : str, str
        Level (``"debug"``, ``"info"``, ``"warning"``, ``"error"``) and text.
    run_finished : Path
        A run's or calibration's folder that was just written.
    stop_pressed
        STOP was pressed just now.
    stopped
        STOP was pressed, and everything is safe or known not to be.
    asked : object
        An :class:`OperatorRequest`: something is to be done by hand.
    handed_on : str, Path
        A panel's name and a file or folder that another panel gives it to work with.
    bench_wanted : object
        Another bench is to be opened in this one's place: its BenchConfig.
    kept_changed
        Something else is kept with the bench.
    pictured
        The live view shows something: its first frame, or what will be on it coarsely.
    opened, closed
        Every device was tried; everything was closed.
    """

    device_changed = Signal(str)
    logged = Signal(str, str)
    run_finished = Signal(object)
    stop_pressed = Signal()
    stopped = Signal()
    asked = Signal(object)
    handed_on = Signal(str, object)
    bench_wanted = Signal(object)
    kept_changed = Signal()
    opened = Signal()
    pictured = Signal()
    closed = Signal()
    _from_thread = Signal(object)

    def __init__(self, config: BenchConfig, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.config = config
        self.bench = Bench(config, self._ask)
        self.live = LiveCamera(self.bench.camera if config.devices else None)
        self.lights = LightLog(partial(light_words, self.bench))
        self.jobs = JobRunner(self)
        self.jobs.job_ended.connect(self._job_ended)
        self.viewing = LiveUpkeep(self.jobs, self.live, self._may_view, self)
        self.kept = KeptWithBench(config.data_folder)
        """Presets, places, what was used last; read when the bench is opened."""
        self._keeper = NewestOnly(self.jobs, "Keeping it with the bench", partial(self.log, "error"))
        self._states: dict[str, DeviceState] = {kind: DeviceState("closed") for kind in self.bench.devices}
        self._threads: list[threading.Thread] = []
        self._stopping = self._stop_again = False
        self.is_closing = False
        """Whether the end has begun."""
        self._all_closed = threading.Event()
        self.is_closed = False
        self._requests: list[OperatorRequest] = []
        self._from_thread.connect(self._do, Qt.ConnectionType.QueuedConnection)
        self._handler = LogBridge(lambda *line: self._in_window(self.log, *line))
        logging.getLogger().addHandler(self._handler)
        for room in ("instrument", "drivers", "calibration_routines"):
            logging.getLogger(room).setLevel(logging.INFO)
        self._hung: DeviceError | None = None
        self._watch = QTimer(self)
        self._watch.setInterval(_WATCH_MS)
        self._watch.timeout.connect(self._look_after_devices)

    # What there is -------------------------------------------------------------------------------
    @property
    def runs_folder(self) -> Path:
        """Where runs and calibrations are written."""
        return self.config.data_folder

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of devices that the bench has."""
        return tuple(self.bench.devices)

    def state(self, kind: str) -> DeviceState:
        """Return how a device is doing; ``"closed"`` for one that the bench does not have."""
        return self._states.get(kind, DeviceState("closed"))

    def is_open(self, kind: str) -> bool:
        """Whether a device can be used."""
        return self.state(kind).condition == "open"

    @property
    def is_ready(self) -> bool:
        """Whether opening every device was tried, and the camera is open."""
        return self._watch.isActive() and "camera" in self.kinds and self.is_open("camera")

    def _may_view(self) -> bool:
        return self.is_open("camera") and not self.is_closing

    # Opening -------------------------------------------------------------------------------------
    def open(self) -> Job:
        """Open every device, each whatever happens to the others, then start the live view."""
        for kind in self._states:
            self._set_state(kind, DeviceState("opening"))

        def work(context: JobContext) -> None:
            self._read_kept()
            for kind in self.kinds:
                context.check()
                self._open_one(kind)

        job = self.jobs.exclusive("Opening the bench", work)
        job.quiet = not self.kinds
        job.ended.connect(self._all_tried)
        return job

    def _read_kept(self) -> None:
        """Read what is kept with the bench, in a job's thread."""
        try:
            self.kept.read()
        except BenchError as error:
            self._in_window(self.log, "error", str(error))
        else:
            self._in_window(self.kept_changed.emit)

    def keep(self, kind: str, name: str, value: Any) -> None:
        """Keep a value with the bench, under a name; None: no longer."""
        self.kept.put(kind, name, value)
        self.kept_changed.emit()
        self._keeper.ask(self.kept.write, lambda _: None)

    def reconnect(self, kind: Kind) -> None:
        """Close and open a device again; while a run goes on, say that it has to wait."""

        def work(_: JobContext) -> None:
            device = self.bench.devices[kind]
            if kind == "camera":
                with contextlib.suppress(DeviceError):  # it is the broken connection that is given up
                    self.live.stop()
            with contextlib.suppress(DeviceError):
                device.close()
            self._open_one(kind)

        try:
            job = self.jobs.device(f"Connecting the {name_of(kind)}", work, {kind})
        except BusyError as error:
            self.log("warning", str(error))
            return
        self._set_state(kind, DeviceState("opening", simulated=self.state(kind).simulated))
        job.ended.connect(lambda: self._tried(kind))

    def _open_one(self, kind: Kind) -> None:
        """Open a device, in a job's thread; a failure becomes its state."""
        try:
            device = self.bench.open_device(kind)
            identity = device.identity
        except DeviceError as error:
            self._in_window(self._not_opened, kind, words_for(error))
        else:
            state = DeviceState("open", str(identity), identity.simulated)
            self._in_window(self._set_state, kind, state)

    def _not_opened(self, kind: str, why: str) -> None:
        self._set_state(kind, DeviceState("failed", why, self.state(kind).simulated))
        self.log("error", why)

    def _all_tried(self) -> None:
        for kind in self.kinds:
            self._tried(kind)
        if not self.is_closing:
            self._watch.start()
            self.opened.emit()

    def _tried(self, kind: str) -> None:
        if self.state(kind).condition == "opening":
            self._set_state(kind, DeviceState("failed", "It was not opened."))
        if kind == "camera" and self.is_open("camera") and self.viewing.wanted:
            self.viewing.start()

    # Jobs ----------------------------------------------------------------------------------------
    def camera_job(self, title: str, work: Callable[[Camera], Any], *, idle: bool = False) -> Job:
        """Run a short job on the camera; with ``idle`` the live view pauses for it (regions, formats ...)."""

        def on_camera(_: JobContext) -> Any:
            with self.live.paused() if idle else contextlib.nullcontext():
                return work(self.bench.camera)

        return self.jobs.device(title, on_camera, {"camera"})

    def switch_light(self, light: LightState, *, quiet: bool = False) -> Job:
        """Light the scene, the point source, or nothing; ``quiet`` where nobody asked for it."""
        return self.jobs.device(
            f"Light: {light}", lambda _: switch_light(self.bench, light), {"led_array", "light"}, quiet=quiet
        )

    def exclusive_job(self, title: str, work: Work) -> Job:
        """Run a job that needs the whole bench (a run, a calibration): the live view is ended for it.

        Raises BusyError when another such job runs.
        """

        def alone(context: JobContext) -> Any:
            self.live.stop()
            before = self.bench.newest_frame  # of an earlier job, and not to be taken for a new one

            def newest() -> Frame | None:
                frame = self.bench.newest_frame
                return None if frame is before else frame

            with self.live.watching(newest):
                return work(context)

        return self.jobs.exclusive(title, alone)

    def describe_frame(self, frame: FrameMetadata) -> str:
        """Return when a frame came, how long it was exposed, what was lit, and whether it is simulated."""
        lit = self.lights.during(frame)
        # By this program's clock: that of a simulated world which does not wait runs at a pace of its own.
        ago = timedelta(microseconds=(time.monotonic_ns() - frame.host_time_ns) / 1e3)
        words = [
            f"{datetime.now() - ago:%H:%M:%S}",
            quantity(frame.exposure_ms, "ms"),
            f"light: {lit or frame.led_pattern or 'not known'}",
        ]
        return ", ".join([*words, "SIMULATED"] if self.state("camera").simulated else words)

    def _job_ended(self, job: Job) -> None:
        self.lights.note()
        if job.error is not None and not self.viewing.was_told(job):
            self._note_error(job)
        elif job.lanes and not job.quiet:
            self.log("debug", f"{job.title}: done.")
        if self.viewing.is_start(job):
            self.viewing.tried(job)
        elif job.lanes and not self._stopping:
            self.viewing.goes_on()

    def _note_error(self, job: Job) -> None:
        error = job.error
        assert error is not None
        expected = StoppedError if self.viewing.is_start(job) else (StoppedError, LimitError)
        if job.quiet and isinstance(error, expected):
            return
        if job.state.value == "cancelled":
            self.log("info", f"{job.title}: stopped. " + " ".join(getattr(error, "__notes__", ())))
            return
        self.log("error", f"{job.title}: {words_for(error)}")
        if isinstance(error, DeviceError) and not isinstance(error, LimitError | StoppedError):
            self.note_failure(error, was_used=bool(job.lanes))

    def note_failure(self, error: DeviceError, *, was_used: bool, surely: bool = False) -> None:
        """Mark the device that an error names as failed, unless it only refused what it was asked.

        One that does not answer who used it stops everything else: light off, motion halted. A display that
        looked at it, beside a run perhaps, does not: an answer may be late once, and its user will meet it.
        """
        for kind, device in self.bench.devices.items():
            if (
                error.device.startswith(device.name)
                and self.state(kind).condition == "open"
                and (surely or is_gone(device, error))
            ):
                self._set_state(kind, DeviceState("failed", words_for(error), self.state(kind).simulated))
                is_free = not (self._stopping or self.is_closing)
                if was_used and is_free and isinstance(error, DeviceTimeoutError):
                    self.stop(why=f"the {name_of(kind)} does not answer")  # nor is it known what it does

    def _look_after_devices(self) -> None:
        """Notice a stream that ended or hangs, and devices that were lost while nobody used them."""
        hung, self._hung = self._hung, self.live.hangs  # at two looks: all may have stood still
        error = self.live.error or (self._hung if hung else None)
        if error is not None and self.is_open("camera"):
            self.log("error", f"Live view: {words_for(error)}")
            self.note_failure(error, was_used=True, surely=True)
        for kind, device in self.bench.devices.items():
            if self.is_open(kind) and not device.is_open and not self.jobs.is_busy(kind):
                text = f"{device.name} was lost. Check its cable and power, then reconnect it."
                self.log("error", text)
                self._set_state(kind, DeviceState("failed", text, self.state(kind).simulated))

    # STOP ----------------------------------------------------------------------------------------
    def stop(self, *, why: str = "") -> None:
        """STOP: motion halted, light off, the running device jobs cancelled. Returns at once.

        ``why`` where nobody pressed it.

        Overtakes everything: the devices' stop functions are called from a thread of their own, again and
        again until no job can start anything any more.
        """
        self._whatever_happens(self.jobs.cancel_device_jobs)
        self._whatever_happens(self.stop_pressed.emit)
        for request in list(self._requests):
            self._whatever_happens(partial(request.answer, False))
            if request.withdrawn is not None:
                self._whatever_happens(request.withdrawn)
        if self._stopping:
            self._stop_again = True
            return
        self._stopping = True
        self.log("warning", f"STOP: {why}." if why else "STOP")
        self._in_thread("STOP", self._stop_all, self.jobs.device_jobs)

    def _whatever_happens(self, step: Callable[[], object]) -> None:
        """Take a step of STOP; one that fails is logged and keeps the bench from nothing."""
        try:
            step()
        except Exception as error:  # noqa: BLE001 - the bench is made safe all the same
            self.log("error", f"STOP: {words_for(error)}")

    def _stop_all(self, running: tuple[Job, ...]) -> None:
        """Make the bench safe until a round began after the last job had ended: none can light anything."""
        deadline_s = time.monotonic() + _STOP_WAIT_S
        named = False
        while True:
            late = tuple(job.title for job in running if not job.is_over)
            failure: Exception | None = None
            try:
                self.bench.stop()
            except Exception as error:  # noqa: BLE001 - whatever it is, STOP goes on and says so
                failure = error
            if not late or self._all_closed.wait(_STOP_REPEAT_S):
                break
            if not named and time.monotonic() > deadline_s:
                named = True
                self._in_window(self._stop_late, failure, late)
        self._in_window(self._stop_ended, failure, late)

    def _stop_late(self, failure: Exception | None, late: tuple[str, ...]) -> None:
        safe = "Light off, nothing moving;" if failure is None else f"{words_for(failure)}\nAnd"
        self.log("error", f"{safe} {', '.join(late)} has not ended yet. STOP is repeated until it has.")

    def _stop_ended(self, failure: Exception | None, late: tuple[str, ...]) -> None:
        if self._stop_again and not self.is_closing:  # pressed once more: something may have begun meanwhile
            self._stop_again = False
            self._in_thread("STOP", self._stop_all, self.jobs.device_jobs)
            return
        self._stopping = self._stop_again = False
        if failure is not None:
            self.log("error", words_for(failure))
        elif late:
            self.log("error", f"Light off, nothing moving; but {', '.join(late)} has not ended yet.")
        else:
            self.log("info", "Stopped: light off, nothing moving.")
        self.stopped.emit()
        if self.viewing.wanted:
            self.viewing.start()

    # The end -------------------------------------------------------------------------------------
    def close(self) -> None:
        """End safely: jobs cancelled, light off, motion stopped, devices closed; ``closed`` follows."""
        if self.is_closing:
            return
        self.is_closing = True
        self._watch.stop()
        self.viewing.give_up()
        for job in self.jobs.jobs:
            job.cancel()
        self.stop()
        jobs = self.jobs.jobs
        self._in_thread("closing the bench", self._close_all, jobs)

    def end_by(self, signal: str) -> None:
        """Stop and close for a signal of the system, whose name is told."""
        self.log("warning", f"Signal {signal}: closing.")
        self.stop()
        self.close()

    def join(self, timeout_s: float = 5.0) -> bool:
        """Wait for all threads, after ``closed``; returns whether they ended. For the end of the program."""
        deadline_s = time.monotonic() + timeout_s
        ended = joined(self._threads, timeout_s)
        return self.jobs.join(max(0.0, deadline_s - time.monotonic())) and ended

    def _in_thread(self, name: str, work: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, name=name, daemon=True)
        self._threads = [*(t for t in self._threads if t.is_alive()), thread]
        thread.start()

    def _close_all(self, jobs: tuple[Job, ...]) -> None:
        """Close everything; whatever a device does or does not, this ends and says so."""
        problems: list[str] = []
        try:
            problems += _within(_STOP_WAIT_S, "making the bench safe", self.bench.stop)
            deadline_s = time.monotonic() + _STOP_WAIT_S
            while not all(job.is_over for job in jobs) and time.monotonic() < deadline_s:
                time.sleep(_STOP_REPEAT_S)
            problems += _within(_STOP_WAIT_S, "ending the live view", self.live.stop)
            problems += _within(_STOP_WAIT_S, "closing the bench", self.bench.close)
        finally:
            self._all_closed.set()
            self._in_window(self._ended, "\n".join(problems))

    def _ended(self, problem: str) -> None:
        if problem:
            self.log("error", problem)
        logging.getLogger().removeHandler(self._handler)
        self.is_closed = True
        for kind in self._states:
            self._set_state(kind, DeviceState("closed"))
        self.closed.emit()

    # The log and the operator --------------------------------------------------------------------
    def log(self, level: Level, text: str) -> None:
        """Write a line into the log panel; for the window's thread."""
        self.logged.emit(level, in_the_log(text.strip()))

    def _ask(self, request: str) -> None:
        """Ask the operator, from a job's thread; returns when it is done."""
        asked = OperatorRequest(request)
        self._in_window(self._show_request, asked)
        asked.wait()

    def _show_request(self, request: OperatorRequest) -> None:
        if self._stopping or self.is_closing:
            request.answer(False)  # sent before STOP: nobody may wait for its answer
            return
        self._requests.append(request)
        request.answered = lambda: self._requests.remove(request)
        self.asked.emit(request)

    def _set_state(self, kind: str, state: DeviceState) -> None:
        state = replace(state, text=in_the_window(state.text))
        if self._states[kind] != state:
            self._states[kind] = state
            if kind == "camera" and state.condition != "open":
                self.viewing.forget_failure()
            self.device_changed.emit(kind)

    def _in_window(self, call: Callable[..., object], *arguments: object) -> None:
        """Have something called in the window's thread, from another one."""
        self._from_thread.emit(partial(call, *arguments))

    def _do(self, call: Callable[[], object]) -> None:
        call()


def _within(seconds: float, title: str, work: Callable[[], object]) -> list[str]:
    """Do something in a thread of its own; return what went wrong, or that it did not end in time."""
    problems: list[str] = []

    def attempt() -> None:
        try:
            work()
        except Exception as error:  # noqa: BLE001 - whatever it is, the next step is tried
            problems.append(words_for(error))

    thread = threading.Thread(target=attempt, name=title, daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        return [f"{title.capitalize()}: a device does not answer. See by eye that light and motion are off."]
    return problems
