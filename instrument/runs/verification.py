"""Whether a run is what it says: every frame, every line of metadata, readable by others."""

from __future__ import annotations

from dataclasses import dataclass

from instrument.bench.photograph import Progress
from instrument.runs.run import DamagedFrame, FinishReason, Run


@dataclass(frozen=True, slots=True)
class Verification:
    """What reading a whole run found.

    Attributes
    ----------
    frames : int
        Frames that are as they were written.
    damaged : tuple of DamagedFrame
        Frames that the log calls written and that are not as they were.
    problems : tuple of str
        Whatever else contradicts itself.
    """

    frames: int
    damaged: tuple[DamagedFrame, ...]
    problems: tuple[str, ...]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong. A run that ended early is sound, only not complete."""
        return not self.damaged and not self.problems


def verify(run: Run, on_progress: Progress | None = None) -> Verification:
    """Read every frame of a run and hold it, its metadata and the image array against the log.

    Parameters
    ----------
    run : Run
    on_progress : callable, optional
        Called with frames read and frames to read.
    """
    damaged: list[DamagedFrame] = []
    for count, index in enumerate(sorted(run.records), start=1):
        if (found := run.verify(index)) is not None:
            damaged.append(found)
        if on_progress is not None:
            on_progress(count, len(run.records))
    return Verification(len(run.records) - len(damaged), tuple(damaged), tuple(_contradictions(run)))


def _contradictions(run: Run) -> list[str]:
    problems: list[str] = []
    if run.torn_bytes:
        problems.append(f"the log ends in a half line of {run.torn_bytes} bytes")
    if run.reason is FinishReason.COMPLETED and run.plan is not None and run.missing():
        problems.append(f"marked as completed, but frames {_few(run.missing())} are not there")
    beyond = [index for index in run.records if not 0 <= index < run.n_frames]
    if beyond:
        problems.append(f"the log has frames {_few(beyond)}, beyond the plan's {run.n_frames}")
    gaps = [index for gap in run.gaps for index in range(gap.first, gap.first + gap.count)]
    if both := sorted(set(gaps) & set(run.records)):
        problems.append(f"frames {_few(both)} are both stored and lost")
    if run.plan is None and (nowhere := sorted(set(run.missing()) - set(gaps))):
        problems.append(f"frames {_few(nowhere)} are neither stored nor accounted for as lost")
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
    if run.plan is not None and array.n_frames != len(run.plan):
        problems.append(f"the image array is for {array.n_frames} frames, the plan has {len(run.plan)}")
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


def _few(indices: list[int]) -> str:
    text = ", ".join(map(str, indices[:8]))
    return text if len(indices) <= 8 else f"{text} and {len(indices) - 8} more"
