"""The half-step for the PSFs, given the beads: least squares under a rank constraint (Kuo 2020, Eq. 5.13)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.arrays import Array, Float32Array
from recon.base import fft
from recon.blind.points import Mixer
from recon.camera.convolution import field_of
from recon.camera.points import Points
from recon.camera.registration import LOCAL_MEAN_PX
from recon.errors import InputError

LEAST_EXPLAINED = 0.75
"""Part of the structure above the noise that the beads have to explain."""
_STRUCTURE = 0.1  # of the fine structure's energy above the noise: with less there is nothing to explain
_SAME_BEAD_PX = 0.5  # a bead moved by less was not moved
_SAME_SLIDE = 0.7  # of the beads at the same places: the slide was not moved


def explained(data: Float32Array, model: Float32Array) -> float:
    """Return which part of the images' fine structure above the noise a model explains; 0 with none.

    Without what varies slowly, as any few points through a wide pattern make a haze.

    Parameters
    ----------
    data, model : ndarray, float32, (n_images, height, width)
    """
    from scipy import ndimage

    def fine(images: Float32Array) -> Float32Array:
        sigma = (0, LOCAL_MEAN_PX, LOCAL_MEAN_PX)
        return np.asarray(images - ndimage.gaussian_filter(images, sigma, mode="nearest"), np.float32)

    noise = float(np.median([_noise(image) for image in data])) ** 2 * data.size
    there = float(np.sum(fine(data) ** 2, dtype=np.float64))
    left = float(np.sum(fine(data - model) ** 2, dtype=np.float64))
    if there - noise < _STRUCTURE * there:
        return 0.0
    return 1 - max(left - noise, 0.0) / (there - noise)


def refuse_what_is_no_beads(data: Float32Array, model: Float32Array, beads: Sequence[Points]) -> None:
    """Raise where the images cannot be of slides of beads, moved in between and seen by one optics.

    Parameters
    ----------
    data, model : ndarray, float32, (n_images, height, width)
    beads : sequence of Points

    Raises InputError: saying what was found and what to do.
    """
    part = explained(data, model)
    if part < LEAST_EXPLAINED:
        raise InputError(
            f"The {sum(map(len, beads))} beads found explain {part:.0%} of what stands out of the noise in "
            f"these images ({LEAST_EXPLAINED:.0%} expected): are these photographs of some twenty separate "
            "beads each, taken by one camera in the dark? More light or a larger --window may help, too."
        )
    for first in range(len(beads)):
        for second in range(first + 1, len(beads)):
            one, other = beads[first].places, beads[second].places
            away = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1))
            if np.mean(away.min(axis=1) < _SAME_BEAD_PX) > _SAME_SLIDE:
                raise InputError(
                    f"Images {first + 1} and {second + 1} show the same beads at the same places: the slide "
                    "was not moved between them. Move it, by any amount, and photograph it again."
                )


def _noise(image: Float32Array) -> float:
    """Return the standard deviation of an image's noise, from second differences along the diagonals."""
    second = image[2:, 2:] - 2 * image[1:-1, 1:-1] + image[:-2, :-2]
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6))


class BeadMixer(Mixer):
    """The map from PSFs to images with the beads fixed: ``b_i = C sum_j h_j * (M_j y_i)`` (Eq. 5.11).

    Parameters
    ----------
    weights : ndarray, float32, (n_psfs, field height, field width)
        The masks ``M_j``: interpolation weights, not negative.
    beads : ndarray, float32, (n_images, field height, field width)
        Not negative.
    psf_shape, sensor_shape : (int, int)

    Attributes
    ----------
    lipschitz : float
        Bound of the squared norm: ``||S||_2^2`` with ``S_ij`` the sum of ``M_j y_i``. At each frequency the
        map is the matrix of the transforms of ``M_j y_i``, whose entries are at most those at frequency zero
        in absolute value because nothing is negative; the spectral norm of a matrix is at most that of a
        non-negative one that dominates it, and cropping only lessens it.
    """

    def __init__(
        self,
        weights: Array,
        beads: Array,
        psf_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
    ) -> None:
        super().__init__((len(beads), len(weights)), psf_shape, sensor_shape)
        field_shape, _ = field_of(sensor_shape, psf_shape)
        padded = np.zeros((len(weights), *self._grid), np.float32)
        sums = np.empty((len(beads), len(weights)))
        for i, image in enumerate(beads):
            np.multiply(weights, image, out=padded[:, : field_shape[0], : field_shape[1]])
            sums[i] = padded.sum(axis=(1, 2), dtype=np.float64)
            fft.rfft(padded, out=self._spectra[i])
        self.lipschitz = float(np.linalg.norm(sums, 2) ** 2)


def limit_rank(psfs: Array, rank: int) -> Array:
    """Return the nearest PSFs (n_psfs, height, width) that span at most ``rank`` dimensions."""
    if rank >= len(psfs):
        return psfs
    columns = psfs.reshape(len(psfs), -1)
    _, vectors = np.linalg.eigh(columns.astype(np.float64) @ columns.T.astype(np.float64))
    kept = vectors[:, -rank:]
    projection = (kept @ kept.T).astype(psfs.dtype)
    limited: Array = (projection @ columns).reshape(psfs.shape)
    return limited


def solve_psfs(
    mixer: BeadMixer, images: Array, start: Array, rank: int, iterations: int
) -> tuple[Float32Array, float]:
    """Fit PSFs of limited rank to images: FISTA whose prox is the projection on the rank (Eq. 5.13).

    The set is not convex, so momentum is dropped whenever the misfit grows; the step ``1 / lipschitz`` then
    makes every step a descent.

    Returns
    -------
    ndarray, float32, (n_psfs, psf height, psf width)
    float
        ``||f(H, y) - b||^2 / 2``.
    """
    step = np.float32(1 / mixer.lipschitz)
    x = limit_rank(np.asarray(start, np.float32), rank)
    seen = mixer.forward(x)
    misfit = _half_square(seen - images)
    y, seen_y, t = x, seen, 1.0
    for _ in range(iterations):
        new = limit_rank(y - step * mixer.adjoint(seen_y - images), rank)
        seen_new = mixer.forward(new)
        misfit_new = _half_square(seen_new - images)
        if misfit_new > misfit and t > 1:
            y, seen_y, t = x, seen, 1.0
            continue
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        beta = np.float32((t - 1) / t_next)
        y, seen_y = new + beta * (new - x), seen_new + beta * (seen_new - seen)
        x, seen, misfit, t = new, seen_new, misfit_new, t_next
    return x, misfit


def _half_square(array: Array) -> float:
    return 0.5 * float(np.vdot(array, array).real)
