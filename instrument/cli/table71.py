"""``diffuserbench table7.1``: the dissertation's comparison of methods, on its grid and without aliasing."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from instrument.cli.app import App, examples, saying_what_is_left
from instrument.cli.etendue import parse_size
from instrument.cli.progress import progress_bar
from instrument.display.table71_figure import rows, write_chart, write_csv
from instrument.files.errors import BenchError, FileError
from instrument.files.sample_images import DEFAULT_SAMPLES, SAMPLES, load_sample
from recon.holography.table71 import GRIDS, METHODS, Cell, run_table

app = App()


@app.command(
    epilog=examples(
        "diffuserbench table7.1",
        "diffuserbench table7.1 --slm 540x960 --iterations 200 --out table71-full",
        "diffuserbench table7.1 --expansion 4 --pictures portrait,relief,head",
    )
)
def table(
    slm: Annotated[str, typer.Option("--slm", metavar="HxW", help="SLM pixels.")] = "135x240",
    expansion: Annotated[
        list[int] | None,
        typer.Option("--expansion", "-q", help="4, 16 or 36; repeatable. Default: all."),
    ] = None,
    pictures: Annotated[
        str, typer.Option("--pictures", help=f"Of {', '.join(SAMPLES)}; names with commas.")
    ] = ",".join(DEFAULT_SAMPLES),
    iterations: Annotated[int, typer.Option("--iterations", "-n", min=1)] = 100,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="NAME", help="Writes NAME.csv and NAME.png.")
    ] = Path("table71"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Table 7.1 of the dissertation: four methods, three expansions, whole field and middle quarter.

    Each hologram is computed on the dissertation's grid, which aliases, and on the alias-free one. The
    dissertation used 40 photographs that it does not name; here they are pictures that ship inside Matplotlib
    or are drawn by this program. The default is a quarter of the dissertation's SLM along each axis. Minutes.
    """
    names = [name.strip() for name in pictures.split(",")]
    for name in names:
        if name not in SAMPLES:
            raise BenchError(f"There is no sample picture {name!r}. Pictures: {', '.join(SAMPLES)}.")
    factors = sorted(set(expansion or (4, 16, 36)))
    if any(round(q**0.5) ** 2 != q or q < 1 for q in factors):
        raise BenchError(f"Expansions are squares (4, 16, 36), not {', '.join(map(str, factors))}.")
    shape = parse_size(slm)
    files = (out.with_name(out.name + ".csv"), out.with_name(out.name + ".png"))
    for file in files:
        if file.exists() and not force:
            raise FileError(file, "exists already.", "Choose another name, or overwrite with --force.")
    with saying_what_is_left(*files), progress_bar() as bar:
        total = len(factors) * len(names) * len(GRIDS) * len(METHODS)
        task = bar.add_task("table 7.1", total=total, note="")

        def show(cell: Cell) -> None:
            bar.update(task, advance=1, note=f"{cell.expansion}x {cell.picture} {cell.method}")

        loaders = {name: partial(load_sample, name) for name in names}
        cells = run_table(loaders, shape, expansions=factors, iterations=iterations, progress=show)
        note = f"{shape[1]} x {shape[0]} SLM pixels, {iterations} iterations, pictures: {', '.join(names)}"
        write_csv(files[0], cells)
        write_chart(files[1], cells, note)
    _print(cells, note)
    for name in names:
        typer.echo(f"{name}: {SAMPLES[name].source}")
    typer.echo(f"Wrote {files[0]} (every picture, SSIM too), {files[1]}")


def _print(cells: list[Cell], note: str) -> None:
    console = Console()
    for crop in (False, True):
        shown = Table(title=f"PSNR in dB, {'middle quarter' if crop else 'whole field'} (computed). {note}")
        for heading in ("expansion", "method"):
            shown.add_column(heading)
        for heading in ("printed", "its grid, judged on it", "its grid, alias-free", "alias-free grid"):
            shown.add_column(heading, justify="right")
        last = 0
        for q, method, figures in rows(cells, crop=crop):
            if last not in (0, q):
                shown.add_section()
            last = q
            shown.add_row(f"{q}x", method, *(f"{value:.2f}" for value in figures))
        console.print(shown)
