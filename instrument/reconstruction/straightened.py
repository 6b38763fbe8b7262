"""Files for the eye (sRGB) in proportion to the light again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, read_image
from instrument.reconstruction.preparation import DarkChoice, dark_from_file
from recon.arrays import Array

SrgbChoice = Literal["none", "photograph", "psf", "both"]
_SLOPE, _LINEAR, _OFFSET, _POWER = 12.92, 0.04045, 0.055, 2.4  # IEC 61966-2-1
_SIXTEEN_BITS = 65535
_COUNTED = ("noise", "full_scale")
"""What metadata tell in counts, which are others then."""


def straightened(file: ImageFile) -> ImageFile:
    """Return an image whose sRGB values are in proportion to the light, as 16 bit where it has integers.

    Raises FileError where its range is not known: fractions are expected from 0 to 1.
    """
    file = replace(file, metadata={k: v for k, v in file.metadata.items() if k not in _COUNTED})
    pixels = file.pixels
    if pixels.dtype.kind == "f":
        lowest, highest = float(np.nanmin(pixels)), float(np.nanmax(pixels))
        if lowest < 0 or highest > 1:
            raise FileError(
                file.path,
                f"sRGB fractions are from 0 to 1; found {lowest:g} to {highest:g}.",
                "Give the file as it came from the camera, or leave --srgb out.",
            )
        return replace(file, pixels=_light(pixels).astype(np.float32))
    light = _light(pixels.astype(np.float64) / _most(pixels.dtype))
    return replace(file, pixels=np.round(_SIXTEEN_BITS * light).astype(np.uint16))


def straightened_dark(choice: DarkChoice, image: ImageFile, which: SrgbChoice) -> DarkChoice:
    """Return a dark frame straightened as its photograph is, ``image`` as it was read; else what was chosen.

    Raises FileError where it is not the photograph's, BenchError for counts: they become others.
    """
    if which == "none" or choice == "auto" or choice == 0:
        return choice
    if isinstance(choice, (int, float)):
        raise BenchError(
            f"--dark {choice:g} is in counts, which --srgb {which} changes: give a dark frame (--dark FILE), "
            "or leave --dark out."
        )
    dark = read_image(choice)
    dark_from_file(dark, image)
    return straightened(dark) if which in ("photograph", "both") else dark


def require_no_counts(noise: object, which: SrgbChoice) -> None:
    """Refuse a noise in counts where --srgb changes the photograph's; BenchError."""
    if which in ("photograph", "both") and noise is not None and noise != "estimate":
        raise BenchError(
            f"--noise is in counts, which --srgb {which} changes: leave it out, the noise is estimated."
        )


def _most(dtype: np.dtype[Any]) -> int:
    bits = 8 * dtype.itemsize - (1 if dtype.kind == "i" else 0)
    return (1 << bits) - 1


def _light(coded: Array) -> Array:
    return np.where(coded <= _LINEAR, coded / _SLOPE, ((coded + _OFFSET) / (1 + _OFFSET)) ** _POWER)
