"""``diffuserbench analyze``: what the optics of a calibration can do, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples, saying_what_is_left
from instrument.cli.progress import one_task
from instrument.files.errors import BenchError, FileError
from recon.types import Calibration

app = App()
_PAGES = (".pdf", ".png", ".svg")


@app.command(
    epilog=examples(
        "diffuserbench analyze runs/2026-11-21-axial",
        "diffuserbench analyze calibration --cutoff-deg 41.5,30 --out supplement.pdf",
        "diffuserbench analyze calibration --z-mm 2.5 --fall-off-deg 13 --lenslet-um 250 --wavelength-nm 520",
        "diffuserbench analyze calibration --no-points          without reconstructions: seconds",
    )
)
def analyze(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="A calibration, or a run with one.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="The page (.pdf, .png, .svg); JSON beside."),
    ] = Path("analysis.pdf"),
    z_mm: Annotated[
        float | None,
        typer.Option(
            "--z-mm", metavar="MM", help="Depth to analyse. Default: the middle in 1/z.", show_default=False
        ),
    ] = None,
    deflection_deg: Annotated[
        float,
        typer.Option("--deflection-deg", metavar="DEG", help="The diffuser's largest deflection."),
    ] = 0.5,
    cutoff_deg: Annotated[
        str | None,
        typer.Option(
            "--cutoff-deg",
            metavar="X,Y",
            help="Angles at which the sensor's response is down to 20 % (calibrate angular).",
            show_default=False,
        ),
    ] = None,
    response: Annotated[
        Path | None,
        typer.Option(
            "--response",
            metavar="FILE",
            help="Instead of --cutoff-deg: angular_response.json of calibrate angular.",
            show_default=False,
        ),
    ] = None,
    fall_off_deg: Annotated[
        float | None,
        typer.Option(
            "--fall-off-deg",
            metavar="DEG",
            help="Sigma of the sensor's angular response. Default: from --cutoff-deg.",
            show_default=False,
        ),
    ] = None,
    lenslet_um: Annotated[
        float | None,
        typer.Option("--lenslet-um", help="Diameter of a microlens diffuser's lenses.", show_default=False),
    ] = None,
    wavelength_nm: Annotated[
        float | None,
        typer.Option("--wavelength-nm", help="Default: the calibration's.", show_default=False),
    ] = None,
    points: Annotated[
        bool, typer.Option("--points/--no-points", help="Two- and 16-point tests by reconstructions.")
    ] = True,
    electrons: Annotated[
        float, typer.Option("--electrons", min=1.0, help="Point tests: electrons at the brightest pixel.")
    ] = 10_000.0,
    read_noise_e: Annotated[
        float, typer.Option("--read-noise", min=0.0, metavar="E", help="Point tests: read noise, electrons.")
    ] = 2.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Resolution, depth of field, field of view, conditioning, point tests and a voxel grid, on one page.

    Everything follows from the calibration's PSFs and its geometry; what they cannot tell (the sensor's
    angular cut-off, the diffuser's deflection) is given as options or named on the page as not known.
    """
    import json

    from calibration_routines.optics.angular_response import load_response
    from instrument.evaluation.analysis_figure import draw_analysis, facts
    from instrument.files.atomic import whole_file, write_text
    from instrument.files.calibration_file import load_calibration
    from instrument.files.figures import save_figure
    from instrument.reconstruction.job import find_calibration
    from recon.analysis import AnalysisSettings, Noise, analyse

    if out.suffix.lower() not in _PAGES:
        raise BenchError(f"--out {out}: the page is one of {', '.join(_PAGES)}.")
    record = out.with_suffix(".json")
    for file in (out, record):
        if file.exists() and not force:
            raise FileError(file, "exists already.", "Choose another name, or overwrite with --force.")
    if z_mm is not None and not z_mm > 0:
        raise BenchError(f"--z-mm {z_mm:g}: a depth is above 0 mm, from the diffuser.")
    if response is not None and (cutoff_deg, fall_off_deg) != (None, None):
        raise BenchError("--response says what --cutoff-deg and --fall-off-deg would: give one of them.")
    measured_response = None if response is None else load_response(response)
    folder = find_calibration(calibration)
    if folder != calibration:
        typer.echo(f"{'Analyses':<28}{folder}")
    measured = load_calibration(folder)
    settings = AnalysisSettings(
        z_um=None if z_mm is None else 1e3 * z_mm,
        deflection_deg=deflection_deg,
        cutoff_deg=_cutoff(cutoff_deg)
        if measured_response is None
        else (measured_response.along_y.cut_off_deg, measured_response.along_x.cut_off_deg),
        fall_off=None if measured_response is None else measured_response.fall_off(),
        fall_off_deg=fall_off_deg,
        lenslet_um=lenslet_um,
        wavelength_nm=wavelength_nm,
        points=points,
        noise=Noise(electrons, read_noise_e),
    )
    simulated = bool(measured.provenance.get("simulated"))
    with saying_what_is_left(out, record):
        with one_task("analyze") as advance:
            analysis = analyse(measured, settings, progress=lambda _what, share: advance(share * 100, 100))
        title, subtitle = _titles(measured, folder)
        figure = draw_analysis(analysis, title, subtitle, simulated=simulated)
        with whole_file(out) as file:
            save_figure(figure, file)
        described = {
            "calibration": str(folder.resolve()),
            "simulated": simulated,
            "provenance": measured.provenance,
            "analysis": analysis.as_json(),
        }
        write_text(record, json.dumps(described, indent=2, allow_nan=False) + "\n")
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


def _cutoff(text: str | None) -> tuple[float, float] | None:
    """Parse ``X,Y`` (or one number for both) to ``(y, x)``."""
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(0 < v < 90 for v in values):
        raise BenchError(
            f"--cutoff-deg {text!r}: one or two angles between 0 and 90, as 41.5,30 for x and y."
        )
    return values[-1], values[0]
