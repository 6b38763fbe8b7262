"""``diffuserbench run``: carry out a plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.running import carry_out, home_if_needed
from instrument.plan import check
from instrument.plan.file import load_plan
from instrument.runs.acquire import abilities_of, prepare

app = App()


@app.command(
    name="run",
    epilog=examples("diffuserbench run plan.toml", "diffuserbench run plan.toml --out /data/monday"),
)
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The plan, .toml or .json.")],
    bench: BenchOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FOLDER",
            help="Where the run's folder is made. Default: data_folder of bench.toml.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Carry out a plan: one run folder, every frame with its metadata.

    Keys while it runs: p pauses (light off) and goes on, q ends it before the next step, s stops at once.
    The bench is checked first; a stage that is not homed is homed. Whatever happens, the light ends off and
    nothing moves; diffuserbench resume goes on with a run that did not end.
    """
    plan = load_plan(file)
    with open_and_say(bench) as opened:
        folder = out or opened.config.data_folder
        check(plan, replace(abilities_of(opened, folder), stage_homed=True))
        home_if_needed(opened, plan)
        runner = prepare(opened, plan, folder)
        carry_out(opened, runner)
