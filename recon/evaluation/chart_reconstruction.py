"""Speed against accuracy: every applicable setting on one problem, scored as it goes.

A run is scored at several counts of iterations on the way, with the time the solver had spent by then
without the scoring. With a ground truth the score is PSNR, SSIM and NRMSE; always also the residual relative
to the noise, and the error on pixels that were held out (:mod:`recon.evaluation.chart_judge`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import product

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array
from recon.base.namespace import Device, array_namespace
from recon.base.noise import NoiseModel
from recon.camera.camera_model import CAMERAS, MODELS, members_of_depths
from recon.errors import InputError
from recon.evaluation.chart_judge import Judge
from recon.evaluation.scene import TestScene, make_scene
from recon.evaluation.scored import Aside, Curve, Point
from recon.evaluation.trial import Setting, Subject
from recon.priors import PRIORS
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import PRECISIONS, ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord, StopReason
from recon.types import Calibration

SCORES = 2
"""Version of how points are scored: those of another one do not compare."""
COUNTS = (3, 5, 10, 20, 40, 80, 160, 320)
"""Iterations at which a run is scored."""


@dataclass(frozen=True, eq=False)
class ChartProblem(Subject[Setting]):
    """What is reconstructed over and over."""

    kind = "reconstruction"

    measurement: Float32Array
    """(height, width): one channel, counts, background subtracted."""
    calibration: Calibration
    volume: bool
    """Whether all depths take part; else the calibration holds one depth."""
    erasures: BoolArray | None = None
    noise: NoiseModel | float | None = None
    truth: Float32Array | None = None
    """(height, width), or (n_z, height, width)."""

    @classmethod
    def of_scene(cls, scene: TestScene) -> ChartProblem:
        """Return a test scene to chart on, with its truth."""
        volume = not scene.spec.is_picture
        return cls(scene.measurement, scene.calibration, volume, scene.erasures, scene.noise, scene.truth)

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the measurement."""
        return self.measurement.shape

    @property
    def binnings(self) -> list[int]:
        """Those that leave enough pixels; erased ones cannot be averaged with others."""
        return [1, *(b for b in (2, 4) if max(self.pixels) // b >= 24 and self.erasures is None)]

    def settings(self) -> tuple[Setting, ...]:
        """Return every applicable setting, the quick ones first; which are not, and why: :meth:`left_out`."""
        return _settings_for(self)

    def left_out(self) -> tuple[str, ...]:
        """Say which settings are not applicable, and why."""
        asked = _asked(self)
        found = []
        for solver in SOLVERS:
            taken, who = list(PRIORS), solver
            for background in (False, True):
                refused: dict[str, list[str]] = {}
                for prior in taken:
                    setting = Setting(solver, "convolution", prior, background=background)
                    if (reason := setting.refusal(asked)) is not None:
                        refused.setdefault(reason, []).append(prior)
                for reason, priors in refused.items():
                    only = "" if priors == taken else f" with {', '.join(priors)}"
                    found.append(f"{who}{only}: {reason}")
                taken = [prior for prior in taken if not any(prior in p for p in refused.values())]
                who = f"{solver} beside a background"
        if not _varies(self):
            found.append("the local and low-rank models: the calibration has one PSF a depth")
        for camera in CAMERAS.values():
            if (reason := camera.refuses(asked.depths)) is not None:
                found.append(f"the {camera.name} model: {reason}")
        if self.binnings == [1]:
            small = self.erasures is None
            why = "too few pixels would be left" if small else "erased pixels cannot be averaged"
            found.append(f"binning: {why}")
        if not _has_gpu():
            found.append("the gpu: there is none that CuPy can use")
        return tuple(found)

    def _curve(
        self,
        setting: Setting,
        limit_s: float | None,
        aside: Aside,
        *,
        counts: Sequence[int] = COUNTS,
        seed: int = 0,
    ) -> Curve:
        """Reconstruct once and score on the way; ``seed`` is that of the pixels held out."""
        judge = Judge(self, setting, seed)
        points: list[Point] = []

        def note(record: IterationRecord, now: Callable[[], Array]) -> None:
            if record.iteration in counts:
                with aside():
                    points.append(judge.point(now(), record.iteration, record.seconds))

        found = reconstruct(
            Measurement(judge.measurement, erasures=judge.erasures, noise=judge.noise),
            judge.used,
            setting.options(
                iterations=counts[-1], time_s=limit_s, tolerance=1e-7, field="full", judged=False
            ),
            on_progress=None if setting.one_step else note,
        )
        if setting.one_step:
            with aside():
                points = [judge.point(found.volume, 0, found.seconds)]
        return Curve(tuple(points), StopReason.TIME not in found.stop_reasons)

    def warm_up(self, setting: Setting) -> None:
        """Reconstruct a small scene of the same sort once."""
        small = (
            make_scene("beads", size=16, grid=3, depths=2)
            if self.volume
            else make_scene("sparse-picture", size=16, grid=3)
        )
        problem = ChartProblem(small.measurement, small.calibration, self.volume)
        problem.run(replace(setting, binning=1), counts=(1,))

    def _identity(self) -> Iterator[str | Array | None]:
        yield from (f"scores {SCORES}", self.measurement)
        yield from (self.calibration.psfs, self.calibration.source_positions_um)
        yield from (self.erasures, self.truth, f"{self.volume} {self.noise}")


@lru_cache(maxsize=2)
def _settings_for(problem: ChartProblem) -> tuple[Setting, ...]:
    asked = _asked(problem)
    own = [m for m in MODELS if m != "auto" and (_varies(problem) or m == "convolution")]
    devices: list[Device] = ["cpu", "gpu"] if _has_gpu() else ["cpu"]
    ways = product(SOLVERS, (*own, *CAMERAS), PRIORS, (1,), (False, True), PRECISIONS[:1], devices)
    taken = [setting for setting in (Setting(*way) for way in ways) if setting.refusal(asked) is None]
    # No solver refuses a binning or a precision: each is asked once for all of them.
    finer = product(taken, problem.binnings, PRECISIONS)
    found = (replace(setting, binning=factor, precision=precision) for setting, factor, precision in finer)
    return tuple(sorted(found, key=lambda setting: setting.cost(volume=problem.volume)))


@lru_cache(maxsize=2)
def _asked(problem: ChartProblem) -> Problem:
    """Return the problem that solvers are asked about: with pixels held out, as every run has them."""
    calibration = problem.calibration
    if not problem.volume:
        calibration = calibration.part(members_of_depths(calibration.source_positions_um)[0][:1])
    erasures = np.zeros(problem.pixels, bool) if problem.erasures is None else problem.erasures.copy()
    erasures[np.unravel_index(erasures.argmin(), erasures.shape)] = True
    measurement = Measurement(problem.measurement, erasures=erasures, noise=problem.noise)
    return Problem.of(measurement, calibration, ReconstructionOptions(model="convolution"))


def _varies(problem: ChartProblem) -> bool:
    positions = problem.calibration.source_positions_um
    return len(positions) > len(members_of_depths(positions))


@cache
def _has_gpu() -> bool:
    try:
        array_namespace("gpu")
    except InputError:
        return False
    return True
