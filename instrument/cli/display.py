"""Holographic displays: ``hologram`` computes what shows a picture; ``etendue``, ``table7.1`` in figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer
from rich.console import Console
from rich.table import Table

from instrument.cli.app import App, BenchOption, examples, load_and_say
from instrument.cli.progress import first_interrupt_cancels, one_task, progress_bar
from instrument.cli.tasks import Terminal, finish
from instrument.display.hologram import (
    HologramResult,
    bench_display,
    compute_and_judge,
    crop_words,
    load_alignment,
    prepare_target,
    read_weights,
    slm_size,
)
from instrument.display.hologram_files import HologramFiles, rows, write_chart, write_csv
from instrument.files.atomic import require_new
from instrument.files.errors import BenchError
from instrument.files.images import Pixels, read_image, read_stack
from instrument.files.sample_images import DEFAULT_SAMPLES, SAMPLES, load_sample
from instrument.tasks.spots import HologramInputs, make_spots, tell_limit
from instrument.tasks.task import Given, saying_what_is_left
from recon.base.declare import option
from recon.base.option_text import size
from recon.holography import (
    Display,
    Etendue,
    HologramOptions,
    HologramRecord,
    HologramStop,
    Target,
    eyebox_for_field_of_view,
    field_of_view_for_eyebox,
    pixels_for,
    pixels_per_degree,
)
from recon.holography.judge import GRIDS, METHODS, Cell, run_table

hologram_app, etendue_app, table_app = App(), App(), App()


def _pictures(typed: str) -> list[str]:
    names = [name.strip() for name in typed.split(",")]
    if unknown := [name for name in names if name not in SAMPLES]:
        raise ValueError(f"there is no sample picture {unknown[0]!r}. Pictures: {', '.join(SAMPLES)}.")
    return names


def _square(typed: str) -> int:
    if typed.isdecimal() and int(typed) > 0 and round(int(typed) ** 0.5) ** 2 == int(typed):
        return int(typed)
    raise ValueError("expansions are squares (4, 16, 36).")


@dataclass(frozen=True, kw_only=True)
class EtendueOptions:
    """A display, and what to say of it."""

    slm: tuple[int, int] = option(
        (540, 960),
        help="SLM pixels, height x width.",
        default_words="540x960",
        metavar="HxW",
        parse=size,
    )
    pitch_um: float = option(16.0, help="SLM pixel pitch.", unit="um", above=0)
    wavelength_nm: float = option(660.0, help="Of the laser.", unit="nm", above=0)
    expansion: float | None = option(
        None, help="Only this expansion.", default_words="1, 4, 16, 36", least=1, flags=("--expansion", "-q")
    )
    f1_mm: float = option(75.0, help="Focal length of the Fourier lens.", unit="mm", above=0)
    f2_mm: float = option(75.0, help="Focal length of the eyepiece.", unit="mm", above=0)
    fov_deg: float | None = option(
        None, help="Say the eyebox left at this width of field.", unit="deg", above=0, flags=("--fov",)
    )
    eyebox_mm: float | None = option(None, help="Say the field left with this eyebox.", unit="mm", above=0)

    def along(self, pixels: int, expansion: float) -> Etendue:
        """Return one axis of the display."""
        return Etendue(pixels, self.pitch_um, self.wavelength_nm, expansion, self.f1_mm, self.f2_mm)


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How much of the table is made, and where it goes."""

    slm: tuple[int, int] = option(
        (135, 240), help="SLM pixels.", default_words="135x240", metavar="HxW", parse=size
    )
    expansion: tuple[int, ...] = option(
        (4, 16, 36),
        help="Étendue expansions; repeatable.",
        default_words="4, 16 and 36",
        flags=("--expansion", "-q"),
        metavar="N",
        parse=_square,
    )
    pictures: list[str] = option(
        DEFAULT_SAMPLES,
        help=f"Of {', '.join(SAMPLES)}; names with commas.",
        default_words=",".join(DEFAULT_SAMPLES),
        metavar="NAMES",
        parse=_pictures,
    )
    iterations: int = option(100, help="Of each hologram.", least=1, flags=("--iterations", "-n"))
    out: Path = option(
        Path("table71"), help="Writes NAME.csv and NAME.png.", metavar="NAME", flags=("--out", "-o")
    )
    force: bool = option(False, help="Overwrite files that exist.")


@etendue_app.command(
    epilog=examples(
        "diffuserbench etendue",
        "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --fov 120",
        "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --eyebox-mm 10",
        "diffuserbench etendue --slm 540x960 --pitch-um 16 --expansion 16 --f1-mm 75 --f2-mm 150",
    )
)
def etendue(options: EtendueOptions) -> None:
    """Field of view, eyebox and pixels per degree of a holographic display (Kuo 2020, Eqs. 7.1 to 7.10).

    With --fov or --eyebox-mm: what is left of the other, for the SLM's width, exactly and in the small angle
    approximation (the dissertation's 1.05 mm for the GAEA-2 at 120 degrees is the latter).
    """
    (height, width), fov, eyebox_mm = options.slm, options.fov_deg, options.eyebox_mm
    expansions = (options.expansion,) if options.expansion else (1.0, 4.0, 16.0, 36.0)
    console = Console()
    nm = options.wavelength_nm
    table = Table(title=f"{width} x {height} pixels of {options.pitch_um:g} um at {nm:g} nm")
    for name in ("expansion q", "mask pixel", "field of view", "eyebox", "resolution", "étendue (width)"):
        table.add_column(name, justify="right")
    for q in expansions:
        x, y = (options.along(n, q) for n in (width, height))
        table.add_row(
            f"{q:g}",
            f"{x.mask_pitch_um:.2f} um",
            f"{x.field_of_view_deg:.1f} deg square",
            f"{x.eyebox_mm:.2f} x {y.eyebox_mm:.2f} mm",
            f"{pixels_per_degree(x, y):.0f} px/deg",
            f"{x.etendue_mm:.3f} mm",
        )
    console.print(table)
    for q in expansions:
        x = options.along(width, q)
        if fov is not None:
            exact, small = (eyebox_for_field_of_view(x, fov, paraxial=p) for p in (False, True))
            typer.echo(
                f"q = {q:g}: {fov:g} degrees leave an eyebox of {exact:.2f} mm (paraxial {small:.2f} mm)"
            )
        if eyebox_mm is not None:
            exact, small = (field_of_view_for_eyebox(x, eyebox_mm, paraxial=p) for p in (False, True))
            typer.echo(
                f"q = {q:g}: an eyebox of {eyebox_mm:g} mm leaves {exact:.1f} degrees (paraxial {small:.1f})"
            )
    if fov is not None and eyebox_mm is not None:
        exact_n, small_n = (pixels_for(nm, fov, eyebox_mm, paraxial=p) for p in (False, True))
        typer.echo(f"Both without a mask need {exact_n} pixels (paraxial {small_n}) along the width.")


@table_app.command(
    epilog=examples(
        "diffuserbench table7.1",
        "diffuserbench table7.1 --slm 540x960 --iterations 200 --out table71-full",
        "diffuserbench table7.1 --expansion 4 --pictures portrait,relief,head",
    )
)
def table(options: TableOptions) -> None:
    """Table 7.1 of the dissertation: four methods, three expansions, whole field and middle quarter.

    Each hologram is computed on the dissertation's grid, which aliases, and on the alias-free one. The
    dissertation used 40 photographs that it does not name; here they are pictures that ship inside Matplotlib
    or are drawn by this program. The default is a quarter of the dissertation's SLM along each axis. Minutes.
    """
    names, factors = list(options.pictures), sorted(set(options.expansion))
    shape, out = options.slm, options.out
    files = (out.with_name(out.name + ".csv"), out.with_name(out.name + ".png"))
    for file in files:
        require_new(file, overwrite=options.force)
    with saying_what_is_left(*files), progress_bar() as bar:
        total = len(factors) * len(names) * len(GRIDS) * len(METHODS)
        task = bar.add_task("table 7.1", total=total, note="")

        def show(cell: Cell) -> None:
            bar.update(task, advance=1, note=f"{cell.expansion}x {cell.picture} {cell.method}")

        loaders = {name: partial(load_sample, name) for name in names}
        cells = run_table(loaders, shape, expansions=factors, iterations=options.iterations, on_progress=show)
        note = f"{shape[1]} x {shape[0]} SLM pixels, {options.iterations} iterations, "
        note += f"pictures: {', '.join(names)}"
        write_csv(files[0], cells)
        write_chart(files[1], cells, note)
    _print_table(cells, note)
    for name in names:
        typer.echo(f"{name}: {SAMPLES[name].source}")
    typer.echo(f"Wrote {files[0]} (every picture, SSIM too), {files[1]}")


def _print_table(cells: list[Cell], note: str) -> None:
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


@hologram_app.command(
    epilog=examples(
        "diffuserbench hologram picture.png --out slm.png",
        "diffuserbench hologram picture.png --loss spatial --centre 0.4,0.6 --radius 0.2 --out slm.png",
        "diffuserbench hologram near.png far.png --z-mm 0 --z-mm 40 --out slm.png",
        "diffuserbench hologram picture.png --frames 2 --psnr 30 --out slm.png",
        "diffuserbench hologram frames/ --video --iterations 10 --out video.png",
        "diffuserbench hologram colour.png --color --out slm.png",
        "diffuserbench hologram picture.png --limit",
        "diffuserbench hologram --spots 10x10 --expansion 1 --out spots.png",
    )
)
def hologram(
    given: Given,
    inputs: HologramInputs,
    options: HologramOptions,
    target: Annotated[
        list[Path] | None, typer.Argument(metavar="[TARGET...]", help="The picture, or one per plane.")
    ] = None,
    bench: BenchOption = None,
) -> None:
    """Compute the SLM phase that shows a picture through the bench's scattering mask, or without one.

    --expansion 1 is an ordinary hologram, without a mask. --spots takes the place of a picture: weighted
    Gerchberg-Saxton makes spots as bright as asked for, at any places and depths.

    Writes the pattern, a JSON file with settings and metrics, and a preview of what will be seen with and
    without the eye's low-pass (computed, not photographed). Ctrl-C keeps the pattern so far.
    """
    if (inputs.spots is None) == (not target):
        raise BenchError("Give a TARGET picture, or --spots.")
    config = load_and_say(bench)
    size = slm_size(config)
    if inputs.spots is not None:
        given.refuse("--spots", "spots")
        finish(make_spots(Terminal(), inputs, options, (config, size)))
        return
    assert target is not None
    if inputs.weights is not None:
        options = replace(options, weights=read_weights(inputs.weights))
    pictures = _frames(target, video=inputs.video)
    if said := next(filter(None, (crop_words(p, options.fit) for planes in pictures for p in planes)), ""):
        typer.echo(said, err=True)
    depths = inputs.depths(1 if inputs.video else len(target))
    lasers = inputs.wavelengths if inputs.color else (None,)
    displays = [
        options.display_of(bench_display(config, size, expansion=options.expansion, wavelength_nm=nm))
        for nm in lasers
    ]
    if inputs.alignment is not None:
        found = load_alignment(inputs.alignment)
        displays = [found.of(display) for display in displays]
    if inputs.limit:
        given.refuse("--limit", "limit")
        if len(target) > 1:
            raise BenchError("--limit is for one picture in one plane.")
        tell_limit(Terminal(), pictures[0][0], displays[0], options, depths[0])
        return
    frames = len(pictures) if inputs.video else 0
    writer = HologramFiles(inputs.out, config.display.slm_binning, options, displays, video=frames)
    writer.check(overwrite=inputs.force)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        initial: list[Any] = [None] * len(displays)
        for number, planes in enumerate(pictures):
            for channel, display in enumerate(displays):
                targets = [
                    prepare_target(
                        _channel(picture, channel if inputs.color else None), display, options, z_mm=z
                    )
                    for picture, z in zip(planes, depths, strict=True)
                ]
                label = writer.label(number, channel)
                result = _compute(display, targets, options, initial[channel], cancel, label)
                initial[channel] = result.hologram.slm if inputs.video else None
                writer.write(number, channel, result)
                _print(label, result, options)
                if result.hologram.stop_reason is HologramStop.CANCELLED:
                    typer.echo("Interrupted: this is the pattern so far.", err=True)
                    raise typer.Exit(130)


def _compute(
    display: Display, targets: list[Target], options: HologramOptions, initial: Any, cancel: Any, label: str
) -> HologramResult:
    with one_task(label, options.iterations) as advance:

        def show(record: HologramRecord, _slm: object) -> None:
            done = float(record.iteration)
            if options.time_s is not None:
                done = max(done, options.iterations * record.seconds / options.time_s)
            advance(done, note=f"{record.psnr_db:.2f} dB")

        return compute_and_judge(display, targets, options, initial=initial, callback=show, cancel=cancel)


def _frames(target: list[Path], *, video: bool) -> list[list[Pixels]]:
    """Return, for each video frame (or once), the pictures of its planes."""
    if not video:
        return [[read_image(path).pixels for path in target]]
    if len(target) != 1:
        raise BenchError("--video takes one folder or stack of pictures.")
    return [[frame] for frame in read_stack(target[0]).pixels]


def _channel(picture: Pixels, channel: int | None) -> npt.NDArray[Any]:
    if channel is None:
        return picture
    if picture.ndim != 3:
        raise BenchError("--color needs a colour picture; this one is grey.")
    return np.ascontiguousarray(picture[..., channel])


def _print(label: str, result: HologramResult, options: HologramOptions) -> None:
    """Say how good the hologram is, for which grid, envelope and frame count."""
    history = result.hologram.history
    typer.echo(
        f"{label}: {history[-1].iteration} iterations, {result.hologram.seconds:.1f} s: "
        f"{result.hologram.stop_reason}"
    )
    for plane, score in enumerate(result.scores):
        name = f"  plane {plane + 1}: " if len(result.scores) > 1 else "  seen: "
        typer.echo(
            f"{name}{score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}; "
            f"middle quarter {score.crop_psnr_db:.2f} dB, SSIM {score.crop_ssim:.3f}"
        )
    typer.echo(
        f"  (computed on the alias-free grid, envelope {options.envelope}, {options.frames} frame(s), "
        "through the eye's low-pass)"
    )
    typer.echo(f"  light: {result.efficiency:.1%} of what falls on the SLM reaches the field")
