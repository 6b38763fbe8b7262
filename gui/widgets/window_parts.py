"""Parts of the main window: a chip a device, and where a panel is shown."""

from __future__ import annotations

from functools import partial

from PySide6.QtCore import QEvent, QObject, QSize
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QPushButton, QScrollArea, QToolButton, QWidget

from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.dialogues import TextWindow


class DeviceChips(QWidget):
    """One chip a device; a click tells all about it, "Reconnect" appears where one has failed."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._session = session
        self.chips: dict[str, QToolButton] = {}
        self.reconnect_buttons: dict[str, QPushButton] = {}
        layout = QHBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(4)
        if not session.kinds:
            layout.addWidget(QLabel("no devices"))
        for kind in session.kinds:
            chip = QToolButton()
            chip.setAutoRaise(True)
            chip.clicked.connect(partial(self._tell, kind))
            again = QPushButton("Reconnect")
            again.setToolTip(f"Open the {kind.replace('_', ' ')} again")
            again.clicked.connect(partial(session.reconnect, kind))
            layout.addWidget(chip)
            layout.addWidget(again)
            self.chips[kind] = chip
            self.reconnect_buttons[kind] = again
            self.show_state(kind)
        session.device_changed.connect(self.show_state)

    def show_state(self, kind: str) -> None:
        """Show how a device is doing now."""
        state = self._session.state(kind)
        now = colours()
        colour = {"open": now.ok, "failed": now.error, "opening": now.warning}.get(state.condition, now.dim)
        name = kind.replace("_", " ").replace("led", "LED").replace("slm", "SLM")
        chip = self.chips[kind]
        word = {"open": "", "opening": " …", "failed": " failed", "closed": " closed"}[state.condition]
        chip.setText(f"● {name}{word}")
        chip.setStyleSheet(f"color: {colour}; border: none; padding: 2px 4px;")
        chip.setToolTip(state.text or state.condition)
        self.reconnect_buttons[kind].setVisible(state.condition == "failed")

    def _tell(self, kind: str) -> None:
        text = self._session.state(kind).text or self._session.state(kind).condition
        window = TextWindow(f"{kind.replace('_', ' ')}", text, self)
        window.show()


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
