"""Runs on disk: every frame verified, frames or results exported."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from instrument.files.errors import BenchError
from instrument.files.images import read_stack
from instrument.files.ome_zarr import is_zarr_name
from instrument.reconstruction.film import Film, Window, is_film, slowed, write_film
from instrument.runs.export import export as export_run
from instrument.runs.imported import FilmFacts
from instrument.runs.imported import import_film as write_recording
from instrument.runs.inspection import verify as verify_run
from instrument.runs.run import Run
from instrument.tasks.task import Desk, Done, Given, task
from instrument.volumes.grid_facts import uneven_steps
from recon.base.declare import option


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """Which runs are read."""

    runs: tuple[Path, ...] = option(help="The runs' folders.", metavar="RUN...", positional=True)


@task("diffuserbench verify runs/2026-11-21_14-03-22_axial-sweep", "diffuserbench verify runs/*")
def verify(desk: Desk, options: VerifyOptions) -> Done:
    """Read every frame and its metadata and hold them against the log's checksums. Changes no data.

    Exit status 1 when anything is not as it was written. A run that ended early is sound, only not complete.
    Which images are damaged is noted in the run (damaged.json), so that list and the window tell it, too.
    """
    sound = True
    for path in options.runs:
        run = Run.open(path)
        with desk.step(path.name) as advance:
            found = verify_run(run, advance)
        for line in found.lines():
            desk.warn(f"{path}: {line}")
        if remedy := found.remedy():
            (desk.say if found.is_sound else desk.warn)(f"{path}: {remedy}")
        sound = sound and found.is_sound
        verdict = "sound" if found.is_sound else "DAMAGED"
        desk.say(f"{path}: {verdict}, {run.condition}, {found.frames} of {run.n_frames} frames read back.")
    return Done(good=sound)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """A film that another program recorded, and what its file may not tell."""

    film: Path = option(
        help="TIFF stack (OME, ImageJ), OME-Zarr, HDF5, MATLAB, .npy, or a folder of images in their order.",
        metavar="FILM",
        positional=True,
    )
    frames_per_s: float | None = option(
        None,
        help="Frames a second.",
        default_words="what the file tells (OME, ImageJ)",
        above=0,
        flags=("--fps",),
    )
    pixel_um: float | None = option(
        None,
        help="Edge of the camera's pixels, as its frames are binned.",
        default_words="what the file tells (OME)",
        unit="um",
        above=0,
    )
    exposure_ms: float | None = option(
        None,
        help="Exposure time.",
        default_words="the file's (OME), else from frame to frame",
        unit="ms",
        above=0,
    )
    label: str = option("recording", help="Becomes part of the folder's name.")
    out: Path = option(Path("runs"), help="Folder that the run's folder is made in.", metavar="FOLDER")


@task(
    "diffuserbench import film.ome.tif",
    "diffuserbench import frames/ --fps 50 --pixel-um 6.5 --label fish",
)
def import_film(desk: Desk, options: ImportOptions) -> Done:
    """Make a recording of a film that another program made: reconstruct it, play it, find what is active.

    The film is copied; its file stays as it is. Pixels stay as they are, raw mosaics too (reconstruct
    --bayer). Compressed films (MP4, AVI) are not taken: their pixels are not in proportion to the light.
    """
    film = read_stack(options.film)
    for note in film.notes:
        desk.fact("Film", note)
    facts = FilmFacts(
        frames_per_s=options.frames_per_s, pixel_um=options.pixel_um, exposure_ms=options.exposure_ms
    )
    known = facts.of(film)
    with desk.step("Frames") as advance:
        run = write_recording(film, options.out, options.label, facts, advance)
    if known.exposure_ms is None:
        desk.warn("Warning: nothing tells the exposure time; the time from frame to frame is noted as such.")
    desk.say(f"{run.n_frames} frames, {known.frames_per_s:.4g} a second, pixels of {known.pixel_um:.4g} um.")
    return Done((run.path,))


def _slice(text: str) -> slice:
    if not re.fullmatch(r"-?\d+|-?\d*:-?\d*(:-?[1-9]\d*)?", text):
        raise ValueError("give A:B, e.g. 0:100, or one number.")
    numbers = [int(part) if part else None for part in text.split(":")]
    if len(numbers) == 1 and numbers[0] is not None:
        return slice(numbers[0], numbers[0] + 1)
    return slice(*numbers)


def _window(text: str) -> Window:
    words = text.split(",")
    if len(words) != 4 or not all(word.strip().isdecimal() for word in words) or "0" in words[2:]:
        raise ValueError("give four whole numbers: top, left, height, width.")
    top, left, height, width = map(int, words)
    return slice(top, top + height), slice(left, left + width)


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """What is written where, how fast a film plays, and on which voxels a volume lies."""

    run: Path = option(
        help="The run's folder; or a reconstruction's file.", metavar="RUN|RESULT", positional=True
    )
    out: Path = option(
        help="File ending in .ome.tif, .tif, .h5, .npy, .mp4, .gif or .csv, or a folder for PNG files. "
        "A picture: .tif, .npy, .png; a volume: .tif, .npy, .ome.zarr; "
        "a video: .mp4, .gif, .csv, .ome.zarr, .ome.tif.",
        metavar="TARGET",
        label="Target",
        positional=True,
    )
    label: str | None = option(None, help="Only steps of this label.", label="Steps' label", applies=("run",))
    frames: slice | None = option(
        None,
        help="Only frames A to B - 1; A:B:C every C-th.",
        metavar="A:B",
        applies=("run",),
        parse=_slice,
    )
    frames_per_s: float | None = option(
        None,
        help="Frames a second of an MP4 or GIF.",
        label="Frames a second",
        least=0.1,
        flags=("--fps",),
        applies=("run", "film"),
    )
    regions: tuple[Window, ...] = option(
        (),
        help="Rows and columns whose mean a .csv follows, with dF/F; repeatable.",
        default_words="the whole picture",
        metavar="T,L,H,W",
        flags=("--region",),
        parse=_window,
        applies=("film",),
    )
    metric: bool = option(
        False,
        help="On voxels of one size, upright: each plane of a reconstruction has a pitch of its own.",
        applies=("volume",),
    )
    voxel_um: float | None = option(
        None,
        help="Edge of the voxels, cubes, with --metric.",
        default_words="the middle plane's pixels and its step",
        unit="um",
        above=0,
        applies=("volume",),
    )


@task(
    "diffuserbench export RUN psfs.ome.tif --label psf",
    "diffuserbench export RUN video.mp4",
    "diffuserbench export RUN frames/ --frames 0:100",
    "diffuserbench export film.ome.zarr curves.csv --region 10,20,5,5 --region 40,8,6,6",
    "diffuserbench export volume.tif volume.ome.zarr --metric",
)
def export(desk: Desk, options: ExportOptions, given: Given) -> Done:
    """Write a run's stored frames, or a reconstruction, for other programs; what is there stays as it is.

    Frames that are not there (gaps of a recording, steps not done) are left out, and said.
    """
    if _is_film(options.run, options.out):
        given.refuse("a film", "film")
        return _export_film(desk, options)
    if _is_result(options.run):
        return _export_result(desk, options, given)
    found, out = Run.open(options.run), options.out
    given.refuse("a run", "run")
    wanted = set(range(found.n_frames)[options.frames or slice(None)])
    if options.label is not None:
        wanted &= {step.index for step in found.steps(options.label)}
    indices = [index for index in sorted(found.records) if index in wanted]
    with desk.step("Frames") as advance:
        export_run(found, out, indices, frames_per_s=options.frames_per_s, on_progress=advance)
    desk.say(f"Wrote {len(indices)} frames.")
    if absent := len(wanted) - len(indices):
        desk.warn(f"Warning: {absent} frames that are not in the run were left out.")
    return Done((out,))


def _is_film(path: Path, target: Path) -> bool:
    """Whether pictures that follow each other are written: a video's, or a run's as GIF or curves."""
    if is_film(path):
        return True
    return path.is_dir() and target.suffix.lower() in (".gif", ".csv")


def _export_film(desk: Desk, options: ExportOptions) -> Done:
    film = Film(options.run)
    height, width = film.read(0).shape[:2]
    for rows, columns in options.regions:
        if rows.stop > height or columns.stop > width:
            raise BenchError(f"--region: the pictures have {height} x {width} pixels.")
    with desk.step("Pictures") as advance:
        write_film(
            film,
            options.out,
            fps=options.frames_per_s,
            regions=options.regions,
            orientation=desk.seen(film.kind),
            advance=advance,
        )
    if words := slowed(options.out, options.frames_per_s or film.fps):
        desk.warn(f"Warning: {words}")
    return Done((options.out,))


def _is_result(path: Path) -> bool:
    """Whether a path is a picture's or volume's: a file, or a Zarr folder, which no run is."""
    return path.is_file() or is_zarr_name(path)


def _export_result(desk: Desk, options: ExportOptions, given: Given) -> Done:
    from instrument.reconstruction.stored_result import export_result, open_result

    result, target = open_result(options.run), options.out
    try:
        kind = "picture" if result.volume is None else "volume"
        given.refuse(f"a {kind}", kind)
        if options.voxel_um is not None and not options.metric:
            raise BenchError("--voxel-um is the size of --metric's voxels: give --metric too.")
        if options.metric:
            result = result.metric(options.voxel_um)
            desk.fact("Voxels", result.voxels_in_words())
        with desk.step("Planes") as advance:
            export_result(result, target, orientation=desk.seen("results"), advance=advance)
        steps = "" if result.planes_um is None else uneven_steps(result.planes_um[0])
    finally:
        result.close()
    if steps and target.suffix.lower() != ".npy":
        desk.fact("Planes", steps)
    return Done((target,))
