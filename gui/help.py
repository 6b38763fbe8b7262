"""F1: what the panel in front is for, what each of its parts does, and every key, in words."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator

from PySide6.QtGui import QAction
from PySide6.QtWidgets import QAbstractButton, QComboBox, QLineEdit, QSlider, QTabWidget, QWidget

from gui.panels import PANELS

KEYS = (
    ("Esc", "STOP: halt all motion, light off, end what runs; everywhere, also in dialogues and menus"),
    ("F1", "this help"),
    ("Tab, Shift+Tab", "from one part to the next, and back; Space presses a button, Alt+Down opens a list"),
    ("Ctrl+Tab", "the next tab of the place that has the keyboard"),
    ("Ctrl+Return", "do what the form in front asks for"),
    ("arrows, PgUp, PgDn", "jog, with the keyboard in the stage's field; Shift ten times, Ctrl a tenth"),
    ("arrows in a picture", "move what is over it, else the picture; Alt changes a size"),
    ("Space, Backspace", "paint and rub out with the brush; Return sends the live view's region"),
    ("+, -, 0", "zoom into a picture, out of it, and the whole of it"),
)
"""Keys that no menu shows."""
_WIDTH = 88


def help_of(name: str, panel: QWidget, focused: QWidget | None, actions: Iterable[QAction]) -> str:
    """Return the help for a panel: the part that has the keyboard first, then the panel, then all keys.

    Parameters
    ----------
    name : str
        The panel's, in the table of panels.
    panel : QWidget
    focused : QWidget, optional
        What has the keyboard.
    actions : iterable of QAction
        Of the window's menus.
    """
    entry = PANELS[name]
    parts = [f"{entry.title.upper()}\n{entry.tip}."]
    if focused is not None and panel.isAncestorOf(focused) and (said := _said(focused)):
        parts.insert(0, f"HERE\n{said}")
    lines = list(dict.fromkeys(said for part in panel.findChildren(QWidget) if (said := _said(part))))
    parts.append("\n".join(lines))
    menus = [
        (a.shortcut().toString(), a.text().replace("&", "")) for a in actions if not a.shortcut().isEmpty()
    ]
    rows = [*KEYS[:2], *menus, *KEYS[2:]]
    wide = max(len(keys) for keys, _ in rows) + 2
    parts.append("\n".join(["KEYS", *(_row(keys, words, wide) for keys, words in rows)]))
    return "\n\n".join(filter(None, parts))


def _said(part: QWidget) -> str:
    """Return what a visible part is and does; empty for one that says nothing of itself."""
    if not part.isVisible() or not isinstance(part, QAbstractButton | QComboBox | QLineEdit | QSlider):
        return ""
    shown = part.text() if isinstance(part, QAbstractButton) else ""
    told = part.toolTip() or part.accessibleDescription()
    name, tip = shown or part.accessibleName(), " ".join(told.split())
    if not name or not tip or isinstance(part.parentWidget(), QTabWidget):
        return ""
    return "\n".join(_wrapped(name if tip == name else f"{name}: {tip}"))


def _row(keys: str, words: str, wide: int) -> str:
    first, *others = textwrap.wrap(words, _WIDTH - wide)
    return "\n".join([f"{keys:<{wide}}{first}", *(" " * wide + line for line in others)])


def _wrapped(text: str) -> Iterator[str]:
    yield from textwrap.wrap(text, _WIDTH, initial_indent="- ", subsequent_indent="  ")
