"""What calibrations tell: ``analyze`` their optics, ``compare`` two, ``refocus`` one to another depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples, saying_what_is_left
from instrument.cli.options import Given
from instrument.cli.progress import one_task
from instrument.files.atomic import require_new
from instrument.files.errors import BenchError, FileError
from recon.analysis import AnalysisSettings, Noise
from recon.base.declare import option
from recon.types import Calibration

analyze_app, compare_app, refocus_app = App(), App(), App()
CalibrationArgument = Annotated[
    Path, typer.Argument(metavar="CALIBRATION", help="A calibration, or a run with one.")
]
_PAGES = (".pdf", ".png", ".svg")


@dataclass(frozen=True, kw_only=True)
class AnalysisFiles:
    """What an analysis reads besides the calibration, and what it writes."""

    out: Path = option(
        Path("analysis.pdf"),
        help="The page (.pdf, .png, .svg); JSON beside.",
        flags=("--out", "-o"),
        group="Files",
    )
    response: Path | None = option(
        None,
        help="Instead of --cutoff-deg: angular_response.json of calibrate angular.",
        group="Files",
    )
    force: bool = option(False, help="Overwrite files that exist.", group="Files")


@dataclass(frozen=True, kw_only=True)
class RefocusOptions:
    """To which depths a PSF is brought."""

    z_um: tuple[float, ...] = option(
        help="Depth wanted; repeatable.", unit="um", shown_unit="mm", shown_factor=1000.0, above=0
    )
    out: Path = option(help="The new calibration.", metavar="FOLDER", flags=("--out", "-o"))
    deflection_deg: float = option(
        0.25, help="How far the diffuser typically bends light.", unit="deg", above=0
    )
    force: bool = option(False, help="Replace a calibration that exists.")


@analyze_app.command(
    epilog=examples(
        "diffuserbench analyze runs/2026-11-21-axial",
        "diffuserbench analyze calibration --cutoff-deg 41.5,30 --out supplement.pdf",
        "diffuserbench analyze calibration --z-mm 2.5 --fall-off-deg 13 --lenslet-um 250 --wavelength-nm 520",
        "diffuserbench analyze calibration --no-points          without reconstructions: seconds",
    )
)
def analyze(
    calibration: CalibrationArgument,
    files: AnalysisFiles,
    settings: AnalysisSettings,
    noise: Noise,
    given: Given,
) -> None:
    """Resolution, depth of field, field of view, conditioning, point tests and a voxel grid, on one page.

    Everything follows from the calibration's PSFs and its geometry; what they cannot tell (the sensor's
    angular cut-off, the diffuser's deflection) is given as options or named on the page as not known.
    """
    from calibration_routines.optics.angular_response import load_response
    from instrument.evaluation.analysis_figure import draw_analysis, facts
    from instrument.files.atomic import write_json
    from instrument.files.calibration_file import load_calibration
    from instrument.files.figures import save_figure
    from instrument.files.record import plain
    from instrument.reconstruction.job import find_calibration
    from recon.analysis import analyse

    out, record = files.out, files.out.with_suffix(".json")
    if out.suffix.lower() not in _PAGES:
        raise BenchError(f"--out {out}: the page is one of {', '.join(_PAGES)}.")
    for file in (out, record):
        require_new(file, overwrite=files.force)
    if files.response is not None and (instead := given.flags("cutoff_deg", "fall_off_deg")):
        raise BenchError(f"--response says what {' and '.join(instead)} would: give one of them.")
    measured_response = None if files.response is None else load_response(files.response)
    folder = find_calibration(calibration)
    if folder != calibration:
        typer.echo(f"{'Analyses':<28}{folder}")
    measured = load_calibration(folder)
    settings = replace(settings, noise=noise)
    if measured_response is not None:
        cutoff = (measured_response.along_y.cut_off_deg, measured_response.along_x.cut_off_deg)
        settings = replace(settings, cutoff_deg=cutoff, fall_off=measured_response.fall_off())
    simulated = bool(measured.provenance.get("simulated"))
    with saying_what_is_left(out, record):
        with one_task("analyze") as advance:
            analysis = analyse(measured, settings, on_progress=lambda _what, share: advance(share * 100, 100))
        title, subtitle = _titles(measured, folder)
        figure = draw_analysis(analysis, title, subtitle, simulated=simulated)
        save_figure(figure, out)
        described = {
            "calibration": str(folder.resolve()),
            "simulated": simulated,
            "provenance": measured.provenance,
            "analysis": plain(analysis.figures()),
        }
        write_json(record, described)
    if simulated:
        typer.echo("SIMULATED: the calibration comes from the simulated bench")
    for name, value in facts(analysis):
        typer.echo(f"{name:<28}{value}")
    for note in analysis.notes:
        typer.echo(f"Note: {note}", err=True)
    typer.echo(f"Wrote {out}, {record}")


def _titles(calibration: Calibration, folder: Path) -> tuple[str, str]:
    """Return what the page is about and where it comes from, for readers who never saw the folder."""
    bench = str(calibration.provenance.get("bench") or "").split(" SIMULATED")[0]  # the page says that apart
    geometry, place = calibration.geometry, folder.resolve()
    name = place.parent.name if place.name == "calibration" else place.name
    depths_mm = sorted({float(z) / 1e3 for z in calibration.source_positions_um[:, 2]})
    depths = f"{len(depths_mm)} depths from {depths_mm[0]:.3g} to {depths_mm[-1]:.3g} mm"
    if len(depths_mm) == 1:
        depths = f"one depth, {depths_mm[0]:.3g} mm"
    facts = [
        f"{len(calibration.psfs)} PSF{'s' if len(calibration.psfs) > 1 else ''} at {depths}",
        f"pixels of {geometry.pixel_pitch_um:.3g} µm",
        f"diffuser to sensor {geometry.diffuser_distance_mm:.3g} mm",
        f"calibration {name}",
    ]
    return f"Optical characterisation{f': {bench}' if bench else ''}", "; ".join(facts)


@compare_app.command(
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
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table

    from instrument.files.atomic import write_json
    from instrument.files.calibration_file import load_calibration
    from instrument.files.record import plain
    from instrument.reconstruction.job import find_calibration
    from recon.analysis.compare import compare as compare_calibrations

    if out is not None:
        require_new(out, overwrite=force)
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
        write_json(out, plain(record))
        typer.echo(f"Wrote {out}")
    if found.due:
        raise typer.Exit(1)


@refocus_app.command(
    epilog=examples(
        "diffuserbench refocus runs/axial --z-mm 27.5 --out calibration-27.5",
        "diffuserbench refocus calibration --z-mm 12 --z-mm 14 --z-mm 16 --out near",
    )
)
def refocus(calibration: CalibrationArgument, options: RefocusOptions) -> None:
    """Bring a calibration's PSF to other depths by paraxial scaling, with the error to expect.

    Between two calibrated depths both neighbours are scaled, registered and mixed (Kuo 2020, Eq. 5.2).
    `reconstruct --calibration FOLDER --z-mm Z` does the same by itself.
    """
    import numpy as np

    from instrument.files.calibration_file import load_calibration, save_calibration
    from instrument.reconstruction.job import find_calibration
    from recon.camera.refocus import central_places
    from recon.camera.refocus import refocus as refocused

    if len(set(options.z_um)) < len(options.z_um):
        raise BenchError("--z-mm: a depth is asked for twice.")
    folder = find_calibration(calibration)
    measured = load_calibration(folder)
    made = [refocused(measured, z, deflection_deg=options.deflection_deg) for z in options.z_um]
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
    path = save_calibration(new, options.out, overwrite=options.force)
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
