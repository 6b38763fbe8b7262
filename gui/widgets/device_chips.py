"""One chip a device, with its state in a word."""

from __future__ import annotations

from functools import partial

from PySide6.QtWidgets import QToolButton, QWidget

from gui.session import BenchSession
from gui.session_news import name_of
from gui.way_on import ReconnectButton
from gui.widgets.building import fill, label, mark
from gui.widgets.device_settings import DeviceSettings
from instrument.bench.config import Kind


class DeviceChips(QWidget):
    """One chip a device; a click shows all about it, "Reconnect" appears where only one has failed."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._session = session
        self.chips: dict[str, QToolButton] = {}
        self.reconnect_buttons: dict[str, ReconnectButton] = {}
        for kind in session.kinds:
            chip = QToolButton()
            chip.setObjectName("device")
            chip.setAutoRaise(True)
            chip.clicked.connect(partial(self._show_all, kind))
            again = ReconnectButton(session, (kind,), self, "Reconnect")
            self.chips[kind], self.reconnect_buttons[kind] = chip, again
            self.show_state(kind)
        pairs = zip(self.chips.values(), self.reconnect_buttons.values(), strict=True)
        shown: list[QWidget] = [widget for pair in pairs for widget in pair]
        fill(self, *(shown or [label("No bench is open")]), across=True, spacing=4)
        session.device_changed.connect(self.show_state)

    def show_state(self, kind: str) -> None:
        """Show how a device is doing now."""
        state = self._session.state(kind)
        chip = self.chips[kind]
        word = {"open": "", "opening": " …", "failed": " failed", "closed": " closed"}[state.condition]
        chip.setText(f"● {name_of(kind)}{word}")
        mark(chip, "condition", state.condition)
        chip.setToolTip(state.text or state.condition)
        failed = [one for one in self.chips if self._session.state(one).condition == "failed"]
        for one, again in self.reconnect_buttons.items():  # of several the strip has one button
            again.setVisible(failed == [one])
        for part in (self, self.parentWidget()):
            if part is not None and (layout := part.layout()) is not None:
                layout.activate()  # never a word cut off for a moment

    def _show_all(self, kind: Kind) -> None:
        DeviceSettings(self._session, kind, self).show()
