"""The page of a comparison of optics: PSFs, photographs, beads in depth, pictures, error against photons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from instrument.files.figures import mark_simulated, style
from recon.arrays import Float32Array
from recon.evaluation.optics_compared import DEPTHS_UM, Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEADS = "Beads lie at calibrated depths only; light from between them is not tested."
"""What a page and a table of a comparison say below."""
_COLOURS = ("#444444", "#1b7fbd", "#d9822b", "#2a9d4a")
_LIGHTS = 5
"""Lights whose pictures are shown."""
_MARGIN = 32
"""Pixels at each edge of the sensor's grid that the scenes leave dark."""
_LEGEND = 0.28
"""Height of the legend below the curves, of theirs."""


def optics_figure(compared: Comparison) -> Figure:
    """Draw a row for every kind of optics: its PSF, the beads plane by plane, the picture at each light.

    The scenes stand above them (Figs. 6.2 and 6.3), errors below.
    """
    from matplotlib.figure import Figure

    first = next(iter(compared.found.values()))
    lights = _spread(sorted(first.pictures), _LIGHTS)
    n_z, n = len(compared.beads), len(compared.found)
    widths = [*[1] * (2 + n_z), 0.15, *[1] * (1 + len(lights))]
    figure = Figure(figsize=(1.7 * sum(widths), 1.7 * (n + 1) + 4.4), layout="constrained")
    figure.suptitle("One scene through four kinds of optics, equal light\n")
    rows = figure.add_gridspec(n + 2, 1, height_ratios=[*[1] * (n + 1), 1.9])

    def row(at: int) -> tuple[list[Axes], list[Axes]]:
        cells = rows[at].subgridspec(1, len(widths), width_ratios=widths)
        axes = [figure.add_subplot(cells[0, column]) for column in range(len(widths))]
        for cell in axes:
            cell.axis("off")
        return axes[: 2 + n_z], axes[3 + n_z :]

    depths = [f"{z / 1e3:.2g} mm" for z in DEPTHS_UM]
    deep, flat = row(0)
    deep[0].set_title("Beads in depth", loc="left", fontsize=11)
    flat[0].set_title("A picture in focus", loc="left", fontsize=11)
    for cell, plane, depth in zip(deep[2:], compared.beads, depths, strict=True):
        _scene(cell, plane, f"the beads, {depth}", float(compared.beads.max()))
    _scene(flat[-1], compared.picture, "the picture")
    for at, (name, found) in enumerate(compared.found.items(), 1):
        deep, flat = row(at)
        _show(deep[0], np.sqrt(np.maximum(found.psfs[n_z // 2], 0)), "PSF (square root)")
        deep[0].axis("on")
        deep[0].set(xticks=[], yticks=[], ylabel=name)
        _show(deep[1], found.bead_photograph, "photograph")
        for cell, plane, depth in zip(deep[2:], found.volume, depths, strict=True):
            _scene(cell, plane, depth, float(found.volume.max()))
        _show(flat[0], found.photograph, "photograph")
        for cell, photons in zip(flat[1:], lights, strict=True):
            _scene(cell, found.pictures[photons], f"{photons:.3g} photons: {found.psnr_db[photons]:.1f} dB")
    below = rows[n + 1].subgridspec(1, 2, width_ratios=[2 + n_z, 1.15 + len(lights)])
    _beads(figure.add_subplot(below[0, 0]), compared)
    _errors(figure.add_subplot(below[0, 1]), compared)
    figure.supxlabel(BEADS, fontsize=9)
    mark_simulated(figure, 0.985)
    return figure


def _spread(values: list[float], most: int) -> list[float]:
    """Return the values, or as many as there is room for, first and last among them."""
    if len(values) <= most:
        return values
    return [values[round(k * (len(values) - 1) / (most - 1))] for k in range(most)]


def _beads(axes: Axes, compared: Comparison) -> None:
    names = list(compared.found)[::-1]
    colours = dict(zip(compared.found, _COLOURS, strict=True))
    values = [compared.found[name].volume_psnr_db for name in names]
    bars = axes.barh(names, values, color=[colours[name] for name in names])
    words = [
        f" {compared.found[name].volume_psnr_db:.1f} dB, {compared.found[name].light_in_place:.0%} in place"
        for name in names
    ]
    axes.bar_label(bars, words, fontsize=9)
    axes.set_xlim(0, 1.4 * max(values))
    style(axes, "Beads against the scene, and their light at its place in all three axes", "PSNR, dB", "")


def _errors(axes: Axes, compared: Comparison) -> None:
    for (name, found), colour in zip(compared.found.items(), _COLOURS, strict=True):
        lights = sorted(found.psnr_db)
        axes.semilogx(lights, [found.psnr_db[light] for light in lights], "o-", color=colour, label=name)
    style(axes, "Picture against the scene", "photons on the sensor", "PSNR, dB")
    low, high = axes.get_ylim()
    axes.set_ylim(low - _LEGEND * (high - low), high)  # the legend's own place: no line runs there
    axes.legend(loc="lower center", frameon=False, ncols=2, fontsize=9, columnspacing=1.0, handlelength=1.2)


def _show(axes: Axes, image: Float32Array, title: str, top: float = 0.0) -> None:
    top = top or max(float(np.percentile(image, 99.8)), 1e-30)
    axes.imshow(image, cmap="gray", vmin=0, vmax=top, interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.axis("off")


def _scene(axes: Axes, image: Float32Array, title: str, brightest: float = 0.0) -> None:
    """Show what is around the scene, beads of all planes at one brightness: white from half of the most."""
    _show(axes, image[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN], title, 0.5 * brightest)
