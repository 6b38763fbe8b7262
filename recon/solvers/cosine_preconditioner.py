"""A preconditioner for the exact data term on the sensor plane, from its cosine modes.

Cropping makes the sensor's system ``I + C q C^T`` a Toeplitz matrix instead of a circulant one, and a
diffuser's transfer function carries 10^5 times more power at its lowest frequencies than elsewhere. A Fourier
preconditioner wraps the image around, which spoils just these frequencies. The cosine transform mirrors it
instead: the system is nearly diagonal there, and the few modes where "nearly" is not enough are inverted
exactly.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base import fft
from recon.base.namespace import Namespace, to_host

EXACT_MODES = 18
"""Lowest cosine modes per axis that are inverted together: their matrix has 324 rows."""

BANDWIDTH = 4
"""Frequencies up to this multiple of the highest exact mode's are summed for their matrix."""

NEARLY = 0.01
"""Change of the share that a background takes from which on a preconditioner follows."""


class CosinePreconditioner:
    """Approximate inverse of ``I + W C F^-1 s q F C^T W`` for one channel, symmetric and positive.

    ``C`` crops to the sensor, ``W`` lets the lowest of its cosine modes count less, as a smooth background
    that is estimated as well does, and ``s`` is a number. In the sensor's cosine basis the inverse is taken
    as ``1 / (1 + s q)``, diagonal (Chan's optimal diagonal, from the autocorrelation times the overlap of the
    sensor with itself shifted) but for the block of the lowest modes, which is exact.

    Parameters
    ----------
    grid_shape, sensor_shape : (int, int)
    dtype : dtype
    xp : module
        Whose arrays: ``numpy`` or ``cupy``.
    """

    def __init__(
        self,
        grid_shape: tuple[int, int],
        sensor_shape: tuple[int, int],
        dtype: npt.DTypeLike,
        xp: Namespace = np,
    ) -> None:
        self._xp, self._shapes = xp, (grid_shape, sensor_shape)
        self._modes: Array = xp.empty(sensor_shape, dtype)
        self._low = _LowModes(grid_shape, sensor_shape)
        self._weights = np.ones(self._low.counts)
        self._symbol: Array = xp.zeros((1, 1), dtype)
        self._near: Array = np.zeros((self._low.size, self._low.size))
        self._scale: float | None = None

    def weigh(self, shape: tuple[int, int], weight: float) -> None:
        """Have so many of the lowest modes count less from the next scale or penalties on."""
        self._weights[: shape[0], : shape[1]] = weight
        self._scale = None

    def set_curvature(self, q: Array) -> None:
        """Give ``q``, real, on the half spectrum; it is not kept."""
        q = to_host(q)
        self._symbol = self._xp.asarray(_cosine_symbol(q, *self._shapes))
        self._near = self._low.block(self._low.near(q))
        self._scale = None

    def set_scale(self, scale: float) -> None:
        """Set ``s``."""
        if scale == self._scale:
            return
        self._scale = scale
        gain = self._symbol * self._symbol.dtype.type(scale)
        gain += 1
        self._gain = 1 / gain
        self._set_low(scale * self._near)

    def _set_low(self, block: Array) -> None:
        """Invert ``1 +`` the lowest modes' block."""
        from scipy.linalg import lapack

        weights = self._weights.ravel()
        system = block * (weights * weights[:, None])
        system.ravel()[:: len(system) + 1] += 1
        # Symmetric, so that its transpose, as the library has matrices, is overwritten in place. The inverse'
        # half takes 0.4 of a general inverse's time.
        factor, _ = lapack.dpotrf(system.T, lower=1, overwrite_a=True)
        inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=True)
        half = inverse.astype(self._modes.dtype)
        self._low_gain = self._xp.asarray(np.where(self._low.lower, half, half.T))

    def apply(self, r: Array, out: Array) -> Array:
        """Write the preconditioned residual into ``out``."""
        height, width = self._low.counts
        modes = fft.dct(r, self._modes)
        low = self._low_gain @ modes[:height, :width].ravel()
        modes *= self._gain
        modes[:height, :width] = low.reshape(height, width)
        return fft.idct(modes, out)


class PicturePreconditioner(CosinePreconditioner):
    """The same for ``q = power / T`` with ``T = separable + differences |Psi|^2``, whose penalties change.

    The diagonal is that of the power over T's own: a change of penalties costs no transform.

    Parameters
    ----------
    power : ndarray, (grid_height, grid_width // 2 + 1)
        ``|H|^2`` of the camera's transfer function.
    grid_shape, sensor_shape : (int, int)
    """

    def __init__(self, power: Array, grid_shape: tuple[int, int], sensor_shape: tuple[int, int]) -> None:
        super().__init__(grid_shape, sensor_shape, power.dtype)
        self._symbol = _cosine_symbol(power, grid_shape, sensor_shape)
        rows, columns = (laplacian_eigenvalues(2 * n)[:n] for n in sensor_shape)
        self._laplacian = (rows[:, None] + columns[None]).astype(power.dtype)
        self._power = self._low.near(power)
        self._gain = np.ones(sensor_shape, power.dtype)

    def set_penalties(self, differences: float, separable: float) -> None:
        """Adapt to ``T``."""
        dtype = self._gain.dtype
        np.multiply(self._laplacian, dtype.type(differences), out=self._gain)
        self._gain += dtype.type(separable)
        # 1 / (1 + symbol / T)
        np.divide(self._gain, self._gain + self._symbol, out=self._gain)
        self._set_low(self._low.block(self._power / (separable + differences * self._low.laplacian)))


def laplacian_eigenvalues(n: int) -> Array:
    """Eigenvalues of the wrapped second difference over ``n`` pixels: ``4 sin^2(pi k / n)``."""
    eigenvalues: Array = 4 * np.sin(np.pi * np.arange(n) / n) ** 2
    return eigenvalues


def _cosine_symbol(q: Array, grid_shape: tuple[int, int], sensor_shape: tuple[int, int]) -> Array:
    """Diagonal of ``Phi C F^-1 q F C^T Phi^T`` up to the coupling of mirrored modes."""
    (grid_height, grid_width), (height, width) = grid_shape, sensor_shape
    autocorrelation = fft.irfft(q.astype(fft.complex_dtype(q.dtype)), grid_width)
    overlap = np.zeros((2 * height, 2 * width), q.dtype)
    rows, row_share = _lags(height, grid_height)
    columns, column_share = _lags(width, grid_width)
    shares = np.outer(row_share, column_share).astype(q.dtype)
    overlap[np.ix_(rows, columns)] = (
        shares * autocorrelation[np.ix_(rows % grid_height, columns % grid_width)]
    )
    symbol = np.maximum(fft.rfft(overlap).real, 0)
    mirrored = symbol[(-np.arange(height)) % (2 * height)]
    return np.ascontiguousarray(0.5 * (symbol[:height, :width] + mirrored[:, :width]))


def _lags(n: int, grid: int) -> tuple[Array, Array]:
    """Return shifts of ``n`` pixels against themselves that the grid tells apart, and the share in common."""
    reach = min(n - 1, (grid - 1) // 2)
    lags = np.arange(-reach, reach + 1)
    return lags, 1 - np.abs(lags) / n


class _LowModes:
    """The matrix of ``C q C^T`` between the lowest cosine modes, summed over the frequencies near them."""

    def __init__(self, grid_shape: tuple[int, int], sensor_shape: tuple[int, int]) -> None:
        self.counts = (min(EXACT_MODES, sensor_shape[0]), min(EXACT_MODES, sensor_shape[1]))
        self.size = self.counts[0] * self.counts[1]
        (rows, fy), (columns, fx) = (
            _mode_pairs(*args) for args in zip(self.counts, sensor_shape, grid_shape, strict=True)
        )
        # Modes and q are real, so that -f adds the conjugate of what f does: half of the columns' frequencies
        # do for all, as real parts. That of 0, and the highest where there is one, are their own partners.
        columns = columns[:, fx >= 0] * np.where((fx > 0) & (2 * fx < grid_shape[1]), 2, 1)[fx >= 0]
        fx = fx[fx >= 0]
        self._at = fy[:, None] % grid_shape[0], fx[None]
        self.laplacian = (
            laplacian_eigenvalues(grid_shape[0])[fy][:, None] + laplacian_eigenvalues(grid_shape[1])[fx][None]
        )
        # Both pairs the other way round are the conjugate as well: half of the rows' pairs do.
        first, second = np.triu_indices(self.counts[0])
        upper = rows[first * self.counts[0] + second] / (grid_shape[0] * grid_shape[1])
        self._rows = np.concatenate([upper.real, -upper.imag])
        self._columns = np.concatenate([columns.real, columns.imag], axis=1)
        self._pairs = first, second
        self.lower = np.tri(self.size, dtype=bool)

    def near(self, q: Array) -> Array:
        """Return the values of a half spectrum at these frequencies."""
        values: Array = q[self._at].astype(np.float64)
        return values

    def block(self, near: Array) -> Array:
        """Return the matrix of ``q`` near, (n_modes, n_modes), float64."""
        (ky, kx), (first, second) = self.counts, self._pairs
        real, imaginary = np.split(self._rows @ near, 2)
        pairs = (np.hstack([real, imaginary]) @ self._columns.T).reshape(-1, kx, kx)
        block = np.empty((ky, kx, ky, kx))
        block[second, :, first] = pairs.transpose(0, 2, 1)
        block[first, :, second] = pairs
        square: Array = block.reshape(self.size, self.size)
        return square


def _mode_pairs(count: int, n: int, grid: int) -> tuple[Array, Array]:
    """Return products of the modes' spectra for each pair of modes, and the (signed) frequencies kept."""
    reach = int(np.ceil(BANDWIDTH * count * grid / (2 * n)))
    near = np.arange(-reach, reach + 1)
    frequencies = near if len(near) < grid else np.arange(grid) - (grid - 1) // 2
    modes = np.cos(np.pi * np.arange(count)[:, None] * (np.arange(n) + 0.5) / n) * np.sqrt(2 / n)
    modes[0] /= np.sqrt(2)
    spectra = np.fft.fft(modes, grid, axis=1)[:, frequencies]
    return (spectra[:, None] * spectra[None].conj()).reshape(count * count, -1), frequencies
