"""Writing a reconstructed volume: OME-TIFF or OME-Zarr with voxel sizes, a page of views, its record."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import whole_file, write_text
from instrument.files.figures import save_figure
from instrument.files.record import plain
from instrument.files.volumes import is_zarr_name, middle_step_um, uneven_steps, write_volume_zarr
from instrument.reconstruction.job import Job
from instrument.reconstruction.result_file import Outputs
from recon.reconstruction.result import Grid, Reconstruction


def write_volume(outputs: Outputs, result: Reconstruction, job: Job) -> None:
    """Write volume, page of views and record, each whole or not at all.

    A TIFF holds ``ZYX`` or ``ZCYX`` float32, an OME-Zarr ``zyx`` or ``czyx``; the name says which. OME knows
    one voxel size for all: that of the middle plane is written there; every plane's own is in the record.

    Raises
    ------
    FileError, OSError
        When a file cannot be written, naming it.
    """
    from instrument.reconstruction.result_figures import volume_figure

    if is_zarr_name(outputs.image):
        about = {"simulated": job.simulated, "record": outputs.record.name}
        write_volume_zarr(outputs.image, result.volume, result.grid, about)
    else:
        _write_tiff(outputs.image, result)
    with whole_file(outputs.preview) as temporary:
        save_figure(volume_figure(result, simulated=job.simulated), temporary)
    write_text(outputs.record, json.dumps(volume_record(result, job), indent=1, allow_nan=False) + "\n")


def _write_tiff(path: Path, result: Reconstruction) -> None:
    import tifffile

    volume = result.volume if result.volume.ndim == 3 else np.moveaxis(result.volume, -1, 1)
    metadata = {"axes": "ZYX" if result.volume.ndim == 3 else "ZCYX", **_voxel_size(result.grid)}
    with whole_file(path) as temporary:
        tifffile.imwrite(temporary, volume, ome=True, metadata=metadata, photometric="minisblack")


def volume_record(result: Reconstruction, job: Job) -> dict[str, Any]:
    """Return all that is known of a volume but its voxels, JSON-compatible."""
    record = {
        "program": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "simulated": job.simulated,
        "inputs": job.provenance,
        "model": result.model,
        "model_reason": result.reason,
        "prior": result.prior,
        "tau": result.tau,
        "background_estimated": result.background is not None,
        "noise_norm": result.noise_norm,
        "stop_reasons": [str(reason) for reason in result.stop_reasons],
        "seconds": result.seconds,
        "warnings": [*job.warnings, *result.warnings],
        "uneven_steps": uneven_steps(result.grid.z_um),
        "verdict": None if result.verdict is None else result.verdict.as_json(),
        "grid": {
            "shape": result.grid.shape,
            "centre": result.grid.centre,
            "z_um": _known(result.grid.z_um),
            "pitch_um": _known(result.grid.pitch_um),
        },
        "provenance": result.provenance,
        "histories": [[asdict(entry) for entry in history] for history in result.histories],
    }
    written: dict[str, Any] = plain(record)
    return written


def _known(values: np.ndarray[Any, Any]) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None


def _voxel_size(grid: Grid) -> dict[str, Any]:
    if not (np.isfinite(grid.pitch_um).all() and np.isfinite(grid.spacing_um).all()):
        return {}
    middle = len(grid.z_um) // 2
    sizes = {
        "X": float(grid.pitch_um[middle]),
        "Y": float(grid.pitch_um[middle]),
        "Z": middle_step_um(grid.z_um),
    }
    lengths = {f"PhysicalSize{axis}": value for axis, value in sizes.items()}
    return lengths | {f"PhysicalSize{axis}Unit": "µm" for axis in sizes}
