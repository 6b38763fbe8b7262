"""Light of the room that grows across a PSF's frame: a plane, where the frame's border shows nothing else.

A dark level is one number, and a lamp beside the camera adds light that is none. Through a PSF that stands on
it each point of the scene seems to light the whole sensor, unevenly. A pattern that reaches the border is not
flat there, and stays as it is; so does a lobe of the PSF's own, whose border bends.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Array, Float32Array

FloatImage = Float32Array

BORDER = 0.04
"""Width of the border, relative to the shorter side."""
PARTS = 8
"""Of each side of the border; each is known by its median."""
FLATTEST = 16.0
"""Rise of the plane over what the parts leave of it, from which it is one. The hand's PSF over light that
grows across it by 1 to 15 % of its peak: 42 and more; as it is 1.6, cut to 40 to 85 % at nine places 5.6 at
most. The USAF target's: 1.6 at most, cut to 70 % 6.3."""
BENT = 0.25
"""What a surface of third order leaves of what the plane leaves of the parts, below which the border bends
and shows a lobe. The hand's over light that grows across it: 0.33 to 0.48. Lobes of 60 to 300 pixels, centred
0 to 200 before 160 columns, that rise by 16 times what is left or more: 0.02 to 0.22, under noise of 3 or 40
counts of 3000; but three so broad that they rise by 50 times and more, under noise of 40: 0.31 to 0.73."""
MOST_LEFT = 0.25
"""Mean light of the border beyond the plane, relative to its rise, up to which it shows no pattern."""
LEAST_RISE = 0.03
"""Rise relative to the mean light of the pattern, from which it is worth a word."""


def sloping_light(psf: Array) -> FloatImage | None:
    """Return the plane of light, counts, that a PSF (height, width[, 3]) stands on; None where there is none.

    Its dark level is part of it. In colours each has its own, and all of them must be planes.
    """
    if psf.ndim == 2:
        return _plane(psf)
    planes = [_plane(psf[..., c]) for c in range(psf.shape[-1])]
    found = [p for p in planes if p is not None]
    return np.stack(found, axis=-1) if found and len(found) == len(planes) else None


def rise_of(plane: FloatImage) -> float:
    """Return by how much a plane grows from its darkest corner to its brightest, counts."""
    corners = plane[:: len(plane) - 1, :: plane.shape[1] - 1]
    return float(np.ptp(corners.reshape(4, -1).mean(axis=1)))


def _plane(psf: Array) -> FloatImage | None:
    height, width = psf.shape
    wide = max(1, round(BORDER * min(height, width)))
    if min(height, width) < 2 * PARTS:
        return None
    y, x = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    rows, columns = (np.array_split(np.arange(n), PARTS) for n in (height, width))
    ends = [np.arange(wide), np.arange(-wide, 0)]
    parts = [(r, c) for r in ends for c in columns] + [(r, c) for r in rows for c in ends]
    medians = np.array([np.median(psf[np.ix_(r, c)]) for r, c in parts])
    places = np.array([(1.0, y[r].mean(), x[c].mean()) for r, c in parts])
    numbers = np.linalg.lstsq(places, medians, rcond=None)[0]
    left = _left_by(places, medians)
    _, down, across = places.T
    bends = [down**i * across**j for i in range(4) for j in range(4 - i)]
    straight = left * BENT <= _left_by(np.column_stack(bends), medians)
    plane: FloatImage = np.asarray(numbers[0] + numbers[1] * y[:, None] + numbers[2] * x, np.float32)
    rise = 2 * float(np.abs(numbers[1:]).sum())
    beyond = float(np.mean([np.mean(psf[np.ix_(r, c)] - plane[np.ix_(r, c)]) for r, c in parts]))
    light = float(np.mean(psf - plane, dtype=np.float64))
    is_plane = straight and rise > FLATTEST * left and beyond < MOST_LEFT * rise
    return plane if is_plane and rise > LEAST_RISE * light > 0 else None


def _left_by(terms: Array, values: Array) -> float:
    """Return the root mean square of what the best sum of terms leaves."""
    best = np.linalg.lstsq(terms, values, rcond=None)[0]
    return float(np.sqrt(np.mean((values - terms @ best) ** 2)))
