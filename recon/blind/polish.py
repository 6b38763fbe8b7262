"""From beads on a grid to points between pixels, and from their PSFs to those that the points ask for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.blind.points import PointMixer, solve_smooth, support_of
from recon.blind.work import ROUNDS_A_DEGREE
from recon.camera.points import FieldFunctions, PointImages, Points, cleaned, overlooked, refine
from recon.camera.registration import displacement, shifted

ROUNDS = 4
"""Times the images are aligned: first to one of them, then to what was found."""


def first_psf(images: Array, psf_shape: tuple[int, int]) -> Float32Array:
    """Return a noisy PSF from images (n, height, width) with light, cut to ``psf_shape``; sum 1."""
    # The image with the highest peak over its energy has the fewest overlaps: the best to align to.
    reference = images[int(np.argmax(images.max(axis=(1, 2)) / np.linalg.norm(images, axis=(1, 2))))]
    found = reference
    for _ in range(ROUNDS):
        aligned = np.stack([_onto(image, found) for image in images])
        found = _shared(aligned)
        window = _brightest_window(found, psf_shape)
        kept = np.zeros_like(found)
        kept[window] = found[window]
        found = kept
    psf = centred(np.ascontiguousarray(found[window], np.float32))
    return np.asarray(psf / psf.sum(), np.float32)


def centred(psf: Array) -> Array:
    """Shift PSFs (..., height, width) by whole pixels so that the centre of light is the centre pixel."""
    rows, columns = offset_of(psf)
    return shifted(psf, -rows, -columns)


def offset_of(psf: Array) -> tuple[int, int]:
    """Return by how many pixels the centre of light of (..., height, width) lies off the centre pixel.

    The part above a tenth of the peak counts, so that a faint background does not pull it to the middle.
    """
    light = psf.reshape(-1, *psf.shape[-2:]).mean(axis=0, dtype=np.float64)
    light = np.where(light > 0.1 * light.max(), light, 0)
    total = light.sum()
    offsets = []
    for axis, n in enumerate(light.shape):
        mean = float(light.sum(axis=1 - axis) @ np.arange(n)) / total
        offsets.append(round(mean - n // 2))
    return offsets[0], offsets[1]


def _onto(image: Array, reference: Array) -> Array:
    rows, columns = displacement(image, reference)
    return shifted(image, -rows, -columns)


def _shared(aligned: Array) -> Array:
    """Rank-one approximation of a stack (n, height, width): its right singular vector, not negative.

    Before it, each pixel is limited to the stack's median and a little: a bead that one image alone has at a
    place would otherwise leave a ghost of its PSF there.
    """
    median = np.median(aligned, axis=0)
    limited = np.minimum(aligned, 1.5 * median)
    rows = limited.reshape(len(aligned), -1).astype(np.float64)
    _, vectors = np.linalg.eigh(rows @ rows.T)
    shared = (vectors[:, -1] @ rows).reshape(aligned.shape[1:])
    return np.asarray(np.maximum(shared * np.sign(shared.sum()), 0))


def _brightest_window(image: Array, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Where a window of ``shape`` holds the most energy."""
    energy = np.pad(image.astype(np.float64) ** 2, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    h, w = (min(n, m) for n, m in zip(shape, image.shape, strict=True))
    inside = energy[h:, w:] - energy[:-h, w:] - energy[h:, :-w] + energy[:-h, :-w]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(int(row), int(row) + h), slice(int(column), int(column) + w)


_BEADS_A_FUNCTION = 4  # at least so many beads for each field function
_LEAST_GAIN = 0.003  # relative decrease of the misfit that another round must bring


@dataclass(frozen=True, slots=True)
class Polished:
    """PSFs and beads after the polish.

    Attributes
    ----------
    psfs : ndarray, float32, (n_functions, height, width)
        One a field function.
    functions : FieldFunctions
    beads : tuple of Points
        One an image.
    misfits : tuple of float
        ``||f - b|| / ||b||`` after the rounds with each degree.
    """

    psfs: Float32Array
    functions: FieldFunctions
    beads: tuple[Points, ...]
    misfits: tuple[float, ...]

    def images(self, sensor_shape: tuple[int, int]) -> Float32Array:
        """Return what the model says of the images: (n_images, height, width)."""
        camera = PointImages(self.psfs, self.functions, sensor_shape)
        return np.stack([camera.image(points) for points in self.beads])

    def at(self, places: Float64Array) -> Float32Array:
        """Return the PSFs at places (n, 2): (n, height, width)."""
        return np.tensordot(self.functions.at(places).astype(np.float32), self.psfs, 1)


def highest_degree_for(beads: int) -> int:
    """Return the highest degree of the field's variation that so many beads tell, 2 at most."""
    return max(d for d in range(3) if d == 0 or (d + 1) * (d + 2) / 2 * _BEADS_A_FUNCTION <= beads)


def polish(
    data: Float32Array,
    beads: Sequence[Points],
    psf_shape: tuple[int, int],
    iterations: int,
    highest_degree: int,
    on_progress: Callable[[float], object],
) -> Polished:
    """Alternate between PSFs and points, the degree of the field's variation raised step by step.

    Parameters
    ----------
    data : ndarray, float32, (n_images, height, width)
    beads : sequence of Points
        At least one each; a first guess good to a pixel.
    psf_shape : (int, int)
    iterations : int
        Of each fit of the PSFs.
    highest_degree : int
        Fewer where there are too few beads.
    on_progress : callable
        Called with the share done.
    """
    sensor = data.shape[1], data.shape[2]
    norm = float(np.linalg.norm(data))
    degrees = range(highest_degree + 1)
    misfits: list[float] = []
    psfs: Float32Array | None = None
    functions: FieldFunctions | None = None
    for degree in degrees:
        places = np.concatenate([points.places for points in beads])
        if degree > highest_degree_for(len(places)):
            break
        best = np.inf
        for number in range(ROUNDS_A_DEGREE):
            on_progress((degree + number / ROUNDS_A_DEGREE) / len(degrees))
            functions = FieldFunctions(degree, np.concatenate([points.places for points in beads]))
            mixer = PointMixer(beads, functions, psf_shape, sensor)
            start = np.zeros((functions.count, *psf_shape), np.float32)
            free, _ = solve_smooth(mixer, data, start, None, iterations)
            support = support_of(free[0])
            psfs, misfit = solve_smooth(mixer, data, free, support, iterations)
            psfs, beads = _centred(psfs, beads)
            noise = misfit / np.sqrt(data.size)
            beads = _better_points(PointImages(psfs, functions, sensor), data, beads, noise)
            if misfit > (1 - _LEAST_GAIN) * best:
                break
            best = misfit
        misfits.append(min(best, misfit) / norm)
    assert psfs is not None
    assert functions is not None
    return Polished(psfs, functions, tuple(beads), tuple(misfits))


def _better_points(
    camera: PointImages, data: Float32Array, beads: Sequence[Points], noise: float
) -> tuple[Points, ...]:
    found = []
    for image, points in zip(data, beads, strict=True):
        fitted, left = refine(camera, image, points)
        fitted = overlooked(camera, left, cleaned(camera, fitted, noise), noise)
        fitted, _ = refine(camera, image, fitted, sweeps=1)
        kept = cleaned(camera, fitted, noise)
        found.append(kept if len(kept) else points)
    return tuple(found)


def _centred(psfs: Float32Array, beads: Sequence[Points]) -> tuple[Float32Array, tuple[Points, ...]]:
    """Give the mean PSF unit light, centred on the centre pixel; the beads go the other way."""
    from recon.camera.registration import shifted

    rows, columns = offset_of(np.maximum(psfs[0], 0)[None])
    light = float(psfs[0].sum(dtype=np.float64))
    moved = np.asarray(shifted(psfs, -rows, -columns) / np.float32(light), np.float32)
    by = np.array([rows, columns], np.float64)
    return moved, tuple(Points(points.places + by, points.light * light) for points in beads)
