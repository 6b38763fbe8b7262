"""A photograph: a frame or the mean of several, what is lit meanwhile, and the file that it is kept in."""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import LedPattern
from instrument.files.atomic import check_writable, require_new
from instrument.files.errors import BenchError, FileError
from instrument.files.images import check_suffix, read_image, side_car, write_image
from instrument.files.record import plain, value_of

if TYPE_CHECKING:
    from instrument.bench.bench import Bench


SPOILT = 1e-3
"""Share of saturated pixels from which a photograph is: a few are the sensor's, or a lamp's reflection."""

Progress = Callable[[int, int], object]
"""Called with how many are done so far, and how many there are in all."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One photograph: a frame, or the mean of several."""

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]
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
        cls, total: npt.NDArray[np.float64], metadata: Sequence[FrameMetadata], means: Sequence[float]
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


class LightState(enum.StrEnum):
    """What is lit while a photograph is taken."""

    SCENE = "scene"
    SOURCE = "source"
    DARK = "dark"
    AS_IS = "as-is"


def switch_light(bench: Bench, light: LightState) -> None:
    """Light the scene, the point source, or nothing; ``AS_IS`` changes nothing.

    Raises DeviceError or BenchError when a light cannot be switched.
    """
    if light is LightState.AS_IS:
        return
    bench.source_on() if light is LightState.SOURCE else bench.source_off()
    bench.scene_on() if light is LightState.SCENE else bench.scene_off()


def light_of(bench: Bench) -> LightState:
    """Return what is lit now, as far as the program knows.

    ``AS_IS`` where no other word is true: another LED pattern than the point source, or LEDs and the scene.
    """
    pattern = led_pattern(bench)
    if pattern is None or pattern.is_dark:
        return LightState.SCENE if bench.scene_lit else LightState.DARK
    return LightState.SOURCE if bench.source_lit and not bench.scene_lit else LightState.AS_IS


def led_pattern(bench: Bench) -> LedPattern | None:
    """Return the pattern that the LED array confirmed last; None where no array is open."""
    leds = bench.led_array
    return leds.pattern if leds is not None and leds.is_open else None


@dataclass(frozen=True, slots=True)
class Lit:
    """What is lit, to the last LED, so that it can be lit again after a run has made the bench safe."""

    pattern: LedPattern | None
    scene: bool

    @classmethod
    def now(cls, bench: Bench) -> Lit:
        """Return what is lit, as far as the program knows."""
        return cls(led_pattern(bench), bench.scene_lit)

    def put_back(self, bench: Bench) -> None:
        """Light it again.

        Raises DeviceError or BenchError when a light cannot be switched.
        """
        if bench.led_array is not None and self.pattern is not None:
            bench.led_array.set_pattern(self.pattern)
        if bench.scene_lit != self.scene:
            bench.scene_on() if self.scene else bench.scene_off()


PHOTOGRAPHS = "photographs"
"""Folder of photographs within that of runs."""


def photograph_name() -> str:
    """Return a file name for a photograph taken now."""
    now = datetime.now(UTC)
    return f"photo-{now:%Y%m%dT%H%M%S}{now.microsecond // 1000:03d}Z.tif"


def check_photograph_file(target: Path, average: int, *, force: bool = False) -> None:
    """Refuse a file that cannot hold the photograph, cannot be written, or is there already.

    Raises FileError.
    """
    check_suffix(target)
    if average > 1 and target.suffix.lower() == ".png":
        raise FileError(
            target, "a mean of several frames is float32, which PNG cannot hold.", "Use .tif or .npy."
        )
    files = [target] if target.suffix.lower() in (".tif", ".tiff") else [target, side_car(target)]
    for file in files:
        check_writable(file)
        require_new(file, overwrite=force)


def write_snapshot(
    bench: Bench, target: Path, taken: Snapshot, light: LightState, *, operator_asked: bool = True
) -> None:
    """Write a photograph with what is known about it; errors as ``write_image``."""
    facts = {**snapshot_facts(bench, taken, light), "operator_asked": operator_asked}
    write_image(target, taken.image, facts)


def snapshot_facts(bench: Bench, taken: Snapshot, light: LightState) -> dict[str, Any]:
    """Return what is kept beside a photograph."""
    noise = bench.camera.noise  # of a frame, whatever the average
    return {
        "bench": bench.label,
        "simulated": bool(bench.simulated_kinds),
        "camera": str(bench.camera.identity),
        "light": light.value,
        "average": taken.average,
        **({"frame_means": taken.frame_means} if taken.frame_means else {}),
        "full_scale": taken.full_scale,
        "noise": plain(noise),
        "pixel_pitch_um": bench.camera.pixel_pitch_um * taken.metadata.binning,
        **plain(taken.metadata),
    }


def read_snapshot(path: Path | str) -> Snapshot:
    """Read a photograph that :func:`write_snapshot` wrote, with its metadata.

    Raises FileError when it cannot be read, or is no photograph of this program's: nothing is known about it.
    """
    image = read_image(path)
    try:
        metadata, average = value_of(FrameMetadata, image.metadata), int(image.metadata["average"])
        means = tuple(float(mean) for mean in image.metadata.get("frame_means", ()))
    except (LookupError, TypeError, ValueError) as error:
        raise FileError(path, f"tells not how it was photographed: {error}.") from None
    pixels = image.pixels
    pixels.flags.writeable = False
    return Snapshot(pixels, metadata, average, means)
