"""A photograph: a frame or the mean of several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera
from drivers.frame import Frame, FrameMetadata
from instrument.files.errors import BenchError
from recon.arrays import Float32Array, Float64Array

SPOILT = 1e-3
"""Share of saturated pixels from which a photograph is: a few are the sensor's, or a lamp's reflection."""

Progress = Callable[[int, int], object]
"""Called with how many are done so far, and how many there are in all."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One photograph: a frame, or the mean of several."""

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | Float32Array
    """``(height, width)`` or ``(height, width, 3)`` in counts, read only; the camera's uint8 or uint16 for a
    single frame, float32 for a mean."""
    metadata: FrameMetadata
    """Of the last frame, but for what is combined of all: see :meth:`FrameMetadata.of_mean`."""
    average: int
    """Number of frames averaged."""
    frame_means: tuple[float, ...] = ()
    """Of a mean: the mean count of each frame; empty where that is not known."""

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> Snapshot:
        """Return the photograph that some frames make: the frame itself, or their mean."""
        if len(frames) == 1:
            return cls(frames[0].image, frames[0].metadata, 1)
        total = np.zeros((), np.float64)
        for frame in frames:
            total = np.add(total, frame.image)
        means = [_mean_count(frame) for frame in frames]
        return cls._mean(total, [frame.metadata for frame in frames], means)

    @classmethod
    def _mean(
        cls, total: Float64Array, metadata: Sequence[FrameMetadata], means: Sequence[float]
    ) -> Snapshot:
        mean = np.asarray(total / len(metadata), np.float32)
        mean.flags.writeable = False
        return cls(mean, FrameMetadata.of_mean(metadata), len(metadata), tuple(means))

    @property
    def unsteadiness(self) -> float:
        """Standard deviation of the frames' mean counts, relative, dark level included; 0 where unknown."""
        means = np.array(self.frame_means)
        return float(means.std(ddof=1) / means.mean()) if len(means) > 1 and means.mean() > 0 else 0.0

    @property
    def full_scale(self) -> int:
        """The largest count that the camera can report at its present bit depth."""
        return (1 << self.metadata.significant_bits) - 1


def _mean_count(frame: Frame) -> float:
    return float(frame.image.mean(dtype=np.float64))


def photograph(
    camera: Camera,
    average: int = 1,
    *,
    on_progress: Progress | None = None,
    on_frame: Callable[[Frame], object] | None = None,
) -> Snapshot:
    """Take the mean of ``average`` frames, all exposed after this call.

    ``on_progress`` is called after each frame, ``on_frame`` with the frame itself.

    Raises DeviceError when the camera fails; BenchError when ``average`` is below 1.
    """
    if average < 1:
        raise BenchError(f"A photograph is the mean of 1 or more frames, not {average}.")
    total = np.zeros((), np.float64)
    metadata: list[FrameMetadata] = []
    means: list[float] = []
    for taken in range(1, average + 1):
        frame = camera.snap()
        metadata.append(frame.metadata)
        if average > 1:
            total = np.add(total, frame.image)
            means.append(_mean_count(frame))
        if on_frame is not None:
            on_frame(frame)
        if on_progress is not None:
            on_progress(taken, average)
    if average == 1:
        return Snapshot(frame.image, frame.metadata, average)
    return Snapshot._mean(total, metadata, means)
