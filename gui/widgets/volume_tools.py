"""What a volume is looked at by: which views, measuring, true proportions; the slider of its planes."""

from __future__ import annotations

from functools import partial
from typing import Literal

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtWidgets import QAbstractButton, QButtonGroup, QCheckBox, QSlider, QWidget

from gui.widgets.building import button, fill

Mode = Literal["brightest", "slices", "turning"]
_MODES: dict[Mode, tuple[str, str, str]] = {
    "brightest": ("Brightest", "The brightest voxels along each axis", "Ctrl+B"),
    "slices": ("Slices", "Slices through one point: a click or arrows in a view move it", "Ctrl+J"),
    "turning": (
        "From any side",
        "The volume in three dimensions: drag or arrow keys turn it, space keeps it turning",
        "Ctrl+T",
    ),
}


class VolumeTools(QWidget):
    """The row above a volume; ``modes`` has its buttons.

    Signals
    -------
    chosen : str
        Another :data:`Mode`.
    """

    chosen = Signal(str)

    def __init__(self) -> None:
        super().__init__()
        group = QButtonGroup(self)
        self.modes: dict[Mode, QAbstractButton] = {}
        for mode, (words, tip, keys) in _MODES.items():
            choose = partial(self.chosen.emit, mode)
            self.modes[mode] = button(words, f"{tip} ({keys})", choose, shortcut=keys, checkable=True)
            group.addButton(self.modes[mode])
        tip = "Drag over the front view: size, mean, deviation, most, and the mean along depth (Ctrl+M)"
        self.measure = button("Measure", tip, shortcut="Ctrl+M", checkable=True)
        self.proportions = QCheckBox("True proportions")
        self.proportions.setToolTip(
            "Voxels of one size, upright: shapes and lengths as in the scene; without, a plane's voxels are "
            "as wide as it is far away"
        )
        self.proportions.setEnabled(False)
        fill(self, *self.modes.values(), self.measure, self.proportions, None, across=True)


class PlaneSlider(QSlider):
    """The depth plane of the front view; Page up and down step it from everywhere in ``around``.

    Signals
    -------
    stepped : int
        So many planes.
    """

    stepped = Signal(int)

    def __init__(self, around: QWidget) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self.setToolTip("Depth plane of the front view (arrow keys; Page up and down from every view)")
        self.setAccessibleName("Depth plane")
        for keys, by in ((Qt.Key.Key_PageUp, -1), (Qt.Key.Key_PageDown, 1)):
            step = QShortcut(
                QKeySequence(keys), around, context=Qt.ShortcutContext.WidgetWithChildrenShortcut
            )
            step.activated.connect(partial(self.stepped.emit, by))
