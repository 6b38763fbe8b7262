"""Files for the eye (sRGB) in proportion to the light again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from instrument.files.images import ImageFile

SrgbChoice = Literal["none", "photograph", "psf", "both"]
_SLOPE, _LINEAR, _OFFSET, _POWER = 12.92, 0.04045, 0.055, 2.4  # IEC 61966-2-1
_SIXTEEN_BITS = 65535


def straightened(file: ImageFile) -> ImageFile:
    """Return an image whose sRGB values are in proportion to the light, as 16 bit where it has integers.

    Raises FileError where its range is not known: fractions are expected from 0 to 1.
    """
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


def _most(dtype: np.dtype[Any]) -> int:
    bits = 8 * dtype.itemsize - (1 if dtype.kind == "i" else 0)
    return (1 << bits) - 1


def _light(coded: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.where(coded <= _LINEAR, coded / _SLOPE, ((coded + _OFFSET) / (1 + _OFFSET)) ** _POWER)
