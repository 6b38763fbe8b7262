"""A video's frames one after the other, each from where the one before ended.

A warm start keeps the object, its dual variables and the penalties, so that a frame that differs little from
the one before needs few iterations. It makes a frame depend on those before it, back to the last cold start.
So that the result does not depend on who computes what, a video is cut into blocks of a fixed length, and
each block begins cold: the same block gives the same pictures in any process, but for the order in which BLAS
adds up (1e-6 of the brightest pixel).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.camera.base import LinearOperator
from recon.camera.convolution import PadCropConvolution
from recon.camera.erasures import Erasures
from recon.errors import InputError
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.weights import penalty_of
from recon.solvers.sensor_admm import SensorAdmm
from recon.types import Calibration

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

PRIORS = ("tv", "tv-isotropic", "l1", "nonnegative")
"""The priors of :data:`recon.priors.PRIORS` that the exact-data ADMM solves."""

COLD_ITERATIONS, WARM_ITERATIONS = 20, 4
"""Iterations of a block's first frame and of the others: as good as independent frames at their best where
the scene stands, and near it where it moves by less than a pixel a frame (docs/benchmarks/video.md)."""

BLOCK = 32
"""Frames a block: its cold start is then a seventh of the work."""

SETTLED = 2e-4
"""Change an iteration below which a frame is done before its iterations are."""


@dataclass(frozen=True)
class VideoCamera:
    """All that one needs to reconstruct any frame of a video: settled once, from one of its frames.

    Attributes
    ----------
    psfs : ndarray, float32, (n_channels or 1, height, width)
        Of unit energy.
    deviation : ndarray, float32, (n_channels,)
        Noise, counts.
    image_scale : ndarray, float32, (n_channels, 1, 1)
        From the scaled problem's object to measurement units.
    valid : ndarray of bool, (n_channels, height, width), or None
    prior : str
    weight : float
        Of the prior, in the scaled problem.
    flat : bool
        Whether frames have no channel axis.
    """

    psfs: Floats
    deviation: Floats
    image_scale: Floats
    valid: npt.NDArray[np.bool_] | None
    prior: str
    weight: float
    flat: bool


def video_camera(
    frame: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None = None,
    prior: str = "tv",
    tau: float | None = None,
    noise: NoiseModel | float | None = None,
    erasures: npt.ArrayLike | None = None,
) -> VideoCamera:
    """Settle noise, scales and the prior's weight from one frame, for all frames of a video.

    Parameters
    ----------
    frame : array, (height, width[, n_channels])
        Background subtracted. A bright one, where the video has brighter and darker ones.
    calibration, z_um, tau, noise, erasures
        As :func:`recon.reconstruct`.
    prior : str
        One of :data:`PRIORS`.

    Raises
    ------
    InputError
        When the input is unusable.
    """
    if prior not in PRIORS:
        raise InputError(f"The prior {prior!r} is not for videos; choose one of {', '.join(PRIORS)}.")
    problem = Problem.of(
        Measurement(frame, noise, erasures=erasures),
        calibration,
        ReconstructionOptions(z_um=z_um, prior=prior, tau=tau, model="convolution", solver="admm-sensor"),
    )
    part = Part(problem, slice(0, problem.n_channels))
    part.weigh(tau)
    return VideoCamera(
        psfs=(problem.depths.central[0] / problem.energy[:, None, None]).astype(np.float32),
        deviation=problem.noise,
        image_scale=problem.image_scale[:, 0],
        valid=None if erasures is None else problem.valid,
        prior=prior,
        weight=part.weight,
        flat=problem.flat,
    )


class VideoSolver:
    """Reconstructs frames in order; for one thread.

    Parameters
    ----------
    camera : VideoCamera
    cold_iterations, warm_iterations : int
        Of the first frame after :meth:`begin`, and of each after it.
    """

    def __init__(
        self,
        camera: VideoCamera,
        *,
        cold_iterations: int = COLD_ITERATIONS,
        warm_iterations: int = WARM_ITERATIONS,
    ) -> None:
        if min(cold_iterations, warm_iterations) < 1:
            raise InputError(
                f"Every frame needs an iteration; got {cold_iterations} cold and {warm_iterations} warm ones."
            )
        self.camera = camera
        self.cold_iterations = cold_iterations
        self.warm_iterations = warm_iterations
        n_channels = len(camera.deviation)
        shape = (camera.psfs.shape[1], camera.psfs.shape[2])
        self._convolution = PadCropConvolution(camera.psfs, shape, n_channels=n_channels)
        operator: LinearOperator = self._convolution
        if camera.valid is not None:
            operator = Erasures(camera.valid, operator.range_shape) @ operator
        blank = np.zeros(operator.range_shape, np.float32)
        self._solver = SensorAdmm(operator, blank, penalty_of(camera.prior, camera.weight))
        self._solver.compile()
        self._cold = True

    def begin(self) -> None:
        """Forget the frames before: the next one starts cold."""
        self._cold = True

    def next(self, frame: Floats) -> Floats:
        """Return the picture of the next frame, in the units and shape of :func:`recon.reconstruct`.

        Parameters
        ----------
        frame : ndarray, float32, (height, width[, n_channels])
            Background subtracted, on the PSF's pixels.
        """
        channels = frame[None] if self.camera.flat else np.moveaxis(frame, 2, 0)
        data = channels / self.camera.deviation[:, None, None]
        if self.camera.valid is not None:
            data = np.where(self.camera.valid, data, 0)
        if self._cold:
            self._solver.restart(data)
        else:
            self._solver.set_data(data)
        for _ in range(self.cold_iterations if self._cold else self.warm_iterations):
            if self._solver.advance().change < SETTLED:
                break
        self._cold = False
        return self._picture()

    def _picture(self) -> Floats:
        (row, column), (height, width) = self._convolution.centre, self._convolution.sensor_shape
        top, left = row - height // 2, column - width // 2
        image = self._solver.solution[:, top : top + height, left : left + width] * self.camera.image_scale
        return np.ascontiguousarray(image[0] if self.camera.flat else np.moveaxis(image, 0, 2), np.float32)


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
