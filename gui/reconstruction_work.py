"""A reconstruction as a job: prepared, solved, written, and shown on the way."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gui.jobs import JobCancelledError, JobContext
from instrument.reconstruction_file import Outputs, write_reconstruction
from instrument.reconstruction_job import Job as Prepared
from instrument.reconstruction_request import PictureRequest, VolumeRequest
from instrument.volume_file import write_volume
from recon.solvers.stopping import IterationRecord

_INTERVAL_S = 0.5
"""What there is so far is shown this often, at most."""
_SHARE = 0.1
"""At most this part of the time goes into making pictures on the way."""


@dataclass(frozen=True, slots=True)
class SoFar:
    """How far a reconstruction is.

    Attributes
    ----------
    share : float
        Of the work that is done, 0 to 1.
    note : str
    prepared : Prepared
        What went in, and what was chosen on the way, in words.
    image : ndarray, float32, or None
        The picture so far; of a volume the brightest over depth.
    history : tuple of IterationRecord
    """

    share: float
    note: str
    prepared: Prepared
    image: npt.NDArray[np.float32] | None = None
    history: tuple[IterationRecord, ...] = ()


def reconstruct_job(request: PictureRequest | VolumeRequest, outputs: Outputs, context: JobContext) -> Path:
    """Do a reconstruction as the command line does; cancelled, what there is so far is written.

    Returns
    -------
    Path
        The image's or volume's file.
    """
    outputs.check(0)
    prepared = request.prepare()
    n_planes = len(prepared.calibration.psfs) if isinstance(request, VolumeRequest) else 1
    outputs.check(n_planes * prepared.measurement.size)
    context.report(SoFar(0.0, "Solving …", prepared))
    history: list[IterationRecord] = []
    shown_s, cost_s = time.monotonic(), 0.0

    def watch(record: IterationRecord, present: Callable[[], npt.NDArray[np.float32]]) -> None:
        nonlocal shown_s, cost_s
        history.append(record)
        now_s = time.monotonic()
        if now_s - shown_s < max(_INTERVAL_S, cost_s / _SHARE):
            return
        image = present()
        if isinstance(request, VolumeRequest):
            image = image.max(axis=0)
        note = f"iteration {record.iteration}, change {record.change:.1e}"
        with contextlib.suppress(
            JobCancelledError
        ):  # the solver hears of it by itself, and keeps what it has
            context.report(SoFar(request.share(record), note, prepared, np.array(image), tuple(history)))
        shown_s = time.monotonic()
        cost_s = shown_s - now_s

    if isinstance(request, VolumeRequest):
        write_volume(outputs, request.solve(prepared, watch=watch, cancel=context.cancel), prepared)
    else:
        write_reconstruction(outputs, request.solve(prepared, watch=watch, cancel=context.cancel), prepared)
    return outputs.image
