"""The SLM images that a plan names."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError


def read_slm_image(path: Path) -> npt.NDArray[np.uint8]:
    """Return the grey levels of an SLM image file, ``(height, width)`` uint8.

    Raises
    ------
    FileError
        When it is missing, no image, or not 8-bit grey.
    """
    if not path.is_file():
        raise FileError(path, "no such SLM image.")
    levels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if levels is None:
        raise FileError(path, "is no image that can be read.", "SLM images are 8-bit grey PNG or TIFF files.")
    if levels.dtype != np.uint8 or levels.ndim != 2:
        raise FileError(path, f"is {levels.dtype} {levels.shape}; an SLM image is 8-bit grey.")
    return levels.view(np.uint8)
