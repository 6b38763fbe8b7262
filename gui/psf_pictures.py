"""The PSFs of a sweep that goes on, to be looked at: the newest as they are, older ones small."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_IN_FULL = 24
"""PSFs that are kept as they are, up to 2 MB each; a sweep may take a thousand."""
_SMALL_PX = 256
_LEVELS = (0.1, 99.9)
"""Percentiles that small pictures are stretched to."""

Image = npt.NDArray[Any]


class PsfPicture(NamedTuple):
    """A PSF, and by how much it was reduced along each side: 1 as it arrived, else 8 bit for the eye."""

    image: Image
    reduced: int


class PsfPictures:
    """Pictures by number; of all but the newest only a small one is kept."""

    def __init__(self) -> None:
        self._in_full: dict[int, Image] = {}
        self._small: dict[int, PsfPicture] = {}

    def __len__(self) -> int:
        return len(self._in_full) + len(self._small)

    @property
    def nbytes(self) -> int:
        """What they hold in memory."""
        images = [*self._in_full.values(), *(picture.image for picture in self._small.values())]
        return sum(image.nbytes for image in images)

    def keep(self, number: int, image: Image) -> None:
        """Keep a picture, in place of an earlier one of the same number."""
        self._in_full.pop(number, None)
        self._small.pop(number, None)
        self._in_full[number] = image
        if len(self._in_full) > _IN_FULL:
            oldest = next(iter(self._in_full))
            self._small[oldest] = small(self._in_full.pop(oldest))

    def get(self, number: int) -> PsfPicture | None:
        """Return a picture; None where none has arrived."""
        image = self._in_full.get(number)
        return PsfPicture(image, 1) if image is not None else self._small.get(number)


def small(image: Image) -> PsfPicture:
    """Return an image, (height, width), as means of blocks stretched to 8 bit, 256 pixels wide at most."""
    factor = -(-max(image.shape) // _SMALL_PX)
    height, width = (max(1, length // factor) for length in image.shape)
    rows, columns = min(factor, image.shape[0]), min(factor, image.shape[1])
    blocks = image[: height * rows, : width * columns].reshape(height, rows, width, columns)
    means = blocks.mean(axis=(1, 3))
    low, high = np.percentile(means, _LEVELS)
    stretched = (means - low) * (255 / max(high - low, 1.0))
    return PsfPicture(np.clip(np.rint(stretched), 0, 255).astype(np.uint8), factor)
