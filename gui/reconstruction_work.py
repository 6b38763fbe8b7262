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
from instrument.reconstruction.checkpointing import checkpoint_for, settle_checkpoint
from instrument.reconstruction.job import Job as Prepared
from instrument.reconstruction.request import PictureRequest, VolumeRequest, done_share
from instrument.reconstruction.result_file import Outputs, write_reconstruction, write_volume
from recon.base.declare import Imports, expression
from recon.solvers.base import IterationRecord

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


@dataclass(frozen=True, slots=True)
class ReconstructionWork:
    """All that a reconstruction is asked for.

    Attributes
    ----------
    request : PictureRequest or VolumeRequest
    outputs : Outputs
    kept_in : Path or None
        The checkpoint's folder.
    rotate_deg : int
        A picture is turned by so much, counter-clockwise, when it is written.
    """

    request: PictureRequest | VolumeRequest
    outputs: Outputs
    kept_in: Path | None = None
    rotate_deg: int = 0


@dataclass(frozen=True, slots=True)
class Written:
    """The file that was written, and what became of the checkpoint, by headings."""

    path: Path
    told: dict[str, str]


def reconstruct_job(work: ReconstructionWork, context: JobContext) -> Written:
    """Do a reconstruction as the command line does; cancelled, what there is so far is written."""
    request, outputs = work.request, work.outputs
    outputs.check(0)
    prepared = request.prepare()
    n_planes = len(prepared.calibration.psfs) if isinstance(request, VolumeRequest) else 1
    outputs.check(n_planes * prepared.measurement.size)
    keeper = checkpoint_for(work.kept_in, prepared, request)
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
            context.report(
                SoFar(done_share(request.options, record), note, prepared, np.array(image), tuple(history))
            )
        shown_s = time.monotonic()
        cost_s = shown_s - now_s

    if isinstance(request, VolumeRequest):
        volume = request.solve(prepared, watch=watch, cancel=context.cancel, keeper=keeper)
        write_volume(outputs, volume, prepared)
        told = settle_checkpoint(keeper, volume.stop_reasons)
    else:
        picture = request.solve(prepared, watch=watch, cancel=context.cancel, keeper=keeper)
        write_reconstruction(outputs, picture, prepared, rotate_deg=work.rotate_deg)
        told = settle_checkpoint(keeper, [picture.stop_reason])
    return Written(outputs.image, told)


def lines_of(work: ReconstructionWork) -> str:
    """Return the Python that does a reconstruction."""
    volume = isinstance(work.request, VolumeRequest)
    write = "write_volume" if volume else "write_reconstruction"
    imports = Imports({("instrument.reconstruction.result_file", "Outputs")})
    imports.names.add((f"instrument.reconstruction.{'volume_file' if volume else 'result_file'}", write))
    lines = [f"request = {expression(work.request, imports)}", "job = request.prepare()"]
    settled: list[str] = []
    if work.kept_in is None:
        lines.append("result = request.solve(job)")
    else:
        kept = "instrument.reconstruction.checkpointing"
        imports.names |= {(kept, "checkpoint_for"), (kept, "settle_checkpoint")}
        reasons = "result.stop_reasons" if volume else "[result.stop_reason]"
        lines += [
            f"keeper = checkpoint_for({expression(work.kept_in, imports)}, job, request)",
            "result = request.solve(job, keeper=keeper)",
        ]
        settled.append(f"settle_checkpoint(keeper, {reasons})")
    named = f"Outputs.named({expression(work.outputs.image, imports)}{', volume=True' if volume else ''})"
    turned = f", rotate_deg={work.rotate_deg}" if work.rotate_deg and not volume else ""
    lines.append(f"{write}({named}, result, job{turned})")
    return "\n".join([*imports.lines(), "", *lines, *settled, ""])
