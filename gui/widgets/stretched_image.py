"""An image drawn over a rectangle of another size: a slice of a coarser level lies where it belongs."""

from __future__ import annotations

from typing import Any

import numpy as np
from PySide6.QtCore import QPointF
from PySide6.QtWidgets import QWidget

from gui.widgets.image_view import Image, ImageView


class StretchedImage(ImageView):
    """Shows images over ``extent``, (width, height) in voxels; places under the mouse are voxels.

    Parameters
    ----------
    keep_aspect : bool
        Whether voxels are square on the screen; without, the image fills its place.
    parent : QWidget, optional
    """

    def __init__(self, *, keep_aspect: bool = True, parent: QWidget | None = None) -> None:
        super().__init__(parent=parent)
        self.extent = (1, 1)
        self.box.setAspectLocked(keep_aspect)

    def show_over(self, image: Image, extent: tuple[int, int], levels: tuple[float, float]) -> None:
        """Show an image, (height, width[, 3]), over ``extent``."""
        moved = self.extent != extent or self.image is None
        self.extent = extent
        self.show_image(image, *levels)
        self.item.setRect(0, 0, *extent)
        if moved:
            self.whole()

    def whole(self) -> None:
        """Show the whole extent."""
        across, down = self.extent
        self.box.setRange(xRange=(0, across), yRange=(0, down), padding=0.01)

    def pixel_at(self, place: QPointF) -> tuple[int, int] | None:
        """Return column and row of the voxel at a place of the scene; None outside."""
        if self.image is None:
            return None
        point: Any = self.box.mapSceneToView(place)
        column, row = int(np.floor(point.x())), int(np.floor(point.y()))
        across, down = self.extent
        return (column, row) if 0 <= column < across and 0 <= row < down else None

    def describe(self, column: int, row: int) -> str:
        """Return a voxel's place and value in words."""
        assert self.image is not None
        height, width = self.image.shape[:2]
        value = self.image[row * height // self.extent[1], column * width // self.extent[0]]
        return f"{column}, {row}: {' '.join(f'{v:.5g}' for v in np.atleast_1d(value))}"
