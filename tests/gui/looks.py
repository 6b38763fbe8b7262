"""What can be told of looks without eyes: words cut off, places scrolled twice, parts without names."""

from __future__ import annotations

from collections.abc import Iterator

from PySide6.QtCore import QCoreApplication, QEvent, QPoint, QRect, QSize, Qt
from PySide6.QtGui import QAccessible
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractScrollArea,
    QComboBox,
    QCommandLinkButton,
    QLabel,
    QLineEdit,
    QListView,
    QMenu,
    QMenuBar,
    QPlainTextEdit,
    QScrollArea,
    QSizePolicy,
    QSlider,
    QTabBar,
    QTableView,
    QWidget,
)

from gui.widgets.tab_order import stops_of

SIZES = {"1366x768": QSize(1350, 690), "1920x1080": QSize(1904, 1000)}
"""Screens, and what they have for a window's inside beside a task bar and the window's frame."""
_SLACK_PX = 1
_BESIDE_PX = 7
"""Of a field, on each side of its words."""
_WITH_KEYS = (QAbstractButton, QComboBox, QLineEdit, QListView, QPlainTextEdit, QSlider, QTableView)


def faults(root: QWidget) -> list[str]:
    """Return all faults of what is visible in a window or panel, one sentence each."""
    for _ in range(3):  # words that were set just now have their place first, and what holds that
        QCoreApplication.sendPostedEvents(None, QEvent.Type.LayoutRequest.value)
    stop = root.findChild(QWidget, "stop")
    hidden = stop is not None and stop.visibleRegion().boundingRect() != stop.rect()
    gone = ["STOP is not wholly in sight"] if hidden else []
    return [*gone, *cut_off(root), *scrolled_twice(root), *nameless(root), *tabbed(root)]


def cut_off(root: QWidget) -> Iterator[str]:
    """Yield what is too small for its words, or lies outside of what shows it."""
    for part in _visible(root, QLineEdit, QComboBox, QAbstractButton):
        inner = isinstance(part.parentWidget(), QComboBox) or isinstance(part, QCommandLinkButton)
        if not inner and part.height() < part.sizeHint().height() - _SLACK_PX:
            yield f"{_where(part)}: {part.height()} px high, and needs {part.sizeHint().height()}"
    for part in _visible(root, QLineEdit):
        words, inner = part.placeholderText(), part.parentWidget()
        needed = part.fontMetrics().horizontalAdvance(words) + 2 * _BESIDE_PX
        if words and not part.text() and needed > part.width() and not isinstance(inner, QComboBox):
            yield f"{_where(part)}: {words!r} needs {needed} px and has {part.width()}"
    for part in _visible(root, QAbstractButton, QLabel, QComboBox, QTabBar):
        if isinstance(part, QTabBar):
            if part.usesScrollButtons() and part.sizeHint().width() > part.width() + _SLACK_PX:
                yield f"{_where(part)}: tabs {part.sizeHint().width()} px wide in {part.width()} px"
            continue
        words = _words(part)
        if not words:
            continue
        if isinstance(part, QLabel) and part.wordWrap():
            least = part.heightForWidth(part.width())
            if least > part.height() + _SLACK_PX:
                yield f"{_where(part)}: {words!r} needs {least} px of height and has {part.height()}"
            continue
        gives_way = part.sizePolicy().horizontalPolicy() == QSizePolicy.Policy.Ignored or (
            isinstance(part, QLabel) and part.minimumWidth() > 0
        )
        if isinstance(part, QCommandLinkButton):
            if part.height() < part.heightForWidth(part.width()) - _SLACK_PX:
                yield f"{_where(part)}: {words!r} is cut off below"
            continue
        fits = isinstance(part, QComboBox) or part.width() >= part.sizeHint().width() - _SLACK_PX
        if not gives_way and not fits:
            yield f"{_where(part)}: {words!r} needs {part.sizeHint().width()} px and has {part.width()}"
        elif not gives_way and not _inside(part):
            yield f"{_where(part)}: {words!r} lies outside of what shows it"


def scrolled_twice(root: QWidget) -> Iterator[str]:
    """Yield places that scroll within a place that scrolls the same way."""
    for place in _visible(root, QAbstractScrollArea):
        around = place.parentWidget()
        while around is not None:
            both = (place, around)
            if isinstance(around, QAbstractScrollArea) and all(
                p.verticalScrollBar().isVisible() for p in both
            ):
                yield f"{_where(place)}: scrolls up and down within {_where(around)}, which does, too"
            around = around.parentWidget()
        if isinstance(place, QScrollArea) and place.horizontalScrollBar().maximum() > 0:
            yield f"{_where(place)}: is scrolled sideways"


def nameless(root: QWidget, *, hidden: bool = False) -> Iterator[str]:
    """Yield what takes keys or clicks but has no name for a screen reader, or no way to it by keys.

    ``hidden``: also of what is not seen now.
    """
    every = (part for part in root.findChildren(QWidget) if isinstance(part, _WITH_KEYS))
    for part in every if hidden else _visible(root, *_WITH_KEYS):
        if part.objectName().startswith("qt_"):
            continue  # Qt's own: corners of tables, buttons of tabs
        holder = part.parentWidget()
        if isinstance(holder, QTabBar | QComboBox | QLineEdit | QMenu | QMenuBar):
            continue
        if holder is not None and holder.inherits("QComboBoxPrivateContainer"):
            continue  # the list of a box that is closed
        interface = QAccessible.queryAccessibleInterface(part)
        # Of a list box Qt's interface says what is chosen; its label is told beside it.
        name = part.accessibleName() or interface.text(QAccessible.Text.Name)
        if not any(map(str.isalpha, name)):
            yield f"{_where(part)}: {name!r} is no name for a screen reader ({part.toolTip()!r})"
        if isinstance(part, QAbstractButton) and part.focusPolicy() == Qt.FocusPolicy.NoFocus:
            yield f"{_where(part)}: {_words(part)!r} cannot be reached by keys"
        if isinstance(part, QAbstractButton) and not part.toolTip():
            yield f"{_where(part)}: {_words(part)!r} has no tool tip"


def tabbed(root: QWidget) -> Iterator[str]:
    """Yield what Tab does wrong: stops that nobody sees, that have no name, parts that it leaves out."""
    stops = list(stops_of(root.window()))
    for stop in stops:
        if stop.visibleRegion().isEmpty() and not _scrolled_away(stop):
            yield f"{_where(stop)}: the keyboard goes there, and nobody sees it"
        if not QAccessible.queryAccessibleInterface(stop).text(QAccessible.Text.Name).strip():
            yield f"{_where(stop)}: the keyboard goes there, and it has no name"
    for part in _visible(root, *_WITH_KEYS):
        if part.objectName().startswith("qt_") or isinstance(part.parentWidget(), QTabBar | QComboBox):
            continue
        by_arrows = isinstance(part, QAbstractButton) and part.group() is not None
        if part.isEnabled() and not by_arrows and part not in stops:
            yield f"{_where(part)}: Tab does not come to {_words(part) if hasattr(part, 'text') else ''!r}"


def _scrolled_away(part: QWidget) -> bool:
    """Whether a part is out of sight only because its form is scrolled elsewhere."""
    around = part.parentWidget()
    while around is not None and not isinstance(around, QScrollArea):
        around = around.parentWidget()
    return around is not None and (not around.visibleRegion().isEmpty() or _scrolled_away(around))


def _visible(root: QWidget, *kinds: type[QWidget]) -> Iterator[QWidget]:
    for part in root.findChildren(QWidget):
        if isinstance(part, kinds) and part.isVisible():
            yield part


def _words(part: QWidget) -> str:
    return part.currentText() if isinstance(part, QComboBox) else str(part.text())  # type: ignore[attr-defined]


def _inside(part: QWidget) -> bool:
    """Whether a part is wholly in its window across; up and down a place may scroll it away."""
    left, right = 0, part.width()
    around: QWidget | None = part.parentWidget()
    while around is not None:
        place = QRect(around.mapFromGlobal(part.mapToGlobal(QPoint(0, 0))), part.size())
        left, right = place.left(), place.right()
        if left < -_SLACK_PX or right > around.width() + _SLACK_PX:
            return False
        if around.isWindow() or isinstance(around, QScrollArea):
            return True
        around = around.parentWidget()
    return True


def _where(part: QWidget) -> str:
    """Return the panel and class of a part, for people."""
    around: QWidget | None = part
    while around is not None:
        if (title := getattr(around, "title", "")) and isinstance(title, str):
            return f"{title}, {type(part).__name__} {part.objectName()}".rstrip()
        around = around.parentWidget()
    return f"{type(part).__name__} {part.objectName()}".rstrip()
