"""Carry out a plan on a bench, step by step, into a run.

::

    IDLE --execute--> RUNNING --pause--> PAUSED --resume--> RUNNING
                         |                  |
                         +-- last step, abort (between steps), stop (at once), error --> ENDING --> FINISHED

On every way out of RUNNING and PAUSED the bench is made safe (light off, motion stopped, SLM blank if so
configured) and the run's files are closed, in that order, each tried even when the one before failed.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

from drivers.errors import LimitError, StoppedError
from drivers.frame import Frame
from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.bench.safety import stop_until
from instrument.bench.sequence import Wire
from instrument.files.errors import BenchError
from instrument.files.slm_image import read_slm_levels
from instrument.plan import Light, Plan, Step
from instrument.runs.finish import end_run
from instrument.runs.run import FinishReason, Run
from instrument.runs.timed import TimedSteps, left_to, take_steps
from instrument.runs.writer import FrameToStore, RunWriter

_log = logging.getLogger(__name__)


class RunState(StrEnum):
    """Where a runner is."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSED = "paused"
    ENDING = "ending"
    """The bench is being made safe and the files are being closed."""
    FINISHED = "finished"


@dataclass(frozen=True, slots=True)
class RunStatus:
    """A snapshot of a runner, for a progress bar or a window."""

    state: RunState
    done: int
    total: int
    """Steps whose frames are on the disk, and steps of the plan."""
    done_here: int = 0
    """Steps among ``done`` that this runner did: those of a run that goes on were done before."""
    step: Step | None = None
    """The step being done, or the last one."""
    seconds: float = 0.0
    """Since the run was started or resumed."""
    seconds_left: float | None = None
    """Estimated from the steps done so far; None before the first."""
    dropped: int = 0
    """Frames that the camera dropped during exposures of this run."""
    saturated_fraction: float = 0.0
    """Of the newest frame."""
    reason: FinishReason | None = None
    """Why it ended, once it has."""
    newest: Snapshot | None = field(default=None, compare=False, repr=False)
    """The photograph that was stored last."""


RunProgress = Callable[[RunStatus], None]
FrameWatch = Callable[[Step, Snapshot], bool]
"""Sees each step's photograph once it is stored; returns whether it touched the bench."""


class _EndedEarlyError(Exception):
    """Carries the reason out of the step loop."""

    def __init__(self, reason: FinishReason) -> None:
        self.reason = reason


class StepSettings:
    """Brings the bench to a step's settings, touching only what differs from the step before."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._now: dict[str, Any] = {}
        """What is set, by the names of a step's fields; not there where it is not known."""

    def actions(self, step: Step, but: str = "") -> list[Callable[[], None]]:
        """Return what to do, in order: camera, motion, SLM, light; one field may be left alone."""
        bench = self._bench
        setters: dict[str, Callable[[Any], object]] = {
            "exposure_ms": bench.camera.set_exposure_ms,
            "gain": bench.camera.set_gain,
            "source_um": lambda source_um: bench.place_source(*source_um),
            "stage": self._move_stage,
            "slm_image": self._display,
            "scene_lit": lambda lit: bench.scene_on() if lit else bench.scene_off(),
            "light": self._set_light,
        }
        wanted = {name: getattr(step, name) for name in setters}
        return [
            partial(self._set, name, value, setters[name])
            for name, value in wanted.items()
            if name != but and value not in (None, {}) and value != self._now.get(name)
        ]

    def unknown(self, name: str) -> None:
        """Take note that a field is as something else left it."""
        self._now.pop(name, None)

    def darken(self) -> None:
        """Turn off the light for a pause; the next step turns it on again."""
        light: Light | None = self._now.get("light")
        if light is not None and light.kind != "off":
            self._bench.source_off()
            del self._now["light"]

    def _set(self, name: str, value: Any, setter: Callable[[Any], object]) -> None:
        for unknown in ("source_um", "stage") if name in ("source_um", "stage") else (name,):
            self._now.pop(unknown, None)
        setter(value)
        self._now[name] = value

    def _move_stage(self, position: Mapping[str, float]) -> None:
        if self._bench.stage is None:
            raise BenchError(f"A stage position, {position}: this bench has no stage.")
        self._bench.stage.move_to(position)

    def _display(self, path: Path) -> None:
        if self._bench.slm is None:
            raise BenchError(f"SLM image {path}: this bench has no SLM.")
        self._bench.slm.display(read_slm_levels(path))

    def _set_light(self, light: Light) -> None:
        if light.kind == "source":
            self._bench.source_on()
        elif light.kind == "off":
            self._bench.source_off()
        elif self._bench.led_array is None:
            raise BenchError(f"light {light}: this bench has no LED array.")
        else:
            self._bench.led_array.set_pattern(light.pattern())


class Runner:
    """Does a plan's steps and stores one frame for each.

    ``execute`` blocks in the thread that calls it; ``pause``, ``resume``, ``abort``, ``stop`` and ``status``
    may be called from any thread.

    Parameters
    ----------
    bench : Bench
        Open.
    writer : RunWriter
        The run; the runner finishes and closes it.
    todo : sequence of int, optional
        Indices of the steps to do, in order; None means all.
    start : Step, optional
        The bench's state before the first step, for a run that is continued: what the plan leaves as it is
        then is as it was.
    on_progress : callable, optional
        Called with the status after every step and change of state, in the thread that executes.
    on_frame : callable, optional
        Called with each step and its photograph once that is stored, in the thread that executes, before the
        next step begins. It may use the bench, and then returns True: the next step sets everything anew.
        What it raises ends the run as failed.
    """

    def __init__(
        self,
        bench: Bench,
        plan: Plan,
        writer: RunWriter,
        *,
        todo: Sequence[int] | None = None,
        start: Step | None = None,
        on_progress: RunProgress | None = None,
        on_frame: FrameWatch | None = None,
    ) -> None:
        self._bench = bench
        self._plan = plan
        self._writer = writer
        self._start = start
        self._todo = frozenset(range(len(plan)) if todo is None else todo)
        self.on_progress = on_progress
        self.on_frame = on_frame
        self._settings = StepSettings(bench)
        self._timed = TimedSteps(bench, plan)
        self._condition = threading.Condition()
        self._pausing = False
        self._aborting = False
        self._stopping = threading.Event()
        self._finished = threading.Event()
        self._status = RunStatus(RunState.IDLE, len(plan) - len(self._todo), len(plan))
        self._started_s = 0.0
        self._thread: threading.Thread | None = None

    # From any thread -----------------------------------------------------------------------------
    @property
    def status(self) -> RunStatus:
        """Where the run is now."""
        with self._condition:
            return self._status

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self._writer.path

    @property
    def mended(self) -> tuple[str, ...]:
        """What was done to the files of a run that goes on, in words."""
        return self._writer.mended

    @property
    def is_pausing(self) -> bool:
        """Whether the run is paused, or will be before its next step."""
        with self._condition:
            return self._pausing

    def pause(self) -> None:
        """Wait before the next step, light off, until ``resume``."""
        with self._condition:
            self._pausing = True
            self._condition.notify_all()

    def resume(self) -> None:
        """Go on after ``pause``."""
        with self._condition:
            self._pausing = False
            self._condition.notify_all()

    def abort(self) -> None:
        """End before the next step."""
        with self._condition:
            self._aborting = True
            self._condition.notify_all()

    def stop(self) -> None:
        """End at once: light off and motion stopped when this returns, whatever was going on.

        Raises StepsFailedError when a device could not be made safe; all were tried.
        """
        self._stopping.set()
        with self._condition:
            self._condition.notify_all()

        def stop() -> None:
            if self.status.state is not RunState.ENDING:
                self._bench.stop()

        executes_here = self._thread in (None, threading.current_thread())
        stop_until(stop, self._finished, once=executes_here)

    # In one thread -------------------------------------------------------------------------------
    def keep_text(self, name: str, text: str) -> None:
        """Write one more small file of the run: what a routine knows of it; RunError when the disk fails."""
        self._writer.keep_text(name, text)

    def discard(self) -> None:
        """Close the run's files without carrying anything out; it can be resumed."""
        self._writer.close()

    def execute(self) -> Run:
        """Do the steps; returns the finished run, whose ``reason`` says how it ended.

        Raises DeviceError or BenchError: what made the run fail; it was marked as failed, and the bench made
        safe. A note says where the run is. Raises KeyboardInterrupt or SystemExit after the run was marked as
        aborted and the bench made safe.
        """
        if self._thread is not None:
            raise RuntimeError("A runner executes its plan once; make a new one (or resume the run).")
        self._thread = threading.current_thread()
        self._started_s = time.monotonic()
        try:
            self._report(state=RunState.RUNNING)
            self._writer.start(steps=len(self._todo))
            self._do_steps()
        except _EndedEarlyError as early:
            run = self._end(early.reason)
        except StoppedError as error:
            if not self._stopping.is_set():
                self._end(FinishReason.FAILED, error)
                raise
            run = self._end(FinishReason.STOPPED)
        except Exception as error:
            self._end(FinishReason.STOPPED if self._stopping.is_set() else FinishReason.FAILED, error)
            raise
        else:
            run = self._end(FinishReason.COMPLETED)
        finally:
            if not self._finished.is_set():  # Ctrl-C, or a second one before the ending had begun
                self._end(FinishReason.ABORTED, sys.exception())
        return run

    def _do_steps(self) -> None:
        part, part_started_s = -1, 0.0
        todo = (step for step in self._plan.whole_steps(self._start) if step.index in self._todo)
        for wire, steps in self._timed.groups(todo):
            step = steps[0]
            self._between_steps()
            if step.part != part:
                part_started_s = time.monotonic() - step.start_after_s
            part = steps[-1].part
            self._wait_until(part_started_s + step.start_after_s)
            self._report(step=step)
            if wire is not None and (taken := self._take_sequence(wire, steps)) is not None:
                self._store(steps, taken)
                continue
            for number, step in enumerate(steps):
                if number:
                    self._between_steps()
                    self._report(step=step)
                self._store([step], [self._take(step)])

    def _store(self, steps: Sequence[Step], taken: Sequence[Snapshot]) -> None:
        pairs = list(zip(steps, taken, strict=True))
        self._writer.write([FrameToStore(step.index, s.image, s.metadata, s.average) for step, s in pairs])
        for step, snapshot in pairs:
            self._report_stored(step, snapshot)
            if self.on_frame is not None and self.on_frame(step, snapshot):
                self._settings = StepSettings(self._bench)

    def _take_sequence(self, wire: Wire, steps: Sequence[Step]) -> list[Snapshot] | None:
        """Take steps by one sequence; None where its source refuses it and the plan leaves the choice."""
        shown_by_itself = left_to(wire)
        for setting in self._settings.actions(steps[0], but=shown_by_itself):
            self._raise_if_stopping()
            setting()
        self._raise_if_stopping()
        try:
            taken, troubles = take_steps(wire, steps, self._see)
        except LimitError as refusal:
            if not self._timed.may_step(steps):
                raise
            self._writer.note("stepped", text=str(refusal), first=steps[0].index, steps=len(steps))
            _log.warning("Taken step by step, not timed by hardware: %s", refusal)
            return None
        finally:
            self._settings.unknown(shown_by_itself)
        self._raise_if_stopping()  # the light may have gone out during the exposures
        for words in troubles:
            self._writer.note("sequence taken again", text=words, first=steps[0].index, steps=len(steps))
            _log.warning("%s: a sequence of %d steps was taken again: %s", steps[0], len(steps), words)
        return taken

    def _see(self, frame: Frame) -> None:
        self._bench.newest_frame = frame

    def _take(self, step: Step) -> Snapshot:
        for setting in self._settings.actions(step):
            self._raise_if_stopping()
            setting()
        self._raise_if_stopping()
        snapshot = self._bench.snap(step.average)
        self._raise_if_stopping()  # the light may have gone out during the exposure
        return snapshot

    def _between_steps(self) -> None:
        with self._condition:
            paused = self._pausing
        if paused and not self._aborting and not self._stopping.is_set():
            self._settings.darken()
            self._writer.note("paused")
            self._report(state=RunState.PAUSED)
            with self._condition:
                self._condition.wait_for(
                    lambda: not self._pausing or self._aborting or self._stopping.is_set()
                )
            self._writer.note("resumed")
            self._report(state=RunState.RUNNING)
        self._raise_if_stopping()
        if self._aborting:
            raise _EndedEarlyError(FinishReason.ABORTED)

    def _wait_until(self, when_s: float) -> None:
        while (left_s := when_s - time.monotonic()) > 0:
            self._settings.darken()
            with self._condition:
                self._condition.wait_for(
                    lambda: self._pausing or self._aborting or self._stopping.is_set(), left_s
                )
            self._between_steps()

    def _raise_if_stopping(self) -> None:
        if self._stopping.is_set():
            raise _EndedEarlyError(FinishReason.STOPPED)

    # The way out ---------------------------------------------------------------------------------
    def _end(self, reason: FinishReason, error: BaseException | None = None) -> Run:
        """Make the bench safe, then finish the run; a failure here never hides ``error``."""
        interruption = self._last_report(state=RunState.ENDING)
        try:
            run = end_run(self._bench, self._writer, reason, error)
        finally:
            self._finished.set()
            interruption = self._last_report(state=RunState.FINISHED, reason=reason) or interruption
        if error is not None:
            error.add_note(
                f"{len(run.records)} of {run.n_frames} frames are kept. For the others: "
                f"diffuserbench resume {run.path}"
            )
        if interruption is not None and error is None:
            raise interruption
        return run

    def _last_report(self, **changes: object) -> BaseException | None:
        """Report; a listener that raises cannot keep the run from its end. Returns its interruption."""
        try:
            self._report(**changes)
        except Exception:  # noqa: BLE001 - a listener's failure is not the run's
            return None
        except BaseException as interruption:  # noqa: BLE001 - e.g. a listener that passes Ctrl-C on
            return interruption
        return None

    # Status --------------------------------------------------------------------------------------
    def _report_stored(self, step: Step, snapshot: Snapshot) -> None:
        now = self.status
        done_here = now.done_here + 1
        seconds = time.monotonic() - self._started_s
        self._report(
            step=step,
            done=now.done + 1,
            done_here=done_here,
            seconds=seconds,
            seconds_left=seconds / done_here * (len(self._todo) - done_here),
            dropped=now.dropped + snapshot.metadata.dropped_before,
            saturated_fraction=snapshot.metadata.saturated_fraction,
            newest=snapshot,
        )

    def _report(self, **changes: object) -> None:
        with self._condition:
            self._status = replace(self._status, **changes)  # type: ignore[arg-type]
            status = self._status
        if self.on_progress is not None:
            self.on_progress(status)


@contextmanager
def discarded(runner: Runner) -> Iterator[None]:
    """Give a run's folder up again where something fails between a runner's making and its run."""
    try:
        yield
    except BaseException:
        runner.discard()
        raise
