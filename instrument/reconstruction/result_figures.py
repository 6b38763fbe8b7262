"""Views and figures of results: a volume as a whole, its brightest voxels, depth as colour; a summary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.seen import as_seen, srgb
from instrument.reconstruction.job import Job
from instrument.volumes.source import VolumeSource
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_sum
from recon.reconstruction.result import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Grey = Float32Array


@dataclass(frozen=True, slots=True)
class Projections:
    """Brightest voxels along each axis; of colour volumes, of the channels' mean."""

    front: Grey
    """float32, (height, width): over depth."""
    deepest: npt.NDArray[np.int32]
    """int32, (height, width): the plane in which the brightest voxel of ``front`` lies."""
    top: Grey
    """float32, (n_z, width): over y."""
    side: Grey
    """float32, (n_z, height): over x."""


def project(source: VolumeSource, advance: Callable[[int, int], object] | None = None) -> Projections:
    """Return the brightest voxels along each axis, with one plane in memory at a time.

    ``advance``: ``advance(planes done, planes)`` after each plane; may raise to end the work.

    Raises FileError when the volume cannot be read.
    """
    n_z, height, width = source.shape
    front = np.full((height, width), -np.inf, np.float32)
    deepest = np.zeros((height, width), np.int32)
    top, side = np.empty((n_z, width), np.float32), np.empty((n_z, height), np.float32)
    for z in range(n_z):
        plane = grey(source.plane(z))
        nearer = plane > front
        np.maximum(front, plane, out=front)
        deepest[nearer] = z
        plane.max(axis=0, out=top[z])
        plane.max(axis=1, out=side[z])
        if advance is not None:
            advance(z + 1, n_z)
    return Projections(front, deepest, top, side)


def grey(plane: Grey) -> Grey:
    """Return the channels' mean of a colour plane; a grey one as it is."""
    return plane if plane.ndim == 2 else plane.mean(axis=-1, dtype=np.float32)


def in_colour_of_depth(front: Grey, deepest: npt.NDArray[np.integer], n_z: int, white: float) -> Float64Array:
    """Return the brightest voxels over depth, (height, width, 3) in 0 to 1, their hue by their depth.

    Blue is the first plane, red the last. ``white`` is the value shown at full brightness.
    """
    from matplotlib import colormaps

    hue = colormaps["turbo"](0.1 + 0.8 * np.arange(n_z) / max(n_z - 1, 1))[:, :3]
    shown: Float64Array = hue[deepest] * (front / white).clip(0, 1)[..., None]
    return shown


def volume_seen(volume: Grey) -> npt.NDArray[np.uint8]:
    """Return a volume (n_z, height, width[, n_channels]) for a screen: brightest over depth, depth as hue."""
    grey_volume = volume if volume.ndim == 3 else volume.mean(axis=-1)
    front = grey_volume.max(axis=0)
    coloured = in_colour_of_depth(front, grey_volume.argmax(axis=0), len(volume), _white(front))
    return np.asarray(np.round(255 * srgb(coloured)), np.uint8)


_SLICES = 3
_WHITE_PERCENTILE = 99.8


def lightest(volume: Grey) -> list[int]:
    """Return the planes that hold most of a volume's light (n_z, height, width), in their order."""
    return sorted(np.argsort(-volume.sum(axis=(1, 2)), kind="stable")[:_SLICES].tolist())


def volume_figure(result: Reconstruction, *, simulated: bool = False) -> Figure:
    """Draw a volume: brightest over each axis, depth as colour, slices, and how the solver converged."""
    from matplotlib.figure import Figure  # costs half a second; only who draws pays

    volume = result.volume if result.volume.ndim == 3 else result.volume.mean(axis=-1)
    figure = Figure(figsize=(15, 8), layout="constrained")
    title = f"{'SIMULATED   ' if simulated else ''}{result.model} model, prior {result.prior}"
    figure.suptitle(title)
    axes = figure.subplots(2, 4)
    front, side, top = (volume.max(axis=a) for a in (0, 2, 1))
    white = _white(front)
    axes[0, 0].imshow(srgb(front / white), cmap="gray", vmin=0, vmax=1)
    axes[0, 0].set(title="brightest over depth", xlabel="x (pixels)", ylabel="y (pixels)")
    axes[0, 1].imshow(srgb(in_colour_of_depth(front, volume.argmax(axis=0), len(volume), white)))
    axes[0, 1].set(title="depth as colour: blue first, red last", xlabel="x (pixels)")
    axes[0, 2].imshow(top, cmap="magma", aspect="auto", vmin=0, vmax=_white(top), interpolation="nearest")
    axes[0, 2].set(title="brightest over y", xlabel="x (pixels)", ylabel="depth plane")
    axes[0, 3].imshow(side.T, cmap="magma", aspect="auto", vmin=0, vmax=_white(side), interpolation="nearest")
    axes[0, 3].set(title="brightest over x", xlabel="depth plane", ylabel="y (pixels)")
    planes = lightest(volume)
    strip = np.concatenate([volume[z] for z in planes], axis=1)
    grid = axes[1, 0].get_gridspec()
    for axis in axes[1, :3]:
        axis.remove()
    slices = figure.add_subplot(grid[1, :3])
    slices.imshow(srgb(strip / white), cmap="gray", vmin=0, vmax=1)
    slices.set(title="planes " + ", ".join(_depth(result, z) for z in planes))
    slices.axis("off")
    for channel, history in enumerate(result.histories):
        iterations = [r.iteration for r in history]
        axes[1, 3].loglog(iterations, [r.data_residual for r in history], label=f"channel {channel}")
    axes[1, 3].axhline(result.noise_norm, color="grey", linestyle="--", label="expected noise")
    axes[1, 3].set(title="data residual (noise = 1 a pixel)", xlabel="iteration")
    axes[1, 3].legend()
    return figure


def _white(image: Float32Array) -> float:
    level = float(np.percentile(image, _WHITE_PERCENTILE))
    return level if level > 0 else max(float(image.max()), 1e-30)


def _depth(result: Reconstruction, plane: int) -> str:
    z_um = result.grid.z_um[plane]
    return f"{plane}" if not np.isfinite(z_um) else f"{plane} (z = {z_um / 1000:.2f} mm)"


def write_figure(path: Path, result: Reconstruction, job: Job, *, rotate_deg: int = 0) -> None:
    """Draw the figure and write it whole or not at all, in the format of the suffix.

    ``rotate_deg``, a multiple of 90, turns the picture counter-clockwise.

    Raises FileError or OSError when it cannot be written.
    """
    save_figure(picture_figure(result, job, rotate_deg=rotate_deg), path)


def picture_figure(result: Reconstruction, job: Job, *, rotate_deg: int = 0) -> Figure:
    """Draw PSF, photograph and picture, how the solver converged, and facts."""
    return summary_figure(_summary(result, job, rotate_deg))


def _summary(result: Reconstruction, job: Job, rotate_deg: int) -> Summary:
    psf = np.moveaxis(job.calibration.psfs[_used_psf(result, job)], 0, -1)
    image = np.rot90(result.image, rotate_deg // 90)
    height, width = image.shape[:2]
    panels = (
        Panel("PSF", _shown(psf[..., 0] if psf.shape[-1] == 1 else psf), gamma=0.5, caption="square root"),
        Panel("Photograph", _on_screen(photographed(job)), caption="dark level subtracted", white=1.0),
        Panel("Reconstruction", _on_screen(image), caption=f"{height} x {width}", white=1.0),
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


def photographed(job: Job) -> Float32Array:
    """Return the photograph to be shown: a colour mosaic's pixels count for their own colour, a cell each."""
    image, valid = job.measurement, job.valid
    mosaic = None if job.reduction is None else job.reduction.mosaic
    if mosaic is None or valid is None or valid.all() or min(image.shape[:2]) < 2:
        return image
    measured = block_sum(np.moveaxis(valid, -1, 0), 2)
    light = block_sum(np.moveaxis(np.where(valid, image, 0), -1, 0), 2)
    cells = np.asarray(light / np.maximum(measured, 1), np.float32)
    return np.moveaxis(cells, 0, -1)


def _on_screen(image: Float32Array) -> Float64Array:
    return as_seen(image) / 255.0


def _shown(image: Float32Array) -> Float32Array:
    return np.maximum(image, 0)


def _convergence(result: Reconstruction) -> Convergence:
    known = [(r.seconds, r.change) for r in result.history if r.change > 0]
    if not known:
        return Convergence((), (), "one shot: no iterations")
    seconds, changes = zip(*known, strict=True)
    return Convergence(seconds, changes, "relative change per iteration", log=True)
