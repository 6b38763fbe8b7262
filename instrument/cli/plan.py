"""``diffuserbench plan``: look at a plan before anything moves, or write one to start from."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import DeviceError
from instrument.bench.bench import Bench
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.progress import one_task
from instrument.files.atomic import require_new, write_text
from instrument.files.errors import BenchError, FileError, size
from instrument.plan import BenchAbilities, Plan, check, estimate
from instrument.plan.illumination import IlluminationOptions
from instrument.plan.model import load_plan, save_plan
from instrument.plan.patterns import pattern_help
from instrument.runs.acquire import abilities_of
from instrument.runs.pace import Pace, pace_of
from instrument.runs.rehearsal import rehearse

Point = tuple[float, float]
WIDTH, HEIGHT = 56, 14


def draw_path(points: Sequence[Point], x_name: str, y_name: str = "") -> str:
    """Return a drawing of points in order: ``S`` the first, ``E`` the last, ``o`` others, dots between.

    Without ``y_name`` the path is a line, and drawn in one.
    """
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    rows = HEIGHT if y_name else 1
    grid = [[" "] * WIDTH for _ in range(rows)]

    def cell(point: Point) -> tuple[int, int]:
        return (
            _scaled(point[1], min(ys), max(ys), rows - 1),
            _scaled(point[0], min(xs), max(xs), WIDTH - 1),
        )

    cells = [cell(point) for point in points]
    for start, end in pairwise(cells):
        length = max(abs(end[0] - start[0]), abs(end[1] - start[1]), 1)
        for i in range(length + 1):
            row = round(start[0] + (end[0] - start[0]) * i / length)
            column = round(start[1] + (end[1] - start[1]) * i / length)
            grid[row][column] = "."
    for row, column in cells:
        grid[row][column] = "o"
    grid[cells[-1][0]][cells[-1][1]] = "E"
    grid[cells[0][0]][cells[0][1]] = "S"
    frame = "+" + "-" * WIDTH + "+"
    drawn = "\n".join("|" + "".join(row) + "|" for row in grid)
    caption = f"{x_name} {min(xs):g} to {max(xs):g}"
    if y_name:
        caption += f" (across), {y_name} {min(ys):g} to {max(ys):g} (down)"
    return f"{frame}\n{drawn}\n{frame}\n{caption}"


def _scaled(value: float, low: float, high: float, last: int) -> int:
    return last // 2 if high == low else round((value - low) / (high - low) * last)


app = App("Look at a plan before anything moves, or write one to start from.")


@app.command(
    epilog=examples("diffuserbench plan show plan.toml", "diffuserbench plan show --steps plan.toml")
)
def show(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The plan, .toml or .json.")],
    bench: BenchOption = None,
    steps: Annotated[bool, typer.Option("--steps", help="List every step.")] = False,
) -> None:
    """Say what a plan does and costs, draw its path, and hold it against the bench: nothing moves.

    Exit status 2 when the plan leaves the stage's limits, the disk or the devices' abilities; every
    offending step is named. Before the first run on a simulated bench some frames are computed to tell
    the time.
    """
    plan = load_plan(file)
    with open_and_say(bench) as opened:
        abilities = abilities_of(opened, opened.config.data_folder)
        pace = pace_of(plan, abilities, opened.config.data_folder, opened.config.text)
        wanted = replace(abilities, stage_homed=True)  # homing is the run's own first move
        _describe(plan, abilities)
        simulated = bool(opened.simulated_kinds)
        if pace is None:
            with suppress(BenchError):  # what the bench cannot do is said below
                check(plan, wanted)
                pace = rehearsal(plan, opened)
    if pace is not None:
        typer.echo(pace.words(plan, abilities))
    elif simulated:
        typer.echo("Computing the simulated light comes on top, most of it at new places: known after a run.")
    if steps:
        for step in plan.steps():
            typer.echo(f"  {step}")
    check(plan, wanted)
    typer.echo("The bench can do it. Nothing has moved.")


@app.command(epilog=examples("diffuserbench plan new", "diffuserbench plan new sweep.toml"))
def new(
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write it.")] = Path("plan.toml"),
) -> None:
    """Write a commented plan to start from."""
    if out.suffix.lower() != ".toml":
        raise FileError(out, "the commented plan is TOML; choose a name that ends in .toml.")
    require_new(out)
    write_text(out, (files("instrument.plan") / "example.toml").read_text())
    typer.echo(f"Wrote {out}. Look at it with: diffuserbench plan show {out}")


@app.command(
    epilog=examples(
        "diffuserbench plan illumination --lattice 3 lit.toml",
        'diffuserbench plan illumination --groups "0-3;4-7;8,9" --exposure-ms 20 lit.toml',
        'diffuserbench plan illumination --pattern "half na=0.3" --exposure-ms 20 lit.toml',
    )
)
def illumination(
    options: IlluminationOptions,
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write it.")] = Path(
        "illumination.toml"
    ),
    bench: BenchOption = None,
) -> None:
    """Write a plan of active illumination: the scene lit by one group of LEDs after the other.

    Run it with the scene in place, and another one with a plain white sheet there, which is brighter; then
    diffuserbench reconstruct SCENE --patterned SHEET solves all frames together.
    """
    if out.suffix.lower() not in (".toml", ".json"):
        raise FileError(out, "a plan's name ends in .toml or .json.")
    require_new(out)
    from calibration_routines.plan_procedures import illumination_plan_for  # reads much: where it is needed

    if options.needs_bench:
        with open_and_say(bench) as opened:
            plan = illumination_plan_for(opened, options)
    else:
        plan = options.plan(None)
    save_plan(plan, out)
    count = len(plan.parts[-1].light)
    exposure = f"{plan.parts[-1].exposures_ms[0]:.4g} ms"
    typer.echo(
        f"Wrote {out}: {count} patterns, {exposure} each. Look at it with: diffuserbench plan show {out}"
    )


@app.command(epilog=examples("diffuserbench plan patterns"))
def patterns() -> None:
    """List the LED patterns that a plan can name, with their options.

    In a plan: light = "half side=left na=0.3", or { kind = "half", side = "left", rgb = [0, 255, 0] }.
    """
    typer.echo(pattern_help())


def rehearsal(plan: Plan, bench: Bench) -> Pace | None:
    """Take some frames of a plan on a simulated bench of its own, with a bar; None: it tells nothing."""
    if not bench.simulated_kinds:
        return None
    with (
        suppress(BenchError, DeviceError),  # what the bench cannot do is said elsewhere
        one_task("Rehearsing on a simulated bench of its own") as advance,
    ):
        return rehearse(plan, bench, advance)
    return None


def _describe(plan: Plan, abilities: BenchAbilities) -> None:
    cost = estimate(plan, abilities)
    typer.echo(f"{plan.label}: {len(plan.parts)} parts, {cost.frames} frames")
    for part in plan.parts:
        words = [f"{len(part)} frames", f"light {', '.join(map(str, part.light))}"]
        words += ["scene lit"] if part.scene_lit else []
        words += [f"mean of {part.average}"] if part.average > 1 else []
        words += [f"{len(part.positions)} positions"] if part.positions is not None else []
        words += [f"{', '.join(f'{e:g}' for e in part.exposures_ms)} ms"] if part.exposures_ms else []
        words += [f"every {part.interval_s:g} s"] if part.repeats > 1 and part.interval_s else []
        typer.echo(f"  {part.label}: {', '.join(words)}")
    typer.echo(f"Exposures: {cost.exposures}, moves: {cost.moves}")
    typer.echo(f"Disk:      {size(cost.total_bytes)}" + _free(abilities))
    typer.echo(f"Time:      {cost.time}, read-out and writing apart")
    places = [abilities.target(step) for step in plan.steps() if abilities.target(step)]
    axes = sorted({axis for place in places for axis in place})
    moving = [axis for axis in axes if len({place.get(axis) for place in places}) > 1]
    if not moving:
        return
    # The axis that goes furthest, across the page; of the others the one that goes furthest, down.
    reach = {
        axis: max(p.get(axis, 0.0) for p in places) - min(p.get(axis, 0.0) for p in places) for axis in axes
    }
    across, *others = sorted(moving, key=lambda axis: -reach[axis])
    down = others[0] if others else ""
    typer.echo(draw_path([(p.get(across, 0.0), p.get(down, 0.0)) for p in places], across, down))


def _free(abilities: BenchAbilities) -> str:
    return f" of {size(abilities.free_bytes)} free" if abilities.free_bytes is not None else ""
