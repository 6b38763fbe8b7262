"""The picture of a stability map: one panel a method, the error in colour, the failure boundary drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK = "#22303c"
_BOUNDARY = "#d1495b"


def map_figure(record: Mapping[str, Any]) -> Figure:
    """Draw a map as ``stability.json`` has it (one entry of ``maps``).

    Severity is shown from blue (far from failing) over white (at the boundary) to brown (failed); each cell
    carries its error; the red line is the boundary, severity 1.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    methods = record["methods"]
    columns = min(len(methods), 3)
    rows = -(-len(methods) // columns)
    figure = Figure(figsize=(max(4.6 * columns + 0.9, 7.0), 3.5 * rows + 1.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(methods) :]:
        axis.set_axis_off()
    images = [
        _draw(axis, name, method, record) for axis, (name, method) in zip(axes, methods.items(), strict=False)
    ]
    bar = figure.colorbar(images[0], ax=list(axes), shrink=0.8, ticks=[-1, 0, 1])
    bar.ax.set_yticklabels(["10 times\nbelow", "boundary", "10 times\nabove"], fontsize=8)
    bar.set_label("severity", fontsize=9, color=_INK)
    figure.suptitle(f"{record['title']} (SIMULATED)", fontsize=12, color=_INK, wrap=True)
    return figure


def _draw(axes: Axes, name: str, method: Mapping[str, Any], record: Mapping[str, Any]) -> Any:
    severity = np.array([[np.nan if v is None else v for v in row] for row in method["severity"]], float)
    level = np.log10(np.maximum(severity, 1e-2))
    image = axes.imshow(level, origin="lower", aspect="auto", cmap="BrBG_r", vmin=-1, vmax=1)
    n_y, n_x = severity.shape
    for iy in range(n_y):
        for ix in range(n_x):
            error = method["error"][iy][ix]
            if error is not None:
                dark = abs(level[iy, ix]) > 0.75
                axes.text(
                    ix,
                    iy,
                    f"{error:.2g}",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color="white" if dark else _INK,
                )
    if n_x > 1 and n_y > 1 and np.isfinite(level).all() and level.min() < 0 <= level.max():
        axes.contour(level, levels=[0.0], colors=[_BOUNDARY], linewidths=2.2)
    for which, count in (("x", n_x), ("y", n_y)):
        about = record[which]
        getattr(axes, f"set_{which}ticks")(range(count))
        getattr(axes, f"set_{which}ticklabels")(ticks_of(about), fontsize=8)
        getattr(axes, f"set_{which}label")(_named(about), fontsize=9, color=_INK)
    axes.set_title(f"{name} (numbers: {record['error']})", fontsize=10, color=_INK, loc="left")
    return image


def ticks_of(axis: Mapping[str, Any]) -> list[str]:
    """Return the names of an axis' ticks: their own where it has some, else the values."""
    own: list[str] = axis.get("ticks", [])
    return own or [_short(v) for v in axis["values"]]


def _named(axis: Mapping[str, Any]) -> str:
    return f"{axis['label']} ({axis['unit']})" if axis["unit"] else str(axis["label"])


def _short(value: float) -> str:
    return f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"
