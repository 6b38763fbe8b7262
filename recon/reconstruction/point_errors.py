"""Points of a picture at continuous places, with error bars of place and light.

The bright spots of a picture are where points are looked for. Their places and light are then fitted to the
photograph itself, all of them together, so that neither the grid of pixels nor the prior's bias is left in
them: Gauss-Newton steps on ``b = sum_k a_k h(u - x_k)``. With ``J`` the derivatives and ``r`` what is left of
the data, the covariance is ``F^-1 (J^T diag(r^2) J) F^-1``, ``F = J^T J`` (White 1980, Econometrica 48:817):
the inverse of Fisher's information where the noise is as expected, and larger where the data are off the
model by more. What a PSF that is a little wrong (aliased between pixels, changed off the axis) leaves of the
data shows in the residual; a share of that size passes for places and light (:data:`POSES_AS_PLACE`).
"""

from __future__ import annotations

import threading
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.points import FieldFunctions, PointImages, Points, cleaned, points_on_grid
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.weights import is_weighted, kind_of

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

LEAST = 0.03
"""Light of a spot, relative to the brightest, from which it is tried as a point."""
SURE = 5.0
"""Times its own deviation, for a point's light to be believed."""
ROUNDS = 3
STEPS = 12
LARGEST_STEP_PX = 0.5
SETTLED_PX = 1e-3
POSES_AS_PLACE, POSES_AS_LIGHT = 0.2, 0.35
"""Of what the points' images leave of the data beyond the noise, relative to their light, so much passes for
a shift and for light: 0.13 to 0.27 and 0.15 to 0.36 in most of 24 photographs of beads, in any light."""
MOST_BYTES = 2**30
"""Of the derivatives: there are fewer points of large photographs."""


@dataclass(frozen=True, slots=True)
class PointErrors:
    """Points of a picture, the brightest first.

    Attributes
    ----------
    places : ndarray, float64, (n, 2)
        ``(row, column)`` in the picture: whole numbers are the middle of pixels.
    light : ndarray, float64, (n,)
        In the picture's units: the sum over a point's pixels.
    covariance : ndarray, float64, (n, 3, 3)
        Of row, column and light.
    """

    places: Floats
    light: Floats
    covariance: Floats

    @property
    def words(self) -> str:
        """How many there are, and how well they are known."""
        if not len(self.light):
            return "none stands out of the noise"
        deviations = self.deviations
        place = float(np.median(np.hypot(deviations[:, 0], deviations[:, 1])))
        light = float(np.median(deviations[:, 2] / self.light))
        return f"{len(self.light)}, placed to {place:.2g} pixels, light to {light:.1%} (medians)"

    @property
    def deviations(self) -> Floats:
        """Standard deviations of row, column and light, (n, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def points_problem(problem: Problem) -> Problem | None:
    """Return what points are fitted by, on the measurement's own pixels; None where a picture has none.

    It has where it is grey, by a prior that counts light, through one PSF.
    """
    given = problem if problem.reduction is None else problem.reduction.given
    grey = given.n_channels == 1 and given.n_planes == 1
    name = problem.prior_name
    if not grey or problem.varies or kind_of(name) != "l1" or not is_weighted(name):
        return None
    return replace(given, model=problem.model, smooth=problem.smooth, reduction=None, choice=None)


def points_of(result: Reconstruction, problem: Problem, cancel: threading.Event | None = None) -> PointErrors:
    """Return the points of a picture.

    Parameters
    ----------
    result : Reconstruction
    problem : Problem
        As :func:`points_problem` returned it.
    cancel : threading.Event, optional
        Set it to stop after the round in progress.
    """
    with closing(Part(problem, slice(0, 1))) as part:
        return _points(result, problem, part, cancel)


def _points(
    result: Reconstruction, problem: Problem, part: Part, cancel: threading.Event | None
) -> PointErrors:
    psf = np.asarray(problem.depths.central[0, 0] / problem.energy[0], np.float32)
    camera = PointImages(psf[None], FieldFunctions(0, np.zeros((1, 2))), problem.sensor_shape)
    centre = result.grid.centre
    scale = float(problem.image_scale.ravel()[0])
    most = MOST_BYTES // (3 * 4 * part.data[0].size)
    found = points_on_grid(result.volume.reshape(result.grid.shape)[0].astype(np.float64), centre, LEAST)
    found = Points(found.places[:most], found.light[:most] / scale)
    covariance = np.zeros((0, 3, 3))
    for _ in range(ROUNDS):
        found = _fitted(camera, part, cleaned(camera, found, 0.0, weakest=0.0))
        covariance = _covariance(camera, part, found)
        sure = found.light > SURE * np.sqrt(np.maximum(covariance[:, 2, 2], 0))
        sure &= np.isfinite(covariance).all(axis=(1, 2))
        if sure.all() or (cancel is not None and cancel.is_set()):
            break
        found = Points(found.places[sure], found.light[sure])
        covariance = covariance[sure]
    order = np.argsort(-found.light)
    units = np.array([1.0, 1.0, scale])
    return PointErrors(
        found.places[order] + centre, found.light[order] * scale, covariance[order] * np.outer(units, units)
    )


def _derivatives(camera: PointImages, part: Part, points: Points) -> tuple[Floats, Floats]:
    """Return what is left of the data, (pixels,), and its slopes by row, column and light, (3 n, pixels)."""
    images = np.zeros((3 * len(points), *part.data.shape[1:]), np.float32)
    seen = np.zeros(part.data.shape[1:], np.float32)
    for k, (place, light) in enumerate(zip(points.places, points.light, strict=True)):
        patch, where = camera.patch(place, slopes=True)
        seen[where] += np.float32(light) * patch[0]
        images[3 * k][where], images[3 * k + 1][where] = light * patch[1], light * patch[2]
        images[3 * k + 2][where] = patch[0]
    rest = _told(part, part.data[0] - seen)
    return rest.ravel(), np.stack([_told(part, image) for image in images]).reshape(len(images), -1)


def _told(part: Part, image: Array) -> Floats:
    """Return what the data tell of an image: valid pixels, without a smooth background."""
    kept = np.where(part.valid, image, 0).astype(part.dtype)
    told: Floats = kept[0] if part.removal is None else part.removal.forward(kept)[0]
    return told


def _fitted(camera: PointImages, part: Part, points: Points) -> Points:
    """Fit places and light of all points together, by steps that only descend."""
    if not len(points):
        return points
    rest, slopes = _derivatives(camera, part, points)
    for _ in range(STEPS):
        information = slopes @ slopes.T
        information[np.diag_indices_from(information)] *= 1 + 1e-6
        step = np.linalg.lstsq(information, slopes @ rest, rcond=None)[0].reshape(-1, 3)
        largest = float(np.abs(step[:, :2]).max())
        step *= min(1.0, LARGEST_STEP_PX / max(largest, 1e-12))
        moved = Points(points.places + step[:, :2], np.maximum(points.light + step[:, 2], 0))
        left, changed = _derivatives(camera, part, moved)
        if float(left @ left) > float(rest @ rest):
            break
        points, rest, slopes = moved, left, changed
        if largest < SETTLED_PX:
            break
    return points


def _covariance(camera: PointImages, part: Part, points: Points) -> Floats:
    """Return the covariance of row, column and light of every point, (n, 3, 3)."""
    if not len(points):
        return np.zeros((0, 3, 3))
    rest, slopes = _derivatives(camera, part, points)
    pixels = int(np.count_nonzero(part.valid))
    inverse = np.linalg.pinv((slopes @ slopes.T).astype(np.float64))
    scores = ((slopes * rest**2) @ slopes.T).astype(np.float64)
    whole = inverse @ scores @ inverse * (pixels / max(pixels - len(slopes), 1))
    at = np.arange(len(points))
    each = np.array(whole.reshape(len(at), 3, len(at), 3)[at, :, at])
    sizes = np.sum(slopes.reshape(len(at), 3, -1).astype(np.float64) ** 2, axis=2)
    seen = points.light**2 * sizes[:, 2]
    unexplained = max(float(rest @ rest) - pixels, 0) / max(float(seen.sum()), 1e-30)
    each[:, (0, 1), (0, 1)] += (
        POSES_AS_PLACE**2 * unexplained * seen[:, None] / np.maximum(sizes[:, :2], 1e-30)
    )
    each[:, 2, 2] += POSES_AS_LIGHT**2 * unexplained * points.light**2
    return each
