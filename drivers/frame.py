"""A camera frame and what is known about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from typing import Any, Self

import numpy as np
import numpy.typing as npt


def filled_in_by_bench(**kind: Any) -> Any:
    """Declare metadata that :meth:`instrument.bench.bench.Bench.with_surroundings` fills in."""
    return field(metadata={"filled_in_by_bench": True}, **kind)


def over_frames(combine: Callable[[Iterable[Any]], Any], **kind: Any) -> Any:
    """Declare metadata of which a mean of several frames has not the last one's, but all of them combined."""
    return field(metadata={"over_frames": combine}, **kind)


@dataclass(frozen=True, slots=True)
class FrameMetadata:
    """What is known about one frame when it leaves the camera driver; the runner adds stage, LEDs and SLM.

    A field declared here (with a default, for frames of before) reaches photographs, runs and recordings, and
    comes back from them. A driver gives it, by name, or as ``RawFrame.facts``; what the bench knows is
    declared by :func:`filled_in_by_bench`.
    """

    frame_id: int
    """Running number given by the device (or by the driver where the device has none), from 0."""
    device_time_ns: int | None
    """The device's own clock at the end of the exposure, or None where it has none.

    GenICam cameras (``aravis``, ``basler``) stamp as their makers chose, many as an exposure begins: SFNC
    says it of chunk data alone (``ChunkTimestamp``: FrameStart). Of theirs what lies between two frames
    counts, the exposure being the same.
    """
    host_time_ns: int
    """``time.monotonic_ns()`` when the frame reached the host."""
    utc: datetime
    """Wall clock (timezone aware, UTC) when the frame reached the host."""
    exposure_ms: float
    gain: float
    """Electronic gain as a factor; 1.0 is the camera's base gain."""
    pixel_format: str
    """GenICam name: ``"Mono8"``, ``"Mono12"``, ``"Mono16"``, ``"BayerRG12"``, ``"RGB8"`` ..."""
    significant_bits: int
    """Bits that carry signal; full scale is ``2**significant_bits - 1`` counts."""
    black_level: float
    """Offset added by the camera, in counts."""
    roi: tuple[int, int, int, int]
    """``(top, left, height, width)`` in sensor pixels before binning."""
    binning: int
    """Sensor pixels summed along each axis."""
    dropped_before: int = over_frames(sum, default=0)
    """Frames that the device or driver lost between the previous frame and this one."""
    saturated_fraction: float = over_frames(max, default=0.0)
    """Fraction of pixels at full scale."""
    stage_position: Mapping[str, float] = filled_in_by_bench(default_factory=dict)
    """Axis name (unit in the name) to position; filled in by the runner."""
    led_pattern: str = filled_in_by_bench(default="")
    """The LED pattern in words, e.g. ``"off"``; filled in by the runner."""
    slm_image_hash: str = filled_in_by_bench(default="")
    """SHA-256 of the SLM image, or empty; filled in by the runner."""

    def among(self, surroundings: FrameMetadata) -> Self:
        """Return these metadata with what the bench fills in taken from others, of the same bench."""
        names = (declared.name for declared in fields(self) if "filled_in_by_bench" in declared.metadata)
        return replace(self, **{name: getattr(surroundings, name) for name in names})

    @staticmethod
    def of_mean(frames: Sequence[FrameMetadata]) -> FrameMetadata:
        """Return the metadata of several frames' mean: the last one's, but for what is combined."""
        last = frames[-1]
        combined = {
            declared.name: declared.metadata["over_frames"](getattr(frame, declared.name) for frame in frames)
            for declared in fields(last)
            if "over_frames" in declared.metadata
        }
        return replace(last, **combined)


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera image, read only.

    Attributes
    ----------
    image : ndarray
        ``(height, width)`` or ``(height, width, 3)``, uint8 or uint16, counts, not writeable.
    metadata : FrameMetadata
    """

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    metadata: FrameMetadata

    def __post_init__(self) -> None:
        if self.image.dtype not in (np.uint8, np.uint16):
            raise TypeError(f"A frame holds uint8 or uint16 counts, not {self.image.dtype}.")
        if self.image.ndim not in (2, 3):
            raise ValueError(f"A frame is (height, width) or (height, width, 3), not {self.image.shape}.")
        self.image.flags.writeable = False

    @property
    def full_scale(self) -> int:
        """The largest count the camera can report at its present bit depth."""
        return (1 << self.metadata.significant_bits) - 1
