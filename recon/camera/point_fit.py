"""Points of light fitted to a photograph, all of them together: places, light, and how well they are known.

Gauss-Newton steps on ``b = sum_k a_k h(u - x_k)``. With ``J`` the derivatives and ``r`` what is left of the
data, the covariance is ``F^-1 (J^T diag(r^2) J) F^-1``, ``F = J^T J`` (White 1980, Econometrica 48:817): the
inverse of Fisher's information where the noise is as expected, and larger where the data are off the model by
more. What a PSF that is a little wrong (aliased between pixels, changed off the axis) leaves of the data
shows in the residual; a share of that size passes for places and light (:data:`POSES_AS_PLACE`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.camera.factors import BackgroundRemoval
from recon.camera.points import PointImages, Points, cleaned

SURE = 5.0
"""Times its own deviation, for a point's light to be believed."""
ROUNDS = 3
STEPS = 12
LARGEST_STEP_PX = 0.5
DAMPED, MOST_DAMPED = 1e-6, 1e2
"""Of the information's diagonal, so much is added at first, and a hundred times more where a step ascends."""
SETTLED_PX = 1e-3
HELD = 2
"""Sets of derivatives that are in memory at once: of a step and of the one before."""
POSES_AS_PLACE, POSES_AS_LIGHT = 0.2, 0.35
"""Of what the points' images leave of the data beyond the noise, relative to their light, so much passes for
a shift and for light: 0.13 to 0.27 and 0.15 to 0.36 in most of 24 photographs of beads, in any light."""


class Photograph(Protocol):
    """What is fitted to: data of one channel in units of their noise, and what they tell of an image.

    Attributes
    ----------
    data : ndarray, (1, height, width)
    valid : ndarray of bool, as ``data``
    removal : BackgroundRemoval or None
        Of a smooth background, where one is in the data.
    dtype : dtype
        Of the arithmetic.
    """

    data: Array
    valid: BoolArray
    removal: BackgroundRemoval | None
    dtype: np.dtype[Any]


def believed(
    camera: PointImages,
    part: Photograph,
    points: Points,
    cancel: threading.Event | None = None,
    on_step: Callable[[float], object] | None = None,
) -> tuple[Points, Float64Array]:
    """Fit points to a photograph, without those whose light is not believed.

    Parameters
    ----------
    camera : PointImages
    part : Photograph
    points : Points
        Where the fit begins; light in units of the part's data.
    cancel : threading.Event, optional
        Set it to stop after the round in progress.
    on_step : callable, optional
        Called with the share done at most, before each step.

    Returns
    -------
    points : Points
    covariance : ndarray, float64, (n, coordinates + 1, coordinates + 1)
        Of each point's coordinates and light.
    """
    count = points.places.shape[1] + 1
    covariance = np.zeros((0, count, count))
    for number in range(ROUNDS):
        tell = None if on_step is None else partial(_tell, on_step, number)
        points = _fitted(camera, part, cleaned(camera, points, 0.0, weakest=0.0), tell)
        covariance = _covariance(camera, part, points)
        sure = points.light > SURE * np.sqrt(np.maximum(covariance[:, -1, -1], 0))
        sure &= np.isfinite(covariance).all(axis=(1, 2))
        if sure.all() or (cancel is not None and cancel.is_set()):
            break
        points = Points(points.places[sure], points.light[sure])
        covariance = covariance[sure]
    return points, covariance


def _tell(on_step: Callable[[float], object], number: int, share: float) -> None:
    on_step((number + share) / ROUNDS)


def misfit(camera: PointImages, part: Photograph, points: Points) -> tuple[float, float]:
    """Return what points leave of a part's data, root mean square: in units of the noise, and beyond it.

    What is left beyond the noise is relative to the points' images: 0 where there is nothing but noise.
    """
    seen = camera.image(points)
    left, light = (
        float(np.sum(_told(part, image).astype(np.float64) ** 2)) for image in (part.data[0] - seen, seen)
    )
    pixels = max(int(np.count_nonzero(part.valid)), 1)
    return (left / pixels) ** 0.5, (max(left - pixels, 0.0) / max(light, 1e-30)) ** 0.5


def _derivatives(camera: PointImages, part: Photograph, points: Points) -> tuple[Float64Array, Float64Array]:
    """Return what is left of the data, (pixels,), and its slopes by each point's coordinates and light.

    Slopes are (n * (coordinates + 1), pixels).
    """
    count = points.places.shape[1] + 1
    images = np.zeros((count * len(points), *part.data.shape[1:]), part.dtype)
    seen = np.zeros(part.data.shape[1:], np.float32)
    for k, (place, light) in enumerate(zip(points.places, points.light, strict=True)):
        patch, where = camera.patch(place, slopes=True)
        seen[where] += np.float32(light) * patch[0]
        of_point = images[count * k : count * (k + 1)]
        of_point[(slice(-1), *where)] = np.float32(light) * patch[1:]
        of_point[(-1, *where)] = patch[0]
    rest = _told(part, part.data[0] - seen)
    for image in images:  # in place: they are what takes the memory
        image[...] = _told(part, image)
    return rest.ravel(), images.reshape(len(images), -1)


def _told(part: Photograph, image: Array) -> Float64Array:
    """Return what the data tell of an image: valid pixels, without a smooth background."""
    kept = np.where(part.valid, image, 0).astype(part.dtype)
    told: Float64Array = kept[0] if part.removal is None else part.removal.forward(kept)[0]
    return told


def _fitted(
    camera: PointImages, part: Photograph, points: Points, tell: Callable[[float], object] | None = None
) -> Points:
    """Fit places and light of all points together, by steps that only descend, shorter where they did not."""
    if not len(points):
        return points
    rest, slopes = _derivatives(camera, part, points)
    damped = DAMPED
    for number in range(STEPS):
        if tell is not None:
            tell(number / STEPS)
        information = slopes @ slopes.T
        information[np.diag_indices_from(information)] *= 1 + damped
        step = np.linalg.lstsq(information, slopes @ rest, rcond=None)[0].reshape(len(points), -1)
        largest = float(np.abs(step[:, :-1]).max())
        step *= min(1.0, LARGEST_STEP_PX / max(largest, 1e-12))
        places = camera.within(points.places + step[:, :-1])
        moved = Points(places, np.maximum(points.light + step[:, -1], 0))
        left, changed = _derivatives(camera, part, moved)
        if float(left @ left) > float(rest @ rest):
            if damped > MOST_DAMPED:
                break
            damped *= 1e2
            continue
        points, rest, slopes = moved, left, changed
        damped = max(damped / 10, DAMPED)
        if largest < SETTLED_PX:
            break
    return points


def _covariance(camera: PointImages, part: Photograph, points: Points) -> Float64Array:
    """Return the covariance of every point's coordinates and light, (n, coordinates + 1, the same)."""
    count = points.places.shape[1] + 1
    if not len(points):
        return np.zeros((0, count, count))
    rest, slopes = _derivatives(camera, part, points)
    pixels = int(np.count_nonzero(part.valid))
    inverse = np.linalg.pinv((slopes @ slopes.T).astype(np.float64))
    scores = ((slopes * rest**2) @ slopes.T).astype(np.float64)
    whole = inverse @ scores @ inverse * (pixels / max(pixels - len(slopes), 1))
    at = np.arange(len(points))
    each = np.array(whole.reshape(len(at), count, len(at), count)[at, :, at])
    sizes = np.array([np.vdot(one, one) for one in slopes], np.float64).reshape(len(at), count)
    seen = points.light**2 * sizes[:, -1]
    unexplained = max(float(rest @ rest) - pixels, 0) / max(float(seen.sum()), 1e-30)
    along = np.arange(count - 1)
    each[:, along, along] += (
        POSES_AS_PLACE**2 * unexplained * seen[:, None] / np.maximum(sizes[:, :-1], 1e-30)
    )
    each[:, -1, -1] += POSES_AS_LIGHT**2 * unexplained * points.light**2
    return each
