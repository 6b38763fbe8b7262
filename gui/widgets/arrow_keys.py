"""What the mouse does in a picture, by keys: arrows move, Alt with them changes the size, Space acts."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, Qt, Signal
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QWidget

ARROWS: dict[int, tuple[int, int]] = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, -1),
    Qt.Key.Key_Down: (0, 1),
}
"""Columns and rows: down the screen is positive, as in an image."""
_ZOOM: dict[int, float] = {
    Qt.Key.Key_Plus: 1.25,
    Qt.Key.Key_Equal: 1.25,
    Qt.Key.Key_Minus: 0.8,
    Qt.Key.Key_0: 0.0,
}


class ArrowKeys(QObject):
    """Keys of a widget that shows a picture or plot; the widget takes the keyboard by Tab or a click.

    The steps are those of the stage: Shift makes them ten times as large, Ctrl a tenth.

    Parameters
    ----------
    widget : QWidget
        Where the keyboard is when the keys are pressed.

    Signals
    -------
    moved : float, float
        Steps to the right and down.
    resized : float, float
        The same with Alt.
    acted : bool
        Space or Return (True); Backspace or Delete (False).
    zoomed : float
        Factor of ``+`` and ``-``; 0 for the key ``0``: show the whole.
    entered
        The widget has the keyboard now.
    left
        It has not any more.
    """

    moved = Signal(float, float)
    resized = Signal(float, float)
    acted = Signal(bool)
    zoomed = Signal(float)
    entered = Signal()
    left = Signal()

    def __init__(self, widget: QWidget) -> None:
        super().__init__(widget)
        widget.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        widget.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Take the keys that mean something here."""
        if event.type() is QEvent.Type.FocusIn:
            self.entered.emit()
        elif event.type() is QEvent.Type.FocusOut:
            self.left.emit()
        if event.type() is not QEvent.Type.KeyPress or not isinstance(event, QKeyEvent):
            return False
        key, held = event.key(), event.modifiers()
        if key in ARROWS:
            scale = 1.0
            if held & Qt.KeyboardModifier.ShiftModifier:
                scale = 10.0
            elif held & Qt.KeyboardModifier.ControlModifier:
                scale = 0.1
            across, down = ARROWS[key]
            signal = self.resized if held & Qt.KeyboardModifier.AltModifier else self.moved
            signal.emit(across * scale, down * scale)
            return True
        if held & (Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.AltModifier):
            return False  # shortcuts
        if key in _ZOOM:
            self.zoomed.emit(_ZOOM[key])
            return True
        if key in (Qt.Key.Key_Space, Qt.Key.Key_Return, Qt.Key.Key_Enter):
            self.acted.emit(True)
            return True
        if key in (Qt.Key.Key_Backspace, Qt.Key.Key_Delete):
            self.acted.emit(False)
            return True
        return False
