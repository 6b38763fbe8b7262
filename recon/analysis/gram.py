"""What of ``A^T A`` a few voxels need: can neighbours be told apart, and a window reconstructed exactly.

If an oracle tells which voxels are lit, their values are a least-squares problem with the columns of these
voxels alone; its condition number bounds what noise does to them (Kuo 2020, sec. 4.4, Fig. 4.5). Columns are
never put together to a matrix: their inner products (the Gram matrix, double precision) are enough, whose
eigenvalues are the squares of the singular values.

``min_y>=0 1/2 ||A y - b||^2`` needs the sensor only through ``A^T b`` and ``A^T A``. Where the object is
known to lie in a window of some thousand voxels, both are small: ``A^T A`` holds the cross-correlations of
the planes' PSFs at the shifts within the window. The minimiser is that of a reconstruction on the whole
sensor which is told that nothing is outside the window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base import fft
from recon.errors import InputError

Single = Float32Array
Direction = Literal["x", "z", "xz"]

WORST = 1e7
"""Condition numbers above this are rounding: the Gram matrix holds their squares, in 16 digits."""
TOLERANCE = 1e-5
"""Of the gradient, relative to the data's: what asks for less light gets none."""
RIDGE = 1e-6
"""Added to columns' squared norm of 1: products are known to so many digits."""
MOST_ROUNDS = 300
_JOIN = 8  # voxels that join in a round, at least
_NEAR_MOST = 0.3  # of the largest gradient, above which others join with it


@dataclass(frozen=True, slots=True)
class Voxel:
    """A voxel: depth plane, and rows and columns from the axis in sensor pixels."""

    plane: int
    row: int = 0
    column: int = 0


def group(direction: Direction, count: int, separation: int, *, first_plane: int = 0) -> tuple[Voxel, ...]:
    """Return voxels of a regular group.

    Parameters
    ----------
    direction : "x", "z" or "xz"
        A line of ``count`` along the columns or along depth, or a square of ``count`` in both.
    count : int
        For ``"xz"`` a square number.
    separation : int
        Voxels from one to the next; in ``"xz"`` in both directions.
    first_plane : int
        Nearest plane of the group.
    """
    n_z, n_x = _sides(direction, count)
    start = -separation * (n_x - 1) // 2
    places = product(range(n_z), range(n_x))
    return tuple(Voxel(first_plane + separation * j, 0, start + separation * i) for j, i in places)


def _sides(direction: Direction, count: int) -> tuple[int, int]:
    """Return how many voxels a group has along depth and along the columns."""
    side = round(count**0.5)
    if direction == "xz" and side * side != count:
        raise InputError(f"A group in x and z is a square: 4, 9, 16, ... sources, not {count}.")
    return {"x": (1, count), "z": (count, 1), "xz": (side, side)}[direction]


def gram_matrix(planes: Array, voxels: Sequence[Voxel]) -> Float64Array:
    """Inner products of the columns of voxels: each plane's PSF, shifted, and cropped to the sensor.

    Parameters
    ----------
    planes : ndarray, (n_z, height, width)
        On-axis PSFs.

    Returns
    -------
    ndarray, float64, (n, n)
    """
    height, width = planes.shape[1:]
    for voxel in voxels:
        if not 0 <= voxel.plane < len(planes) or abs(voxel.row) >= height or abs(voxel.column) >= width:
            raise InputError(f"{voxel} is not within {len(planes)} planes of {height} x {width} pixels.")
    gram = np.empty((len(voxels), len(voxels)))
    for i, first in enumerate(voxels):
        for j in range(i, len(voxels)):
            gram[i, j] = gram[j, i] = _product(planes, first, voxels[j])
    return gram


def condition_number(gram: Float64Array) -> float:
    """Condition number of the columns with this Gram matrix, each column divided by its norm.

    Infinite where a column is zero or the columns are dependent as far as double precision tells.
    """
    norms = np.sqrt(np.diag(gram))
    if not (norms > 0).all():
        return float("inf")
    values = np.linalg.eigvalsh(gram / np.outer(norms, norms))
    if values[0] <= values[-1] / WORST**2:
        return float("inf")
    return float(np.sqrt(values[-1] / values[0]))


@dataclass(frozen=True, slots=True)
class ConditionCurve:
    """Condition number of groups of ``count`` sources at growing separations, in voxels."""

    direction: Direction
    count: int
    separations: tuple[int, ...]
    values: tuple[float, ...]


def condition_curve(
    planes: Array, direction: Direction, count: int, separations: Sequence[int]
) -> ConditionCurve:
    """Compute one curve of Fig. 4.5; separations for which there are too few planes are left out."""
    kept, values = [], []
    n_z, n_x = _sides(direction, count)
    for separation in separations:
        depth, reach = (separation * (n - 1) + 1 for n in (n_z, n_x))
        if depth > len(planes) or reach > planes.shape[2] // 2:
            continue
        voxels = group(direction, count, separation, first_plane=(len(planes) - depth) // 2)
        kept.append(int(separation))
        values.append(condition_number(gram_matrix(planes, voxels)))
    return ConditionCurve(direction, count, tuple(kept), tuple(values))


def _product(planes: Array, first: Voxel, second: Voxel) -> float:
    """Inner product of two shifted, cropped PSFs, without copies."""
    cuts: list[list[slice]] = [[], []]
    for size, a, b in zip(
        planes.shape[1:], (first.row, first.column), (second.row, second.column), strict=True
    ):
        # On the sensor both are present from max(a, b, 0) to size + min(a, b, 0).
        low, high = max(a, b, 0), size + min(a, b, 0)
        if high <= low:
            return 0.0
        cuts[0].append(slice(low - a, high - a))
        cuts[1].append(slice(low - b, high - b))
    one, two = planes[first.plane][tuple(cuts[0])], planes[second.plane][tuple(cuts[1])]
    return float(np.einsum("ij,ij->", one, two, dtype=np.float64))


# Windows --------------------------------------------------------------------------------------------
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
        self._turned = np.ascontiguousarray(np.conj(self._spectra).transpose(1, 0, 2))
        self._products = self._correlations((reach[0], reach[1]))
        down, right = (np.arange(-h, h + 1) for h in half)
        height, width = self._grid
        u, v = np.arange(height), np.arange(width // 2 + 1)
        both = np.where((v == 0) | (2 * v == width), 1.0, 2.0) / (height * width)
        self._waves = (
            np.exp(2j * np.pi * np.outer(down, u) / height).astype(np.complex64),
            (both[:, None] * np.exp(2j * np.pi * np.outer(v, right) / width)).astype(np.complex64),
        )

    def adjoint(self, data: Array) -> Single:
        """Return ``A^T b`` in the window; columns have norm 1."""
        # Few shifts are asked for: their sums over frequencies cost less than whole transforms.
        down, right = self._waves
        seen = self._spectrum(data)[:, None] * self._turned  # (rows, n_z, columns) of frequencies
        some = (down @ seen.reshape(len(seen), -1)).reshape(-1, self.n_z, seen.shape[2])
        return np.ascontiguousarray((some @ right).real.transpose(1, 0, 2))

    def solve(self, data: Array) -> Single:
        """Reconstruct from an image (height, width) by an active set (Lawson and Hanson).

        Voxels join where the gradient asks for light most, several at a time, and leave where their least
        squares do; it ends where none asks for more than :data:`TOLERANCE` of what the first did. Returns
        float32, (n_z, rows, columns) of the window, in units of the PSFs as given.
        """
        from scipy.ndimage import maximum_filter  # late: importing recon stays light

        if data.shape != self.sensor_shape:
            raise InputError(f"The image is {data.shape}, the PSFs are {self.sensor_shape}.")
        target = self.adjoint(data).astype(np.float64)
        x, lit, asking = np.zeros_like(target), np.zeros(target.shape, bool), target
        for _ in range(MOST_ROUNDS):
            outside = np.where(lit, -np.inf, asking)
            if outside.max() <= max(TOLERANCE * target.max(), 0.0):
                break
            peaks = (outside == maximum_filter(outside, 3)) & (outside > _NEAR_MOST * outside.max())
            places = np.flatnonzero(peaks)
            best = np.argsort(outside.flat[places])[::-1][: max(_JOIN, int(lit.sum()) // 4)]
            lit.flat[places[best]] = True
            self._fit(x, lit, target)
            asking = target - self._normal(x)
        return np.asarray(x / self._norms[:, None, None], np.float32)

    def _fit(self, x: Float64Array, lit: BoolArray, target: Float64Array) -> None:
        """Bring ``x`` to the least squares of the lit voxels; those that would be negative go dark."""
        from scipy.linalg import solve  # late, as above

        while lit.any():
            z, r, c = np.nonzero(lit)
            rows, columns = (2 * h for h in self.half)
            gram = self._products[
                z[:, None], z, r[:, None] - r + rows, c[:, None] - c + columns
            ] + RIDGE * np.eye(len(z))
            wanted = np.asarray(solve(gram, target[lit], assume_a="pos", check_finite=False))
            if (falling := wanted <= 0).any():
                now = x[lit]
                shares = np.where(falling, now / np.where(falling, now - wanted, 1.0), 1.0)
                now = now + shares.min() * (wanted - now)
                now[falling & (shares <= shares.min())] = 0.0
                x[lit] = now
                lit[lit] = ~(falling & (now <= 0))
                continue
            x[lit] = wanted
            return

    def _normal(self, x: Float64Array) -> Float64Array:
        """``A^T A x`` in the window."""
        seen = np.zeros_like(x)
        rows, columns = (2 * h + 1 for h in self.half)
        for k, r, c in np.argwhere(x > 0):
            down, right = rows - 1 - r, columns - 1 - c
            seen += x[k, r, c] * self._products[:, k, down : down + rows, right : right + columns]
        return seen

    def _correlations(self, reach: tuple[int, int]) -> Float64Array:
        """Return the inner products of planes ``j`` and ``k`` shifted against one another, (j, k, r, c)."""
        shape = 2 * reach[0] + 1, 2 * reach[1] + 1
        products = np.empty((self.n_z, self.n_z, *shape))
        for j in range(self.n_z):
            for k in range(j, self.n_z):
                spectrum = np.conj(self._spectra[j]) * self._spectra[k]
                products[j, k] = self._around(fft.irfft(spectrum, self._grid[1]), reach)
                products[k, j] = products[j, k, ::-1, ::-1]
        return products

    def _spectrum(self, image: Array) -> Array:
        padded = np.zeros(self._grid, np.float32)
        padded[: image.shape[0], : image.shape[1]] = image
        return fft.rfft(padded)

    def _around(self, correlation: Single, half: tuple[int, int]) -> Single:
        rows, columns = (np.arange(-h, h + 1) for h in half)
        return correlation[np.ix_(rows, columns)]
