"""``diffuserbench chart``: every method on one scene or photograph, time and memory against the error."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import command_app, examples, saying_what_is_left
from instrument.cli.progress import progress_bar
from instrument.errors import BenchError

app = command_app()


@app.command(
    epilog=examples(
        "diffuserbench chart --scene sparse-picture",
        "diffuserbench chart --scene beads --size 40 --budget 120 --out beads-chart",
        "diffuserbench chart --calibration demo/calibration --image photo.tif --z-mm 30",
        "diffuserbench chart --calibration axial/calibration --image photo.tif --volume",
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
        Path | None,
        typer.Option("--calibration", "-c", metavar="FOLDER", help="Your calibration.", show_default=False),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option("--image", "-i", metavar="FILE", help="Your photograph.", show_default=False),
    ] = None,
    z_mm: Annotated[
        float | None,
        typer.Option(
            "--z-mm", metavar="MM", help="Distance of a flat scene, of several depths.", show_default=False
        ),
    ] = None,
    volume: Annotated[
        bool, typer.Option("--volume", help="With --image: a volume of all calibrated depths.")
    ] = False,
    size: Annotated[int, typer.Option("--size", min=16, metavar="N", help="Pixels of a scene's side.")] = 48,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the scene.")] = 0,
    budget_s: Annotated[
        float, typer.Option("--budget", min=1.0, metavar="S", help="Time for all settings together, seconds.")
    ] = 300.0,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FOLDER", help="For chart.png, .html, .csv, .json."),
    ] = Path("chart"),
) -> None:
    """Chart every applicable method, model, prior, count of iterations and binning on one problem.

    With a ground truth the error is PSNR, SSIM and NRMSE; without one the error on 5 % of the pixels, which
    are held out and predicted from the rest. Each setting runs in a process of its own, quick ones first. Run
    the same command again to go on where it stopped.
    """
    if (scene is None) == (calibration is None and image is None):
        raise BenchError("Give --scene NAME, or your own --calibration FOLDER and --image FILE.")
    from instrument.chart_figure import write_charts
    from instrument.chart_job import make_chart, problem_of_job, problem_of_scene
    from recon.chart import Setting

    if scene is not None:
        problem, about = problem_of_scene(scene, size, seed)
    else:
        if calibration is None or image is None:
            raise BenchError("Your own chart needs both --calibration FOLDER and --image FILE.")
        from instrument.reconstruction_job import job_from_calibration

        job = job_from_calibration(calibration, image)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        problem, about = problem_of_job(job, None if z_mm is None else 1e3 * z_mm, volume=volume)
    if about.get("simulated"):
        typer.echo("SIMULATED   scene or input come from a simulation")
    out.mkdir(parents=True, exist_ok=True)
    record = out / "chart.json"
    with saying_what_is_left(record), progress_bar() as bar:
        task = bar.add_task("settings", total=None, note="")

        def told(place: int, total: int, setting: Setting, left_s: float) -> None:
            bar.update(
                task, total=total, completed=place, note=f"{setting.name}, {left_s:.0f} s of the budget left"
            )

        data = make_chart(problem, about, record, budget_s=budget_s, told=told)
    if not data.points:
        raise BenchError("No setting could be run: " + "; ".join(f"{k}: {v}" for k, v in data.failed.items()))
    files = write_charts(out, data)
    unit = "dB" if data.has_truth else "noise, held out"
    typer.echo(f"{'Pareto front':<44}{'iterations':>10}{'s':>9}{'MiB':>8}{unit:>18}")
    for p in data.front():
        value = p.psnr_db if data.has_truth else p.held_out
        typer.echo(f"{p.setting:<44}{p.iterations:>10}{p.seconds:>9.3g}{p.peak_mib:>8.3g}{value:>18.3f}")
    for name, why in data.failed.items():
        typer.echo(f"Warning: {name} could not be run: {why}", err=True)
    if data.missing:
        typer.echo(
            f"No time, or not enough, for {len(data.missing)} settings "
            f"({', '.join(data.missing[:3])}, ...): run the same command again to go on."
        )
    typer.echo(f"{'Wrote':<12}{', '.join(map(str, (record, *files)))}")
