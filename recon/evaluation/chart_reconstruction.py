"""Speed against accuracy: every applicable setting on one problem, scored as it goes.

A run is scored at several counts of iterations on the way, with the time the solver had spent by then
without the scoring. With a ground truth the score is PSNR, SSIM and NRMSE; always also the residual relative
to the noise, and the error on pixels that were held out (:mod:`recon.evaluation.chart_judge`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.evaluation.chart_judge import Judge
from recon.evaluation.scene import Family, make_scene
from recon.evaluation.scored import Aside, Curve, KindName, Point, nothing_aside
from recon.evaluation.trial import Setting, left_out, require_applicable, settings_for
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.reconstruct import reconstruct
from recon.solvers.base import IterationRecord, StopReason
from recon.types import Calibration

__all__ = ["ChartProblem", "Setting", "left_out", "run_setting", "settings_for"]

Array = npt.NDArray[Any]

SCORES = 2
"""Version of how points are scored: those of another one do not compare."""
COUNTS = (3, 5, 10, 20, 40, 80, 160, 320)
"""Iterations at which a run is scored."""


@dataclass(frozen=True)
class ChartProblem:
    """What is reconstructed over and over.

    Attributes
    ----------
    measurement : ndarray, (height, width)
        One channel, counts, background subtracted.
    calibration : Calibration
    volume : bool
        Whether all depths take part; else the calibration holds one depth.
    erasures : ndarray of bool or None
    noise : NoiseModel, float or None
    truth : ndarray or None
        (height, width), or (n_z, height, width).
    """

    measurement: npt.NDArray[np.float32]
    calibration: Calibration
    volume: bool
    erasures: npt.NDArray[np.bool_] | None = None
    noise: NoiseModel | float | None = None
    truth: npt.NDArray[np.float32] | None = None
    kind: KindName = "reconstruction"

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the measurement."""
        return self.measurement.shape

    def settings(self) -> tuple[Setting, ...]:
        """As :func:`settings_for`."""
        return settings_for(self)

    def run(self, setting: Setting, *, limit_s: float | None, aside: Aside) -> Curve:
        """As :func:`run_setting`."""
        return run_setting(self, setting, limit_s=limit_s, aside=aside)

    def warm_up(self, setting: Setting) -> None:
        """Reconstruct a small scene of the same sort once."""
        family: Family = "beads" if self.volume else "sparse-picture"
        scene = make_scene(family, size=16, grid=3, **({"depths": 2} if self.volume else {}))
        small = ChartProblem(scene.measurement, scene.calibration, self.volume)
        run_setting(small, replace(setting, binning=1), counts=(1,))

    def fingerprint(self) -> str:
        """Digest measurement, calibration, erasures, noise and truth."""
        digest = hashlib.sha256(f"scores {SCORES}".encode())
        for array in (self.measurement, self.calibration.psfs, self.calibration.source_positions_um):
            digest.update(np.ascontiguousarray(array).data)
        for part in (self.erasures, self.truth):
            digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
        digest.update(f"{self.volume} {self.noise}".encode())
        return digest.hexdigest()[:16]


def run_setting(
    problem: ChartProblem,
    setting: Setting,
    *,
    limit_s: float | None = None,
    counts: Sequence[int] = COUNTS,
    seed: int = 0,
    aside: Aside = nothing_aside,
) -> Curve:
    """Reconstruct once and score on the way.

    Parameters
    ----------
    limit_s : float, optional
        Wall seconds after which the run stops.
    counts : sequence of int
        Iterations to score at, ascending.
    seed : int
        Of the pixels held out; the same for all settings that are compared.
    aside : Aside
        In which points are scored.

    Raises
    ------
    InputError
        When the setting does not apply to the problem.
    """
    require_applicable(problem, setting)
    judge = Judge(problem, setting, seed)
    points: list[Point] = []

    def note(record: IterationRecord, now: Callable[[], Array]) -> None:
        if record.iteration not in counts:
            return
        with aside():
            points.append(judge.point(now(), record.iteration, record.seconds))

    options = setting.options(
        iterations=counts[-1], time_s=limit_s, tolerance=1e-7, field="full", judged=False
    )
    found = reconstruct(
        Measurement(judge.measurement, erasures=judge.erasures, noise=judge.noise),
        judge.used,
        options,
        on_progress=None if setting.one_step else note,
    )
    if setting.one_step:
        with aside():
            points = [judge.point(found.volume, 0, found.seconds)]
    return Curve(tuple(points), StopReason.TIME not in found.stop_reasons)
