"""What the volume solvers share: the exact data term on the sensor, one channel, where state lives.

The device is a property of arrays: a solver's own live in the memory of ``room.xp``. Classes here run on any;
their compiled subclasses replace single steps where the arrays are NumPy's and the prior is one they know.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray
from recon.base import fft
from recon.base.namespace import Namespace, namespace_of
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.solvers.base import Solver
from recon.solvers.cosine_preconditioner import NEARLY, CosinePreconditioner
from recon.solvers.memory import Storage
from recon.solvers.moving import move_spectra

MOST_STEPS = 30
"""Conjugate gradient steps of one iteration at most."""


class SensorSystem:
    """Solves for the data residual ``e`` that a proximal or ADMM step on the whole volume leaves.

    Let ``A = C M`` with ``M`` the sum of circular convolutions over depth and ``C`` the crop to the sensor's
    valid pixels. Minimising ``1/2 ||A x - b||^2 + 1/2 <x, T x> - <r, x>`` gives ``x = T^-1 (r + A^H e)``
    where ``e = b - A x`` solves ``(I + C q C^T) e = b - A T^-1 r`` with ``q = M T^-1 M^H`` diagonal in
    frequency: a two-dimensional problem however many planes there are. Erasures are part of ``C`` and cost
    nothing.

    Conjugate gradients are preconditioned in the sensor's cosine modes, of which a smooth background takes
    the lowest (:class:`~recon.solvers.cosine_preconditioner.CosinePreconditioner`). A camera that is no
    convolution does not have the power at its lowest frequencies that the central one has, which that inverse
    takes for exact: there ``C F^-1 1 / (1 + q / 2) F C^T`` serves, the inverse for a sensor that covers half
    the grid, and smooth light of which a restrained background leaves little is its own.

    Parameters
    ----------
    grid_shape : (int, int)
    window : tuple of slice
        Where the sensor lies on the grid.
    measured : SensorData
        Its valid pixels, and a smooth background to be estimated as well: a further factor ``W`` of ``C``,
        a projection or, restrained, nearly one.
    dtype : dtype
    xp : module
        Whose arrays: ``numpy`` or ``cupy``.
    bend : callable, optional
        ``bend(e)`` returns ``A T^-1 A^H e`` of a camera that is no convolution: ``q`` is then that of the
        convolution that the system is preconditioned with. Each of its few steps costs as much as an
        iteration of FISTA.

    Attributes
    ----------
    tolerance : float
        Residual to reach, relative to the right-hand side (see :meth:`follow`).
    """

    def __init__(
        self,
        grid_shape: tuple[int, int],
        window: tuple[slice, slice],
        measured: SensorData,
        *,
        dtype: npt.DTypeLike = np.float32,
        xp: Namespace = np,
        bend: Callable[[Array], Array] | None = None,
    ) -> None:
        valid = measured.valid
        self.xp = xp
        self.window = window
        self.tolerance = 1e-4
        self.max_steps = MOST_STEPS
        self._operator_bend = bend
        self.dtype = np.dtype(dtype)
        self._adapted_to: float | None = None
        self._cosine: CosinePreconditioner | None = None
        if bend is None:
            shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
            self._cosine = CosinePreconditioner(grid_shape, shape, self.dtype, xp)
        self.set_background(measured.background)
        self._mask = None if valid is None or valid.all() else xp.asarray(valid.astype(self.dtype))
        # The grid's rows that hold the sensor; no others are ever transformed to or from real space.
        rows = (1, window[0].stop - window[0].start, grid_shape[1])
        self._cast, self._seen = xp.zeros(rows, self.dtype), xp.empty(rows, self.dtype)
        self._spectrum = xp.empty(fft.spectrum_shape(grid_shape), fft.complex_dtype(self.dtype))
        self._q: Array = xp.zeros(fft.spectrum_shape(grid_shape), self.dtype)
        self._scale = 0.0
        self.steps = 0

    def set_background(self, background: BackgroundRemoval | None) -> None:
        """Estimate a smooth background as well, as restrained as it is now."""
        xp = self.xp
        self._basis = None if background is None else [xp.asarray(part) for part in background.basis(0)]
        self._taken = 1.0 if background is None else background.taken
        if background is None or self._cosine is None:
            return
        if self._adapted_to is None or abs(self._taken - self._adapted_to) > NEARLY:
            rows, columns, _ = background.basis(0)
            self._cosine.weigh((len(rows), len(columns)), 1 - self._taken)
            self._adapted_to = self._taken

    def set_curvature(self, q: Array) -> None:
        """Give ``q`` but for a factor, real, on the half spectrum; it is kept as it is."""
        self._q = q
        if self._cosine is not None:
            self._cosine.set_curvature(q)

    def set_scale(self, scale: float) -> None:
        """Give the factor of ``q``: a penalty's reciprocal, or a step."""
        self._scale = scale

    def follow(self, progress: float) -> None:
        """Set the tolerance by how far the solver around it has still to go (a relative residual).

        Inexact at first, then always ahead of the solver, so that it can converge as far as it is asked to.
        """
        floor = 10 * float(np.finfo(self.dtype).eps)
        self.tolerance = float(np.clip(0.02 * progress, floor, 1e-4))

    def masked(self, image: Array) -> Array:
        """Take out, in place, what says nothing: pixels that are not valid, a smooth background."""
        if self._mask is not None:
            image *= self._mask
        if self._basis is not None:
            image -= self._smooth(image)
            if self._mask is not None:
                image *= self._mask
        return image

    def _smooth(self, image: Array) -> Array:
        """Return what a background takes of an image."""
        assert self._basis is not None
        rows, columns, inverse = self._basis
        coefficients = rows @ image.astype(np.float64) @ columns.T
        best = self._taken * (inverse @ coefficients.ravel()).reshape(coefficients.shape)
        smooth: Array = (rows.T @ best @ columns).astype(self.dtype)
        return smooth

    def weighed(self, e: Array) -> Array:
        """``W e``, with ``W`` the factor that a restrained background is; ``e`` itself where it is none.

        A projection changes nothing of what lies in its range.
        """
        return self.masked(e.copy()) if self._taken < 1 else e

    def spectrum_of(self, e: Array) -> Array:
        """``F C^T e``, in an array that the next call overwrites."""
        rows, columns = self.window
        self._cast[0, :, columns] = self.weighed(e)
        spectrum: Array = fft.rfft_strip(self._cast, rows.start, self._spectrum[None])[0]
        return spectrum

    def from_spectrum(self, X: Array) -> Array:
        """``C F^-1 X``; overwrites ``X``."""
        rows, columns = self.window
        return self.masked(fft.irfft_strip(X[None], rows.start, self._seen)[0, :, columns].copy())

    def _filtered(self, e: Array, transfer: Array) -> Array:
        X = self.spectrum_of(e)
        fft.multiply(X[None], transfer[None])
        return self.from_spectrum(X)

    def _bend(self, e: Array) -> Array:
        """``C q C^T e``."""
        if self._operator_bend is not None:
            return self.masked(self._operator_bend(self.weighed(e)))
        bent = self._filtered(e, self._q)
        bent *= bent.dtype.type(self._scale)
        return bent

    def _adapt(self) -> None:
        """Have the preconditioner follow ``q`` and its factor."""
        if self._cosine is not None:
            self._cosine.set_scale(self._scale)
        else:
            self._inverse = 1 / (1 + self._q * self._q.dtype.type(0.5 * self._scale))

    def _preconditioned(self, residual: Array) -> Array:
        """Return a residual times an approximate inverse, on the valid pixels."""
        if self._cosine is None:
            z = self._filtered(residual, self._inverse)
            if self._taken < 1:
                z += self._smooth(residual)
        else:
            z = self._cosine.apply(residual, self.xp.empty_like(residual))
        if self._taken == 1:
            return self.masked(z)
        if self._mask is not None:  # light that no pixel measures would have to be taken back
            z *= self._mask
        return z

    def solve(self, right: Array, e: Array) -> None:
        """Improve ``e`` in place until the residual is down to the tolerance."""
        xp = self.xp
        target = self.tolerance * float(xp.linalg.norm(right))
        if not np.isfinite(target):
            e[...] = np.nan
            return
        self._adapt()
        residual = right - e - self._bend(e)
        direction = xp.zeros_like(e)
        rho = 1.0
        self.steps = 0
        while float(xp.linalg.norm(residual)) > target and self.steps < self.max_steps:
            z = self._preconditioned(residual)
            rho, rho_before = float(xp.vdot(residual, z)), rho
            if not rho > 0:  # what is left is less than the arithmetic can tell
                break
            direction *= rho / rho_before if self.steps else 0.0
            direction += z
            image = direction + self._bend(direction)
            length = e.dtype.type(rho / float(xp.vdot(direction, image)))
            e += length * direction
            residual -= length * image
            self.steps += 1


def residual_norm(e: Array) -> float:
    """``||e||``; infinity where it is not a number, which a stopping rule takes for lost."""
    norm = float(namespace_of(e).linalg.norm(e))
    return norm if np.isfinite(norm) else np.inf


@dataclass(frozen=True)
class Tuning:
    """How a splitting method runs; the defaults need no change.

    Attributes
    ----------
    relaxation : float, optional
        alpha, between 1 and 2; default the method's own.
    first : float, optional
        Penalty (ADMM) or step (Douglas-Rachford) to start with; default from operator and data.
    balance : bool
        Adapt it while running.
    kappa : float
        Penalty of non-negativity relative to that of total variation.
    drop_empty : bool
        With l1: leave out planes that stay empty.
    """

    relaxation: float | None = None
    first: float | None = None
    balance: bool = True
    kappa: float = 1.0
    drop_empty: bool = True


@dataclass(frozen=True)
class Room:
    """Where a solver's state lives.

    Attributes
    ----------
    xp : module
        Whose arrays: ``numpy`` or ``cupy``.
    storage : Storage
        Memory, or files. (The transfer functions are the operator's.)
    keep_state : bool
        False gives the state up when a run ends: one volume less at the peak, and nothing to go on from.
    """

    xp: Namespace = np
    storage: Storage = field(default_factory=Storage)
    keep_state: bool = True

    def zeros(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Array:
        """Return an array of zeros there."""
        return self.storage.zeros(shape, dtype) if self.xp is np else self.xp.zeros(shape, dtype)


@dataclass(frozen=True)
class SensorData:
    """What one channel of the sensor measured.

    Attributes
    ----------
    image : ndarray, (1, height, width)
    valid : ndarray of bool, (height, width), optional
        Pixels that were measured; default all.
    background : BackgroundRemoval, optional
        A smooth background to be estimated as well, for the same valid pixels.
    """

    image: Array
    valid: BoolArray | None = None
    background: BackgroundRemoval | None = None

    @classmethod
    def of(cls, data: Array | SensorData) -> SensorData:
        """Return data as they are, an image as the data of a sensor whose pixels are all valid."""
        return data if isinstance(data, SensorData) else cls(data)


class VolumeSplitting(Solver):
    """A splitting method for one channel of a volume whose data term is solved exactly on the sensor.

    Parameters
    ----------
    operator : Convolution
        One channel.
    data : ndarray, (1, height, width), or SensorData
    tuning : Tuning
    room : Room
    relaxation : float
        The method's own, where ``tuning`` names none.
    bend : callable, optional
        Of a camera that is no convolution, as :class:`SensorSystem`; ``operator`` is what it is
        preconditioned with.
    """

    def __init__(
        self,
        operator: Convolution,
        data: Array | SensorData,
        tuning: Tuning | None,
        room: Room | None,
        relaxation: float,
        bend: Callable[[Array], Array] | None = None,
    ) -> None:
        super().__init__()
        if operator.domain_shape[0] != 1:
            raise ValueError(f"One channel at a time, not {operator.domain_shape[0]}.")
        self.operator = operator
        self.tuning, self.room = tuning or Tuning(), room or Room()
        self.relaxation = self.tuning.relaxation or relaxation
        self.balance = self.tuning.balance
        self.xp = self.room.xp
        data = SensorData.of(data)
        self.system = SensorSystem(
            operator.grid_shape,
            operator.sensor_window,
            data,
            dtype=operator.dtype,
            xp=self.xp,
            bend=bend,
        )
        self.set_data(data)

    def set_data(self, data: SensorData) -> None:
        """Go on with other data of the same valid pixels from where the solver is: a video's next frame."""
        operator = self.operator
        self.system.set_background(data.background)
        image = np.array(data.image, operator.dtype).reshape(operator.sensor_shape)
        self.data = self.system.masked(self.xp.asarray(image))

    def _forward(self, x: Array) -> Array:
        """Return what the sensor sees of a volume (n_z, height, width), masked as the data are."""
        if self.xp is np:
            return self.system.masked(self.operator.forward(x)[0])
        return self.system.from_spectrum((self._transfer * fft.rfft(x)).sum(axis=0))

    @property
    def _transfer(self) -> Array:
        """Transfer functions on the device, (n_z, grid_height, grid_width // 2 + 1)."""
        if self.xp is np:
            return self.operator.channel_spectrum(0)
        if self._on_device is None:
            self._on_device = self.xp.asarray(self.operator.channel_spectrum(0))
        return self._on_device

    _on_device: Array | None = None
    _total: Array | None = None
    """Spectrum of what the planes cast but for the data term's step, once there is one."""

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint of a solver of the same problem; what was cast before is not its."""
        super().restore(state)
        self._total = None

    def _keep_total(self, total: Array) -> Array:
        """Keep what the planes cast for data to come; return it."""
        if self._total is None:
            self._total = self.xp.empty_like(total)
        self._total[...] = total
        return total

    def move(self, rows: float, columns: float) -> None:
        """Move object and dual variables; what is left of the data is noise, which does not move."""
        if self._total is not None:
            move_spectra(self._total, rows, columns, self.operator.grid_shape[1])

    def _start(self) -> Array | None:
        return None  # zeros will do: a copy of a volume is too much to pay for a fall-back


def squares(a: Array) -> float:
    """Sum of squares, in float64."""
    return float((a * a).sum(dtype=np.float64))


def is_due(iteration: int) -> bool:
    """Tell whether to balance after this iteration (counted from 0): 2, 4, 6, 8, 12, 16, 24, 32, 48, ...

    Ever more seldom: a method whose penalty changes finitely often in any stretch that grows converges, and a
    bad guess is still put right late in a long run.
    """
    if iteration in (2, 4, 6):
        return True
    while iteration > 6 and iteration % 2 == 0:
        iteration //= 2
    return iteration in (4, 6)
