"""The summary figure of a reconstruction from files: PSF, photograph, picture, convergence, settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.reconstruction.job import Job
from recon.reconstruction.result import Reconstruction


def write_figure(path: Path, result: Reconstruction, job: Job, *, rotate_deg: int = 0) -> None:
    """Draw the figure and write it whole or not at all, in the format of the suffix.

    ``rotate_deg``, a multiple of 90, turns the picture counter-clockwise.

    Raises
    ------
    FileError, OSError
        When it cannot be written.
    """
    with whole_file(path) as temporary:
        save_figure(summary_figure(_summary(result, job, rotate_deg)), temporary)


def _summary(result: Reconstruction, job: Job, rotate_deg: int) -> Summary:
    psf = np.moveaxis(job.calibration.psfs[_used_psf(result, job)], 0, -1)
    image = np.rot90(result.image, rotate_deg // 90)
    height, width = image.shape[:2]
    panels = (
        Panel("PSF", _shown(psf[..., 0] if psf.shape[-1] == 1 else psf), gamma=0.5, caption="square root"),
        Panel("Photograph", _shown(job.measurement), caption="dark level subtracted"),
        Panel("Reconstruction", _shown(image), caption=f"{height} x {width}"),
    )
    facts = [("method", result.solver), ("prior", result.prior)]
    if result.tau is not None:
        facts.append(("tau", f"{result.tau:.3g}"))
    facts.append(("stopped", str(result.stop_reason)))
    facts.append(("time", f"{result.seconds:.1f} s"))
    return Summary("Reconstruction", panels, _convergence(result), lines=facts, simulated=job.simulated)


def _used_psf(result: Reconstruction, job: Job) -> int:
    """Return which of the calibration's PSFs the reconstruction took."""
    z_um = result.provenance.get("psf_z_um")
    return 0 if z_um is None else int(np.argmin(np.abs(job.calibration.source_positions_um[:, 2] - z_um)))


def _shown(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return np.maximum(image, 0)


def _convergence(result: Reconstruction) -> Convergence:
    known = [(r.seconds, r.change) for r in result.history if r.change > 0]
    if not known:
        return Convergence((), (), "one shot: no iterations")
    seconds, changes = zip(*known, strict=True)
    return Convergence(seconds, changes, "relative change per iteration", log=True)
