"""The smallest model for a volume, and another try where it left out too much."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.camera.camera_model import members_of_depths
from recon.reconstruction.channel import VolumePrior
from recon.reconstruction.decide import choose
from recon.reconstruction.overrides import Wishes
from recon.reconstruction.planes import put_back
from recon.reconstruction.preparation import Field
from recon.reconstruction.selection_run import Reduced, reduce, shown, whole_volume
from recon.reconstruction.volume import grid_of, reconstruct_volume, window_of
from recon.reconstruction.volume_result import VolumeReconstruction
from recon.solvers.stopping import IterationRecord, StopReason
from recon.types import Calibration

Progress = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]

MORE_RUNS = 2
"""Runs with planes put back, at most: the second of them, like any that was told so by the first, has all."""


def reconstruct_chosen_volume(
    measurement: npt.ArrayLike,
    calibration: Calibration,
    *,
    prior: VolumePrior,
    axis_weights: npt.ArrayLike | None,
    estimate_background: bool | None,
    positive_background: bool,
    background: npt.ArrayLike | None,
    erasures: npt.ArrayLike | None,
    noise: NoiseModel | float | None,
    tolerance: float | None,
    time_s: float | None,
    field: Field,
    wishes: Wishes | None,
    callback: Progress | None,
    cancel: threading.Event | None,
    **others: Any,
) -> VolumeReconstruction:
    """Choose, reconstruct what was chosen, and bring it back; parameters as :func:`recon.reconstruct_volume`.

    Where what is left of the data shows light in depths that were left out, these are put back and the volume
    is reconstructed again: once with them and their neighbours, then with all, as far as ``time_s`` allows. A
    last run that still shows signs has its warning. One that was cut short serves only where it came
    further than the one before, by what both minimise; else that one is returned, with its warning.
    """
    wishes = _settled(
        wishes or Wishes(), axis_weights, estimate_background, positive_background, tolerance, field
    )
    choice = choose(
        measurement,
        calibration,
        prior=prior,
        noise=noise,
        background=background,
        erasures=erasures,
        wishes=wishes,
    )
    spent = 0.0
    best: tuple[VolumeReconstruction, Reduced] | None = None
    for left in range(MORE_RUNS, -1, -1):
        small = reduce(
            choice, measurement, calibration, noise=noise, background=background, erasures=erasures
        )

        def tell(
            record: IterationRecord, now: Callable[[], npt.NDArray[np.float32]], small: Any = small
        ) -> None:
            assert callback is not None
            callback(record, shown(small, now))

        result = reconstruct_volume(
            small.measurement,
            small.calibration,
            prior=prior,
            axis_weights=axis_weights,
            model=choice.model,
            estimate_background=choice.background,
            positive_background=positive_background,
            erasures=small.erasures,
            noise=small.noise,
            tolerance=choice.tolerance,
            time_s=None if time_s is None else time_s - spent,
            field=field,
            extent=small.extent,
            precision=choice.precision,
            callback=None if callback is None else tell,
            cancel=cancel,
            **others,
        )
        spent += result.seconds
        if best is None or not _cut_short(result) or _objective(result) < _objective(best[0]):
            best = result, small
        more = put_back(choice, result.provenance.get("light_in_planes_left_out", []), everything=left == 1)
        out_of_time = time_s is not None and spent >= time_s
        if not left or more is None or wishes.planes is not None or out_of_time or _cancelled(result):
            break
        choice = more
    psfs = calibration.psfs
    height, width = np.shape(measurement)[:2]
    window, centre = window_of(field, (height, width), (psfs.shape[2], psfs.shape[3]))
    assert best is not None
    whole = whole_volume(*best, grid_of(calibration, _depths_um(calibration), window, centre))
    return replace(whole, seconds=spent, stop_reasons=result.stop_reasons)


def _settled(
    wishes: Wishes,
    axis_weights: npt.ArrayLike | None,
    estimate_background: bool | None,
    positive_background: bool,
    tolerance: float | None,
    field: Field,
) -> Wishes:
    """Return the wishes with what the other arguments say."""
    if wishes.background is None:
        asked = True if positive_background else estimate_background
        wishes = replace(wishes, background=asked)
    if wishes.tolerance is None:
        wishes = replace(wishes, tolerance=tolerance)
    if field == "full":  # what can reach the sensor is asked for, on its pixels
        wishes = replace(wishes, field="all", binning=1)
    if axis_weights is not None and np.ndim(axis_weights) == 2:  # one row a depth
        wishes = replace(wishes, planes="all", between=False)
    return wishes


def _cancelled(result: VolumeReconstruction) -> bool:
    return StopReason.CANCELLED in result.stop_reasons


def _cut_short(result: VolumeReconstruction) -> bool:
    return StopReason.TIME in result.stop_reasons or _cancelled(result)


def _objective(result: VolumeReconstruction) -> float:
    """Return misfit and prior together, which a run with more planes can only make smaller in the end."""
    return sum(history[-1].objective for history in result.histories)


def _depths_um(calibration: Calibration) -> npt.NDArray[np.float64]:
    positions = calibration.source_positions_um
    return np.array([float(np.mean(positions[g, 2])) for g in members_of_depths(positions)])
