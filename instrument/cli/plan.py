"""``diffuserbench plan``: look at a plan before anything moves, or write one to start from."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from instrument.acquire import abilities_of
from instrument.atomic import write_text
from instrument.cli.app import BenchOption, command_app, examples, open_and_say
from instrument.errors import FileError
from instrument.plan import BenchAbilities, Plan, check, estimate
from instrument.plan.drawing import draw_path
from instrument.plan.file import load_plan
from instrument.words import duration, size

app = command_app("Look at a plan before anything moves, or write one to start from.")


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
    offending step is named.
    """
    plan = load_plan(file)
    with open_and_say(bench) as opened:
        abilities = abilities_of(opened, opened.config.data_folder)
    _describe(plan, abilities)
    if steps:
        for step in plan.steps():
            typer.echo(f"  {step}")
    check(plan, replace(abilities, stage_homed=True))  # homing is the run's own first move
    typer.echo("The bench can do it. Nothing has moved.")


@app.command(epilog=examples("diffuserbench plan new", "diffuserbench plan new sweep.toml"))
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write it.")] = Path("plan.toml"),
) -> None:
    """Write a commented plan to start from."""
    if file.suffix.lower() != ".toml":
        raise FileError(file, "the commented plan is TOML; choose a name that ends in .toml.")
    if file.exists():
        raise FileError(file, "exists already and was left as it is.")
    write_text(file, (files("instrument.plan") / "example.toml").read_text())
    typer.echo(f"Wrote {file}. Look at it with: diffuserbench plan show {file}")


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
    typer.echo(f"Time:      {duration(cost.seconds)}, read-out and writing apart")
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
