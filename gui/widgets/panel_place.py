"""Where a panel stands: it scrolls where the window is too small for it."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, QSize
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QScrollArea, QWidget

_SMALLEST = (240, 110)
"""Width and height in pixels that a panel may be pressed to; it scrolls then."""


class PanelPlace(QScrollArea):
    """Holds one panel, or nothing yet; lets the window be smaller than its panels want."""

    def __init__(self) -> None:
        super().__init__()
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setMinimumSize(*_SMALLEST)
        self.content: QWidget | None = None

    def hold(self, content: QWidget) -> None:
        """Put a panel here."""
        self.content = content
        self.setWidget(_Holder(content))


class _Holder(QWidget):
    """Gives its child all of its room, and is as small as its child can be.

    A scroll area takes the *preferred* height of a layout in which a line wraps; without a layout the least.
    """

    def __init__(self, content: QWidget) -> None:
        super().__init__()
        self._content = content
        content.setParent(self)
        content.installEventFilter(self)
        content.show()

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
