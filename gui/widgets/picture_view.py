"""A reconstructed picture: levels, colour map, turning, place and value under the mouse."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PySide6.QtWidgets import QHBoxLayout, QPushButton, QVBoxLayout, QWidget

from gui.theme import colours
from gui.widgets.image_view import ImageView
from gui.widgets.levels_bar import LevelsBar


class PictureView(QWidget):
    """Shows one picture, (height, width) or (height, width, 3)."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.picture: npt.NDArray[np.float32] | None = None
        self.turned_deg = 0
        self.pitch_um: float | None = None
        self.image = _ScaledImage()
        self.levels = LevelsBar()
        self.levels.changed.connect(self._show)
        self.turn = QPushButton("Turn 90°")
        self.turn.setToolTip(
            "Turn the picture counter-clockwise; a picture on the sensor's grid is upside down"
        )
        self.turn.clicked.connect(self.turn_by_90)
        self.whole = QPushButton("Whole")
        self.whole.setToolTip("Show the whole picture (the wheel zooms, dragging moves)")
        self.whole.clicked.connect(self.image.whole)
        self.image.setMinimumSize(70, 50)
        self.hovered = self.image.hovered
        below = QHBoxLayout()
        below.addStretch()
        below.addWidget(self.whole)
        below.addWidget(self.turn)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.image, 1)
        layout.addLayout(below)
        layout.addWidget(self.levels)

    @property
    def shown(self) -> npt.NDArray[np.float32] | None:
        """The picture as it is turned now."""
        return None if self.picture is None else np.rot90(self.picture, self.turned_deg // 90)

    def show_picture(
        self, picture: npt.NDArray[np.float32], *, pitch_um: float | None = None, keep_levels: bool = False
    ) -> None:
        """Show a picture; ``pitch_um`` is a pixel's size in the object's plane."""
        self.picture = picture
        self.image.pitch_um = pitch_um
        self.levels.set_image(picture, keep_levels=keep_levels)
        self._show()

    def turn_by_90(self) -> None:
        """Turn it counter-clockwise; exports are turned alike."""
        self.turned_deg = (self.turned_deg + 90) % 360
        self._show()

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        self.image.graphics.setBackground(colours().window)
        self.levels.restyle()

    def _show(self) -> None:
        if (shown := self.shown) is not None:
            self.image.set_colour_map(self.levels.colour_map)
            self.image.show_image(shown, *self.levels.levels)


class _ScaledImage(ImageView):
    """An image whose places under the mouse are also told in micrometres from the middle."""

    def __init__(self) -> None:
        super().__init__()
        self.pitch_um: float | None = None

    def describe(self, column: int, row: int) -> str:
        """Return a pixel's place and value in words."""
        words = super().describe(column, row)
        if self.pitch_um is None or self.image is None:
            return words
        height, width = self.image.shape[:2]
        x_um, y_um = ((p - n // 2) * self.pitch_um for p, n in ((column, width), (row, height)))
        return f"{words}   ({_length(x_um)}, {_length(y_um)} from the middle)"


def _length(um: float) -> str:
    return f"{um:.3g} µm" if abs(um) < 1000 else f"{um / 1000:.3g} mm"
