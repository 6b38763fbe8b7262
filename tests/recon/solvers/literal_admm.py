"""The ADMM of Kuo 2020, A.3, written as the text has it: the plain reference for the fast solvers.

NumPy's FFT, one array a variable, no tricks; slow and short. Use :class:`~recon.solvers.Admm` for work.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.factors import as_cropped_convolution
from recon.priors.base import Prior
from recon.priors.total_variation import Differences
from recon.solvers.base import IterationRecord, Solver
from recon.solvers.prior_splits import split_prior


def circular(camera: Convolution, x: Array) -> Array:
    """Return what a sensor as large as the grid would see: the circular convolution ``M x``."""
    return fft.irfft(fft.rfft(x) * camera.spectrum[:, 0], camera.grid_shape[1])


class LiteralAdmm(Solver):
    """Eqs. A.4 and following in two dimensions, with complex FFTs of whole arrays.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution``, with or without ``Erasures``; its dtype is that of all arithmetic
        (NumPy's FFTs keep single precision).
    data : ndarray, ``operator.range_shape``
    prior : Prior
        One wrapped ``TotalVariation`` and separable priors.
    mu : tuple of float
        ``mu_1, mu_2, mu_3`` of A.3.
    initial : ndarray, ``operator.domain_shape``, optional
        Starting point; default zeros.
    """

    state_names: ClassVar[tuple[str, ...]] = ("y", "xi", "eta", "rho")

    def __init__(
        self,
        operator: LinearOperator,
        data: Array,
        prior: Prior,
        mu: tuple[float, float, float] = (1.0, 1.0, 1.0),
        *,
        initial: Array | None = None,
    ) -> None:
        super().__init__()
        structure = as_cropped_convolution(operator)
        convolution = structure.convolution
        tv, self.separable, _ = split_prior(prior)
        self.tau = tv.weight if tv else 0.0
        self.isotropic = bool(tv and tv.isotropic)
        self.mu_1, self.mu_2, self.mu_3 = mu
        shape = operator.domain_shape
        dtype = operator.dtype
        self.psi = Differences(shape, (1.0, 1.0), dtype=dtype)

        # D of A.4 as a mask on the whole grid, and b on the same grid.
        self.D = np.zeros(shape, dtype)
        window = (..., *convolution.sensor_window)
        self.D[window] = structure.weight
        self.b = np.zeros(shape, dtype)
        self.b[window] = np.where(structure.weight > 0, data, 0)

        point = np.zeros(shape, dtype)
        point[:, 0, 0] = 1
        self.M = np.fft.fft2(circular(convolution, point))
        psi_psi = np.fft.fft2(self.psi.adjoint(self.psi.forward(point))).real
        self.denominator = self.mu_1 * np.abs(self.M) ** 2 + self.mu_2 * psi_psi + self.mu_3
        self.y = np.zeros(shape, dtype)
        if initial is not None:
            self.y[...] = initial
        self.xi = np.zeros(shape, dtype)
        self.eta = np.zeros(self.psi.range_shape, dtype)
        self.rho = np.zeros(shape, dtype)

    @property
    def solution(self) -> Array:
        """The split variable ``w``, which obeys the separable prior."""
        return self.separable.prox(self.y + self.rho / self.mu_3, 1 / self.mu_3)

    def convolve(self, y: Array) -> Array:
        """``M y``."""
        result: Array = np.fft.ifft2(self.M * np.fft.fft2(y)).real
        return result

    def correlate(self, v: Array) -> Array:
        """``M^T v``."""
        result: Array = np.fft.ifft2(np.conj(self.M) * np.fft.fft2(v)).real
        return result

    def step(self) -> IterationRecord:
        """Do the updates of A.3 in their order."""
        previous, norm = self.y, np.linalg.norm
        u = self.shrink(self.psi.forward(self.y) + self.eta / self.mu_2, self.tau / self.mu_2)
        v = (self.D * self.b + self.mu_1 * self.convolve(self.y) + self.xi) / (self.D + self.mu_1)
        w = self.separable.prox(self.y + self.rho / self.mu_3, 1 / self.mu_3)
        right = self.correlate(self.mu_1 * v - self.xi)
        right = right + self.psi.adjoint(self.mu_2 * u - self.eta) + self.mu_3 * w - self.rho
        self.y = np.fft.ifft2(np.fft.fft2(right) / self.denominator).real
        My = self.convolve(self.y)
        self.xi = self.xi + self.mu_1 * (My - v)
        self.eta = self.eta + self.mu_2 * (self.psi.forward(self.y) - u)
        self.rho = self.rho + self.mu_3 * (self.y - w)
        Py = self.psi.forward(self.y)
        residual = float(norm(self.D * My - self.b))
        size = float(norm(self.y)) or 1.0
        prior = self.tau * float(np.sum(self.lengths(Py)))
        prior += self.separable.weight * float(np.sum(np.abs(w)))
        return IterationRecord(
            0,
            0.0,
            0.5 * residual**2 + prior,
            residual,
            primal_residual=float(norm([norm(My - v), norm(Py - u), norm(self.y - w)])) / size,
            # The splits follow y, whose change is what is left of the optimality condition.
            dual_residual=float(norm(self.y - previous)) / size,
            change=float(norm(self.y - previous)) / size,
        )

    def lengths(self, d: Array) -> Array:
        """Lengths of the differences: of each on its own, or of the pairs."""
        lengths: Array = np.sqrt(np.sum(d * d, axis=0)) if self.isotropic else np.abs(d)
        return lengths

    def shrink(self, d: Array, threshold: float) -> Array:
        """Soft threshold: of each difference, or of each pixel's pair when isotropic."""
        size = np.linalg.norm(d, axis=0) if self.isotropic else np.abs(d)
        result: Array = d * (np.maximum(size - threshold, 0) / np.maximum(size, np.finfo(d.dtype).tiny))
        return result
