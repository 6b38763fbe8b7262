"""The picture of a mask alignment: spots getting bright, and the displacement that is left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file

Field = npt.NDArray[np.float64]


def write_alignment_figure(
    path: Path,
    displacement: Field,
    rest: Field,
    mask_shape: tuple[int, int],
    efficiencies: Sequence[tuple[int, float]],
    title: str,
    *,
    simulated: bool,
) -> None:
    """Draw efficiency against frames and the displacement that is kept; errors as ``whole_file``.

    Parameters
    ----------
    path : Path
    displacement, rest : ndarray, (rows, columns, 2)
        Of the pose, and the smooth rest; mask pixels on nodes from edge to edge of the mask.
    mask_shape : (int, int)
    efficiencies : sequence of (int, float)
        Frames taken, and spot brightness over the model's ideal.
    title : str
    simulated : bool
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.4), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1.3, 1.3])
    frames, values = zip(*efficiencies, strict=True)
    left.plot(frames, values, "o-", color="#00798c")
    left.set_ylim(0, max(1.05, 1.05 * max(values)))
    left.set_xlabel("frames taken")
    left.set_title("Spot brightness / model's ideal", loc="left")
    left.grid(color="#e3e8ec")
    height, width = mask_shape
    for axes, field, words in (
        (middle, displacement, "Shift, rotation and scale left"),
        (right, rest, "Smooth rest"),
    ):
        y, x = np.meshgrid(
            np.linspace(0, height, field.shape[0]), np.linspace(0, width, field.shape[1]), indexing="ij"
        )
        size = np.hypot(field[..., 0], field[..., 1])
        arrows = axes.quiver(x, y, field[..., 1], field[..., 0], size, angles="xy", cmap="viridis")
        figure.colorbar(arrows, ax=axes, label="mask pixels", shrink=0.7)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_title(f"{words}: {np.sqrt(np.mean(size**2)):.2f} mask pixels rms", loc="left")
    figure.suptitle(title + ("   SIMULATED" if simulated else ""), x=0.01, ha="left")
    with whole_file(path) as temporary:
        figure.savefig(temporary)
