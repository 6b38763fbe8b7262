"""A sweep on the screen: its planned path, the quality of each PSF, their pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QHBoxLayout, QSizePolicy, QWidget

from calibration_routines.psf.psf_quality import MIN_SNR, PsfQuality
from calibration_routines.psf.sweep_watch import PointTaken
from gui.theme import colours
from gui.widgets.building import cell, fill, hint, split, table
from gui.widgets.plots import dots, plot_widget
from recon.arrays import Array

Place = Mapping[str, float]

_SHOWN = {"um": ("mm", 1e-3)}
"""Lengths are shown in millimetres."""
_MOST_SYMBOLS = 3000


class PathPlot(QWidget):
    """Draws places one after the other, the first one marked, and where the run is now.

    With lateral and axial motion there are two views: depth across, and along the axis. ``parts`` makes them:
    to make one when there is a path to be drawn would be a turn of the window's thread that is felt.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._layout = QHBoxLayout(self)
        self._layout.setContentsMargins(0, 0, 0, 0)
        self.nothing = hint("Nothing moves.")
        self.nothing.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._layout.addWidget(self.nothing)
        self._made: list[_View] = []
        self.views: list[_View] = []
        """Those that are shown."""
        self.places: tuple[Place, ...] = ()
        self.setMinimumHeight(140)

    def parts(self) -> Iterator[None]:
        """Make both views."""
        for _ in range(2):
            view = _View()
            view.plot.hide()
            self._layout.addWidget(view.plot)
            self._made.append(view)
            yield

    def show_path(self, places: Sequence[Place]) -> None:
        """Draw a path; an empty one says that nothing moves."""
        places = tuple(places)
        self.nothing.setText("Nothing moves." if not places else "The source goes to one place and stays.")
        if places == self.places:
            return
        self.places = places
        pairs = _pairs(places)
        self.views = self._made[: len(pairs)]
        for view, pair in zip(self.views, pairs, strict=True):
            view.set_axes(*pair)
        for view in self._made:
            view.plot.setVisible(view in self.views)
        self.nothing.setVisible(not self.views)
        for view in self.views:
            view.draw(places)

    def clear(self, words: str) -> None:
        """Show no path, and why."""
        self.show_path(())
        self.nothing.setText(words)

    def show_now(self, place: Place | None) -> None:
        """Mark where the run is."""
        for view in self.views:
            view.mark(place)

    def restyle(self) -> None:
        """Take over another theme."""
        for view in self.views:
            view.draw(self.places)


class _View:
    """One plot of two axes of the path."""

    def __init__(self) -> None:
        self.axes = "", ""
        self.plot: Any = plot_widget()
        self._scales = (1.0, 1.0)
        self._line: Any = self.plot.plot([], [])
        self._first: Any = self.plot.plot([], [])
        self._now: Any = self.plot.plot([], [])

    def set_axes(self, across: str, down: str) -> None:
        if (across, down) == self.axes:
            return
        self.axes = across, down
        (x, x_unit, x_scale), (y, y_unit, y_scale) = (_shown(name) for name in self.axes)
        self.plot.set_axes(x, y, x_unit, y_unit)
        self._scales = (x_scale, y_scale)

    def draw(self, places: Sequence[Place]) -> None:
        x, y = self._values(places)
        now = colours()
        symbols = dots(now.accent) if len(places) <= _MOST_SYMBOLS else {"symbol": None}
        self._line.setData(x, y, pen=pg.mkPen(now.dim, width=1), **symbols)
        start = dots(None, 10) | {"symbol": "s", "symbolPen": pg.mkPen(now.ok, width=2)}
        self._first.setData(x[:1], y[:1], pen=None, **start)
        here = dots(None, 13) | {"symbolPen": pg.mkPen(now.warning, width=2)}
        self._now.setData([], [], pen=None, **here)
        self.plot.autoRange()

    def mark(self, place: Place | None) -> None:
        if place is None or not all(name in place for name in self.axes):
            self._now.setData([], [])
            return
        x, y = self._values([place])
        self._now.setData(x, y)

    def _values(self, places: Sequence[Place]) -> list[Any]:
        return [
            np.array([place.get(name, 0.0) * scale for place in places])
            for name, scale in zip(self.axes, self._scales, strict=True)
        ]


def _pairs(places: Sequence[Place]) -> list[tuple[str, str]]:
    """Return the axes of each view: those that change, depth across."""
    names = sorted({name for place in places for name in place})
    moving = [n for n in names if len({place.get(n) for place in places}) > 1]
    if not moving:
        return []
    lateral = [n for n in moving if n in ("x_um", "y_um")]
    if "z_um" in moving:
        side = ("z_um", lateral[0] if lateral else "x_um")
        return [side, ("x_um", "y_um")] if len(lateral) == 2 else [side]
    if lateral:
        return [("x_um", "y_um")]
    other = [n for n in names if n != moving[0]]
    return [(moving[0], (moving[1:] or other or moving)[0])]


def _shown(name: str) -> tuple[str, str, float]:
    """Return the name of ``x_um`` without its unit, the unit that it is shown in, and the factor to that."""
    axis, _, unit = name.rpartition("_")
    return (axis, *_SHOWN.get(unit, (unit, 1.0)))


_COLUMNS = (
    ("x\n(mm)", "Where the source stood"),
    ("y\n(mm)", "Where the source stood"),
    ("z\n(mm)", "Where the source stood"),
    ("signal\n/noise", f"Mean signal inside the pattern over a pixel's noise; from {MIN_SNR:g} it is good"),
    ("satu-\nrated", "Pixels at full scale"),
    ("off\n(px)", "Distance from where the others, or the stage, say the pattern is"),
    ("verdict", "What is wrong; the whole text as tool tip"),
)
_VERDICT = len(_COLUMNS) - 1


class PsfTable(QWidget):
    """A table of PSFs and a plot of their signal to noise; those with findings are marked.

    Signals
    -------
    chosen : int
        The row of a PSF that was clicked.
    """

    chosen = Signal(int)

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.table = table([name for name, _ in _COLUMNS], wide=_VERDICT)
        for place, (name, tip) in enumerate(_COLUMNS):
            self.table.setHorizontalHeaderItem(place, cell(name, tip))
        self.table.currentCellChanged.connect(lambda row, *_: self.chosen.emit(row))
        # Beside an axis so low the words are cut off.
        self.plot: Any = plot_widget("signal / noise of each PSF", counts=True)
        self.plot.setMinimumHeight(90)
        self._points: Any = self.plot.plot([], [])
        self._least: Any = pg.InfiniteLine(angle=0, pos=MIN_SNR)
        self.plot.addItem(self._least)
        self._qualities: list[PsfQuality | None] = []
        self.nothing = hint("No PSF yet: each is judged here as it arrives.")
        self._both = split(self.table, self.plot, sizes=[220, 140], down=True)
        fill(self, (self._both, 1), (self.nothing, 1))
        self.restyle()

    @property
    def qualities(self) -> tuple[PsfQuality | None, ...]:
        """What is shown, by row; None for PSFs that have not arrived."""
        return tuple(self._qualities)

    def clear(self) -> None:
        """Show nothing."""
        self._qualities = []
        self.table.setRowCount(0)
        self._draw()

    def arrived(self, event: PointTaken) -> None:
        """Show a PSF that was just taken, or taken again."""
        row = event.number - 1
        self._set(row, event.quality, "taking it again" if event.retaking else "")
        self.table.scrollTo(self.table.model().index(row, 0))
        self._draw()

    def show_all(self, qualities: Sequence[PsfQuality]) -> None:
        """Show the last judgement, which holds all PSFs against one another."""
        self.table.setRowCount(len(qualities))
        self._qualities = []
        for row, quality in enumerate(qualities):
            self._set(row, quality)
        self._draw()

    def restyle(self) -> None:
        """Take over another theme."""
        self._least.setPen(pg.mkPen(colours().warning, style=Qt.PenStyle.DashLine))
        self._draw()

    def _set(self, row: int, quality: PsfQuality, note: str = "") -> None:
        if self.table.rowCount() <= row:
            self.table.setRowCount(row + 1)
        self._qualities += [None] * (row + 1 - len(self._qualities))
        self._qualities[row] = quality
        verdict = note or ("good" if not quality.findings else " ".join(quality.findings))
        cells = [f"{value / 1e3:.3f}" for value in quality.source_um]
        cells += [f"{quality.snr:.0f}", f"{quality.saturated_pixels}", f"{quality.step_px:.2f}", verdict]
        tip, warns = "\n".join(quality.findings), bool(quality.findings)
        for place, text in enumerate(cells):
            self.table.setItem(row, place, cell(text, tip, number=place != _VERDICT, warns=warns))

    def _draw(self) -> None:
        # A single frame without noise has no figure.
        known = [(row + 1, q) for row, q in enumerate(self._qualities) if q is not None and isfinite(q.snr)]
        self.plot.setVisible(bool(known))
        self._both.setVisible(bool(self._qualities))
        self.nothing.setVisible(not self._qualities)
        brushes = [pg.mkBrush(colours().warning if q.findings else colours().ok) for _, q in known]
        self._points.setData(
            [number for number, _ in known],
            [q.snr for _, q in known],
            pen=pg.mkPen(colours().line),
            **dots(brushes or None, 7),
        )


_IN_FULL = 24
"""PSFs that are kept as they are, up to 2 MB each; a sweep may take a thousand."""
_SMALL_PX = 256
_LEVELS = (0.1, 99.9)
"""Percentiles that small pictures are stretched to."""


class PsfPicture(NamedTuple):
    """A PSF, and by how much it was reduced along each side: 1 as it arrived, else 8 bit for the eye."""

    image: Array
    reduced: int


class PsfPictures:
    """Pictures by number; of all but the newest only a small one is kept."""

    def __init__(self) -> None:
        self._in_full: dict[int, Array] = {}
        self._small: dict[int, PsfPicture] = {}

    def keep(self, number: int, image: Array) -> None:
        """Keep a picture, in place of an earlier one of the same number."""
        self._in_full.pop(number, None)
        self._small.pop(number, None)
        self._in_full[number] = image
        if len(self._in_full) > _IN_FULL:
            oldest = next(iter(self._in_full))
            self._small[oldest] = small(self._in_full.pop(oldest))

    def get(self, number: int) -> PsfPicture | None:
        """Return a picture; None where none has arrived."""
        image = self._in_full.get(number)
        return PsfPicture(image, 1) if image is not None else self._small.get(number)


def small(image: Array) -> PsfPicture:
    """Return an image, (height, width), as means of blocks stretched to 8 bit, 256 pixels wide at most."""
    factor = -(-max(image.shape) // _SMALL_PX)
    height, width = (max(1, length // factor) for length in image.shape)
    rows, columns = min(factor, image.shape[0]), min(factor, image.shape[1])
    blocks = image[: height * rows, : width * columns].reshape(height, rows, width, columns)
    means = blocks.mean(axis=(1, 3))
    low, high = np.percentile(means, _LEVELS)
    stretched = (means - low) * (255 / max(high - low, 1.0))
    return PsfPicture(np.clip(np.rint(stretched), 0, 255).astype(np.uint8), factor)
