"""A procedure from an open bench to its saved result, as command line, window and scripts call it alike.

A procedure is frozen data: what a person asked for. ``outlook`` says what it will do and cost, nothing moves;
``carry_out`` does all of it (homing, exposures, frames, analysis, files) and ends with the light off.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from calibration_routines.times import first_guess, took, took_before
from instrument.bench.bench import Bench
from instrument.files.atomic import DOUBTFUL
from instrument.plan import Plan, PlanEstimate
from instrument.runs.acquire import abilities_of
from instrument.runs.pace import keep_pace
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.runner import RunStatus
from recon.base.arguments import require_argument

if TYPE_CHECKING:
    from calibration_routines.display.spot_camera import SpotLook
    from calibration_routines.psf.sweep_plan import SweepExposures
    from calibration_routines.psf.sweep_watch import SweepEvent


@dataclass(frozen=True, slots=True)
class Outlook:
    """What a procedure will do, as far as that is known before it starts."""

    reasons: tuple[str, ...] = ()
    """What its numbers come from, in words."""
    plan: Plan | None = None
    """Of its frames, with the camera's present exposure; None where the next frame depends on the last
    one."""
    cost: PlanEstimate | None = None
    """Of the plan."""
    free_bytes: int | None = None
    """On the disk that the runs go to."""
    plan_lines: tuple[str, ...] = ()
    """The plan in words where more is to be said than frames and seconds; exposures are only found at the
    start (:meth:`Listener.planned`)."""
    beside_s: float = 0.0
    """What frames take by the clock that the cost has none of: of a search, or all without a plan."""
    work: tuple[tuple[str, float], ...] = ()
    """What steps compute, in their order: a step's name, and so many transforms of 1024 x 1024 there and
    back. All that follows the first of them is there, or nothing."""
    path: tuple[dict[str, float], ...] = ()
    """Where the source (``x_um``, ``y_um``, ``z_um``) or the stage goes, in the order of the visits."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a procedure leaves."""

    verdict: tuple[str, ...]
    """What was measured and how good it is, in sentences."""
    good: bool
    """Whether nothing was found wrong."""
    runs: tuple[Path, ...] = ()
    """Folders of its runs."""
    calibration: Path | None = None
    """What a reconstruction or a hologram is given."""
    files: tuple[Path, ...] = ()
    """What else was written: results, pictures."""
    result: object = None
    """What the routine returned: ``SweepCalibration``, ``AngularResponse``, ``DiffuserSurface``,
    ``BeadCalibration``, ``SlmCalibration``, ``AlignmentReport`` or ``Run``."""

    @property
    def whole(self) -> bool:
        """Whether it is not a run that was ended before its last frame."""
        return not isinstance(self.result, Run) or self.result.condition is RunCondition.COMPLETED

    def __post_init__(self) -> None:
        """Say of a result that is kept under a doubtful name that it is (:func:`named_by_worth`)."""
        kept = [path.name for path in (self.calibration, *self.files) if path is not None]
        if doubtful := [name for name in kept if name.startswith(DOUBTFUL)]:
            words = f"Not to be relied on, hence kept as {doubtful[0]}."
            object.__setattr__(self, "verdict", (*self.verdict, words))


class Listener:
    """Follows how a procedure goes on, in the thread that carries it out; override what is of interest."""

    def step(self, words: str) -> None:
        """Note that another step begins: ``"finding exposures"``."""

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Note how much of the step is done, where it does not take the frames of a plan.

        ``at_most``: the step ends when it has found what it looks for, usually long before ``total``.
        """

    def said(self, words: str) -> None:
        """Note what was found on the way, for a log."""

    def exposures(self, found: SweepExposures) -> None:
        """Note which exposures a sweep will have."""

    def planned(self, lines: Sequence[str]) -> None:
        """Note in words what will be taken, once the exposures are known."""

    def frame(self, status: RunStatus) -> None:
        """Note that a frame of a run is on the disk, or that the run's state changed."""

    def event(self, event: SweepEvent) -> None:
        """Note how good a PSF, or the source, is as soon as it is known."""

    def look(self, look: SpotLook) -> None:
        """Note what a picture of spots showed: a frame of a mask alignment."""


def require_whereabouts(folder: object, control: object, listener: object) -> None:
    """Raise InputError where a run's folder, its control or its listener is something else."""
    require_argument("folder", folder, Path | None)
    require_argument("control", control, RunControl | None)
    require_argument("listener", listener, Listener | None)


class Procedure(ABC):
    """What commands, windows and scripts carry out; a frozen dataclass of what was asked for."""

    @abstractmethod
    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Check everything that can be checked before something moves.

        Parameters
        ----------
        bench : Bench
            Open.
        folder : Path, optional
            Where runs go; the bench's data folder by default.

        Raises SettingsError, PlanError, BenchError when it cannot be done as asked.
        """

    def foretold(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Return the outlook with how long it takes in all, by what it took before or by its work."""
        outlook = self.outlook(bench, folder)
        told = took_before(self, bench, outlook) or first_guess(bench, outlook)
        return replace(outlook, reasons=(*outlook.reasons, *told))

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Check it, then do it; after an error in doing it the light is off and nothing moves.

        Raises EndedEarlyError, RunEndedError when it was aborted or stopped (what was taken is kept);
        BenchError, DeviceError when it cannot be done or a device fails.
        """
        outlook = self.outlook(bench, folder)
        control = control or RunControl()
        with control.procedure(bench):
            began_s = time.monotonic()
            try:
                outcome = self.perform(bench, folder, control, listener or Listener())
            except (KeyboardInterrupt, SystemExit, EndedEarlyError) as interruption:
                _note_left(interruption, control)
                raise
            if control.ending is None and outcome.whole:
                took(self, bench, outlook, time.monotonic() - began_s)
                for run in outcome.runs[:1]:
                    keep_pace(run, partial(abilities_of, bench), bench.config.text)
            return outcome

    @abstractmethod
    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Do what was checked: ``control`` has the bench, and is asked between steps whether to go on."""


def _note_left(interruption: BaseException, control: RunControl) -> None:
    """Say where the result of a run is, or how it is made of its frames, unless that is said already."""
    notes = getattr(interruption, "__notes__", ())
    if control.run is None or control.left is None or any("diffuserbench resume" in note for note in notes):
        return
    if words := control.left(control.run):
        interruption.add_note(words)
