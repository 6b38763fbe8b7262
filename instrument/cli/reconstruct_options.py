"""The options of ``diffuserbench reconstruct``: their words, and what they mean."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from instrument.reconstruction.mosaic import mosaic_named
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.request import Settings, known_model
from instrument.reconstruction.words import (
    parse_binning,
    parse_dark,
    parse_erasures,
    parse_noise,
    parse_precision,
    parse_wishes,
)
from recon.reconstruction.solve import ITERATIONS


class Method(enum.StrEnum):
    """The methods of :func:`recon.reconstruct`."""

    ADMM = "admm"
    ADMM_SENSOR = "admm-sensor"
    ADMM_GPU = "admm-gpu"  # says what replaces it
    FISTA = "fista"
    WIENER = "wiener"


class PriorName(enum.StrEnum):
    """The priors of :func:`recon.reconstruct`."""

    TV = "tv"
    TV_ISOTROPIC = "tv-isotropic"
    TV_HAAR = "tv-haar"
    L1 = "l1"
    NONNEGATIVE = "nonnegative"
    NONE = "none"


class Rotation(enum.StrEnum):
    """By how much the written picture is turned, degrees counter-clockwise."""

    NONE = "0"
    QUARTER = "90"
    HALF = "180"
    THREE_QUARTERS = "270"


RunArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="[RUN]",
        help="With --video: the recording's folder; with --patterned: the run's.",
        show_default=False,
    ),
]
ImageOption = Annotated[
    Path | None,
    typer.Option("--image", "-i", metavar="FILE", help="The photograph (raw frame).", show_default=False),
]
VideoOption = Annotated[
    bool, typer.Option("--video", help="Every frame of the recording RUN; --out NAME.ome.zarr.")
]
PatternedOption = Annotated[
    Path | None,
    typer.Option(
        "--patterned",
        metavar="SHEET",
        help="One picture of RUN, lit by patterns in turn; SHEET is the same plan's run of a plain sheet.",
        show_default=False,
    ),
]
WarmOption = Annotated[
    int | None,
    typer.Option(
        "--warm",
        min=1,
        metavar="N",
        help="Of a video: iterations of frames that go on from the one before. Default: 4.",
        show_default=False,
    ),
]
BlockOption = Annotated[
    int | None,
    typer.Option(
        "--block",
        min=1,
        metavar="N",
        help="Of a video: frames that hang together. Default: 32, with --over-time 16.",
        show_default=False,
    ),
]
OverTimeOption = Annotated[
    str | None,
    typer.Option(
        "--over-time",
        metavar="tv|lowrank",
        help="Of a video: a prior over time, frames of a block solved together.",
        show_default=False,
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        metavar="N",
        help="Of a video: a Dask cluster of N processes here. Default: threads.",
        show_default=False,
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="tcp://...",
        help="Of a video: a Dask scheduler whose workers see the same files.",
        show_default=False,
    ),
]
FpsOption = Annotated[
    float | None,
    typer.Option(
        "--fps",
        min=0.1,
        metavar="N",
        help="Of a video: frames a second of the film. Default: the recording's.",
        show_default=False,
    ),
]
FilmOption = Annotated[bool, typer.Option("--mp4/--no-mp4", help="Of a video: a film, too.")]
PsfOption = Annotated[
    Path | None, typer.Option("--psf", "-p", metavar="FILE", help="The PSF image.", show_default=False)
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        "-c",
        metavar="FOLDER",
        help="Instead of --psf: a calibration, or a run with one.",
        show_default=False,
    ),
]
VolumeOption = Annotated[
    Path | None,
    typer.Option(
        "--volume",
        metavar="FOLDER|STACK",
        help="A volume: PSFs, one a depth (folder, stack or calibration).",
        show_default=False,
    ),
]
ModelOption = Annotated[
    str,
    typer.Option(
        "--model",
        metavar="auto|convolution|local|lowrank",
        help="Camera model; local, lowrank: PSFs from several places of the field. auto: the smallest model, "
        "depths, field, binning and colours that explain the data.",
    ),
]
ExplainOption = Annotated[
    bool,
    typer.Option(
        "--explain",
        help="Say what auto would choose, why, and what one step up or down would cost; reconstruct nothing.",
    ),
]
ChooseOption = Annotated[
    list[str] | None,
    typer.Option(
        "--choose",
        metavar="NAME=VALUE",
        help="Overrule one of auto's choices (repeatable): model=, planes=all|0-3,7, between=on|off, "
        "field=all, binning=N, channels=all|merged, background=on|off, precision=float32|float64.",
        show_default=False,
    ),
]
BackgroundOption = Annotated[
    bool | None,
    typer.Option(
        "--background/--no-background",
        help="Of a volume: estimate a smooth background as well. Default: auto decides; other models: yes.",
        show_default=False,
    ),
]
PrecisionOption = Annotated[
    str,
    typer.Option(
        "--precision",
        metavar="auto|float32|float64",
        help="Of the arithmetic. auto: float32, unless --model auto finds that it would show. float64 takes "
        "twice the memory and up to twice the time.",
    ),
]
DistanceOption = Annotated[
    float | None,
    typer.Option(
        "--z-mm",
        metavar="MM",
        help="Distance of the scene; a PSF is refocused to it.",
        show_default=False,
    ),
]
DarkOption = Annotated[
    str,
    typer.Option(
        "--dark", metavar="FILE|COUNTS|auto", help="Dark frame or offset; auto estimates the offset."
    ),
]
CropOption = Annotated[
    str | None,
    typer.Option(
        "--crop",
        metavar="T,L,H,W|HxW",
        help="Window in pixels, of PSF and image; HxW is centred.",
        show_default=False,
    ),
]
BinningOption = Annotated[
    str,
    typer.Option("--bin", metavar="N|auto", help="Average N x N pixels; auto: to at most 0.5 megapixel."),
]
ErasuresOption = Annotated[
    str,
    typer.Option(
        "--erasures",
        metavar="none|saturated|FILE|SHARE",
        help="Pixels to leave out: saturated ones, a mask's zeros, or a random share.",
    ),
]
BayerOption = Annotated[
    str,
    typer.Option(
        "--bayer",
        metavar="RGGB|GRBG|GBRG|BGGR|auto|none",
        help="The photograph is a raw frame of this colour mosaic; auto: as its metadata say.",
    ),
]
NoiseOption = Annotated[
    str | None,
    typer.Option(
        "--noise",
        metavar="COUNTS|READ,GAIN|estimate",
        help="Camera noise: one deviation, or read noise in counts and counts per electron. "
        "Default: as the photograph's metadata say, else estimated.",
        show_default=False,
    ),
]
ScratchOption = Annotated[
    Path | None,
    typer.Option(
        "--scratch",
        metavar="FOLDER",
        help="Of a volume: where to keep what does not fit into memory, on a fast disk.",
        show_default=False,
    ),
]
MemoryOption = Annotated[
    float | None,
    typer.Option(
        "--memory",
        metavar="GIB",
        help="Of a volume: memory that may be taken. Default: what is free.",
        show_default=False,
    ),
]
MethodOption = Annotated[
    Method,
    typer.Option(
        "--method",
        "-m",
        help="admm: best; admm-sensor: dense scenes; admm-gpu: on a GPU; fista: plain; wiener: one shot.",
    ),
]
PriorOption = Annotated[
    PriorName | None,
    typer.Option("--prior", help="What the scene is like. Default: tv; none for wiener.", show_default=False),
]
TauOption = Annotated[
    float | None,
    typer.Option(
        "--tau",
        metavar="X",
        help="Weight of the prior, relative to the data. Default: from the noise.",
        show_default=False,
    ),
]
IterationsOption = Annotated[
    int | None,
    typer.Option(
        "--iterations",
        "-n",
        min=1,
        metavar="N",
        help=f"At most N iterations. Default: {ITERATIONS}, or none with --time.",
        show_default=False,
    ),
]
TimeOption = Annotated[
    float | None,
    typer.Option("--time", min=0.0, metavar="S", help="At most S seconds.", show_default=False),
]
StopAtNoiseOption = Annotated[
    bool,
    typer.Option("--stop-at-noise", help="Stop as soon as the residual is down to the expected noise."),
]
CheckpointOption = Annotated[
    Path | None,
    typer.Option(
        "--checkpoint",
        metavar="FOLDER",
        help="Keep the work here, once a minute and at the end; the same command goes on from it.",
        show_default=False,
    ),
]
PositiveBackgroundOption = Annotated[
    bool,
    typer.Option(
        "--positive-background",
        help="Of a volume: a background that is nowhere negative; up to three more runs.",
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance",
        min=0.0,
        metavar="X",
        help="Stop when the relative change an iteration falls below X (and residuals below 10 X). Default: "
        "2e-3 (fista 5e-4; volumes, --model local or lowrank 1e-3; auto, PSFs vary: 2e-3, 3e-3). 0: never.",
        show_default=False,
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="FILE",
        help="float32 TIFF (volumes: or, videos: .ome.zarr); .png and .json go beside it. "
        "Default: reconstruction.tif, video.ome.zarr.",
        show_default=False,
    ),
]
RotateOption = Annotated[
    Rotation,
    typer.Option("--rotate", help="Turn the picture counter-clockwise, degrees; 180 if upside down."),
]
FigureOption = Annotated[
    Path | None,
    typer.Option(
        "--figure", metavar="FILE", help="Also a summary figure (.png, .pdf, .svg).", show_default=False
    ),
]
DeviceOption = Annotated[
    str,
    typer.Option(
        "--device", metavar="cpu|gpu", help="Of a volume: where to compute (pictures: --method admm-gpu)."
    ),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]
AllowSaturatedOption = Annotated[
    bool,
    typer.Option("--allow-saturated", help="Accept a PSF with much of its light in saturated pixels."),
]
MixedDepthOption = Annotated[
    bool, typer.Option("--mixed-depth", help="Accept PSF and image of different bit depth.")
]


def parse_settings(
    *,
    model: str,
    dark: str,
    crop: str | None,
    binning: str,
    erasures: str,
    noise: str | None,
    prior: PriorName | None,
    tau: float | None,
    iterations: int | None,
    time_s: float | None,
    tolerance: float | None,
    stop_at_noise: bool,
    bayer: str,
    choices: list[str] | None = None,
    precision: str = "auto",
) -> Settings:
    """Understand the options that pictures and volumes share.

    Raises
    ------
    BenchError
        Which option is not understood, and what is expected.
    """
    wishes = parse_wishes(model, choices or [])
    return Settings(
        model=known_model(model),
        dark=parse_dark(dark),
        crop=None if crop is None else Crop.parse(crop),
        binning=parse_binning(binning),
        erasures=parse_erasures(erasures),
        noise=parse_noise(noise),
        prior=None if prior is None else prior.value,
        tau=tau,
        iterations=iterations,
        time_s=time_s,
        tolerance=tolerance,
        stop_at_noise=stop_at_noise,
        mosaic=mosaic_named(bayer),
        wishes=wishes,
        precision=parse_precision(precision, wishes),
    )
