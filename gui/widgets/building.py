"""What panels are built of: buttons, labels, rows, columns, tables, timers, and places that scroll."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from PySide6.QtCore import QEvent, QObject, QSignalBlocker, QSize, Qt, QTimer, SignalInstance
from PySide6.QtGui import QColor, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import (
    QBoxLayout,
    QComboBox,
    QFrame,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QLayout,
    QPlainTextEdit,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from gui.theme import colours

Part = QWidget | QLayout | int | tuple[QWidget | QLayout, int] | None
"""Of a row or column: a widget, another layout, one of them with its stretch, a gap in pixels, or (None) what
takes the room that is left."""
Margins = tuple[int, int, int, int]
_L = TypeVar("_L", bound=QBoxLayout)


# Layouts -----------------------------------------------------------------------------------------------
def in_row(*parts: Part, spacing: int | None = None) -> QHBoxLayout:
    """Return parts side by side."""
    return _filled(QHBoxLayout(), parts, (0, 0, 0, 0), spacing)


def in_column(*parts: Part, spacing: int | None = None) -> QVBoxLayout:
    """Return parts below each other."""
    return _filled(QVBoxLayout(), parts, (0, 0, 0, 0), spacing)


def fill(
    widget: QWidget,
    *parts: Part,
    across: bool = False,
    margins: Margins = (0,) * 4,
    spacing: int | None = None,
) -> QWidget:
    """Fill a widget with parts below each other, or side by side, and return it."""
    _filled(QHBoxLayout(widget) if across else QVBoxLayout(widget), parts, margins, spacing)
    return widget


def _filled(layout: _L, parts: Sequence[Part], margins: Margins, spacing: int | None) -> _L:
    layout.setContentsMargins(*margins)
    if spacing is not None:
        layout.setSpacing(spacing)
    for part in parts:
        if part is None:
            layout.addStretch(1)
        elif isinstance(part, int):
            layout.addSpacing(part)
        else:
            item, stretch = part if isinstance(part, tuple) else (part, 0)
            if isinstance(item, QWidget):
                layout.addWidget(item, stretch)
            else:
                layout.addLayout(item, stretch)
    return layout


def split(
    *widgets: QWidget,
    sizes: Sequence[int] = (),
    down: bool = False,
    stretch: int | None = None,
    firm: bool = False,
) -> QSplitter:
    """Return widgets with borders to be dragged between them, side by side or (``down``) below each other.

    ``stretch`` is the number of the one that grows with the window; of ``firm`` ones none can be closed.
    """
    splitter = QSplitter(Qt.Orientation.Vertical if down else Qt.Orientation.Horizontal)
    for widget in widgets:
        splitter.addWidget(widget)
    if stretch is not None:
        splitter.setStretchFactor(stretch, 1)
    if sizes:
        splitter.setSizes(list(sizes))
    splitter.setChildrenCollapsible(not firm)
    return splitter


def tabs(pages: Mapping[str, QWidget]) -> QTabWidget:
    """Return pages by their titles, behind tabs."""
    shown = QTabWidget()
    shown.setDocumentMode(True)
    for title, page in pages.items():
        shown.addTab(page, title)
    return shown


# Widgets -----------------------------------------------------------------------------------------------
def button(
    words: str,
    tip: str = "",
    clicked: Callable[..., object] | SignalInstance | None = None,
    *,
    shortcut: str = "",
    primary: bool = False,
    checkable: bool = False,
    enabled: bool = True,
) -> QPushButton:
    """Return a push button; ``primary`` is the one that a panel is there for."""
    made = QPushButton(words)
    made.setToolTip(tip)
    made.setCheckable(checkable)
    made.setEnabled(enabled)
    if shortcut:
        made.setShortcut(shortcut)
    if primary:
        made.setObjectName("primary")
    if clicked is not None:
        made.clicked.connect(clicked)
    return made


_HINT_PX = 560
"""The widest that a sentence of a hint is: longer lines are read badly."""


class Hint(QWidget):
    """What stands where there is nothing to be seen yet: one sentence, and one button for what comes next.

    Parameters
    ----------
    words : str
    answer : str
        On the button.
    clicked : callable
    other : (str, callable), optional
        A second, quiet button.
    """

    def __init__(
        self,
        words: str,
        answer: str,
        clicked: Callable[[], object],
        other: tuple[str, Callable[[], object]] | None = None,
    ) -> None:
        super().__init__()
        self.words = hint(words)
        self.words.setContentsMargins(0, 0, 0, 0)
        self.words.setMaximumWidth(_HINT_PX)
        self.button = button(answer, words or answer, lambda: clicked())
        parts: list[Part] = [in_row(None, (self.words, 100), None), in_row(None, self.button, None)]
        self._buttons = [self.button]
        if other is not None:
            self.other = button(other[0], words or other[0], lambda: other[1]())
            self.other.setFlat(True)
            self._buttons.append(self.other)
            parts.append(in_row(None, self.other, None))
        fill(self, None, *parts, None, margins=(16, 8, 16, 8), spacing=10)

    def say(self, words: str, *, busy: bool = False) -> None:
        """Say something else; ``busy``: nothing is to be done here meanwhile, and there is no button."""
        self.words.setText(words)
        for one in self._buttons:
            one.setToolTip(words)
        self.button.setVisible(not busy)


class OneLine(QLabel):
    """One line of words: as much of it as there is room for, with "…"; the tool tip has all of it.

    It widens nothing: it takes what room it is given.
    """

    def __init__(self, words: str = "") -> None:
        super().__init__()
        self._words = ""
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.setText(words)

    def text(self) -> str:
        """Return all of the words."""
        return self._words

    def setText(self, words: str) -> None:  # noqa: N802 - Qt's name
        """Show other words."""
        if words != self._words:
            self._words = words
            self.setToolTip(words)
            self.setAccessibleDescription(words)
        self._fit()

    def clear(self) -> None:
        """Show nothing."""
        self.setText("")

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Show what there is room for now."""
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        room_px = self.contentsRect().width()
        shown = self.fontMetrics().elidedText(self._words, Qt.TextElideMode.ElideRight, room_px)
        if super().text() != shown:
            super().setText(shown)


def label(
    words: str = "", role: str = "", *, selectable: bool = False, wraps: bool = False, yields: bool = False
) -> QLabel:
    """Return a label. ``role``: dim, value, heading, title, hint; one that ``yields`` widens nothing."""
    made = OneLine(words) if yields and not wraps else QLabel(words)
    made.setWordWrap(wraps)
    if role:
        made.setProperty("role", role)
    if selectable:
        made.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    if yields:
        made.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
    return made


def hint(words: str) -> QLabel:
    """Return a sentence in the middle of a place where there is nothing to be seen yet."""
    made = label(words, "hint", wraps=True)
    made.setAlignment(Qt.AlignmentFlag.AlignCenter)
    made.setContentsMargins(16, 8, 16, 8)
    return made


_MOST_ENTRIES = 25
"""Of a list box that is open, before it is scrolled."""


def choice(
    words: Iterable[str] = (), tip: str = "", chosen: Callable[[int], object] | None = None
) -> QComboBox:
    """Return a box of words; ``chosen`` is called with the number of the one that is chosen."""
    made = QComboBox()
    made.setMaxVisibleItems(_MOST_ENTRIES)
    made.addItems(list(words))
    made.setToolTip(tip)
    made.setAccessibleName(tip)
    if chosen is not None:
        made.currentIndexChanged.connect(chosen)
    return made


def offer(box: QComboBox, items: Iterable[tuple[str, Any]]) -> None:
    """Offer other words, each with its value, and choose the first; no choice is signalled."""
    with QSignalBlocker(box):
        box.clear()
        for words, value in items:
            box.addItem(words, value)


def narrow(box: QComboBox, characters: int = 5) -> QComboBox:
    """Let a box be narrower than its longest entry, and return it."""
    box.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    box.setMinimumContentsLength(characters)
    return box


_BAR_PX = 6
"""Height of a bar: one as high as a button looks like a button."""


class ShareBar(QProgressBar):
    """A thin bar without words; while there is no progress its place is empty."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self.setTextVisible(False)
        self.setFixedHeight(_BAR_PX)
        self.setRange(0, most)

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: N802 - Qt's name
        """Paint what has begun: an empty frame would look like a field."""
        if self.value() > self.minimum() or self.maximum() == self.minimum():
            super().paintEvent(event)


def share_bar(most: int = 1000) -> QProgressBar:
    """Return a bar for a share of ``most``, without words on it."""
    return ShareBar(most)


def text_view(text: str = "", tip: str = "", *, empty: str = "") -> QPlainTextEdit:
    """Return a text of several lines, to be read and copied; ``empty`` stands there while there is none."""
    made = QPlainTextEdit(text)
    made.setPlaceholderText(empty)
    made.setReadOnly(True)
    made.setToolTip(tip)
    made.setAccessibleName(tip or "Text")
    return made


def mark(widget: QWidget, name: str, on: bool | str) -> None:
    """Set a property that the style sheet looks at, such as ``refused``."""
    widget.setProperty(name, on)
    widget.style().unpolish(widget)
    widget.style().polish(widget)


# Tables ------------------------------------------------------------------------------------------------
def table(
    columns: Sequence[str], tip: str = "", *, wide: int | None = None, row_px: int = 24
) -> QTableWidget:
    """Return a table to be looked at, without rows yet; the ``wide`` column takes the room that is left."""
    made = QTableWidget(0, len(columns))
    made.setHorizontalHeaderLabels(list(columns))
    made.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
    made.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
    made.setTabKeyNavigation(False)
    made.setCornerButtonEnabled(False)
    made.setShowGrid(False)
    made.setToolTip(tip)
    made.setAccessibleName(tip or ", ".join(columns))
    made.verticalHeader().setDefaultSectionSize(row_px)
    header = made.horizontalHeader()
    header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    header.setHighlightSections(False)
    if wide is not None:
        if (title := made.horizontalHeaderItem(wide)) is not None:
            title.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
        header.setSectionResizeMode(wide, QHeaderView.ResizeMode.Stretch)
    return made


def cell(
    text: str, tip: str = "", *, number: bool = False, warns: bool = False, data: Any = None
) -> QTableWidgetItem:
    """Return a cell; a ``number`` stands at the right, ``data`` is under ``UserRole``."""
    item = QTableWidgetItem(text)
    item.setToolTip(tip)
    item.setData(Qt.ItemDataRole.UserRole, data)
    if number:
        item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
    if warns:
        item.setForeground(QColor(colours().warning))
    return item


# Timers ------------------------------------------------------------------------------------------------
def every(parent: QObject, interval_ms: int, call: Callable[[], object]) -> QTimer:
    """Return a timer that runs, and calls again and again."""
    timer = QTimer(parent)
    timer.timeout.connect(call)
    timer.start(interval_ms)
    return timer


def after_rest(parent: QObject, rest_ms: int, call: Callable[[], object]) -> QTimer:
    """Return a timer that calls once when it was not started for so long; it does not run yet."""
    timer = QTimer(parent)
    timer.setSingleShot(True)
    timer.setInterval(rest_ms)
    timer.timeout.connect(call)
    return timer


# Places that scroll ------------------------------------------------------------------------------------
_GAP_PX = 6


def scrolled(form: QWidget) -> QScrollArea:
    """Return a frameless place for a form, which scrolls up and down; its bar keeps off.

    It takes the form only when it has its own place: else it measures all of the form at once.
    """
    scroll, holder = QScrollArea(), QWidget()
    scroll.setWidgetResizable(True)
    scroll.setFrameShape(QFrame.Shape.NoFrame)
    scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)  # it follows the keyboard's place in the form
    scroll.setWidget(holder)
    inside = in_column(form)
    holder.setLayout(inside)
    bar = scroll.verticalScrollBar()
    bar.rangeChanged.connect(lambda _, most: inside.setContentsMargins(0, 0, _GAP_PX * (most > 0), 0))
    return scroll


_SMALLEST = (240, 110)
"""Width and height in pixels that a panel may be pressed to; it scrolls then."""


class PanelPlace(QScrollArea):
    """Holds one panel, or nothing yet; lets the window be smaller than its panels want."""

    def __init__(self) -> None:
        super().__init__()
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setMinimumSize(*_SMALLEST)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.content: QWidget | None = None
        self._seen = True

    def hold(self, content: QWidget) -> None:
        """Put a panel here."""
        self.content = content
        holder = _Holder(content)
        self.setWidget(holder)  # first: each new parent has all of a panel take its looks again
        holder.setVisible(self._seen)
        holder.take()

    def set_seen(self, seen: bool) -> None:
        """Show or hide what is held.

        Qt calls what lies in a dock behind another one visible: keys would go where nobody looks.
        """
        self._seen = seen
        if (holder := self.widget()) is not None:
            holder.setVisible(seen)


class _Holder(QWidget):
    """Gives its child all of its room, and is as small as its child can be.

    A scroll area takes the *preferred* height of a layout in which a line wraps; without a layout the least.
    """

    def __init__(self, content: QWidget) -> None:
        super().__init__()
        self._content = content

    def take(self) -> None:
        """Have the child inside."""
        self._content.setParent(self)
        self._content.installEventFilter(self)
        self._content.resize(self.size())
        self._content.show()
        self.updateGeometry()

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the least size that the child can have."""
        return self._content.minimumSizeHint()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size that the child would like."""
        return self._content.sizeHint()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Give the child all of the room."""
        self._content.resize(self.size())

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Pass on that the child needs another size."""
        if event.type() == QEvent.Type.LayoutRequest:
            self.updateGeometry()
        return False
