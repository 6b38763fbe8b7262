"""What a reconstruction returns, and where its voxels lie."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.arrays import Array, Float32Array
from recon.camera.convolution import field_of
from recon.camera.grid import Grid
from recon.reconstruction.options import Field
from recon.solvers.base import IterationRecord, StopReason
from recon.solvers.douglas_rachford import EmptyPlanes
from recon.verdict.judge import Verdict

if TYPE_CHECKING:
    from recon.reconstruction.choice import Choice
    from recon.reconstruction.problem import Problem
    from recon.reconstruction.psf_refinement import Refinement
    from recon.reconstruction.uncertainty import Uncertainty


def window_of(
    field: Field, sensor_shape: tuple[int, int], psf_shape: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the part of the operator's grid that a field takes, and where the axis is in it."""
    (full_height, full_width), (row, column) = field_of(sensor_shape, psf_shape)
    if field == "full":
        return (slice(0, full_height), slice(0, full_width)), (row, column)
    height, width = sensor_shape
    top, left = max(row - height // 2, 0), max(column - width // 2, 0)
    window = slice(top, min(top + height, full_height)), slice(left, min(left + width, full_width))
    return window, (row - top, column - left)


@dataclass(frozen=True, slots=True, repr=False)
class Reconstruction:
    """A reconstructed picture or volume with all that is needed to judge it: a picture is one plane.

    Attributes
    ----------
    volume : ndarray, float32, (n_z, height, width) or (n_z, height, width, n_channels)
        In the units in which ``measurement = sum_z PSF_z * volume_z`` holds with the PSFs as calibrated.
    grid : Grid
    model : str
        Camera model, and in ``reason`` why.
    solver, prior : str
    tau : float or None
        Regularisation that was solved with, relative to ``max |A^H b|`` (for ``"wiener"`` as
        :func:`recon.solvers.wiener_filter`); None where nothing is weighted. The largest of all channels.
    noise_norm : float
        Expected norm of the noise, in the units of the histories' residuals.
    residuals : tuple of float
        Norm of what is left of the data, one a run; of a solution in one step without its negative light,
        and NaN with ``judged=False``: only a verdict asks for it.
    histories : tuple of tuple of IterationRecord
        One history a run: one, or one a channel; residuals in units of the noise' standard deviation. Empty
        ones for solvers in one step.
    stop_reasons : tuple of StopReason
        One a run.
    seconds : float
        Wall time of the solver.
    background : ndarray or None
        The smooth background that was estimated along with the volume, and light from beyond its depths
        where that was looked for, measurement units; shaped as the
        measurement.
    empty_planes : tuple of EmptyPlanes
        One a channel, with l1: depth planes that were left out because they stayed empty, and whether the
        optimality condition certifies it.
    warnings : tuple of str
        What may be wrong with the result, in sentences.
    verdict : Verdict or None
        Whether to trust it, from the data alone; None where nobody asked for one.
    uncertainty : Uncertainty or None
        How far it may be off, pixel by pixel; None where nobody asked for it.
    residual : ndarray, float32, shaped as the measurement, or None
        What is left of the data, in units of their noise, 0 where there are none; None where a verdict says
        what the result is worth, or none was asked for.
    choice : Choice or None
        What was chosen and why, where the program chose (``model="auto"``).
    refinement : Refinement or None
        How the PSFs were brought to fit the photograph, where that was asked for (``refine_psf``).
    state : ndarray or None
        The whole object on the operator's grid in measurement units, (n_channels, n_z, grid height, grid
        width), for a start that forgets nothing; None where that would take too much memory, or does not fit
        the measurement's own pixels: a start is then taken from ``volume``.
    provenance : mapping
        Software and settings, JSON-compatible.
    basis : (Problem, Reconstruction) or None
        The smaller problem that was solved where the program chose, and its own result, from which
        :func:`~recon.reconstruction.reconstruct.judged` takes the verdict.
    """

    volume: Float32Array
    grid: Grid
    model: str
    reason: str
    solver: str
    prior: str
    tau: float | None
    noise_norm: float
    residuals: tuple[float, ...]
    histories: tuple[tuple[IterationRecord, ...], ...]
    stop_reasons: tuple[StopReason, ...]
    seconds: float
    background: Float32Array | None = None
    empty_planes: tuple[EmptyPlanes, ...] = ()
    warnings: tuple[str, ...] = ()
    verdict: Verdict | None = None
    uncertainty: Uncertainty | None = None
    residual: Float32Array | None = None
    choice: Choice | None = None
    refinement: Refinement | None = None
    state: Array | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    basis: tuple[Problem, Reconstruction] | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        """Say in a line what it is, how it was made, and whether to trust it."""
        planes, height, width = self.volume.shape[:3]
        size = f"Picture {height} x {width}" if planes == 1 else f"Volume {planes} x {height} x {width}"
        size += f" x {self.volume.shape[3]} channels" if self.volume.ndim == 4 else ""
        count = len(self.history)
        ended = f"{count} iterations, {self.seconds:.1f} s, {self.stop_reason}" if count else "one step"
        verdict = "" if self.verdict is None else "; " + self.verdict.sentences[0].partition(":")[0]
        return f"<{size} by {self.solver}, prior {self.prior}: {ended}{verdict}>"

    @property
    def is_picture(self) -> bool:
        """Whether there is one plane."""
        return len(self.volume) == 1

    @property
    def image(self) -> Float32Array:
        """The picture, (height, width[, n_channels]).

        Raises ValueError when there are several planes.
        """
        if not self.is_picture:
            raise ValueError(f"This is a volume of {len(self.volume)} planes: take .volume.")
        return np.ascontiguousarray(self.volume[0])

    @property
    def history(self) -> tuple[IterationRecord, ...]:
        """The iterations of the run that took most: channels may run one after the other."""
        return self.histories[self._longest]

    @property
    def stop_reason(self) -> StopReason:
        """Why the run that took most iterations ended."""
        return self.stop_reasons[self._longest]

    @property
    def _longest(self) -> int:
        return max(range(len(self.histories)), key=lambda run: len(self.histories[run]))
