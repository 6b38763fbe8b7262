"""A video's frames one after the other, each from where the one before ended.

A warm start keeps the object, its dual variables and the penalties, so that a frame that differs little from
the one before needs few iterations. It makes a frame depend on those before it, back to the last cold start.
So that the result does not depend on who computes what, a video is cut into blocks of a fixed length, and
each block begins cold: the same block gives the same pictures in any process, but for the order in which BLAS
adds up (1e-6 of the brightest pixel).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import given
from recon.reconstruction.solvers import SOLVERS
from recon.streams.running import Running
from recon.types import Calibration

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

COLD_ITERATIONS, WARM_ITERATIONS = 20, 4
"""Iterations of a block's first frame and of the others: as good as independent frames at their best where
the scene stands, and near it where it moves by less than a pixel a frame (docs/benchmarks/video.md)."""

BLOCK = 32
"""Frames a block: its cold start is then a seventh of the work."""

SETTLED = 2e-4
"""Change an iteration below which a frame is done before its iterations are."""


def stream_problem(
    frame: Measurement | npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions | None = None,
    **overrides: Any,
) -> Problem:
    """Settle noise, scales and camera from one frame, for all frames of a video.

    Parameters
    ----------
    frame : Measurement or array, (height, width[, n_channels])
        Background subtracted. A bright one, where the video has brighter and darker ones.
    calibration : Calibration or array
    options : ReconstructionOptions, optional
        Any camera model, prior, background and depths; ``"auto"`` is one PSF a depth here, as the quickest,
        and the exact-data ADMM where that has a way.
    **overrides
        Single options, and facts about the frame, by their names, as of :func:`recon.reconstruct`.

    Raises
    ------
    InputError
        When the input is unusable, or no solver has a way for it.
    """
    known, options = given(overrides, options)
    measurement = frame if isinstance(frame, Measurement) else Measurement(frame)
    if options.model == "auto":
        options = replace(options, model="convolution")
    problem = Problem.of(replace(measurement, **known), calibration, options)
    if options.solver == "auto" and SOLVERS["admm-sensor"].accepts(problem) is None:
        problem = replace(problem, options=replace(options, solver="admm-sensor"))
    problem.solver  # noqa: B018 - refuses at once what it has no way for
    return problem


class VideoSolver:
    """Reconstructs frames in order; for one thread.

    Parameters
    ----------
    problem : Problem
        Of :func:`stream_problem`.
    cold_iterations, warm_iterations : int
        Of the first frame after :meth:`begin`, and of each after it.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        cold_iterations: int = COLD_ITERATIONS,
        warm_iterations: int = WARM_ITERATIONS,
    ) -> None:
        if min(cold_iterations, warm_iterations) < 1:
            raise InputError(
                f"Every frame needs an iteration; got {cold_iterations} cold and {warm_iterations} warm ones."
            )
        self.problem = problem
        self.cold_iterations = cold_iterations
        self.warm_iterations = warm_iterations
        self.running = Running(problem)
        self._cold = True

    def begin(self) -> None:
        """Forget the frames before: the next one starts cold."""
        self._cold = True

    def next(self, frame: Floats) -> Floats:
        """Return the picture (height, width[, n_channels]) of the next frame; of several depths the volume.

        Parameters
        ----------
        frame : ndarray, float32, (height, width[, n_channels])
            Background subtracted, on the PSF's pixels.
        """
        problem = self.problem.with_data(frame)
        if self._cold:
            self.running.begin(problem)
        else:
            self.running.go_on(problem)
        self.running.iterate(self.cold_iterations if self._cold else self.warm_iterations, SETTLED)
        self._cold = False
        return self.picture()

    def picture(self) -> Floats:
        """Return what there is of the newest frame."""
        volume = self.running.volume()
        return np.ascontiguousarray(volume[0]) if self.problem.n_planes == 1 else volume


def blocks_of(frames: list[int], length: int = BLOCK) -> list[tuple[int, ...]]:
    """Cut a video's frame numbers, ascending, into blocks of numbers ``n length <= index < (n + 1) length``.

    By number and not by count, so that blocks stay what they are when frames are missing or added at the end.
    """
    if length < 1:
        raise InputError(f"A block needs a frame at least; got a length of {length}.")
    blocks: dict[int, list[int]] = {}
    for index in frames:
        blocks.setdefault(index // length, []).append(index)
    return [tuple(block) for _, block in sorted(blocks.items())]
