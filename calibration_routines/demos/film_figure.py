"""One page of a film of the simulated animal: what was reconstructed, beside what was there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration_routines.demos.film_judge import FOLLOWED, Judged, Truth
from instrument.files.atomic import whole_file
from instrument.reconstruction.activity import Activity
from recon.streams.activity import PERCENTILE

SHOWN = 9
"""Courses drawn; more would not be told apart."""
MARGIN_PX = 6


def write_film_figure(path: Path, activity: Activity, truth: Truth, judged: Judged) -> None:
    """Draw the pictures with cells and regions, courses beside the truth, and the blood; PNG."""
    from matplotlib.figure import Figure  # costs half a second; only who draws pays

    figure = Figure(figsize=(13, 9.5), layout="constrained")
    figures = judged.figures()
    figure.suptitle(
        f"SIMULATED animal, {len(activity.frames)} frames, each an instant without motion blur.\n"
        f"dF/F follows the truth in "
        f"{judged.followed_clear:.0%} of the {judged.clear_active} cells that flash and stand clear "
        f"(correlation {FOLLOWED:g} or more); median of all {judged.active}: {figures['median_correlation']}"
    )
    everything = np.concatenate([truth.cells_px, truth.vessel_px])
    low, high = everything.min(axis=0) - MARGIN_PX, everything.max(axis=0) + MARGIN_PX
    grid = figure.add_gridspec(3, 2, height_ratios=(2.2, 2.4, 1.6))
    active = np.isfinite(judged.correlation)
    rise = activity.frames.max(axis=0) - np.percentile(activity.frames, PERCENTILE, axis=0)
    pictures = (
        (activity.frames.mean(axis=0), "gray", "mean of the film; o cells that flash, + regions found"),
        (rise, "inferno", "largest rise of light; o cells that flash, bright: clear ones"),
    )
    for place, (picture, colours, title) in enumerate(pictures):
        axes = figure.add_subplot(grid[0, place])
        at = tuple(np.clip(np.round(truth.cells_px[active]).astype(int), 0, np.array(picture.shape) - 1).T)
        brightest = float(np.percentile(picture[at], 80)) if place else float(np.percentile(picture, 99.7))
        axes.imshow(picture, cmap=colours, vmin=0, vmax=brightest)
        for chosen, colour in ((active & ~truth.clear, "tab:blue"), (active & truth.clear, "cyan")):
            rows, columns = truth.cells_px[chosen].T
            axes.plot(columns, rows, "o", mfc="none", mec=colour, ms=7, mew=0.9)
        if place == 0:
            for region in activity.regions:
                axes.plot(region.centre[1], region.centre[0], "r+", ms=6)
            axes.plot(truth.vessel_px[:, 1], truth.vessel_px[:, 0], ":", color="tab:red", lw=0.8)
        axes.set_xlim(low[1], high[1])
        axes.set_ylim(high[0], low[0])
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(title, fontsize=10)
    axes = figure.add_subplot(grid[1, :])
    clear = np.flatnonzero(active & truth.clear)
    order = clear[np.argsort(-judged.correlation[clear])]
    some = order[np.unique(np.linspace(0, len(order) - 1, SHOWN).round().astype(int))] if len(order) else []
    for number, cell in enumerate(some):
        peak = max(float(truth.change[cell].max()), 0.1)
        for course, colour, width in ((judged.traces[cell], "tab:red", 1.1), (truth.change[cell], "k", 0.7)):
            axes.plot(activity.times_s, course / peak - 1.35 * number, color=colour, lw=width)
        axes.text(
            activity.times_s[-1], -1.35 * number, f"  {judged.correlation[cell]:.3f}", va="bottom", fontsize=8
        )
    axes.set_yticks([])
    axes.set_xlim(float(activity.times_s[0]), 1.05 * float(activity.times_s[-1]))
    axes.set_title(
        "dF/F of cells that stand clear, best to worst: reconstructed (red), true (black), correlation",
        fontsize=10,
    )
    axes.set_xlabel("seconds")
    below = figure.add_subplot(grid[2, 0])
    shown = judged.kymograph[:60]
    reach = float(np.percentile(np.abs(shown), 99)) or 1.0
    below.imshow(
        shown, aspect="auto", cmap="magma", vmin=0, vmax=reach,
        extent=(0, truth.vessel_step_um * shown.shape[1], float(activity.times_s[len(shown) - 1]), 0),
    )  # fmt: skip
    below.set_title("blood: light along the vessel against time", fontsize=10)
    below.set_xlabel("um along the vessel")
    below.set_ylabel("seconds")
    speed = figure.add_subplot(grid[2, 1])
    times = 0.5 * (activity.times_s[:-1] + activity.times_s[1:])  # from one frame to the next
    speed.plot(times, judged.speed_um_s, color="tab:red", lw=0.8, label="reconstructed")
    speed.plot(activity.times_s, truth.speed_um_s, "k", lw=0.7, label="true")
    speed.set_xlim(0, min(6.0, float(times[-1])))
    speed.set_ylim(-float(truth.speed_um_s.max()), 2.2 * float(truth.speed_um_s.max()))
    speed.set_xlabel("seconds")
    speed.set_ylabel("um/s")
    speed.legend(fontsize=8, loc="upper right")
    speed.set_title(
        f"speed of the blood: median {judged.median_um_s:.0f}, true {judged.true_median_um_s:.0f} um/s",
        fontsize=10,
    )
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
