"""Raw frames of a colour mosaic sensor: prepared so that the mosaic stays part of the camera's model."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.preparation import Crop, FloatImage, reduce
from recon.arrays import BoolArray, Float32Array
from recon.camera.factors import PATTERNS, Pattern, interpolate_bayer, split_bayer
from recon.errors import InputError
from recon.types import Calibration

MosaicChoice = Pattern | Literal["auto"] | None
"""A colour mosaic; None for none; "auto" for what the image's metadata say."""

_GENICAM: dict[str, Pattern] = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}


def mosaic_named(text: str) -> MosaicChoice:
    """Return the pattern of that name; None for ``none``.

    Raises InputError.
    """
    if text == "none":
        return None
    if text == "auto":
        return "auto"
    found = next((p for p in get_args(Pattern) if p == text.upper()), None)
    if found is None:
        raise InputError(
            f"choose one of {', '.join(PATTERNS)}, auto (by what the photograph's metadata say) or none."
        )
    pattern: Pattern = found
    return pattern


def mosaic_of(image: ImageFile) -> Pattern | None:
    """Return the mosaic that an image's metadata tell of, as the camera's driver wrote it; else None."""
    return None if image.is_colour else _named(str(image.metadata.get("pixel_format", "")))


def in_colours(image: Float32Array, pixel_format: str) -> Float32Array:
    """Return a raw frame of a mosaic sensor as (height, width, 3), interpolated; any other image as it is."""
    pattern = None if image.ndim == 3 else _named(pixel_format)
    return image if pattern is None else interpolate_bayer(image, pattern)


_PHASES = 0.05
"""Share of the light by which a mosaic's colours differ at least; white light on silicon gives far more."""


def suspected_mosaic(image: ImageFile) -> str:
    """Ask whether a grey image without metadata is a mosaic's raw frame; empty where it does not look so.

    The four pixels of a 2 x 2 cell, averaged over the picture, agree in a grey image; in a raw frame two on a
    diagonal (green) agree and the others do not.
    """
    height, width = (side - side % 2 for side in image.pixels.shape[:2])
    if image.is_colour or "pixel_format" in image.metadata or min(height, width) < 64:
        return ""
    cells = image.pixels[:height, :width].astype(np.float64).reshape(height // 2, 2, width // 2, 2)
    a, b, c, d = np.nanmean(cells, axis=(0, 2)).ravel()
    spread = max(a, b, c, d) - min(a, b, c, d)
    if spread <= _PHASES * (np.mean((a, b, c, d)) - np.nanpercentile(image.pixels, 1)):
        return ""
    greens = {("GRBG", "GBRG"): abs(a - d), ("RGGB", "BGGR"): abs(b - c)}
    patterns = min(greens, key=lambda one: greens[one])
    if greens[patterns] > 0.2 * spread:
        return ""
    return (
        f"{image.path} looks like the raw frame of a colour mosaic and is taken as grey: say --bayer "
        f"{patterns[0]} or --bayer {patterns[1]} if it is one, --bayer none if not."
    )


def _named(pixel_format: str) -> Pattern | None:
    return _GENICAM.get(pixel_format[5:7]) if pixel_format.startswith("Bayer") else None


def require_mosaic(image: ImageFile, pattern: Pattern) -> None:
    """Refuse an image that cannot be a mosaic's raw frame.

    Raises FileError.
    """
    height, width = image.pixels.shape[:2]
    if image.is_colour or min(height, width) < 2:
        raise FileError(
            image.path,
            f"is {image.describe()}; a raw {pattern} frame is grey, of at least 2 x 2 pixels.",
            "Leave --bayer out for a picture that is colour already.",
        )


def require_whole_cells(image: ImageFile, match: int) -> None:
    """Refuse a raw frame of whose pixels an odd number, along each side, makes one of its calibration's.

    Raises FileError.
    """
    if match > 1 and match % 2:
        raise FileError(
            image.path,
            f"is a colour mosaic's raw frame, and {match} x {match} of its pixels make one of the "
            "calibration's: colours are averaged over whole cells of 2 x 2.",
            "Photograph with the calibration's binning, or take the frame as grey (--bayer none).",
        )


def reduce_mosaic(
    raw: FloatImage, pattern: Pattern, crop: Crop | None, binning: int
) -> tuple[FloatImage, BoolArray]:
    """Split a raw frame into colours, cut the window out and average each colour's pixels.

    Raises BenchError when the binning is odd.

    Parameters
    ----------
    raw : ndarray, (height, width)
        Dark level subtracted.
    binning : int
        1, or even: then every binned pixel holds whole cells of the mosaic, and so every colour.

    Returns
    -------
    image : ndarray, float32, (height, width, 3)
    known : ndarray of bool, as ``image``
        Where the colour was measured.
    """
    if binning > 1 and binning % 2:
        raise BenchError(
            f"--bin {binning}: pixels of a colour mosaic are averaged over whole cells; take an even number."
        )
    image, erased = split_bayer(raw, pattern)
    known = ~erased
    if crop is not None:
        window = crop.slices((raw.shape[0], raw.shape[1]))
        image, known = image[window], known[window]
    if binning == 1:
        return np.ascontiguousarray(image, np.float32), known
    height, width = image.shape[0] // binning, image.shape[1] // binning
    if not (height and width):
        raise BenchError(f"--bin {binning}: the image has {image.shape[0]} x {image.shape[1]} pixels.")
    cells = (height, binning, width, binning, 3)
    kept = slice(0, height * binning), slice(0, width * binning)
    count = known[kept].reshape(cells).sum(axis=(1, 3))
    total = image[kept].reshape(cells).sum(axis=(1, 3), dtype=np.float64)
    return (total / count).astype(np.float32), np.ones((height, width, 3), bool)


def pattern_of(choice: MosaicChoice, image: ImageFile) -> Pattern | None:
    """Return the mosaic asked for, or that of the metadata; refused where the image cannot be one."""
    pattern = mosaic_of(image) if choice == "auto" else choice
    if pattern is not None:
        require_mosaic(image, pattern)
    return pattern


def mosaic_psf(psf: FloatImage, pattern: Pattern, crop: Crop | None, factor: int) -> FloatImage:
    """Bring a PSF to a mosaic's measurement: binned, each colour by the pixels that saw it, as that is."""
    if psf.ndim == 3:
        return reduce(psf, 0.0, crop, factor)
    if factor > 1:
        return reduce_mosaic(psf, pattern, crop, factor)[0]
    return reduce(interpolate_bayer(psf, pattern), 0.0, crop, 1)


def matched_mosaic(
    raw: FloatImage, pattern: Pattern, match: int, crop: Crop | None, factor: int
) -> tuple[FloatImage, BoolArray]:
    """Bring a raw frame to a calibration's pixels, then cut and bin on those."""
    if match == 1:
        return reduce_mosaic(raw, pattern, crop, factor)
    image = reduce(reduce_mosaic(raw, pattern, None, match)[0], 0.0, crop, factor)
    return image, np.ones(image.shape, bool)


def on_every_pixel(level: float | FloatImage, match: int, shape: tuple[int, ...]) -> float | FloatImage:
    """Bring a dark level on a calibration's pixels to those of the raw frame."""
    if not isinstance(level, np.ndarray):
        return level
    spread = np.repeat(np.repeat(level, match, axis=0), match, axis=1)
    grown: FloatImage = np.zeros(shape[:2], np.float32)
    grown[: spread.shape[0], : spread.shape[1]] = spread
    return grown


def in_colour(calibration: Calibration, pattern: Pattern, match: int) -> Calibration:
    """Fill the colours of PSFs that are raw frames themselves; binned ones are grey and serve all colours."""
    if calibration.psfs.shape[1] > 1 or match > 1:
        return calibration
    psfs = np.stack([np.moveaxis(interpolate_bayer(psf[0], pattern), -1, 0) for psf in calibration.psfs])
    return replace(calibration, psfs=psfs, background=None)
