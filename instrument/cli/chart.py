"""``diffuserbench chart``: every setting on one problem, what it costs against how good it is."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from instrument.cli.app import App, BenchOption, examples, load_and_say, saying_what_is_left
from instrument.cli.etendue import parse_size
from instrument.cli.progress import progress_bar
from instrument.cli.reconstruct_options import (
    BinningOption,
    CropOption,
    DarkOption,
    PsfOption,
)
from instrument.files.errors import BenchError
from instrument.reconstruction.words import parse_binning, parse_dark

if TYPE_CHECKING:
    from collections.abc import Sequence

    from instrument.evaluation.chart_data import ChartData
    from instrument.reconstruction.job import Job
    from recon.evaluation.scored import Named, Point, Problem

app = App()

_LEAST_S = 1.0
"""For settings, where photographs took all of the budget: so that each call comes further."""
_OWN = "--calibration (or --psf) and --image"
_COMPARED = "--calibrations with --calibration and --image"


@app.command(
    epilog=examples(
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
)
def chart(
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene",
            metavar="NAME",
            help="A simulated scene with ground truth: dense-picture, sparse-picture, beads, dense-volume, "
            "microscope.",
            show_default=False,
        ),
    ] = None,
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            "--calibration",
            "-c",
            metavar="FOLDER",
            help="Your calibration; with --volume PSF images of several depths will do. With --calibrations: "
            "one or more, to be compared.",
            show_default=False,
        ),
    ] = None,
    psf: PsfOption = None,
    image: Annotated[
        Path | None,
        typer.Option("--image", "-i", metavar="FILE", help="Your photograph.", show_default=False),
    ] = None,
    dark: DarkOption = "auto",
    crop: CropOption = None,
    binning: BinningOption = "auto",
    hologram: Annotated[
        list[str] | None,
        typer.Option(
            "--hologram",
            metavar="TARGET",
            help="A picture to be shown by the bench's SLM, once for each plane: a file, or portrait, "
            "relief, head, leaves, clouds.",
            show_default=False,
        ),
    ] = None,
    calibrations: Annotated[
        bool,
        typer.Option(
            "--calibrations",
            help="Calibrations: your own (--calibration, --image), whole and thinned; else of a simulated "
            "microscope: one PSF, axial, 3 x 3, 5 x 5, blind from beads.",
        ),
    ] = False,
    z_mm: Annotated[
        list[float] | None,
        typer.Option(
            "--z-mm",
            metavar="MM",
            help="Distance of a flat scene, of several depths; of each hologram's plane.",
            show_default=False,
        ),
    ] = None,
    volume: Annotated[
        bool, typer.Option("--volume", help="With --image: a volume of all calibrated depths.")
    ] = False,
    expansion: Annotated[
        list[int] | None,
        typer.Option(
            "--expansion",
            "-q",
            help="With --hologram: étendue expansions. Default: 4, 16 and the bench's.",
            show_default=False,
        ),
    ] = None,
    frames: Annotated[
        list[int] | None,
        typer.Option(
            "--frames",
            min=1,
            help="With --hologram: time-multiplexed frames. Default: 1, 2, 3.",
            show_default=False,
        ),
    ] = None,
    slm: Annotated[
        str | None,
        typer.Option(
            "--slm",
            metavar="HxW",
            help="With --hologram: other SLM pixels than the bench's: few, for a quick chart.",
            show_default=False,
        ),
    ] = None,
    bench: BenchOption = None,
    size: Annotated[
        int | None,
        typer.Option(
            "--size",
            min=16,
            metavar="N",
            help="Pixels of the side of a scene (default 48) or of the microscope's sensor (about; 90).",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the scene.")] = 0,
    budget_s: Annotated[
        float, typer.Option("--budget", min=1.0, metavar="S", help="Time for all settings together, seconds.")
    ] = 300.0,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FOLDER", help="For chart.png, .html, .csv, .json."),
    ] = Path("chart"),
) -> None:
    """Chart what every setting costs against how good it is, each in a process of its own, quick ones first.

    Reconstructions (of --scene, or of --image with --calibration or --psf): method, model, prior, iterations,
    binning and precision. With a ground truth the error is PSNR, SSIM and NRMSE; without one the error on 5 %
    of the pixels, which are held out and predicted from the rest. Holograms (--hologram): loss, method,
    expansion, frames and iterations. Calibrations (--calibrations): the number of photographs against the
    error of what is reconstructed with them. Run the same command again to go on where it stopped.
    """
    subject = _only(
        calibrations and bool(calibration or image),
        {
            "--scene": scene is not None,
            _OWN: any(path is not None for path in (calibration, psf, image)),
            "--hologram": bool(hologram),
            "--calibrations": calibrations,
        },
    )
    _refuse(
        subject,
        {
            "--volume": (volume, (_OWN, _COMPARED)),
            "--dark": (dark != "auto", (_OWN, _COMPARED)),
            "--crop": (crop is not None, (_OWN, _COMPARED)),
            "--bin": (binning != "auto", (_OWN, _COMPARED)),
            "--psf": (psf is not None, (_OWN,)),
            "--z-mm": (bool(z_mm), (_OWN, _COMPARED, "--hologram")),
            "--expansion": (bool(expansion), ("--hologram",)),
            "--frames": (bool(frames), ("--hologram",)),
            "--slm": (slm is not None, ("--hologram",)),
            "--size": (size is not None, ("--scene", "--calibrations")),
            "--bench": (bench is not None, ("--hologram",)),
        },
    )
    from instrument.evaluation.chart_figure import write_charts
    from instrument.evaluation.chart_problems import (
        problem_of_calibrations,
        problem_of_job,
        problem_of_pictures,
        problem_of_scene,
    )

    problem: Problem
    if scene is not None:
        problem, about = problem_of_scene(scene, size or 48, seed)
    elif hologram:
        problem, about = problem_of_pictures(
            load_and_say(bench),
            hologram,
            z_mm or (),
            expansion or (),
            frames or (1, 2, 3),
            None if slm is None else parse_size(slm),
        )
    elif calibrations and subject != _COMPARED:
        began = time.monotonic()
        problem, about = _calibrations(size or 90, out, budget_s)
        budget_s = max(budget_s - (time.monotonic() - began), _LEAST_S)
    else:
        if len(z_mm or ()) > 1 or (z_mm and volume):
            raise BenchError("--z-mm is the distance of a flat scene: give it once, and without --volume.")
        z_um = 1e3 * z_mm[0] if z_mm else None
        compared = subject == _COMPARED
        jobs = {
            folder: _job(folder, psf, image, dark, crop, binning, volume=volume)
            for folder in _folders(calibration, compared=compared)
        }
        prepared = list(jobs.values())
        prepared = prepared or [_job(None, psf, image, dark, crop, binning, volume=volume)]
        for job in prepared:
            for name, text in job.notes.items():
                typer.echo(f"{name:<12}{text}")
        if compared:
            problem, about = problem_of_calibrations(jobs, z_um, volume=volume)
        else:
            problem, about = problem_of_job(prepared[0], z_um, volume=volume)
    if about.get("simulated"):
        typer.echo("SIMULATED   what is charted, or its input, comes from a simulation")
    out.mkdir(parents=True, exist_ok=True)
    record = out / "chart.json"
    data = _made(problem, about, record, budget_s)
    if not data.points:
        if not data.failed:
            raise BenchError("There was no time for any setting: give a longer --budget.")
        raise BenchError("No setting could be run: " + "; ".join(f"{k}: {v}" for k, v in data.failed.items()))
    files = write_charts(out, data)
    _tell(data)
    typer.echo(f"{'Wrote':<12}{', '.join(map(str, (record, *files)))}")


def _folders(given: list[Path] | None, *, compared: bool) -> list[Path]:
    folders = given or []
    if compared and not folders:
        raise BenchError("--calibrations with --image compares your own: give --calibration, once or more.")
    if not compared and len(folders) > 1:
        raise BenchError("Several --calibration are compared with --calibrations; else give one.")
    if repeated := [str(folder) for folder in folders if folders.count(folder) > 1]:
        raise BenchError(f"--calibration {repeated[0]} is given twice.")
    return folders


def _only(compared: bool, given: dict[str, bool]) -> str:
    if compared and not given["--scene"] and not given["--hologram"]:
        return _COMPARED
    chosen = [name for name, is_given in given.items() if is_given]
    if len(chosen) != 1:
        found = f"; {' and '.join(chosen)} exclude each other" if chosen else ""
        raise BenchError(
            f"Give one of --scene NAME, --hologram TARGET, --calibrations, or your own {_OWN}{found}."
        )
    return chosen[0]


def _refuse(subject: str, options: dict[str, tuple[bool, tuple[str, ...]]]) -> None:
    for name, (is_given, subjects) in options.items():
        if is_given and subject not in subjects:
            raise BenchError(f"{name} goes with {' or '.join(subjects)}, not with {subject}.")


def _job(
    calibration: Path | None,
    psf: Path | None,
    image: Path | None,
    dark: str,
    crop: str | None,
    binning: str,
    *,
    volume: bool,
) -> Job:
    if image is None or (calibration is None) == (psf is None):
        raise BenchError("Your own chart needs --image FILE, and either --calibration FOLDER or --psf FILE.")
    if psf is not None and volume:
        raise BenchError("--volume needs --calibration: one PSF image is of one depth.")
    from instrument.reconstruction.job import job_from_calibration, job_from_files
    from instrument.reconstruction.preparation import Crop
    from instrument.reconstruction.volume_job import volume_job

    window = None if crop is None else Crop.parse(crop)
    level, factor = parse_dark(dark), parse_binning(binning)
    if psf is not None:
        return job_from_files(psf, image, dark=level, crop=window, binning=factor)
    assert calibration is not None
    prepared = volume_job if volume else job_from_calibration
    return prepared(calibration, image, dark=level, crop=window, binning=factor)


def _calibrations(size: int, out: Path, budget_s: float) -> tuple[Problem, dict[str, Any]]:
    from instrument.evaluation.bench_photographs import OutOfTimeError, photographs
    from recon.evaluation.chart_calibration import CalibrationProblem

    out.mkdir(parents=True, exist_ok=True)
    path = out / "photographs.npz"
    counted = ""

    def advance(done: int, total: int) -> None:
        nonlocal counted
        counted = f"{done} of {total} photographs are in {path}: the same command goes on."
        bar.update(task, completed=done, total=total)

    try:
        with progress_bar() as bar:
            task = bar.add_task("photographs", total=None, note="")
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


def _made(problem: Problem, about: dict[str, Any], record: Path, budget_s: float) -> ChartData:
    from instrument.evaluation.chart_job import make_chart

    with saying_what_is_left(record), progress_bar() as bar:
        task = bar.add_task("settings", total=None, note="")

        def told(place: int, total: int, setting: Named, left_s: float) -> None:
            bar.update(
                task, total=total, completed=place, note=f"{setting.name}, {left_s:.0f} s of the budget left"
            )

        return make_chart(problem, about, record, budget_s=budget_s, told=told)


def _tell_even(group: str, even: Sequence[Point], *, on_the_way: bool) -> None:
    """Say what the held-out pixels cannot tell from the best setting."""
    from recon.evaluation.even import SETTLED_ITERATIONS

    best, others = even[0], sorted({p.setting for p in even[1:]} - {even[0].setting})
    when = f"after {SETTLED_ITERATIONS} iterations or more" if on_the_way else group
    typer.echo(f"{'Held out':<12}best {when}: {_told(best)}")
    cheap = "quickest" if on_the_way else "one with the fewest photographs"
    least = min(even, key=lambda p: p.seconds if on_the_way else p.images)
    if not others:
        typer.echo(f"{'':<12}no other setting is even with it")
        return
    typer.echo(
        f"{'':<12}even with it, as far as these pixels tell, apart by less than twice the scatter: "
        f"{len(others)}; the {cheap}: {_told(least)}"
    )


def _told(point: Point) -> str:
    from instrument.evaluation.chart_words import in_words

    # Pixel by pixel, as settings were compared; points are drawn by blocks, which every binning has.
    error = (sum(point.held_out_parts) / len(point.held_out_parts)) ** 0.5
    return f"{in_words(point)} (error {error:.3g} a pixel, {point.seconds:.3g} s)"


def _tell(data: ChartData) -> None:
    """Print the fronts, what failed, and what there was no time for."""
    score, cost = data.kind.score_of(data.points), data.kind.costs[0]
    heading = f"{'iterations':>10}{cost.key:>9}{'MiB':>8}"
    for group, front in data.fronts().items():
        name = f"Pareto front {group}".rstrip()
        typer.echo(f"{name:<44}{heading}  {score.words}")
        for p in front:
            paid, value = getattr(p, cost.key), getattr(p, score.key)
            typer.echo(f"{p.setting:<44}{p.iterations:>10}{paid:>9.3g}{p.peak_mib:>8.3g}  {value:.3f}")
    for group, even in data.even().items():
        _tell_even(group, even, on_the_way=data.kind_name == "reconstruction")
    for why in data.about.get("left_out", ()):
        typer.echo(f"{'Not charted':<12}{why}")
    for setting, why in data.failed.items():
        typer.echo(f"Warning: {setting} could not be run: {why}", err=True)
    if data.missing:
        some = ", ".join(data.missing[:3]) + (", ..." if len(data.missing) > 3 else "")
        typer.echo(
            f"No time, or not enough, for {len(data.missing)} settings ({some}): run the same command again "
            "to go on."
        )
