"""The demo's chart: what a few methods cost on its own photograph, against how good they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from instrument.evaluation.chart import ChartData
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.errors import InputError
from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.scored import Point
from recon.evaluation.trial import Setting
from recon.reconstruction.reduction import reduced_calibration
from recon.types import Calibration

if TYPE_CHECKING:
    from calibration_routines.optics.photograph import Photograph

SMALLER = 2
"""Pixels along each side of the picture that the chart has as one: every method in seconds."""
COUNTS = (1, 2, 3, 5, 8, 12, 20, 30, 45)
PRIORS = ("tv", "nonnegative")


def chart_of(
    photo: Photograph,
    calibration: Calibration,
    truth: Float32Array,
    budget_s: float,
    on_progress: Callable[[float], object],
) -> ChartData:
    """Run every solver on a photograph of one depth, binned and not, with a few priors.

    Parameters
    ----------
    photo : Photograph
    calibration : Calibration
        Of one depth.
    truth : ndarray, float32, (height, width)
        The scene as the camera collects it, on the photograph's grid.
    budget_s : float
        Seconds for all settings together, without scoring.
    on_progress : callable
        ``on_progress(share)`` before each.
    """
    problem = ChartProblem(
        block_mean(photo.measurement, SMALLER, about_axis=True),
        reduced_calibration(calibration, SMALLER, None),
        volume=False,
        truth=block_mean(truth, SMALLER, about_axis=True),
    )
    settings = [setting for setting in problem.settings() if _is_shown(setting)]
    points: list[Point] = []
    warm: set[tuple[str, str]] = set()
    failed: dict[str, str] = {}
    for number, setting in enumerate(settings):
        on_progress(number / len(settings))
        try:
            if (setting.solver, setting.prior) not in warm:
                problem.warm_up(setting)
                warm.add((setting.solver, setting.prior))
            points += problem.run(setting, limit_s=budget_s / len(settings), counts=COUNTS).points
        except InputError as error:
            failed[setting.name] = str(error)
    about = {"scene": "the photograph of the demo", "simulated": True, "pixels": list(problem.pixels)}
    return ChartData(problem.kind, about, tuple(points), failed, ())


def _is_shown(setting: Setting) -> bool:
    return (
        setting.is_plain
        and setting.precision == "float32"
        and setting.device == "cpu"
        and setting.prior in PRIORS
        and setting.binning <= 2
    )
