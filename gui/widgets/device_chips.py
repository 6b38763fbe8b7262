"""The devices of the bench in a row: how each is doing, why one failed, a button to connect it again."""

from __future__ import annotations

from functools import partial

from PySide6.QtWidgets import QHBoxLayout, QLabel, QPushButton, QToolButton, QWidget

from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.message import TextWindow


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
