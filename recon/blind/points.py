"""Beads as points: the half-steps for their places and light, and for smooth PSFs on their support.

On a grid of pixels a bead between them is a blob, and the PSF that fits it too sharp: with spots hardly wider
than a pixel this model error exceeds the noise. A point with a continuous place has none of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array
from recon.base import fft
from recon.camera.base import LinearOperator
from recon.camera.convolution import field_of
from recon.camera.points import FieldFunctions, Points

Numbers = Array


_BLUR_PX = 0.8  # of the image in which the support is found
_ABOVE_NOISE = 3.0  # standard deviations: fainter pixels would sum to a haze of noise
_LEAST_PX = 4  # pixels in one piece


class Mixer(LinearOperator):
    """The map from PSFs to images in which each image is a sum of the PSFs' convolutions, cropped.

    Subclasses fill ``_spectra``, of what image ``i`` has of PSF ``k``: (n_images, n_psfs, *spectrum); and
    ``lipschitz``, a bound of the squared norm.
    """

    lipschitz: float

    def __init__(
        self, counts: tuple[int, int], psf_shape: tuple[int, int], sensor_shape: tuple[int, int]
    ) -> None:
        n_images, n_psfs = counts
        super().__init__((n_psfs, *psf_shape), (n_images, *sensor_shape), np.float32)
        self._grid = fft.fast_shape(field_of(sensor_shape, psf_shape)[0])
        self._spectra = np.empty((*counts, *fft.spectrum_shape(self._grid)), np.complex64)
        self._seen = np.empty((n_images, *self._spectra.shape[2:]), np.complex64)
        self._product = np.empty(self._spectra.shape[1:], np.complex64)
        self._rows = np.empty((n_images, sensor_shape[0], self._grid[1]), np.float32)

    def forward(self, x: Numbers, out: Float32Array | None = None) -> Float32Array:
        """Return images (n_images, height, width) of PSFs (n_psfs, psf height, psf width)."""
        _, height, width = self.domain_shape
        padded = np.zeros((len(x), *self._grid), np.float32)
        padded[:, :height, :width] = x
        spectra = fft.rfft(padded)
        for row, seen in zip(self._spectra, self._seen, strict=True):
            np.einsum("kyx,kyx->yx", row, spectra, out=seen)
        rows = fft.irfft_strip(self._seen, height - 1, self._rows)
        return _into(out, rows[:, :, width - 1 : width - 1 + self.range_shape[2]])

    def adjoint(self, y: Numbers, out: Float32Array | None = None) -> Float32Array:
        """Return the exact transpose."""
        _, height, width = self.domain_shape
        self._rows[...] = 0
        self._rows[:, :, width - 1 : width - 1 + self.range_shape[2]] = y
        fft.rfft_strip(self._rows, height - 1, self._seen)
        np.conj(self._seen, out=self._seen)
        total = np.zeros(self._spectra.shape[1:], np.complex64)
        for row, image in zip(self._spectra, self._seen, strict=True):
            total += np.multiply(row, image, out=self._product)
        back = fft.irfft(np.conj(total), self._grid[1])
        return _into(out, back[:, :height, :width])

    @property
    def norm_bound(self) -> float:
        """Root of ``lipschitz``."""
        return float(np.sqrt(self.lipschitz))


def _into(out: Float32Array | None, values: Float32Array) -> Float32Array:
    if out is None:
        return values.copy()
    out[...] = values
    return out


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
        super().__init__((len(beads), functions.count), psf_shape, sensor_shape)
        _, centre = field_of(sensor_shape, psf_shape)
        f_y, f_x = np.fft.fftfreq(self._grid[0]), np.fft.rfftfreq(self._grid[1])
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
) -> tuple[Float32Array, float]:
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
    x: Float32Array = np.asarray(start * kept, np.float32)
    y, t = x, 1.0
    for _ in range(iterations):
        new = (y - step * mixer.adjoint(mixer.forward(y) - images)) * kept
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        y = new + np.float32((t - 1) / t_next) * (new - x)
        x, t = new, t_next
    return x, float(np.linalg.norm(mixer.forward(x) - images))


def support_of(psf: Numbers) -> BoolArray:
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
    support: BoolArray = ndimage.binary_dilation(sizes[pieces] >= _LEAST_PX)
    return support if support.any() else np.ones(psf.shape, bool)
