"""Fluorescence over time in a video, or in a recording that is reconstructed on the way."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from instrument.files.errors import BenchError, FileError
from instrument.files.ome_zarr import is_zarr_name
from instrument.reconstruction.activity import ActivitySettings, find_activity, require_frames, write_activity
from instrument.reconstruction.film import open_video
from instrument.reconstruction.options import InputOptions, SourceOptions, VideoOptions
from instrument.reconstruction.video import VideoRequest
from instrument.runs.run import Run
from instrument.runs.run_files import STATE
from instrument.tasks.task import Desk, Done, Only, saying_what_is_left, task
from instrument.tasks.video import make_video
from recon.base.declare import option
from recon.reconstruction.options import ReconstructionOptions

_VIDEO = "video.ome.zarr"
WARM_ITERATIONS = 6
"""Of a recording reconstructed on the way: with a video's usual 4, a quarter of simulated neurons is lost."""


@dataclass(frozen=True, kw_only=True)
class ActivityFiles:
    """What is looked at, and where results go."""

    video: Path = option(
        help="A reconstructed video, or a recording (then with --calibration).",
        metavar="VIDEO|RUN",
        positional=True,
        group="Files",
    )
    out: Path = option(
        Path("activity"),
        help="Made by this.",
        metavar="FOLDER",
        flags=("--out", "-o"),
        label="Result",
        group="Files",
    )
    force: bool = option(False, help="Replace what is in the folder.", label="Overwrite", group="Files")


@task(
    "diffuserbench activity film.ome.zarr",
    "diffuserbench activity film.ome.zarr --window 60 --align --out fish/",
    "diffuserbench activity runs/2026-11-21-recording --calibration runs/2026-11-20-axial --z-mm 2.2",
)
def activity(
    desk: Desk,
    settings: ActivitySettings,
    files: ActivityFiles,
    source: Annotated[SourceOptions, Only("psf", "calibration")],
    inputs: Annotated[InputOptions, Only("binning")],
    scene: Annotated[ReconstructionOptions, Only("z_um")],
) -> Done:
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
        if is_recording := _is_recording(files.video, source):
            require_frames(files.video, len(Run.open(files.video).records))  # before minutes of solving
            made = make_video(desk, _request(files, source, inputs, scene), force=files.force)
            if made.kept:
                return made
        pictures = open_video(files.out / _VIDEO if is_recording else files.video)
        warm = pictures.attributes.get("diffuserbench", {}).get("warm_iterations")
        if warm is not None and warm < WARM_ITERATIONS:
            desk.warn(
                f"Warning: this video has {warm} warm iterations a frame. With fewer than {WARM_ITERATIONS} "
                f"some of what is active is missed: reconstruct the recording with {WARM_ITERATIONS} or more "
                "('reconstruct --video --warm')."
            )
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        with desk.step("looking for activity"):
            found = find_activity(pictures, settings, free_bytes=free)
        desk.fact("Frames", f"{len(found.indices)} of {pictures.path}")
        taken_out = ", taken out" if settings.align else ""
        desk.fact("Motion", f"up to {found.motion.largest_px:.2f} pixels{taken_out}")
        if not found.motion.is_still and not settings.align:
            desk.warn("Warning: frames move by half a pixel or more: edges look active. Try --align.")
        if found.still_moving_px:
            desk.warn(
                f"Warning: moved back, frames still move by up to {found.still_moving_px:.1f} pixels: what "
                "turns, stretches or leaves the field has no place of its own. No region is looked for."
            )
        desk.fact("Bleaching", _fading(found.faded))
        desk.fact("Regions", str(len(found.regions)))
        left_out = found.search.left_out
        if left_out:
            told = (f"{count} that {what}" for what, count in left_out.items())
            desk.fact("Left out", f"places whose neighbours go together: {', '.join(told)}")
        if not found.regions:
            desk.warn(
                "Warning: no region found: nothing is active here, or too weakly. Where cells are a few "
                "pixels wide, --smooth 1.5 shows them; else a lower --correlation or more light may."
            )
        with desk.step("writing"):
            written = write_activity(found, pictures, out, settings)
        return Done(tuple(written))


def _fading(share: float) -> str:
    percent = round(100 * share)
    if percent == 0:
        return "none: the field's light does not fade"
    what = "fades" if percent > 0 else "grows"
    return f"the field's light {what} by {abs(percent)} % in all; taken out of the baseline"


def _is_recording(path: Path, source: SourceOptions) -> bool:
    """Whether a path is a run, and no reconstructed video; FileError where it is neither."""
    if not path.exists():
        raise FileError(path, "does not exist; a video of 'reconstruct --video' or a run is expected.")
    if is_zarr_name(path):
        if source != SourceOptions():
            raise BenchError("--psf and --calibration are for recordings; this is a reconstructed video.")
        return False
    if not (path / STATE).exists():
        raise FileError(path, "is neither a reconstructed video (.ome.zarr) nor a run.")
    return True


def _request(
    files: ActivityFiles, source: SourceOptions, inputs: InputOptions, scene: ReconstructionOptions
) -> VideoRequest:
    files.out.mkdir(parents=True, exist_ok=True)
    return VideoRequest(
        run=files.video,
        out=files.out / _VIDEO,
        psf=source.psf,
        calibration=source.calibration,
        inputs=inputs,
        options=scene,
        video=VideoOptions(warm_iterations=WARM_ITERATIONS),
    )
