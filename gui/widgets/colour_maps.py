"""Colour maps for images with 8-bit indices: index 255 is kept for saturated pixels."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.live.frame_view import SATURATED

_SIGNAL = SATURATED - 1
_SATURATED_RGB = {"grey": (255, 40, 40), "red": (255, 120, 90)}
_STOPS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "grey": ((0, 0, 0), (255, 255, 255)),
    "red": ((0, 0, 0), (175, 0, 0)),
}
_MATPLOTLIB = ("viridis", "inferno", "magma", "turbo")
NAMES = (*_STOPS, *_MATPLOTLIB)


@lru_cache(maxsize=16)
def table(name: str, *, mark_saturation: bool = True) -> npt.NDArray[np.uint8]:
    """Return ``(256, 3)`` uint8 colours of a map, the last one that of saturation.

    Parameters
    ----------
    name : str
        One of ``NAMES``.
    mark_saturation : bool
        Without, the last colour is that of the brightest signal.
    """
    if name in _STOPS:
        stops = np.array(_STOPS[name], float)
        places = np.linspace(0, 254, len(stops))
        colours = np.stack([np.interp(np.arange(255), places, stops[:, c]) for c in range(3)], axis=1)
    else:
        from matplotlib import colormaps

        colours = colormaps[name](np.linspace(0, 1, 255))[:, :3] * 255
    result = np.empty((256, 3), np.uint8)
    result[:255] = np.round(colours)
    result[SATURATED] = _SATURATED_RGB.get(name, (255, 255, 255)) if mark_saturation else result[254]
    result.flags.writeable = False
    return result


def spares_hues(name: str) -> bool:
    """Whether a map has one hue for everything: coloured images go through it too, by their brightness."""
    return name == "red"


def indices_of(image: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.float32]:
    """Return an image's places in a map, 0 to 254; what is no number is darkest."""
    scaled = (np.asarray(image, np.float32) - np.float32(low)) * np.float32(_SIGNAL / max(high - low, 1e-12))
    places: npt.NDArray[np.float32] = np.clip(np.nan_to_num(scaled, copy=False), 0, _SIGNAL, out=scaled)
    return places


def grey_indices(image: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.float32]:
    """Return the same of a coloured image (height, width, 3), by the mean of its channels."""
    places: npt.NDArray[np.float32] = indices_of(image, low, high).mean(axis=2)
    return places


def as_shown(image: npt.NDArray[Any], low: float, high: float, name: str) -> npt.NDArray[np.uint8]:
    """Return the 8-bit colours of an image as a view shows it in a map, (height, width, 3)."""
    if image.ndim == 2 or spares_hues(name):
        places = indices_of(image, low, high) if image.ndim == 2 else grey_indices(image, low, high)
        mapped: npt.NDArray[np.uint8] = table(name, mark_saturation=False)[places.astype(np.uint8)]
        return mapped
    return np.round(indices_of(image, low, high) * (255 / _SIGNAL)).astype(np.uint8)
