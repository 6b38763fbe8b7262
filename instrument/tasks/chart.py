"""Every setting on one problem: what it costs against how good it is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from instrument.files.atomic import output_folder
from instrument.files.errors import BenchError
from instrument.reconstruction.options import InputOptions, SourceOptions
from instrument.tasks.task import BenchFile, Desk, Done, Given, Only, bench_of, saying_what_is_left, task
from recon.base.declare import option
from recon.base.option_text import size as size_of
from recon.reconstruction.options import ReconstructionOptions

if TYPE_CHECKING:
    from instrument.evaluation.chart import ChartData
    from instrument.reconstruction.job import Job
    from recon.evaluation.chart_hologram import HologramProblem
    from recon.evaluation.scored import Point
    from recon.evaluation.trial import Named, Subject

_LEAST_S = 1.0
"""For settings, where photographs took all of the budget: so that each call comes further."""


@dataclass(frozen=True, kw_only=True)
class ChartFiles:
    """For how long is charted, and where it goes."""

    budget_s: float = option(
        300.0,
        help="Time for all settings together.",
        unit="s",
        least=1,
        flags=("--budget",),
        group="Time and files",
    )
    out: Path = option(
        Path("chart"),
        help="For chart.png, .html, .csv, .json.",
        metavar="FOLDER",
        flags=("--out", "-o"),
        label="Result",
        group="Time and files",
    )


def _scenes() -> tuple[str, ...]:
    from recon.evaluation.scene import FAMILIES

    return FAMILIES


@dataclass(frozen=True, kw_only=True)
class SceneChart:
    """Which simulated scene."""

    name: str = option(
        help="Which kind of scene.",
        metavar="NAME",
        choices=_scenes,
        label="Scene",
        positional=True,
        group="Scene",
    )
    size: int = option(48, help="Pixels of its side.", least=16, group="Scene")
    seed: int = option(0, help="Another one: another scene of this kind.", least=0, group="Scene")


@task(
    "diffuserbench chart scene sparse-picture",
    "diffuserbench chart scene beads --size 40 --budget 120 --out beads-chart",
    out=Path("scene-chart"),
)
def scene(desk: Desk, subject: SceneChart, files: ChartFiles) -> Done:
    """Chart every way to reconstruct a simulated scene against its ground truth.

    Method, model, prior, iterations, binning and precision, each setting in a process of its own, quick ones
    first; the error is PSNR, SSIM and NRMSE. The same command goes on where it stopped.
    """
    from instrument.evaluation.chart_problems import problem_of_scene

    return _charted(desk, *problem_of_scene(subject.name, subject.size, subject.seed), files)


@task(
    "diffuserbench chart photograph --calibration demo/calibration --image photo.tif --z-mm 30",
    "diffuserbench chart photograph --psf psf.tif --image photo.tif --bin 8",
    "diffuserbench chart photograph --volume axial/calibration --image photo.tif",
    out=Path("photograph-chart"),
    needed=("image",),
)
def photograph(
    desk: Desk,
    source: Annotated[SourceOptions, Only("image", "psf", "calibration", "volume")],
    inputs: Annotated[InputOptions, Only("dark", "crop", "binning")],
    place: Annotated[ReconstructionOptions, Only("z_um")],
    files: ChartFiles,
    given: Given,
) -> Done:
    """Chart every way to reconstruct your own photograph, by pixels held out.

    As of a scene; but without a ground truth the error is that on 5 % of the pixels, which are held out and
    predicted from the rest. The same command goes on where it stopped.
    """
    from instrument.evaluation.chart_problems import problem_of_job

    is_volume = source.volume is not None
    if is_volume:
        given.refuse("--volume", "volume")
    job = _job(desk, source, inputs, place)
    return _charted(desk, *problem_of_job(job, place.z_um, volume=is_volume), files)


@dataclass(frozen=True, kw_only=True)
class HologramChart:
    """What is shown, and what is tried."""

    targets: tuple[str, ...] = option(
        help="The picture to be shown by the bench's SLM, or one per plane: a file, or portrait, relief, "
        "head, leaves, clouds.",
        metavar="TARGET...",
        label="Pictures",
        positional=True,
        group="Hologram",
    )
    z_mm: tuple[float, ...] = option(
        (),
        help="Depth of each target behind the focal plane; once a target.",
        label="Depth",
        default_words="0",
        unit="mm",
        group="Hologram",
    )
    expansion: tuple[int, ...] = option(
        (),
        help="Étendue expansions; repeatable.",
        default_words="4, 16 and the bench's",
        flags=("--expansion", "-q"),
        group="Hologram",
    )
    frames: tuple[int, ...] = option(
        (1, 2, 3),
        help="Time-multiplexed frames; repeatable.",
        default_words="1, 2, 3",
        least=1,
        group="Hologram",
    )
    slm: tuple[int, int] | None = option(
        None,
        help="Other SLM pixels than the bench's: few, for a quick chart.",
        label="SLM",
        metavar="HxW",
        parse=size_of,
        group="Hologram",
    )


@task(
    "diffuserbench chart hologram picture.png --slm 135x240 --out hologram-chart",
    "diffuserbench chart hologram near.png far.png --z-mm 0 --z-mm 40",
    out=Path("hologram-chart"),
)
def hologram(desk: Desk, subject: HologramChart, bench: BenchFile, files: ChartFiles) -> Done:
    """Chart every way to compute a picture's hologram for the bench's SLM: loss, method, expansion, frames.

    Each setting in a process of its own, quick ones first, as it iterates; expansions do not compete, each
    shows another field of view. The same command goes on where it stopped.
    """
    from instrument.evaluation.chart_problems import problem_of_pictures

    about = subject.targets, subject.z_mm, subject.expansion, subject.frames, subject.slm
    problem, facts = problem_of_pictures(bench_of(desk, bench), *about)
    if facts["cropped"]:
        desk.warn(facts["cropped"])
    done = _charted(desk, problem, facts, files)
    _tell_limits(desk, problem)
    return done


_QUICK = 2_000_000
"""Pixels of a mask up to which a limit takes less than half a minute."""


def _tell_limits(desk: Desk, problem: HologramProblem) -> None:
    """Say what no number of frames of a phase SLM exceeds, of each expansion that is quickly told."""
    from instrument.display.limit import at_most
    from recon.holography import hologram_limit

    alone = [(d, t[0]) for d, t in zip(problem.displays, problem.targets, strict=True) if len(t) == 1]
    with desk.interruptible() as cancel:
        for display, target in alone:
            if cancel.is_set():
                return
            if display.mask.levels.size > _QUICK:
                told = "diffuserbench hologram --limit tells"
            else:
                told = at_most(hologram_limit(display, target, cancel=cancel))
            desk.say(f"Any number of phase frames, {display.expansion}x: {told}")


_SIMULATED = "simulated microscope"


@dataclass(frozen=True, kw_only=True)
class CalibrationsChart:
    """Which calibrations."""

    folders: tuple[Path, ...] = option(
        (),
        help="Your own calibrations, with --image.",
        metavar="[FOLDER]...",
        label="Calibrations",
        default_words=f"those of a {_SIMULATED}",
        positional=True,
        group="Calibrations",
    )
    volume: bool = option(
        False, help="A volume of all calibrated depths.", applies=("volume",), group="Calibrations"
    )
    size: int = option(
        90,
        help="Pixels of the simulated sensor's side, about.",
        least=16,
        applies=(_SIMULATED,),
        group="Calibrations",
    )


@task(
    "diffuserbench chart calibrations --out calibration-chart",
    "diffuserbench chart calibrations grid/calibration beads/calibration --image photo.tif --z-mm 30",
    out=Path("calibration-chart"),
)
def calibrations(
    desk: Desk,
    subject: CalibrationsChart,
    source: Annotated[SourceOptions, Only("image")],
    inputs: Annotated[InputOptions, Only("dark", "crop", "binning")],
    place: Annotated[ReconstructionOptions, Only("z_um")],
    files: ChartFiles,
    given: Given,
) -> Done:
    """Chart how many photographs a calibration needs, against the error of what is reconstructed with it.

    Your own calibrations, whole and thinned, by the pixels that are held out of your photograph. Without any:
    one PSF, axial, 3 x 3, 5 x 5, several depths, blind from beads, of a simulated microscope. The same
    command goes on where it stopped.
    """
    if not subject.folders:
        given.refuse("no FOLDER", _SIMULATED)
        began = time.monotonic()
        found = _simulated(desk, subject.size, files.out, files.budget_s)
        # Its photographs are taken out of the budget.
        return _charted(desk, *found, files, spent_s=time.monotonic() - began)
    depths = "volume" if subject.volume else "picture"
    given.refuse("FOLDER and --volume" if subject.volume else "FOLDER", depths)
    if repeated := [str(folder) for folder in subject.folders if subject.folders.count(folder) > 1]:
        raise BenchError(f"{repeated[0]} is given twice.")
    from instrument.evaluation.chart_problems import problem_of_calibrations

    jobs = {}
    for folder in subject.folders:
        own = replace(source, volume=folder) if subject.volume else replace(source, calibration=folder)
        jobs[folder] = _job(desk, own, inputs, place)
    return _charted(desk, *problem_of_calibrations(jobs, place.z_um, volume=subject.volume), files)


def _job(desk: Desk, source: SourceOptions, inputs: InputOptions, place: ReconstructionOptions) -> Job:
    """Return a photograph with its calibration, as a reconstruction has them; say what is to be known."""
    if source.image is None:
        raise BenchError("Give your photograph with --image FILE.")
    from instrument.reconstruction.request import request_of

    job = request_of(source, inputs, place).prepare()
    for name, text in job.notes.items():
        desk.fact(name, text)
    return job


def _charted(
    desk: Desk, problem: Subject[Any], about: dict[str, Any], files: ChartFiles, *, spent_s: float = 0.0
) -> Done:
    """Try every setting in what is left of the budget; tell, draw, write."""
    from instrument.evaluation.figures import write_charts

    out = files.out
    output_folder(out)
    if about.get("simulated"):
        desk.say("SIMULATED   what is charted, or its input, comes from a simulation")
    record = out / "chart.json"
    data = _made(desk, problem, about, record, max(files.budget_s - spent_s, _LEAST_S))
    if not data.points:
        if not data.failed:
            raise BenchError("There was no time for any setting: give a longer --budget.")
        raise BenchError("No setting could be run: " + "; ".join(f"{k}: {v}" for k, v in data.failed.items()))
    with desk.step("drawing"):
        chart_files = write_charts(out, data)
    _tell(desk, data)
    return Done((record, *chart_files))


def _simulated(desk: Desk, size: int, out: Path, budget_s: float) -> tuple[Subject[Any], dict[str, Any]]:
    from instrument.evaluation.bench_photographs import OutOfTimeError, photographs
    from recon.evaluation.chart_calibration import CalibrationProblem

    output_folder(out)
    path = out / "photographs.npz"
    counted = ""

    def advance(done: int, total: int) -> None:
        nonlocal counted
        counted = f"{done} of {total} photographs are in {path}: the same command goes on."
        show(done, total)

    try:
        with desk.step("photographs") as show:
            taken = photographs(size, path, advance, budget_s=budget_s)
    except (KeyboardInterrupt, SystemExit) as interruption:
        interruption.add_note(counted or "Nothing was written.")
        raise
    except OutOfTimeError as error:
        raise BenchError(
            f"The budget of {budget_s:g} s was spent on photographs: {error.done} of {error.total} are "
            "taken and kept. Run the same command again to go on, or give a longer --budget."
        ) from error
    return CalibrationProblem(taken), {"bench": "simulated microscope", "simulated": True}


def _made(
    desk: Desk, problem: Subject[Any], about: dict[str, Any], record: Path, budget_s: float
) -> ChartData:
    from instrument.evaluation.chart import make_chart

    with saying_what_is_left(record), desk.step("settings") as advance:

        def on_progress(place: int, total: int, setting: Named, left_s: float) -> None:
            advance(place, total, note=f"{setting.name}, {left_s:.0f} s of the budget left")

        return make_chart(problem, about, record, budget_s=budget_s, on_progress=on_progress)


def _tell_even(desk: Desk, group: str, even: Sequence[Point], *, on_the_way: bool) -> None:
    """Say what the held-out pixels cannot tell from the best setting."""
    from recon.evaluation.scored import SETTLED_ITERATIONS

    best, others = even[0], sorted({p.setting for p in even[1:]} - {even[0].setting})
    when = f"after {SETTLED_ITERATIONS} iterations or more" if on_the_way else group
    desk.say(f"{'Held out':<12}best {when}: {_told(best)}")
    cheap = "quickest" if on_the_way else "one with the fewest photographs"
    least = min(even, key=lambda p: p.seconds if on_the_way else p.images)
    if not others:
        desk.say(f"{'':<12}no other setting is even with it")
        return
    desk.say(
        f"{'':<12}even with it, as far as these pixels tell, apart by less than twice the scatter: "
        f"{len(others)}; the {cheap}: {_told(least)}"
    )


def _told(point: Point) -> str:
    from instrument.evaluation.chart import in_words

    # Pixel by pixel, as settings were compared; points are drawn by blocks, which every binning has.
    error = (sum(point.held_out_parts) / len(point.held_out_parts)) ** 0.5
    return f"{in_words(point)} (error {error:.3g} a pixel, {point.seconds:.3g} s)"


def _tell(desk: Desk, data: ChartData) -> None:
    """Print the fronts, what failed, and what there was no time for."""
    score, cost = data.kind.score_of(data.points), data.kind.costs[0]
    heading = f"{'iterations':>10}{cost.key:>9}{'MiB':>8}"
    for group, front in data.fronts().items():
        name = f"Pareto front {group}".rstrip()
        desk.say(f"{name:<44}{heading}  {score.words}")
        for p in front:
            paid, value = getattr(p, cost.key), getattr(p, score.key)
            desk.say(f"{p.setting:<44}{p.iterations:>10}{paid:>9.3g}{p.peak_mib:>8.3g}  {value:.3f}")
    for group, even in data.even().items():
        _tell_even(desk, group, even, on_the_way=data.kind_name == "reconstruction")
    for why in data.about.get("left_out", ()):
        desk.say(f"{'Not charted':<12}{why}")
    for setting, why in data.failed.items():
        desk.warn(f"Warning: {setting} could not be run: {why}")
    if data.missing:
        some = ", ".join(data.missing[:3]) + (", ..." if len(data.missing) > 3 else "")
        desk.say(
            f"No time, or not enough, for {len(data.missing)} settings ({some}): run the same command again "
            "to go on."
        )
