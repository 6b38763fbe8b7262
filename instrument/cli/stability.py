"""``diffuserbench stability``: maps of where methods fail, against pairs of stresses."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from instrument.cli.app import App, examples
from instrument.cli.progress import progress_bar
from instrument.files.errors import BenchError, FileError
from instrument.tasks.task import saying_what_is_left
from recon.base.declare import option

app = App()


@dataclass(frozen=True, kw_only=True)
class StabilityOptions:
    """Which maps, how large, and where they are kept."""

    method: tuple[str, ...] = option(
        (),
        help="Only these methods; repeatable.",
        default_words="each map's",
        flags=("--method", "-m"),
        metavar="NAME",
    )
    size: Literal["quick", "full"] = option("quick", help="quick: coarse, small pictures; full: hours.")
    out: Path = option(
        Path("stability"),
        help="Where maps are kept and gone on with.",
        metavar="FOLDER",
        flags=("--out", "-o"),
    )
    list_maps: bool = option(False, help="Only list maps and their methods.", flags=("--list",))
    redraw: bool = option(False, help="Only draw what stability.json holds.")
    shipped: bool = option(False, help="With --redraw: the maps that come with the program.")


@app.command(
    epilog=examples(
        "diffuserbench stability --list",
        "diffuserbench stability light --size quick",
        "diffuserbench stability light erasures --method 'admm tv' --out maps",
        "diffuserbench stability --size full --out stability",
        "diffuserbench stability --redraw --out stability",
    )
)
def stability(
    options: StabilityOptions,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Maps; default all.", show_default=False)
    ] = None,
) -> None:
    """Map where methods fail: the error against pairs of stresses, with the failure boundary drawn.

    For each map a PNG, and stability.json with all of them. Ctrl-C keeps what is done; the same command goes
    on from there. What counts as failure, and what each map says, is in docs/stability.md.
    """
    from recon.evaluation.maps import MAPS, cells_of, map_named, run_map

    chosen = [map_named(name) for name in names or MAPS]
    if options.list_maps:
        for stress in chosen:
            typer.echo(f"{stress.name:<20}{stress.title}\n{'':<20}{stress.x.label} x {stress.y.label}")
            typer.echo(f"{'':<20}methods: {'; '.join(stress.methods)}")
        return
    if options.redraw:
        _redraw(options.out, [s.name for s in chosen] if names else None, shipped=options.shipped)
        return
    if options.shipped:
        raise BenchError("--shipped goes with --redraw.")
    wanted = {s.name: _methods(s.methods, options.method) for s in chosen}
    chosen = [s for s in chosen if wanted[s.name]]
    if not chosen:
        known = sorted({m for s in (map_named(n) for n in wanted) for m in s.methods})
        raise BenchError(f"No map has the method {', '.join(options.method)}. Methods: {'; '.join(known)}.")
    out, size = options.out, options.size
    _make(out)
    from instrument.files.stability_file import RESULT, CellLog, map_record, write_stability

    log = CellLog(out)
    jobs = {s.name: cells_of(s, size, wanted[s.name]) for s in chosen}
    pictures = [out / f"{s.name}.png" for s in chosen]
    with saying_what_is_left(out / RESULT, *pictures), progress_bar() as bar:
        task = bar.add_task("stability", total=sum(map(len, jobs.values())), note="")
        for stress, picture in zip(chosen, pictures, strict=True):
            asked = set(jobs[stress.name])
            made = [c for c in log.of(stress, size) if (c.method, c.ix, c.iy) in asked]
            bar.update(task, advance=len(made), note=stress.name)
            for cell in run_map(stress, size, methods=wanted[stress.name], known=made):
                log.add(stress, size, cell)
                bar.update(task, advance=1, note=f"{stress.name}: {cell.method}")
            record = map_record(stress, size, log.of(stress, size))
            write_stability(out, {stress.name: record}, " ".join(["diffuserbench", *sys.argv[1:]]))
            _draw(record, picture)
            _tell(stress.name, record)
    typer.echo(f"Wrote {', '.join(map(str, (out / RESULT, *pictures)))}")


def _methods(offered: tuple[str, ...], asked: tuple[str, ...]) -> list[str]:
    return list(offered) if not asked else [m for m in offered if m in asked]


def _make(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise FileError(folder, "is a file; a folder is expected.", "Name another with --out.")
    folder.mkdir(parents=True, exist_ok=True)


def _draw(record: dict[str, object], picture: Path) -> None:
    from instrument.evaluation.figures import map_figure
    from instrument.files.figures import save_figure

    save_figure(map_figure(record), picture)


def _redraw(out: Path, names: list[str] | None, *, shipped: bool) -> None:
    from instrument.files.stability_file import RESULT, read_stability
    from recon.verdict.cases import SHIPPED

    maps = read_stability(SHIPPED if shipped else out / RESULT)["maps"]
    if missing := [n for n in names or () if n not in maps]:
        raise BenchError(f"Not made yet: {', '.join(missing)}. Leave --redraw out to make them.")
    _make(out)
    for name in names or maps:
        _draw(maps[name], out / f"{name}.png")
        typer.echo(f"Drew {out / f'{name}.png'}")


def _tell(name: str, record: dict[str, object]) -> None:
    methods = record["methods"]
    assert isinstance(methods, dict)
    for method, result in methods.items():
        failed = [f for row in result["failure"] for f in row]
        share = sum(f is not None for f in failed)
        typer.echo(f"{name:<20}{method:<24}{share:3d} of {len(failed)} cells fail, {result['seconds']:.0f} s")
