"""From image files to what a reconstruction needs: matched, dark-subtracted, erased, cropped, binned.

Every choice that is made here for the user comes back in words, so that it can be shown and kept.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from instrument.files.errors import BenchError, FileError, count, percent
from instrument.files.images import ImageFile, read_image
from instrument.reconstruction.defects import defective_pixels, whole_lines
from recon.arrays import Array, BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.base.checks import saturated_share
from recon.base.sloping_light import rise_of, sloping_light
from recon.errors import InputError
from recon.types import Calibration

FloatImage = Float32Array

ErasuresChoice = Literal["none", "saturated"] | float | Path
"""Nothing; saturated pixels; a random share; a mask file, zero where a pixel is erased."""
DarkChoice = Literal["auto"] | float | Path | ImageFile

AUTO_PIXELS = 500_000
"""Automatic binning goes on until the image has at most this many pixels."""
LEAST_BINNED = 8
"""Pixels along each side that binning must leave: fewer hold no pattern to decode."""
SATURATED_LIGHT_LIMIT = 0.01
"""A PSF with a larger share of its light in saturated pixels is refused: its true shape is unknown."""

SEED = 0
"""Of the pixels that are left out at random."""

# Full scale of 8 to 16 bit sensors, right-aligned and left-aligned in 16 bit.
_FULL_SCALES = (255, 1023, 4095, 16383, 65535, 65472, 65520, 65532)
_PATCH = 10
_MARGIN = 5


@dataclass(frozen=True, slots=True)
class Crop:
    """A window of an image, in pixels; ``top`` and ``left`` None mean that it is centred."""

    top: int | None
    left: int | None
    height: int
    width: int

    @classmethod
    def parse(cls, text: str) -> Crop:
        """Read ``"TOP,LEFT,HEIGHT,WIDTH"`` or ``"HEIGHTxWIDTH"``.

        Raises InputError.
        """
        if match := re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", text):
            window = cls(None, None, int(match[1]), int(match[2]))
        elif match := re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*", text):
            window = cls(int(match[1]), int(match[2]), int(match[3]), int(match[4]))
        else:
            raise InputError(
                "write TOP,LEFT,HEIGHT,WIDTH in pixels, e.g. 100,200,600,800, or HEIGHTxWIDTH for a centred "
                "window, e.g. 600x800."
            )
        if window.height == 0 or window.width == 0:
            raise InputError("this is an empty window.")
        return window

    def slices(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Return the window as slices of an image; refused where it leaves the image.

        Raises BenchError.
        """
        top = (shape[0] - self.height) // 2 if self.top is None else self.top
        left = (shape[1] - self.width) // 2 if self.left is None else self.left
        if top < 0 or left < 0 or top + self.height > shape[0] or left + self.width > shape[1]:
            raise BenchError(
                f"--crop asks for {self.height} x {self.width} pixels from ({top}, {left}), "
                f"but the image has {shape[0]} x {shape[1]}."
            )
        return slice(top, top + self.height), slice(left, left + self.width)


@dataclass(frozen=True, slots=True)
class Dark:
    """What is subtracted from image and PSF, and where it came from.

    ``image`` and ``psf`` are counts: a number, or an array of the whole frame's shape.
    """

    image: float | FloatImage
    psf: float | FloatImage
    reason: str


def check_psf(psf: ImageFile, *, allow_saturated: bool = False) -> tuple[str, ...]:
    """Refuse a PSF that nothing can be reconstructed with; return warnings in sentences.

    Raises FileError when it is constant or too much of its light lies in saturated pixels.
    """
    pixels = psf.pixels
    lowest, highest = float(pixels.min()), float(pixels.max())
    if lowest == highest:
        what = "empty (all zero)" if highest == 0 else f"constant (every pixel is {highest:g})"
        raise FileError(psf.path, f"the PSF is {what}.", "Was the point source on?")
    saturated = saturated_pixels(pixels)
    if not saturated.any():
        return ()
    total = float(pixels.sum(dtype=np.float64)) - lowest * pixels.size
    count = np.count_nonzero(saturated)
    share = float(np.sum(pixels[saturated] - lowest, dtype=np.float64)) / total
    found = f"{count} pixels of the PSF are saturated (at {highest:g}) and hold {share:.1%} of its light"
    if share > SATURATED_LIGHT_LIMIT and is_full_scale(pixels) and not allow_saturated:
        lines = whole_lines(saturated)
        raise FileError(
            psf.path,
            f"{found}; up to {SATURATED_LIGHT_LIMIT:.0%} is allowed.",
            f"They fill {lines}: defects of the sensor, which no exposure mends. Put the mean of the "
            "lines beside them there in the PSF; in the photograph --erasures leaves them out."
            if lines
            else "Take it again with a shorter exposure, or use --allow-saturated.",
        )
    return (f"{found}.",)


def saturated_pixels(pixels: Array) -> BoolArray:
    """Return which pixels are at full scale, in their shape, as far as an image can tell; channels apart.

    They are at their channel's maximum, where that is a full scale and is reached more than once, or where
    suspiciously many are there: cameras may clip below, and a dark frame taken off or a change of scale moves
    the maximum.
    """
    channels = pixels[..., None] if pixels.ndim == 2 else pixels
    saturated = np.zeros(channels.shape, bool)
    for c in range(channels.shape[2]):
        known = channels[..., c][np.isfinite(channels[..., c])]  # holes are NaN
        if not known.size:
            continue
        at_top = channels[..., c] == known.max()
        if np.count_nonzero(at_top) > 1 if is_full_scale(known) else saturated_share(known):
            saturated[..., c] = at_top
    return saturated.reshape(pixels.shape)


def is_full_scale(pixels: Array) -> bool:
    """Tell whether the maximum is that of an 8, 10, 12, 14 or 16 bit sensor, left-aligned in 16 bit too."""
    return pixels.dtype.kind == "u" and int(pixels.max()) in _FULL_SCALES


# Dark ----------------------------------------------------------------------------------------------
def dark_from_counts(counts: float) -> Dark:
    """Return a constant offset for both."""
    return Dark(counts, counts, f"{counts:g} counts, as given")


def dark_from_file(dark: ImageFile, image: ImageFile) -> Dark:
    """Return a dark frame for both.

    Raises FileError when its shape, channels or bit depth differ from the image's.
    """
    if dark.pixels.shape[:2] != image.pixels.shape[:2] or (dark.is_colour and not image.is_colour):
        raise FileError(
            dark.path,
            f"the dark frame is {dark.describe()}, but the image {image.path} is {image.describe()}.",
            "Take it with the same camera, region of interest and binning.",
        )
    depths = dark.pixels.dtype, image.pixels.dtype
    if depths[0] != depths[1] and all(d.kind == "u" for d in depths):
        raise FileError(
            dark.path,
            f"the dark frame has {8 * depths[0].itemsize} bit, but the image {image.path} has "
            f"{8 * depths[1].itemsize} bit: their counts are not the same.",
            "Use the raw file of the dark frame.",
        )
    if np.array_equal(dark.pixels, image.pixels):
        raise FileError(
            dark.path,
            f"the dark frame is the photograph {image.path} itself: nothing would be left of it.",
            "Give a frame taken in the dark (diffuserbench snap --dark), or leave --dark out.",
        )
    frame = dark.pixels.astype(np.float32)
    words = f"the frame {dark.path} (mean {float(frame.mean()):.1f} counts)"
    if (brighter := _brighter_share(frame, image.pixels)) > _MOST_BRIGHTER:
        words += f"; in {brighter:.0%} of the picture it is BRIGHTER than the photograph: was there light?"
    return Dark(frame, frame, words)


_MOST_BRIGHTER, _BRIGHTER_BY, _SURE, _SIDE = 0.1, 0.05, 4.0, 8
"""In what share of its blocks a photograph may lie below its dark frame, by more than what share of the mean
and how many standard deviations of noise."""


def _brighter_share(dark: Array, image: Array) -> float:
    """Return in what share of the picture a dark frame is clearly brighter than a photograph."""
    greys = [np.nan_to_num(pixels.astype(np.float64)) for pixels in (dark, image)]
    greys = [grey.mean(axis=-1) if grey.ndim == 3 else grey for grey in greys]
    if min(greys[0].shape) < _SIDE:
        return 0.0
    dark_means, means = (block_mean(grey, _SIDE) for grey in greys)
    # Noise of a block's mean: what the dark frame, which has no picture, varies by within blocks.
    variance = float(np.median(block_mean(greys[0] ** 2, _SIDE) - dark_means**2))
    noise = np.sqrt(2 * max(variance, 0.0)) / _SIDE
    least = max(_BRIGHTER_BY * abs(float(means.mean())), _SURE * noise)
    return float((dark_means > means + least).mean())


def dark_from_corners(psf: ImageFile, image: ImageFile) -> Dark:
    """Estimate a constant offset where no dark frame is at hand.

    The PSF's darkest corner tells it (mean of 10 x 10 pixels, 5 from the border: light rarely reaches there);
    the image, whose corners are lit, has the same offset when both are raw frames of one camera
    (:func:`both_raw`). Otherwise the image's offset is the mean of its darkest 10 x 10 pixels. It is never
    more than those, so that nothing is pushed below zero by an offset that the image does not have. Where the
    PSF stands on light that grows across it, that is subtracted from it instead.
    """
    corner, name = darkest_corner(psf.pixels)
    darkest, plane = darkest_block(image.pixels), sloping_light(psf.pixels)
    raw = both_raw(psf, image)
    rise = 0.0 if plane is None else rise_of(plane)
    rise = round(rise) if rise >= 10 else rise  # of fractions they may be less than one
    shared = raw and corner <= darkest
    if shared and plane is None:
        words = f"{corner:.1f} counts from both: mean of the PSF's {name} corner"
    else:
        why = f"mean of the PSF's {name} corner" if shared else "the image's darkest 10 x 10 pixels"
        why += ", darker than the PSF's corners" if raw and not shared else ""
        of_psf = (
            f"{in_counts(corner)} from the PSF (its {name} corner)"
            if plane is None
            else f"from the PSF light that grows across it by {in_counts(rise)} counts, as its border "
            "shows: take it in the dark"
        )
        words = f"{in_counts(corner if shared else darkest)} from the image ({why}), {of_psf}"
    words += " (estimated; a frame or counts may be given by --dark)"
    return Dark(corner if shared else darkest, corner if plane is None else plane, words)


def in_counts(level: float) -> str:
    """Return counts by at least four digits, large ones without an exponent."""
    return f"{level:.0f}" if abs(level) >= 1000 else f"{level:.4g}"


def both_raw(psf: ImageFile, image: ImageFile) -> bool:
    """Whether a PSF and an image are integers of one depth, be it that the image's bad pixels are NaN."""
    dtype, pixels = psf.pixels.dtype, image.pixels
    if dtype.kind != "u" or dtype == pixels.dtype or pixels.dtype.kind != "f" or not np.isnan(pixels).any():
        return dtype.kind == "u" and dtype == pixels.dtype
    counts = pixels[np.isfinite(pixels)]
    most = 2 ** (8 * dtype.itemsize) - 1
    fewest = most >> 8  # no eight bits that were put into sixteen
    return bool(fewest < counts.max() <= most and counts.min() >= 0 and not (counts % 1).any())


def darkest_corner(pixels: Array) -> tuple[float, str]:
    """Return the mean of a PSF's darkest corner, and which it is."""
    height, width = pixels.shape[:2]
    margin = min(_MARGIN, height // 4, width // 4)
    side = max(1, min(_PATCH, height // 4, width // 4))
    near, far = slice(margin, margin + side), slice(-margin - side, -margin or None)
    corners = {
        "upper left": pixels[near, near],
        "upper right": pixels[near, far],
        "lower left": pixels[far, near],
        "lower right": pixels[far, far],
    }
    means = {name: float(corner.mean(dtype=np.float64)) for name, corner in corners.items()}
    name = min(means, key=means.__getitem__)
    return means[name], name


def darkest_block(pixels: Array) -> float:
    """Return the mean of an image's darkest block of 10 x 10 pixels (smaller in a smaller image)."""
    grey = pixels.mean(axis=-1, dtype=np.float32) if pixels.ndim == 3 else pixels
    return float(np.nanmin(bin_image(grey, max(1, min(_PATCH, *grey.shape)))))


def dark_level(choice: DarkChoice, psf: ImageFile, image: ImageFile) -> Dark:
    """Return what is subtracted from a PSF and an image: as given, or estimated."""
    if choice == "auto":
        return dark_from_corners(psf, image)
    if isinstance(choice, (Path, ImageFile)):
        return dark_from_file(read_image(choice), image)
    return dark_from_counts(choice)


def calibrated_dark(choice: DarkChoice, image: ImageFile, calibration: Calibration, match: int) -> Dark:
    """Return what to subtract from an image on the calibration's pixels; the PSFs need nothing."""
    if isinstance(choice, (Path, ImageFile)):
        dark = dark_from_file(read_image(choice), image)
        return replace(dark, image=bin_image(np.asarray(dark.image), match))
    if choice != "auto":
        return dark_from_counts(choice)
    if calibration.background is not None:
        background = np.moveaxis(calibration.background, 0, -1)
        return Dark(
            background[..., 0] if background.shape[-1] == 1 else background,
            0.0,
            f"the calibration's background (mean {float(background.mean()):.1f} counts)",
        )
    darkest = darkest_block(image.pixels)
    return Dark(darkest, 0.0, f"{darkest:.4g} counts: the image's darkest 10 x 10 pixels (estimated)")


# Size ------------------------------------------------------------------------------------------------
def auto_binning(shape: tuple[int, int]) -> int:
    """Return the smallest binning that leaves at most ``AUTO_PIXELS`` pixels."""
    factor = 1
    while (shape[0] // factor) * (shape[1] // factor) > AUTO_PIXELS:
        factor += 1
    return factor


def bin_image(image: Array, factor: int) -> FloatImage:
    """Return the mean of ``factor`` x ``factor`` pixels, float32; a rest at the right and bottom is left out.

    Raises BenchError when the image is smaller than one binned pixel.
    """
    if factor < 1 or factor > min(image.shape[:2]):
        raise BenchError(f"--bin {factor}: the image has {image.shape[0]} x {image.shape[1]} pixels.")
    if factor == 1:
        return image.astype(np.float32)
    if image.ndim == 2:
        binned: FloatImage = block_mean(image, factor)
        return binned
    return np.ascontiguousarray(np.moveaxis(block_mean(np.moveaxis(image, -1, 0), factor), 0, -1))


def reduce(pixels: Array, dark: float | FloatImage, crop: Crop | None, binning: int) -> FloatImage:
    """Subtract the dark level, cut the window out, bin; float32, negative values kept.

    Raises BenchError when binning leaves less than :data:`LEAST_BINNED` pixels along a side.
    """
    if isinstance(dark, np.ndarray) and dark.ndim < pixels.ndim:
        dark = dark[..., None]
    image: FloatImage = np.subtract(pixels, dark, dtype=np.float32)
    if crop is not None:
        image = image[crop.slices(image.shape[:2])]
    binned = bin_image(image, binning)
    if binning > 1 and min(binned.shape[:2]) < LEAST_BINNED:
        most = max(min(image.shape[:2]) // LEAST_BINNED, 1)
        raise BenchError(
            f"--bin {binning} leaves {binned.shape[0]} x {binned.shape[1]} of {image.shape[0]} x "
            f"{image.shape[1]} pixels; a picture takes {LEAST_BINNED} or more along each side. "
            f"Take --bin {most}{' or less' if most > 1 else ''}."
        )
    return binned


# Erasures: exact (Kuo 2020, Eq. 3.10), the reconstruction explains the other pixels and predicts the erased
@dataclass(frozen=True, slots=True)
class Erased:
    """Which pixels are valid, ``(height, width)`` or ``(height, width, 3)``; None means all of them."""

    valid: BoolArray | None
    reason: str


def erasures_of(choice: ErasuresChoice, image: ImageFile, psf: Array | None = None) -> Erased:
    """Return which pixels of an image take part; with a ``psf`` defective ones count as saturated.

    Raises BenchError or FileError when the share is not from 0 to below 1, or the mask does not fit or leaves
    nothing.
    """
    if choice == "none":
        return Erased(None, "none")
    if choice == "saturated":
        return _saturated(image, psf)
    if isinstance(choice, Path):
        return _from_mask(choice, image)
    if not 0 <= choice < 1:
        raise BenchError(f"--erasures {choice:g}: a share from 0 to below 1 is expected, e.g. 0.8.")
    keep = np.random.default_rng(SEED).random(image.pixels.shape[:2]) >= choice
    return Erased(keep, f"{1 - keep.mean():.1%} of the pixels, at random (seed {SEED})")


def reduce_valid(valid: BoolArray, crop: Crop | None, binning: int) -> BoolArray:
    """Cut and bin a mask like its image: a binned pixel is valid where all of its pixels are."""
    if crop is not None:
        valid = valid[crop.slices((valid.shape[0], valid.shape[1]))]
    height, width = valid.shape[0] // binning, valid.shape[1] // binning
    blocks = valid[: height * binning, : width * binning].reshape(
        height, binning, width, binning, *valid.shape[2:]
    )
    return np.asarray(blocks.all(axis=(1, 3)))


def _saturated(image: ImageFile, psf: Array | None) -> Erased:
    saturated = saturated_pixels(image.pixels)
    left_out = saturated if psf is None else saturated | defective_pixels(image.pixels, psf)
    unknown = int(np.count_nonzero(np.isnan(image.pixels)))
    nan = f"{count(unknown, 'pixel')} that {'is' if unknown == 1 else 'are'} NaN" if unknown else ""
    if not left_out.any():
        return Erased(None, nan or "none (no pixel is saturated)")
    said = []
    if number := int(np.count_nonzero(saturated)):
        tops = ", ".join(f"{top:g}" for top in np.unique(image.pixels[saturated]))
        said += [f"{count(number, 'saturated pixel')} ({percent(number / image.pixels.size)}, at {tops})"]
    if number := int(np.count_nonzero(left_out & ~saturated)):
        said += [count(number, f"hot or dead {'one' if said else 'pixel'}")]
    words = f"{' and '.join(said)}; --erasures none uses them"
    return Erased(~left_out, f"{nan}; {words}" if nan else words)


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
