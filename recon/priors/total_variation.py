"""Total variation: exact (by an inner iteration), with separable constraints, and the Haar form of A.1."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.namespace import namespace_of
from recon.camera.base import LinearOperator
from recon.priors.base import Prior, Separable, Zero, require_weight


class Differences(LinearOperator):
    """``weights[i] * (x[next along axis i] - x)``, stacked over the trailing axes.

    Parameters
    ----------
    shape : tuple of int
        Shape of the object, channels first.
    weights : array, (n_axes,) or (n_z, n_axes)
        One for each of the trailing axes, e.g. ``(1, 1)`` for a picture; a volume's depth axis wants its own.
        Of a volume also for each depth.
    wrap : tuple of bool, optional
        Whether the last pixel of an axis neighbours the first; default True for all. Wrapped differences are
        diagonal in Fourier space. Without wrapping the last difference is zero.
    dtype : dtype
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        weights: npt.ArrayLike,
        wrap: tuple[bool, ...] | None = None,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        self.weights = np.asarray(weights, np.float64)
        n_axes = self.weights.shape[-1]
        super().__init__(shape, (n_axes, *shape), dtype)
        by_depth = self.weights.ndim == 2 and len(shape) >= 3 and len(self.weights) == shape[-3]
        if not 1 <= n_axes <= len(shape) or not (self.weights.ndim == 1 or by_depth):
            raise ValueError(f"Weights {self.weights.shape} do not fit an object of shape {shape}.")
        self.wrap = (True,) * n_axes if wrap is None else wrap
        if len(self.wrap) != n_axes:
            raise ValueError(f"wrap has {len(self.wrap)} entries for {n_axes} weights.")

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return the differences, one object-sized array for each axis."""
        out = namespace_of(x).empty(self.range_shape, self.dtype) if out is None else out
        for d, axis, weight, wrap in self._axes(out):
            first, last, inner, shifted = _parts(axis)
            np.subtract(x[shifted], x[inner], out=d[inner])
            d[last] = x[first] - x[last] if wrap else 0
            d *= weight
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return minus the divergence of the differences ``y``."""
        out = namespace_of(y).empty(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        for d, axis, weight, wrap in self._axes(y):
            first, last, inner, shifted = _parts(axis)
            flow = d * weight
            if not wrap:
                flow[last] = 0
            out -= flow
            out[shifted] += flow[inner]
            out[first] += flow[last]
        return out

    @property
    def norm_bound(self) -> float:
        """``2 sqrt(sum weights^2)``: a difference at most doubles."""
        return 2 * float(np.sqrt((self.weights**2).reshape(-1, len(self.wrap)).max(axis=0).sum()))

    def _axes(self, stack: Array) -> list[tuple[Array, int, Array, bool]]:
        n = len(self.wrap)
        # By depth: a number for each plane, whatever axes follow.
        weights = self.weights.T.astype(self.dtype).reshape(n, -1, 1, 1)
        each = weights if self.weights.ndim == 2 else weights[:, 0, 0, 0]
        return [(stack[i], i - n, each[i], self.wrap[i]) for i in range(n)]


def _parts(axis: int) -> tuple[Any, Any, Any, Any]:
    """Index the first, last, all but last and all but first elements along a trailing axis."""
    rest = (slice(None),) * (-axis - 1)
    return tuple((..., part, *rest) for part in (slice(0, 1), slice(-1, None), slice(0, -1), slice(1, None)))  # type: ignore[return-value]


class _WithSeparable(Prior):
    """A prior whose prox takes in that of a separable one, so that their sum is such a prior again."""

    separable: Separable

    def terms(self) -> tuple[Prior, ...]:
        """Return the prior on its own and the separable part."""
        return (self.with_separable(Zero()), self.separable)

    def joined(self, other: Prior) -> Prior | None:
        """Return the sum with a separable prior."""
        if not isinstance(other, Separable):
            return None
        return self.with_separable(self.separable.with_separable(other))

    def with_separable(self, separable: Separable) -> Self:
        """Return the same prior with another separable part."""
        other = self.for_a_run()
        other.separable = separable
        return other


class TotalVariation(_WithSeparable):
    """``weight * sum ||differences||`` plus an optional separable prior (Kuo 2020, Eq. 4.5).

    Parameters
    ----------
    weight : float
    isotropic : bool
        Sum the Euclidean norm of each pixel's differences; else their absolute values.
    axis_weights : array, (n_axes,) or (n_z, n_axes)
        Weights of the differences along the trailing axes: ``(1, 1)`` for a picture, ``(wz, 1, 1)`` for a
        volume, at each depth where they differ.
    wrap : tuple of bool, optional
        See :class:`~recon.priors.total_variation.Differences`.
    separable : Separable, optional
        Added to the total variation; their joint prox stays exact.
    tolerance : float
        The prox iterates until its duality gap is below this fraction of ``1/2 ||x||^2``.
    max_inner : int
        Most inner iterations of one prox.
    """

    def __init__(
        self,
        weight: float,
        *,
        isotropic: bool = False,
        axis_weights: npt.ArrayLike = (1.0, 1.0),
        wrap: tuple[bool, ...] | None = None,
        separable: Separable | None = None,
        tolerance: float = 1e-6,
        max_inner: int = 200,
    ) -> None:
        self.weight = require_weight(weight)
        self.isotropic = isotropic
        self.axis_weights = np.asarray(axis_weights, np.float64)
        self.wrap = wrap
        self.separable = separable or Zero()
        self.tolerance = tolerance
        self.max_inner = max_inner

    @classmethod
    def of_volume(
        cls, weight: float, axis_weights: npt.ArrayLike = (1.0, 1.0, 1.0), *, isotropic: bool = False
    ) -> TotalVariation:
        """Return that of (..., n_z, height, width): periodic in the plane, as the FFT is, not in depth."""
        return cls(weight, isotropic=isotropic, axis_weights=axis_weights, wrap=(False, True, True))

    def differences(self, x: Array) -> Differences:
        """Return the difference operator for objects like ``x``."""
        return Differences(x.shape, self.axis_weights, self.wrap, x.dtype)

    def value(self, x: Array) -> float:
        """Return ``weight * TV(x) + separable(x)``."""
        return self.weight * self._norm(self.differences(x).forward(x)) + self.separable.value(x)

    def prox(self, x: Array, step: float) -> Array:
        """Prox by accelerated projected gradient on the dual (Beck & Teboulle 2009), warm-started.

        The prox of the separable part enters where they project onto the constraint, which keeps the method
        exact for any separable part.
        """
        strength = x.dtype.type(self.weight * step)
        psi = self.differences(x)
        if strength == 0:
            return self.separable.prox(x, step)
        if self.memory is None or self.memory.shape != psi.range_shape or self.memory.dtype != x.dtype:
            self.memory = np.zeros(psi.range_shape, x.dtype)
        dual = ahead = self.memory
        rate = 1 / (strength * psi.norm_bound**2)
        target = self.tolerance * 0.5 * float(np.vdot(x, x))
        t = 1.0
        for inner in range(self.max_inner):
            p = self.separable.prox(x - strength * psi.adjoint(ahead), step)
            dp = psi.forward(p)
            if inner % 5 == 4 and self._gap(p, dp, ahead, x, strength, step) <= target:
                break
            new = self._project(ahead + x.dtype.type(rate) * dp)
            t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
            ahead = new + x.dtype.type((t - 1) / t_next) * (new - dual)
            dual, t = new, t_next
        # A start that is no number would spoil every later call.
        self.memory = dual if np.isfinite(np.sum(dual, dtype=np.float64)) else None
        return p

    def _gap(self, p: Array, dp: Array, dual: Array, x: Array, strength: float, step: float) -> float:
        """Bound the prox's suboptimality: primal objective at ``p`` less dual objective.

        The extrapolated dual may leave the feasible set by a little; projecting it back costs one more pass
        and keeps the bound honest.
        """
        feasible = self._project(dual)
        q = self.separable.prox(x - strength * self.differences(x).adjoint(feasible), step)
        primal = (
            strength * self._norm(dp) + 0.5 * float(np.vdot(p - x, p - x)) + step * self.separable.value(p)
        )
        lower = (
            strength * float(np.vdot(self.differences(x).forward(q), feasible))
            + 0.5 * float(np.vdot(q - x, q - x))
            + step * self.separable.value(q)
        )
        return primal - lower

    def _norm(self, d: Array) -> float:
        sizes = np.sqrt(np.sum(d * d, axis=0)) if self.isotropic else np.abs(d)
        return float(np.sum(sizes, dtype=np.float64))

    def _project(self, d: Array) -> Array:
        if self.isotropic:
            result: Array = d / np.maximum(1, np.sqrt(np.sum(d * d, axis=0)))
            return result
        return np.clip(d, -1, 1)


class HaarTotalVariation(_WithSeparable):
    """Anisotropic total variation with the prox of Kuo 2020, A.1: soft-threshold the Haar differences.

    Sum and difference of each neighbouring pair make the transform invertible (Eqs. A.1, A.2); every axis
    is treated apart and the results are averaged. Thresholding at ``2 * n_axes * weight * step`` makes this
    equal to the first projected gradient step on the dual of the exact prox (the text leaves the threshold
    open): cheap, with a fixed point slightly off the exact minimiser. A separable part is applied after it.
    """

    exact = False

    def __init__(self, weight: float, *, n_axes: int = 2, separable: Separable | None = None) -> None:
        self.weight = require_weight(weight)
        self.n_axes = n_axes
        self.separable = separable or Zero()

    def value(self, x: Array) -> float:
        """Return ``weight`` times the anisotropic total variation (wrapped), plus the separable part."""
        total = sum(
            float(np.sum(np.abs(np.roll(x, -1, axis) - x), dtype=np.float64)) for axis in self._axes()
        )
        return self.weight * total + self.separable.value(x)

    def prox(self, x: Array, step: float) -> Array:
        """Threshold the differences along each axis, invert, average; then the separable prox."""
        threshold = x.dtype.type(2 * self.n_axes * self.weight * step)
        share = x.dtype.type(0.5 / self.n_axes)
        result = x.copy()
        for axis in self._axes():
            # Soft-thresholding takes clip(diff) off diff; Eq. A.2 spreads half of that over the pair.
            taken = np.clip((np.roll(x, -1, axis) - x) * x.dtype.type(0.5), -threshold, threshold)
            taken *= share
            result += taken
            result -= np.roll(taken, 1, axis)
        return self.separable.prox(result, step)

    def _axes(self) -> range:
        return range(-self.n_axes, 0)
