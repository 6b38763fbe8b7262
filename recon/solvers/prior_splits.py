"""The priors' side of a splitting solver in two dimensions: differences and pixels, one state each.

With ``R(t) = 2 prox(t) - t`` and a state ``t = (split variable + scaled dual variable)`` for each split ``K``
(``Psi`` for total variation, the identity for the separable prior), an iteration is ``t <- t + relax (K y -
prox(t))``, and the next right-hand side is ``mu_u Psi^T R(t_u) + mu_w R(t_w)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.base.threads import in_blocks
from recon.camera.base import Array
from recon.errors import StructureError
from recon.priors.base import Prior
from recon.priors.simple import Separable
from recon.priors.sums import sum_of
from recon.priors.total_variation import TotalVariation

STRIPS = 16
"""Strips a channel is cut into: enough to share among many cores, few enough to cost nothing."""

SETTLED = 1e-3
"""Relative residuals below which a split keeps its penalty. What one iteration changes by then depends on
which pixel happens to leave its bound in it (seen to differ tenfold between float32 and float64), which says
nothing about the balance."""


class PriorSplits:
    """States of the splits for total variation plus a separable prior.

    Parameters
    ----------
    prior : Prior
        At most one :class:`~recon.priors.TotalVariation` (wrapped, equal weights) plus separable priors.
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
    """

    def __init__(self, prior: Prior, start: Array) -> None:
        from recon.solvers import _split_kernels

        self._kernels: Any = _split_kernels
        self.tv, self.separable = split_prior(prior)
        self.y = start
        self.t_w = start.copy()
        self.tx = np.roll(start, -1, 2) - start
        self.ty = np.roll(start, -1, 1) - start
        self.mu = np.ones((2, len(start)))
        _, height, width = start.shape
        strips = min(STRIPS, height)
        self._edges = np.array([height * s // strips for s in range(strips + 1)])
        self._below = np.empty((len(start), strips, width), start.dtype)
        self._above = np.empty_like(self._below)
        self._sums = np.zeros((len(start) * height, _split_kernels.N_SUMS))

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

    def solution(self) -> Array:
        """Return the split variable that obeys the separable prior."""
        return np.stack([self.separable.prox(t, 1 / mu) for t, mu in zip(self.t_w, self.mu[1], strict=True)])

    def channel_sums(self) -> Array:
        """Return the last sweep's sums (columns as in ``_split_kernels``), (n_channels, n_sums)."""
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
        return primal, dual, ratio(s[k.CHANGE_W], s[k.NORM_W])

    def value(self) -> float:
        """Return the prior's value at the last sweep's iterates (finite: bounds hold by construction)."""
        k, s = self._kernels, self.channel_sums().sum(axis=0)
        weight = self.tv.weight if self.tv else 0.0
        return float(weight * s[k.TV] + self.separable.weight * s[k.L1])

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

    def _thresholds(self) -> Array:
        weights = np.array([[self.tv.weight if self.tv else 0.0], [self.separable.weight]])
        thresholds: Array = np.divide(weights, self.mu, out=np.zeros_like(self.mu), where=self.mu > 0)
        return thresholds


def split_prior(prior: Prior) -> tuple[TotalVariation | None, Separable]:
    """Take a prior apart into total variation and separable part.

    Raises
    ------
    StructureError
        When there is something else in it.
    """
    terms = prior.terms()
    separable = sum_of(*(t for t in terms if isinstance(t, Separable)))
    assert isinstance(separable, Separable)
    others = [t for t in terms if not isinstance(t, Separable)]
    if not others:
        return None, separable
    tv = others[0]
    if len(others) > 1 or not isinstance(tv, TotalVariation) or tv.axis_weights != (1.0, 1.0):
        names = ", ".join(type(t).__name__ for t in others)
        raise StructureError(f"ADMM takes one TotalVariation in two dimensions, not {names}; fista may.")
    return tv, separable


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
