"""``diffuserbench compare``: two calibrations of one camera, and whether to calibrate again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.files.errors import FileError

app = App()


@app.command(
    epilog=examples(
        "diffuserbench compare runs/last-week runs/today",
        "diffuserbench compare before after --out bump.json",
    )
)
def compare(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="A calibration, or a run with one.")],
    new: Annotated[Path, typer.Argument(metavar="NEW", help="A later one of the same camera.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write the figures as JSON.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that exists.")] = False,
) -> None:
    """Say what moved between two calibrations: shift, scale, rotation, likeness, brightness.

    Ends with status 1 when a recalibration is due (the new calibration should replace the old one), else 0.
    """
    import json
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table

    from instrument.files.atomic import write_text
    from instrument.files.calibration_file import load_calibration
    from instrument.files.plain_json import plain
    from instrument.reconstruction.job import find_calibration
    from recon.analysis.compare import compare as compare_calibrations

    if out is not None and out.exists() and not force:
        raise FileError(out, "exists already.", "Choose another name, or overwrite with --force.")
    folders = [find_calibration(folder) for folder in (old, new)]
    first, second = (load_calibration(folder) for folder in folders)
    for name, folder, calibration in (("Old", folders[0], first), ("New", folders[1], second)):
        typer.echo(f"{name:<5}{folder}")
        if source := calibration.provenance.get("refocused_from"):
            raise FileError(
                folder,
                f"was computed from {source}, not measured: it cannot tell what moved.",
                "Compare the calibrations that were measured.",
            )
    found = compare_calibrations(first, second)
    table = Table()
    for heading in ("z, mm", "shift, px (x, y)", "scale", "rotation", "alike", "aligned", "spot", "light"):
        table.add_column(heading, justify="right")
    for c in found.changes:
        turned = "?" if c.rotation_deg is None else f"{c.rotation_deg:+.3f}°"
        table.add_row(
            f"{c.z_um / 1e3:.4g}",
            f"{c.columns:+.2f}, {c.rows:+.2f}",
            f"{c.scale:.5f}",
            turned,
            f"{c.as_is:.3f}",
            f"{c.aligned:.3f}",
            f"{c.spot:.2f}",
            f"{c.brightness:.2f}",
        )
    Console().print(table)
    typer.echo("RECALIBRATE" if found.due else "No recalibration is due")
    for reason in found.reasons:
        typer.echo(f"  {reason}")
    if first.provenance.get("simulated") or second.provenance.get("simulated"):
        typer.echo("SIMULATED: a calibration comes from the simulated bench")
    if out is not None:
        record = {"old": str(folders[0].resolve()), "new": str(folders[1].resolve()), **asdict(found)}
        write_text(out, json.dumps(plain(record), indent=2, allow_nan=False) + "\n")
        typer.echo(f"Wrote {out}")
    if found.due:
        raise typer.Exit(1)
