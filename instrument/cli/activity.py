"""``diffuserbench activity``: fluorescence over time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.files.errors import BenchError, FileError
from instrument.files.volumes import is_zarr_name
from instrument.reconstruction.activity import ActivitySettings, find_activity, write_activity
from instrument.reconstruction.options import InputOptions, SourceOptions, VideoOptions
from instrument.reconstruction.video_files import VideoPictures
from instrument.runs.run_files import STATE
from instrument.tasks.task import Only, saying_what_is_left
from recon.base.declare import option
from recon.reconstruction.options import ReconstructionOptions

app = App()

WARM_ITERATIONS = 6
"""Of a recording reconstructed on the way: with a video's usual 4, a quarter of simulated neurons is lost."""


@dataclass(frozen=True, kw_only=True)
class ActivityFiles:
    """Where results go."""

    out: Path = option(
        Path("activity"), help="Made by this.", metavar="FOLDER", flags=("--out", "-o"), group="Files"
    )
    force: bool = option(False, help="Replace what is in the folder.", group="Files")


@app.command(
    epilog=examples(
        "diffuserbench activity film.ome.zarr",
        "diffuserbench activity film.ome.zarr --window 60 --align --out fish/",
        "diffuserbench activity runs/2026-11-21-recording --calibration runs/2026-11-20-axial --z-mm 2.2",
    )
)
def activity(
    video: Annotated[
        Path,
        typer.Argument(
            metavar="VIDEO|RUN",
            help="A video of reconstruct --video, or a recording (then with --calibration).",
        ),
    ],
    settings: ActivitySettings,
    files: ActivityFiles,
    source: Annotated[SourceOptions, Only("psf", "calibration")],
    inputs: Annotated[InputOptions, Only("binning")],
    scene: Annotated[ReconstructionOptions, Only("z_um")],
) -> None:
    """Find what is active in a video: baseline, dF/F, regions, traces, and a film with activity in red.

    The baseline of a pixel is the 20th percentile of its last and next seconds; regions are where neighbours
    change together.
    """
    out = files.out
    if (out / "activity.json").exists() and not files.force:
        raise FileError(out, "holds results already.", "Choose another folder with --out, or --force.")
    if out.exists() and not out.is_dir():
        raise FileError(out, "is no folder.")
    with saying_what_is_left(out):
        pictures = _video(video, source, inputs, scene, files)
        warm = pictures.attributes.get("diffuserbench", {}).get("warm_iterations")
        if warm is not None and warm < WARM_ITERATIONS:
            typer.echo(
                f"Warning: this video has {warm} warm iterations a frame. With fewer than {WARM_ITERATIONS} "
                f"some of what is active is missed: reconstruct it with --warm {WARM_ITERATIONS}.",
                err=True,
            )
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        found = find_activity(pictures, settings, free_bytes=free)
        typer.echo(f"{'Frames':<12}{len(found.indices)} of {pictures.path}")
        typer.echo(
            f"{'Motion':<12}up to {found.motion.largest_px:.2f} pixels"
            + (", taken out" if settings.align else "")
        )
        if not found.motion.is_still and not settings.align:
            typer.echo(
                "Warning: frames move by half a pixel or more: edges look active. Try --align.", err=True
            )
        if found.still_moving_px:
            typer.echo(
                f"Warning: moved back, frames still move by up to {found.still_moving_px:.1f} pixels: what "
                "turns, stretches or leaves the field has no place of its own. No region is looked for.",
                err=True,
            )
        typer.echo(f"{'Bleaching':<12}{_fading(found.faded)}")
        typer.echo(f"{'Regions':<12}{len(found.regions)}")
        left_out = found.search.left_out
        if left_out:
            told = (f"{count} that {what}" for what, count in left_out.items())
            typer.echo(f"{'Left out':<12}places whose neighbours go together: {', '.join(told)}")
        if not found.regions:
            typer.echo(
                "Warning: no region found: nothing is active here, or too weakly. A lower --correlation or "
                "more light may show it.",
                err=True,
            )
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, write_activity(found, pictures, out, settings)))}")


def _fading(share: float) -> str:
    percent = round(100 * share)
    if percent == 0:
        return "none: the field's light does not fade"
    what = "fades" if percent > 0 else "grows"
    return f"the field's light {what} by {abs(percent)} % in all; taken out of the baseline"


def _video(
    path: Path,
    source: SourceOptions,
    inputs: InputOptions,
    scene: ReconstructionOptions,
    files: ActivityFiles,
) -> VideoPictures:
    """Return the video that ``path`` is, or reconstruct the recording that it is."""
    if not path.exists():
        raise FileError(path, "does not exist; a video of 'reconstruct --video' or a run is expected.")
    if is_zarr_name(path):
        if source != SourceOptions():
            raise BenchError("--psf and --calibration are for recordings; this is a reconstructed video.")
        return opened(path)
    if not (path / STATE).exists():
        raise FileError(path, "is neither a reconstructed video (.ome.zarr) nor a run.")
    from instrument.cli.solving import reconstruct_to_video
    from instrument.reconstruction.video import VideoRequest

    files.out.mkdir(parents=True, exist_ok=True)
    request = VideoRequest(
        run=path,
        out=files.out / "video.ome.zarr",
        psf=source.psf,
        calibration=source.calibration,
        inputs=inputs,
        options=scene,
        video=VideoOptions(warm_iterations=WARM_ITERATIONS),
    )
    reconstruct_to_video(request, force=files.force)
    return opened(request.out)


def opened(path: Path) -> VideoPictures:
    """Open a video; FileError where it is something else."""
    try:
        video = VideoPictures(path)
        if video.axes not in ("tyx", "tcyx", "tzyx", "tczyx"):
            raise KeyError("t")
    except (FileNotFoundError, KeyError, IndexError, ValueError, TypeError) as error:
        raise FileError(path, "is no video of 'reconstruct --video'.", "See docs/video.md.") from error
    return video
