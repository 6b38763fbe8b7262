"""``diffuserbench refocus``: a calibrated PSF brought to another depth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.files.errors import BenchError

app = App()


@app.command(
    epilog=examples(
        "diffuserbench refocus runs/axial --z-mm 27.5 --out calibration-27.5",
        "diffuserbench refocus calibration --z-mm 12 --z-mm 14 --z-mm 16 --out near",
    )
)
def refocus(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="A calibration, or a run with one.")
    ],
    z_mm: Annotated[list[float], typer.Option("--z-mm", metavar="MM", help="Depth wanted; repeatable.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="The new calibration.")],
    deflection_deg: Annotated[
        float,
        typer.Option("--deflection-deg", metavar="DEG", help="How far the diffuser typically bends light."),
    ] = 0.25,
    force: Annotated[bool, typer.Option("--force", help="Replace a calibration that exists.")] = False,
) -> None:
    """Bring a calibration's PSF to other depths by paraxial scaling, with the error to expect.

    Between two calibrated depths both neighbours are scaled, registered and mixed (Kuo 2020, Eq. 5.2).
    `reconstruct --calibration FOLDER --z-mm Z` does the same by itself.
    """
    from dataclasses import replace

    import numpy as np

    from instrument.files.calibration_file import load_calibration, save_calibration
    from instrument.reconstruction.job import find_calibration
    from recon.camera.refocus import central_places
    from recon.camera.refocus import refocus as refocused

    if not all(0 < z < float("inf") for z in z_mm):
        raise BenchError("--z-mm: depths are above 0 mm, from the diffuser.")
    if len(set(z_mm)) < len(z_mm):
        raise BenchError("--z-mm: a depth is asked for twice.")
    folder = find_calibration(calibration)
    measured = load_calibration(folder)
    made = [refocused(measured, 1e3 * z, deflection_deg=deflection_deg) for z in z_mm]
    new = replace(
        measured,
        psfs=np.stack([one.psf for one in made]),
        source_positions_um=np.array([(*one.source_um, one.z_um) for one in made]),
        quality={
            "refocused": [
                {
                    "z_um": one.z_um,
                    "from_z_um": one.from_z_um,
                    "displacement_error_um": one.displacement_error_um,
                    "expected_similarity": one.expected_similarity,
                }
                for one in made
            ]
        },
        provenance={**measured.provenance, "refocused_from": str(folder.resolve())},
    )
    path = save_calibration(new, out, overwrite=force)
    if measured.provenance.get("simulated"):
        typer.echo("SIMULATED: the calibration comes from the simulated bench")
    for one in made:
        typer.echo(f"{one.z_um / 1e3:g} mm: {one}")
        if one.extrapolated:
            near, far = (v / 1e3 for v in one.calibrated_um)
            typer.echo(
                f"Warning: {one.z_um / 1e3:g} mm lies outside the calibrated "
                f"{f'{near:.4g} to {far:.4g} mm' if far > near else f'depth, {near:.4g} mm'}: the pattern is "
                "extrapolated, by scaling alone. Measure a PSF there where it matters.",
                err=True,
            )
    if len(measured.psfs) > len(central_places(measured)):
        typer.echo(
            "Note: the calibration has several places at a depth; the one nearest to the axis was taken, how "
            "PSFs vary over the field is lost. reconstruct --model local uses all of them.",
            err=True,
        )
    typer.echo(f"Wrote {path}")
