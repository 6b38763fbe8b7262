"""Blind deconvolution of bead images: beads and PSFs in turn, the rank raised (Kuo 2020, Eqs. 5.11-5.13).

First on a grid of pixels, as the dissertation does. That finds the beads, but not between pixels, and its
PSFs bend to make up for it. Then the same again with beads as points (:mod:`recon.blind.polish`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.threads import linear_algebra_on_one_thread
from recon.blind.made_up import alike_by_halves
from recon.blind.polish import first_psf, offset_of, polish
from recon.blind.psf_step import BeadMixer, refuse_what_is_no_beads, solve_psfs
from recon.blind.settings import BlindSettings
from recon.blind.work import blind_work, grid_points
from recon.camera.convolution import field_of
from recon.camera.points import Points, points_on_grid
from recon.camera.registration import shifted
from recon.camera.varying_psfs import FieldOfPsfs, interpolation_weights, local_convolution
from recon.errors import InputError
from recon.priors import L1, NonNegativity
from recon.solvers import Fista, StoppingRules

Progress = Callable[[str, float], object]


@dataclass(frozen=True)
class BlindResult:
    """PSFs over the field, found without knowing where any bead was.

    What the images cannot tell is fixed by convention: each PSF's light sums to 1 (a bead's brightness and
    the response at its place come as a product); the centre of light of their mean is the centre pixel (all
    beads could be shifted one way and the PSF the other); and a bead is a point (all beads could be blurred
    and the PSF be sharper).

    Attributes
    ----------
    psfs : ndarray, float32, (n_psfs, psf height, psf width)
        Registered to one another. Their noise is on both sides of zero: clipped, it would sum to a haze.
    points : ndarray, (n_psfs, 2)
        ``(row, column)`` from the axis in object pixels that each PSF stands for.
    beads : tuple of Points
        One an image; light as in the images.
    rank : int
        Of the PSFs, at most: the number of functions over the field.
    misfits : tuple of float
        ``||f(H, y) - b|| / ||b||`` after each round on the grid.
    point_misfits : tuple of float
        The same with beads as points, after each degree of the field's variation.
    stopped : str
        Why the rounds on the grid ended.
    sensor_shape : (int, int)
    halves_alike : float
        Cosine similarity of the mean PSFs that either half of the images gives, their noise taken off.
    """

    psfs: Float32Array
    points: Float64Array
    beads: tuple[Points, ...]
    rank: int
    misfits: tuple[float, ...]
    point_misfits: tuple[float, ...]
    stopped: str
    sensor_shape: tuple[int, int]
    halves_alike: float

    def on_sensor(self) -> Float32Array:
        """Return each PSF where a source at its point casts it: (n_psfs, sensor height, sensor width)."""
        height, width = self.sensor_shape
        p_height, p_width = self.psfs.shape[1:]
        result = np.zeros((len(self.psfs), height, width), np.float32)
        for psf, image, (row, column) in zip(self.psfs, result, self.points, strict=True):
            top = height // 2 - p_height // 2 + round(float(row))
            left = width // 2 - p_width // 2 + round(float(column))
            rows = slice(max(top, 0), min(top + p_height, height))
            columns = slice(max(left, 0), min(left + p_width, width))
            if rows.stop > rows.start and columns.stop > columns.start:
                image[rows, columns] = psf[
                    rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
                ]
        return result


@linear_algebra_on_one_thread()
def calibrate_from_beads(
    images: Array,
    psf_shape: tuple[int, int],
    settings: BlindSettings | None = None,
    *,
    on_progress: Progress | None = None,
) -> BlindResult:
    """Recover PSFs over the field and the beads from images of beads at unknown places.

    Parameters
    ----------
    images : ndarray, (n_images, height, width)
        Background removed. Nine images of some twenty beads each were enough for the dissertation.
    psf_shape : (int, int)
        Window that holds the whole pattern: the aperture's shadow and what the diffuser bends beyond it.
    settings : BlindSettings, optional
    on_progress : callable, optional
        Called with what is being done and the share done.

    Raises InputError when there are fewer than two images, one is empty, or the window does not fit the
    sensor.
    """
    settings = settings or BlindSettings()
    # Negative noise is kept: clipped, it would be a haze that PSFs and beads had to explain.
    data = np.asarray(images, np.float32)
    _check(data, psf_shape, settings)
    report = on_progress or (lambda _what, _share: None)
    scale = np.float32(data.max())
    data = np.asarray(data / scale, np.float32)
    sensor = (data.shape[1], data.shape[2])
    points = grid_points(sensor, settings)
    work = blind_work((len(data), *sensor), psf_shape, settings)
    field_shape, centre = field_of(sensor, psf_shape)
    rows, columns = (np.arange(n) - c for n, c in zip(field_shape, centre, strict=True))
    weights = interpolation_weights(points, np.eye(len(points)), rows, columns).astype(np.float32)

    report("first PSF", 0.0)
    psfs: Float32Array = np.repeat(first_psf(np.maximum(data, 0), psf_shape)[None], len(points), axis=0)
    beads = np.zeros((len(data), *field_shape), np.float32)
    norm = float(np.linalg.norm(data))
    misfits: list[float] = []
    best: Float32Array | None = None
    stopped = "the last rank was reached"
    ranks = [r for r in settings.ranks if r <= len(points)]
    for number, rank in enumerate(ranks):

        def finding(done: float, rank: int = rank, before: float = work.on_grid(number)) -> None:
            report(f"rank {rank}: beads", (before + work.beads * done) / work.total)

        beads = _solve_beads(data, np.maximum(psfs, 0), points, beads, settings, finding)
        if not beads.any():
            raise InputError(
                "No bead was found: the first PSF explains nothing. Are the images of the same optics, with "
                "several beads each and their background removed?"
            )
        report(f"rank {rank}: PSFs", (work.on_grid(number) + work.beads) / work.total)
        mixer = BeadMixer(weights, beads, psf_shape, sensor)
        psfs, half = solve_psfs(mixer, data, psfs, rank, settings.iterations)
        psfs, beads = _by_convention(psfs, beads)
        misfits.append(float(np.sqrt(2 * half)) / norm)
        if best is not None and misfits[-1] > (1 - settings.improvement) * misfits[-2]:
            stopped = f"rank {rank} fits only {1 - misfits[-1] / misfits[-2]:.1%} better"
            best = beads if misfits[-1] < misfits[-2] else best
            break
        best = beads
    assert best is not None
    polished = polish(
        data,
        [points_on_grid(image, centre) for image in best],
        psf_shape,
        settings.iterations,
        settings.degree,
        lambda share: report("beads between pixels", work.between_pixels(share) / work.total),
    )
    refuse_what_is_no_beads(data, polished.images(sensor), polished.beads)
    report("both halves of the images", work.between_pixels(1.0) / work.total)
    alike = alike_by_halves(data, polished, settings.iterations)
    psfs = polished.at(points)
    light = psfs.sum(axis=(1, 2), keepdims=True)
    return BlindResult(
        psfs=np.asarray(psfs / np.where(light > 0, light, 1), np.float32),
        points=points,
        beads=tuple(Points(found.places, found.light * float(scale)) for found in polished.beads),
        rank=polished.functions.count,
        misfits=tuple(misfits),
        point_misfits=polished.misfits,
        stopped=stopped,
        sensor_shape=sensor,
        halves_alike=alike,
    )


def _check(data: Float32Array, psf_shape: tuple[int, int], settings: BlindSettings) -> None:
    if data.ndim != 3 or len(data) < 2:
        raise InputError(f"Two or more images (n, height, width) of beads are needed, not {data.shape}.")
    if not np.isfinite(data).all():
        raise InputError("An image of beads holds values that are not finite numbers.")
    if not (data.max(axis=(1, 2)) > 0).all():
        raise InputError("An image of beads holds no light.")
    for first in range(len(data)):
        for second in range(first + 1, len(data)):
            if np.array_equal(data[first], data[second]):
                raise InputError(
                    f"Images {first + 1} and {second + 1} are the same, pixel by pixel: each must be a "
                    "photograph of its own, the slide moved in between."
                )
    if any(p < 3 or p > n for p, n in zip(psf_shape, data.shape[1:], strict=True)):
        raise InputError(
            f"The PSF's window {psf_shape} must lie within the sensor {data.shape[1:]}: bin less, or use a "
            "smaller aperture or a farther slide."
        )
    ranks = list(settings.ranks)
    if not ranks or ranks != sorted(ranks) or ranks[0] < 1:
        raise InputError(f"Ranks rise from 1 or more, not {ranks}.")
    if min(settings.grid) < 1 or settings.iterations < 1 or not 0 < settings.tau < 1:
        raise InputError("The grid and the iterations are at least 1, tau lies between 0 and 1.")
    if settings.degree not in (0, 1, 2):
        raise InputError(f"PSFs vary over the field with degree 0, 1 or 2, not {settings.degree}.")


def _solve_beads(
    data: Float32Array,
    psfs: Float32Array,
    points: Array,
    start: Float32Array,
    settings: BlindSettings,
    on_progress: Callable[[float], None],
) -> Float32Array:
    """Find the beads of each image with the PSFs fixed (Eq. 5.12): FISTA with a rigorous step."""
    sensor = (data.shape[1], data.shape[2])
    operator = local_convolution([FieldOfPsfs(psfs[:, None], points)], sensor)
    found = np.empty_like(start)
    for number, (image, beads, out) in enumerate(zip(data, start, found, strict=True)):
        on_progress(number / len(data))
        target = image[None]
        weight = settings.tau * float(np.abs(operator.adjoint(target)).max())
        solver = Fista(operator, target, L1(weight) + NonNegativity(), initial=beads[None, None])
        outcome = solver.run(StoppingRules(iterations=settings.iterations, tolerance=1e-3))
        out[...] = outcome.solution[0, 0]
    return found


def _by_convention(psfs: Float32Array, beads: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Centre the mean PSF and give it unit light; the beads are moved and scaled the other way."""
    rows, columns = offset_of(psfs)
    light = np.float32(psfs.sum() / len(psfs))
    centred = np.asarray(shifted(psfs, -rows, -columns) / light, np.float32)
    return centred, np.asarray(shifted(beads, rows, columns) * light, np.float32)
