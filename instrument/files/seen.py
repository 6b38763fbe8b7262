"""How a picture of light is shown: contrast by percentiles, colours balanced, for a screen (sRGB)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array

WHITE_PERCENTILE = 99.8
"""What is shown white; brighter pixels are white too."""
BLACK_PERCENTILE = 0.2
"""What is shown black, of raw photographs: they stand on their camera's offset."""
MOST_BALANCE = 3.0
"""How much a colour is brightened at most beside the brightest: one that is only noise stays dark."""


@dataclass(frozen=True, slots=True)
class Levels:
    """What is shown black and white, in the picture's units; one white a channel, or one for all."""

    black: float
    white: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """Return them for a record, with how they were found and the curve between them."""
        white = self.white[0] if len(self.white) == 1 else list(self.white)
        return {
            "white": white,
            "white_percentile": WHITE_PERCENTILE,
            "black": self.black,
            "transfer": "sRGB",
        }


def levels_of(image: Array, *, raw: bool = False) -> Levels:
    """Find what is to be shown black and white.

    Parameters
    ----------
    image : ndarray, (height, width) or (height, width, n_channels)
        Light; NaN counts as black.
    raw : bool
        Whether black is not zero: a photograph with its camera's offset.
    """
    image = np.nan_to_num(image, nan=0.0)
    black = float(np.percentile(image, BLACK_PERCENTILE)) if raw else 0.0
    channels = image[..., None] if image.ndim == 2 else image
    whites = [_white(channels[..., c], black) for c in range(channels.shape[-1])]
    brightest = max(whites)
    return Levels(black, tuple(max(white, (brightest - black) / MOST_BALANCE + black) for white in whites))


def _white(channel: Array, black: float) -> float:
    white = float(np.percentile(channel, WHITE_PERCENTILE))
    if white <= black:  # few points of light
        white = float(channel.max())
    return white if white > black else black + 1.0


def srgb(light: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return what a screen is sent for light in 0 to 1 (IEC 61966-2-1)."""
    light = np.clip(light, 0, 1)
    shown: npt.NDArray[np.floating] = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055
    )
    return shown


def as_seen(image: Array, levels: Levels | None = None, *, raw: bool = False) -> npt.NDArray[np.uint8]:
    """Return 8-bit pixels for a screen, (height, width) or (height, width, 3).

    Parameters
    ----------
    image : ndarray, (height, width) or (height, width, n_channels)
        Light in any unit; of more or fewer than three channels the mean is shown.
    levels : Levels, optional
        Instead of the picture's own, so that several pictures are shown alike.
    raw : bool
        As for :func:`levels_of`.
    """
    if image.ndim == 3 and image.shape[-1] != 3:
        image = image.mean(axis=-1)
    levels = levels or levels_of(image, raw=raw)
    white = np.asarray(levels.white, np.float32)
    scale = white if image.ndim == 3 else white.max()
    light = (np.nan_to_num(image, nan=0.0).astype(np.float32) - levels.black) / (scale - levels.black)
    return np.asarray(np.round(255 * srgb(light)), np.uint8)


def png_bytes(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return 8-bit pixels, grey or RGB, as a PNG."""
    import cv2

    ordered = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    return bytes(cv2.imencode(".png", np.ascontiguousarray(ordered))[1].tobytes())
