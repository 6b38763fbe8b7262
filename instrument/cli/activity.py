"""``diffuserbench activity``: fluorescence over time."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples, saying_what_is_left
from instrument.cli.reconstruct_options import BinningOption, CalibrationOption, DistanceOption, PsfOption
from instrument.files.errors import BenchError, FileError
from instrument.files.volume_zarr import is_zarr_name
from instrument.reconstruction.activity import ActivitySettings, find_activity, write_activity
from instrument.reconstruction.request import Settings
from instrument.reconstruction.video_output import VideoPictures
from instrument.reconstruction.words import parse_binning
from instrument.runs.layout import STATE

app = App()

WARM_ITERATIONS = 6
"""Of a recording reconstructed on the way: with a video's usual 4, a quarter of simulated neurons is lost."""


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
    psf: PsfOption = None,
    calibration: CalibrationOption = None,
    z_mm: DistanceOption = None,
    binning: BinningOption = "auto",
    window_s: Annotated[
        float,
        typer.Option("--window", min=0.0, metavar="S", help="Of the sliding baseline, seconds."),
    ] = 30.0,
    percentile: Annotated[
        float, typer.Option("--percentile", min=0.0, max=100.0, help="Of a window that is the baseline.")
    ] = 20.0,
    align: Annotated[bool, typer.Option("--align", help="Move frames back to one place first.")] = False,
    least_correlation: Annotated[
        float,
        typer.Option("--correlation", min=0.0, max=1.0, help="Local correlation from which a region begins."),
    ] = 0.5,
    radius_px: Annotated[
        float, typer.Option("--radius", min=1.0, metavar="PX", help="As far as a region reaches.")
    ] = 8.0,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="Made by this.")] = Path(
        "activity"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace what is in the folder.")] = False,
) -> None:
    """Find what is active in a video: baseline, dF/F, regions, traces, and a film with activity in red.

    The baseline of a pixel is the 20th percentile of its last and next seconds; regions are where neighbours
    change together.
    """
    if (out / "activity.json").exists() and not force:
        raise FileError(out, "holds results already.", "Choose another folder with --out, or --force.")
    if out.exists() and not out.is_dir():
        raise FileError(out, "is no folder.")
    with saying_what_is_left(out):
        pictures = _video(video, psf, calibration, z_mm, binning, out, force)
        warm = pictures.attributes.get("diffuserbench", {}).get("warm_iterations")
        if warm is not None and warm < WARM_ITERATIONS:
            typer.echo(
                f"Warning: this video has {warm} warm iterations a frame. With fewer than {WARM_ITERATIONS} "
                f"some of what is active is missed: reconstruct it with --warm {WARM_ITERATIONS}.",
                err=True,
            )
        settings = ActivitySettings(
            window_s=window_s,
            percentile=percentile,
            align=align,
            least_correlation=least_correlation,
            radius_px=radius_px,
        )
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        found = find_activity(pictures, settings, free_bytes=free)
        typer.echo(f"{'Frames':<12}{len(found.indices)} of {pictures.path}")
        typer.echo(
            f"{'Motion':<12}up to {found.motion.largest_px:.2f} pixels" + (", taken out" if align else "")
        )
        if not found.motion.is_still and not align:
            typer.echo(
                "Warning: frames move by half a pixel or more: edges look active. Try --align.", err=True
            )
        typer.echo(f"{'Bleaching':<12}{_fading(found.faded)}")
        typer.echo(f"{'Regions':<12}{len(found.regions)}")
        if not found.regions:
            typer.echo("Warning: no region found; lower --correlation, or is nothing active?", err=True)
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, write_activity(found, pictures, out, settings)))}")


def _fading(share: float) -> str:
    percent = round(100 * share)
    if percent == 0:
        return "none: the field's light does not fade"
    what = "fades" if percent > 0 else "grows"
    return f"the field's light {what} by {abs(percent)} % in all; taken out of the baseline"


def _video(
    path: Path,
    psf: Path | None,
    calibration: Path | None,
    z_mm: float | None,
    binning: str,
    out: Path,
    force: bool,
) -> VideoPictures:
    """Return the video that ``path`` is, or reconstruct the recording that it is."""
    if not path.exists():
        raise FileError(path, "does not exist; a video of 'reconstruct --video' or a run is expected.")
    if is_zarr_name(path):
        if psf is not None or calibration is not None:
            raise BenchError("--psf and --calibration are for recordings; this is a reconstructed video.")
        return opened(path)
    if not (path / STATE).exists():
        raise FileError(path, "is neither a reconstructed video (.ome.zarr) nor a run.")
    from instrument.cli.video import reconstruct_to_video
    from instrument.reconstruction.video import VideoRequest

    out.mkdir(parents=True, exist_ok=True)
    request = VideoRequest(
        run=path,
        out=out / "video.ome.zarr",
        psf=psf,
        calibration=calibration,
        z_um=None if z_mm is None else 1e3 * z_mm,
        settings=Settings(binning=parse_binning(binning)),
        warm_iterations=WARM_ITERATIONS,
    )
    reconstruct_to_video(request, workers=None, scheduler=None, force=force)
    return opened(request.out)


def opened(path: Path) -> VideoPictures:
    """Open a video; FileError where it is something else."""
    try:
        video = VideoPictures(path)
        if (
            video.array.ndim not in (3, 4)
            or video.attributes["ome"]["multiscales"][0]["axes"][0]["name"] != "t"
        ):
            raise KeyError("t")
    except (FileNotFoundError, KeyError, IndexError, ValueError, TypeError) as error:
        raise FileError(path, "is no video of 'reconstruct --video'.", "See docs/video.md.") from error
    return video
