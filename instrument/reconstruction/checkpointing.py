"""A reconstruction that is kept while it runs, and gone on with: the folder that fits a request."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from instrument.files.checkpoint import CheckpointFolder, digest
from instrument.files.errors import BenchError
from instrument.reconstruction.job import Job
from instrument.reconstruction.request import PictureRequest, VolumeRequest
from recon.base.declare import identity
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import StopReason

_FINISHED = (StopReason.CONVERGED, StopReason.NOISE_LEVEL)


def require_kept(request: PictureRequest | VolumeRequest) -> None:
    """Refuse to keep what has no iterations.

    Raises
    ------
    BenchError
    """
    solver = request.options.solver
    if solver != "auto" and SOLVERS.named(solver).one_step:
        raise BenchError(f"{solver} is one shot: --checkpoint does not apply to it.")


def checkpoint_for(
    folder: Path | None, job: Job, request: PictureRequest | VolumeRequest
) -> CheckpointFolder | None:
    """Return the folder that was asked for, checked against what is to be reconstructed.

    What only says when to stop may differ from the earlier run.

    Raises
    ------
    BenchError
        As :func:`require_kept`.
    FileError
        When the folder keeps something else.
    """
    if folder is None:
        return None
    require_kept(request)
    problem = {
        "program": f"diffuserbench {version('diffuserbench')}",
        "measurement": digest(job.measurement),
        "psfs": digest(job.calibration.psfs),
        "psf positions": digest(job.calibration.source_positions_um),
        "valid pixels": digest(job.valid),
        **identity(request.options),
        # As it will be used: the photograph's metadata may have told it.
        "noise": str(job.binned_noise(request.inputs.noise)),
    }
    return CheckpointFolder(folder, problem)


def settle_checkpoint(
    keeper: CheckpointFolder | None, reasons: Sequence[StopReason | None]
) -> dict[str, str]:
    """Remove a checkpoint whose work has come to its end; return what is to be told of it, by headings.

    To be called once the result is written: until then the checkpoint is all that there is of it.
    """
    told: dict[str, str] = {}
    if keeper is None:
        return told
    if keeper.resumed_from:
        told["Went on"] = f"from iteration {keeper.resumed_from} in {keeper.folder}"
    if all(reason in _FINISHED for reason in reasons):
        keeper.remove()
        told["Checkpoint"] = "removed: the work has come to its end"
    else:
        told["Checkpoint"] = f"{keeper.folder}: the same again, with more time, goes on from it"
    return told
