"""``diffuserbench calibrate``: measure what the reconstruction needs to know about the bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calibration_routines.psf.sweep_request import AxialRequest, LateralRequest, VolumeRequest
from instrument.cli import calibrate_angular, calibrate_beads, calibrate_dpc, calibrate_slm
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.numbers import finite, positive
from instrument.cli.sweeping import say_and_take
from instrument.files.errors import BenchError

app = App("Measure PSFs, the sensor's angular response, the diffuser, or how an SLM answers.")

ZMin = Annotated[
    float, typer.Option("--z-min", metavar="MM", callback=finite, help="Nearest plane, from the diffuser.")
]
Planes = Annotated[
    int | None,
    typer.Option(help="Number of planes, evenly spaced in 1/z; left out: as many as the optics need."),
]
Average = Annotated[int, typer.Option(help="Frames a PSF.")]
DarkFrames = Annotated[int, typer.Option(help="Dark frames at the shortest and longest exposure each.")]
X = Annotated[
    float,
    typer.Option(metavar="MM", callback=finite, help="Lateral place of the source, or the grid's centre."),
]
Target = Annotated[
    float,
    typer.Option(callback=finite, help="Level of each PSF's 99.9th percentile, as a fraction of full scale."),
]
Dct = Annotated[
    int,
    typer.Option(metavar="N", help="Remove the N x N lowest DCT coefficients (stray light); 0: none."),
]
BinningText = Annotated[
    str,
    typer.Option(
        "--binning",
        metavar="N|auto",
        help="Software binning, on top of the camera's; auto: as far as the PSF's finest structure allows.",
    ),
]
Every = Annotated[
    int,
    typer.Option(
        "--reference-every", metavar="N", help="PSFs between two visits to the reference point; 0: none."
    ),
]
Lenslet = Annotated[
    float | None,
    typer.Option(
        "--lenslet", metavar="UM", callback=positive, help="Lenslet diameter, for the number of planes."
    ),
]
Wavelength = Annotated[
    float | None,
    typer.Option("--wavelength", metavar="NM", callback=positive, help="For --lenslet; default: [geometry]."),
]
Out = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="Where the run's folder goes; left out: the bench's data folder."),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only say what would be done, and why; nothing moves.")
]
HalfField = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        callback=finite,
        help="Half the grid's width (height); left out: what a reconstruction shows.",
    ),
]
Spacing = Annotated[
    float | None,
    typer.Option(
        "--spacing",
        metavar="MM",
        callback=positive,
        help="Of the points; left out: by Nyquist of the fall-off.",
    ),
]
FallOffDeg = Annotated[
    float | None,
    typer.Option(
        "--fall-off-deg",
        metavar="DEG",
        callback=positive,
        help="Standard deviation of a Gaussian angular response.",
    ),
]
ResponseFile = Annotated[
    Path | None,
    typer.Option("--response", metavar="FILE", help="Angular response, from calibrate angular."),
]


@app.callback()
def calibrate() -> None:
    """Measure what the reconstruction needs to know about the bench."""


app.command(epilog=calibrate_slm.EPILOG)(calibrate_slm.slm)
app.command(epilog=calibrate_angular.EPILOG)(calibrate_angular.angular)
app.command(epilog=calibrate_dpc.EPILOG)(calibrate_dpc.dpc)
app.command(epilog=calibrate_beads.EPILOG)(calibrate_beads.beads)


@app.command(
    epilog=examples(
        "diffuserbench calibrate axial --z-min 100 --z-max 300 --planes 12",
        "diffuserbench calibrate axial --z-min 300          one PSF, 300 mm in front of the diffuser",
        "diffuserbench calibrate axial --z-min 100 --z-max 300 --dry-run",
    )
)
def axial(
    z_min: ZMin,
    z_max: Annotated[
        float | None,
        typer.Option(
            "--z-max", metavar="MM", callback=finite, help="Farthest plane; left out: one PSF at --z-min."
        ),
    ] = None,
    planes: Planes = None,
    average: Average = 4,
    dark_frames: DarkFrames = 4,
    x: X = 0.0,
    y: X = 0.0,
    target: Target = 0.7,
    dct: Dct = 0,
    binning: BinningText = "1",
    reference_every: Every = 16,
    lenslet: Lenslet = None,
    wavelength: Wavelength = None,
    by_hand: Annotated[
        bool, typer.Option("--by-hand", help="The source was placed by hand at --z-min; nothing moves.")
    ] = False,
    dry_run: DryRun = False,
    out: Out = None,
    bench: BenchOption = None,
) -> None:
    """Move the point source along the axis and measure one PSF a plane.

    Finds the exposures without saturating, takes dark frames, sweeps, judges every PSF in words, takes bad
    planes again, and saves the calibration in the run's folder. Ends with the light off.
    """
    with open_and_say(bench) as opened:
        request = AxialRequest(
            z_min_um=1e3 * z_min,
            z_max_um=_micrometres(z_max),
            planes=planes,
            lenslet_um=lenslet,
            wavelength_nm=wavelength,
            x_um=1e3 * x,
            y_um=1e3 * y,
            average=average,
            dark_frames=dark_frames,
            target=target,
            dct_order=dct,
            binning=_binning(binning),
            by_hand=by_hand,
            reference_every=reference_every,
        )
        say_and_take(Console(), opened, request, out, dry_run=dry_run)


@app.command(
    epilog=examples(
        "diffuserbench calibrate lateral --z 300 --dry-run          the grid, and why",
        "diffuserbench calibrate lateral --z 1.7 --fall-off-deg 13 --half-field-x 1.2 --half-field-y 0.8",
        "diffuserbench calibrate lateral --z 300 --spacing 40",
    )
)
def lateral(
    z: Annotated[
        float,
        typer.Option("--z", metavar="MM", callback=positive, help="Depth of the grid, from the diffuser."),
    ],
    half_field_x: HalfField = None,
    half_field_y: HalfField = None,
    spacing: Spacing = None,
    response: ResponseFile = None,
    fall_off_deg: FallOffDeg = None,
    average: Average = 4,
    dark_frames: DarkFrames = 4,
    x: X = 0.0,
    y: X = 0.0,
    target: Target = 0.7,
    dct: Dct = 0,
    binning: BinningText = "1",
    reference_every: Every = 10,
    dry_run: DryRun = False,
    out: Out = None,
    bench: BenchOption = None,
) -> None:
    """Move the point source over a grid at one depth and measure a PSF at each point.

    For a camera whose PSF changes over the field: reconstruct --volume CALIBRATION --model local, lowrank or
    auto. Each pattern's shift is measured and held against the stage; a reference point is visited again and
    again to tell whether the source drifts.
    """
    request = LateralRequest(
        z_um=1e3 * z,
        half_field_x_um=_micrometres(half_field_x),
        half_field_y_um=_micrometres(half_field_y),
        spacing_um=_micrometres(spacing),
        response=response,
        fall_off_deg=fall_off_deg,
        x_um=1e3 * x,
        y_um=1e3 * y,
        average=average,
        dark_frames=dark_frames,
        target=target,
        dct_order=dct,
        binning=_binning(binning),
        reference_every=reference_every,
    )
    with open_and_say(bench) as opened:
        say_and_take(Console(), opened, request, out, dry_run=dry_run)


@app.command(
    epilog=examples(
        "diffuserbench calibrate volume --z-min 100 --z-max 300 --dry-run",
        "diffuserbench calibrate volume --z-min 1.7 --z-max 3 --lenslet 250 --wavelength 520 "
        "--fall-off-deg 13",
    )
)
def volume(
    z_min: ZMin,
    z_max: Annotated[float, typer.Option("--z-max", metavar="MM", callback=finite, help="Farthest plane.")],
    planes: Planes = None,
    half_field_x: HalfField = None,
    half_field_y: HalfField = None,
    spacing: Spacing = None,
    response: ResponseFile = None,
    fall_off_deg: FallOffDeg = None,
    lenslet: Lenslet = None,
    wavelength: Wavelength = None,
    average: Average = 4,
    dark_frames: DarkFrames = 4,
    x: X = 0.0,
    y: X = 0.0,
    target: Target = 0.7,
    dct: Dct = 0,
    binning: BinningText = "1",
    reference_every: Every = 10,
    dry_run: DryRun = False,
    out: Out = None,
    bench: BenchOption = None,
) -> None:
    """Move the point source over a grid at each of several depths, evenly spaced in 1/z.

    As lateral, plane after plane. The number of planes and of points follows from the optics unless given.
    """
    request = VolumeRequest(
        z_min_um=1e3 * z_min,
        z_max_um=1e3 * z_max,
        planes=planes,
        lenslet_um=lenslet,
        wavelength_nm=wavelength,
        half_field_x_um=_micrometres(half_field_x),
        half_field_y_um=_micrometres(half_field_y),
        spacing_um=_micrometres(spacing),
        response=response,
        fall_off_deg=fall_off_deg,
        x_um=1e3 * x,
        y_um=1e3 * y,
        average=average,
        dark_frames=dark_frames,
        target=target,
        dct_order=dct,
        binning=_binning(binning),
        reference_every=reference_every,
    )
    with open_and_say(bench) as opened:
        say_and_take(Console(), opened, request, out, dry_run=dry_run)


def _micrometres(length_mm: float | None) -> float | None:
    return None if length_mm is None else 1e3 * length_mm


def _binning(text: str) -> int:
    """Return the software binning; 0 stands for automatic."""
    if text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise BenchError(f"--binning takes a whole number from 1, or auto; not {text!r}.")
    return int(text)
