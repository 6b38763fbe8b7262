"""The fast ADMM for a cropped convolution with total variation, l1 and bounds (Kuo 2020, Eq. 4.5, A.3).

The splitting is that of Eq. A.4 in two dimensions: ``v = M y`` (the circular convolution), ``u = Psi y`` (the
differences), ``w = y``. Written with one state a split, ``t = (split variable + scaled dual)``: with
``R(t) = 2 prox(t) - t``,

``(mu_v M^T M + mu_u Psi^T Psi + mu_w) y = mu_v M^T R(t_v) + mu_u Psi^T R(t_u) + mu_w R(t_w)``
``t <- t + relax (K y - prox(t))`` for each split ``K``.

That is ADMM with over-relaxation, in two real FFTs, two half-filled ones (:class:`DataSplit`)
and two sweeps over memory an iteration, with the right-hand side written over ``y``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.arguments import require_argument
from recon.base.threads import over_rows
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.priors.base import Prior
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import IterationRecord, require_parts
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues
from recon.solvers.prior_splits import PictureSplitting, ratio

SETTLING = (4, 8, 16, 32)
"""Iterations before which the penalty of the differences is set from the object so far."""


@dataclass(frozen=True, slots=True)
class Penalties:
    """Penalty parameters of the three splits.

    ``differences`` and ``separable`` are relative to the mean of ``|H|^2``, so that none depends on the PSF's
    brightness. The defaults were found on dense, sparse and measured scenes at signal-to-noise ratios from 50
    to 1000: after 100 iterations within about a factor of two of each scene's best constants.
    """

    data: float = 0.1
    differences: float | None = None
    """Default: from the object as it emerges, such that total variation's threshold is a tenth of its
    brightness (its 99.9th percentile); settled after the first 32 iterations, so that convergence is certain.
    """
    separable: float = 0.3


class Admm(PictureSplitting):
    """ADMM for a (masked) :class:`~recon.camera.convolution.Convolution`.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution`` of a picture, with or without ``Erasures`` after it.
    data : ndarray, ``operator.range_shape``
    prior : Prior
        (Wrapped) :class:`~recon.priors.TotalVariation`, separable priors, and any other with an exact prox.
    initial : ndarray, optional
        Starting point on the operator's domain.
    penalties : Penalties, optional
    relax : float
        Over-relaxation, between 1 and 2.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "_y", "_mu", "_splits.tx", "_splits.ty", "_splits.t_w",
        "_split.T", "_split.Q", "_split.t", "_split.sums",
    )  # fmt: skip

    def __init__(
        self,
        operator: LinearOperator,
        data: Array,
        prior: Prior,
        *,
        initial: Array | None = None,
        penalties: Penalties | None = None,
        relax: float = 1.7,
    ) -> None:
        data = require_parts(operator, data, prior)
        relax = require_argument("relax", relax, float, above=0)
        penalties = require_argument("penalties", penalties, Penalties | None) or Penalties()
        super().__init__(operator, prior, initial)
        valid = np.ascontiguousarray(np.where(self._weight > 0, data, 0), operator.dtype)
        self.relax = relax
        self._settles = penalties.differences is None
        self._split = DataSplit(self._camera, valid, self._weight, penalties.data, self._y, relax)
        power = float(np.mean(self._camera.power()))
        differences = 1.0 if penalties.differences is None else penalties.differences
        self._mu_data = penalties.data
        mu = np.array([[differences * power], [penalties.separable * power]])
        if self._splits.others:
            self._splits.set_penalties(np.broadcast_to(mu, self._mu.shape))
        self._mu[...] = mu

    @property
    def penalties(self) -> Array:
        """Present penalties of data, differences and pixels, (3, n_channels)."""
        return np.vstack([np.full(len(self._y), self._mu_data), self._mu])

    def compile(self) -> None:
        """Do one step of a tiny problem of the same precision."""
        _compile(self._y.dtype)

    def step(self) -> IterationRecord:
        """Update the priors' splits in a sweep over memory, then solve for ``y`` in Fourier space."""
        tv = self._splits.tv
        if self._settles and tv and self.iteration in SETTLING:
            self._settle_differences(tv.weight)
        # What is known of the iterate that the sweep is about to turn into a right-hand side.
        data = self._split.sums.sum(axis=0)
        if self._splits.others:
            if self.iteration in SETTLING:
                self._splits.set_penalties(self._mu)
            self._splits.meet(self.relax)
        mu_u, mu_w = self._mu[0].astype(self._y.dtype), self._splits.pixel_penalties.astype(self._y.dtype)
        for c, y in enumerate(self._y):  # one after the other, so that the caches hold it
            self._splits.sweep(self.relax, c)
            self._split.solve(c, y, mu_u[c], mu_w[c])
        return self._record(*data)

    def _record(
        self, misfit: float, disagreement: float, change: float, norm: float, multiplier: float
    ) -> IterationRecord:
        primal, dual, moved = self._splits.residuals()
        return IterationRecord(
            0,
            0.0,
            objective=float(0.5 * misfit + self._splits.value()),
            data_residual=float(np.sqrt(misfit)),
            primal_residual=max(primal, ratio(disagreement, norm)),
            dual_residual=max(dual, ratio(change, multiplier)),
            change=moved,
        )

    def _settle_differences(self, weight: float) -> None:
        """Set the differences' penalty from each channel's brightness; their dual variable stays."""
        mu = self._mu.copy()
        for c, image in enumerate(self.solution[:, ::2, ::2]):
            brightness = float(np.percentile(np.abs(image), 99.9))
            if brightness > 0 and weight > 0:
                mu[0, c] = 10 * weight / brightness
        self._splits.set_penalties(mu)


class DataSplit:
    """State of the data's split, and the linear system between the splits.

    The split is ``v = M y``, a circular convolution of which a window is measured. Its state
    ``t = (v + scaled dual)`` lives on the whole grid, but its prox changes it on valid pixels of the sensor
    only: ``prox(t) = t - q`` with ``q = w / (w + mu) (t - b)`` there and 0 elsewhere. So the state is kept as
    a spectrum, where ``M`` is a product and the reflection ``R(t) = t - 2 q``, and only the sensor's rows go
    to real space and back to make ``q``: half-filled transforms, three quarters of the work of whole ones,
    and no sweep over the grid.

    Parameters
    ----------
    camera : Convolution
    data, weight : ndarray, ``camera.range_shape``
        Measurement, and 1 where it is valid, 0 where erased.
    penalty : float
    start : ndarray, ``camera.domain_shape``
        Object to begin with.
    relax : float

    Attributes
    ----------
    T : ndarray, complex, (n_channels, grid_height, grid_width // 2 + 1)
        Spectrum of the state.
    Q : ndarray, complex, as T
        Spectrum of what the state's prox takes off.
    t : ndarray, ``camera.range_shape``
        The state on the sensor.
    sums : ndarray, (n_channels, 5)
        Squared norms of the last update: residual, ``M y - prox(t)``, change of ``prox(t)``, ``prox(t)``,
        ``q``.
    """

    def __init__(
        self,
        camera: Convolution,
        data: Array,
        weight: Array,
        penalty: float,
        start: Array,
        relax: float,
    ) -> None:
        from recon.solvers import _picture_kernels

        self._kernels: Any = _picture_kernels
        self._camera, self._data, self._weight = camera, data, weight
        self._penalty = data.dtype.type(penalty)
        self._relax = data.dtype.type(relax)
        height, width = camera.grid_shape
        rows, columns = (laplacian_eigenvalues(n).astype(data.dtype) for n in (height, width))
        self.T = fft.rfft(start)
        fft.multiply(self.T, camera.spectrum[:, 0])
        self._laplace = rows, columns[: self.T.shape[2]].copy()
        self._grid_sums = np.zeros((height, _picture_kernels.N_GRID_SUMS))
        self._sensor_sums = np.zeros((camera.sensor_shape[0], _picture_kernels.N_SENSOR_SUMS))
        self._band = np.empty((camera.sensor_shape[0], width), data.dtype)
        self._Y, self._P = np.empty_like(self.T[0]), np.empty_like(self.T[0])
        self.Q = np.empty_like(self.T)
        self.t = np.zeros_like(data)
        self.sums = np.zeros((len(data), 5))
        for channel in range(len(data)):
            self._start(channel)

    def solve(self, channel: int, y: Array, mu_u: Any, mu_w: Any) -> None:
        """Turn a channel's right-hand side of the priors into its object, in place, and update the state.

        Solves ``(mu_v M^T M + mu_u Psi^T Psi + mu_w) y = mu_v M^T R(t) + rhs``.
        """
        H = self._camera.channel_spectrum(channel)[0]
        rows, columns = self._laplace
        fft.rfft(y, out=self._Y)
        over_rows(
            self._kernels.solve, self._Y, self.T[channel], self.Q[channel], H, self._P,
            mu_w + mu_u * rows, mu_u * columns, self._penalty, self._relax,
            y.shape[1] % 2 == 0, self._grid_sums,
        )  # fmt: skip
        fft.irfft(self._Y, y.shape[1], out=y)
        self._see(channel)

    def _start(self, channel: int) -> None:
        """From a state that agrees with the object to its update, ``t <- t + relax (M y - prox(t))``."""
        T = self.T[channel]
        self._P[...] = T
        self._see(channel)
        T += self._relax * self.Q[channel]
        self._P[...] = T
        self._grid_sums[0] = 0.0, _energy(T, self._band.shape[1])
        self._see(channel)

    def _see(self, channel: int) -> None:
        """From the state's spectrum in ``_P`` to what its prox takes off, and the sums."""
        top, left = self._camera.corner
        band, k = self._band, self._kernels
        fft.irfft_strip(self._P[None], top, band[None])
        over_rows(
            k.see, band, left, self.t[channel], self._data[channel], self._weight[channel],
            self._penalty, self._relax, self._sensor_sums,
        )  # fmt: skip
        fft.rfft_strip(band[None], top, self.Q[channel][None])
        seen = self._sensor_sums.sum(axis=0)
        grid = self._grid_sums.sum(axis=0) / np.prod(self._camera.grid_shape)
        # Off the sensor prox(t) = t: what is there is the whole grid's, by Parseval, less what was seen.
        step = max(float(grid[k.STEP] - seen[k.STEP_SEEN]), 0.0)
        state = max(float(grid[k.STATE] - seen[k.STATE_SEEN]), 0.0)
        self.sums[channel] = (
            seen[k.DATA],
            seen[k.PRIMAL] + (1 - self._relax) ** 2 * step,
            seen[k.CHANGE] + self._relax**2 * step,
            seen[k.NORM] + state,
            seen[k.MULTIPLIER],
        )


def _energy(spectrum: Array, width: int) -> float:
    """Squared norm of a whole spectrum of which the half of an image of that width is given."""
    each = np.abs(spectrum).astype(np.float64) ** 2
    alone = each[:, 0].sum() + (each[:, -1].sum() if width % 2 == 0 else 0.0)
    return float(2 * each.sum() - alone)


@cache
def _compile(dtype: np.dtype[Any]) -> None:
    tiny = Convolution(np.ones((1, 2, 2)), (2, 2), dtype=dtype)
    Admm(tiny, np.ones((1, 2, 2), dtype), TotalVariation(1.0)).step()
