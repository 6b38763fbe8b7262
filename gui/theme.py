"""Looks for a dark room: a dark theme, a red one that spares night vision, and colour maps of images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtGui import QColor, QPalette
from PySide6.QtWidgets import QApplication

from instrument.live.frame_view import SATURATED


@dataclass(frozen=True, slots=True)
class Colours:
    """The colours of a theme, as ``#rrggbb``."""

    window: str
    panel: str
    field: str
    line: str
    text: str
    dim: str
    accent: str
    ok: str
    warning: str
    error: str
    stop: str
    stop_text: str
    curves: tuple[str, ...]
    """For plots, in turn."""
    colour_map: str
    """The images' colour map to begin with: a name of ``gui.theme``."""
    red_light_only: bool = False
    """Whether hues cannot distinguish things: brightness has to."""


DARK = Colours(
    window="#14171c",
    panel="#1b1f26",
    field="#242a33",
    line="#343c48",
    text="#d7dde6",
    dim="#8792a2",
    accent="#4aa3df",
    ok="#58c08a",
    warning="#e5b454",
    error="#f0716b",
    stop="#d5322d",
    stop_text="#ffffff",
    curves=("#4aa3df", "#e5b454", "#58c08a", "#c58af0", "#f0716b", "#7fd3d6"),
    colour_map="grey",
)
RED = Colours(
    window="#0a0000",
    panel="#120202",
    field="#1d0404",
    line="#3f0b0b",
    text="#d83a30",
    dim="#94241f",
    accent="#ff4a3d",
    ok="#b5322a",
    warning="#ff5c4d",
    error="#ff2a1c",
    stop="#a80f08",
    stop_text="#000000",
    curves=("#ff4a3d", "#a82a22", "#ff8074", "#7a1a14", "#d83a30", "#ff2a1c"),
    colour_map="red",
    red_light_only=True,
)
"""Only red light: no channel but red above a few levels."""
THEMES = {"dark": DARK, "red": RED}

_now = [DARK]


def colours() -> Colours:
    """Return the colours in use."""
    return _now[0]


def apply_theme(app: QApplication, name: str) -> None:
    """Give the whole program the looks of a theme, ``"dark"`` or ``"red"``."""
    theme = THEMES[name]
    _now[0] = theme
    app.setStyle("Fusion")
    palette = QPalette()
    role = QPalette.ColorRole
    for what, colour in {
        role.Window: theme.window,
        role.WindowText: theme.text,
        role.Base: theme.field,
        role.AlternateBase: theme.panel,
        role.Text: theme.text,
        role.PlaceholderText: theme.dim,
        role.Button: theme.field,
        role.ButtonText: theme.text,
        role.BrightText: theme.warning,
        role.Highlight: theme.accent,
        role.HighlightedText: theme.window,
        role.ToolTipBase: theme.field,
        role.ToolTipText: theme.text,
        role.Link: theme.accent,
        role.Light: theme.line,
        role.Midlight: theme.line,
        role.Mid: theme.line,
        role.Dark: theme.window,
        role.Shadow: theme.window,
    }.items():
        palette.setColor(what, QColor(colour))
    for what in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, what, QColor(theme.dim).darker(130))
    app.setPalette(palette)
    app.setStyleSheet(_style(theme))


def _style(c: Colours) -> str:
    faint = QColor(c.dim).darker(150).name()
    filled = QColor(c.accent).darker(220).name()  # text over it stays readable
    return f"""
QWidget {{ font-size: 10pt; }}
QToolTip {{ background: {c.field}; color: {c.text}; border: 1px solid {c.line}; padding: 3px; }}
QLineEdit, QPlainTextEdit, QTextEdit, QSpinBox, QDoubleSpinBox, QListView, QTreeView, QTableView {{
  background: {c.field}; border: 1px solid {c.line}; border-radius: 4px; padding: 3px 5px;
  selection-background-color: {c.accent}; selection-color: {c.window}; }}
QLineEdit:focus, QPlainTextEdit:focus, QListView:focus, QTableView:focus {{ border-color: {c.accent}; }}
QGraphicsView {{ border: 1px solid transparent; }}
QGraphicsView:focus {{ border: 1px solid {c.accent}; }}
QLineEdit:read-only {{ background: {c.panel}; }}
*[refused="true"] {{ border: 2px solid {c.error}; color: {c.error}; font-weight: 700; }}
QLabel#reason {{ color: {c.error}; font-size: 9pt; }}
QLabel#refusal {{ color: {c.warning}; }}
QLabel#dim, QLabel[role="dim"] {{ color: {c.dim}; }}
QLabel[role="value"] {{ color: {c.text}; font-weight: 600; }}
QLabel[role="title"] {{ color: {c.text}; font-size: 16pt; font-weight: 600; }}
QLabel[role="hint"] {{ color: {c.dim}; font-size: 11pt; }}
QCommandLinkButton {{ background: {c.field}; border: 1px solid {c.line}; border-radius: 6px; padding: 8px;
  text-align: left; color: {c.text}; }}
QCommandLinkButton:hover, QCommandLinkButton:focus {{ border-color: {c.accent}; }}
QLabel[role="heading"] {{ color: {c.dim}; font-size: 9pt; font-weight: 600; }}
QPushButton, QToolButton {{ background: {c.field}; border: 1px solid {c.line}; border-radius: 4px;
  padding: 4px 10px; }}
QPushButton:hover, QToolButton:hover {{ border-color: {c.accent}; }}
QPushButton:focus, QToolButton:focus {{ border-color: {c.accent}; }}
QPushButton:pressed, QPushButton:checked, QToolButton:checked {{ background: {c.accent}; color: {c.window}; }}
QPushButton:disabled, QToolButton:disabled {{ color: {faint}; }}
QPushButton:flat {{ background: transparent; border: none; color: {c.dim}; padding: 2px 6px; }}
QPushButton:flat:hover, QPushButton:flat:focus {{ color: {c.accent}; }}
QPushButton#stop {{ background: {c.stop}; color: {c.stop_text}; border: none; border-radius: 5px;
  font-size: 14pt; font-weight: 800; padding: 6px 26px; letter-spacing: 2px; }}
QPushButton#stop:hover, QPushButton#stop:focus {{ border: 2px solid {c.text}; padding: 4px 24px; }}
QPushButton#primary {{ background: {c.accent}; color: {c.window}; border: none; font-weight: 600;
  padding: 5px 14px; }}
QPushButton#primary:disabled {{ background: {c.field}; color: {c.dim}; }}
QLabel#simulated, QLabel#caution {{ background: {c.warning}; color: {c.window}; font-weight: 800;
  padding: 3px 10px;
  border-radius: 4px; letter-spacing: 1px; }}
QFrame#jog-pad {{ background: {c.field}; border: 1px dashed {c.line}; border-radius: 5px; }}
QFrame#jog-pad[active="true"] {{ border: 2px solid {c.accent}; }}
QFrame#strip {{ background: {c.panel}; border-bottom: 1px solid {c.line}; }}
QGroupBox {{ border: 1px solid {c.line}; border-radius: 5px; margin-top: 10px; padding-top: 6px; }}
QGroupBox::title {{ subcontrol-origin: margin; left: 8px; padding: 0 4px; color: {c.dim}; }}
QTabWidget::pane {{ border: 1px solid {c.line}; }}
QTabBar::tab {{ background: {c.panel}; color: {c.dim}; border: 1px solid {c.line}; border-bottom: none;
  padding: 5px 12px; margin-right: 1px; }}
QTabBar::tab:selected {{ background: {c.field}; color: {c.text}; border-top: 2px solid {c.accent}; }}
QTabBar::tab:hover {{ color: {c.text}; }}
QDockWidget {{ color: {c.dim}; }}
QDockWidget::title {{ background: {c.panel}; padding: 4px 8px; }}
QMainWindow::separator {{ background: {c.line}; width: 3px; height: 3px; }}
QSplitter::handle {{ background: {c.line}; }}
QProgressBar {{ background: {c.field}; border: 1px solid {c.line}; border-radius: 4px; text-align: center; }}
QProgressBar::chunk {{ background: {filled}; border-radius: 3px; }}
QScrollBar:vertical {{ background: {c.window}; width: 10px; }}
QScrollBar:horizontal {{ background: {c.window}; height: 10px; }}
QScrollBar::handle {{ background: {c.line}; border-radius: 4px; min-height: 24px; min-width: 24px; }}
QScrollBar::add-line, QScrollBar::sub-line {{ width: 0; height: 0; }}
QStatusBar {{ background: {c.panel}; color: {c.dim}; }}
QToolBar {{ border: none; border-bottom: 1px solid {c.line}; }}
QMenuBar {{ border: none; }}
QMenuBar, QMenu {{ background: {c.panel}; }}
QMenu::item:selected, QMenuBar::item:selected {{ background: {c.accent}; color: {c.window}; }}
"""


_SIGNAL = SATURATED - 1
_SATURATED_RGB = {"grey": (255, 40, 40), "red": (255, 120, 90)}
_STOPS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "grey": ((0, 0, 0), (255, 255, 255)),
    "red": ((0, 0, 0), (175, 0, 0)),
}
_MATPLOTLIB = ("viridis", "inferno", "magma", "turbo")
NAMES = (*_STOPS, *_MATPLOTLIB)


@lru_cache(maxsize=16)
def table(name: str, *, mark_saturation: bool = True) -> npt.NDArray[np.uint8]:
    """Return ``(256, 3)`` uint8 colours of a map, the last one that of saturation.

    Parameters
    ----------
    name : str
        One of ``NAMES``.
    mark_saturation : bool
        Without, the last colour is that of the brightest signal.
    """
    if name in _STOPS:
        stops = np.array(_STOPS[name], float)
        places = np.linspace(0, 254, len(stops))
        colours = np.stack([np.interp(np.arange(255), places, stops[:, c]) for c in range(3)], axis=1)
    else:
        from matplotlib import colormaps

        colours = colormaps[name](np.linspace(0, 1, 255))[:, :3] * 255
    result = np.empty((256, 3), np.uint8)
    result[:255] = np.round(colours)
    result[SATURATED] = _SATURATED_RGB.get(name, (255, 255, 255)) if mark_saturation else result[254]
    result.flags.writeable = False
    return result


def spares_hues(name: str) -> bool:
    """Whether a map has one hue for everything: coloured images go through it too, by their brightness."""
    return name == "red"


def indices_of(image: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.float32]:
    """Return an image's places in a map, 0 to 254; what is no number is darkest."""
    scaled = (np.asarray(image, np.float32) - np.float32(low)) * np.float32(_SIGNAL / max(high - low, 1e-12))
    places: npt.NDArray[np.float32] = np.clip(np.nan_to_num(scaled, copy=False), 0, _SIGNAL, out=scaled)
    return places


def grey_indices(image: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.float32]:
    """Return the same of a coloured image (height, width, 3), by the mean of its channels."""
    places: npt.NDArray[np.float32] = indices_of(image, low, high).mean(axis=2)
    return places


def as_shown(image: npt.NDArray[Any], low: float, high: float, name: str) -> npt.NDArray[np.uint8]:
    """Return the 8-bit colours of an image as a view shows it in a map, (height, width, 3)."""
    if image.ndim == 2 or spares_hues(name):
        places = indices_of(image, low, high) if image.ndim == 2 else grey_indices(image, low, high)
        mapped: npt.NDArray[np.uint8] = table(name, mark_saturation=False)[places.astype(np.uint8)]
        return mapped
    return np.round(indices_of(image, low, high) * (255 / _SIGNAL)).astype(np.uint8)
