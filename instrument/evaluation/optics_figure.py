"""The page of a comparison of optics: PSFs, photographs, pictures, beads in depth, error against photons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from instrument.files.figures import mark_simulated, style
from instrument.files.seen import srgb
from instrument.reconstruction.result_figures import in_colour_of_depth
from recon.evaluation.optics_compared import Comparison, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

BEADS = "Beads lie at calibrated depths only; light from between them is not tested."
"""What a page and a table of a comparison say below."""
_COLOURS = ("#444444", "#1b7fbd", "#d9822b", "#2a9d4a")
_MARGIN = 32
"""Pixels at each edge of the sensor's grid that the scenes leave dark."""


def optics_figure(compared: Comparison) -> Figure:
    """Draw a row for every kind of optics, the scenes above them, and the error against photons below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 15.5), layout="constrained")
    figure.suptitle("One scene through four kinds of optics, equal light\n")
    rows = figure.add_gridspec(
        len(compared.found) + 2, 1, height_ratios=[*[1] * (len(compared.found) + 1), 1.5]
    )
    few, many = (
        min(next(iter(compared.found.values())).pictures),
        max(next(iter(compared.found.values())).pictures),
    )
    titles = (
        "PSF (square root)",
        "photograph",
        f"{few:.0e} photons",
        f"{many:.0e} photons",
        "beads, depth as colour",
    )
    first = _row(figure, rows[0])
    for axes in first:
        axes.axis("off")
    _picture(first[3], compared.picture, "the picture")
    _depths(first[4], compared.beads, "the beads")
    for row, (name, found) in enumerate(compared.found.items(), 1):
        cells = _row(figure, rows[row])
        shown = (np.sqrt(np.maximum(found.psf, 0)), found.photograph)
        for place, image, title in zip(cells[:2], shown, titles[:2], strict=True):
            _show(place, image, title)
        for place, photons, title in zip(cells[2:4], (few, many), titles[2:4], strict=True):
            _picture(place, found.pictures[photons], f"{title}: {found.psnr_db[photons]:.1f} dB")
        _depths(cells[4], found.volume, f"{titles[4]}: {found.volume_psnr_db:.1f} dB")
        cells[0].axis("on")
        cells[0].set(xticks=[], yticks=[], ylabel=name)
    below = figure.add_subplot(rows[len(compared.found) + 1])
    for (name, found), colour in zip(compared.found.items(), _COLOURS, strict=True):
        lights = sorted(found.psnr_db)
        values = [found.psnr_db[light] for light in lights]
        below.semilogx(lights, values, "o-", color=colour, label=name)
    style(below, "Picture against the scene", "photons on the sensor", "PSNR, dB")
    below.legend(loc="lower right", frameon=False)
    figure.supxlabel(BEADS, fontsize=9)
    mark_simulated(figure, 0.985)
    return figure


def _row(figure: Figure, place: SubplotSpec) -> list[Axes]:
    cells = place.subgridspec(1, 5)
    return [figure.add_subplot(cells[0, column]) for column in range(5)]


def _show(axes: Axes, image: Image, title: str) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=max(float(np.percentile(image, 99.8)), 1e-30))
    axes.set_title(title, fontsize=9)
    axes.axis("off")


def _picture(axes: Axes, image: Image, title: str) -> None:
    _show(axes, image[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN], title)


def _depths(axes: Axes, volume: Image, title: str) -> None:
    front = volume.max(axis=0)
    coloured = in_colour_of_depth(front, volume.argmax(axis=0), len(volume), 0.5 * float(front.max()) or 1.0)
    axes.imshow(srgb(coloured)[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN], interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.axis("off")
