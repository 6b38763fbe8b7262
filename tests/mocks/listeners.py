"""What follows a procedure in tests: callbacks for its frames and events, and what it said on the way."""

from __future__ import annotations

from collections.abc import Callable

from calibration_routines.procedure import Listener
from calibration_routines.psf.sweep_plan import SweepExposures
from calibration_routines.psf.sweep_watch import SweepEvent
from instrument.runs.run_control import RunControl
from instrument.runs.runner import Runner, RunStatus


class Following(Listener):
    """Calls what it is given, and keeps steps and exposures."""

    def __init__(
        self,
        on_frame: Callable[[RunStatus], None] = lambda _: None,
        on_event: Callable[[SweepEvent], None] = lambda _: None,
    ) -> None:
        self.steps: list[str] = []
        self.found: SweepExposures | None = None
        self._on_frame, self._on_event = on_frame, on_event

    def step(self, words: str) -> None:
        self.steps.append(words)

    def exposures(self, found: SweepExposures) -> None:
        self.found = found

    def frame(self, status: RunStatus) -> None:
        self._on_frame(status)

    def event(self, event: SweepEvent) -> None:
        self._on_event(event)


class KeepingControl(RunControl):
    """Keeps the runners that it follows."""

    def __init__(self) -> None:
        super().__init__()
        self.runners: list[Runner] = []

    def follow(self, runner: Runner) -> None:
        self.runners.append(runner)
        super().follow(runner)
