"""Colour maps for images with 8-bit indices: index 255 is kept for saturated pixels."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from instrument.frame_view import SATURATED

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
