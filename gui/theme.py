"""Looks: a dark theme, a light one, a red one that spares night vision, and colour maps of images."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakSet

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QSettings
from PySide6.QtGui import QColor, QPalette
from PySide6.QtWidgets import QApplication, QDialog, QWidget
from shiboken6 import isValid

from instrument.live.frame_view import SATURATED
from recon.arrays import Array, Float32Array


@dataclass(frozen=True, slots=True)
class Colours:
    """The colours of a theme, as ``#rrggbb``; contrasts are those of WCAG 2.1 AA."""

    window: str
    panel: str
    field: str
    line: str
    """Between parts; says nothing."""
    border: str
    """Round what takes keys and clicks."""
    text: str
    dim: str
    accent: str
    ok: str
    warning: str
    error: str
    stop: str
    """Of no other area is the contrast with the window as great."""
    stop_text: str
    primary: str
    """Fills the button that a panel is there for, what is switched on, what is chosen."""
    primary_text: str
    badge: str
    badge_text: str
    curves: tuple[str, ...]
    """For plots, in turn."""
    colour_map: str = "grey"
    """The images' colour map to begin with: a name of ``gui.theme``."""
    red_light_only: bool = False
    """Whether hues cannot distinguish things: brightness, dashes and words have to."""


DARK = Colours(
    window="#14171c",
    panel="#1b1f26",
    field="#242a33",
    line="#343c48",
    border="#6c7889",
    text="#d7dde6",
    dim="#98a3b3",
    accent="#5fb0e8",
    ok="#58c08a",
    warning="#e5b454",
    error="#f58079",
    stop="#ff5247",
    stop_text="#1a0000",
    primary="#1f5f8b",
    primary_text="#ffffff",
    badge="#6b4e00",
    badge_text="#ffe0a0",
    curves=("#5fb0e8", "#e5b454", "#58c08a", "#c58af0", "#f58079", "#7fd3d6"),
)
LIGHT = Colours(
    window="#f1f3f6",
    panel="#f8f9fb",
    field="#ffffff",
    line="#cfd5dd",
    border="#7d8794",
    text="#1b1f26",
    dim="#535c69",
    accent="#0a64a4",
    ok="#176c3c",
    warning="#855400",
    error="#b3261e",
    stop="#c8000f",
    stop_text="#ffffff",
    primary="#c9e1f4",
    primary_text="#0b3d63",
    badge="#ffe1a3",
    badge_text="#4d3500",
    curves=("#0a64a4", "#a05a00", "#176c3c", "#7a3fb0", "#b3261e", "#00707a"),
)
RED = Colours(
    window="#0a0000",
    panel="#120202",
    field="#1d0404",
    line="#3f0b0b",
    border="#c0302a",
    text="#ff7a6e",
    dim="#e8493d",
    accent="#ff8278",
    ok="#f0564a",
    warning="#ff8278",
    error="#ff5c4d",
    stop="#ff4a3d",
    stop_text="#000000",
    primary="#6e1610",
    primary_text="#ff8278",
    badge="#4a0e0a",
    badge_text="#ff8278",
    curves=("#ff8278", "#ff4a3d", "#c2251c", "#ff6a5e", "#e2473b", "#d9362c"),
    colour_map="red",
    red_light_only=True,
)
"""Only red light: no channel but red above a few levels."""
THEMES = {"dark": DARK, "light": LIGHT, "red": RED}

SMALL_PT, BODY_PT, LARGE_PT, TITLE_PT = 9, 10, 12, 16
"""The type scale: reasons and headings, everything else, hints, what a page is called."""

_now = [DARK]


_log = logging.getLogger(__name__)

TURN = "turn"
"""Yielded by what makes or dresses widgets a part at a time: what it did is painted before it goes on."""
_half: WeakSet[QWidget] = WeakSet()
"""Parts that have a theme's sheet and, as another was chosen meanwhile, not all of its colours."""


def colours() -> Colours:
    """Return the colours in use."""
    return _now[0]


def sheet() -> str:
    """Return the style sheet of the theme in use."""
    return _style(colours())


def theme_of(settings: QSettings) -> str:
    """Return the theme that was chosen last."""
    name = str(settings.value("theme", "dark"))
    return name if name in THEMES else "dark"


def apply_theme(app: QApplication, name: str) -> None:
    """Give the whole program the looks of a theme, one of :data:`THEMES`, before there is a window."""
    _now[0] = THEMES[name]
    if not app.styleSheet():  # which hides the style's own name
        app.setStyle("Fusion")
    app.setPalette(_palette())
    app.setStyleSheet(sheet())


def change_theme(name: str, window: QWidget, wholes: Sequence[QWidget]) -> Generator[str | None]:
    """Give a window the looks of another theme, one of :data:`THEMES`, with a ``yield`` after each part.

    A sheet at the window, or the program, would go to all of two thousand widgets at once.

    Parameters
    ----------
    name : str
    window : QWidget
        Is not painted until what is seen of it has the new looks, and then at once.
    wholes : sequence of QWidget
        In the window: each takes the sheet for itself and all that is in it. What holds them looks as the
        palette says; what stands beside them takes the sheet, too.
    """
    _now[0] = THEMES[name]
    app = QApplication.instance()
    assert isinstance(app, QApplication)
    parts = [*wholes, *window.findChildren(QDialog)]
    window.setUpdatesEnabled(False)
    shown: list[QWidget] = []
    try:
        app.setPalette(_palette())
        holding = {window}
        for whole in wholes:
            holder = whole.parentWidget()
            while holder is not None and holder not in holding:
                holding.add(holder)
                holder = holder.parentWidget()
        for holder in holding:
            holder.style().polish(holder)
            children = [child for child in holder.children() if isinstance(child, QWidget)]
            parts += [child for child in children if child not in holding and child not in parts]
        yield None
        for part in parts:
            if isValid(part) and part.isVisible():
                yield from restyled(part)
        for holder in holding:
            yield from _recoloured(holder)
        shown = [part for part in parts if isValid(part) and part.isVisible() and not part.isWindow()]
        for part in shown:
            part.setUpdatesEnabled(False)
        window.setUpdatesEnabled(True)
        for part in shown:
            yield TURN
            if isValid(part):
                part.setUpdatesEnabled(True)
    finally:
        for part in (window, *shown):
            if isValid(part):
                part.setUpdatesEnabled(True)
    yield TURN
    for part in parts:
        yield from restyled(part)


def restyled(part: QWidget) -> Iterator[None]:
    """Give a part of a window the sheet, and its plots and pictures the colours of the theme in use, once."""
    if not isValid(part) or (_is_dressed(part) and part not in _half):
        return
    _half.add(part)
    dress(part)
    yield
    if not isValid(part):  # it may have gone meanwhile
        return
    for widget in (part, *part.findChildren(QWidget)):
        yield from _recoloured(widget)
    _half.discard(part)


def _recoloured(widget: QWidget) -> Iterator[None]:
    """Have a plot or picture take over the colours of the theme in use."""
    if isValid(widget) and hasattr(widget, "restyle"):
        try:
            widget.restyle()
        except Exception:  # noqa: BLE001 - the parts after it get theirs
            _log.exception("%s keeps the colours of the theme before", type(widget).__name__)
        yield


def dress(part: QWidget) -> None:
    """Give a new panel or dialogue the theme in use, which may be another than the program began with."""
    if not _is_dressed(part):
        part.setStyleSheet(sheet())


def _is_dressed(part: QWidget) -> bool:
    app, around = QApplication.instance(), part
    assert isinstance(app, QApplication)
    while not around.styleSheet() and (holder := around.parentWidget()) is not None:
        around = holder
    return (around.styleSheet() or app.styleSheet()) == sheet()


def _palette() -> QPalette:
    theme, palette, role = colours(), QPalette(), QPalette.ColorRole
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
        role.Highlight: theme.primary,
        role.HighlightedText: theme.primary_text,
        role.ToolTipBase: theme.field,
        role.ToolTipText: theme.text,
        role.Link: theme.accent,
        role.Light: theme.line,
        role.Midlight: theme.line,
        role.Mid: theme.border,
        role.Dark: theme.border,
        role.Shadow: theme.window,
        role.Accent: theme.accent,
    }.items():
        palette.setColor(what, QColor(colour))
    for what in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, what, QColor(theme.dim).darker(130))
    return palette


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, 1 to 21 (WCAG 2.1, "contrast ratio")."""
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def luminance(colour: str) -> float:
    """Return the relative luminance of ``#rrggbb``, 0 to 1 (WCAG 2.1, from sRGB)."""
    levels = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def _style(c: Colours) -> str:
    faint = QColor(c.dim)
    faint.setAlpha(130)
    unused = faint.name(QColor.NameFormat.HexArgb)
    side = f"4px solid {c.field}"
    arrow = f"image: none; width: 0; height: 0; border-left: {side}; border-right: {side};"
    places = (
        (0, "window"),
        (0.39, "window"),
        (0.4, "midlight"),
        (0.6, "midlight"),
        (0.61, "window"),
        (1, "window"),
    )
    rule = ", ".join(f"stop:{place} palette({role})" for place, role in places)
    return f"""
QWidget {{ font-size: {BODY_PT}pt; }}
QToolTip {{ background: {c.field}; color: {c.text}; border: 1px solid {c.border}; padding: 3px; }}
QLineEdit, QPlainTextEdit, QTextEdit, QListView, QTreeView, QTableView, QComboBox {{
  background: {c.field}; color: {c.text}; border: 1px solid {c.border}; border-radius: 4px; padding: 3px 5px;
  selection-background-color: {c.primary}; selection-color: {c.primary_text}; }}
QLineEdit:focus, QPlainTextEdit:focus, QListView:focus, QTableView:focus, QComboBox:focus, QComboBox:on {{
  border: 2px solid {c.accent}; padding: 2px 4px; }}
QLineEdit {{ placeholder-text-color: {c.dim}; min-height: 18px; }}
QComboBox {{ padding-left: 7px; }}
QComboBox:focus, QComboBox:on {{ padding-left: 6px; }}
QComboBox QLineEdit {{ border: none; background: transparent; padding: 0; min-height: 0; }}
QLineEdit:read-only {{ background: {c.panel}; }}
QLineEdit:disabled, QComboBox:disabled {{ color: {unused}; border-color: {c.line}; }}
QLineEdit:disabled {{ placeholder-text-color: {unused}; }}
QComboBox {{ combobox-popup: 0; }}
QComboBox::drop-down {{ border: none; width: 16px; }}
QComboBox::down-arrow {{ {arrow} border-top: 5px solid {c.dim}; }}
QComboBox::down-arrow:disabled {{ border-top-color: {c.line}; }}
QComboBox QAbstractItemView {{ border: 1px solid {c.border}; padding: 0; }}
QComboBox QAbstractItemView::item {{ min-height: 22px; padding: 0 4px; }}
QGraphicsView {{ border: 1px solid transparent; }}
QGraphicsView:focus {{ border: 1px solid {c.accent}; }}
*[refused="true"] {{ border: 2px solid {c.error}; color: {c.error}; font-weight: 700; }}
QLineEdit[refused="true"], QComboBox[refused="true"] {{ padding: 2px 4px; }}
QLabel[warns="warning"] {{ color: {c.warning}; font-weight: 700; }}
QLabel[warns="error"] {{ color: {c.error}; font-weight: 700; }}
QLabel#reason {{ color: {c.error}; font-size: {SMALL_PT}pt; }}
QLabel#refusal {{ color: {c.warning}; }}
QLabel#dim, QLabel[role="dim"] {{ color: {c.dim}; }}
QLabel[role="value"] {{ color: {c.text}; font-weight: 600; }}
QLabel[role="title"] {{ color: {c.text}; font-size: {TITLE_PT}pt; font-weight: 600; }}
QLabel[role="hint"] {{ color: {c.dim}; font-size: {LARGE_PT}pt; }}
QLabel[role="heading"] {{ color: {c.dim}; font-size: {SMALL_PT}pt; font-weight: 600; }}
QPushButton, QToolButton, QCommandLinkButton {{ background: {c.field}; color: {c.text};
  border: 1px solid {c.border}; border-radius: 4px; padding: 4px 10px; }}
QPushButton:hover, QToolButton:hover, QCommandLinkButton:hover {{ border-color: {c.accent}; }}
QPushButton:focus, QToolButton:focus, QCommandLinkButton:focus {{
  border: 2px solid {c.accent}; padding: 3px 9px; outline: none; }}
QPushButton:pressed, QPushButton:checked, QToolButton:checked {{
  background: {c.primary}; color: {c.primary_text}; }}
QPushButton:disabled, QToolButton:disabled {{ color: {unused}; border-color: {c.line}; }}
QPushButton:checked:disabled, QToolButton:checked:disabled {{ background: {c.line}; }}
QPushButton::menu-indicator {{ width: 0; }}
QPushButton:flat, QToolButton[autoRaise="true"] {{ background: transparent; border: 1px solid transparent;
  color: {c.dim}; padding: 2px 6px; }}
QPushButton:flat:hover, QPushButton:flat:focus, QToolButton[autoRaise="true"]:hover,
QToolButton[autoRaise="true"]:focus {{ color: {c.accent}; border-color: {c.accent}; }}
QToolButton#device {{ border: none; padding: 2px 4px; }}
QToolButton#device[condition="open"] {{ color: {c.ok}; }}
QToolButton#device[condition="failed"] {{ color: {c.error}; }}
QToolButton#device[condition="opening"] {{ color: {c.warning}; }}
QCommandLinkButton {{ border-radius: 6px; padding: 8px 12px 8px 8px; text-align: left; }}
QCommandLinkButton:focus {{ padding: 7px; }}
QPushButton#stop {{ background: {c.stop}; color: {c.stop_text}; border: 2px solid {c.stop};
  border-radius: 5px;
  font-size: {LARGE_PT + 2}pt; font-weight: 800; padding: 2px 24px; letter-spacing: 2px; }}
QPushButton#stop:hover, QPushButton#stop:focus {{ border-color: {c.text}; }}
QPushButton#primary {{ background: {c.primary}; color: {c.primary_text}; border: 1px solid {c.accent};
  font-weight: 600; padding: 4px 13px; }}
QPushButton#primary:focus {{ border: 2px solid {c.text}; padding: 3px 12px; }}
QPushButton#primary:disabled {{ background: {c.field}; color: {unused}; border-color: {c.line}; }}
QLabel#simulated, QLabel#caution {{ background: {c.badge}; color: {c.badge_text}; font-weight: 800;
  border: 1px solid {c.warning}; padding: 3px 10px; border-radius: 4px; letter-spacing: 1px; }}
QLabel#caption {{ background: {c.panel}; color: {c.text}; padding: 2px 8px; border-radius: 4px; }}
QFrame#jog-pad {{ background: {c.field}; border: 1px dashed {c.border}; border-radius: 5px; }}
QFrame#jog-pad[active="true"] {{ border: 2px solid {c.accent}; }}
QFrame#strip {{ background: {c.panel}; border-bottom: 1px solid {c.line}; }}
QCheckBox::indicator {{ width: 14px; height: 14px; border: 1px solid {c.border}; border-radius: 3px;
  background: {c.field}; }}
QCheckBox::indicator:checked {{ background: {c.accent}; background-clip: content; padding: 3px;
  width: 8px; height: 8px; }}
QCheckBox::indicator:focus {{ border-color: {c.text}; }}
QCheckBox::indicator:hover {{ border-color: {c.accent}; }}
QCheckBox::indicator:disabled {{ border-color: {c.line}; }}
QCheckBox::indicator:checked:disabled {{ background: {unused}; background-clip: content; }}
QSlider::groove:horizontal {{ height: 4px; background: {c.line}; border-radius: 2px; }}
QSlider::sub-page:horizontal {{ background: {c.accent}; border-radius: 2px; }}
QSlider::handle:horizontal {{ width: 12px; margin: -5px 0; border-radius: 7px; background: {c.field};
  border: 1px solid {c.accent}; }}
QSlider::handle:horizontal:hover, QSlider::handle:horizontal:focus {{ background: {c.accent}; }}
QSlider::sub-page:horizontal:disabled {{ background: {c.line}; }}
QSlider::handle:horizontal:disabled {{ border-color: {c.line}; }}
QGroupBox {{ border: 1px solid {c.line}; border-radius: 5px; margin-top: 10px; padding-top: 6px; }}
QGroupBox::title {{ subcontrol-origin: margin; left: 8px; padding: 0 4px; color: {c.dim}; }}
QTabBar {{ qproperty-drawBase: 0; }}
QTabWidget::pane {{ border: 1px solid palette(midlight); }}
QTabBar::tab {{ background: palette(alternate-base); color: palette(placeholder-text);
  border: 1px solid palette(midlight); border-bottom: none; padding: 5px 12px; margin-right: 1px; }}
QTabBar::tab:selected {{ background: palette(base); color: palette(text);
  border-top: 2px solid palette(link); }}
QTabBar::tab:hover {{ color: palette(text); }}
QTabBar::tab:selected:focus {{ color: palette(link); border: 2px solid palette(link);
  padding: 5px 11px 3px 11px; }}
QWidget#dock-title {{ background: {c.panel}; }}
QMainWindow::separator {{ background: palette(midlight); width: 3px; height: 3px; }}
QSplitter::handle:horizontal {{ width: 5px; background: qlineargradient(x1:0, y1:0, x2:1, y2:0, {rule}); }}
QSplitter::handle:vertical {{ height: 5px; background: qlineargradient(x1:0, y1:0, x2:0, y2:1, {rule}); }}
QProgressBar {{ background: {c.field}; color: {c.text}; border: 1px solid {c.line}; border-radius: 4px;
  text-align: center; }}
QProgressBar::chunk {{ background: {c.primary}; border-radius: 3px; }}
QProgressBar[textVisible="false"] {{ border: none; border-radius: 3px; }}
QProgressBar[textVisible="false"]::chunk {{ background: {c.accent}; }}
QHeaderView::section {{ background: {c.panel}; color: {c.dim}; border: none;
  border-bottom: 1px solid {c.line}; padding: 3px; }}
QHeaderView, QTableCornerButton::section {{ background: {c.panel}; border: none; }}
QTableView {{ outline: none; }}
QTableView::item {{ border-bottom: 1px solid {c.line}; padding: 0 3px; }}
QTableView::item:selected {{ background: {c.primary}; color: {c.primary_text}; }}
QScrollBar:vertical {{ background: {c.window}; width: 10px; }}
QScrollBar:horizontal {{ background: {c.window}; height: 10px; }}
QScrollBar::handle {{ background: {c.border}; border-radius: 4px; min-height: 24px; min-width: 24px; }}
QScrollBar::add-line, QScrollBar::sub-line {{ width: 0; height: 0; }}
QStatusBar {{ background: {c.panel}; color: {c.dim}; }}
QStatusBar::item {{ border: none; }}
QWidget#header {{ background: {c.panel}; }}
QMenuBar {{ border: none; }}
QMenuBar, QMenu {{ background: {c.panel}; color: {c.text}; }}
QMenu::item:selected, QMenuBar::item:selected {{ background: {c.primary}; color: {c.primary_text}; }}
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


def indices_of(image: Array, low: float, high: float) -> Float32Array:
    """Return an image's places in a map, 0 to 254; what is no number is darkest."""
    scaled = (np.asarray(image, np.float32) - np.float32(low)) * np.float32(_SIGNAL / max(high - low, 1e-12))
    places: Float32Array = np.clip(np.nan_to_num(scaled, copy=False), 0, _SIGNAL, out=scaled)
    return places


def grey_indices(image: Array, low: float, high: float) -> Float32Array:
    """Return the same of a coloured image (height, width, 3), by the mean of its channels."""
    places: Float32Array = indices_of(image, low, high).mean(axis=2)
    return places


def as_shown(image: Array, low: float, high: float, name: str) -> npt.NDArray[np.uint8]:
    """Return the 8-bit colours of an image as a view shows it in a map, (height, width, 3)."""
    if image.ndim == 2 or spares_hues(name):
        places = indices_of(image, low, high) if image.ndim == 2 else grey_indices(image, low, high)
        mapped: npt.NDArray[np.uint8] = table(name, mark_saturation=False)[places.astype(np.uint8)]
        return mapped
    return np.round(indices_of(image, low, high) * (255 / _SIGNAL)).astype(np.uint8)
