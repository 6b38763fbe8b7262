"""Blocks of frames solved together, with a prior over time.

The frames of a block are the channels of one problem for the exact-data ADMM, whose priors act on each frame.
One split more, ``z = y`` with the prior over time on ``z``, joins them: it adds its penalty to the pixels' in
the quadratic problem, and its proximal map sees the stack whole. Memory is that of a block, about 40 bytes a
frame and pixel of the FFT grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from recon.camera.base import Array, LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.errors import InputError
from recon.priors.base import Prior
from recon.reconstruction.measurement import Floats
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers.sensor_admm import SensorAdmm
from recon.streams.over_time import LowRankPlusSparse, OverTime, TemporalTotalVariation

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
    over_time : OverTime
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


def solve_together(
    problem: Problem,
    frames: Floats,
    over_time: OverTimeName,
    *,
    weight: float | None = None,
    iterations: int = JOINT_ITERATIONS,
    ended: Callable[[], bool] = lambda: False,
) -> Floats | None:
    """Reconstruct a block of frames with a prior over time.

    Parameters
    ----------
    problem : Problem
        Of :func:`~recon.streams.video.stream_problem`; grey.
    frames : ndarray, float32, (n_frames, height, width)
        Background subtracted.
    over_time : "tv" or "lowrank"
        Total variation along time, or low rank plus sparse (background and activity).
    weight : float, optional
        Of the prior over time relative to the frames' own; default 1.
    iterations : int
    ended : callable
        Asked before each iteration; True gives the block up.

    Returns
    -------
    ndarray, float32, (n_frames, height, width), or None
        In the units of :func:`recon.reconstruct`; None when given up.

    Raises
    ------
    InputError
        When the frames are colour, or fewer than two; or their camera has more than one PSF or a background:
        frames are the channels of one problem, which a solver of one channel at a time cannot join.
    """
    if not problem.flat or frames.ndim != 3:
        raise InputError("Priors over time take grey frames; reconstruct each channel on its own.")
    if len(frames) < 2:
        raise InputError("A prior over time needs two frames at least.")
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
    shape = problem.sensor_shape
    part = Part(problem, slice(0, 1))
    part.weigh(problem.options.tau)
    psfs = problem.depths.central[0] / problem.energy[:, None, None]
    operator: LinearOperator = Convolution(psfs, shape, n_channels=len(frames), dtype=part.dtype)
    data = np.stack([problem.with_data(frame).data[0] for frame in frames])
    if not problem.valid.all():
        valid = np.repeat(problem.valid, len(frames), axis=0)
        operator = Erasures(valid, data.shape, part.dtype) @ operator
    scale = part.weight * (1.0 if weight is None else weight)
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
