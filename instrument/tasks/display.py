"""Holographic displays in figures: field of view and eyebox, the dissertation's comparison of methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from instrument.display.hologram_files import rows, write_chart, write_csv
from instrument.files.atomic import require_new
from instrument.files.figures import ACCENT, INK, check_figure, save_figure, style
from instrument.files.sample_images import DEFAULT_SAMPLES, SAMPLES, load_sample
from instrument.tasks.task import Desk, Done, saying_what_is_left, task
from recon.base.declare import option
from recon.base.option_text import size
from recon.holography import (
    Etendue,
    eyebox_for_field_of_view,
    field_of_view_for_eyebox,
    pixels_for,
    pixels_per_degree,
)
from recon.holography.scores import GRIDS, METHODS, Cell, run_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        label="SLM",
        default_words="540x960",
        metavar="HxW",
        parse=size,
    )
    pitch_um: float = option(16.0, help="SLM pixel pitch.", unit="um", above=0)
    wavelength_nm: float = option(660.0, help="Of the laser.", unit="nm", above=0)
    expansion: float | None = option(
        None, help="Only this expansion.", default_words="1, 4, 16, 36", least=1, flags=("--expansion", "-q")
    )
    f1_mm: float = option(
        75.0, help="Focal length of the Fourier lens.", unit="mm", above=0, label="Fourier lens"
    )
    f2_mm: float = option(75.0, help="Focal length of the eyepiece.", unit="mm", above=0, label="Eyepiece")
    fov_deg: float | None = option(
        None,
        help="Say the eyebox left at this width of field.",
        unit="deg",
        above=0,
        flags=("--fov",),
        label="Field of view",
    )
    eyebox_mm: float | None = option(None, help="Say the field left with this eyebox.", unit="mm", above=0)
    figure: Path | None = option(None, help="Also a page: eyebox against field of view (.png, .pdf, .svg).")
    force: bool = option(False, help="Overwrite a page that exists.", label="Overwrite")

    def along(self, pixels: int, expansion: float) -> Etendue:
        """Return one axis of the display."""
        return Etendue(pixels, self.pitch_um, self.wavelength_nm, expansion, self.f1_mm, self.f2_mm)


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How much of the table is made, and where it goes."""

    slm: tuple[int, int] = option(
        (135, 240), help="SLM pixels.", default_words="135x240", metavar="HxW", label="SLM", parse=size
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
        Path("table71"),
        help="Writes NAME.csv and NAME.png.",
        metavar="NAME",
        flags=("--out", "-o"),
        label="Result",
    )
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite")


@task(
    "diffuserbench etendue",
    "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --fov 120",
    "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --eyebox-mm 10",
    "diffuserbench etendue --slm 540x960 --pitch-um 16 --expansion 16 --f1-mm 75 --f2-mm 150",
    "diffuserbench etendue --fov 60 --figure etendue.png",
)
def etendue(desk: Desk, options: EtendueOptions) -> Done:
    """Field of view, eyebox and pixels per degree of a holographic display (Kuo 2020, Eqs. 7.1 to 7.10).

    With --fov or --eyebox-mm: what is left of the other, for the SLM's width, exactly and in the small angle
    approximation (the dissertation's 1.05 mm for the GAEA-2 at 120 degrees is the latter).
    """
    (height, width), fov, eyebox_mm = options.slm, options.fov_deg, options.eyebox_mm
    if options.figure is not None:
        check_figure(options.figure, overwrite=options.force)
    expansions = (options.expansion,) if options.expansion else (1.0, 4.0, 16.0, 36.0)
    nm = options.wavelength_nm
    lines = []
    for q in expansions:
        x, y = (options.along(n, q) for n in (width, height))
        lines.append(
            (
                f"{q:g}",
                f"{x.mask_pitch_um:.2f}",
                f"{x.field_of_view_deg:.1f}",
                f"{x.eyebox_mm:.2f} x {y.eyebox_mm:.2f}",
                f"{pixels_per_degree(x, y):.0f}",
                f"{x.etendue_mm:.3f}",
            )
        )
    headings = (
        "expansion",
        "mask pixel, um",
        "field of view, deg",
        "eyebox, mm",
        "resolution, px/deg",
        "étendue, mm",
    )
    title = f"{width} x {height} pixels of {options.pitch_um:g} um at {nm:g} nm"
    desk.table(headings, lines, f"{title}; the field is square, the étendue is of the width")
    for q in expansions:
        x = options.along(width, q)
        if fov is not None:
            exact, small = (eyebox_for_field_of_view(x, fov, paraxial=p) for p in (False, True))
            desk.say(
                f"q = {q:g}: {fov:g} degrees leave an eyebox of {exact:.2f} mm (paraxial {small:.2f} mm)"
            )
        if eyebox_mm is not None:
            exact, small = (field_of_view_for_eyebox(x, eyebox_mm, paraxial=p) for p in (False, True))
            desk.say(
                f"q = {q:g}: an eyebox of {eyebox_mm:g} mm leaves {exact:.1f} degrees (paraxial {small:.1f})"
            )
    if fov is not None and eyebox_mm is not None:
        exact_n, small_n = (pixels_for(nm, fov, eyebox_mm, paraxial=p) for p in (False, True))
        desk.say(f"Both without a mask need {exact_n} pixels (paraxial {small_n}) along the width.")
    if options.figure is None:
        return Done()
    axes = [options.along(width, q) for q in expansions]
    with desk.step("drawing"):
        return Done((save_figure(_etendue_page(axes, title, options), options.figure),))


def _etendue_page(displays: Sequence[Etendue], title: str, options: EtendueOptions) -> Figure:
    """Draw what each expansion leaves of eyebox and field of view; a dot where these lenses put it."""
    import numpy as np
    from matplotlib.figure import Figure

    page = Figure(figsize=(7.5, 5.2), dpi=110, layout="constrained", facecolor="white")
    axes = page.add_subplot()
    degrees = np.linspace(2, 178, 177)
    for display in displays:
        left_mm = [eyebox_for_field_of_view(display, float(deg)) for deg in degrees]
        (line,) = axes.semilogy(degrees, left_mm, label=f"expansion {display.expansion:g}")
        axes.plot(display.field_of_view_deg, display.eyebox_mm, "o", color=line.get_color())
    for wanted, draw in ((options.fov_deg, axes.axvline), (options.eyebox_mm, axes.axhline)):
        if wanted is not None:
            draw(wanted, color=ACCENT, linewidth=1, linestyle="--")
    style(axes, title, "field of view (degrees)", "eyebox (mm)")
    axes.legend(frameon=False, labelcolor=INK, title="dots: with these lenses")
    return page


@task(
    "diffuserbench table7.1",
    "diffuserbench table7.1 --slm 540x960 --iterations 200 --out table71-full",
    "diffuserbench table7.1 --expansion 4 --pictures portrait,relief,head",
)
def table(desk: Desk, options: TableOptions) -> Done:
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
    total = len(factors) * len(names) * len(GRIDS) * len(METHODS)
    with saying_what_is_left(*files), desk.step("table 7.1", total) as advance:
        done = 0

        def show(cell: Cell) -> None:
            nonlocal done
            done += 1
            advance(done, note=f"{cell.expansion}x {cell.picture} {cell.method}")

        loaders = {name: partial(load_sample, name) for name in names}
        cells = run_table(loaders, shape, expansions=factors, iterations=options.iterations, on_progress=show)
        note = f"{shape[1]} x {shape[0]} SLM pixels, {options.iterations} iterations, "
        note += f"pictures: {', '.join(names)}"
        write_csv(files[0], cells)
        write_chart(files[1], cells, note)
    _tell_table(desk, cells, note)
    for name in names:
        desk.say(f"{name}: {SAMPLES[name].source}")
    desk.say(f"{files[0]} has every picture, SSIM too.")
    return Done(files)


def _tell_table(desk: Desk, cells: list[Cell], note: str) -> None:
    headings = ("printed", "its grid, judged on it", "its grid, alias-free", "alias-free grid")
    for crop in (False, True):
        lines = [
            (f"{q}x", method, *(f"{v:.2f}" for v in figures)) for q, method, figures in rows(cells, crop=crop)
        ]
        title = f"PSNR in dB, {'middle quarter' if crop else 'whole field'} (computed). {note}"
        desk.table(("expansion", "method", *headings), lines, title)
