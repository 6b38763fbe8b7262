"""The priors' side of a splitting solver in two dimensions: differences, pixels, whatever has a prox.

With ``R(t) = 2 prox(t) - t`` and a state ``t = (split variable + scaled dual variable)`` for each split ``K``
(``Psi`` for total variation, the identity for the separable prior), an iteration is ``t <- t + relax (K y -
prox(t))``, and the next right-hand side is ``mu_u Psi^T R(t_u) + mu_w R(t_w)``. Any other prior is one more
split ``z = y`` with its own prox and penalty, which adds to the pixels'.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from recon.arrays import Array
from recon.base.namespace import namespace_of, to_host
from recon.base.threads import in_blocks
from recon.camera.base import LinearOperator
from recon.camera.factors import as_cropped_convolution
from recon.errors import StructureError
from recon.priors.base import Prior, Separable
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import Solver, starting_point
from recon.solvers.moving import move

STRIPS = 16
"""Strips a channel is cut into: enough to share among many cores, few enough to cost nothing."""

SETTLED = 1e-3
"""Relative residuals below which a split keeps its penalty. What one iteration changes by then depends on
which pixel happens to leave its bound in it (seen to differ tenfold between float32 and float64), which says
nothing about the balance."""


LARGEST_STEP = 10.0
"""Largest factor by which the penalty of a prior known by its prox changes at once."""


class ProxSplit:
    """The split ``z = y`` of a prior of which nothing is known but ``value`` and ``prox``.

    Parameters
    ----------
    prior : Prior
    start : ndarray
        Object to begin with.

    Attributes
    ----------
    state, split : ndarray
        ``t`` and ``z = prox(t)``.
    mu : float
        Penalty.
    sums : tuple of float
        Squared norms of the last :meth:`meet`: primal residual, change and size of ``z``, multiplier / mu.
    kept : tuple of str
        What :meth:`checkpoint` returns, by name.
    """

    kept: ClassVar[tuple[str, ...]] = ("state", "split", "mu", "sums", "memory")

    def __init__(self, prior: Prior, start: Array) -> None:
        self.prior = prior.for_a_run()
        self.mu = 1.0
        self.state = start.copy()
        self.split = self._prox()
        self.sums = (0.0, 0.0, 0.0, 0.0)

    def _prox(self) -> Array:
        split: Array = self.prior.checked_prox(self.state, 1 / self.mu).astype(self.state.dtype, copy=False)
        return split

    def meet(self, y: Array, relax: float) -> None:
        """Update from the object."""
        before = self.split
        self.state = self.state + self.state.dtype.type(relax) * (y - before)
        self.split = self._prox()
        parts = (y - self.split, self.split - before, self.split, self.state - self.split)
        self.sums = tuple(float(namespace_of(v).vdot(v, v)) for v in parts)  # type: ignore[assignment]

    def pull(self) -> Array:
        """Return what it adds to the next right-hand side, ``mu R(t)``."""
        pull: Array = self.state.dtype.type(self.mu) * (2 * self.split - self.state)
        return pull

    def balanced(self, guess: float) -> float:
        """Return a penalty that balances the residuals; the guess, as long as nothing is known of them."""
        if not any(self.sums):
            return guess
        return self.mu * balancing(*self.sums)

    def set_penalty(self, mu: float) -> None:
        """Change the penalty; split variable and (unscaled) multiplier stay what they are."""
        if mu != self.mu:
            self.state = self.split + self.state.dtype.type(self.mu / mu) * (self.state - self.split)
        self.mu = mu

    def move(self, rows: float, columns: float) -> None:
        """Move with the object."""
        move(self.state, rows, columns)
        move(self.split, rows, columns)

    def restart(self) -> None:
        """Begin anew from zero."""
        self.prior.memory = None
        self.mu = 1.0
        self.state = self.state * 0
        self.split = self._prox()
        self.sums = (0.0, 0.0, 0.0, 0.0)

    def checkpoint(self) -> dict[str, Any]:
        """Return the state, with what the prior's prox keeps."""
        memory = np.zeros(0) if self.prior.memory is None else self.prior.memory
        values = (to_host(self.state), to_host(self.split), self.mu, np.array(self.sums), to_host(memory))
        return dict(zip(self.kept, values, strict=True))

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        xp = namespace_of(self.state)
        self.state, self.split, self.mu = xp.array(kept["state"]), xp.array(kept["split"]), float(kept["mu"])
        self.sums = tuple(float(v) for v in kept["sums"])  # type: ignore[assignment]
        self.prior.memory = xp.array(kept["memory"]) if kept["memory"].size else None


class PriorSplits:
    """States of the splits for a sum of priors.

    Parameters
    ----------
    prior : Prior
        Total variation (wrapped, equal weights) and separable priors have compiled sweeps; any others need
        ``value`` and an exact ``prox``.
    start : ndarray, (n_channels, height, width)
        Object whose states to begin with; becomes :attr:`y`.

    Attributes
    ----------
    y : ndarray
        The object before :meth:`sweep`, the right-hand side after it.
    tx, ty, t_w : ndarray
        States of the differences and of the pixels.
    mu : ndarray, (2, n_channels)
        Penalties of the differences (0 without total variation) and of the pixels.
    others : tuple of ProxSplit
        Splits of priors that have no sweep of their own.
    """

    def __init__(self, prior: Prior, start: Array) -> None:
        from recon.solvers import _picture_kernels

        self._kernels: Any = _picture_kernels
        self.tv, self.separable, others = split_prior(prior)
        self.y = start
        self.others = tuple(ProxSplit(other, start) for other in others)
        self.t_w = start.copy()
        self.tx = np.roll(start, -1, 2) - start
        self.ty = np.roll(start, -1, 1) - start
        self.mu = np.ones((2, len(start)))
        _, height, width = start.shape
        strips = min(STRIPS, height)
        self._edges = np.array([height * s // strips for s in range(strips + 1)])
        self._below = np.empty((len(start), strips, width), start.dtype)
        self._above = np.empty_like(self._below)
        self._sums = np.zeros((len(start) * height, _picture_kernels.N_SUMS))

    @property
    def pixel_penalties(self) -> Array:
        """What all splits of the object itself add to the quadratic problem, (n_channels,)."""
        penalties: Array = self.mu[1] + sum(other.mu for other in self.others)
        return penalties

    def meet(self, relax: float) -> None:
        """Update the states of the priors without a sweep from ``y``, the object of all channels."""
        for other in self.others:
            other.meet(self.y, relax)

    def sweep(self, relax: float, channel: int | None = None) -> None:
        """Update the states from ``y`` and write the next right-hand side over it; of one channel, or all.

        A ``relax`` of 0 leaves the states as they are.
        """
        dtype, height = self.y.dtype, self.y.shape[1]
        f = dtype.type
        part = slice(None) if channel is None else slice(channel, channel + 1)
        y, tx, ty, t_w = self.y[part], self.tx[part], self.ty[part], self.t_w[part]
        below, above = self._below[part], self._above[part]
        sums = self._sums if channel is None else self._sums[channel * height : (channel + 1) * height]
        mu_u, mu_w = self.mu[:, part].astype(dtype)
        threshold_u, threshold_w = (t[part].astype(dtype) for t in self._thresholds())
        isotropic = bool(self.tv and self.tv.isotropic)
        self._kernels.save_strip_neighbours(
            y, tx, ty, self._edges, threshold_u, f(relax), isotropic, below, above
        )

        def strips(start: int, stop: int) -> None:
            self._kernels.sweep_priors(
                start, stop, self._edges, below, above, y, tx, ty, t_w,
                mu_u, mu_w, threshold_u, threshold_w,
                f(self.separable.lower), f(self.separable.upper), f(relax), isotropic, sums,
            )  # fmt: skip

        in_blocks(strips, len(y) * (len(self._edges) - 1))
        for other in self.others:
            y += other.pull()[part]

    def solution(self) -> Array:
        """Return the split variable that obeys the separable prior; without one, the first other prior's."""
        if self.others and self.separable.is_zero:
            return self.others[0].split.copy()
        return np.stack([self.separable.prox(t, 1 / mu) for t, mu in zip(self.t_w, self.mu[1], strict=True)])

    def channel_sums(self) -> Array:
        """Return the last sweep's sums (columns as in ``_picture_kernels``), (n_channels, n_sums)."""
        sums: Array = self._sums.reshape(len(self.y), -1, self._sums.shape[1]).sum(axis=1)
        return sums

    def residuals(self) -> tuple[float, float, float]:
        """Return primal and dual residual and the change of the solution in the last sweep, all relative."""
        k, s = self._kernels, self.channel_sums().sum(axis=0)
        primal = ratio(s[k.PRIMAL_W], s[k.NORM_W])
        dual = ratio(s[k.CHANGE_W], s[k.MULTIPLIER_W])
        if self.tv:
            primal = max(primal, ratio(s[k.PRIMAL_U], s[k.NORM_U]))
            dual = max(dual, ratio(s[k.CHANGE_U], s[k.MULTIPLIER_U]))
        moved = ratio(s[k.CHANGE_W], s[k.NORM_W])
        for disagreement, change, norm, multiplier in (other.sums for other in self.others):
            primal, dual = max(primal, ratio(disagreement, norm)), max(dual, ratio(change, multiplier))
            moved = max(moved, ratio(change, norm))
        return primal, dual, moved

    def value(self) -> float:
        """Return the prior's value at the last sweep's iterates (finite: bounds hold by construction)."""
        k, s = self._kernels, self.channel_sums().sum(axis=0)
        weight = self.tv.weight if self.tv else 0.0
        others = sum(other.prior.checked_value(other.split) for other in self.others)
        return float(weight * s[k.TV] + self.separable.weight * s[k.L1] + others)

    def balanced_penalties(self) -> Array:
        """Return penalties that balance the last sweep's relative residuals, (2, n_channels).

        As in Wohlberg 2017, for each split on its own: ``mu sqrt(primal / dual)``, the residuals relative to
        the norms of split variable and multiplier. Unlike a fixed constant this follows exposure, size and
        density of the scene by itself. A split whose residuals are both below ``SETTLED`` keeps its own.
        """
        k, s = self._kernels, self.channel_sums()
        splits = (
            (k.PRIMAL_U, k.MULTIPLIER_U, k.CHANGE_U, k.NORM_U),
            (k.PRIMAL_W, k.MULTIPLIER_W, k.CHANGE_W, k.NORM_W),
        )
        balanced = self.mu.copy()
        for mu, columns in zip(balanced, splits, strict=True):
            primal, multiplier, change, norm = s[:, columns].T
            known = (s[:, columns] > 0).all(axis=1)
            known &= (primal > SETTLED**2 * norm) | (change > SETTLED**2 * multiplier)
            unbalance = primal[known] / change[known] * (multiplier[known] / norm[known])
            mu[known] *= unbalance**0.25  # of squared norms
        return balanced

    def set_penalties(self, mu: Array) -> None:
        """Change the penalties; split variables and (unscaled) multipliers stay what they are."""
        before = self._thresholds()
        factors = np.divide(self.mu, mu, out=np.ones_like(mu), where=mu > 0).astype(self.y.dtype)
        isotropic = bool(self.tv and self.tv.isotropic)
        for c, (factor_u, factor_w) in enumerate(factors.T):
            threshold = self.y.dtype.type(before[0, c])
            kept = soft_pair(self.tx[c], self.ty[c], threshold, isotropic)
            pixels = self.separable.prox(self.t_w[c], 1 / self.mu[1, c])
            states = (
                (self.tx, kept[0], factor_u),
                (self.ty, kept[1], factor_u),
                (self.t_w, pixels, factor_w),
            )
            for t, split, factor in states:
                t[c] = split + factor * (t[c] - split)
        self.mu[...] = mu
        for other in self.others:
            other.set_penalty(other.balanced(float(np.mean(mu[1]))))

    def move(self, rows: float, columns: float) -> None:
        """Move with the object, the next right-hand side as well."""
        for part in (self.y, self.tx, self.ty, self.t_w):
            move(part, rows, columns)
        for other in self.others:
            other.move(rows, columns)

    def restart(self) -> None:
        """Begin anew from zero; penalties are to be set again, as those of new splits are."""
        for array in (self.y, self.tx, self.ty, self.t_w):
            array[...] = 0
        self.mu[...] = 1
        for other in self.others:
            other.restart()

    def _thresholds(self) -> Array:
        weights = np.array([[self.tv.weight if self.tv else 0.0], [self.separable.weight]])
        thresholds: Array = np.divide(weights, self.mu, out=np.zeros_like(self.mu), where=self.mu > 0)
        return thresholds


def balancing(primal: float, change: float, norm: float, multiplier: float) -> float:
    """Return by what a penalty is to be multiplied so that relative residuals become equal (Wohlberg 2017).

    Squared norms: primal residual, change of the split variable, size of the variable, multiplier / penalty.
    1 where nothing moves any more, or nothing is known.
    """
    moving = primal > SETTLED**2 * norm or change > SETTLED**2 * multiplier
    if not moving or not all(v > 0 and np.isfinite(v) for v in (primal, change, norm, multiplier)):
        return 1.0
    factor = (primal / change * (multiplier / norm)) ** 0.25
    return float(np.clip(factor, 1 / LARGEST_STEP, LARGEST_STEP))


def is_plain(tv: TotalVariation) -> bool:
    """Whether differences wrap around and weigh alike, as the sweeps of pictures have them."""
    return np.array_equal(tv.axis_weights, (1.0, 1.0)) and tv.wrap in (None, (True, True))


class PictureSplitting(Solver):
    """A splitting method for a (masked) convolution of pictures: the priors' splits are part of its state.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution`` of a picture, with or without ``Erasures`` after it.
    prior : Prior
        (Wrapped) :class:`~recon.priors.TotalVariation`, separable priors, and any other with an exact prox.
    initial : ndarray, optional
        Starting point on the operator's domain.
    """

    def __init__(self, operator: LinearOperator, prior: Prior, initial: Array | None) -> None:
        super().__init__()
        structure = as_cropped_convolution(operator)
        self._camera, self._weight = structure.convolution, np.ascontiguousarray(structure.weight)
        self._splits = PriorSplits(prior, starting_point(operator, initial))
        self._y, self._mu, self.splits = self._splits.y, self._splits.mu, self._splits.others

    @property
    def solution(self) -> Array:
        """The split variable that obeys the separable prior."""
        return self._splits.solution()


def split_prior(
    prior: Prior, has_sweep: Callable[[TotalVariation], bool] = is_plain
) -> tuple[TotalVariation | None, Separable, tuple[Prior, ...]]:
    """Take a prior apart: total variation of the kind that a solver has a sweep for, separable part, others.

    Raises StructureError when a prior's prox is not that of its value.
    """
    separable, tv, others = Separable(), None, []
    for term in prior.terms():
        if isinstance(term, Separable):
            separable = separable.with_separable(term)
        elif tv is None and isinstance(term, TotalVariation) and has_sweep(term):
            tv = term
        else:
            others.append(term)
    require_exact(*others)
    return tv, separable, tuple(others)


def require_exact(*priors: Prior) -> None:
    """Refuse priors whose prox is not that of their value: no splitting method finds their minimiser."""
    for prior in priors:
        if not prior.exact:
            raise StructureError(
                f"The prox of {type(prior).__name__} is only near that of its value for small steps, and "
                "splitting methods take large ones: they would settle somewhere else. Take fista."
            )


def soft_pair(tx: Array, ty: Array, threshold: Any, isotropic: bool) -> tuple[Array, Array]:
    """Threshold a pair of differences, together or each on its own."""
    if isotropic:
        size = np.sqrt(tx * tx + ty * ty)
        keep = np.maximum(size - threshold, 0) / np.maximum(size, np.finfo(tx.dtype).tiny)
        return tx * keep, ty * keep
    return tx - np.clip(tx, -threshold, threshold), ty - np.clip(ty, -threshold, threshold)


def ratio(part: float, whole: float) -> float:
    """Square root of a ratio of sums of squares: 0 for nothing of nothing, 1 for something of nothing."""
    if whole == 0:
        return 0.0 if part == 0 else 1.0
    return float(np.sqrt(part / whole))
