"""Frames of one camera one after the other, each from where the one before ended: videos, and live pictures.

A warm start keeps the object, its dual variables and the penalties, so that a frame that differs little from
the one before needs few iterations. It makes a frame depend on those before it, back to the last cold start.
So that the result does not depend on who computes what, a video is cut into blocks of a fixed length, and
each block begins cold: the same block gives the same pictures in any process, but for the order in which BLAS
adds up (1e-6 of the brightest pixel).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array
from recon.base.threads import linear_algebra_on_one_thread
from recon.camera.camera_model import Extent, choose_model
from recon.camera.refocus_field import at_depth
from recon.errors import InputError
from recon.reconstruction.first_look import look_at
from recon.reconstruction.measurement import Measurement, depths_of
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import given, require_two_images
from recon.reconstruction.selection import choice_for, with_background
from recon.reconstruction.solvers import SOLVERS, OfferedSolver
from recon.solvers.base import Solver, StoppingRules
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.splitting import VolumeSplitting
from recon.streams.motion import Panning
from recon.types import Calibration

COLD_ITERATIONS, WARM_ITERATIONS = 20, 4
"""Iterations of a block's first frame and of the others: as good as independent frames at their best where
the scene stands, and near it where it moves by less than a pixel a frame (docs/benchmarks/video.md)."""
BLOCK = 32
"""Frames a block: its cold start is then a seventh of the work."""
SETTLED = 2e-4
"""Change an iteration below which a video's frame is done before its iterations are."""


LOOKED_AT = 5
"""Frames of a film, evenly over it, whose mean ``auto`` chooses by."""


def stream_problem(
    frame: Measurement | npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions | None = None,
    *,
    choosing: bool = True,
    others: Sequence[Float32Array] = (),
    extent: Extent | None = None,
    **overrides: Any,
) -> Problem:
    """Settle noise, scales and camera from one frame, for all frames of a video.

    Raises InputError when the input is unusable, or no solver has a way for it.

    Parameters
    ----------
    frame : Measurement or array, (height, width[, n_channels])
        Background subtracted. A bright one, where the video has brighter and darker ones.
    options : ReconstructionOptions, optional
        Any camera model, prior, background and depths. ``"auto"`` is the model that the frames' mean asks
        for; without ``choosing`` one PSF a depth, as the quickest (the problem's warnings say where PSFs
        differ over the field). The exact-data ADMM is taken where that has a way.
    choosing : bool
        Whether a camera model, and a smooth background where a photograph would have one, are chosen unless
        the options say.
    others : sequence of ndarray, as ``frame``
        More frames of the video for ``auto`` to look at.
    extent : Extent, optional
        How much of PSFs and field is modelled, where that was chosen before.
    **overrides
        Single options, and facts about the frame, by their names, as of :func:`recon.reconstruct`.
    """
    known, options = given(overrides, options)
    measurement = frame if isinstance(frame, Measurement) else Measurement(frame)
    measurement = replace(measurement, **known)
    doubt, reason, chosen = "", "", False
    wishes = options.choose or Overrides()
    if wishes != Overrides(field=wishes.field):
        raise InputError(
            "Of the choices only field=all is for films: they keep all depths, pixels and channels; --model "
            "and --background say the rest."
        )
    if options.z_um is not None and isinstance(calibration, Calibration):
        calibration, _ = at_depth(calibration, options.z_um)
    if options.model == "auto":
        doubt, reason = _by_one_psf(calibration, options)
        if doubt and choosing and isinstance(calibration, Calibration):
            options, extent, reason, doubt = _chosen(measurement, others, calibration, options)
            chosen = True
        else:
            options = replace(options, model="convolution", choose=None)
    problem = Problem.of(measurement, calibration, options, extent=extent)
    if choosing and not chosen:
        require_two_images(problem)
        if isinstance(calibration, Calibration):
            problem = with_background(problem, calibration, restoring=False)
    if doubt:
        problem = replace(problem, warnings=(*problem.warnings, doubt))
    if reason:
        problem = replace(problem, reason=reason)
    if options.solver == "auto" and SOLVERS["admm-sensor"].accepts(problem) is None:
        problem = replace(problem, options=replace(options, solver="admm-sensor"))
    problem.solver  # noqa: B018 - refuses at once what it has no way for
    return problem


def _chosen(
    frame: Measurement,
    others: Sequence[Float32Array],
    calibration: Calibration,
    options: ReconstructionOptions,
) -> tuple[ReconstructionOptions, Extent | None, str, str]:
    """Choose camera model, background and field for a film by the mean of several of its frames.

    Depths, pixels and channels stay: something may come to be where nothing is in these frames. Returns the
    options, the extent, why that model, and what else is to be said.
    """
    mean = replace(frame, image=np.mean([np.asarray(frame.image), *others], axis=0, dtype=np.float32))
    if mean.noise is None and mean.flat:  # as noisy as one frame: that is what is solved
        mean = replace(mean, noise=float(frame.deviations(frame.counts())[0]))
    asked = replace(
        options.choose or Overrides(),
        planes="all", between=False, beyond=False, binning=1, channels="all",
    )  # fmt: skip
    posed = Problem.of(mean, calibration, replace(options, choose=asked))
    require_two_images(posed)
    choice = choice_for(posed, film=True)
    extent = None
    if choice.model != "convolution":
        extent = Extent(choice.psf_window, choice.acceptance_px, choice.margin)
    why = {d.name: d.why for d in choice.decisions}
    reason = f"by the mean of {len(others) + 1} frames: {why['model']}"
    if choice.margin is not None:
        reason += f"; the object lies where PSFs were measured: {why['field']}"
    said = ""
    if choice.background and options.estimate_background is None:
        said = f"A smooth background is estimated as well: {why['background']}."
    settled = replace(options, model=choice.model, estimate_background=choice.background, choose=None)
    return settled, extent, reason, said


def _by_one_psf(calibration: Calibration | npt.ArrayLike, options: ReconstructionOptions) -> tuple[str, str]:
    """Say what one PSF for the whole field does not tell of a calibration, and why it is taken.

    The first is empty where it tells enough.
    """
    if not isinstance(calibration, Calibration) or len(calibration.psfs) == 1:
        return "", "there is one PSF"
    model, why = choose_model(depths_of(calibration, options)[1], "auto")
    if model == "convolution":
        return "", why
    doubt = (
        f"One PSF serves the whole field, as is quickest: {why}. "
        f"--model {model} takes all of them, in several times the time."
    )
    return doubt, "one PSF a depth, as is quickest"


class VideoSolver:
    """Solves frame after frame of one camera; for one thread. Close it, or use it as a context manager.

    Whatever camera, background, erasures and depths the problem has, each frame goes on from the one before,
    with all that an iteration builds on (object, dual variables, penalties). Splittings whose data term is
    solved exactly take new data in the memory that they have, and move what they have with a scene that moves
    as a whole; other solvers are made anew for each frame, which costs what their making costs.

    Raises InputError when the solver has no iterations, or no way for the problem.

    Parameters
    ----------
    problem : Problem
        Of :func:`stream_problem`: a first frame settles noise, scales and the prior's weight.
    cold_iterations, warm_iterations : int
        Of the first frame after :meth:`begin`, and of each after it.
    parts : list of Part, optional
        The problem's, where they are there already.
    times_noise : float, optional
        The prior's weight, of :func:`weight_of`, where that is known already.

    Attributes
    ----------
    iterations : int
        Since the last frame that began from zero.
    """

    @linear_algebra_on_one_thread()
    def __init__(
        self,
        problem: Problem,
        *,
        cold_iterations: int = COLD_ITERATIONS,
        warm_iterations: int = WARM_ITERATIONS,
        parts: list[Part] | None = None,
        times_noise: float | None = None,
    ) -> None:
        if min(cold_iterations, warm_iterations) < 1:
            raise InputError(
                f"Every frame needs an iteration; got {cold_iterations} cold and {warm_iterations} warm ones."
            )
        self.cold_iterations, self.warm_iterations = cold_iterations, warm_iterations
        self._offered = require_steps(problem)
        self._first = self.problem = problem
        self.parts = parts or [Part(problem, channels) for channels in parts_of(problem)]
        times_noise = weight_of(problem) if times_noise is None else times_noise
        for part in self.parts:
            part.weigh(problem.options.tau, times_noise)
        self.solvers: list[Any] = [None for _ in self.parts]
        self.iterations = self._calm = 0
        self._cold = True
        self._panning = Panning()

    def close(self) -> None:
        """Remove what the solvers kept on disk; nothing can be solved afterwards."""
        self.solvers = [None for _ in self.parts]
        for part in self.parts:
            part.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def weights(self) -> list[float]:
        """The prior's weight in the scaled problem, one a part."""
        return [part.weight for part in self.parts]

    # Frames ------------------------------------------------------------------------------------------
    def begin(self) -> None:
        """Forget the frames before: the next one starts cold."""
        self._cold = True

    def next(self, frame: Float32Array) -> Float32Array:
        """Return the picture (height, width[, n_channels]) of the next frame; of several depths the volume.

        Parameters
        ----------
        frame : ndarray, float32, (height, width[, n_channels])
            Background subtracted, on the PSF's pixels.
        """
        count = self.cold_iterations if self._cold else self.warm_iterations
        self.take(frame)
        for _ in range(2):
            for _ in range(count):
                if self.advance(SETTLED):
                    break
            if self.confirm():
                break
        return self.picture()

    @linear_algebra_on_one_thread()
    def take(self, frame: Float32Array) -> None:
        """Take a frame as of :meth:`next`, to be iterated by :meth:`advance`."""
        self.problem = self._first.with_data(frame)
        if self._cold:
            self._panning.forget()
        by = self._panning.next(self.problem.data, self.problem.valid)
        for place, (part, solver) in enumerate(zip(self.parts, self.solvers, strict=True)):
            part.set_data(self.problem)
            if any(by) and isinstance(solver, Solver):
                solver.move(*by)
            if isinstance(solver, SensorAdmm):
                (solver.restart if self._cold else solver.set_data)(part.data)
            elif isinstance(solver, VolumeSplitting) and not self._cold:
                solver.set_data(part.sensor_data)
            else:
                self.solvers[place] = self._renewed(part, solver)
        self.iterations = 0 if self._cold else self.iterations
        self._calm, self._cold = 0, False

    def advance(self, settled: float) -> bool:
        """Do one iteration of every part; return whether changes stay below ``settled``.

        Other solvers than a picture's may not move at all in their first iterations: theirs must be calm for
        several in a row, and what does not move at all has not come to rest.
        """
        change = max(float(solver.advance().change) for solver in self.solvers)
        self.iterations += 1
        kept = all(isinstance(solver, SensorAdmm) for solver in self.solvers)
        self._calm = self._calm + 1 if change < settled and (kept or change > 0) else 0
        return self._calm >= (1 if kept else StoppingRules().patience)

    def confirm(self) -> bool:
        """Let depths that were left out as empty take part again where this frame has light there.

        Returns whether there were none.
        """
        missing = [s for s in self.solvers if isinstance(s, Solver) and not s.confirm()]
        self._calm = 0 if missing else self._calm
        return not missing

    def volume(self) -> Float32Array:
        """Return what there is of the newest frame, (n_z, height, width[, n_channels]), measurement units."""
        return self.problem.whole(
            [
                self.problem.measured(part.lifted(solver.solution), part.channels)
                for part, solver in zip(self.parts, self.solvers, strict=True)
            ]
        )

    def picture(self) -> Float32Array:
        """Return the same; of one depth its picture."""
        volume = self.volume()
        return volume[0] if self.problem.n_planes == 1 else volume

    # Solvers -----------------------------------------------------------------------------------------
    def _renewed(self, part: Part, before: Any) -> Any:
        """Return a solver of a part's new data; unless it begins cold, with all that the one before knew."""
        remove = part.storage.turn()
        if self._cold or before is None:
            solver = self._made(part, None)
        elif isinstance(before, Solver) and before.state_names:
            solver = self._made(part, None)
            solver.restore(before.checkpoint(copy=False))
        else:
            solver = self._made(part, np.array(part.lifted(before.solution)))
        remove()
        return solver

    def _made(self, part: Part, start: Any) -> Any:
        solver = self._offered.make(part, start)
        if not hasattr(solver, "advance"):
            raise InputError(f"{self._offered.name} cannot be halted after each iteration: take another.")
        if isinstance(solver, Solver):
            solver.compile()
        return solver


def weight_of(problem: Problem) -> float | None:
    """Return the prior's weight in units of the noise, by a first look at a problem; None for the table's."""
    look = look_at(problem)
    return None if look is None else look.weight(problem.prior_name)


def require_steps(problem: Problem) -> OfferedSolver:
    """Return a problem's solver; InputError where it has no iterations to go on with."""
    if problem.solver.one_step:
        raise InputError(f"{problem.solver.name} has no iterations to go on with: take another solver.")
    return problem.solver
