"""Reconstruction of a small window of a volume from a large sensor, exactly and fast.

``min_y>=0 1/2 ||A y - b||^2`` needs the sensor only through ``A^T b`` and ``A^T A``. Where the object is
known to lie in a window of some thousand voxels, both are small: ``A^T A`` holds the cross-correlations of
the planes' PSFs at the shifts within the window. The minimiser is that of a reconstruction on the whole
sensor which is told that nothing is outside the window, at the cost of some small transforms an iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

TOLERANCE = 3e-5
MOST_ITERATIONS = 2000


@dataclass(frozen=True)
class WindowSolution:
    """What a window was reconstructed to.

    Attributes
    ----------
    volume : ndarray, float64, (n_z, height, width)
    iterations : int
    change : float
        Relative change in the last iteration.
    """

    volume: Floats
    iterations: int
    change: float


class WindowProblem:
    """Reconstructs windows about the axis with tau = 0: least squares with non-negativity (Eq. 4.2).

    The sensor is taken for large enough to hold the shifted PSFs: right for windows small against the dark
    rim around the pattern.

    Parameters
    ----------
    planes : ndarray, (n_z, height, width)
        On-axis PSFs of the window's planes.
    half : (int, int)
        Rows and columns that the window reaches from the axis: ``2 half + 1`` voxels.
    """

    def __init__(self, planes: Array, half: tuple[int, int]) -> None:
        if planes.ndim != 3:
            raise InputError(f"Planes are (n_z, height, width), not {planes.shape}.")
        self.half = half
        self.n_z = len(planes)
        self.sensor_shape = planes.shape[1:]
        self._norms = np.sqrt(np.einsum("zij,zij->z", planes, planes, dtype=np.float64))
        if not (self._norms > 0).all():
            raise InputError("A plane's PSF is zero everywhere.")
        reach = [2 * h for h in half]
        self._grid = fft.fast_shape([n + r for n, r in zip(self.sensor_shape, reach, strict=True)])
        self._spectra = np.stack([self._spectrum(p / n) for p, n in zip(planes, self._norms, strict=True)])
        self._small = fft.fast_shape([2 * r + 1 for r in reach])
        # (frequencies, n_z, n_z): one small matrix product for each frequency.
        self._gram = self._correlations(reach)
        # Circulant embedding: the window's A^T A is a compression of it, so its norm bounds ours.
        self._lipschitz = float(np.linalg.eigvalsh(self._gram)[:, -1].max())

    def adjoint(self, data: Array) -> Floats:
        """Return ``A^T b`` in the window; columns have norm 1."""
        spectrum = self._spectrum(data)
        return np.stack(
            [self._around(fft.irfft(spectrum * np.conj(h), self._grid[1]), self.half) for h in self._spectra]
        )

    def solve(
        self, data: Array, *, iterations: int = MOST_ITERATIONS, tolerance: float = TOLERANCE
    ) -> WindowSolution:
        """Reconstruct from an image (height, width): accelerated projected gradient with restart.

        The step is 1 over a bound of the norm of ``A^T A``. In units of the PSFs as given.
        """
        if data.shape != self.sensor_shape:
            raise InputError(f"The image is {data.shape}, the PSFs are {self.sensor_shape}.")
        target = self.adjoint(data)
        x = np.zeros_like(target)
        y, t, change = x, 1.0, np.inf
        done = 0
        for done in range(1, iterations + 1):  # noqa: B007 (how many it took)
            new = np.maximum(y - (self._normal(y) - target) / self._lipschitz, 0.0)
            step = new - x
            if float(np.vdot(y - new, step)) > 0:  # the momentum points against the descent
                t = 1.0
            t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
            y = new + (t - 1) / t_next * step
            x, t = new, t_next
            size = float(np.linalg.norm(x))
            change = float(np.linalg.norm(step)) / size if size > 0 else 0.0
            if change < tolerance:
                break
        return WindowSolution(x / self._norms[:, None, None], done, change)

    def _normal(self, x: Floats) -> Floats:
        """``A^T A x`` in the window."""
        rows, columns = (2 * h + 1 for h in self.half)
        padded = np.zeros((self.n_z, *self._small))
        padded[:, :rows, :columns] = x
        spectra = fft.rfft(padded).reshape(self.n_z, -1)
        seen = np.matmul(self._gram, spectra.T[:, :, None])[:, :, 0].T
        shape = (self.n_z, *fft.spectrum_shape(self._small))
        return fft.irfft(np.ascontiguousarray(seen).reshape(shape), self._small[1])[:, :rows, :columns]

    def _correlations(self, reach: list[int]) -> npt.NDArray[np.complex128]:
        gram = np.empty((self.n_z, self.n_z, *fft.spectrum_shape(self._small)), np.complex128)
        for j in range(self.n_z):
            for k in range(j, self.n_z):
                product = np.conj(self._spectra[j]) * self._spectra[k]
                near = self._around(fft.irfft(product, self._grid[1]), (reach[0], reach[1]))
                kernel = np.zeros(self._small)
                kernel[: near.shape[0], : near.shape[1]] = near
                kernel = np.roll(kernel, (-reach[0], -reach[1]), (0, 1))
                gram[j, k] = fft.rfft(kernel)
                gram[k, j] = np.conj(gram[j, k])
        return np.ascontiguousarray(gram.reshape(self.n_z, self.n_z, -1).transpose(2, 0, 1))

    def _spectrum(self, image: Array) -> Array:
        padded = np.zeros(self._grid)
        padded[: image.shape[0], : image.shape[1]] = image
        return fft.rfft(padded)

    def _around(self, correlation: Floats, half: tuple[int, int]) -> Floats:
        rows, columns = (np.arange(-h, h + 1) for h in half)
        return correlation[np.ix_(rows, columns)]
