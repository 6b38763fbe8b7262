"""What a run's frames are for: a record beside them, of which a result is made, and why there may be none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from calibration_routines.procedure import Listener
from instrument.bench.bench import Bench
from instrument.files.atomic import named_by_worth, write_text
from instrument.files.errors import BenchError, FileError, SettingsError
from instrument.files.record import RecordFormat, plain
from instrument.plan import Plan
from instrument.runs.acquire import prepare
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.runner import Runner, discarded
from recon.errors import InputError

T = TypeVar("T")
REFUSED = "no_result.txt"
"""In a run's folder: why its frames, all of them, give no result."""


class CalibrationError(BenchError):
    """A calibration that cannot be taken, or was ended before its last frame."""

    exit_code = 1


class RunEndedError(CalibrationError):
    """The run behind a calibration was ended before its last frame; its frames are kept.

    ``what`` begins the sentence ("The sweep"), ``remedy`` says what to do about it.
    """

    def __init__(self, what: str, run: Run, remedy: str = "") -> None:
        self.run = run
        self.words = f"{what} ended early ({run.condition}); what was taken is in {run.path}."
        """Without the remedy, which is not the same on the command line and in a window."""
        super().__init__(self.words + (f" {remedy}" if remedy else ""))


def completed(run: Run, what: str = "The run", remedy: str = "") -> Run:
    """Return a run that has all its frames; RunEndedError when it was ended before its last one."""
    if run.condition is not RunCondition.COMPLETED:
        raise RunEndedError(what, run, remedy)
    return run


@dataclass(frozen=True, slots=True)
class Purpose(Generic[T]):
    """What a run's frames are for: a record in its folder, of which its result is made, later too."""

    kind: type[T]
    """Dataclass of the record."""
    file: str
    result: str
    """Names in the run's folder: of the record, and of the result once there is one."""
    format: RecordFormat

    def is_of(self, run: Path | str) -> bool:
        """Whether a run's frames are for this."""
        return (Path(run) / self.file).is_file()

    def place(self, run: Path, *, doubted: bool) -> Path:
        """Return where the result of a run goes (:func:`named_by_worth`)."""
        return named_by_worth(run / self.result, doubted=doubted)

    def kept(self, run: Path) -> Path:
        """Return where the result of a run is: under a doubtful name where that is what there is."""
        good, doubtful = (self.place(run, doubted=doubted) for doubted in (False, True))
        return doubtful if doubtful.exists() and not good.exists() else good

    def lacks_result(self, run: Path) -> bool:
        """Whether they are, and the result is not there yet."""
        return self.is_of(run) and not any(self.place(run, doubted=one).exists() for one in (False, True))

    @contextmanager
    def analysed(self, run: Path) -> Iterator[None]:
        """Keep with a complete run why its frames give no result, when their analysis in the block says so.

        The same frames would say it again, so that :func:`can_go_on` offers the run to nobody any more.
        """
        refused = run / REFUSED
        try:
            yield
        except (CalibrationError, InputError) as error:
            try:
                write_text(refused, f"{error}\n")
            except FileError as unwritten:  # why there is no result counts, not that it cannot be kept
                error.add_note(str(unwritten))
            raise
        refused.unlink(missing_ok=True)  # by a program before this one

    def read(self, run: Path) -> T:
        """Read the record of a run; CalibrationError when there is none, or it is damaged."""
        path = run / self.file
        if not self.is_of(run):
            raise CalibrationError(f"{run} is no {self.format.thing}: it has no {self.file}.")
        try:
            return self.format.value(self.kind, self.format.read(path), path)
        except (FileError, SettingsError) as error:
            raise CalibrationError(f"{path} cannot be read: {error}") from error

    def prepare(
        self,
        bench: Bench,
        plan: Plan,
        folder: Path | None,
        record: T,
        control: RunControl,
        listener: Listener,
    ) -> Runner:
        """Return the runner of a plan whose run has the record; errors as ``prepare``."""
        runner = prepare(bench, plan, folder, on_progress=listener.frame, control=control)
        with discarded(runner):
            runner.keep_text(self.file, self.format.text(plain(record)))
        control.left = self.left
        return runner

    def left(self, run: Path) -> str:
        """Say what an interruption leaves of a run: its result, or how it is made; nothing of another's."""
        if self.lacks_result(run):
            return f"Its frames are kept. For its result: diffuserbench resume {run}"
        return f"Its result is saved: {self.kept(run)}" if self.is_of(run) else ""
