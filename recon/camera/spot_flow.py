"""Patterns of two depths, light by light moved to where it is between them.

Scaled to one depth (Kuo 2020, Eq. 5.2) the patterns lie on one another, but the spots of which they are made
are not of one size: what a lenslet has out of focus grows with the distance from its focus, not with the
pattern. Their mean shows every spot twice. Here the displacement from one to the other is found pixel by
pixel, and both are moved their share of the way. Where that leaves them far less alike than they were, no
light was followed (depths too far apart, caustics that are no spots): then they stay.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import BoolArray, Float32Array

FINE_PX, MOST_PX = 700, 1400
"""Longer sides of images that are looked at on half pixels, and of the largest that are looked at."""
MOST_LOST = 2.0
"""What two patterns may lack of likeness after they were moved, relative to before: beyond that none of 57
pairs by wave optics gained by it, and some lost much (docs/decisions/0254)."""
_WINDOW_PX, _LEVELS, _ROUNDS, _POLYNOMIAL_PX, _DEVIATION_PX = 7, 3, 3, 5, 1.1
_BRIGHT = 0.999


def met(
    first: Float32Array, second: Float32Array, share: float, shown: BoolArray
) -> tuple[Float32Array, Float32Array]:
    """Return two patterns (n_channels, height, width), both with their light moved to between them.

    As they are where that leaves them less alike by more than :data:`MOST_LOST`.

    Parameters
    ----------
    first, second : ndarray, float32, (n_channels, height, width)
    share : float
        How far from the first to the second, 0 to 1.
    shown : ndarray of bool, (height, width)
        Pixels that both show: elsewhere nothing is moved.
    """
    flow = _displacement(first.mean(axis=0) * shown, second.mean(axis=0) * shown)
    flow[~shown] = 0
    spread = np.gradient(flow[..., 0], axis=1) + np.gradient(flow[..., 1], axis=0)
    both = _moved(first, flow, spread, -share), _moved(second, flow, spread, 1 - share)
    lost, before = 1 - _likeness(*both, shown), 1 - _likeness(first, second, shown)
    return both if lost <= MOST_LOST * before else (first, second)


def _likeness(first: Float32Array, second: Float32Array, shown: BoolArray) -> float:
    a, b = (image[:, shown].ravel() for image in (first, second))
    return float(a @ b) / max(float(np.linalg.norm(a)) * float(np.linalg.norm(b)), 1e-30)


def _displacement(first: Float32Array, second: Float32Array) -> Float32Array:
    """Return (column, row) by which what is at each pixel of the first lies elsewhere in the second.

    By polynomials fitted about each pixel (G. Farnebäck, 2003).
    """
    import cv2

    height, width = first.shape
    longer = max(height, width)
    factor = 2.0 if longer <= FINE_PX else min(1.0, MOST_PX / longer)
    bright = max(float(np.quantile(first, _BRIGHT)), 1e-30)

    def seen(image: Float32Array) -> npt.NDArray[np.uint8]:
        smaller = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        sized = np.asarray(
            cv2.resize(image.astype(np.float32), None, fx=factor, fy=factor, interpolation=smaller)
        )
        return np.asarray(255 * np.sqrt(np.clip(sized / bright, 0, 1)), np.uint8)

    start: Any = None
    flow = cv2.calcOpticalFlowFarneback(
        seen(first), seen(second), start, 0.5, _LEVELS, _WINDOW_PX, _ROUNDS, _POLYNOMIAL_PX, _DEVIATION_PX, 0
    )
    way = cv2.INTER_AREA if factor > 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(flow, (width, height), interpolation=way) / factor, np.float32)


def _moved(images: Float32Array, flow: Float32Array, spread: Float32Array, part: float) -> Float32Array:
    """Return images read a part of the flow away; what is spread over more pixels is dimmer on each."""
    import cv2

    rows, columns = (np.float32(one) for one in np.indices(images.shape[-2:]))
    at = columns + np.float32(part) * flow[..., 0], rows + np.float32(part) * flow[..., 1]
    read = [cv2.remap(image, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for image in images]
    brought = np.stack(read) * (1 + np.float32(part) * spread)
    return np.asarray(np.maximum(brought, np.minimum(images.min(), 0)), np.float32)
