"""Beads as points: the half-steps for their places and light, and for smooth PSFs on their support.

On a grid of pixels a bead between them is a blob, and the PSF that fits it too sharp: with spots hardly wider
than a pixel this model error exceeds the noise. A point with a continuous place has none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.camera.convolution import field_of
from recon.camera.points import FieldFunctions, Points

Array = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[Any]


_BLUR_PX = 0.8  # of the image in which the support is found
_ABOVE_NOISE = 3.0  # standard deviations: fainter pixels would sum to a haze of noise
_LEAST_PX = 4  # pixels in one piece


class Mixer:
    """A linear map from PSFs to images in which each image is a sum of the PSFs' convolutions, cropped.

    Subclasses fill ``_spectra``: of what image ``i`` has of PSF ``k``, (n_images, n_psfs, *spectrum).
    """

    _spectra: npt.NDArray[np.complex64]

    def __init__(self, psf_shape: tuple[int, int], sensor_shape: tuple[int, int]) -> None:
        self._psf, self._sensor = psf_shape, sensor_shape
        self._grid = fft.fast_shape(field_of(sensor_shape, psf_shape)[0])

    def forward(self, psfs: Numbers) -> Array:
        """Return images (n_images, height, width) of PSFs (n_psfs, psf height, psf width)."""
        padded = np.zeros((len(psfs), *self._grid), np.float32)
        padded[:, : self._psf[0], : self._psf[1]] = psfs
        spectra = fft.rfft(padded)
        seen = np.stack([np.einsum("kyx,kyx->yx", row, spectra) for row in self._spectra])
        return np.ascontiguousarray(fft.irfft(seen, self._grid[1])[self._window])

    def adjoint(self, images: Numbers) -> Array:
        """Return the exact transpose."""
        padded = np.zeros((len(images), *self._grid), np.float32)
        padded[self._window] = images
        spectra = np.conj(fft.rfft(padded))
        total = np.zeros(self._spectra.shape[1:], np.complex64)
        for row, image in zip(self._spectra, spectra, strict=True):
            total += row * image
        back = fft.irfft(np.conj(total), self._grid[1])
        return np.ascontiguousarray(back[:, : self._psf[0], : self._psf[1]])

    @property
    def _window(self) -> tuple[slice, slice, slice]:
        (top, left), (height, width) = ((n - 1 for n in self._psf), self._sensor)
        return slice(None), slice(top, top + height), slice(left, left + width)


class PointMixer(Mixer):
    """The map from PSFs to images with points fixed: ``b_i = C sum_b a_b sum_k phi_k(x_b) p_k(u - x_b)``.

    Parameters
    ----------
    beads : sequence of Points
        One an image.
    functions : FieldFunctions
        ``phi_k``.
    psf_shape, sensor_shape : (int, int)

    Attributes
    ----------
    lipschitz : float
        Squared norm without the cropping, which only lessens it: the largest over the frequencies of the
        squared norm of the matrix (n_images, n_functions) that the map is at each.
    """

    def __init__(
        self,
        beads: Sequence[Points],
        functions: FieldFunctions,
        psf_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
    ) -> None:
        super().__init__(psf_shape, sensor_shape)
        _, centre = field_of(sensor_shape, psf_shape)
        f_y, f_x = np.fft.fftfreq(self._grid[0]), np.fft.rfftfreq(self._grid[1])
        self._spectra = np.empty((len(beads), functions.count, len(f_y), len(f_x)), np.complex64)
        for points, out in zip(beads, self._spectra, strict=True):
            weights = functions.at(points.places) * points.light[:, None]
            rows = np.exp(-2j * np.pi * np.outer(points.places[:, 0] + centre[0], f_y)).astype(np.complex64)
            columns = np.exp(-2j * np.pi * np.outer(points.places[:, 1] + centre[1], f_x))
            for k in range(functions.count):
                out[k] = rows.T @ (weights[:, k, None] * columns).astype(np.complex64)
        self.lipschitz = self._largest()

    def _largest(self) -> float:
        largest = 0.0
        for row in range(self._spectra.shape[2]):  # one row of frequencies at a time: little memory
            s = self._spectra[:, :, row]
            gram = np.einsum("nkx,njx->xkj", np.conj(s), s)
            largest = max(largest, float(np.linalg.eigvalsh(gram)[:, -1].max()))
        return largest


def solve_smooth(
    mixer: PointMixer, images: Numbers, start: Numbers, support: Numbers | None, iterations: int
) -> tuple[Array, float]:
    """Fit the PSFs of all field functions to the images: FISTA with the projection on the support as prox.

    The set is a subspace and the step ``1 / lipschitz``, so it converges to the least squares on it.

    Returns
    -------
    ndarray, float32, (n_functions, psf height, psf width)
    float
        ``||f - b||``.
    """
    kept = np.float32(1) if support is None else support.astype(np.float32)
    step = np.float32(1 / mixer.lipschitz)
    x: Array = np.asarray(start * kept, np.float32)
    y, t = x, 1.0
    for _ in range(iterations):
        new = (y - step * mixer.adjoint(mixer.forward(y) - images)) * kept
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        y = new + np.float32((t - 1) / t_next) * (new - x)
        x, t = new, t_next
    return x, float(np.linalg.norm(mixer.forward(x) - images))


def support_of(psf: Numbers) -> npt.NDArray[np.bool_]:
    """Return where a noisy PSF (height, width) has light: above the noise, in pieces of several pixels.

    The noise is read from the negative values, which light does not have. Elsewhere nothing but noise would
    be fitted, and the sum of a little noise in many pixels is a haze over every reconstruction.
    """
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(np.asarray(psf, np.float32), _BLUR_PX)
    negative = smooth[smooth < 0]
    if not negative.size:
        return np.ones(psf.shape, bool)
    noise = float(np.sqrt(np.mean(negative**2)))
    lit = smooth > _ABOVE_NOISE * noise
    pieces, count = ndimage.label(lit)
    if not count:
        return np.ones(psf.shape, bool)
    sizes = ndimage.sum_labels(lit, pieces, np.arange(count + 1))
    support: npt.NDArray[np.bool_] = ndimage.binary_dilation(sizes[pieces] >= _LEAST_PX)
    return support if support.any() else np.ones(psf.shape, bool)
