"""A volume's reconstruction from files, before the work: a stack of PSFs, one a depth, and a photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from instrument.files.calibration_file import is_calibration
from instrument.files.images import read_stack
from instrument.reconstruction.job import Job, job_from_calibration, job_with
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.preparation import darkest_block
from instrument.runs.run import STATE
from recon.types import Calibration


def volume_job(
    psfs: Path,
    image: Path,
    inputs: InputOptions,
) -> Job:
    """Prepare a photograph and PSFs at several depths.

    Parameters
    ----------
    psfs : Path
        A calibration folder or the run it lies in, a multi-page TIFF or array, or a folder with one image
        file a depth, in the order of their names (the photograph itself may lie there too). Integer PSFs lose
        their darkest level; float ones are taken to be free of any offset.
    image, inputs
        As :func:`instrument.reconstruction.job.job_from_calibration`.

    Raises
    ------
    FileError, BenchError
    """
    if psfs.is_dir() and (is_calibration(psfs) or (psfs / STATE).is_file()):  # or the run it was made in
        return job_from_calibration(psfs, image, inputs)
    stack = read_stack(psfs, leave_out=image).pixels
    pixels = stack.astype(np.float32)
    if stack.dtype.kind == "u":
        pixels = np.maximum(pixels - min(darkest_block(p) for p in pixels), 0)
    channels = pixels[:, None] if pixels.ndim == 3 else np.moveaxis(pixels, -1, 1)
    calibration = Calibration(
        np.ascontiguousarray(channels), np.full((len(pixels), 3), np.nan), provenance={"psfs": str(psfs)}
    )
    return job_with(calibration, psfs, image, inputs)
