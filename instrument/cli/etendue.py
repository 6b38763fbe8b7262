"""``diffuserbench etendue``: field of view, eyebox and resolution of a holographic display."""

from __future__ import annotations

import re
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from instrument.cli.app import App, examples
from instrument.files.errors import BenchError
from recon.holography import Etendue, eyebox_for_field_of_view, field_of_view_for_eyebox, pixels_for

app = App()


@app.command(
    epilog=examples(
        "diffuserbench etendue",
        "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --fov 120",
        "diffuserbench etendue --slm 2464x4160 --pitch-um 3.74 --wavelength-nm 532 --eyebox-mm 10",
        "diffuserbench etendue --slm 540x960 --pitch-um 16 --expansion 16 --f1-mm 75 --f2-mm 150",
    )
)
def etendue(
    slm: Annotated[str, typer.Option("--slm", metavar="HxW", help="SLM pixels, height x width.")] = "540x960",
    pitch_um: Annotated[float, typer.Option("--pitch-um", help="SLM pixel pitch.")] = 16.0,
    wavelength_nm: Annotated[float, typer.Option("--wavelength-nm")] = 660.0,
    expansion: Annotated[
        float | None,
        typer.Option(
            "--expansion",
            "-q",
            min=1.0,
            help="Only this expansion. Default: 1, 4, 16, 36.",
            show_default=False,
        ),
    ] = None,
    f1_mm: Annotated[float, typer.Option("--f1-mm", help="Focal length of the Fourier lens.")] = 75.0,
    f2_mm: Annotated[float, typer.Option("--f2-mm", help="Focal length of the eyepiece.")] = 75.0,
    fov: Annotated[
        float | None,
        typer.Option(
            "--fov", metavar="DEG", help="The eyebox left at this width of field.", show_default=False
        ),
    ] = None,
    eyebox_mm: Annotated[
        float | None,
        typer.Option(
            "--eyebox-mm", metavar="MM", help="The field left with this eyebox.", show_default=False
        ),
    ] = None,
) -> None:
    """Field of view, eyebox and pixels per degree of a holographic display (Kuo 2020, Eqs. 7.1 to 7.10).

    With --fov or --eyebox-mm: what is left of the other, for the SLM's width, exactly and in the small angle
    approximation (the dissertation's 1.05 mm for the GAEA-2 at 120 degrees is the latter).
    """
    height, width = parse_size(slm)
    console = Console()
    table = Table(title=f"{width} x {height} pixels of {pitch_um:g} um at {wavelength_nm:g} nm")
    for name in ("expansion q", "mask pixel", "field of view", "eyebox", "resolution", "étendue (width)"):
        table.add_column(name, justify="right")
    for q in (expansion,) if expansion else (1.0, 4.0, 16.0, 36.0):
        x, y = (Etendue(n, pitch_um, wavelength_nm, q, f1_mm, f2_mm) for n in (width, height))
        table.add_row(
            f"{q:g}",
            f"{x.mask_pitch_um:.2f} um",
            f"{x.field_of_view_deg:.1f} deg square",
            f"{x.eyebox_mm:.2f} x {y.eyebox_mm:.2f} mm",
            f"{x.pixels_per_degree:.0f} x {y.pixels_per_degree:.0f} px/deg",
            f"{x.etendue_mm:.3f} mm",
        )
    console.print(table)
    for q in (expansion,) if expansion else (1.0, 4.0, 16.0, 36.0):
        x = Etendue(width, pitch_um, wavelength_nm, q, f1_mm, f2_mm)
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
        exact_n, small_n = (pixels_for(wavelength_nm, fov, eyebox_mm, paraxial=p) for p in (False, True))
        typer.echo(f"Both without a mask need {exact_n} pixels (paraxial {small_n}) along the width.")


def parse_size(text: str) -> tuple[int, int]:
    """Return ``(height, width)`` from a text like ``1080x1920``."""
    found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not found:
        raise BenchError(f"--slm {text!r}: write height x width in pixels, e.g. 1080x1920.")
    return int(found[1]), int(found[2])
