"""One frame of the live view with the full solver, as its preview would end if it had the time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.reconstruction.preparation import bin_image
from recon import Measurement, reconstruct
from recon.errors import InputError
from recon.reconstruction.result import Reconstruction
from recon.solvers.stopping import IterationRecord
from recon.types import Calibration


def full_picture(
    image: npt.NDArray[Any],
    calibration: Calibration,
    *,
    z_um: float | None = None,
    callback: Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], None] | None = None,
    cancel: threading.Event | None = None,
) -> Reconstruction:
    """Reconstruct a frame with the default solver, at the calibration's pixels.

    Parameters
    ----------
    image : ndarray, (height, width) or (height, width, n_channels)
        Counts, of the calibration's pixels or a whole multiple of them, which is then binned to them.
    calibration : Calibration
        Its background is subtracted.
    z_um, callback, cancel
        As of :func:`recon.reconstruct`.

    Raises
    ------
    InputError
        When frame and calibration do not fit each other.
    """
    height, width = calibration.psfs.shape[-2:]
    factor = max(1, image.shape[0] // height)
    if (image.shape[0] // factor, image.shape[1] // factor) != (height, width):
        raise InputError(
            f"The frame is {image.shape[0]} x {image.shape[1]} pixels, the calibration {height} x {width}: "
            "a whole multiple is expected. Set the camera's region and binning as for the calibration."
        )
    background = None if calibration.background is None else np.moveaxis(calibration.background, 0, -1)
    return reconstruct(
        Measurement(bin_image(image, factor), background=background),
        calibration,
        z_um=z_um,
        on_progress=None if callback is None else lambda record, now: callback(record, lambda: now()[0]),
        cancel=cancel,
    )
