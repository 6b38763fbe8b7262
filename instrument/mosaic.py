"""Raw frames of a colour mosaic sensor: prepared so that the mosaic stays part of the camera's model."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from instrument.errors import BenchError, FileError
from instrument.images import ImageFile
from instrument.preparation import Crop, FloatImage
from recon.bayer import PATTERNS, Pattern, split_bayer

_GENICAM: dict[str, Pattern] = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}


def mosaic_named(text: str) -> Pattern | Literal["auto"] | None:
    """Return the pattern that ``--bayer`` names; None for ``none``.

    Raises
    ------
    BenchError
    """
    if text == "none":
        return None
    if text == "auto":
        return "auto"
    found = next((p for p in get_args(Pattern) if p == text.upper()), None)
    if found is None:
        raise BenchError(
            f"--bayer {text!r} is not known; choose one of {', '.join(PATTERNS)}, auto (by what the "
            "photograph's metadata say) or none."
        )
    pattern: Pattern = found
    return pattern


def mosaic_of(image: ImageFile) -> Pattern | None:
    """Return the mosaic that an image's metadata tell of, as the camera's driver wrote it; else None."""
    name = str(image.metadata.get("pixel_format", ""))
    return None if image.is_colour or not name.startswith("Bayer") else _GENICAM.get(name[5:7])


def require_mosaic(image: ImageFile, pattern: Pattern) -> None:
    """Refuse an image that cannot be a mosaic's raw frame.

    Raises
    ------
    FileError
    """
    height, width = image.pixels.shape[:2]
    if image.is_colour or min(height, width) < 2:
        raise FileError(
            image.path,
            f"is {image.describe()}; a raw {pattern} frame is grey, of at least 2 x 2 pixels.",
            "Leave --bayer out for a picture that is colour already.",
        )


def reduce_mosaic(
    raw: FloatImage, pattern: Pattern, crop: Crop | None, binning: int
) -> tuple[FloatImage, npt.NDArray[np.bool_]]:
    """Split a raw frame into colours, cut the window out and average each colour's pixels.

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

    Raises
    ------
    BenchError
        When the binning is odd.
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
