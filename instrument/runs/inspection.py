"""Looking at runs: those of a folder, a picture of one, and whether one is what it says it is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from instrument.bench.photograph import Progress
from instrument.bench.photograph_file import PHOTOGRAPHS
from instrument.files.errors import FileError, frames_in_words, ranges
from instrument.files.figures import save_figure
from instrument.files.images import image_metadata
from instrument.files.seen import as_seen
from instrument.runs.repair import file_problems
from instrument.runs.results import result_problems
from instrument.runs.run import DamagedFrame, FinishReason, Run, RunCondition
from instrument.runs.run_files import LOG, FileProblem, is_run, note_damage, noted_damage


@dataclass(frozen=True, slots=True)
class Verification:
    """What looking at a whole run found, and what ``resume`` would do about it."""

    log_bytes: int
    """The log's size when it was read: what was found holds as long as it has not grown."""
    condition: RunCondition
    """How the run was left."""
    is_recording: bool
    frames: int
    """Frames that are as they were written."""
    todo: tuple[int, ...]
    """A plan's steps whose data are not safely stored, in order."""
    damaged: tuple[DamagedFrame, ...]
    """Frames that the log calls written and that are not as they were."""
    without_a_line: tuple[int, ...]
    """Images on the disk that no line of the log is about."""
    files: tuple[FileProblem, ...]
    """Small files that are not as they were written."""
    problems: tuple[str, ...]
    """Whatever else contradicts itself."""
    results: tuple[FileProblem, ...] = ()
    """Parts of what was made of the frames that cannot be read any more."""

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong. A run that ended early is sound, only not complete."""
        return self.is_as_written and not self.results

    @property
    def is_as_written(self) -> bool:
        """Whether nothing is wrong with the run itself, whatever became of what was made of its frames."""
        return not (self.damaged or self.without_a_line or self.files or self.problems)

    @property
    def became(self) -> str:
        """What became of the run, with a mark when it is damaged."""
        return _became(self.condition, is_damaged=not self.is_sound)

    def lines(self) -> list[str]:
        """Return what is wrong, a line each."""
        found = [f"frame {frame.index}: {frame.problem}" for frame in self.damaged]
        if self.without_a_line:
            found.append(f"images without their line in the log: {frames_in_words(self.without_a_line)}")
        return [*found, *map(str, self.files), *self.problems, *map(str, self.results)]

    def remedy(self) -> str:
        """Return what ``resume`` would do, or what must be done before it can; empty where nothing is."""
        beyond_help = [file.name for file in self.files if not file.remedy]
        if LOG in beyond_help:
            return "Put the run's own log back, or move this one away: resume changes nothing before."
        if beyond_help and self.todo:
            return f"Put {', '.join(beyond_help)} back from a backup: resume takes no frame before."
        done = list(dict.fromkeys(file.remedy for file in self.files if file.remedy))
        if self.is_recording:
            if self.damaged:
                done.append(f"marks {frames_in_words([f.index for f in self.damaged])} as lost")
            if self.without_a_line:
                done.append("keeps the images without a line")
        else:
            if set(self.without_a_line) - set(self.todo):
                done.append("moves the images beyond the plan's away")
            if self.todo:
                done.append(f"takes {frames_in_words(self.todo)}")
        return f"diffuserbench resume {', '.join(done)}; what it replaces is kept beside." if done else ""

    def __str__(self) -> str:
        left = "" if self.is_recording else f", {len(self.todo)} to do"
        left += f", first step {self.todo[0]}" if self.todo else ""
        return "\n  ".join([f"{self.condition}: {self.frames} frames safely stored{left}", *self.lines()])


def verify(run: Run, on_progress: Progress | None = None, *, read: bool = True) -> Verification:
    """Read every frame of a run and hold it, its metadata, files and image array against the log.

    What was made of its frames is read, too, a calibration against its checksums. ``on_progress`` is called
    with frames read and frames to read. ``read``: False looks at the images' sizes only, which is quick, and
    reads again what was damaged when the run was last read. What reading finds is noted with the run.
    """
    frames_noted, results_noted = (set(), set()) if read else noted_damage(run.path)
    damaged = run.damaged(on_progress, read=read, noted=frames_noted)
    results = tuple(result_problems(run.path, read=read, noted=results_noted))
    is_new = read or (frames_noted and not damaged) or (results_noted and not results)
    if is_new and not run.is_being_written:
        note_damage(run.path, [frame.index for frame in damaged], sorted({part.of for part in results}))
    again = {frame.index for frame in damaged}
    plan = run.plan
    steps = range(len(plan)) if plan is not None else ()
    running = run.is_being_written
    return Verification(
        log_bytes=run.log_bytes,
        condition=run.condition,
        is_recording=plan is None,
        frames=len(run.records) + len(run.unlisted) - len(damaged),
        todo=tuple(i for i in steps if i not in run.records or i in again),
        damaged=damaged,
        without_a_line=() if running else tuple(run.without_a_line()),
        files=tuple(file_problems(run)),
        problems=() if run.log_is_foreign else tuple(_contradictions(run)),
        results=results,
    )


def _contradictions(run: Run) -> list[str]:
    problems: list[str] = []
    if run.reason is FinishReason.COMPLETED and run.plan is not None and run.missing():
        problems.append(f"marked as completed, but frames {ranges(run.missing(), 8)} are not there")
    beyond = [index for index in run.records if not 0 <= index < run.n_frames]
    if beyond:
        problems.append(f"the log has frames {ranges(beyond, 8)}, beyond the plan's {run.n_frames}")
    gaps = [index for gap in run.gaps for index in range(gap.first, gap.first + gap.count)]
    accounted = {*gaps, *run.lost, *run.unlisted, *run.without_a_line()}
    if both := sorted(set(gaps) & set(run.records)):
        problems.append(f"frames {ranges(both, 8)} are both stored and lost")
    if run.plan is None and (nowhere := sorted(set(run.missing()) - accounted)):
        problems.append(f"frames {ranges(nowhere, 8)} are neither stored nor accounted for as lost")
    if run.has_frames:
        problems += _array_contradictions(run)
    if run.plan is not None:
        for step in run.plan.whole_steps():
            record = run.records.get(step.index)
            if record is not None and record.average != step.average:
                problems.append(f"frame {step.index} averages {record.average}, planned were {step.average}")
    return problems


def _array_contradictions(run: Run) -> list[str]:
    problems: list[str] = []
    array = run.array
    if run.plan is None and run.reason is not None and array.n_frames != run.n_frames:
        problems.append(f"the image array is for {array.n_frames} frames, the log knows {run.n_frames}")
    height, width = array.frame_shape[:2]
    for index, record in run.records.items():
        roi, binning = record.metadata.roi, record.metadata.binning
        if (roi[2] // binning, roi[3] // binning) != (height, width):
            problems.append(
                f"frame {index}: its region {roi} at binning {binning} is not {height} x {width} pixels"
            )
    return problems


COLUMNS, ROWS = 4, 3


def contact_sheet(run: Run, path: Path, *, leave_out: Collection[int] = ()) -> list[int]:
    """Write a page of up to twelve of a run's frames, spread evenly; returns which.

    Each frame is shown as it is seen (sRGB, contrast by percentiles); pixels at full scale are red. Frames to
    ``leave_out`` are not shown; where none are left, nothing is written.

    Raises FileError when ``path`` cannot be written.
    """
    from matplotlib.figure import Figure

    stored = sorted(set(run.records) - set(leave_out))
    if not stored:
        return []
    chosen = np.unique(np.linspace(0, len(stored) - 1, min(len(stored), COLUMNS * ROWS)).round().astype(int))
    indices = [stored[i] for i in chosen]
    rows = -(-len(indices) // COLUMNS)
    figure = Figure(figsize=(3.2 * COLUMNS, 2.9 * rows + 0.5), layout="constrained")
    mark = "  SIMULATED" if run.is_simulated else ""
    figure.suptitle(
        f"{run.path.name}: {run.condition}, {len(stored)} of {run.n_frames} frames{mark}  (red: saturated)"
    )
    labels = {step.index: step.label for step in run.steps()} if run.plan is not None else {}
    for place, index in enumerate(indices, start=1):
        axes = figure.add_subplot(rows, COLUMNS, place)
        axes.imshow(_shown(run, index))
        metadata = run.metadata(index)
        axes.set_title(
            f"{index} {labels.get(index, '')}  {metadata.exposure_ms:g} ms\n{metadata.led_pattern}",
            fontsize=8,
        )
        axes.set_axis_off()
    save_figure(figure, path)
    return indices


def _shown(run: Run, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    frame = run.frame(index)
    step = max(1, frame.shape[1] // 640)
    frame = frame[::step, ::step]
    seen = as_seen(frame, raw=True).astype(np.float32) / 255
    picture = seen if seen.ndim == 3 else np.repeat(seen[..., None], 3, axis=2)
    full_scale = (1 << run.metadata(index).significant_bits) - 1
    saturated = frame >= full_scale if frame.ndim == 2 else np.any(frame >= full_scale, axis=2)
    picture[saturated] = (1, 0, 0)
    return np.asarray(picture, np.float32)


@dataclass(frozen=True, slots=True)
class RunSummary:
    """One run of a folder, or a photograph beside them."""

    path: Path
    condition: RunCondition | None = None
    """None when it cannot be read; ``problem`` says why."""
    label: str = ""
    stored: int = 0
    frames: int = 0
    """Frames on the disk, and those that belong to it."""
    is_recording: bool = False
    is_photograph: bool = False
    is_simulated: bool = False
    problem: str = ""
    is_damaged: bool = False
    """Whether a small file or a result is not as it was written, or an image is gone, of another size, or was
    found damaged when the run was last read and still is."""

    @property
    def kind(self) -> str:
        """``"plan"``, ``"recording"`` or ``"photograph"``."""
        return "photograph" if self.is_photograph else "recording" if self.is_recording else "plan"

    @property
    def became(self) -> str:
        """What became of it, with a mark when it is damaged."""
        if self.condition is None:
            return "UNREADABLE"
        return _became(self.condition, is_damaged=self.is_damaged)


def _became(condition: RunCondition, *, is_damaged: bool) -> str:
    return f"{condition}, DAMAGED" if is_damaged else str(condition)


def run_paths(folder: Path) -> list[Path]:
    """Return the folders of the runs in a folder, the oldest first; empty where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if not p.name.startswith(".") and is_run(p))


def runs_and_photographs(folder: Path) -> list[Path]:
    """Return the folders of the runs in a folder and the photographs beside them, the newest first."""

    def began(path: Path) -> str:  # as the names of runs begin
        if path.parent == folder:
            return path.name
        try:
            return f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d_%H-%M-%S}"
        except OSError:  # gone meanwhile
            return ""

    return sorted([*run_paths(folder), *(folder / PHOTOGRAPHS).glob("[!.]*.tif")], key=began, reverse=True)


def summary(path: Path) -> RunSummary:
    """Return what became of a run or, from a file, what a photograph says of itself."""
    if path.is_file():
        said = image_metadata(path)
        simulated = bool(said.get("simulated"))
        return RunSummary(path, RunCondition.COMPLETED, "", 1, 1, is_photograph=True, is_simulated=simulated)
    try:
        run = Run.open(path)
        return RunSummary(
            path,
            run.condition,
            run.label,
            len(run.records),
            run.n_frames,
            run.plan is None,
            False,
            run.is_simulated,
            run.error,
            not run.is_being_written and not verify(run, read=False).is_sound,
        )
    except FileError as error:
        return RunSummary(path, problem=error.problem)
