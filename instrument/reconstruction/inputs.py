"""What a reconstruction starts from, declared once: the files, and how a photograph becomes a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from instrument.reconstruction.erasures import Choice as ErasuresChoice
from instrument.reconstruction.job import DarkChoice, NoiseChoice
from instrument.reconstruction.mosaic import MosaicChoice, mosaic_named
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.words import parse_dark, parse_erasures, parse_noise
from recon.base.declare import RARE, option
from recon.camera.bayer import PATTERNS

_FILES, _PHOTOGRAPH = "Input", "The photograph"
_NOT_PATTERNED = ("picture", "volume", "video")


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Photograph, and the camera's response: one PSF, a calibration, or PSFs of several depths."""

    image: Path | None = option(
        None,
        help="The photograph (raw frame).",
        flags=("--image", "-i"),
        applies=("picture", "volume"),
        group=_FILES,
    )
    psf: Path | None = option(
        None, help="The PSF image.", flags=("--psf", "-p"), applies=("picture", "video"), group=_FILES
    )
    calibration: Path | None = option(
        None,
        help="Instead of --psf: a calibration, or a run with one.",
        metavar="FOLDER",
        flags=("--calibration", "-c"),
        applies=("picture", "video", "patterned picture"),
        group=_FILES,
    )
    volume: Path | None = option(
        None,
        help="A volume: PSFs, one a depth (folder, stack or calibration).",
        metavar="FOLDER|STACK",
        applies=("volume",),
        group=_FILES,
    )


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """How a photograph and its PSFs become a measurement and a camera."""

    dark: DarkChoice = option(
        "auto",
        help="Dark frame or offset; auto estimates the offset.",
        metavar="FILE|COUNTS|auto",
        parse=parse_dark,
        applies=_NOT_PATTERNED,
        group=_PHOTOGRAPH,
    )
    crop: Crop | None = option(
        None,
        help="Window in pixels, of PSF and image; HxW is centred.",
        metavar="T,L,H,W|HxW",
        parse=Crop.parse,
        applies=_NOT_PATTERNED,
        group=_PHOTOGRAPH,
    )
    binning: int | None = option(
        None,
        help="Average N x N pixels.",
        default_words="auto: to at most 0.5 megapixel",
        none_word="auto",
        least=1,
        flags=("--bin",),
        metavar="N|auto",
        applies=(*_NOT_PATTERNED, "patterned picture"),
        group=_PHOTOGRAPH,
    )
    erasures: ErasuresChoice = option(
        "saturated",
        help="Pixels to leave out: saturated ones, a mask's zeros, or a random share.",
        metavar="none|saturated|FILE|SHARE",
        parse=parse_erasures,
        applies=_NOT_PATTERNED,
        group=_PHOTOGRAPH,
    )
    mosaic: MosaicChoice = option(
        "auto",
        help="It is a raw frame of this colour mosaic; auto: as its metadata say.",
        flags=("--bayer",),
        metavar=f"{'|'.join(PATTERNS)}|auto|none",
        parse=mosaic_named,
        applies=("picture", "volume"),
        label="Colour mosaic",
        group=_PHOTOGRAPH,
    )
    noise: NoiseChoice = option(
        None,
        help="Camera noise: one deviation, or read noise in counts and counts per electron.",
        default_words="as its metadata say, else estimated",
        metavar="COUNTS|READ,GAIN|estimate",
        parse=parse_noise,
        applies=_NOT_PATTERNED,
        group=_PHOTOGRAPH,
    )
    allow_saturated: bool = option(
        False,
        help="Accept a PSF image with much of its light in saturated pixels.",
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
