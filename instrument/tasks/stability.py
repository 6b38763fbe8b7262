"""Maps of where methods fail, against pairs of stresses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from instrument.files.atomic import output_folder
from instrument.files.errors import BenchError, FileError
from instrument.tasks.task import Desk, Done, saying_what_is_left, task
from recon.base.declare import option
from recon.base.option_text import command_line


@dataclass(frozen=True, kw_only=True)
class StabilityOptions:
    """Which maps, how large, and where they are kept."""

    names: tuple[str, ...] = option(
        (), help="Maps; default all.", metavar="[NAME]...", label="Maps", default_words="all", positional=True
    )
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
        label="Result",
    )
    list_maps: bool = option(False, help="Only list maps and their methods.", flags=("--list",))
    redraw: bool = option(False, help="Only draw what stability.json holds.")
    shipped: bool = option(False, help="With --redraw: the maps that come with the program.")
    case: Path | None = option(
        None,
        help="With --redraw: mark where this reconstruction lies, the cell whose evidence is most like its.",
        metavar="RESULT",
    )


@task(
    "diffuserbench stability --list",
    "diffuserbench stability light --size quick",
    "diffuserbench stability light erasures --method 'admm tv' --out maps",
    "diffuserbench stability --size full --out stability",
    "diffuserbench stability --redraw --out stability",
    "diffuserbench stability light erasures --redraw --shipped --case reconstruction.tif",
)
def stability(desk: Desk, options: StabilityOptions) -> Done:
    """Map where methods fail: the error against pairs of stresses, with the failure boundary drawn.

    For each map a PNG, and stability.json with all of them. Ctrl-C keeps what is done; the same command goes
    on from there. What counts as failure, and what each map says, is in docs/stability.md.
    """
    from recon.evaluation.maps import MAPS, cells_of, map_named, run_map

    names = options.names
    chosen = [map_named(name) for name in names or MAPS]
    if options.list_maps:
        for stress in chosen:
            desk.say(f"{stress.name}: {stress.title}\n  {stress.x.label} x {stress.y.label}")
            desk.say(f"  methods: {'; '.join(stress.methods)}")
        return Done()
    if options.redraw:
        wanted_names = [s.name for s in chosen] if names else None
        return _redraw(desk, options, wanted_names)
    if options.shipped or options.case is not None:
        raise BenchError("--shipped and --case go with --redraw.")
    wanted = {s.name: _methods(s.methods, options.method) for s in chosen}
    chosen = [s for s in chosen if wanted[s.name]]
    if not chosen:
        known = sorted({m for s in (map_named(n) for n in wanted) for m in s.methods})
        raise BenchError(f"No map has the method {', '.join(options.method)}. Methods: {'; '.join(known)}.")
    out, size = options.out, options.size
    output_folder(out)
    from instrument.files.stability_file import RESULT, CellLog, map_record, write_stability

    log = CellLog(out)
    jobs = {s.name: cells_of(s, size, wanted[s.name]) for s in chosen}
    pictures = [out / f"{s.name}.png" for s in chosen]
    done, total = 0, sum(map(len, jobs.values()))

    def kept() -> str:
        return f"{done} of {total} cells are kept: what asks for the same goes on from there." if done else ""

    with (
        saying_what_is_left(out / RESULT, *pictures, kept=kept),
        desk.step("stability" if size == "quick" else "stability, full", total) as advance,
    ):
        for stress, picture in zip(chosen, pictures, strict=True):
            asked = set(jobs[stress.name])
            made = [c for c in log.of(stress, size) if (c.method, c.ix, c.iy) in asked]
            done += len(made)
            advance(done, note=stress.name)
            for cell in run_map(stress, size, methods=wanted[stress.name], known=made):
                log.add(stress, size, cell)
                done += 1
                advance(done, note=f"{stress.name}: {cell.method}")
            record = map_record(stress, size, log.of(stress, size))
            write_stability(out, {stress.name: record}, command_line("stability", options))
            _draw(record, picture)
            _tell(desk, stress.name, record)
    return Done((out / RESULT, *pictures))


def _methods(offered: tuple[str, ...], asked: tuple[str, ...]) -> list[str]:
    return list(offered) if not asked else [m for m in offered if m in asked]


def _draw(record: dict[str, object], picture: Path) -> None:
    from instrument.evaluation.figures import map_figure
    from instrument.files.figures import save_figure

    save_figure(map_figure(record), picture)


def _redraw(desk: Desk, options: StabilityOptions, names: list[str] | None) -> Done:
    from instrument.files.stability_file import RESULT, read_stability
    from recon.verdict.cases import SHIPPED

    out = options.out
    maps = read_stability(SHIPPED if options.shipped else out / RESULT)["maps"]
    if missing := [n for n in names or () if n not in maps]:
        raise BenchError(f"Not made yet: {', '.join(missing)}. Leave --redraw out to make them.")
    verdict = None if options.case is None else _verdict_of(options.case)
    output_folder(out)
    for name in names or maps:
        if verdict is not None:
            desk.fact(name, _mark(maps[name], verdict))
        _draw(maps[name], out / f"{name}.png")
    return Done(tuple(out / f"{name}.png" for name in names or maps))


def _verdict_of(case: Path) -> dict[str, Any]:
    """Return a reconstruction's verdict as it is recorded.

    Raises FileError when it is none, or has none.
    """
    from instrument.reconstruction.stored_result import open_result

    record = open_result(case).record
    verdict: dict[str, Any] | None = record.get("verdict")
    if not verdict or not verdict.get("evidence"):
        remedy = "Reconstruct it anew." if record else "Give a picture that reconstruct wrote."
        raise FileError(case, "was not judged, so that it has no place on a map.", remedy)
    return verdict


def _mark(record: dict[str, Any], verdict: dict[str, Any]) -> str:
    """Mark a map with the cell that a case is most like; return in words which it is."""
    from instrument.evaluation.figures import label_of, ticks_of
    from recon.verdict.likeness import most_like

    like = most_like(verdict["evidence"], verdict["method"], record)
    if like is None:
        return f"no method of it fails as {verdict['method']} does, or its cells tell too little"
    record["methods"][like.method]["case"] = [like.ix, like.iy]
    place = ", ".join(
        f"{label_of(record[axis])} {ticks_of(record[axis])[index]}"
        for axis, index in (("x", like.ix), ("y", like.iy))
    )
    return (
        f"most like {place}: severity {like.severity:.2g}; {like.distance:.1f} times all cases' scatter away"
    )


def _tell(desk: Desk, name: str, record: dict[str, object]) -> None:
    methods = record["methods"]
    assert isinstance(methods, dict)
    for method, result in methods.items():
        failed = [f for row in result["failure"] for f in row]
        share = sum(f is not None for f in failed)
        desk.say(f"{name:<20}{method:<24}{share:3d} of {len(failed)} cells fail, {result['seconds']:.0f} s")
