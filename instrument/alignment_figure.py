"""The picture of a mask alignment: spots getting bright, and the displacement that is left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from instrument.atomic import whole_file
from recon.holography.pose import Pose


def write_alignment_figure(
    path: Path,
    pose: Pose,
    mask_shape: tuple[int, int],
    efficiencies: Sequence[tuple[int, float]],
    title: str,
    *,
    simulated: bool,
) -> None:
    """Draw efficiency against frames and the displacement field that is kept; errors as ``whole_file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 4.6), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.4])
    frames, values = zip(*efficiencies, strict=True)
    left.plot(frames, values, "o-", color="#00798c")
    left.set_ylim(0, 1.05)
    left.set_xlabel("frames taken")
    left.set_title("Spot brightness / model's ideal", loc="left")
    left.grid(color="#e3e8ec")
    field = pose.displacement(mask_shape)
    height, width = mask_shape
    y, x = np.meshgrid(
        np.linspace(0, height, field.shape[0]), np.linspace(0, width, field.shape[1]), indexing="ij"
    )
    size = np.hypot(field[..., 0], field[..., 1])
    arrows = right.quiver(x, y, field[..., 1], field[..., 0], size, angles="xy", cmap="viridis")
    figure.colorbar(arrows, ax=right, label="mask pixels")
    right.set_aspect("equal")
    right.invert_yaxis()
    right.set_title("Displacement left for the model", loc="left")
    figure.suptitle(title + ("   SIMULATED" if simulated else ""), x=0.01, ha="left")
    with whole_file(path) as temporary:
        figure.savefig(temporary)
