"""What a reconstruction reads and writes, declared once (how: :mod:`recon.reconstruction.options`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from instrument.reconstruction.mosaic import MosaicChoice, mosaic_named
from instrument.reconstruction.preparation import Crop, DarkChoice, ErasuresChoice
from instrument.reconstruction.straightened import SrgbChoice
from recon.base.declare import RARE, option
from recon.base.noise import NoiseModel
from recon.camera.factors import PATTERNS
from recon.errors import InputError
from recon.streams.joint import OverTimeName
from recon.streams.video import WARM_ITERATIONS

NoiseChoice = NoiseModel | float | Literal["estimate"] | None
"""A camera's noise; None for what the photograph's metadata say, and estimated where they say nothing."""

_FILES, _PHOTOGRAPH, _VIDEO, _OUTPUT = "Input", "The photograph", "Videos", "Output"
_KEPT = ("picture", "volume")
_NOT_PATTERNED = ("picture", "volume", "video")
_EVERY = (*_NOT_PATTERNED, "patterned picture")


def _dark(text: str) -> DarkChoice:
    """Read ``auto``, an offset in counts, or the name of a dark frame."""
    if text == "auto":
        return "auto"
    try:
        counts = float(text)
    except ValueError:
        return Path(text).expanduser()
    if not math.isfinite(counts):
        raise InputError("the offset must be a finite number of counts.")
    return counts


def _erasures(text: str) -> ErasuresChoice:
    """Read ``none``, ``saturated``, a share of the pixels, or the name of a mask."""
    if text == "none":
        return "none"
    if text == "saturated":
        return "saturated"
    try:
        return float(text)
    except ValueError:
        return Path(text).expanduser()


def _noise(text: str) -> NoiseChoice:
    """Read ``COUNTS``, ``READ,GAIN`` (read noise in counts, counts per electron) or ``estimate``."""
    if text == "estimate":
        return "estimate"
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(math.isfinite(v) and v >= 0 for v in values):
        raise InputError(
            "write a standard deviation in counts (3.5), or read noise in counts and counts per electron "
            "(2.1,0.13), or estimate."
        )
    return values[0] if len(values) == 1 else NoiseModel(*values)


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Photograph, and the camera's response: one PSF, a calibration, or PSFs of several depths."""

    image: Path | None = option(
        None,
        help="The photograph (raw frame).",
        label="Photograph",
        flags=("--image", "-i"),
        applies=("picture", "volume"),
        group=_FILES,
    )
    video: bool = option(
        False,
        help="Every frame of the recording RUN, to NAME.ome.zarr.",
        applies=("video",),
        group=_FILES,
    )
    patterned: Path | None = option(
        None,
        help="One picture of RUN, lit by patterns in turn; SHEET: its plan run on a sheet.",
        metavar="SHEET",
        label="Run on a sheet",
        applies=("patterned picture",),
        group=_FILES,
    )
    psf: Path | None = option(
        None,
        help="The PSF image.",
        flags=("--psf", "-p"),
        applies=("picture", "video"),
        label="PSF image",
        group=_FILES,
    )
    calibration: Path | None = option(
        None,
        help="A calibration, or a run with one, instead of a PSF image.",
        metavar="FOLDER",
        flags=("--calibration", "-c"),
        applies=("picture", "video", "patterned picture"),
        group=_FILES,
    )
    volume: Path | None = option(
        None,
        help="A volume: PSFs, one a depth (folder, stack or calibration).",
        metavar="FOLDER|STACK",
        label="PSFs",
        applies=("volume",),
        group=_FILES,
    )


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """How a photograph and its PSFs become a measurement and a camera."""

    dark: DarkChoice = option(
        "auto",
        help="Dark frame or offset; auto estimates the offset.",
        metavar="FILE|COUNTS",
        parse=_dark,
        applies=_NOT_PATTERNED,
        group=_PHOTOGRAPH,
    )
    crop: Crop | None = option(
        None,
        help="Window in pixels, of PSF and image; HxW is centred.",
        metavar="T,L,H,W|HxW",
        parse=Crop.parse,
        applies=_EVERY,
        group=_PHOTOGRAPH,
    )
    binning: int | None = option(
        None,
        help="Average N x N pixels.",
        default_words="auto, up to 0.5 megapixel",
        none_word="auto",
        least=1,
        flags=("--bin",),
        metavar="N|auto",
        applies=_EVERY,
        group=_PHOTOGRAPH,
    )
    erasures: ErasuresChoice = option(
        "saturated",
        help="Left out: none, saturated (hot, dead), FILE's zeros, a share.",
        metavar="WHICH",
        parse=_erasures,
        applies=_EVERY,
        group=_PHOTOGRAPH,
    )
    mosaic: MosaicChoice = option(
        "auto",
        help=f"Colours of a raw frame: {', '.join(PATTERNS)}, none.",
        default_words="auto: by metadata",
        flags=("--bayer",),
        metavar="MOSAIC",
        parse=mosaic_named,
        applies=_EVERY,
        label="Colour mosaic",
        group=_PHOTOGRAPH,
    )
    noise: NoiseChoice = option(
        None,
        help="Deviation; READ,GAIN: counts, counts per electron; estimate.",
        default_words="by metadata",
        metavar="COUNTS",
        parse=_noise,
        applies=_EVERY,
        group=_PHOTOGRAPH,
    )
    pixel_um: float | None = option(
        None,
        help="Pixel pitch of PSFs, one a depth, that are files.",
        default_words="as their file says",
        unit="um",
        above=0,
        applies=("volume",),
        label="Pixel pitch of PSF files",
        group=RARE,
    )
    distance_mm: float | None = option(
        None,
        help="Diffuser to sensor, of PSFs, one a depth, that are files.",
        default_words="not known",
        unit="mm",
        above=0,
        applies=("volume",),
        label="Diffuser to sensor, of PSF files",
        group=RARE,
    )
    srgb: SrgbChoice = option(
        "none",
        help="sRGB files to straighten.",
        label="Files coded for the eye (sRGB)",
        applies=("picture", "volume"),
        group=RARE,
    )
    allow_saturated: bool = option(
        False,
        help="Accept a PSF image with much of its light in saturated pixels.",
        label="PSF may be saturated",
        applies=("picture",),
        group=RARE,
    )
    allow_mixed_depth: bool = option(
        False,
        help="Accept a PSF image and a photograph of different bit depth.",
        flags=("--mixed-depth",),
        applies=("picture",),
        label="PSF may be of another bit depth",
        group=RARE,
    )


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """What is written, kept or only said."""

    out: Path | None = option(
        None,
        help="float32 TIFF (volumes: or, videos: .ome.zarr), beside it .png and .json.",
        flags=("--out", "-o"),
        label="Result",
        group=_OUTPUT,
    )
    rotate_deg: Literal["0", "90", "180", "270"] = option(
        "0",
        help="Turn the picture counter-clockwise, degrees; 180 if upside down.",
        flags=("--rotate",),
        label="Turned (degrees)",
        applies=("picture", "video", "patterned picture"),
        group=_OUTPUT,
    )
    figure: Path | None = option(
        None,
        help="Also a summary figure (.png, .pdf, .svg).",
        applies=(*_KEPT, "patterned picture"),
        group=_OUTPUT,
    )
    checkpoint: Path | None = option(
        None,
        help="Keep the work here once a minute; the same command goes on from it.",
        metavar="FOLDER",
        applies=(*_KEPT, "patterned picture"),
        group=_OUTPUT,
    )
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite", group=_OUTPUT)
    explain: bool = option(
        False,
        help="Only say what auto would choose, why, and what time and memory it takes.",
        applies=_EVERY,
        group=_OUTPUT,
    )


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """How a recording's frames are solved and shown."""

    warm_iterations: int = option(
        WARM_ITERATIONS,
        help="Iterations of frames that go on from the one before.",
        least=1,
        flags=("--warm",),
        applies=("video",),
        group=_VIDEO,
    )
    over_time: OverTimeName | None = option(
        None,
        help="A prior over time, frames of a block solved together.",
        applies=("video",),
        group=_VIDEO,
    )
    block: int | None = option(
        None,
        help="Frames that hang together.",
        label="Frames a block",
        default_words="32, with --over-time 16",
        least=1,
        applies=("video",),
        group=_VIDEO,
    )
    fps: float | None = option(
        None,
        help="Frames a second of the film.",
        label="Frames a second",
        default_words="the recording's",
        least=0.1,
        metavar="N",
        applies=("video",),
        group=_VIDEO,
    )
    film: bool = option(
        True, help="A film, too.", flags=("--mp4/--no-mp4",), applies=("video",), group=_VIDEO
    )
    workers: int | None = option(
        None,
        help="A Dask cluster of N processes here.",
        default_words="threads",
        least=1,
        applies=("video",),
        group=RARE,
    )
    scheduler: str | None = option(
        None,
        help="A Dask scheduler whose workers see the same files.",
        metavar="tcp://...",
        applies=("video",),
        group=RARE,
    )
    scheduler_owner: str | None = option(
        None,
        help="Whose scheduler it is, if not yours: a user here, or of another machine.",
        metavar="NAME",
        applies=("video",),
        group=RARE,
    )
