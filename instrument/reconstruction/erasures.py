"""Which pixels of a photograph take part: all, all but saturated ones, those of a mask, a random share.

Erasing is exact (Kuo 2020, Eq. 3.10): the reconstruction explains the other pixels and predicts the erased.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, read_image
from instrument.reconstruction.preparation import Crop, saturated_pixels

Choice = Literal["none", "saturated"] | float | Path
"""Nothing; saturated pixels; a random share; a mask file, zero where a pixel is erased."""

SEED = 0


@dataclass(frozen=True, slots=True)
class Erased:
    """Which pixels are valid, ``(height, width)`` or ``(height, width, 3)``; None means all of them."""

    valid: npt.NDArray[np.bool_] | None
    reason: str


def erasures_of(choice: Choice, image: ImageFile) -> Erased:
    """Return which pixels of an image take part.

    Raises
    ------
    BenchError, FileError
        When the share is not from 0 to below 1, or the mask does not fit or leaves nothing.
    """
    if choice == "none":
        return Erased(None, "none")
    if choice == "saturated":
        return _saturated(image)
    if isinstance(choice, Path):
        return _from_mask(choice, image)
    if not 0 <= choice < 1:
        raise BenchError(f"--erasures {choice:g}: a share from 0 to below 1 is expected, e.g. 0.8.")
    keep = np.random.default_rng(SEED).random(image.pixels.shape[:2]) >= choice
    return Erased(keep, f"{1 - keep.mean():.1%} of the pixels, at random (seed {SEED})")


def reduce_valid(valid: npt.NDArray[np.bool_], crop: Crop | None, binning: int) -> npt.NDArray[np.bool_]:
    """Cut and bin a mask like its image: a binned pixel is valid where all of its pixels are."""
    if crop is not None:
        valid = valid[crop.slices((valid.shape[0], valid.shape[1]))]
    height, width = valid.shape[0] // binning, valid.shape[1] // binning
    blocks = valid[: height * binning, : width * binning].reshape(
        height, binning, width, binning, *valid.shape[2:]
    )
    return np.asarray(blocks.all(axis=(1, 3)))


def _saturated(image: ImageFile) -> Erased:
    count = saturated_pixels(image.pixels)
    if not count:
        return Erased(None, "none (no pixel is saturated)")
    full_scale = int(image.pixels.max())
    share = f"{count / image.pixels.size:.2%}"
    reason = f"{count} saturated pixels ({share}, at {full_scale}); --erasures none uses them"
    return Erased(np.asarray(image.pixels) != full_scale, reason)


def _from_mask(path: Path, image: ImageFile) -> Erased:
    mask = read_image(path)
    shape: tuple[Any, ...] = image.pixels.shape
    if mask.pixels.shape not in (shape, shape[:2]):
        raise FileError(
            path, f"the mask is {mask.describe()}, but the image {image.path} is {image.describe()}."
        )
    valid = np.asarray(mask.pixels != 0)
    if not valid.any():
        raise FileError(path, "the mask is zero everywhere: no pixel is left.", "Zero marks erased pixels.")
    return Erased(valid, f"{1 - valid.mean():.1%} of the pixels, where {path} is zero")
