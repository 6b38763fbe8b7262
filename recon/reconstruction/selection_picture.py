"""The smallest model for a picture of one depth."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.checks import as_channels
from recon.base.noise import NoiseModel
from recon.camera.camera_model import one_depth, sort_by_depth
from recon.camera.field_registration import NOT_ON_AXIS, one_psf
from recon.errors import InputError
from recon.reconstruction.channel import PRIORS
from recon.reconstruction.choice import Choice, Decision
from recon.reconstruction.decide import choose
from recon.reconstruction.overrides import Wishes
from recon.reconstruction.picture import reconstruct
from recon.reconstruction.preparation import Field
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection_run import reduce
from recon.reconstruction.solving import steps_of_tolerance
from recon.reconstruction.varying_picture import reconstruct_varying
from recon.solvers.methods import method_named
from recon.solvers.stopping import IterationRecord
from recon.types import Calibration

Progress = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]


def choose_picture(
    measurement: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None = None,
    prior: str = "tv",
    noise: NoiseModel | float | None = None,
    background: npt.ArrayLike | None = None,
    erasures: npt.ArrayLike | None = None,
    wishes: Wishes | None = None,
) -> Choice:
    """Choose what to reconstruct a picture with. Parameters as :func:`recon.reconstruct`."""
    if prior not in PRIORS:
        raise InputError(f"Models are chosen for the priors {', '.join(PRIORS)}, not {prior!r}.")
    depth, _ = _at_depth(calibration, z_um)
    choice = choose(
        measurement,
        depth,
        prior=prior,
        noise=noise,
        background=background,
        erasures=erasures,
        wishes=wishes,
    )
    return _by_plain_admm(choice, depth, wishes or Wishes()) if _is_plain(choice) else choice


def _is_plain(choice: Choice) -> bool:
    """Tell whether the picture's own solver does, which has one PSF and no background."""
    return choice.model == "convolution" and not choice.background


def _by_plain_admm(choice: Choice, depth: Calibration, wishes: Wishes) -> Choice:
    """Return the choice with what the picture's own solver does: the whole field, and its own end."""
    height, width = depth.psfs.shape[2:]
    tolerance = method_named("admm").tolerance if wishes.tolerance is None else wishes.tolerance
    replaced = {
        "field": Decision(
            "field",
            f"{2 * height - 1} x {2 * width - 1} pixels",
            "one convolution of a picture is quick on everything that can reach the sensor",
            overruled=wishes.field is not None,
            numbers={"share_of_largest": 1.0},
        ),
        "iterations": Decision(
            "iterations",
            f"until they change by less than {tolerance:g}",
            "as asked" if wishes.tolerance is not None else "where this solver stops by default",
            0.0,
            *steps_of_tolerance(tolerance),
            overruled=wishes.tolerance is not None,
            numbers={"tolerance": tolerance},
        ),
    }
    return replace(
        choice,
        psf_window=(height, width),
        acceptance_px=None,
        tolerance=tolerance,
        decisions=tuple(replaced.get(d.name, d) for d in choice.decisions),
    )


def reconstruct_chosen(
    measurement: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None,
    prior: str,
    tau: float | None,
    iterations: int | None,
    time_s: float | None,
    tolerance: float | None,
    stop_at_noise: bool,
    noise: NoiseModel | float | None,
    background: npt.ArrayLike | None,
    erasures: npt.ArrayLike | None,
    field: Field,
    wishes: Wishes | None,
    callback: Progress | None,
    cancel: threading.Event | None,
    judged: bool = True,
) -> Reconstruction:
    """Choose, reconstruct what was chosen, and bring it back; parameters as :func:`recon.reconstruct`."""
    wishes = wishes or Wishes()
    if field == "full":  # what can reach the sensor is asked for, on its pixels
        wishes = replace(wishes, field="all", binning=1)
    if wishes.tolerance is None:
        wishes = replace(wishes, tolerance=tolerance)
    depth, warnings = _at_depth(calibration, z_um)
    choice = choose_picture(
        measurement,
        depth,
        prior=prior,
        noise=noise,
        background=background,
        erasures=erasures,
        wishes=wishes,
    )
    if _is_plain(choice):
        # The others say so themselves; that some PSFs were hard to register is of no concern to one.
        warnings += tuple(w for w in sort_by_depth(depth).warnings if w == NOT_ON_AXIS)
    small = reduce(choice, measurement, depth, noise=noise, background=background, erasures=erasures)

    def show(record: IterationRecord, now: Callable[[], npt.NDArray[np.float32]]) -> None:
        assert callback is not None
        callback(record, lambda: small.picture(now()))

    common: dict[str, Any] = {
        "z_um": z_um,
        "prior": prior,
        "tau": tau,
        "iterations": iterations,
        "time_s": time_s,
        "tolerance": choice.tolerance,
        "noise": small.noise,
        "erasures": small.erasures,
        "field": field,
        "callback": None if callback is None else show,
        "cancel": cancel,
        "judged": judged,
        "stop_at_noise": stop_at_noise,
    }
    if _is_plain(choice):
        result = reconstruct(
            small.measurement,
            _central(small.calibration),
            model="convolution",
            precision=choice.precision,
            **common,
        )
    else:
        result = reconstruct_varying(
            small.measurement,
            small.calibration,
            model=choice.model,
            reason=next(d.why for d in choice.decisions if d.name == "model"),
            background=None,
            keeper=None,
            estimate_background=choice.background,
            extent=small.extent,
            precision=choice.precision,
            **common,
        )
    return _whole(result, choice, small.picture(result.image), (*warnings, *small.warnings))


def _whole(
    result: Reconstruction, choice: Choice, image: npt.NDArray[np.float32], warnings: tuple[str, ...]
) -> Reconstruction:
    grid, factor = result.grid, choice.binning
    if factor > 1:
        height, width = image.shape[:2]
        grid = replace(
            grid,
            shape=(height, width),
            centre=(height // 2, width // 2),
            sensor_pitch_um=None if grid.sensor_pitch_um is None else grid.sensor_pitch_um / factor,
            object_pitch_um=None if grid.object_pitch_um is None else grid.object_pitch_um / factor,
        )
    why = next(d.why for d in choice.decisions if d.name == "model")
    return replace(
        result,
        image=image,
        grid=grid,
        warnings=tuple(dict.fromkeys((*warnings, *result.warnings))),
        # Only a state on the measurement's own pixels and channels can start another run.
        state=None if factor > 1 or choice.merged else result.state,
        choice=choice,
        provenance={
            **result.provenance,
            "model": choice.model,
            "model_reason": why,
            "auto": choice.to_json(),
        },
    )


def _at_depth(
    calibration: Calibration | npt.ArrayLike, z_um: float | None
) -> tuple[Calibration, tuple[str, ...]]:
    """Return the PSFs of one depth, and warnings: the central one alone where they cannot be registered."""
    if not isinstance(calibration, Calibration):
        psfs = as_channels(calibration, "PSF")
        return Calibration(np.asarray(psfs, np.float32)[None], np.full((1, 3), np.nan)), ()
    depth = one_depth(calibration, z_um)
    try:
        sort_by_depth(depth)
    except InputError as error:
        return _central(depth), (f"One PSF for the whole field: {error}",)
    return depth, ()


def _central(calibration: Calibration) -> Calibration:
    """Return one PSF for the whole field: the one on the axis."""
    positions = calibration.source_positions_um
    nearest = int(np.argmin(np.nan_to_num(np.hypot(positions[:, 0], positions[:, 1]))))
    own = slice(nearest, nearest + 1)
    return replace(calibration, psfs=one_psf(calibration)[None], source_positions_um=positions[own])
