"""ADMM with the exact data term: for dense scenes on many pixels.

Total variation and the separable prior are split off as in Kuo 2020, A.3, but the convolution is not: its
split variable lives on the whole grid, most of which no pixel sees, with one penalty for all frequencies,
while a diffuser's transfer function spans a factor of 10^5 in power. Such a split moves the dim and the
unseen parts by a hair an iteration. Here the quadratic problem between the priors keeps the data term as it
is,

``(A^H A + T) y = A^H b + rhs``, ``T = mu_u Psi^T Psi + mu_w``, hence ``y = T^-1 (rhs + A^H e)`` where
``(I + C q C^T) e = b - A T^-1 rhs``, ``q = |H|^2 / T``,

a system on the sensor's pixels alone. Its solution ``e`` (at the end the residual ``b - A y``) is kept from
iteration to iteration, and one conjugate gradient step on it suffices with the preconditioner of
:mod:`recon.solvers.cosine_preconditioner`. An iteration costs four real FFTs, two of them only over the
sensor's rows, and a pair of cosine transforms of the sensor's size. (Bredies & Sun 2015 show why such a
splitting converges without exact solves in this place.)

Erased pixels would spoil the preconditioner. They are imputed instead: their data is what the object of the
iteration before casts there, so that they pull at nothing once converged (a proximal ADMM; the minimiser is
that of the valid pixels alone).

A smooth background that is estimated as well is a further factor ``W`` before the data
(:class:`~recon.camera.factors.BackgroundRemoval`), diagonal in the preconditioner's cosine modes, so that
the system ``(I + W C q C^T W) e = W (b - A T^-1 rhs)`` takes no more steps than the other.
"""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.filling import fill_smoothly
from recon.base.threads import over_rows
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures
from recon.priors.base import Prior
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import IterationRecord
from recon.solvers.cosine_preconditioner import NEARLY, PicturePreconditioner, laplacian_eigenvalues
from recon.solvers.prior_splits import PictureSplitting

BALANCING = (3, 6, 12, 24, 48, 96, 192)
"""Iterations before which the penalties are balanced; fixed after the last, so that convergence is sure."""

LEAST_PIXEL_SHARE = 0.03
"""Lower bound of the pixels' penalty relative to the differences'."""

GRADIENT_BALANCING = (12, 24, 48)
"""Of these, those at which the data term's gradient helps to set the pixels' penalty: before, the gradient
tells nothing, afterwards the multiplier is found and its residuals can be trusted."""

LARGEST_STEP = (10.0, 100.0)
"""Largest factors by which the penalties of differences and pixels change at once."""

FIRST_THRESHOLD = 0.3
"""First guess of total variation's threshold, relative to the object's mean."""

FIRST_PIXEL_SHARE = 0.05
"""First guess of the pixels' penalty relative to the differences'."""

IMPUTATION = 1.5
"""Over-relaxation of the erased pixels' imputation, between 1 and 2."""

FIRST_DATA_STEPS = 4
"""Conjugate gradient steps of the first iteration, whose start is nowhere near."""


class SensorAdmm(PictureSplitting):
    """ADMM that solves the data term on the sensor's pixels, for a (masked) cropped convolution.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution`` of a picture, with or without ``Erasures`` after it.
    data : ndarray, ``operator.range_shape``
    prior : Prior
        (Wrapped) :class:`~recon.priors.TotalVariation`, separable priors, and any other with an exact prox.
    initial : ndarray, optional
        Starting point on the operator's domain. To go on where a run ended, use :meth:`checkpoint`, which
        keeps the dual variables too.
    relax : float
        Over-relaxation, between 1 and 2.
    data_steps : int
        Conjugate gradient steps an iteration.
    background : BackgroundRemoval, optional
        Of a smooth background to be estimated as well, of all pixels.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "_y", "_mu", "_splits.tx", "_splits.ty", "_splits.t_w", "_e", "_E", "_data",
    )  # fmt: skip

    def __init__(
        self,
        operator: LinearOperator,
        data: Array,
        prior: Prior,
        *,
        initial: Array | None = None,
        relax: float = 1.5,
        data_steps: int = 1,
        background: BackgroundRemoval | None = None,
    ) -> None:
        super().__init__(operator, prior, initial)
        self._background = background
        self._adapted_to: float | None = None
        if background is not None:
            rows, columns, _ = background.basis(0)
            self._cosines = rows.astype(operator.dtype), columns.astype(operator.dtype)
        from recon.solvers import _picture_kernels

        self._kernels: Any = _picture_kernels
        camera, splits, start = self._camera, self._splits, self._y
        self._erased = not np.all(self._weight)
        # Imputed on erased pixels, so part of the state.
        self._data = np.empty(operator.range_shape, operator.dtype)
        self._top, self._left = camera.corner
        self._spectrum = camera.spectrum[:, 0]
        self.relax = relax
        self.data_steps = data_steps

        # ``e`` and its spectrum: keeping the latter saves a transform an iteration.
        self._e = np.zeros(operator.range_shape, operator.dtype)
        self._E = np.zeros(fft.spectrum_shape(start.shape), fft.complex_dtype(operator.dtype))
        self._Y, self._P = np.empty_like(self._E[0]), np.empty_like(self._E[0])
        self._band = np.empty((camera.sensor_shape[0], start.shape[2]), operator.dtype)
        self._residual, self._direction, self._z = (
            np.empty(camera.sensor_shape, operator.dtype) for _ in range(3)
        )
        self.set_data(data)
        grid = (start.shape[1], start.shape[2])
        self._laplace_rows, columns = (laplacian_eigenvalues(n).astype(operator.dtype) for n in grid)
        self._laplace_columns = columns[: grid[1] // 2 + 1].copy()
        self._row_sums = np.zeros(grid[0])
        power = camera.power()
        self._preconditioners = [
            PicturePreconditioner(power[c % len(power)], grid, camera.sensor_shape) for c in range(len(start))
        ]
        # What the first guess of the penalties needs to know of each channel's |H|^2.
        self._mean_power = power.mean(axis=(1, 2), dtype=np.float64)
        self._power_at_zero = power[:, 0, 0].astype(np.float64)
        splits.set_penalties(self._first_penalties())
        self._adapt()
        splits.sweep(0)

    def set_data(self, data: Array) -> None:
        """Go on with other data (``operator.range_shape``) from where the solver is: a video's next frame.

        Object, dual variables and penalties stay: a warm start of all that an iteration builds on.
        """
        self._data[...] = data
        if self._background is not None:  # how much it takes may have changed with the data
            for image, e, E in zip(self._data, self._e, self._E, strict=True):
                self._weigh(image)
                self._band[...] = 0
                seen = self._band[:, self._left : self._left + e.shape[1]]
                seen[...] = e
                self._weigh(seen)
                fft.rfft_strip(self._band[None], self._top, E[None])
            if self._adapted_to is not None and abs(self._background.taken - self._adapted_to) > NEARLY:
                self._adapt()
        if self._erased:
            for image, weight in zip(self._data, self._weight, strict=True):
                fill_smoothly(image, weight)

    def move(self, rows: float, columns: float) -> None:
        """Move object and dual variables; what is left of the data is noise, which does not move."""
        self._splits.move(rows, columns)

    def restart(self, data: Array) -> None:
        """Begin anew from zero with other data, in the memory that the solver has."""
        self.iteration = 0
        self.set_data(data)
        self._splits.restart()
        for array in (self._e, self._E):
            array[...] = 0
        self._splits.set_penalties(self._first_penalties())
        self._adapt()
        self._splits.sweep(0)

    def compile(self) -> None:
        """Do two data steps of a tiny problem of the same precision."""
        _compile(self._y.dtype)

    def step(self) -> IterationRecord:
        """Solve for the object, then update the priors' splits in one sweep over memory.

        ``data_residual`` is the norm of ``e``, which is the object's residual but for what the data steps
        leave; ``objective`` adds the priors of the object and its split variables. Both meet the solution's
        as the iteration converges.
        """
        if self.iteration in BALANCING:
            self._splits.set_penalties(self._balanced_penalties())
            self._adapt()
            self._splits.sweep(0)
        steps = self.data_steps if self.iteration else max(self.data_steps, FIRST_DATA_STEPS)
        misfit = self._update(steps)
        primal, dual, change = self._splits.residuals()
        data = float(np.sqrt(misfit)) if np.isfinite(misfit) else np.inf
        return IterationRecord(0, 0.0, 0.5 * data**2 + self._splits.value(), data, primal, dual, change)

    def _update(self, steps: int) -> float:
        """Update objects and splits; return the squared data residual."""
        misfit = 0.0
        if self._splits.others:  # which see all channels at once
            misfit += sum(self._solve(channel, steps) for channel in range(len(self._y)))
            self._splits.meet(self.relax)
            self._splits.sweep(self.relax)
            return misfit
        for channel in range(len(self._y)):  # one after the other, so that the caches hold it
            misfit += self._solve(channel, steps)
            self._splits.sweep(self.relax, channel)
        return misfit

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint taken from a solver of the same problem."""
        super().restore(state)
        self._adapt()

    def _solve(self, channel: int, steps: int) -> float:
        """Turn a channel's right-hand side into its object; return its squared data residual.

        Conjugate gradients on ``e``, warm-started.
        """
        f = self._y.dtype.type
        y, e, r, p, band = self._y[channel], self._e[channel], self._residual, self._direction, self._band
        E, Y, P = self._E[channel], self._Y, self._P
        H = self._spectrum[channel % len(self._spectrum)]
        weight = self._weight[channel]
        T = (self._laplace_rows, self._laplace_columns, *self._quadratic(channel).astype(y.dtype))
        kernels, columns = self._kernels, slice(self._left, self._left + p.shape[1])

        fft.rfft(y, out=Y)
        over_rows(kernels.predict, Y, E, H, *T, P)
        fft.irfft_strip(P[None], self._top, band[None])
        self._weigh(band[:, columns])
        over_rows(kernels.residual, r, band, self._left, self._data[channel], e)
        rho_before = 1.0
        for step in range(steps):
            rho = float(np.vdot(r, self._preconditioners[channel].apply(r, self._z)))
            if np.isnan(rho):
                y[...] = rho
                return rho
            if not rho > 0:
                break
            if step:
                p *= f(rho / rho_before)
                p += self._z
            else:
                p[...] = self._z
            band[...] = 0
            band[:, columns] = p
            self._weigh(band[:, columns])
            fft.rfft_strip(band[None], self._top, P[None])
            # <p, (I + C q C^T) p> by Parseval: the last step needs no transform back.
            over_rows(kernels.curvature, P, H, *T, band.shape[1] % 2 == 0, self._row_sums)
            bend = float(np.vdot(p, p)) + float(self._row_sums.sum()) / y.size
            if not bend > 0:
                break
            length = f(rho / bend)
            e += length * p
            over_rows(kernels.advance, Y, E, P, H, *T, length)
            if step < steps - 1:
                over_rows(kernels.weigh, P, H, *T)
                fft.irfft_strip(P[None], self._top, band[None])
                self._weigh(band[:, columns])
                over_rows(kernels.reduce_residual, r, p, band, self._left, length)
            rho_before = rho
        if self._erased:
            over_rows(kernels.impute, self._data[channel], weight, e, f(IMPUTATION))
        fft.irfft(Y, y.shape[1], out=y)
        return float(np.vdot(e, weight * e if self._erased else e))

    def _weigh(self, image: Array) -> None:
        """Take out of an image, in place, what a smooth background takes: ``W``."""
        if self._background is not None:
            rows, columns = self._cosines
            taken = image.dtype.type(self._background.taken)
            image -= rows.T @ (taken * (rows @ image @ columns.T)) @ columns

    def _adapt(self) -> None:
        """Tell the preconditioners of new penalties."""
        for channel, preconditioner in enumerate(self._preconditioners):
            if self._background is not None:
                rows, columns = self._cosines
                preconditioner.weigh((len(rows), len(columns)), 1 - self._background.taken)
                self._adapted_to = self._background.taken
            preconditioner.set_penalties(*self._quadratic(channel))

    def _quadratic(self, channel: int) -> Array:
        """Return the penalties of differences and of pixels in the quadratic problem."""
        others = sum(other.mu for other in self._splits.others)
        pixels = self._mu[1, channel] + others + self._extra_penalty()
        return np.array([self._mu[0, channel], pixels])

    def _extra_penalty(self) -> float:
        """Return what a subclass' split of the object itself adds to the pixels' penalty."""
        return 0.0

    def _first_penalties(self) -> Array:
        """Guess penalties from the object's mean, which the data tells through the PSF's sum."""
        tv, separable = self._splits.tv, self._splits.separable
        strength = (tv.weight if tv else 0.0) or separable.weight
        mu = np.zeros_like(self._mu)
        for c, data in enumerate(self._data):
            of_psf = c % len(self._mean_power)
            mean = float(np.linalg.norm(data)) / float(np.sqrt(data.size * self._power_at_zero[of_psf]))
            threshold = FIRST_THRESHOLD * mean
            guess = float(self._mean_power[of_psf])
            penalty = strength / threshold if strength > 0 and threshold > 0 else guess
            mu[1, c] = FIRST_PIXEL_SHARE * penalty
            if tv and tv.weight > 0:
                mu[0, c] = penalty
        return mu

    def _balanced_penalties(self) -> Array:
        """Balance by residuals; the pixels, once there is an object, by what their multiplier has to become.

        ADMM is fastest where the penalty is about the size of the final multiplier over that of the split
        variable. The multiplier approaches that size from zero. Where its penalty is far too small, as on
        measured data that no non-negative object explains, it never gets there in time, and residuals
        relative to it look balanced all the same. The data term's gradient at the split variable is what the
        multiplier has to become (stationarity), and it comes down from far above, as small errors at low
        frequencies weigh much there. The geometric mean of the two lies within a factor of about three of the
        best penalty, on dense, sparse and measured scenes.
        """
        balanced = self._splits.balanced_penalties()
        if self.iteration in GRADIENT_BALANCING:
            w = self.solution
            misfit = self._camera.forward(w)
            for image in misfit:
                self._weigh(image)
            misfit -= self._data
            misfit *= self._weight
            for image in misfit:
                self._weigh(image)
            gradient = self._camera.adjoint(misfit)
            for c, pixels in enumerate(w):
                size, slope = float(np.linalg.norm(pixels)), float(np.linalg.norm(gradient[c]))
                multiplier = float(self._mu[1, c] * np.linalg.norm(self._splits.t_w[c] - pixels))
                if size > 0:
                    balanced[1, c] = np.sqrt(multiplier * slope) / size
        steps = np.array(LARGEST_STEP)[:, None]
        mu = np.clip(balanced, self._mu / steps, self._mu * steps)
        bound = mu[0] > 0
        mu[1, bound] = np.maximum(mu[1, bound], LEAST_PIXEL_SHARE * mu[0, bound])
        return mu


@cache
def _compile(dtype: np.dtype[Any]) -> None:
    tiny = Convolution(np.ones((1, 2, 2)), (2, 2), dtype=dtype)
    valid = np.arange(4).reshape(1, 2, 2) > 0
    masked = Erasures(valid, (1, 2, 2), dtype) @ tiny
    solver = SensorAdmm(masked, np.ones((1, 2, 2), dtype), TotalVariation(1.0), data_steps=2)
    solver.move(0.5, 0.5)
    solver.step()
