"""Blocks of frames solved together, with a prior over time: a proximal map of (n_frames, height, width).

The frames of a block are the channels of one problem for the exact-data ADMM, whose priors act on each frame.
One split more, ``z = y`` with the prior over time on ``z``, joins them: it adds its penalty to the pixels' in
the quadratic problem, and its proximal map sees the stack whole. Memory is that of a block, about 40 bytes a
frame and pixel of the FFT grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np

from recon.arrays import Array, Float32Array
from recon.base.threads import in_blocks
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.errors import InputError
from recon.priors.base import Prior
from recon.reconstruction.first_look import look_at
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers.sensor_admm import SensorAdmm


class OverTime(Protocol):
    """A prior that couples frames."""

    def value(self, stack: Array) -> float:
        """Return the prior's value."""

    def prox(self, stack: Array, step: float) -> Array:
        """Return ``argmin_z 1/2 ||z - stack||^2 + step value(z)``, a new array."""


class TemporalTotalVariation:
    """``weight sum_t |x[t + 1] - x[t]|``: pixels keep their value but for jumps.

    The prox is exact, pixel by pixel (Condat 2013, "A direct algorithm for 1-D total variation denoising").
    """

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def value(self, stack: Array) -> float:
        """Return the weighted sum of jumps."""
        return self.weight * float(np.sum(np.abs(np.diff(stack, axis=0)), dtype=np.float64))

    def prox(self, stack: Array, step: float) -> Array:
        """Denoise each pixel's course."""
        from recon.streams import _time_kernels

        courses = np.ascontiguousarray(stack.reshape(len(stack), -1).T)
        result = np.empty_like(courses)
        threshold = courses.dtype.type(step * self.weight)
        kernel = _time_kernels.denoise
        in_blocks(lambda a, b: kernel(a, b, courses, threshold, result), len(courses), grain=1024)
        return np.ascontiguousarray(result.T).reshape(stack.shape)


class LowRankPlusSparse:
    """``min_(L + S = x) weight_rank ||L||_* + weight_sparse ||S||_1``: background plus activity.

    Nuclear norm of the stack as a matrix of frames by pixels (Candès et al. 2011). The prox alternates
    between the two parts, from where it was last time; with a solver that calls it again and again the
    parts settle with it.

    Attributes
    ----------
    sparse : ndarray or None
        Of the last prox.
    """

    def __init__(self, weight_rank: float, weight_sparse: float, rounds: int = 2) -> None:
        self.weight_rank, self.weight_sparse, self.rounds = weight_rank, weight_sparse, rounds
        self.sparse: Array | None = None

    def value(self, stack: Array) -> float:
        """Return the value of the parts that the last prox found, scaled to add up to ``stack``."""
        sparse = np.zeros_like(stack) if self.sparse is None else self.sparse
        low = (stack - sparse).reshape(len(stack), -1)
        nuclear = float(np.sum(np.sqrt(np.maximum(np.linalg.eigvalsh(_gram(low)), 0))))
        return self.weight_rank * nuclear + self.weight_sparse * float(
            np.sum(np.abs(sparse), dtype=np.float64)
        )

    def prox(self, stack: Array, step: float) -> Array:
        """Return background plus activity."""
        sparse = np.zeros_like(stack) if self.sparse is None else self.sparse
        for _ in range(self.rounds):
            low = _shrunk_rank(stack - sparse, step * self.weight_rank)
            rest = stack - low
            limit = stack.dtype.type(step * self.weight_sparse)
            sparse = rest - np.clip(rest, -limit, limit)
        self.sparse = sparse
        together: Array = low + sparse
        return together


def _gram(matrix: Array) -> Array:
    product: Array = (matrix @ matrix.T).astype(np.float64)
    return product


def _shrunk_rank(stack: Array, threshold: float) -> Array:
    """Lessen a stack's singular values (frames by pixels), from the small matrix of frames by frames."""
    matrix = stack.reshape(len(stack), -1)
    values, vectors = np.linalg.eigh(_gram(matrix))
    singular = np.sqrt(np.maximum(values, 0))
    kept = np.where(singular > threshold, 1 - threshold / np.maximum(singular, 1e-30), 0)
    weights = ((vectors * kept) @ vectors.T).astype(stack.dtype)
    shrunk: Array = (weights @ matrix).reshape(stack.shape)
    return shrunk


OverTimeName = Literal["tv", "lowrank"]
OVER_TIME: tuple[OverTimeName, ...] = ("tv", "lowrank")

JOINT_ITERATIONS = 60
"""Of a block that is solved together; its first ones are all cold."""
JOINT_BLOCK = 16
"""Frames of such a block: 16 of a megapixel take 5 GB."""
TIME_SHARE = 1.0
"""Penalty of the split over time relative to that of the pixels, whose scale it shares."""


RANK_SHARE, SPARSE_SHARE = 0.03, 0.3
"""Weights of low rank (by the root of the pixels, the largest singular value of noise) and of sparse activity
relative to the frames' prior. Larger ones take more light from the background than noise from the frames."""


class JointAdmm(SensorAdmm):
    """The exact-data ADMM on a stack of frames with a prior over time.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution`` with a channel a frame, with or without ``Erasures`` after it.
    data, prior
        As of :class:`~recon.solvers.SensorAdmm`.
    """

    def __init__(self, operator: LinearOperator, data: Array, prior: Prior, over_time: OverTime) -> None:
        self._over_time = over_time
        self._mu_time = 0.0
        super().__init__(operator, data, prior)
        self._t_time = np.zeros(operator.domain_shape, operator.dtype)
        self._split = self._t_time.copy()

    def _extra_penalty(self) -> float:
        return self._mu_time

    def _adapt(self) -> None:
        before, self._mu_time = self._mu_time, TIME_SHARE * float(np.mean(self._mu[1]))
        if before > 0 and before != self._mu_time:
            # The multiplier stays; its scaled form does not.
            self._t_time -= self._split
            self._t_time *= self._t_time.dtype.type(before / self._mu_time)
            self._t_time += self._split
        super()._adapt()

    def _update(self, steps: int) -> float:
        self._split = self._over_time.prox(self._t_time, 1 / self._mu_time)
        self._y += self._y.dtype.type(self._mu_time) * (2 * self._split - self._t_time)
        misfit = sum(self._solve(channel, steps) for channel in range(len(self._y)))
        self._t_time += self._y.dtype.type(self.relax) * (self._y - self._split)
        for channel in range(len(self._y)):
            self._splits.sweep(self.relax, channel)
        return misfit


def require_joint(problem: Problem) -> None:
    """Refuse what a prior over time has no way for: frames are the channels of one problem.

    Raises InputError when frames are colour, or their camera has more than one PSF, one depth, or a
    background, which a solver of one channel at a time cannot join; or another solver was asked for.
    """
    if not problem.flat:
        raise InputError("Priors over time take grey frames; reconstruct each channel on its own.")
    if not problem.together:
        raise InputError(
            "A prior over time joins frames as the channels of one problem: it takes one PSF, one depth, no "
            "background and the cpu. Leave the prior over time out."
        )
    if problem.patterned or problem.options.solver not in ("auto", "admm-sensor"):
        raise InputError(
            "A prior over time has a solver of its own, for frames in one light: leave the solver or the "
            "prior over time out."
        )


def solve_together(
    problem: Problem,
    frames: Float32Array,
    over_time: OverTimeName,
    *,
    weight: float | None = None,
    iterations: int = JOINT_ITERATIONS,
    ended: Callable[[], bool] = lambda: False,
) -> Float32Array | None:
    """Reconstruct a block of frames with a prior over time.

    Raises InputError when there are fewer than two frames, or as of :func:`require_joint`.

    Parameters
    ----------
    problem : Problem
        Of :func:`~recon.streams.video.stream_problem`; grey.
    frames : ndarray, float32, (n_frames, height, width)
        Background subtracted.
    over_time : "tv" or "lowrank"
        Total variation along time, or low rank plus sparse (background and activity).
    weight : float, optional
        Of the prior over time, in units of the noise that the adjoint passes on; default 1. What changes in
        time says nothing of the steps in space that the frames' own weight follows.
    ended : callable
        Asked before each iteration; True gives the block up.

    Returns
    -------
    ndarray, float32, (n_frames, height, width), or None
        In the units of :func:`recon.reconstruct`; None when given up.
    """
    require_joint(problem)
    if frames.ndim != 3 or len(frames) < 2:
        raise InputError(f"A prior over time needs two frames at least, grey; got {frames.shape}.")
    shape = problem.sensor_shape
    part = Part(problem, slice(0, 1))
    look = look_at(problem)
    part.weigh(problem.options.tau, None if look is None else look.weight(problem.prior_name))
    psfs = problem.depths.central[0] / problem.energy[:, None, None]
    operator: LinearOperator = Convolution(psfs, shape, n_channels=len(frames), dtype=part.dtype)
    data = np.stack([problem.with_data(frame).data[0] for frame in frames])
    if not problem.valid.all():
        valid = np.repeat(problem.valid, len(frames), axis=0)
        operator = Erasures(valid, data.shape, part.dtype) @ operator
    scale = (1.0 if weight is None else weight) * float(np.sqrt(problem.valid.mean()))
    prior_over_time: OverTime = (
        TemporalTotalVariation(scale)
        if over_time == "tv"
        else LowRankPlusSparse(RANK_SHARE * scale * float(np.sqrt(np.prod(shape))), SPARSE_SHARE * scale)
    )
    solver = JointAdmm(operator, data, part.prior, prior_over_time)
    for _ in range(iterations):
        if ended():
            return None
        solver.advance()
    rows, columns = problem.window
    return np.ascontiguousarray(solver.solution[:, rows, columns] * problem.image_scale[0], np.float32)
