"""The title of a panel at the side, and its two buttons: apart, and away."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QDockWidget, QPushButton, QWidget

from gui.widgets.building import button, fill, label


class DockTitle(QWidget):
    """In the place of Qt's own, whose buttons have grey pictures in every theme, and no keys.

    Parameters
    ----------
    dock : QDockWidget
        It can still be dragged by its title.
    """

    def __init__(self, dock: QDockWidget) -> None:
        super().__init__(dock)
        self.setObjectName("dock-title")
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        title = dock.windowTitle()
        self.apart = _sign("↗", f"{title}: a window of its own, or back in its place")
        self.apart.clicked.connect(lambda: dock.setFloating(not dock.isFloating()))
        self.away = _sign("×", f"{title}: close; the menu View opens it again")
        self.away.clicked.connect(dock.close)
        self._words = label(title, "dim")
        parts = (self._words, None, self.apart, self.away)
        fill(self, *parts, across=True, margins=(9, 0, 4, 0), spacing=2)

    def set_seen(self, seen: bool) -> None:
        """Show or hide what it holds: Qt calls what lies in a dock behind another one visible."""
        for part in (self._words, self.apart, self.away):
            part.setVisible(seen)


def _sign(sign: str, tip: str) -> QPushButton:
    made = button(sign, tip)
    made.setAccessibleName(tip)
    made.setFlat(True)
    made.setFocusPolicy(Qt.FocusPolicy.TabFocus)
    return made
