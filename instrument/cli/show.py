"""``diffuserbench show``: what is in a run, with a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.files.formatting import size
from instrument.runs.run import Run
from instrument.runs.run_picture import contact_sheet

app = App()


@app.command(epilog=examples("diffuserbench show runs/2026-11-21_14-03-22_axial-sweep"))
def show(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The run's folder.")],
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            "-p",
            metavar="FILE",
            help="Where the picture goes (PNG). Default: summary.png in the run's folder.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Say how a run ended, what it holds, with which bench and software; draw a sheet of its frames."""
    found = Run.open(run)
    for name, value in _facts(found):
        typer.echo(f"{name + ':':<14}{value}")
    if not found.records:
        return
    target = picture or run / "summary.png"
    contact_sheet(found, target)
    typer.echo(f"{'picture:':<14}{target}")


def _facts(run: Run) -> list[tuple[str, str]]:
    origin = run.provenance
    facts = [
        ("run", run.path.name + ("  SIMULATED" if run.is_simulated else "")),
        ("became", run.condition + (f": {run.error}" if run.error else "")),
        ("frames", f"{len(run.records)} of {run.n_frames}"),
    ]
    if run.plan is not None:
        facts += [(part.label, f"{len(part)} frames, mean of {part.average}") for part in run.plan.parts]
    else:
        lost = sum(gap.count for gap in run.gaps)
        facts.append(("lost", f"{lost} in {len(run.gaps)} gaps"))
        if run.frame_period_s:
            facts.append(("rate", f"{1 / run.frame_period_s:.3f} frames/s"))
    if run.has_frames:
        array = run.array
        facts.append(("image", f"{' x '.join(map(str, array.frame_shape))} {array.dtype}"))
        facts.append(("bytes", size(sum(record.n_bytes for record in run.records.values()))))
    saturated = [i for i, record in run.records.items() if record.metadata.saturated_fraction > 0]
    if saturated:
        facts.append(("saturated", f"{len(saturated)} frames, the first is {saturated[0]}"))
    facts.append(("started", f"{run.state['started_utc']} (UTC)"))
    facts += [(kind, str(device)) for kind, device in origin["devices"].items()]
    facts.append(
        ("software", f"diffuserbench {origin['packages']['diffuserbench']}, Python {origin['python']}")
    )
    if origin["git_commit"]:
        facts.append(("commit", origin["git_commit"]))
    facts.append(("host", origin["host"]))
    return facts
