"""Write a run's frames for other programs, one frame in memory at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from drivers.frame import FrameMetadata
from instrument.bench.photograph import Progress
from instrument.files.atomic import check_writable, require_new, whole_file
from instrument.files.errors import BenchError, FileError, ranges
from instrument.files.films import as_shown, write_mp4
from instrument.files.images import write_image
from instrument.files.ome_tiff import annotation, resolution
from instrument.files.ome_zarr import is_zarr_name
from instrument.files.record import plain
from instrument.runs.frame_facts import z_steps_um
from instrument.runs.run import Run
from instrument.runs.run_files import FRAMES, RunError
from recon.arrays import Array

_BIG_TIFF_BYTES = 3_900_000_000


def export(
    run: Run,
    target: Path | str,
    frames: Sequence[int] | None = None,
    *,
    frames_per_s: float | None = None,
    on_progress: Progress | None = None,
) -> list[int]:
    """Write frames of a run to a file, or to a folder of PNG files; the format follows from the name.

    ``.ome.tif`` (OME-TIFF), ``.tif`` (stack), ``.h5`` or ``.hdf5``, ``.npy``, ``.mp4`` (8 bit: full scale
    becomes 255); a name without suffix, or an existing folder: one PNG a frame, named by its number.
    Frames that are not there (gaps, steps not done) are left out; the numbers of those written are returned,
    and kept inside the file where the format allows it.

    Raises FileError when the target exists, cannot be written, or has another suffix; RunError when a frame
    is not there.

    Parameters
    ----------
    target : path
        Must not exist, except as a folder for PNG files.
    frames : sequence of int, optional
        Which ones, all of them stored; None means every stored frame.
    frames_per_s : float, optional
        Of an MP4; None means the recording's own rate, 10 for a run of a plan.
    on_progress : callable, optional
        Called after each frame.
    """
    target = Path(target)
    indices = sorted(run.records) if frames is None else list(frames)
    if not indices:
        raise RunError(run.path, "has no such frames to export.")
    if absent := [index for index in indices if index not in run.records]:
        raise RunError(run.path, f"frame {absent[0]} is not there ({run.condition}).")

    def images() -> Iterator[Array]:
        for done, index in enumerate(indices, start=1):
            yield run.frame(index)
            if on_progress is not None:
                on_progress(done, len(indices))

    name = target.name.lower()
    if target.is_dir() or not target.suffix:
        _png(run, target, indices, images())
        return indices
    writers: dict[str, Callable[[Run, Path, list[int], Iterator[Array]], None]] = {
        **dict.fromkeys((".ome.tif", ".ome.tiff"), partial(_tiff, ome=True)),
        **dict.fromkeys((".tif", ".tiff"), partial(_tiff, ome=False)),
        **dict.fromkeys((".h5", ".hdf5"), _hdf5),
        ".npy": _npy,
        ".mp4": partial(_mp4, frames_per_s=frames_per_s),
    }
    writer = next((write for suffix, write in writers.items() if name.endswith(suffix)), None)
    if is_zarr_name(target):
        own = run.path / FRAMES
        raise FileError(target, f"a run's frames are an OME-Zarr already: {own}.", "Copy that folder.")
    if writer is None:
        raise FileError(
            target, f"no known format. Choose a name ending in {', '.join(writers)}, or a folder."
        )
    require_new(target)
    check_writable(target, 0 if name.endswith(".mp4") else sum(run.records[i].n_bytes for i in indices))
    with whole_file(target) as temporary:
        writer(run, temporary, indices, images())
    return indices


def _tiff(run: Run, path: Path, indices: list[int], images: Iterator[Array], *, ome: bool) -> None:
    array = run.array
    shape = (len(indices), *array.frame_shape)
    pitch_um = float(run.provenance["pixel_pitch_um"])
    noted = [run.metadata(i) for i in indices]
    axis = "Z" if ome and run.plan is not None and z_steps_um(noted).size else "T"
    metadata: dict[str, Any] = {"axes": f"{axis}YXS" if array.is_colour else f"{axis}YX"}
    if ome:
        metadata |= {"Name": run.path.name, **_ome_facts(run, indices, noted, axis)}
        for side in "XY":
            metadata |= {f"PhysicalSize{side}": pitch_um, f"PhysicalSize{side}Unit": "µm"}
    else:
        metadata["frames"] = json.dumps(indices)
    with tifffile.TiffWriter(
        path, bigtiff=array.dtype.itemsize * int(np.prod(shape)) > _BIG_TIFF_BYTES, ome=ome
    ) as tiff:
        tiff.write(
            images,
            shape=shape,
            dtype=array.dtype,
            photometric="rgb" if array.is_colour else "minisblack",
            metadata=metadata,
            **resolution(pitch_um),
        )


def _ome_facts(run: Run, indices: list[int], noted: list[FrameMetadata], axis: str) -> dict[str, Any]:
    """Return what OME's fields hold of frames: when and where each was taken, and the camera's settings.

    ``axis`` is that of the frames, T or Z.
    """
    first = noted[0]
    began_ns = first.host_time_ns
    planes: dict[str, list[Any]] = {
        "DeltaT": [(one.host_time_ns - began_ns) / 1e9 for one in noted],
        "ExposureTime": [one.exposure_ms / 1e3 for one in noted],
        f"The{axis}": list(range(len(noted))),
    }
    for name in "xyz":
        if all(f"{name}_um" in one.stage_position for one in noted):
            planes[f"Position{name.upper()}"] = [one.stage_position[f"{name}_um"] for one in noted]
            planes[f"Position{name.upper()}Unit"] = ["µm"] * len(noted)
    facts: dict[str, Any] = {"AcquisitionDate": f"{first.utc:%Y-%m-%dT%H:%M:%S}", "Plane": planes}
    if run.array.dtype.kind == "u":
        facts["SignificantBits"] = first.significant_bits
    if axis == "Z":
        facts |= {"PhysicalSizeZ": float(np.median(np.abs(z_steps_um(noted)))), "PhysicalSizeZUnit": "µm"}
    elif run.frame_period_s:
        facts |= {"TimeIncrement": run.frame_period_s, "TimeIncrementUnit": "s"}
    told = ("pixel_format", "black_level", "gain", "binning", "roi", "led_pattern", "slm_image_hash")
    facts["MapAnnotation"] = annotation(
        {
            **{name: _told([plain(getattr(one, name)) for one in noted]) for name in told},
            "significant_bits": first.significant_bits,
            "simulated": run.is_simulated,
            "frames": ranges(indices),
        }
    )
    return facts


def _told(values: list[Any]) -> Any:
    """Return the value of all frames; where they differ, each frame's, in their order."""
    return values[0] if all(one == values[0] for one in values) else "; ".join(map(str, values))


def _hdf5(run: Run, path: Path, indices: list[int], images: Iterator[Array]) -> None:
    try:
        import h5py
    except ImportError:
        raise BenchError(
            "HDF5 files need the package h5py, which is not installed. "
            "Install it (pip install h5py), or export to .ome.tif or .npy."
        ) from None
    array = run.array
    # The file is held already while it is written, and HDF5 would wait for itself.
    with h5py.File(path, "w", locking=False) as file:
        data = file.create_dataset(
            "frames", (len(indices), *array.frame_shape), array.dtype, chunks=(1, *array.frame_shape)
        )
        data.attrs["pixel_pitch_um"] = float(run.provenance["pixel_pitch_um"])
        data.attrs["axes"] = "t,y,x,c" if array.is_colour else "t,y,x"
        for place, image in enumerate(images):
            data[place] = image
        noted = [run.metadata(i) for i in indices]
        for name in ("pixel_format", "significant_bits", "black_level", "gain"):  # one for all, as a rule
            data.attrs[name] = _told([getattr(one, name) for one in noted])
        file.create_dataset("frame_number", data=np.array(indices))
        file.create_dataset("exposure_ms", data=[one.exposure_ms for one in noted])
        began_ns = noted[0].host_time_ns
        file.create_dataset("time_s", data=[(one.host_time_ns - began_ns) / 1e9 for one in noted])
        for axis in noted[0].stage_position:
            if all(axis in one.stage_position for one in noted):
                file.create_dataset(f"stage/{axis}", data=[one.stage_position[axis] for one in noted])
        lines = [json.dumps(run.records[i].to_json(), ensure_ascii=False) for i in indices]
        file.create_dataset("metadata", data=lines, dtype=h5py.string_dtype())
        file.attrs["run"] = run.path.name
        file.attrs["simulated"] = run.is_simulated
        file.attrs["provenance"] = json.dumps(run.provenance)
        if run.plan is not None:
            file.attrs["plan"] = run.plan.to_json()


def _npy(run: Run, path: Path, indices: list[int], images: Iterator[Array]) -> None:
    array = run.array
    shape = (len(indices), *array.frame_shape)
    data = np.lib.format.open_memmap(path, mode="w+", dtype=array.dtype, shape=shape)
    for place, image in enumerate(images):
        data[place] = image
    data.flush()


def _png(run: Run, folder: Path, indices: list[int], images: Iterator[Array]) -> None:
    if run.array.dtype == np.float32:
        raise RunError(run.path, "has averaged frames (float32), which PNG cannot hold. Export to .tif.")
    folder.mkdir(parents=True, exist_ok=True)
    digits = len(str(max(indices)))
    for index, image in zip(indices, images, strict=True):
        path = folder / f"frame-{index:0{digits}d}.png"
        require_new(path)
        write_image(path, image)


def _mp4(
    run: Run, path: Path, _indices: list[int], images: Iterator[Array], *, frames_per_s: float | None
) -> None:
    if frames_per_s is None:
        frames_per_s = 1 / run.frame_period_s if run.frame_period_s else 10.0
    full_scale = (1 << next(iter(run.records.values())).metadata.significant_bits) - 1
    shown = (as_shown(image.astype(np.float32), 0, full_scale) for image in images)
    write_mp4(path, shown, frames_per_s, codec="mp4v")
