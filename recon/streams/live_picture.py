"""Live pictures: how they are asked for, what each is worth, and what makes them at one resolution."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from recon.arrays import Float32Array
from recon.base.declare import option, require
from recon.errors import InputError
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers.wiener_filter import WienerFilter, cross_validated
from recon.streams.detail import Detail
from recon.streams.stillness import SceneState, has_light
from recon.streams.video import VideoSolver

SETTLED = 1e-3
"""Change an iteration below which a frame's picture is done, or the solver's own where that is smaller: 55 dB
from where the exact-data ADMM would end."""

NOISE_ONLY = "Noise only, no light of a scene"
"""Doubt of a picture whose frames hold nothing else."""

DARK = "Dark, nothing was lit: no picture is made"
"""Doubt of the black picture of a frame that was taken with nothing lit and holds noise only."""

UNLIT = "Nothing was lit, and nothing in the frame is the calibration's pattern: no picture is made"
"""Doubt of the black picture of such a frame: what a dark frame was not, once many are averaged."""

UNLIT_SO_FAR = "Nothing was lit, as far as is known: whether there is light all the same is being found out"
"""Doubt of the black picture of such a frame until the calibration was held against it."""

_LIVE = "Live pictures"
_MODELS = {"convolution": "", "local": "local model", "lowrank": "low rank"}


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """How live pictures keep pace with a camera."""

    budget_ms: float = option(
        33.0,
        help="Time for one picture: pixels, depths and iterations give way to it.",
        unit="ms",
        above=0,
        group=_LIVE,
    )
    finest: int = option(1, help="Least binning.", least=1, group=_LIVE)
    coarsest: int = option(8, help="Largest binning.", least=1, group=_LIVE)
    average: int = option(
        8,
        help="Frames averaged at most while the scene is still.",
        least=1,
        label="Frames averaged",
        group=_LIVE,
    )
    plane: int | None = option(
        None,
        help="Of several depths the one that is shown, the nearest is 0.",
        default_words="the brightest of all",
        least=0,
        label="Depth shown",
        group=_LIVE,
    )

    def __post_init__(self) -> None:
        """Raise InputError that names all mistakes at once."""
        require(self)
        if self.finest > self.coarsest:
            raise InputError(
                f"1 <= finest <= coarsest is expected; got finest {self.finest}, coarsest {self.coarsest}."
            )


@dataclass(frozen=True, slots=True)
class LivePicture:
    """A picture, and what it is worth."""

    image: Float32Array
    """(height, width) or (height, width, n_channels): the part of the scene opposite to the sensor, on pixels
    binned ``binning x binning``; brightness does not depend on the binning."""
    binning: int
    method: str
    """The solver that made it; ``"wiener"`` for a filter, which is of one depth and one PSF; empty for a dark
    frame's black picture."""
    iterations: int
    """Done for this picture; 0 for ``"wiener"``."""
    total_iterations: int
    """Since the solver last began anew; what it knew of the scene before a movement stays with it."""
    scene: SceneState
    """Whether the scene is new, moving or still."""
    frames: int
    """Frames averaged; 1 unless the scene is still."""
    settled: bool
    """Whether further iterations on these frames would change nothing that can be seen."""
    work_ms: float
    """Time that the picture took."""
    budget_ms: float
    """Time that it was allowed."""
    volume: Float32Array | None = None
    """(n_z, height, width[, n_channels]): the depths ``planes``, where several are reconstructed; None for a
    filter's picture."""
    planes: tuple[int, ...] = (0,)
    """Depths of the calibration that were reconstructed, the nearest is 0: all, or fewer in short time."""
    shown: str = ""
    """Which of several depths ``image`` shows, in words."""
    camera: str = ""
    """What besides one PSF a depth on all pixels made it, in words: ``"local model, background"``."""
    doubt: str = ""
    """Why this is no picture of the scene, in words; empty where nothing speaks against it."""
    awaited: str = ""
    """That the calibration is not judged yet, in words; empty once it was, and where there is a doubt."""

    @property
    def quality(self) -> str:
        """What the picture is worth, in words: ``"binned 2 x 2, 3 iterations (41 in all), moving"``.

        A doubt comes first, or that nothing is known of the calibration yet.
        """
        pixels = "all pixels" if self.binning == 1 else f"binned {self.binning} x {self.binning}"
        many = "" if self.iterations == 1 else "s"
        steps = f"{self.iterations} iteration{many} ({self.total_iterations} in all)"
        if not self.method:
            return self.doubt
        how = "Wiener filter" if self.method == "wiener" else steps
        scene = f"still, {self.frames} frames averaged" if self.frames > 1 else str(self.scene)
        settled = "settled" if self.settled else ""
        worth = ", ".join(filter(None, (pixels, self.shown, self.camera, how, scene, settled)))
        return ": ".join(filter(None, (self.said, worth)))

    @property
    def said(self) -> str:
        """What is doubted, or not known yet; empty where nothing speaks against the picture."""
        return self.doubt or self.awaited


@dataclass(frozen=True)
class Level:
    """Live pictures of some pixels and planes.

    Brightness does not depend on the binning: one binned pixel holds the light of all its pixels.
    """

    problem: Problem
    """Of a first frame on binned pixels and these planes, which settles noise, scales and weights."""
    detail: Detail
    """Pixels and planes."""
    whole: Problem
    """Of the same frame and every plane: what the calibration is judged by."""
    preview: Part
    """Of the same frame through one PSF, without a background: what the filter is for."""
    filter: WienerFilter
    lit: bool
    """Whether that frame held light: what was settled on noise serves no scene."""
    solver: VideoSolver | None = None
    """None until it was made: a filter is made in a moment, for the first picture."""

    @classmethod
    def of(cls, problem: Problem, detail: Detail, whole: Problem, plane: int) -> Level:
        """Return a level without a solver, whose filter is for one of its depths."""
        plain = problem if problem.together else _preview(problem, plane)
        part = Part(plain, slice(0, plain.n_channels))
        operator = part.picture_operator
        wiener = WienerFilter(operator, cross_validated(operator, part.data))
        return cls(problem, detail, whole, part, wiener, has_light(_filled(problem), problem.noise))

    def sees_light(self, frame: Float32Array, count: int) -> bool:
        """Tell whether the mean of ``count`` frames, shaped as those that came, holds more than noise."""
        seen = self.problem.with_data(frame)
        return has_light(_filled(seen), self.problem.noise / np.float32(count) ** 0.5)

    @property
    def binning(self) -> int:
        """Pixels averaged along each axis."""
        return self.detail.binning

    def camera(self, *, filtered: bool, varies: bool) -> str:
        """Say which camera made a picture of the solver's, or of the filter's, where it is no plain one.

        ``varies``: whether there are several PSFs of a depth.
        """
        problem = self.preview.problem if filtered else self.problem
        model = _MODELS.get(problem.model, problem.model)
        if varies and not model:
            model = "one PSF for all of the field"
        erased = f"{1 - problem.valid.mean():.1%} of the pixels left out" if not problem.valid.all() else ""
        return ", ".join(filter(None, (model, "background" if problem.smooth else "", erased)))

    @cached_property
    def method(self) -> str:
        """The solver's name."""
        return self.problem.solver.name

    @cached_property
    def tolerance(self) -> float:
        """Change an iteration below which a frame's picture is done."""
        return min(SETTLED, self.problem.stop_tolerance)

    def solving(self) -> Level:
        """Return the level with a solver that has found memory and threads, at a picture's cost."""
        shared = self.preview.problem is self.problem
        solver = VideoSolver(self.problem, parts=[self.preview] if shared else None)
        try:
            solver.take(np.asarray(self.problem.measurement.image, np.float32))
            solver.advance(0.0)
        except BaseException:
            solver.close()
            raise
        solver.begin()
        return replace(self, solver=solver)

    def filtered(self, frame: Float32Array) -> Float32Array:
        """Return Wiener's picture, (1, height, width[, n_channels]), of a frame on binned pixels."""
        plain = self.preview.problem
        light = np.maximum(self.filter(plain.with_data(frame).data), 0)
        volume = plain.measured(self.preview.lifted(light), self.preview.channels)
        return plain.whole([volume]) / np.float32(self.binning**2)

    def solved(self) -> Float32Array:
        """Return what the solver has at present, (n_z, height, width[, n_channels])."""
        assert self.solver is not None
        return self.solver.volume() / np.float32(self.binning**2)


def _filled(problem: Problem) -> Float32Array:
    """Return a problem's frame in counts, (height, width, n_channels), the mean where pixels are erased."""
    data, valid = problem.data * problem.noise[:, None, None], problem.valid
    if not valid.all():
        mean = np.sum(data, axis=(1, 2), keepdims=True) / np.sum(valid, axis=(1, 2), keepdims=True)
        data = np.where(valid, data, mean.astype(np.float32))
    return np.moveaxis(data, 0, -1)


def _preview(problem: Problem, plane: int) -> Problem:
    """Return a problem with one depth's central PSF for everything."""
    options = ReconstructionOptions(solver="wiener", prior="none", field=problem.options.field)
    psf = np.moveaxis(problem.depths.central[plane], 0, -1)
    return Problem.of(problem.measurement, psf, options)


class ComingLevel:
    """A level being made in a thread of its own, while pictures go on at the one before."""

    def __init__(self, detail: Detail, make: Callable[[], Level]) -> None:
        self.detail = detail
        pool = ThreadPoolExecutor(1, "live level")
        self._made = pool.submit(make)
        pool.shutdown(wait=False)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the level is made, or the time is over; return whether it is made."""
        wait((self._made,), timeout_s)
        return self._made.done()

    def result(self) -> Level:
        """Return the level; waits for it, and raises what went wrong with it."""
        return self._made.result()
