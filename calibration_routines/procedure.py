"""A procedure from an open bench to its saved result, as command line, window and scripts call it alike.

A procedure is frozen data: what a person asked for. ``outlook`` says what it will do and cost, nothing moves;
``carry_out`` does all of it (homing, exposures, frames, analysis, files) and ends with the light off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from instrument.bench.bench import Bench
from instrument.plan import Plan, PlanEstimate, Step, estimate
from instrument.runs.acquire import abilities_of
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from instrument.runs.runner import RunStatus
from recon.base.registry import Registry

if TYPE_CHECKING:
    from calibration_routines.display.display_io import SpotLook
    from calibration_routines.psf.exposure import SweepExposures
    from calibration_routines.psf.sweep_watch import SweepEvent


@dataclass(frozen=True, slots=True)
class Outlook:
    """What a procedure will do, as far as that is known before it starts.

    Attributes
    ----------
    reasons : tuple of str
        What its numbers come from, in words.
    plan : Plan or None
        Of its frames, with the camera's present exposure; None where the next frame depends on the last one.
    cost : PlanEstimate or None
        Of the plan.
    free_bytes : int or None
        On the disk that the runs go to.
    plan_lines : tuple of str
        The plan in words where more is to be said than frames and seconds; exposures are only found at the
        start (:meth:`Listener.planned`).
    path : tuple of mapping
        Where the source (``x_um``, ``y_um``, ``z_um``) or the stage goes, in the order of the visits.
    """

    reasons: tuple[str, ...] = ()
    plan: Plan | None = None
    cost: PlanEstimate | None = None
    free_bytes: int | None = None
    plan_lines: tuple[str, ...] = ()
    path: tuple[dict[str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a procedure leaves.

    Attributes
    ----------
    verdict : tuple of str
        What was measured and how good it is, in sentences.
    good : bool
        Whether nothing was found wrong.
    runs : tuple of Path
        Folders of its runs.
    calibration : Path or None
        What a reconstruction or a hologram is given.
    files : tuple of Path
        What else was written: results, pictures.
    result : object
        What the routine returned: ``SweepCalibration``, ``AngularResponse``, ``DiffuserSurface``,
        ``BeadCalibration``, ``SlmCalibration``, ``AlignmentReport`` or ``Run``.
    """

    verdict: tuple[str, ...]
    good: bool
    runs: tuple[Path, ...] = ()
    calibration: Path | None = None
    files: tuple[Path, ...] = ()
    result: object = None


class Listener:
    """Hears how a procedure goes on, in the thread that carries it out; override what is of interest."""

    def step(self, words: str) -> None:
        """Hear that another step begins: ``"finding exposures"``."""

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Hear how much of the step is done, where it does not take the frames of a plan.

        ``at_most``: the step ends when it has found what it looks for, usually long before ``total``.
        """

    def said(self, words: str) -> None:
        """Hear what was found on the way, for a log."""

    def exposures(self, found: SweepExposures) -> None:
        """Hear which exposures a sweep will have."""

    def planned(self, lines: Sequence[str]) -> None:
        """Hear in words what will be taken, once the exposures are known."""

    def frame(self, status: RunStatus) -> None:
        """Hear that a frame of a run is on the disk, or that the run's state changed."""

    def event(self, event: SweepEvent) -> None:
        """Hear how good a PSF, or the source, is as soon as it is known."""

    def look(self, look: SpotLook) -> None:
        """Hear what a picture of spots showed: a frame of a mask alignment."""


class Procedure(Protocol):
    """What windows and scripts carry out."""

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Check everything that can be checked before something moves.

        Parameters
        ----------
        bench : Bench
            Open.
        folder : Path, optional
            Where runs go; the bench's data folder by default.

        Raises
        ------
        SettingsError, PlanError, BenchError
            When it cannot be done as asked.
        """

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Do it; the light is off and nothing moves when this returns or raises.

        Raises
        ------
        EndedEarlyError, RunEndedError
            When it was aborted or stopped; what was taken is kept.
        BenchError, DeviceError
            When it cannot be done or a device fails.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Routine:
    """A row of the registry: what ``calibrate`` and the window offer, from its options to its result.

    Attributes
    ----------
    name : str
        On the command line: ``diffuserbench calibrate NAME``.
    title : str
        In the window.
    help : str
        What it does, one sentence.
    options : type
        Frozen dataclass with declared fields (:mod:`recon.base.declare`); raises SettingsError for what makes
        no sense together.
    procedure : callable
        Makes the procedure of such options: what plans (``outlook``) and runs (``carry_out``).
    details : str
        More about it, for the command's help.
    needs : tuple of str
        Devices that it needs besides the camera.
    examples : tuple of str
        Command lines.
    start : callable, optional
        Gives values for a form to begin with, by name, that follow from the bench.
    lacks_result : callable, optional
        Of routines whose runs become results later, too: whether a folder is such a run, without its result.
    finish : callable, optional
        Makes the result of such a run.
    file : str
        Where the command line writes the result when nothing else is said, of options with an ``out``.
    command : str
        The command that it is part of.
    """

    name: str
    title: str
    help: str
    options: type[Any]
    procedure: Callable[[Any], Procedure]
    details: str = ""
    needs: tuple[str, ...] = ()
    examples: tuple[str, ...] = ()
    start: Callable[[Bench], Mapping[str, Any]] | None = None
    lacks_result: Callable[[Path], bool] = lambda _: False
    finish: Callable[[Run], Outcome] | None = None
    file: str = ""
    command: str = "calibrate"


_MODULES = (
    "psf.sweep_procedure",
    "optics.photograph",
    "optics.angular",
    "optics.dpc",
    "optics.beads",
    "display.slm_calibration",
    "display.mask_alignment",
)
"""Each has its routines as ``ROUTINES``. They are imported when somebody asks what there is."""


def _own() -> Iterator[Routine]:
    for name in _MODULES:
        yield from import_module(f"calibration_routines.{name}").ROUTINES


routines: Registry[Routine] = Registry("routine", "diffuserbench.routines", _own)
"""All routines by name: the project's, those of installed packages, those that this program registered."""


def outlook_of(
    bench: Bench, plan: Plan, folder: Path | None, reasons: Sequence[str] = (), *, homes: bool = False
) -> Outlook:
    """Return the outlook of a plan that was checked.

    Where it moves a stage, the reasons say whether that is homed first: always (``homes``), or where it has
    no reference yet.
    """
    abilities = abilities_of(bench, folder or bench.config.data_folder)
    path = path_of(plan)
    told = list(reasons)
    if path and bench.stage is not None and (homes or not bench.stage.is_homed):
        told.append("The stage is homed first, every axis to its reference: its way must be free.")
    return Outlook(tuple(told), plan, estimate(plan, abilities), abilities.free_bytes, path=path)


def path_of(plan: Plan) -> tuple[dict[str, float], ...]:
    """Return the places that a plan visits, one after the other; empty where nothing moves."""
    places: list[dict[str, float]] = []
    for step in plan.steps():
        place = place_of(step)
        if place and (not places or places[-1] != place):
            places.append(place)
    return tuple(places)


def place_of(step: Step) -> dict[str, float]:
    """Return where a step puts the source (``x_um``, ``y_um``, ``z_um``) or the stage; empty: nowhere."""
    if step.source_um is not None:
        return dict(zip(("x_um", "y_um", "z_um"), step.source_um, strict=True))
    return dict(step.stage)


@contextmanager
def under_control(bench: Bench, control: RunControl | None) -> Iterator[RunControl]:
    """Give the control of a procedure that is carried out in the block, a new one where nobody has one."""
    control = control or RunControl()
    with control.procedure(bench):
        yield control


def home_if_needed(bench: Bench, listener: Listener, plan: Plan | None = None) -> None:
    """Home a stage that has no reference yet; for a plan that places nothing, not."""
    needed = plan is None or any(part.positions is not None for part in plan.parts)
    if needed and bench.stage is not None and not bench.stage.is_homed:
        listener.step("homing the stage")
        bench.stage.home()
