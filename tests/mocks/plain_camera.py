"""What a scene casts through one PSF, by plain shifts and sums."""

from __future__ import annotations

import numpy as np


def cast(light: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Return what light of the sensor's field casts; PSF and light of one shape, the axis in the middle."""
    (height, width), image = response.shape, np.zeros(response.shape)
    for row, column in np.argwhere(light > 0):
        dy, dx = row - height // 2, column - width // 2
        there = np.s_[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)]
        here = np.s_[max(-dy, 0) : height + min(-dy, 0), max(-dx, 0) : width + min(-dx, 0)]
        image[there] += light[row, column] * response[here]
    return image
