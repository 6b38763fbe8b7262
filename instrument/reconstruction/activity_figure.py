"""A page of a video's activity: where, and when."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from instrument.reconstruction.activity import Activity

SHOWN = 20
"""Traces drawn; more would not be told apart."""


def write_figure(path: Path, activity: Activity, *, simulated: bool) -> None:
    """Draw mean fluorescence with the regions, local correlation, traces, and motion; PNG."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    mark = "   SIMULATED" if simulated else ""
    figure.suptitle(
        f"{len(activity.regions)} regions in {len(activity.indices)} frames; frames off their place by up to "
        f"{activity.motion.largest_px:.2f} pixels{mark}"
    )
    grid = figure.add_gridspec(3, 2, height_ratios=(3, 2.4, 0.8))
    mean = activity.frames.mean(axis=0)
    for place, (image, title, colours) in enumerate(
        (
            (mean, "mean fluorescence, regions", "gray"),
            (activity.correlation, "local correlation of dF/F", "magma"),
        )
    ):
        axes = figure.add_subplot(grid[0, place])
        shown = axes.imshow(image, cmap=colours, vmax=float(np.percentile(image, 99.8)))
        figure.colorbar(shown, ax=axes)
        axes.set_title(title)
        axes.set_axis_off()
        for number, region in enumerate(activity.regions):
            row, column = region.centre
            radius = max(float(np.sqrt(len(region.rows) / np.pi)), 2.0) + 1
            colour = f"C{number % 10}"
            turn = np.linspace(0, 2 * np.pi, 40)
            axes.plot(column + radius * np.cos(turn), row + radius * np.sin(turn), color=colour, lw=1)
            axes.annotate(str(number), (column + radius, row - radius), color=colour, fontsize=7)
    axes = figure.add_subplot(grid[1, :])
    step = 1.1 * float(np.max(activity.traces, initial=0.1))
    for number, trace in enumerate(activity.traces[:SHOWN]):
        axes.plot(activity.times_s, trace + number * step, color=f"C{number % 10}", lw=0.9)
    axes.set_ylabel(f"dF/F, {step:.2g} apart")
    axes.set_xlim(float(activity.times_s[0]), float(activity.times_s[-1]))
    below = figure.add_subplot(grid[2, :], sharex=axes)
    below.plot(activity.times_s, activity.motion.shifts, lw=0.9, label=["rows", "columns"])
    below.set_ylabel("off by (px)")
    below.set_xlabel("time (s), or frame number")
    below.legend(fontsize=7, loc="upper right")
    figure.savefig(path, dpi=110, format="png")
