"""A film of a video's pictures: MP4 with VP9, which browsers and players show, written by OpenCV's FFmpeg.

OpenCV's wheels carry no H.264 encoder (its licence); VP9 in MP4 was played back from each file when this was
chosen, and is read back by the tests.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file
from instrument.files.errors import FileError

CODEC = "vp09"
DEFAULT_FPS = 25.0
SAMPLES = 24
"""Pictures looked at to find black and white of all."""
BLACK_PERCENTILE, WHITE_PERCENTILE = 0.5, 99.8


def levels_of(pictures: Iterable[npt.NDArray[Any]]) -> tuple[float, float]:
    """Return black and white for pictures to be shown alike: percentiles over all of them, NaN left out."""
    values = [picture[np.isfinite(picture)][::7] for picture in pictures]
    together = np.concatenate([v for v in values if v.size] or [np.zeros(1)])
    low, high = np.percentile(together, (BLACK_PERCENTILE, WHITE_PERCENTILE))
    return float(low), float(high) if high > low else float(low) + 1.0


def as_shown(picture: npt.NDArray[Any], black: float, white: float) -> npt.NDArray[np.uint8]:
    """Return a picture as 8-bit RGB, (height, width, 3); NaN is black."""
    level = np.nan_to_num((picture - black) / (white - black), nan=0.0)
    shown = np.round(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2) if shown.ndim == 2 else shown


def write_mp4(path: Path, pictures: Iterable[npt.NDArray[np.uint8]], fps: float) -> int:
    """Write pictures, 8-bit RGB (height, width, 3), whole or not at all; returns how many.

    Sides are made even by repeating the last row or column, as the codec needs.

    Raises
    ------
    FileError
        When OpenCV here cannot encode, or the folder cannot be written to.
    """
    import cv2

    count = 0
    writer: Any = None
    with whole_file(path) as temporary:
        try:
            for picture in pictures:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if writer is None:
                    size = (even.shape[1], even.shape[0])
                    writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*CODEC), fps, size)
                    if not writer.isOpened():
                        raise FileError(
                            path,
                            f"OpenCV {cv2.__version__} here cannot encode VP9.",
                            "Install opencv-contrib-python-headless from PyPI, or use --no-mp4.",
                        )
                writer.write(np.ascontiguousarray(even[..., ::-1]))
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if count == 0:
            raise FileError(path, "there is no picture to make a film of.")
    return count
