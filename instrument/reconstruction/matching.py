"""PSFs and a photograph of one camera on the same pixels and in the same colours, by whole binnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from instrument.files.errors import FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.preparation import (
    Dark,
    DarkChoice,
    bin_image,
    dark_level,
    darkest_corner,
    in_counts,
)
from recon.types import Calibration

MOST_TIMES = 8
"""More pixels than these to one are no camera's binning, but another picture."""


@dataclass(frozen=True, slots=True)
class Matched:
    """A PSF on a photograph's pixels, or that it is to be binned to.

    Attributes
    ----------
    psf : ImageFile
        Binned, and grey where the photograph is.
    psf_binning, image_binning : int
        One of them is 1; the photograph's has yet to be done.
    warnings : tuple of str
        What was done, in sentences.
    """

    psf: ImageFile
    psf_binning: int = 1
    image_binning: int = 1
    warnings: tuple[str, ...] = ()


def check_pair(
    psf: ImageFile, image: ImageFile, *, allow_mixed_depth: bool = False, mosaic: bool = False
) -> None:
    """Refuse a PSF and an image that cannot belong together.

    ``mosaic``: the image is a colour sensor's raw frame, whose pixels are not averaged to the PSF's.

    Raises FileError when no whole binning brings one to the other's shape, their bit depths differ, or the
    PSF's planes may be depths as well as colours, which the image has none of.
    """
    if psf.colours_are_guessed and not (image.is_colour or mosaic):
        raise FileError(
            psf.path,
            "holds three planes; nothing tells whether these are colours or depths: the photograph is grey.",
            "PSFs of depths are given by --volume; of colours give their mean, or a picture (TIFF, PNG).",
        )
    psf_shape, shape = psf.pixels.shape[:2], image.pixels.shape[:2]
    if psf_shape != shape and (mosaic or whole_binnings(psf_shape, shape) is None):
        turned = " One of them may be rotated." if psf_shape == shape[::-1] else ""
        other = "" if mosaic else ", or one of them a whole multiple of the other's"
        raise FileError(
            psf.path,
            f"the PSF is {psf.describe()}, but the image {image.path} is {image.describe()}: "
            f"both must have one shape{other}.{turned}",
            "Take both with the same camera, region of interest and binning.",
        )
    depths = psf.pixels.dtype, image.pixels.dtype
    if depths[0] != depths[1] and all(d.kind == "u" for d in depths) and not allow_mixed_depth:
        raise FileError(
            psf.path,
            f"the PSF has {8 * depths[0].itemsize} bit, but the image {image.path} has "
            f"{8 * depths[1].itemsize} bit: one of them has probably been converted.",
            "Use the raw files of both, or --mixed-depth if it is meant so.",
        )


def whole_binnings(psf_shape: Sequence[int], shape: Sequence[int]) -> tuple[int, int] | None:
    """Return the binnings of a PSF and of an image that bring both to one shape; None: there are none.

    One of them is 1, the other up to :data:`MOST_TIMES`; rows and columns that are left over are cut off.
    """
    if tuple(psf_shape) == tuple(shape):
        return 1, 1
    for times in range(2, MOST_TIMES + 1):
        if tuple(n // times for n in psf_shape) == tuple(shape):
            return times, 1
        if tuple(n // times for n in shape) == tuple(psf_shape):
            return 1, times
    return None


def matched(psf: ImageFile, image: ImageFile, *, mosaic: bool) -> Matched:
    """Return a PSF that passed :func:`check_pair` with its image, on the latter's pixels and colours."""
    warnings: tuple[str, ...] = ()
    if psf.is_colour and not (image.is_colour or mosaic):
        psf = replace(psf, pixels=psf.pixels.mean(axis=-1, dtype=np.float32))
        warnings += (MEAN_COLOUR,)
    binnings = whole_binnings(psf.pixels.shape[:2], image.pixels.shape[:2])
    assert binnings is not None
    ours, theirs = binnings
    if ours == theirs == 1:
        return Matched(psf, warnings=warnings)
    warnings += (binned_words(psf.pixels.shape, image.pixels.shape, ours, theirs),)
    binned = psf if ours == 1 else replace(psf, pixels=bin_image(psf.pixels, ours))
    return Matched(binned, ours, theirs, warnings)


def matched_calibration(
    calibration: Calibration, image: ImageFile, *, mosaic: bool
) -> tuple[Calibration, str]:
    """Return a calibration in the photograph's colours, and what was done; empty where that was nothing."""
    if calibration.psfs.shape[1] == 1 or image.is_colour or mosaic:
        return calibration, ""
    background = calibration.background
    grey = replace(
        calibration,
        psfs=calibration.psfs.mean(axis=1, keepdims=True),
        background=None if background is None else background.mean(axis=0, keepdims=True),
    )
    return grey, MEAN_COLOUR


MEAN_COLOUR = "The photograph is grey and its PSF has colours: their mean is taken."


def binned_words(psf: Sequence[int], image: Sequence[int], ours: int, theirs: int) -> str:
    """Return what is binned to what, and where that is right."""
    both = f"The PSF has {psf[0]} x {psf[1]} pixels and the photograph {image[0]} x {image[1]}"
    which, times = ("PSF", ours) if ours > 1 else ("photograph", theirs)
    return (
        f"{both}: the {which} is binned {times} x {times}. That is right where the camera binned the other "
        "and both show the whole field; where one is a region of interest, cut the same one out of the other."
    )


def matched_dark(
    choice: DarkChoice, psf: ImageFile, image: ImageFile, pair: Matched, *, apart: bool = False
) -> Dark:
    """Return what is subtracted from both on the pixels that they come to; ``psf`` as it was read.

    ``apart``: whether a dark frame's counts are the image's only.
    """
    dark = dark_level(choice, psf, image)
    others = apart or psf.pixels.shape[:2] != image.pixels.shape[:2]
    if isinstance(dark.image, np.ndarray) and others:
        corner, name = darkest_corner(psf.pixels)
        words = f"{dark.reason} from the image, {in_counts(corner)} from the PSF (its {name} corner)"
        dark = Dark(bin_image(dark.image, pair.image_binning), corner, words)
    if isinstance(dark.psf, np.ndarray):
        of_psf = dark.psf if dark.psf.ndim <= pair.psf.pixels.ndim else dark.psf.mean(axis=-1)
        whole = of_psf.shape[:2] == psf.pixels.shape[:2]
        dark = replace(dark, psf=bin_image(of_psf, pair.psf_binning) if whole else of_psf)
    return dark
