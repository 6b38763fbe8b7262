"""A volume's reconstruction from files, before the work: a stack of PSFs, one a depth, and a photograph."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.calibration_file import is_calibration
from instrument.erasures import Choice
from instrument.errors import FileError
from instrument.images import ImageFile, read_image, read_stack
from instrument.preparation import Crop, darkest_block
from instrument.reconstruction_job import DarkChoice, Job, job_from_calibration, job_with
from recon.types import Calibration

SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".npy")


def volume_job(
    psfs: Path,
    image: Path,
    *,
    dark: DarkChoice = "auto",
    crop: Crop | None = None,
    binning: int | None = None,
    erasures: Choice = "saturated",
) -> Job:
    """Prepare a photograph and PSFs at several depths.

    Parameters
    ----------
    psfs : Path
        A calibration folder, a multi-page TIFF or array, or a folder with one image file a depth, in the
        order of their names (the photograph itself may lie there too). Integer PSFs lose their darkest
        level; float ones are taken to be free of any offset.
    image, dark, crop, binning, erasures
        As :func:`instrument.reconstruction_job.job_from_calibration`.

    Raises
    ------
    FileError, BenchError
    """
    if psfs.is_dir() and is_calibration(psfs):
        return job_from_calibration(psfs, image, dark=dark, crop=crop, binning=binning, erasures=erasures)
    stack = _stack(psfs, image)
    pixels = stack.astype(np.float32)
    if stack.dtype.kind == "u":
        pixels = np.maximum(pixels - min(darkest_block(p) for p in pixels), 0)
    channels = pixels[:, None] if pixels.ndim == 3 else np.moveaxis(pixels, -1, 1)
    calibration = Calibration(
        np.ascontiguousarray(channels), np.full((len(pixels), 3), np.nan), provenance={"psfs": str(psfs)}
    )
    return job_with(calibration, psfs, image, dark=dark, crop=crop, binning=binning, erasures=erasures)


def _stack(psfs: Path, image: Path) -> npt.NDArray[Any]:
    if not psfs.is_dir():
        return read_stack(psfs).pixels
    files = sorted(p for p in psfs.iterdir() if p.suffix.lower() in SUFFIXES)
    files = [p for p in files if p.resolve() != image.resolve()]
    if not files:
        raise FileError(
            psfs, f"holds no PSF images ({', '.join(SUFFIXES)}).", "One file a depth is expected."
        )
    images: list[ImageFile] = [read_image(p) for p in files]
    for other in images[1:]:
        if other.pixels.shape != images[0].pixels.shape or other.pixels.dtype != images[0].pixels.dtype:
            raise FileError(
                other.path, f"is {other.describe()}, but {images[0].path} is {images[0].describe()}."
            )
    return np.stack([i.pixels for i in images])
