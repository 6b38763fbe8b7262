"""A recording's reconstruction from request to files: prepare or take up again, solve, finish."""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import refuse_input, write_json
from instrument.files.errors import BenchError, FileError
from instrument.files.films import as_shown, write_mp4
from instrument.files.images import ImageFile
from instrument.files.ome_zarr import is_zarr_name, stem_of
from instrument.files.record import plain
from instrument.reconstruction.job import Job, Reduction, binned_note
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.request import PictureRequest
from instrument.reconstruction.video_files import (
    DEFAULT_FPS,
    VideoPictures,
    changed_settings,
    create_output,
    levels_of,
    require_video,
    samples_of,
)
from instrument.reconstruction.video_job import VideoJob, VideoPlan
from instrument.reconstruction.video_work import BlockReport, CancelledError, cluster, in_process, on_cluster
from instrument.runs.run import Run
from instrument.runs.run_files import is_run
from recon.arrays import Float32Array
from recon.base.declare import inapplicable
from recon.base.threads import linear_algebra_on_one_thread
from recon.reconstruction.decoys import check_calibration
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.solvers.memory import give_back
from recon.streams.joint import JOINT_BLOCK, JOINT_ITERATIONS, require_joint
from recon.streams.stillness import has_light
from recon.streams.video import BLOCK, COLD_ITERATIONS, LOOKED_AT, VideoSolver, stream_problem, weight_of


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoRequest:
    """What a video is reconstructed from and how."""

    run: Path
    """A recording (any run with frames)."""
    out: Path
    """``NAME.ome.zarr``; ``NAME.mp4`` and ``NAME.json`` go beside it."""
    psf: Path | None = None
    calibration: Path | None = None
    """One of the two."""
    inputs: InputOptions = field(default_factory=InputOptions)
    """As for a picture."""
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    """As for a picture; ``iterations`` are those of a block's first frame. Stopping by time or tolerance
    would make pictures depend on the machine: they do not apply."""
    video: VideoOptions = field(default_factory=VideoOptions)
    """With a prior over time every frame has the ``iterations``, 60 by default."""
    rotate_deg: int = 0

    @property
    def film_path(self) -> Path:
        """The MP4."""
        return self.out.with_name(f"{stem_of(self.out)}.mp4")

    @property
    def record_path(self) -> Path:
        """The JSON with settings and origin."""
        return self.out.with_name(f"{stem_of(self.out)}.json")


@dataclass(frozen=True, slots=True)
class PreparedVideo:
    """A job ready to be worked on."""

    job: VideoJob
    request: VideoRequest
    notes: dict[str, str]
    """What was read and chosen, to be shown."""
    warnings: tuple[str, ...]
    resumed: bool
    """Whether part of it was done before."""

    @property
    def left(self) -> list[int]:
        """Blocks still to be solved."""
        done = self.job.done()
        return [number for number in range(len(self.job.blocks)) if number not in done]


@linear_algebra_on_one_thread()
def prepare_video(request: VideoRequest, *, force: bool = False) -> PreparedVideo:
    """Read the recording's first frame and the PSF, settle everything, and make the job or find it begun.

    ``force``: begin anew where there is an output already.

    Raises FileError, BenchError or InputError when something cannot be used, or the output holds another
    video.
    """
    require_request(request)
    run = _recording(request.run)
    frames = tuple(sorted(run.records))
    picture = _first_picture(request, run, frames[0])
    assert picture.reduction is not None
    inputs, options = request.inputs, request.options
    others: list[Float32Array] = []
    if options.model == "auto" and request.video.over_time is None:
        at = np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).round().astype(int))[1:]
        others = [picture.reduction.apply(run.frame(frames[i])) for i in at]
    problem = stream_problem(
        Measurement(
            picture.measurement,
            picture.binned_noise(inputs.noise),
            erasures=None if picture.valid is None else ~picture.valid,
        ),
        picture.calibration,
        replace(options, iterations=None),
        choosing=request.video.over_time is None,
        others=others,
    )
    if request.video.over_time is not None:
        require_joint(problem)
    reduction = picture.reduction
    if reduction.crop is not None:  # settled, so that a window is the same for every frame
        rows, columns = reduction.crop.slices(_binned_shape(run, frames[0], reduction.first_binning))
        crop = Crop(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
        reduction = replace(reduction, crop=crop)
    usual = COLD_ITERATIONS if request.video.over_time is None else JOINT_ITERATIONS
    times_noise = weight_of(problem)
    plan = VideoPlan(
        run=str(run.path.resolve()),
        frames=frames,
        n_frames=run.n_frames,
        block=request.video.block or (BLOCK if request.video.over_time is None else JOINT_BLOCK),
        cold_iterations=options.iterations or usual,
        warm_iterations=request.video.warm_iterations,
        over_time=request.video.over_time,
        rotate_deg=request.rotate_deg,
        picture_shape=(*problem.grid.shape[problem.n_planes == 1 :], *picture.measurement.shape[2:]),
        settings=_settings(request, picture, problem, reduction, times_noise),
    )
    job, resumed = _job(request, plan, force)
    if job is None:
        job = VideoJob.create(request.out, plan, problem, reduction, times_noise)
        _create(request, run, plan, problem)  # last, and whole: without it the same command begins anew
    saturated = sum(record.metadata.saturated_fraction > 0 for record in run.records.values())
    warnings = list(dict.fromkeys((*picture.warnings, *problem.warnings)))
    if saturated:
        warnings.append(f"{saturated} of {len(frames)} frames have saturated pixels: expect halos there.")
    if changed := changed_settings(run):
        warnings.append(
            f"The frames differ in {' and '.join(changed)}: what gets brighter or dimmer with it is not the "
            "scene's doing."
        )
    if not has_light(picture.measurement, problem.noise):
        warnings.append("The first frame holds nothing but noise: was the scene lit?")
    warnings += filter(None, (_doubt(problem),))
    if missing := run.n_frames - len(frames):
        warnings.append(f"{missing} of {run.n_frames} frames were lost when recording: they stay NaN.")
    pixels = binned_note(picture.reduction.first_binning) if request.calibration is not None else ""
    notes = {**picture.notes, "Image": f"{run.path}: {len(frames)} frames{pixels}"}
    notes["Model"] = f"{problem.model}: {problem.reason}" if problem.reason else problem.model
    return PreparedVideo(job, request, notes, tuple(warnings), resumed)


def solve_video(
    prepared: PreparedVideo,
    on_progress: Callable[[BlockReport], object],
    cancel: threading.Event,
    on_lost: Callable[[int], object] = lambda _: None,
) -> bool:
    """Solve what is left, as the options say: in this process, on processes here, or on a cluster.

    ``on_lost`` is told how many workers were lost, each time.

    Raises BenchError when there is no Dask or no scheduler, or one of somebody else; FileError or OSError
    when a frame cannot be read or a picture written.

    Returns
    -------
    bool
        False when cancelled; what is on the disk stays, and the same request goes on with the rest.
    """
    job, output = prepared.job, prepared.request.out.resolve()
    folder, video = job.folder.resolve(), prepared.request.video
    try:
        if video.workers is None and video.scheduler is None:
            in_process(folder, output, prepared.left, on_progress, cancel)
        else:
            crew = cluster(workers=video.workers, scheduler=video.scheduler, owner=video.scheduler_owner)
            with crew as client:
                on_cluster(client, folder, output, prepared.left, on_progress, cancel, on_lost)
    except CancelledError:
        return False
    return True


def finish_video(prepared: PreparedVideo, on_frame: Callable[[int], object] = lambda _: None) -> list[Path]:
    """Write film and record, and remove the job; returns what there is now.

    ``on_frame`` is told how many frames of the film were looked at. Raises FileError or OSError.
    """
    request, plan = prepared.request, prepared.job.plan
    pictures = VideoPictures(request.out)
    pictures.remove_litter()
    written = [request.out]
    pictures.say_white(samples_of(plan.frames))
    if request.video.film:
        write_shown(prepared, plan.frames, on_frame)
        written.append(request.film_path)
    unlit = prepared.job.unlit()
    record = {**plain(plan.settings), "frames": len(plan.frames), "run": plan.run, "frames_unlit": unlit}
    record["warnings"] = list(prepared.warnings)
    write_json(request.record_path, record)
    prepared.job.remove()
    return [*written, request.record_path]


def write_shown(
    prepared: PreparedVideo, frames: Sequence[int], on_frame: Callable[[int], object] = lambda _: None
) -> None:
    """Write an MP4 of these frames, which are on the disk; raises FileError or OSError."""
    give_back()  # what solving freed: an encoder's memory would come on top of it, or not
    request, pictures = prepared.request, VideoPictures(prepared.request.out)
    black, white = levels_of(pictures.flat(index) for index in samples_of(frames))

    def shown() -> Iterator[npt.NDArray[np.uint8]]:
        for number, index in enumerate(frames):
            yield as_shown(pictures.flat(index), black, white)
            on_frame(number + 1)

    fps = request.video.fps or (1 / pictures.period_s if pictures.period_s else DEFAULT_FPS)
    write_mp4(request.film_path, shown(), fps)


def require_request(request: VideoRequest) -> None:
    """Raise FileError or BenchError for what can be seen to be wrong before anything is read."""
    if not is_zarr_name(request.out) or not request.film_path.stem:
        raise FileError(request.out, "a video is written as OME-Zarr: the name must end in .ome.zarr.")
    if not request.out.parent.is_dir():
        raise FileError(request.out, f"its folder {request.out.parent} does not exist.", "Make it first.")
    given = request.options
    if given.time_s is not None or given.tolerance is not None:
        raise BenchError(
            "--time and --tolerance do not apply to --video: pictures must not depend on the machine. "
            "Use --iterations and --warm."
        )
    if wrong := inapplicable(given, "video"):
        names = ", ".join(o.name for o in wrong)
        raise BenchError(f"{names}: not for a video. Leave {'it' if len(wrong) == 1 else 'them'} out.")
    _require_spared(request)


def done_before(request: VideoRequest, plan: VideoPlan) -> set[int]:
    """Return the blocks of a plan that are on the disk already, where the same request goes on with them."""
    begun = _begun(request)
    if begun is None:
        return set()
    same = plain(plan) == plain(begun.plan)
    anew: list[int] | None = [] if same else begun.goes_on_without(plan)
    return set() if anew is None else begun.done() - set(anew)


# Pieces ------------------------------------------------------------------------------------------------
def _recording(path: Path) -> Run:
    """Open what is to be reconstructed; raises FileError where it is no video of a scene."""
    if path.exists() and not is_run(path):
        found = "a file" if path.is_file() else "a folder that no run was written to"
        raise FileError(
            path,
            f"is {found}: --video takes the folder of a recording.",
            "'diffuserbench record' makes one, 'diffuserbench import' one of another program's film, "
            "'diffuserbench list' shows them; a single photograph is reconstructed by --image without "
            "--video.",
        )
    run = Run.open(path)
    require_video(run)
    return run


def _first_picture(request: VideoRequest, run: Run, index: int) -> Job:
    """Prepare the first frame as a photograph would be."""
    # What is saturated differs from frame to frame; pixels can only be left out of all.
    inputs = request.inputs
    if inputs.erasures == "saturated":
        inputs = replace(inputs, erasures="none")
    told = {"pixel_format": run.metadata(index).pixel_format}
    frame = ImageFile(Path(f"{run.path.name} frame {index}"), run.frame(index), metadata=told)
    asked = PictureRequest(
        image=frame,
        psf=request.psf,
        calibration=request.calibration,
        inputs=inputs,
        options=replace(request.options, iterations=None),
    )
    try:
        job = asked.prepare()
    except FileError as error:  # of a file that is none
        is_frame = error.path == frame.path
        raise FileError(run.path if is_frame else error.path, error.problem, error.remedy) from error
    return replace(job, simulated=job.simulated or run.is_simulated)


def _binned_shape(run: Run, index: int, factor: int) -> tuple[int, int]:
    height, width = run.frame(index).shape[:2]
    return height // factor, width // factor


def _settings(
    request: VideoRequest, picture: Job, problem: Problem, reduction: Reduction, times_noise: float | None
) -> dict[str, Any]:
    """Return what the result depends on, JSON-compatible."""
    with VideoSolver(problem, times_noise=times_noise) as solver:
        weights = solver.weights
    provenance = {key: value for key, value in picture.provenance.items() if key != "image"}
    chosen: dict[str, Any] = plain(
        {
            **provenance,
            "psf_file": None if request.psf is None else str(request.psf.resolve()),
            "z_um": request.options.z_um,
            "prior": str(request.options.prior or "tv"),
            "solver": problem.solver.name,
            "model": problem.model,
            "model_reason": problem.reason,
            "background_estimated": problem.smooth,
            "weight": max(weights),
            "noise_deviation": problem.noise,
            "optics_sha256": _digest(problem, reduction),
            "simulated": picture.simulated,
            "software": {"diffuserbench": version("diffuserbench")},
        }
    )
    return chosen


def _digest(problem: Problem, reduction: Reduction) -> str:
    """Return a digest of PSFs, dark level and pixels used: files of the same name may have changed since."""
    digest = hashlib.sha256()
    for array in (problem.calibration.psfs, problem.image_scale, reduction.dark, problem.valid):
        values = np.asarray(array)
        digest.update(f"{values.shape} {values.dtype}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _job(request: VideoRequest, plan: VideoPlan, force: bool) -> tuple[VideoJob | None, bool]:
    """Return the job begun before for the same plan; none with ``force``, which removes what there is."""
    begun = None if force else _begun(request)
    if begun is not None:
        if plain(plan) == plain(begun.plan):
            return begun, True
        if (anew := begun.goes_on_without(plan)) is not None:  # frames were marked as lost since
            pictures = VideoPictures(request.out, write=True)
            for index in (index for number in anew for index in begun.blocks[number]):
                pictures.remove(index)
            begun.go_on_without(plan, anew)
            return begun, True
    if request.out.exists() and not force:
        if begun is not None:
            raise FileError(
                request.out,
                f"holds an unfinished video with other settings or frames ({_difference(plan, begun.plan)}).",
                "Give the same as then to go on with it, or --force to begin anew.",
            )
        raise FileError(request.out, "exists.", "Choose another name with --out, or --force to replace it.")
    beside = (request.film_path, request.record_path) if request.video.film else (request.record_path,)
    for other in () if force else beside:
        if other.exists():
            raise FileError(
                other,
                "exists, and would be replaced by what goes with the video.",
                "Choose another name with --out, or --force to replace it.",
            )
    for old in (VideoJob.folder_of(request.out), request.out):
        if old.exists():
            shutil.rmtree(old)
    return None, False


def _begun(request: VideoRequest) -> VideoJob | None:
    """Return the job of a film that was begun before; None where there is none."""
    folder = VideoJob.folder_of(request.out)
    return VideoJob(folder) if (folder / "job.json").exists() and request.out.exists() else None


def _require_spared(request: VideoRequest) -> None:
    """Refuse an output that is, holds or is a part of what is read: ``--force`` would delete measurements.

    A video may lie in the folder of its run; a record beside it tells it from the run's own frames.
    """
    refuse_input(request.out)
    out = request.out.resolve()
    ours = request.record_path.exists() or VideoJob.folder_of(request.out).exists()
    for read in (request.run, request.psf, request.calibration):
        if read is None:
            continue
        source = read.resolve()
        part = source in out.parents and out.exists() and not ours
        if source == out or out in source.parents or part:
            raise FileError(
                request.out,
                f"cannot be replaced by the video: it is read, as {read}.",
                "Choose another --out.",
            )


def _difference(plan: VideoPlan, begun: VideoPlan) -> str:
    mine, other = ({**p, **p["settings"]} for p in (plain(plan), plain(begun)))
    names = [name for name in mine if name != "settings" and mine[name] != other.get(name)]
    return ", ".join(names) or "settings"


def _create(request: VideoRequest, run: Run, plan: VideoPlan, problem: Problem) -> None:
    *depths, height, width = plan.picture_shape[: 2 + (problem.n_planes > 1)]
    turned = request.rotate_deg % 180 != 0
    shape = (width, height) if turned else (height, width)
    create_output(
        request.out,
        plan.n_frames,
        (*depths, *shape, *plan.picture_shape[len(depths) + 2 :]),
        period_s=run.frame_period_s,
        grid=problem.grid,
        attributes={
            **plan.settings,
            "run": plan.run,
            "warm_iterations": None if plan.over_time else plan.warm_iterations,
            "missing": sorted(set(range(plan.n_frames)) - set(plan.frames)),
            "calibrated_px": _calibrated_px(problem, request.rotate_deg // 90),
        },
    )


def _doubt(problem: Problem) -> str:
    """Say why the calibration may be another camera's, by the first frame; empty where nothing does."""
    check = check_calibration(problem)
    said = "" if check is None else "".join(check.sentences[:1])
    return f"{said[:1].upper()}{said[1:]}"


def _calibrated_px(problem: Problem, quarter_turns: int) -> tuple[float, float, float, float] | None:
    """Return which pixels of the pictures lie between PSFs that vary over the field; None where one holds.

    Top, left, bottom, right, of pictures turned counter-clockwise so many times.
    """
    if problem.model == "convolution":
        return None
    box = problem.grid.spanned_by(problem.calibration.source_positions_um)
    if box is None:
        return None
    _, height, width = problem.grid.shape
    for _ in range(quarter_turns):
        top, left, bottom, right = box
        box = (width - 1 - right, top, width - 1 - left, bottom)
        height, width = width, height
    return box
