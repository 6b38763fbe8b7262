"""Pause, abort or stop a procedure of several runs from another thread, also between its runs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError, note_failures, stop_until
from instrument.files.errors import BenchError
from instrument.runs.run import FinishReason
from instrument.runs.runner import Runner


class EndedEarlyError(BenchError):
    """A procedure was aborted or stopped between its runs, as somebody asked; the bench is safe."""

    exit_code = 1

    def __init__(self, reason: FinishReason) -> None:
        self.reason = reason
        super().__init__(f"The procedure was {reason}.")


class RunControl:
    """What a window or a key handler holds of a procedure that goes on in another thread.

    The procedure brings its runners to :meth:`follow` and calls :meth:`check` between other steps. All other
    methods may be called from any thread at any time; what was asked for before a run began holds for it.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self.run: Path | None = None
        """The run that goes on or went last; None before the first."""
        self.left: Callable[[Path], str] | None = None
        """Says what an interruption leaves of that run, and what makes its result of it."""
        self._runner: Runner | None = None
        self._bench: Bench | None = None
        self._idle = threading.Event()
        self._idle.set()
        self._pausing = False
        self._ending: FinishReason | None = None

    # From any thread -----------------------------------------------------------------------------
    @property
    def is_pausing(self) -> bool:
        """Whether the procedure is paused, or will be before its next step."""
        with self._condition:
            return self._pausing

    @property
    def ending(self) -> FinishReason | None:
        """Why the procedure was asked to end; None while it may go on."""
        with self._condition:
            return self._ending

    def pause(self) -> None:
        """Wait before the next step, light off, until :meth:`resume`."""
        self._pause(True)

    def resume(self) -> None:
        """Go on after :meth:`pause`."""
        self._pause(False)

    def abort(self) -> None:
        """End before the next step; a run that goes on can be resumed later."""
        with self._condition:
            self._ending = self._ending or FinishReason.ABORTED
            if self._runner is not None:
                self._runner.abort()
            self._condition.notify_all()

    def stop(self) -> None:
        """End at once: light off and motion stopped when this returns, whatever was going on.

        Raises StepsFailedError when a device could not be made safe; all were tried.
        """
        with self._condition:
            self._ending = FinishReason.STOPPED
            runner, bench = self._runner, self._bench
            self._condition.notify_all()
        try:
            if runner is not None:
                runner.stop()
        finally:
            if bench is not None and not self._idle.is_set():
                stop_until(bench.stop, self._idle)

    # In the procedure's thread -------------------------------------------------------------------
    @contextmanager
    def procedure(self, bench: Bench) -> Iterator[None]:
        """Hold the bench while the block runs; on the way out of an error the bench is made safe."""
        with self._condition:
            self._bench = bench
            self._idle.clear()
        try:
            self.check()
            yield
        except BaseException as error:
            try:
                bench.stop()
            except StepsFailedError as failure:
                note_failures(error, failure)
            raise
        finally:
            with self._condition:
                self._bench = self._runner = None
                self._idle.set()

    def follow(self, runner: Runner) -> None:
        """Let a runner of the procedure be paused, aborted and stopped."""
        with self._condition:
            self._runner, self.run = runner, runner.path
            if self._pausing:
                runner.pause()
            if self._ending is FinishReason.ABORTED:
                runner.abort()
        if self.ending is FinishReason.STOPPED:
            runner.stop()

    def check(self) -> None:
        """Wait, everything dark, while the procedure is paused.

        Raises EndedEarlyError when it was aborted or stopped.
        """
        if self.is_pausing and self.ending is None and (bench := self._bench) is not None:
            if bench.can_switch_source:
                bench.source_off()
            if bench.can_switch_scene:
                bench.scene_off()
        with self._condition:
            self._condition.wait_for(lambda: not self._pausing or self._ending is not None)
            if self._ending is not None:
                raise EndedEarlyError(self._ending)

    def _pause(self, pausing: bool) -> None:
        with self._condition:
            self._pausing = pausing
            if self._runner is not None:
                if pausing:
                    self._runner.pause()
                else:
                    self._runner.resume()
            self._condition.notify_all()
