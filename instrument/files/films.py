"""Films: pictures one after the other, as MP4."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file
from instrument.files.errors import FileError
from recon.arrays import Array


def as_shown(picture: Array, black: float, white: float) -> npt.NDArray[np.uint8]:
    """Return a picture as 8-bit RGB, (height, width, 3); NaN is black."""
    level = np.nan_to_num((picture - black) / (white - black), nan=0.0)
    shown = np.round(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2) if shown.ndim == 2 else shown


def write_mp4(
    path: Path, pictures: Iterable[npt.NDArray[np.uint8]], fps: float, *, codec: str = "vp09"
) -> int:
    """Write pictures, 8-bit RGB (height, width, 3), whole or not at all; returns how many.

    VP9, the default, is what browsers and players show: OpenCV's wheels carry no H.264 encoder (its licence).
    MPEG-4 (``"mp4v"``) is encoded a hundred times as fast. Sides are made even by repeating the last row or
    column, as codecs need.

    Raises FileError when OpenCV here cannot encode, or the folder cannot be written to.
    """
    count = 0
    writer: Any = None
    with whole_file(path) as temporary:
        try:
            for picture in pictures:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if writer is None:
                    size = (even.shape[1], even.shape[0])
                    writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*codec), fps, size)
                    if not writer.isOpened():
                        raise FileError(
                            path,
                            f"OpenCV {cv2.__version__} here cannot encode {codec}.",
                            "Install opencv-python-headless from PyPI, or do without the MP4.",
                        )
                writer.write(np.ascontiguousarray(even[..., ::-1]))
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if count == 0:
            raise FileError(path, "there is no picture to make a film of.")
    return count
