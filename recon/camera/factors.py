"""What stands behind and before a camera: erased pixels, a smooth background, patterns of light.

Each is a factor of the operator that solvers are given. Erased pixels (Kuo 2020, Eq. 3.10) are also what a
raw frame of a colour mosaic comes down to: a colour measurement of which every pixel kept one channel.
Reconstructing it as such uses what was measured and invents nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.camera.base import Composition, LinearOperator, Projection
from recon.camera.convolution import Convolution
from recon.errors import InputError, StructureError


class Erasures(Projection):
    """Set the pixels that carry no information to zero: dead, saturated, deliberately not read.

    Parameters
    ----------
    valid : ndarray of bool, (height, width) or (n_channels, height, width)
        True where the pixel was measured; broadcast to ``shape``.
    shape : tuple of int
        Shape of the data, channels first.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        valid: BoolArray,
        shape: tuple[int, ...],
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        super().__init__(shape, shape, dtype)
        try:
            self.valid = np.broadcast_to(np.asarray(valid, bool), shape)
        except ValueError:
            raise InputError(
                f"valid must be an array (height, width) or {shape} of True and False, not {np.shape(valid)}."
            ) from None

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Zero the pixels that are not valid."""
        result: Array = np.multiply(x, self.valid, out=out, dtype=self.dtype)
        return result


@dataclass(frozen=True)
class CroppedConvolution:
    """``diag(weight) C F^-1 diag(H) F``: a circular convolution of which a window is measured.

    Attributes
    ----------
    convolution : Convolution
    weight : ndarray, ``range_shape``
        1 where the pixel was measured, 0 where it was erased.
    """

    convolution: Convolution
    weight: Array


def as_cropped_convolution(operator: LinearOperator) -> CroppedConvolution:
    """Return an operator's structure as a cropped convolution.

    Raises StructureError when it is something else.
    """
    weight = np.ones(operator.range_shape, operator.dtype)
    inner = operator
    while isinstance(inner, Composition) and isinstance(inner.outer, Erasures):
        weight *= inner.outer.valid
        inner = inner.inner
    if isinstance(inner, Convolution) and inner.is_picture:
        return CroppedConvolution(inner, weight)
    raise StructureError(
        f"This solver needs a Convolution of a picture, with or without Erasures; got "
        f"{type(inner).__name__}. Fista takes any operator."
    )


Pattern = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
PATTERNS: tuple[Pattern, ...] = ("RGGB", "GRBG", "GBRG", "BGGR")


def split_bayer(raw: Array, pattern: Pattern) -> tuple[Array, BoolArray]:
    """Return a Bayer raw frame as a colour measurement and its erasures, both for :func:`recon.reconstruct`.

    Parameters
    ----------
    raw : ndarray, (height, width)
        Background subtracted.
    pattern : str
        Colours of the first four pixels in reading order: ``"RGGB"`` is GenICam's ``BayerRG``.

    Returns
    -------
    image : ndarray, (height, width, 3), as ``raw``
        Red, green, blue; zero where a colour was not measured.
    erasures : ndarray of bool, (height, width, 3)
        True where a colour was not measured.
    """
    erasures = ~_sites(raw, pattern)
    return np.where(erasures, raw.dtype.type(0), raw[..., None]), erasures


def interpolate_bayer(raw: Array, pattern: Pattern) -> Float32Array:
    """Return a colour image (height, width, 3) with missing colours as the mean of their nearest neighbours.

    For PSF images, which the model needs at every pixel. It blurs details finer than two pixels.
    """
    from scipy.ndimage import convolve

    sites = _sites(raw, pattern)
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32)
    channels = []
    for c in range(3):
        known = sites[..., c].astype(np.float32)
        total = convolve(np.where(sites[..., c], raw, 0).astype(np.float32), kernel, mode="constant")
        weight = convolve(known, kernel, mode="constant")
        channels.append(np.where(sites[..., c], raw, total / np.maximum(weight, 1e-6)))
    return np.stack(channels, axis=-1).astype(np.float32)


def _sites(raw: Array, pattern: Pattern) -> BoolArray:
    """Return where each colour was measured, (height, width, 3)."""
    if pattern not in PATTERNS:
        raise InputError(f"The Bayer pattern {pattern!r} is not known. Choose one of {', '.join(PATTERNS)}.")
    if raw.ndim != 2 or min(raw.shape) < 2:
        raise InputError(f"A Bayer frame must be (height, width), at least 2 x 2; it is {raw.shape}.")
    sites = np.zeros((*raw.shape, 3), bool)
    for k, colour in enumerate(pattern):
        sites[k // 2 :: 2, k % 2 :: 2, "RGB".index(colour)] = True
    return sites


_SAMPLES = 6
"""Points at which non-negativity is asked for, for each frequency along an axis."""


class BackgroundRemoval(Projection):
    """Takes out of data what a smooth background of low DCT frequencies explains; its own adjoint.

    Kuo 2020, Eqs. 6.1 and 6.2, solves ``min_{y, g} 1/2 ||b - (A y + g)||^2 + prior(y)`` for a background
    ``g`` with low DCT frequencies only. Given ``y``, the best ``g`` is the projection of ``b - A y`` onto
    those frequencies; put back, what is left is ``min_y 1/2 ||P (b - A y)||^2 + prior(y)`` with ``P`` the
    projection onto the rest. So the joint problem needs no further unknowns, no step of its own and no start
    for ``g``: ``P`` is one more factor of the operator. The dissertation also asks for ``g >= 0``:
    :meth:`non_negative` is the projection onto backgrounds that obey it (see
    :mod:`recon.reconstruction.solve`).

    A prior that does not mind a smooth object (total variation, bounds alone) leaves object and background to
    be exchanged for one another: much light more in the one and as much less in the other, without bound. A
    ``restraint`` ``r`` adds ``r/2 ||g||^2``: the best ``g`` is ``1 / (1 + r)`` of the projection, and the
    smooth part of what is left counts ``sqrt(r / (1 + r))`` instead of nothing. Without one this is an
    orthogonal projection.

    Parameters
    ----------
    shape : (n_channels, height, width)
        Shape of the data.
    n_frequencies : (int, int)
        How many of the lowest frequencies along y and x belong to the background; 5 x 5 in the dissertation.
    valid : ndarray of bool, broadcast to ``shape``, optional
        Pixels that were measured; the others are zero in the result.
    dtype : dtype
        float32 or float64.
    restraint : float
        Weight of the background's squared norm on the valid pixels, relative to that of the misfit.

    Attributes
    ----------
    taken : float
        Share of the data's smooth part that :meth:`forward` takes out; changes with :meth:`restrain`.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        n_frequencies: tuple[int, int] = (5, 5),
        valid: BoolArray | None = None,
        dtype: npt.DTypeLike = np.float32,
        restraint: float = 0.0,
    ) -> None:
        super().__init__(shape, shape, dtype)
        self.restrain(restraint)
        _, height, width = shape
        ny, nx = min(n_frequencies[0], height), min(n_frequencies[1], width)
        self._rows, self._columns = _cosines(ny, height), _cosines(nx, width)
        valid = np.ones(shape, bool) if valid is None else np.broadcast_to(np.asarray(valid, bool), shape)
        self._valid = None if valid.all() else valid
        # Gram matrix of the basis on the valid pixels, (n_channels, ny nx, ny nx); the identity if all are.
        self._inverse = np.stack([np.linalg.pinv(self._gram(mask)) for mask in valid])

    def _gram(self, mask: BoolArray) -> Float64Array:
        yy = np.einsum("ay,by->aby", self._rows, self._rows).reshape(-1, mask.shape[0])
        xx = np.einsum("ax,bx->abx", self._columns, self._columns).reshape(-1, mask.shape[1])
        ny, nx = len(self._rows), len(self._columns)
        gram = (yy @ mask.astype(np.float64) @ xx.T).reshape(ny, ny, nx, nx)
        return np.asarray(gram.transpose(0, 2, 1, 3).reshape(ny * nx, ny * nx))

    def basis(self, channel: int) -> tuple[Array, Array, Array]:
        """Return what :meth:`background` computes with: cosines along y and x, inverse Gram matrix."""
        return self._rows, self._columns, self._inverse[channel]

    def restrain(self, restraint: float) -> None:
        """Set how much the background's squared norm counts."""
        self.restraint, self.taken = restraint, 1 - float(np.sqrt(restraint / (1 + restraint)))

    def background(self, y: Array) -> Array:
        """Return the background for data ``y``, on all pixels."""
        return self._fitted(y, 1 / (1 + self.restraint))

    def _fitted(self, y: Array, share: float) -> Array:
        """Return a share of the least-squares fit to the valid pixels, on all."""
        fitted = np.empty(self.range_shape, self.dtype)
        for channel, image in enumerate(y):
            coefficients = self._coefficients(image, channel)
            best = share * (self._inverse[channel] @ coefficients.ravel()).reshape(coefficients.shape)
            fitted[channel] = self._rows.T @ best @ self._columns
        return fitted

    def _coefficients(self, image: Array, channel: int) -> Array:
        """Return the cosines' sums over the valid pixels of a channel, (ny, nx)."""
        masked = image if self._valid is None else image * self._valid[channel]
        coefficients: Array = self._rows @ masked.astype(np.float64) @ self._columns.T
        return coefficients

    def non_negative(self, y: Array) -> Array:
        """Return the smooth image nearest to ``y`` on the valid pixels that is nowhere negative.

        A quadratic problem in a few coefficients, solved exactly through its dual by non-negative least
        squares, with ``g >= 0`` on a grid several times finer than the highest frequency; what is left
        between the grid's points is lifted off.
        """
        from scipy.optimize import nnls

        rows, columns = (
            basis[:, np.unique(np.linspace(0, basis.shape[1] - 1, _SAMPLES * len(basis)).astype(int))]
            for basis in (self._rows, self._columns)
        )
        samples = np.einsum("ay,bx->yxab", rows, columns).reshape(-1, len(rows) * len(columns))
        fitted = np.empty(self.range_shape, self.dtype)
        for channel, image in enumerate(y):
            wanted = self._coefficients(image, channel).ravel()
            values, vectors = np.linalg.eigh(self._inverse[channel])
            root = (vectors * np.sqrt(np.maximum(values, 0))).T
            scale = max(float(np.abs(root @ wanted).max()), 1e-30)
            push, _ = nnls(root @ samples.T, -(root @ wanted) / scale)
            best = self._inverse[channel] @ (wanted + scale * (samples.T @ push))
            best = best.reshape(len(self._rows), len(self._columns))
            smooth = self._rows.T @ best @ self._columns
            fitted[channel] = smooth - min(float(smooth.min()), 0.0)
        return fitted

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Remove the smooth part."""
        fitted = self._fitted(x, self.taken)
        out = np.subtract(x, fitted, out=np.empty_like(fitted) if out is None else out)
        if self._valid is not None:
            out *= self._valid
        return out


def _cosines(count: int, length: int) -> Float64Array:
    """Return the ``count`` lowest vectors of the orthonormal DCT-II of ``length``."""
    k, n = np.arange(count)[:, None], np.arange(length) + 0.5
    basis = np.sqrt(2 / length) * np.cos(np.pi * k * n / length)
    basis[:1] /= np.sqrt(2)
    return np.asarray(basis, np.float64)


class PatternedCamera(LinearOperator):
    """Active illumination: a scene lit by known patterns in turn, ``x -> (A (p_1 x), ..., A (p_K x))``.

    Each pattern lights part of the scene, so that each frame is that of a sparser scene, whose light is
    spread over the sensor less mixed up. One object ``x`` explains all frames; nothing of it may move
    meanwhile.

    Parameters
    ----------
    camera : LinearOperator
        Domain (n_channels, n_z, grid height, grid width), range (n_channels, height, width).
    patterns : ndarray, (n_patterns, height, width)
        Relative light on the part of the scene opposite to the sensor; beyond it the nearest edge's.
    window : (slice, slice)
        Where that part lies on the camera's grid.
    """

    def __init__(self, camera: LinearOperator, patterns: Array, window: tuple[slice, slice]) -> None:
        self.camera, self.window = camera, window
        grid = camera.domain_shape[2:]
        margins = [(w.start, n - w.stop) for w, n in zip(window, grid, strict=True)]
        self._patterns = np.pad(patterns, ((0, 0), *margins), mode="edge").astype(camera.dtype)
        channels, *pixels = camera.range_shape
        self._frames = (channels, len(patterns), *pixels)
        super().__init__(camera.domain_shape, (channels * len(patterns), *pixels), camera.dtype)
        brightest = float(np.max(np.sum(self._patterns.astype(np.float64) ** 2, axis=0)))
        self._norm_bound = camera.norm_bound * float(np.sqrt(brightest))

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return the frames of a scene, each channel's in turn."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        lit = np.empty(self.domain_shape, self.dtype)
        frames = out.reshape(self._frames)
        for k, pattern in enumerate(self._patterns):
            frames[:, k] = self.camera.forward(np.multiply(pattern, x, out=lit))
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Apply the camera's adjoint to each frame, weigh it with its pattern, and add up."""
        out = np.empty(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        frames = y.reshape(self._frames)
        for k, pattern in enumerate(self._patterns):
            back = self.camera.adjoint(np.ascontiguousarray(frames[:, k]))
            out += np.multiply(pattern, back, out=back)
        return out

    @property
    def norm_bound(self) -> float:
        """The camera's times the root of the brightest pixel's summed squared patterns."""
        return self._norm_bound
