"""The runs in a folder, at a glance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from instrument.runs.layout import STATE, RunCondition
from instrument.runs.run import Run, RunError


@dataclass(frozen=True, slots=True)
class RunSummary:
    """One run of a folder.

    Attributes
    ----------
    path : Path
    condition : RunCondition or None
        None when it cannot be read; ``problem`` says why.
    label : str
    stored, frames : int
        Frames on the disk, and those that belong to it.
    is_recording : bool
    is_simulated : bool
    problem : str
    """

    path: Path
    condition: RunCondition | None = None
    label: str = ""
    stored: int = 0
    frames: int = 0
    is_recording: bool = False
    is_simulated: bool = False
    problem: str = ""


def run_paths(folder: Path) -> list[Path]:
    """Return the folders of the runs in a folder, the oldest first; empty where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if not p.name.startswith(".") and (p / STATE).is_file())


def summary(path: Path) -> RunSummary:
    """Return what became of a run."""
    try:
        run = Run.open(path)
        return RunSummary(
            path,
            run.condition,
            run.label,
            len(run.records),
            run.n_frames,
            run.plan is None,
            run.is_simulated,
            run.error,
        )
    except RunError as error:
        return RunSummary(path, problem=error.problem)
