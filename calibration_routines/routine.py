"""Rows of the registry: what ``calibrate`` and the window offer, from options to results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import Any

from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.purpose import Purpose
from instrument.bench.bench import Bench
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from instrument.runs.runner import Runner
from instrument.runs.writer import dated_name, free_name
from recon.base.registry import Registry


@dataclass(frozen=True, slots=True, kw_only=True)
class FromFiles:
    """How a routine's result is made of files instead of on a bench."""

    options: type[Any]
    """Frozen dataclass with declared fields: the files, and what is not known of them."""
    named: str
    """Its field that names them; None there: the bench."""
    uses: tuple[str, ...]
    """The routine's options that matter with files, too."""
    look: Callable[[Any, Any], Sequence[str]]
    """Takes the routine's options and the files, says what would be done; raises what is wrong with them."""
    make: Callable[[Any, Any, Path, RunControl, Listener], Outcome]
    """Takes the same, where the result goes, who ends it and who follows."""
    folder: str
    """Where the result goes when nothing else is said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Routine:
    """A row of the registry: what ``calibrate`` and the window offer, from its options to its result."""

    name: str
    """On the command line: ``diffuserbench calibrate NAME``."""
    title: str
    """In the window."""
    help: str
    """What it does, one sentence."""
    options: type[Any]
    """Frozen dataclass with declared fields (:mod:`recon.base.declare`); raises SettingsError for what makes
    no sense together."""
    procedure: Callable[[Any], Procedure]
    """Makes the procedure of such options: what plans (``outlook``) and runs (``carry_out``)."""
    details: str = ""
    """More about it, for the command's help."""
    needs: tuple[str, ...] = ()
    """Devices that it needs besides the camera."""
    tried_on: str = "default"
    """The simulated bench that it can be tried on, one of ``instrument.bench.config_file.TEMPLATES``."""
    examples: tuple[str, ...] = ()
    """Command lines."""
    start: Callable[[Bench], Mapping[str, Any]] | None = None
    """Gives values for a form to begin with, by name, that follow from the bench."""
    purpose: Purpose[Any] | None = None
    """Of runs that become results later, too."""
    finish: Callable[[Run, Bench | None, RunControl, Listener], Outcome] | None = None
    """Makes the result of such a complete run: takes it, the bench for retakes (or None), control and
    listener."""
    finish_takes_frames: bool = False
    """Whether that needs the bench, to take the frames of further runs."""
    restore: Callable[[Run, Bench, int], None] | None = None
    """Brings back what no plan tells, before such a run takes a step that it lacks and has not come to by the
    one before; takes that step's number, too."""
    watch: Callable[[Bench, Runner, Listener], None] | None = None
    """Makes the runner of such a run that goes on look at its frames as from its beginning."""
    files: FromFiles | None = None
    file: str = ""
    """Where the command line writes the result when nothing else is said, of options with an ``out``."""
    command: str = "calibrate"
    """The command that it is part of."""

    @property
    def declared(self) -> tuple[type[Any], ...]:
        """All classes of options: its own, and those of files."""
        return (self.options,) if self.files is None else (self.options, self.files.options)

    def useless(self, *, with_files: bool) -> set[str]:
        """Return the names of options that say nothing: with files the bench's, else those of files."""
        if self.files is None:
            return set()
        own, of_files = ({field.name for field in fields(options)} for options in self.declared)
        return own - set(self.files.uses) if with_files else of_files - {self.files.named}

    def asked(self, values: Mapping[str, Any]) -> Procedure:
        """Return the procedure that options by name, of all classes, ask for; errors as these classes."""
        own, *others = (
            kind(**{field.name: values[field.name] for field in fields(kind) if field.name in values})
            for kind in self.declared
        )
        if self.files is None or getattr(others[0], self.files.named) is None:
            return self.procedure(own)
        return OfFiles(self.name, own, others[0])


@dataclass(frozen=True, slots=True)
class OfFiles(Procedure):
    """A routine's result made of files; the bench only says where results go."""

    routine: str
    asked: Any
    files: Any
    out: Path | None = None
    """Where the result goes; None: dated, beside the runs."""

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Look at the files; raises what is wrong with them."""
        return Outlook(tuple(self._how.look(self.asked, self.files)))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Make the result."""
        beside = bench.config.data_folder if folder is None else folder
        out = self.out or free_name(beside, dated_name(f"{self.routine} calibration"))
        return self._how.make(self.asked, self.files, out, control, listener)

    @property
    def _how(self) -> FromFiles:
        how = routines[self.routine].files
        assert how is not None
        return how


_MODULES = (
    "psf.sweep_procedure",
    "optics.stage_play",
    "optics.photograph",
    "optics.angular",
    "optics.dpc",
    "optics.beads",
    "optics.screen_bench",
    "display.slm_calibration",
    "display.mask_alignment",
    "display.display_learning",
)
"""Each has its routines as ``ROUTINES``. They are imported when somebody asks what there is."""


def _own() -> Iterator[Routine]:
    for name in _MODULES:
        yield from import_module(f"calibration_routines.{name}").ROUTINES


routines: Registry[Routine] = Registry("routine", "diffuserbench.routines", _own)
"""All routines by name: the project's, those of installed packages, those that this program registered."""
