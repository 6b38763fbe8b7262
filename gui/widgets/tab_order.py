"""The order in which Tab goes through a panel: as its parts stand, whenever they were made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtWidgets import (
    QAbstractScrollArea,
    QApplication,
    QComboBox,
    QFormLayout,
    QLayout,
    QLineEdit,
    QScrollArea,
    QSplitter,
    QStackedWidget,
    QTabBar,
    QTabWidget,
    QWidget,
)
from shiboken6 import isValid


def tab_in_order(root: QWidget, *, after: QWidget | None = None) -> None:
    """Have Tab go through what a widget holds from top to bottom and from left to right.

    Qt goes in the order in which widgets got their place, which in panels made a part at a time is none that
    anybody sees. What is made later comes right ``after`` another part; the rest stays as it is.
    """
    stops = [part for part in _in_order(root) if part.focusPolicy() & Qt.FocusPolicy.TabFocus]
    for earlier, later in pairwise(stops if after is None else [after, *stops]):
        QWidget.setTabOrder(earlier, later)


def take_turns(on: Sequence[QWidget], off: Sequence[QWidget]) -> None:
    """Enable some buttons and disable others; the keyboard goes with the work, not to wherever Qt goes on."""
    for part in on:
        part.setEnabled(True)
    if on:
        hand_on(on[0], off)
    for part in off:
        part.setEnabled(False)


def hand_on(to: QWidget, leaving: Sequence[QWidget]) -> None:
    """Give the keyboard to a part if one has it that is about to be put off or hidden."""
    if any(part.hasFocus() for part in leaving):
        to.setFocus()


class Kept(QObject):
    """Keeps the place of the keyboard while the part that had it is off or hidden: no field takes keys."""

    def __init__(self, window: QWidget) -> None:
        super().__init__(window)
        self._window = window
        self._part: QWidget | None = None
        app = QApplication.instance()
        assert isinstance(app, QApplication)
        app.focusChanged.connect(self._changed)

    @staticmethod
    def takes(part: QWidget) -> bool:
        """Whether a part can have the keyboard now."""
        return part.isEnabled() and part.isVisible()

    def keep(self, part: QWidget) -> None:
        """Give the keyboard back to a part as soon as it is there again, unless another has it by then."""
        self._part = part
        part.installEventFilter(self)

    def neighbour(self, stops: Sequence[QWidget], *, forward: bool) -> QWidget | None:
        """Return the stop beside the part that had the keyboard, where nobody has it; None where none did."""
        if self._part is None or not isValid(self._part) or not stops:
            return None
        part: QWidget | None = self._part
        while part is not None and part not in stops:
            part = part.nextInFocusChain() if forward else part.previousInFocusChain()
            if part is self._part:
                return None
        return part

    def _changed(self, old: QWidget | None, new: QWidget | None) -> None:
        """See that nobody has the keyboard because a whole form was put off."""
        left = new is None and old is not None and isValid(old) and isValid(self._window)
        if old is not None and left and self._window.isAncestorOf(old) and not self.takes(old):
            self.keep(old)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """See the part that had the keyboard come back."""
        came = event.type() in (QEvent.Type.EnabledChange, QEvent.Type.Show)
        if came and isinstance(watched, QWidget) and self.takes(watched):
            watched.removeEventFilter(self)
            if self._part is watched:
                self._part = None
                if QApplication.focusWidget() is None:
                    watched.setFocus()
        return False


def stops_of(window: QWidget) -> Iterator[QWidget]:
    """Yield what Tab stops at in a window, from its beginning."""
    part = window.nextInFocusChain()
    while part is not None and part is not window:
        takes = part.focusPolicy() & Qt.FocusPolicy.TabFocus and part.focusProxy() is None
        takes = takes and not (isinstance(part, QTabBar) and not part.count())  # of docks that are all hidden
        if takes and part.isVisible() and part.isEnabled():
            yield part
        part = part.nextInFocusChain()


def _in_order(part: QWidget) -> Iterator[QWidget]:
    yield part
    for inner in _inside(part):
        yield from _in_order(inner)


def _inside(part: QWidget) -> Iterator[QWidget]:
    """Yield a widget's own children as they stand in it."""
    match part:
        case QSplitter() | QStackedWidget() | QTabWidget():
            if isinstance(part, QTabWidget):
                yield part.tabBar()
            pages = (part.widget(number) for number in range(part.count()))
            yield from (page for page in pages if page is not None)
        case QScrollArea():
            if (held := part.widget()) is not None:
                yield held
        case QAbstractScrollArea() | QComboBox() | QLineEdit() | QTabBar():
            pass  # one stop, whatever it is made of
        case _:
            layout = part.layout()
            if layout is not None:
                yield from _laid_out(layout)
            else:
                own = (child for child in part.children() if isinstance(child, QWidget))
                yield from (child for child in own if not child.isWindow())


def _laid_out(layout: QLayout) -> Iterator[QWidget]:
    """Yield the widgets of a layout and of those in it, in their order; of a form row by row."""
    items = [layout.itemAt(number) for number in range(layout.count())]
    if isinstance(layout, QFormLayout):
        roles = (QFormLayout.ItemRole.LabelRole, QFormLayout.ItemRole.FieldRole)
        rows = [[layout.itemAt(row, role) for role in roles] for row in range(layout.rowCount())]
        spanning = [layout.itemAt(row, QFormLayout.ItemRole.SpanningRole) for row in range(layout.rowCount())]
        items = [item for row, whole in zip(rows, spanning, strict=True) for item in (*row, whole)]
    for item in items:
        if item is None:
            continue
        if (widget := item.widget()) is not None:
            yield widget
        elif (inner := item.layout()) is not None:
            yield from _laid_out(inner)
