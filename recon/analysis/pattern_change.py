"""What became of one PSF: its shift, size and turn, by blocks registered between pixels, and what is left.

The new PSF is laid on the old one in blocks; from the blocks' displacements follow shift, scale and rotation
by least squares. What is left then is a change of the pattern itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from recon.analysis.correlation import correlate, cut_to_light, lit_extent, similarity, spot_px
from recon.arrays import Array, Float32Array
from recon.camera.registration import register
from recon.camera.transformed import geometric_centre, resampled

BLOCKS = 4
"""Blocks along each side of the pattern."""
ROUNDS = 3
"""Times the blocks are measured, each time on what the last fit left."""
PARTS = ROUNDS + 4
"""Of comparing two PSFs: the whole of them, the rounds, their likeness as they lie, shifted, and turned."""


@dataclass(frozen=True, slots=True)
class Change:
    """What became of one PSF."""

    z_um: float
    rows: float
    columns: float
    """``rows`` and ``columns``: by how much the pattern moved, pixels."""
    scale: float
    """Size of the new pattern over that of the old one."""
    rotation_deg: float | None
    """From the image's right towards its bottom; None where too few parts of the pattern were recognised."""
    as_is: float
    aligned: float
    """``as_is`` and ``aligned``: inner product at the best whole-pixel shift, and after shift, scale and
    rotation are undone."""
    spot: float
    """Spot size of the new camera with the old PSF, laid on it between pixels, over that with its own."""
    edge_px: float
    """How far scale and rotation move the pattern's edge."""
    decoy: float
    """Inner product of the old PSF with the new one turned by 180 degrees, at the best whole-pixel shift.

    Patterns of different diffusers have as much in common."""
    brightness: float
    """Light of the new PSF over the old, at equal exposure where both calibrations know theirs."""
    place_error_px: float = 0.0
    scale_error: float = 0.0
    """``place_error_px`` and ``scale_error``: standard deviations of either shift, and of the size, by how
    the blocks of the pattern agree."""
    extent_px: float = 1.0
    """From the pattern's middle to its corner."""


def compare_psfs(
    new: Array,
    old: Array,
    z_um: float = float("nan"),
    exposure: float = 1.0,
    on_part: Callable[[int], object] = lambda _: None,
) -> Change:
    """Compare two PSFs (height, width); ``exposure`` is the new one's over the old one's.

    ``on_part`` gets how many of ``PARTS`` are done.
    """
    whole = register(new, old)
    on_part(1)
    light = cut_to_light(old)
    extent = 0.5 * float(np.hypot(*light.shape))
    factor, shift, errors = _fit(new, old, complex(whole.rows, whole.columns), lambda n: on_part(1 + n))
    moved = _undone(new, factor, shift)
    as_they_lie = correlate(old, new)
    on_part(PARTS - 2)
    shifted = correlate(old, _undone(new, 1.0 + 0j, shift))  # between pixels a spot looks wider
    on_part(PARTS - 1)
    turned = correlate(old, np.ascontiguousarray(new[::-1, ::-1]))
    on_part(PARTS)
    return Change(
        z_um=z_um,
        rows=shift.real,
        columns=shift.imag,
        scale=abs(factor),
        rotation_deg=float(-np.rad2deg(np.angle(factor))) if errors is not None else None,
        as_is=as_they_lie.maximum,
        aligned=similarity(moved, old),
        spot=min(as_they_lie.spot_px, shifted.spot_px) / spot_px(new),
        edge_px=abs(factor - 1) * extent,
        decoy=turned.maximum,
        brightness=float(new.sum(dtype=np.float64) / old.sum(dtype=np.float64)) / exposure,
        place_error_px=math.inf if errors is None else errors[0],
        scale_error=math.inf if errors is None else errors[1],
        extent_px=extent,
    )


def _fit(
    new: Array, old: Array, shift: complex, on_round: Callable[[int], object]
) -> tuple[complex, complex, tuple[float, float] | None]:
    """Fit ``p_new = factor p_old + shift``, positions being ``row + i column`` from the image's centre.

    Returns standard deviations of a shift and of the factor, too; None where blocks were not recognised.
    """
    factor, errors = 1.0 + 0j, None
    for number in range(ROUNDS):
        places, displacements = _block_displacements(_undone(new, factor, shift), old)
        on_round(number + 1)
        if len(places) < 4:
            break
        # On the undone image: q = c p + t; q in the new image is factor q + shift.
        matrix = np.stack([places, np.ones_like(places)], axis=1)
        (c, t), *_ = np.linalg.lstsq(matrix, places + displacements, rcond=None)
        shift, factor = shift + factor * t, factor * c
        rest = displacements - (c - 1) * places - t
        variance = float((np.abs(rest) ** 2).sum()) / (2 * len(places) - 4)  # of a row or a column
        apart = float((np.abs(places - places.mean()) ** 2).sum())
        errors = math.sqrt(variance / len(places)), math.sqrt(variance / max(apart, 1e-12))
    return complex(factor), complex(shift), errors


def _block_displacements(
    moved: Array, old: Array
) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128]]:
    places, displacements = [], []
    height, width = old.shape
    edges_y, edges_x = (
        np.linspace(first, last + 1, BLOCKS + 1).astype(int) for first, last in lit_extent(old)
    )
    for top, bottom in pairwise(edges_y):
        for left, right in pairwise(edges_x):
            one, two = (image[top:bottom, left:right] for image in (moved, old))
            if min(one.shape) < 8 or not (np.ptp(one) > 0 and np.ptp(two) > 0):
                continue
            found = register(one, two)
            if found.reliable and max(abs(found.rows), abs(found.columns)) < 0.25 * min(one.shape):
                places.append(complex((top + bottom - height) / 2, (left + right - width) / 2))
                displacements.append(complex(found.rows, found.columns))
    return np.array(places, np.complex128), np.array(displacements, np.complex128)


def _undone(image: Array, factor: complex, shift: complex) -> Float32Array:
    """Return ``image(factor p + shift)``: cubic splines, zero beyond the border."""
    # (r + i c)(a + i b) = (a r - b c) + i (b r + a c)
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    centre = geometric_centre(image)
    return resampled(image, matrix, centre + np.array([shift.real, shift.imag]) - matrix @ centre)
