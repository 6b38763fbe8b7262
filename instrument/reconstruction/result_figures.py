"""Figures of results: a picture's summary (PSF, photograph, picture, convergence), a volume's views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.reconstruction.job import Job
from instrument.reconstruction.volume_views import in_colour_of_depth
from recon.reconstruction.result import Reconstruction

_SLICES = 4
_WHITE_PERCENTILE = 99.8


def volume_figure(result: Reconstruction, *, simulated: bool = False) -> Figure:
    """Draw a volume: brightest over each axis, depth as colour, slices, and how the solver converged."""
    volume = result.volume if result.volume.ndim == 3 else result.volume.mean(axis=-1)
    figure = Figure(figsize=(15, 8), layout="constrained")
    title = f"{'SIMULATED   ' if simulated else ''}{result.model} model, prior {result.prior}"
    figure.suptitle(title)
    axes = figure.subplots(2, 4)
    front, side, top = (volume.max(axis=a) for a in (0, 2, 1))
    white = _white(front)
    axes[0, 0].imshow(front, cmap="gray", vmin=0, vmax=white)
    axes[0, 0].set(title="brightest over depth", xlabel="x (pixels)", ylabel="y (pixels)")
    axes[0, 1].imshow(in_colour_of_depth(front, volume.argmax(axis=0), len(volume), white))
    axes[0, 1].set(title="depth as colour: blue first, red last", xlabel="x (pixels)")
    axes[0, 2].imshow(top, cmap="magma", aspect="auto", vmin=0, vmax=_white(top), interpolation="nearest")
    axes[0, 2].set(title="brightest over y", xlabel="x (pixels)", ylabel="depth plane")
    axes[0, 3].imshow(side.T, cmap="magma", aspect="auto", vmin=0, vmax=_white(side), interpolation="nearest")
    axes[0, 3].set(title="brightest over x", xlabel="depth plane", ylabel="y (pixels)")
    planes = np.unique(np.linspace(0, len(volume) - 1, _SLICES + 1).round().astype(int)[1:])
    strip = np.concatenate([volume[z] for z in planes[: _SLICES - 1]], axis=1)
    grid = axes[1, 0].get_gridspec()
    for axis in axes[1, :3]:
        axis.remove()
    slices = figure.add_subplot(grid[1, :3])
    slices.imshow(strip, cmap="gray", vmin=0, vmax=white)
    slices.set(title="planes " + ", ".join(_depth(result, z) for z in planes[: _SLICES - 1]))
    slices.axis("off")
    for channel, history in enumerate(result.histories):
        iterations = [r.iteration for r in history]
        axes[1, 3].loglog(iterations, [r.data_residual for r in history], label=f"channel {channel}")
    axes[1, 3].axhline(result.noise_norm, color="grey", linestyle="--", label="expected noise")
    axes[1, 3].set(title="data residual (noise = 1 a pixel)", xlabel="iteration")
    axes[1, 3].legend()
    return figure


def _white(image: npt.NDArray[np.float32]) -> float:
    level = float(np.percentile(image, _WHITE_PERCENTILE))
    return level if level > 0 else max(float(image.max()), 1e-30)


def _depth(result: Reconstruction, plane: int) -> str:
    z_um = result.grid.z_um[plane]
    return f"{plane}" if not np.isfinite(z_um) else f"{plane} (z = {z_um / 1000:.2f} mm)"


def write_figure(path: Path, result: Reconstruction, job: Job, *, rotate_deg: int = 0) -> None:
    """Draw the figure and write it whole or not at all, in the format of the suffix.

    ``rotate_deg``, a multiple of 90, turns the picture counter-clockwise.

    Raises
    ------
    FileError, OSError
        When it cannot be written.
    """
    save_figure(summary_figure(_summary(result, job, rotate_deg)), path)


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
