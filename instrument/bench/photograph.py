"""One photograph: a frame, or the mean of several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera
from drivers.frame import Frame, FrameMetadata
from instrument.files.errors import BenchError

Progress = Callable[[int, int], object]
"""Called with how many are done so far, and how many there are in all."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One photograph: a frame, or the mean of several.

    Attributes
    ----------
    image : ndarray
        ``(height, width)`` or ``(height, width, 3)`` in counts, read only; the camera's uint8 or uint16 for
        a single frame, float32 for a mean.
    metadata : FrameMetadata
        Of the last frame, but for what is combined of all: see :meth:`FrameMetadata.of_mean`.
    average : int
        Number of frames averaged.
    """

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]
    metadata: FrameMetadata
    average: int

    @property
    def full_scale(self) -> int:
        """The largest count that the camera can report at its present bit depth."""
        return (1 << self.metadata.significant_bits) - 1


def photograph(
    camera: Camera,
    average: int = 1,
    *,
    on_progress: Progress | None = None,
    on_frame: Callable[[Frame], object] | None = None,
) -> Snapshot:
    """Take the mean of ``average`` frames, all exposed after this call.

    ``on_progress`` is called after each frame, ``on_frame`` with the frame itself.

    Raises
    ------
    DeviceError
        When the camera fails.
    BenchError
        When ``average`` is below 1.
    """
    if average < 1:
        raise BenchError(f"A photograph is the mean of 1 or more frames, not {average}.")
    total = np.zeros((), np.float64)
    metadata: list[FrameMetadata] = []
    for taken in range(1, average + 1):
        frame = camera.snap()
        metadata.append(frame.metadata)
        if average > 1:
            total = np.add(total, frame.image)
        if on_frame is not None:
            on_frame(frame)
        if on_progress is not None:
            on_progress(taken, average)
    if average == 1:
        return Snapshot(frame.image, frame.metadata, average)
    mean = np.asarray(total / average, np.float32)
    mean.flags.writeable = False
    return Snapshot(mean, FrameMetadata.of_mean(metadata), average)
