"""Every setting on one problem: what it costs against how good it is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from instrument.files.errors import BenchError
from instrument.reconstruction.options import InputOptions, SourceOptions
from instrument.tasks.task import BenchFile, Desk, Done, Given, Only, bench_of, saying_what_is_left, task
from recon.base.declare import option
from recon.base.option_text import size as size_of

if TYPE_CHECKING:
    from instrument.evaluation.chart import ChartData
    from instrument.reconstruction.job import Job
    from recon.evaluation.scored import Point
    from recon.evaluation.trial import Named, Subject

_LEAST_S = 1.0
"""For settings, where photographs took all of the budget: so that each call comes further."""


class _Subject(NamedTuple):
    """What is charted: as options are declared to apply to it, and as people ask for it."""

    word: str
    title: str
    of_photographs: tuple[str, ...] = ()


_SCENE = _Subject("scene", "--scene")
_OWN = _Subject("photograph", "--calibration (or --psf) and --image", ("picture", "volume"))
_COMPARED = _Subject(
    "comparison of calibrations", "--calibrations with --calibration and --image", ("volume",)
)
_SIMULATED = _Subject("simulated calibration", "--calibrations")
_HOLOGRAM = _Subject("hologram", "--hologram")
_HOLOGRAMS, _PHOTOGRAPHS = (_HOLOGRAM.word,), (_OWN.word, _COMPARED.word)


@dataclass(frozen=True, kw_only=True)
class ChartOptions:
    """What is charted, and for how long."""

    scene: str | None = option(
        None,
        help="A simulated scene with ground truth: dense-picture, sparse-picture, beads, dense-volume, "
        "microscope.",
        metavar="NAME",
        group="What to chart",
    )
    calibration: tuple[Path, ...] = option(
        (),
        help="Your calibration; with --volume PSF images of several depths will do. With --calibrations: "
        "one or more, to be compared.",
        metavar="FOLDER",
        flags=("--calibration", "-c"),
        group="What to chart",
    )
    calibrations: bool = option(
        False,
        help="Calibrations: your own (--calibration, --image), whole and thinned; else of a simulated "
        "microscope: one PSF, axial, 3 x 3, 5 x 5, blind from beads.",
        group="What to chart",
    )
    hologram: tuple[str, ...] = option(
        (),
        help="A picture to be shown by the bench's SLM, once for each plane: a file, or portrait, relief, "
        "head, leaves, clouds.",
        metavar="TARGET",
        group="What to chart",
    )
    volume: bool = option(
        False,
        help="With --image: a volume of all calibrated depths.",
        applies=_PHOTOGRAPHS,
        group="What to chart",
    )
    z_um: tuple[float, ...] = option(
        (),
        help="Distance of a flat scene, of several depths; of each hologram's plane, behind the focal plane.",
        unit="um",
        shown_unit="mm",
        shown_factor=1000.0,
        flags=("--z-mm",),
        applies=(*_PHOTOGRAPHS, *_HOLOGRAMS),
        group="What to chart",
    )
    expansion: tuple[int, ...] = option(
        (),
        help="Étendue expansions; repeatable.",
        default_words="4, 16 and the bench's",
        flags=("--expansion", "-q"),
        applies=_HOLOGRAMS,
        group="Holograms",
    )
    frames: tuple[int, ...] = option(
        (1, 2, 3),
        help="Time-multiplexed frames; repeatable.",
        default_words="1, 2, 3",
        least=1,
        applies=_HOLOGRAMS,
        group="Holograms",
    )
    slm: tuple[int, int] | None = option(
        None,
        help="Other SLM pixels than the bench's: few, for a quick chart.",
        metavar="HxW",
        parse=size_of,
        applies=_HOLOGRAMS,
        group="Holograms",
    )
    size: int | None = option(
        None,
        help="Pixels of the side of a scene (default 48) or of the microscope's sensor (about; 90).",
        least=16,
        applies=(_SCENE.word, _SIMULATED.word),
        group="Simulated scenes",
    )
    seed: int = option(0, help="Of the scene.", least=0, group="Simulated scenes")
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


@task(
    "diffuserbench chart --scene sparse-picture",
    "diffuserbench chart --scene beads --size 40 --budget 120 --out beads-chart",
    "diffuserbench chart --calibration demo/calibration --image photo.tif --z-mm 30",
    "diffuserbench chart --psf psf.tif --image photo.tif --bin 8",
    "diffuserbench chart --calibration axial/calibration --image photo.tif --volume",
    "diffuserbench chart --hologram picture.png --slm 135x240 --out hologram-chart",
    "diffuserbench chart --calibrations --out calibration-chart",
    "diffuserbench chart --calibrations -c grid/calibration -c beads/calibration -i photo.tif --z-mm 30",
    "diffuserbench chart --hologram near.png --hologram far.png --z-mm 0 --z-mm 40",
)
def chart(
    desk: Desk,
    options: ChartOptions,
    source: Annotated[SourceOptions, Only("psf", "image")],
    inputs: Annotated[InputOptions, Only("dark", "crop", "binning")],
    bench: BenchFile,
    given: Given,
) -> Done:
    """Chart what every setting costs against how good it is, each in a process of its own, quick ones first.

    Reconstructions (of --scene, or of --image with --calibration or --psf): method, model, prior, iterations,
    binning and precision. With a ground truth the error is PSNR, SSIM and NRMSE; without one the error on 5 %
    of the pixels, which are held out and predicted from the rest. Holograms (--hologram): loss, method,
    expansion, frames and iterations. Calibrations (--calibrations): the number of photographs against the
    error of what is reconstructed with them. Run the same command again to go on where it stopped.
    """
    subject = _subject(given)
    given.refuse(subject.title, subject.word, *subject.of_photographs)
    if bench.bench is not None and subject is not _HOLOGRAM:
        raise BenchError(f"--bench is for holograms; it does not apply with {subject.title}.")
    from instrument.evaluation.figures import write_charts

    out = options.out
    began = time.monotonic()
    problem, about = _problem(desk, subject, options, (source, inputs), bench)
    # Photographs of a simulated microscope are taken out of the budget.
    spent_s = time.monotonic() - began if subject is _SIMULATED else 0.0
    if about.get("simulated"):
        desk.say("SIMULATED   what is charted, or its input, comes from a simulation")
    out.mkdir(parents=True, exist_ok=True)
    record = out / "chart.json"
    data = _made(desk, problem, about, record, max(options.budget_s - spent_s, _LEAST_S))
    if not data.points:
        if not data.failed:
            raise BenchError("There was no time for any setting: give a longer --budget.")
        raise BenchError("No setting could be run: " + "; ".join(f"{k}: {v}" for k, v in data.failed.items()))
    with desk.step("drawing"):
        files = write_charts(out, data)
    _tell(desk, data)
    return Done((record, *files))


def _problem(
    desk: Desk,
    subject: _Subject,
    options: ChartOptions,
    photographs: tuple[SourceOptions, InputOptions],
    bench: BenchFile,
) -> tuple[Subject[Any], dict[str, Any]]:
    """Return what is charted, and what to say of it."""
    from instrument.evaluation.chart_problems import (
        problem_of_calibrations,
        problem_of_job,
        problem_of_pictures,
        problem_of_scene,
    )

    if subject is _SCENE:
        assert options.scene is not None
        return problem_of_scene(options.scene, options.size or 48, options.seed)
    z_mm = [1e-3 * z_um for z_um in options.z_um]
    if subject is _HOLOGRAM:
        return problem_of_pictures(
            bench_of(desk, bench), options.hologram, z_mm, options.expansion, options.frames, options.slm
        )
    if subject is _SIMULATED:
        return _calibrations(desk, options.size or 90, options.out, options.budget_s)
    if len(z_mm) > 1 or (z_mm and options.volume):
        raise BenchError("--z-mm is the distance of a flat scene: give it once, and without --volume.")
    z_um = options.z_um[0] if options.z_um else None
    source, inputs = photographs
    compared = subject is _COMPARED
    jobs = {
        folder: _job(folder, source, inputs, volume=options.volume)
        for folder in _folders(options.calibration, compared=compared)
    }
    prepared = list(jobs.values()) or [_job(None, source, inputs, volume=options.volume)]
    for job in prepared:
        for name, text in job.notes.items():
            desk.say(f"{name:<12}{text}")
    if compared:
        return problem_of_calibrations(jobs, z_um, volume=options.volume)
    return problem_of_job(prepared[0], z_um, volume=options.volume)


def _folders(given: Sequence[Path], *, compared: bool) -> Sequence[Path]:
    if compared and not given:
        raise BenchError("--calibrations with --image compares your own: give --calibration, once or more.")
    if not compared and len(given) > 1:
        raise BenchError("Several --calibration are compared with --calibrations; else give one.")
    if repeated := [str(folder) for folder in given if given.count(folder) > 1]:
        raise BenchError(f"--calibration {repeated[0]} is given twice.")
    return given


def _subject(given: Given) -> _Subject:
    """Return what is to be charted.

    Raises BenchError when none or more than one is given.
    """
    own = any(name in given for name in ("calibration", "psf", "image"))
    found = [s for s, name in ((_SCENE, "scene"), (_HOLOGRAM, "hologram")) if name in given]
    if "calibrations" in given and ("calibration" in given or "image" in given):
        found.append(_COMPARED)
    elif "calibrations" in given:
        found += [_OWN, _SIMULATED] if own else [_SIMULATED]
    elif own:
        found.append(_OWN)
    if len(found) != 1:
        both = f"; {' and '.join(s.title for s in found)} exclude each other" if found else ""
        raise BenchError(
            f"Give one of --scene NAME, --hologram TARGET, --calibrations, or your own {_OWN.title}{both}."
        )
    return found[0]


def _job(folder: Path | None, source: SourceOptions, inputs: InputOptions, *, volume: bool) -> Job:
    image, psf = source.image, source.psf
    if image is None or (folder is None) == (psf is None):
        raise BenchError("Your own chart needs --image FILE, and either --calibration FOLDER or --psf FILE.")
    if psf is not None and volume:
        raise BenchError("--volume needs --calibration: one PSF image is of one depth.")
    from instrument.reconstruction.job import job_from_calibration, job_from_files
    from instrument.reconstruction.request import volume_job

    if psf is not None:
        return job_from_files(psf, image, inputs)
    assert folder is not None
    prepared = volume_job if volume else job_from_calibration
    return prepared(folder, image, inputs)


def _calibrations(desk: Desk, size: int, out: Path, budget_s: float) -> tuple[Subject[Any], dict[str, Any]]:
    from instrument.evaluation.bench_photographs import OutOfTimeError, photographs
    from recon.evaluation.chart_calibration import CalibrationProblem

    out.mkdir(parents=True, exist_ok=True)
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
