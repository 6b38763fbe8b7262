"""Points of a picture or volume at continuous places, with error bars of place and light.

The bright spots of a picture are where points are looked for; those of a volume are given. Their places and
light are then fitted to the photograph itself, all of them together (:mod:`recon.camera.point_fit`), so that
neither the grid of voxels nor the prior's bias is left in them. Of a volume each point has a continuous
depth, too: its image is made of the PSFs of both planes beside it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from recon.analysis.point_places import PointPlaces, voxels_of
from recon.arrays import Float64Array
from recon.camera.grid import Grid
from recon.camera.point_fit import HELD, believed, misfit
from recon.camera.points import FieldFunctions, PointImages, Points, points_on_grid
from recon.camera.points_in_depth import ImagesInDepth, Rays
from recon.errors import InputError
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.weights import is_weighted, kind_of
from recon.types import Calibration

COORDINATES = 4
"""Of a point: plane, row, column and light."""
OFF_BY_PSFS = 1.4
"""Times the fit's own deviation: PSFs beside the axis and between planes are a little others than those they
are made of, and pose as place where the noise hides it (``benchmarks/bead_places.py``)."""
LEAST = 0.03
"""Light of a spot, relative to the brightest, from which it is tried as a point."""
MOST_BYTES = 2**31
"""Of all derivatives that are held at once: there are fewer points of large photographs."""


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

    places: Float64Array
    light: Float64Array
    covariance: Float64Array

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
    def deviations(self) -> Float64Array:
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
    most = _most(3, part.data[0].size, part.dtype.itemsize)
    found = points_on_grid(result.volume.reshape(result.grid.shape)[0].astype(np.float64), centre, LEAST)
    found = Points(found.places[:most], found.light[:most] / scale)
    found, covariance = believed(camera, part, found, cancel)
    order = np.argsort(-found.light)
    units = np.array([1.0, 1.0, scale])
    return PointErrors(
        found.places[order] + centre, found.light[order] * scale, covariance[order] * np.outer(units, units)
    )


def fitted_places(
    found: PointPlaces,
    grid: Grid,
    measurement: Measurement | npt.ArrayLike,
    calibration: Calibration,
    *,
    on_progress: Callable[[float], object] | None = None,
) -> PointPlaces:
    """Fit points of a volume to its photograph.

    Parameters
    ----------
    found : PointPlaces
        As :func:`~recon.analysis.point_places.point_places` found them in the volume: where the fit begins.
    grid : Grid
        Of that volume.
    measurement : Measurement or array, (height, width)
    calibration : Calibration
        Both as the volume was reconstructed from them; one PSF a depth, of known depths.
    on_progress : callable, optional
        Called with the share done at most; may raise to end the work.

    Returns
    -------
    PointPlaces
        The brightest first, without those whose light is not five times its own deviation, and without
        those that came to lie on another.

    Raises InputError where places or depths are not known, the photograph is in colour, PSFs vary over the
    field, or there are more points than fit into two gibibytes.
    """
    problem = _problem(found, measurement, calibration)
    psfs = problem.depths.central[:, 0] / np.float32(problem.energy[0])
    distance_um = 1e3 * (calibration.geometry.diffuser_distance_mm or 0.0)
    camera = ImagesInDepth(problem.depths.z_um, psfs, distance_um, problem.sensor_shape)
    rays = Rays(problem.grid, camera)
    scale = float(problem.image_scale.ravel()[0])
    start = Points(np.array([rays.place_of(one) for one in found.places_um]), found.light / scale)
    with closing(Part(problem, slice(0, 1))) as part:
        points, covariance = believed(camera, part, start, on_step=on_progress)
        left, unexplained = misfit(camera, part, points)
    order = np.argsort(-points.light, kind="stable")
    places, covariance = points.places[order], covariance[order]
    places_um = np.array([rays.um_of(one) for one in places]).reshape(-1, 3)
    slopes = np.array([rays.slopes_of(one) for one in places]).reshape(-1, 3, 3)
    known = np.einsum("nij,njk,nik->ni", slopes, covariance[:, :3, :3], slopes)
    last = len(problem.depths.z_um) - 1
    return PointPlaces(
        places_um,
        OFF_BY_PSFS * np.sqrt(np.maximum(known, 0)),
        voxels_of(places_um, grid),
        points.light[order] * scale,
        (places[:, 0] < 0) | (places[:, 0] > last),
        left,
        unexplained,
    )


def _most(coordinates: int, pixels: int, bytes_each: int) -> int:
    """Return how many points fit into memory, of which so many numbers are fitted."""
    return MOST_BYTES // (HELD * coordinates * pixels * bytes_each)


def _problem(
    found: PointPlaces, measurement: Measurement | npt.ArrayLike, calibration: Calibration
) -> Problem:
    """Return photograph and PSFs in units of the noise; InputError where points cannot be fitted by them."""
    if not len(found):
        raise InputError("There are no points to be fitted.")
    if not np.isfinite(found.places_um).all():
        raise InputError("Points are fitted where the volume knows its places; this one does not.")
    if not calibration.geometry.diffuser_distance_mm:
        raise InputError(
            "Points are fitted by PSFs made between depths, and the calibration does not say how far the "
            "sensor is from the diffuser: give diffuser_distance_mm."
        )
    problem = Problem.of(measurement, calibration, ReconstructionOptions(model="convolution", prior="l1"))
    if problem.depths.varies:
        raise InputError(
            "Points are fitted by one PSF a depth; this calibration's vary over the field, which is not "
            "modelled here. Take the places in the volume."
        )
    if problem.n_channels > 1:
        raise InputError(
            "Points are fitted to grey photographs, or channels that were merged; this one has colours: take "
            "the places in the volume."
        )
    z_um = problem.depths.z_um
    if len(z_um) < 2 or not np.isfinite(z_um).all() or (z_um <= 0).any():
        raise InputError("Points are fitted by PSFs of two known depths or more.")
    height, width = problem.sensor_shape
    if len(found) > (most := _most(COORDINATES, height * width, np.dtype(problem.precision).itemsize)):
        raise InputError(
            f"{len(found)} points of a photograph of {height} x {width} pixels are more than are fitted "
            f"together, {most}: take the places in the volume, or reconstruct it of a binned or cropped "
            "photograph. Fewer points of it do not help: what the others show would pass for these."
        )
    return problem
