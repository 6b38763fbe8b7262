"""A picture of a run: a sheet of its frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from instrument.files.atomic import whole_file
from instrument.runs.run import Run, RunError

COLUMNS, ROWS = 4, 3


def contact_sheet(run: Run, path: Path) -> list[int]:
    """Write a picture of up to twelve of a run's frames, spread evenly, as PNG; returns which.

    Each frame is stretched from its 0.1th to its 99.9th percentile; pixels at full scale are red.

    Raises
    ------
    RunError
        When the run has no frames.
    FileError
        When ``path`` cannot be written.
    """
    stored = sorted(run.records)
    if not stored:
        raise RunError(run.path, "has no frames to show.")
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
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=100, format="png")
    return indices


def _shown(run: Run, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    frame = run.frame(index)
    step = max(1, frame.shape[1] // 640)
    frame = frame[::step, ::step].astype(np.float32)
    low, high = np.percentile(frame, (0.1, 99.9))
    grey = np.clip((frame - low) / max(high - low, 1.0), 0, 1)
    picture = grey if grey.ndim == 3 else np.repeat(grey[..., None], 3, axis=2)
    full_scale = (1 << run.metadata(index).significant_bits) - 1
    saturated = frame >= full_scale if frame.ndim == 2 else np.any(frame >= full_scale, axis=2)
    picture[saturated] = (1, 0, 0)
    return picture.astype(np.float32)
