"""The file that a photograph is kept in, with what is known about it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.frame import FrameMetadata
from instrument.bench.lit import LightState
from instrument.bench.photograph import Snapshot
from instrument.files.atomic import check_writable, require_new
from instrument.files.errors import FileError
from instrument.files.images import check_suffix, read_image, side_car, write_image
from instrument.files.record import plain, value_of

if TYPE_CHECKING:
    from instrument.bench.bench import Bench

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
