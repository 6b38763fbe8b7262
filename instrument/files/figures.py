"""Pictures of results, drawn without a screen (Matplotlib's Agg canvas; no global state is touched)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import require_new, whole_file
from instrument.files.errors import FileError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Image = npt.NDArray[np.floating]

INK = "#22303c"
FAINT = "#8496a5"
ACCENT = "#d1495b"
SECOND = "#00798c"


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture of a summary: grey (height, width) or colour (height, width, 3), any scale."""

    title: str
    image: Image
    caption: str = ""
    pixel_mm: float | None = None
    """Size of one pixel, for a scale bar; None draws none."""
    gamma: float = 1.0
    """Display value = (value / white) ** gamma; below 1 lifts the shadows."""
    white: float | None = None
    """Value shown as white; the 99.8th percentile by default."""


@dataclass(frozen=True, slots=True)
class Convergence:
    """Error against time, for the plot below the pictures."""

    seconds: Sequence[float]
    values: Sequence[float]
    label: str
    reached: str = ""
    """A word or two at the last point, e.g. ``"26.1 dB"``."""
    x_label: str = "seconds of reconstruction"
    log: bool = False
    """Whether the values' axis is logarithmic."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What one run of the bench shows at a glance: four pictures, the sweep, and the convergence."""

    title: str
    panels: Sequence[Panel]
    convergence: Convergence
    sweep: Sequence[Panel] = ()
    sweep_title: str = ""
    lines: Sequence[tuple[str, str]] = field(default_factory=tuple)
    """Facts listed beside the plot: name and value."""
    simulated: bool = False
    """Writes SIMULATED over the figure."""


def summary_figure(summary: Summary) -> Figure:
    """Draw a summary: pictures on top, the axial sweep as a strip, convergence and facts below.

    Returns
    -------
    matplotlib.figure.Figure
        In a notebook it shows itself; :func:`save_figure` writes it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = 3 if summary.sweep else 2
    heights = [2.75, 1.1, 2.4] if summary.sweep else [2.75, 2.4]
    figure = Figure(figsize=(14.0, sum(heights) + 1.5), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    outer = figure.add_gridspec(
        rows, 1, height_ratios=heights, hspace=0.42, left=0.035, right=0.985, top=0.885, bottom=0.075
    )
    pictures = outer[0].subgridspec(1, len(summary.panels), wspace=0.06)
    for column, panel in enumerate(summary.panels):
        draw_panel(figure.add_subplot(pictures[0, column]), panel)
    if summary.sweep:
        strip = outer[1].subgridspec(1, len(summary.sweep), wspace=0.05)
        for column, panel in enumerate(summary.sweep):
            draw_panel(figure.add_subplot(strip[0, column]), panel, small=True)
        top = outer[1].get_position(figure).y1
        figure.text(0.035, top + 0.028, summary.sweep_title, fontsize=13, color=INK, va="bottom")
    bottom = outer[rows - 1].subgridspec(1, 2, width_ratios=[1.25, 1.0], wspace=0.12)
    _draw_convergence(figure.add_subplot(bottom[0, 0]), summary.convergence)
    draw_facts(figure.add_subplot(bottom[0, 1]), summary.lines)
    figure.text(0.035, 0.955, summary.title, fontsize=17, color=INK, weight="bold", va="center")
    if summary.simulated:
        mark_simulated(figure, 0.955)
    return figure


def check_figure(path: Path, *, overwrite: bool | None = True) -> None:
    """Refuse a name that no figure is written under, or of a file that may not be overwritten.

    ``overwrite`` is as for :func:`~instrument.files.atomic.require_new`. Raises FileError.
    """
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise FileError(path, "a figure is written as .png, .pdf or .svg.")
    require_new(path, overwrite=overwrite)


def pictures_figure(
    title: str, panels: Sequence[Panel], lines: Sequence[tuple[str, str]] = (), *, simulated: bool = False
) -> Figure:
    """Draw pictures side by side, facts beside them."""
    from matplotlib.figure import Figure

    height, width = panels[0].image.shape[:2]
    wide = max(2.5, 4.2 * width / height)
    columns = [wide] * len(panels) + [4.5] * bool(lines)
    figure = Figure(figsize=(sum(columns) + 0.6, 5.6), dpi=100, facecolor="white")
    grid = figure.add_gridspec(
        1, len(columns), width_ratios=columns, wspace=0.08, left=0.035, right=0.985, top=0.82, bottom=0.09
    )
    for column, panel in enumerate(panels):
        draw_panel(figure.add_subplot(grid[0, column]), panel)
    if lines:
        draw_facts(figure.add_subplot(grid[0, -1]), lines)
    figure.text(0.035, 0.94, title, fontsize=17, color=INK, weight="bold", va="center")
    if simulated:
        mark_simulated(figure, 0.94)
    return figure


def mark_simulated(figure: Figure, y: float) -> None:
    """Write SIMULATED at a figure's right side, ``y`` from its bottom."""
    box: dict[str, Any] = {"boxstyle": "round,pad=0.35", "facecolor": ACCENT, "edgecolor": "none"}
    bold: dict[str, Any] = {"fontsize": 14, "weight": "bold", "color": "white"}
    figure.text(0.985, y, "SIMULATED", ha="right", va="center", bbox=box, **bold)


def save_figure(figure: Figure, path: Path | str) -> Path:
    """Write a figure, whole or not at all, as PNG (or what the name's ending says) and return its path.

    Errors as ``whole_file``.
    """
    target = Path(path)
    optimised: dict[str, Any] = {"pil_kwargs": {"optimize": True}} if target.suffix.lower() == ".png" else {}
    with whole_file(target) as temporary:  # other writers do not know the option, not even as None
        figure.savefig(temporary, **optimised)
    return target


def draw_panel(axes: Axes, panel: Panel, *, small: bool = False) -> None:
    """Draw a picture with its title, caption and scale bar."""
    white = panel.white if panel.white is not None else float(np.percentile(panel.image, 99.8))
    shown = np.clip(panel.image / max(white, 1e-12), 0.0, 1.0) ** panel.gamma
    axes.imshow(shown, cmap="gray", vmin=0.0, vmax=1.0, interpolation="antialiased")
    axes.set_anchor("NW")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_edgecolor(FAINT)
        spine.set_linewidth(0.6)
    axes.set_title(panel.title, fontsize=9 if small else 13, color=INK, loc="left", pad=3 if small else 5)
    if panel.caption:
        axes.set_xlabel(panel.caption, fontsize=8 if small else 10, color=FAINT, loc="left", labelpad=4)
    if panel.pixel_mm is not None:
        _draw_scale_bar(axes, panel.image.shape[1], panel.image.shape[0], panel.pixel_mm)


def _draw_scale_bar(axes: Axes, width: int, height: int, pixel_mm: float) -> None:
    length_mm = _round_length(0.22 * width * pixel_mm)
    length = length_mm / pixel_mm
    left, y = 0.05 * width, 0.93 * height
    axes.plot([left, left + length], [y, y], color="white", linewidth=2.5, solid_capstyle="butt")
    name = f"{length_mm:g} mm" if length_mm < 1000 else f"{length_mm / 1000:g} m"
    axes.text(left, y - 0.025 * height, name, color="white", fontsize=9, va="bottom")


def _round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not longer than ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * (1 + 1e-9)))


def _draw_convergence(axes: Axes, convergence: Convergence) -> None:
    seconds, values = np.asarray(convergence.seconds), np.asarray(convergence.values)
    axes.plot(seconds, values, color=SECOND, linewidth=2)
    if len(seconds):
        axes.plot(seconds[-1:], values[-1:], "o", color=ACCENT, markersize=6)
        axes.annotate(
            convergence.reached,
            (seconds[-1], values[-1]),
            xytext=(-6, 9),
            textcoords="offset points",
            ha="right",
            color=ACCENT,
            fontsize=11,
            weight="bold",
        )
        axes.margins(x=0.02, y=0.18)
        axes.set_xlim(left=0.0)
    if convergence.log:
        axes.set_yscale("log")
    style(axes, convergence.label, convergence.x_label, title_size=13)


def style(axes: Axes, title: str, x: str = "", y: str = "", *, title_size: float = 11.5) -> None:
    """Name a plot and its axes, and give it a faint grid and no box."""
    axes.set_title(title, fontsize=title_size, color=INK, loc="left", pad=5)
    axes.set_xlabel(x, fontsize=10, color=INK)
    axes.set_ylabel(y, fontsize=10, color=INK)
    axes.tick_params(labelsize=9, colors=INK, length=2)
    axes.grid(True, color="#e3e8ec", linewidth=0.7)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_edgecolor(FAINT)


def draw_facts(axes: Axes, lines: Sequence[tuple[str, str]]) -> None:
    """List facts, name and value, where a plot would be."""
    axes.set_axis_off()
    step = 1.0 / max(len(lines), 8)
    for index, (name, value) in enumerate(lines):
        y = 1.0 - (index + 0.4) * step
        axes.text(0.0, y, name, transform=axes.transAxes, fontsize=10.5, color=FAINT, va="center")
        axes.text(0.3, y, value, transform=axes.transAxes, fontsize=10.5, color=INK, va="center")
