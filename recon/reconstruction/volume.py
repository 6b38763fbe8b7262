"""One call from a measurement and a calibration to a volume, with defaults that need no tuning."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recon.base.checks import check_psf
from recon.base.namespace import Device
from recon.base.noise import NoiseModel
from recon.base.options import require_options
from recon.camera.camera_model import Extent, ModelName, choose_model, sort_by_depth
from recon.camera.light import energies, levelled
from recon.camera.local_convolution import field_of
from recon.errors import InputError
from recon.reconstruction.channel import PRIORS, ChannelProblem, Scaled, VolumePrior
from recon.reconstruction.positive_background import in_turns, is_negative, may_go_on
from recon.reconstruction.preparation import (
    Field,
    Precision,
    channel_noise,
    data_of,
    require_precision,
    require_same_pixels,
)
from recon.reconstruction.unmodelled_planes import limit_of, signs_in_words, signs_of_light
from recon.reconstruction.volume_result import VolumeGrid, VolumeReconstruction
from recon.solvers import Outcome, Solver, StoppingRules
from recon.solvers.base import Keeper
from recon.solvers.douglas_rachford import DouglasRachford
from recon.solvers.empty_planes import EmptyPlanes
from recon.solvers.stopping import IterationRecord
from recon.types import Calibration
from recon.verdict.collect import evidence_of, not_judged, unsettled_by
from recon.verdict.judge import method_name, verdict_on
from recon.verdict.verdict import Verdict

if TYPE_CHECKING:
    from recon.reconstruction.overrides import Wishes

Array = npt.NDArray[Any]
Progress = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]


def reconstruct_volume(
    measurement: npt.ArrayLike,
    calibration: Calibration,
    *,
    prior: VolumePrior = "tv",
    tau: float | None = None,
    axis_weights: npt.ArrayLike | None = None,
    model: ModelName = "auto",
    estimate_background: bool | None = None,
    positive_background: bool = False,
    background: npt.ArrayLike | None = None,
    erasures: npt.ArrayLike | None = None,
    noise: NoiseModel | float | None = None,
    iterations: int | None = None,
    time_s: float | None = None,
    stop_at_noise: bool = False,
    tolerance: float | None = None,
    drop_empty: bool = True,
    field: Field = "sensor",
    initial: VolumeReconstruction | None = None,
    memory_gib: float | None = None,
    scratch: Path | str | None = None,
    device: Device = "cpu",
    extent: Extent | None = None,
    wishes: Wishes | None = None,
    callback: Progress | None = None,
    cancel: threading.Event | None = None,
    judged: bool = True,
    keeper: Keeper | None = None,
    precision: Precision = "float32",
) -> VolumeReconstruction:
    """Reconstruct a volume from one measurement (Kuo 2020, Eq. 4.2; with a background Eq. 6.2).

    Parameters
    ----------
    measurement : array, (height, width) or (height, width, n_channels)
        Any real dtype, any exposure. Background already subtracted, given as ``background``, or estimated.
    calibration : Calibration
        One PSF a depth, or several over the field at each depth.
    prior : str
        ``"tv"`` for extended objects, ``"tv-isotropic"``, ``"l1"`` for sparse and fluorescent ones,
        ``"nonnegative"``. All include non-negativity.
    tau : float, optional
        Weight of the prior relative to ``max |A^H b|``. Default: from the noise.
    axis_weights : array, (3,) or (n_z, 3), optional
        Weights of the z, y and x differences of TV. Default: by the voxels' shape where the geometry is known
        (:meth:`~recon.reconstruction.volume_result.VolumeGrid.axis_weights`), else 1.
    model : str
        ``"convolution"``, ``"local"`` or ``"lowrank"`` (Kuo 2020, Ch. 5); or ``"auto"``: the smallest model,
        depths, field, binning and colours that explain the data (:func:`recon.reconstruction.decide`). The
        result is on the measurement's pixels and all calibrated depths whatever was chosen; ``choice`` says
        what and why. With a start, a keeper, an extent, another device, a memory limit or a scratch folder,
        only the model is chosen.
    estimate_background : bool, optional
        Estimate a smooth background as well (Eq. 6.2). Default: with ``"auto"`` where the data show one, else
        unless ``background`` is given. Stray light that the model cannot explain otherwise ends up as haze in
        the outermost planes.
    positive_background : bool
        Where the estimated background comes out negative, improve volume and a background ``>= 0`` in turn:
        up to three runs more, each with ``iterations`` of its own.
    background, erasures, noise
        As :func:`recon.reconstruct`.
    iterations, time_s, tolerance : optional
        When to stop, whichever comes first. Without ``iterations`` and ``time_s``: 200 iterations. ``time_s``
        is shared evenly by the channels. Default tolerance: 1e-3; ``"auto"`` sets it by the model.
    stop_at_noise : bool
        Also stop as soon as a channel's residual is down to the expected noise.
    drop_empty : bool
        With l1: leave out depth planes that stay empty, and certify it (see ``empty_planes`` of the result).
    field : "sensor" or "full"
        Return the part opposite to the sensor, or everything that can reach it.
    initial : VolumeReconstruction, optional
        Start from this one: same calibration, same ``field``.
    memory_gib : float, optional
        How much memory may be taken; default what is free.
    scratch : path, optional
        Folder on a fast disk for what does not fit into memory. Without it a volume too large is refused.
    device : "cpu" or "gpu"
        Where to compute. The GPU needs CuPy (``pip install "diffuserbench[gpu]"``), about three times the
        memory that the CPU takes, and the convolution model.
    extent : Extent, optional
        How much of the PSFs and of the field to model; default all.
    wishes : recon.reconstruction.overrides.Wishes, optional
        With ``"auto"``: choices that are not to be left to the program. Refused where not all is chosen.
    callback : callable, optional
        ``callback(record, volume)`` after each iteration; ``volume()`` makes the present one, and may be
        called until ``callback`` returns.
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    judged : bool
        Say whether the result can be trusted (``verdict``).
    keeper : Keeper, optional
        Keeps the solvers' state, a part a channel, and has them go on from what was kept of the same
        reconstruction. Turns for a positive background are not kept: they begin anew.
    precision : "float32" or "float64"
        Of the solver's arithmetic, with any model; the volume is float32. Float64 takes twice the memory.
        With ``"auto"`` and float64 only the model is chosen; to have all chosen in float64, wish for it.

    Raises
    ------
    InputError
        When the input is unusable or does not fit into memory; the text says what to do.
    """
    if prior not in PRIORS:
        raise InputError(f"The prior {prior!r} is not known for volumes. Choose one of {', '.join(PRIORS)}.")
    require_precision(precision)
    require_options(iterations=iterations, time_s=time_s, tolerance=tolerance, tau=tau, noise=noise)
    preventing = {
        f"model={model!r}": model != "auto",
        f"device={device!r}": device != "cpu",
        "a start (initial)": initial is not None,
        "a checkpoint (keeper)": keeper is not None,
        "an extent": extent is not None,
        "a memory limit (memory_gib)": memory_gib is not None,
        "a scratch folder": scratch is not None,
        f"precision={precision!r}": precision != "float32",
    }
    prevented = next((what for what, prevents in preventing.items() if prevents), None)
    if prevented is None:
        from recon.reconstruction.selection_volume import reconstruct_chosen_volume

        return reconstruct_chosen_volume(
            measurement,
            calibration,
            prior=prior,
            tau=tau,
            axis_weights=axis_weights,
            estimate_background=estimate_background,
            positive_background=positive_background,
            background=background,
            erasures=erasures,
            noise=noise,
            iterations=iterations,
            time_s=time_s,
            tolerance=tolerance,
            stop_at_noise=stop_at_noise,
            judged=judged,
            drop_empty=drop_empty,
            field=field,
            wishes=wishes,
            callback=callback,
            cancel=cancel,
        )
    if wishes is not None:
        from recon.reconstruction.overrides import require_choice

        require_choice(wishes, prevented)
    tolerance = 1e-3 if tolerance is None else tolerance
    scaled = prepare_volume(measurement, calibration, background, erasures, noise, extent)
    name, reason = choose_model(scaled.depths, model)
    as_measured = scaled
    smooth = background is None if estimate_background is None else estimate_background
    try:
        rules = StoppingRules(
            iterations=200 if iterations is None and time_s is None else iterations,
            time_s=None if time_s is None else time_s / len(scaled.data),
            tolerance=tolerance,
        )
    except ValueError as error:
        raise InputError(str(error)) from error
    height, width = scaled.data.shape[1:]
    psf_shape = scaled.depths.central.shape[2:]
    window, centre = window_of(field, (height, width), (psf_shape[0], psf_shape[1]))
    gains = np.ones((1, 1, 1), np.float32)
    if prior == "l1":  # which counts light on the sensor: no voxel may be the cheaper explanation
        even, gains = levelled(scaled.depths, (height, width), varying=name != "convolution")
        scaled = replace(scaled, depths=even)
        gains = gains if gains.shape[1:] == (1, 1) else gains[:, window[0], window[1]]
    grid = grid_of(calibration, scaled.depths.z_um, window, centre)
    weights = grid.axis_weights() if axis_weights is None else np.asarray(axis_weights, float)
    volumes, outcomes, backgrounds, taus, empty = [], [], [], [], []
    signs: list[npt.NDArray[np.float64]] = []
    for channel in range(len(scaled.data)):
        run = ChannelProblem(
            scaled,
            channel,
            name,
            smooth=smooth,
            prior=prior,
            weights=weights,
            drop_empty=drop_empty,
            memory_gib=memory_gib,
            scratch=scratch,
            device=device,
            acceptance_px=None if extent is None else extent.acceptance_px,
            precision=precision,
        )
        start = None if initial is None else run.start(_channel(initial.volume, channel) * gains, window)
        solver, relative = run.solver(tau, start)
        scale = float(scaled.noise[channel]) / scaled.energy

        def tell(solver: Solver, record: IterationRecord, scale: float = scale) -> None:
            if callback is not None:
                callback(
                    record,
                    lambda: _measured(solver.solution, window, np.float32(scale) / gains),
                )

        if stop_at_noise:
            rules = replace(rules, noise_norm=_noise_norm(scaled, channel))
        outcome = solver.run(
            rules,
            callback=tell if callback is not None else None,
            cancel=cancel,
            keeper=keeper,
            part=f"channel-{channel}",
        )
        smooth_part = run.background(outcome.solution) if smooth else None
        if positive_background and smooth_part is not None and is_negative(smooth_part):
            smooth_part = run.positive_background(outcome.solution)
            if may_go_on(outcome):
                first = replace(outcome, solution=np.empty(0))
                del solver, outcome
                outcome, smooth_part, solver = in_turns(
                    smooth_part,
                    first,
                    run.with_background,
                    run.positive_background,
                    rules,
                    tell if callback is not None else None,
                    cancel,
                )
        if extent is not None and extent.left_out is not None:
            rest = run.residual(outcome.solution, smooth_part)
            signs.append(signs_of_light(rest, extent.left_out, channel, extent.psf_window) / limit_of(run))
        volumes.append(_measured(outcome.solution, window, np.float32(scale) / gains))
        backgrounds.append(None if smooth_part is None else smooth_part * scaled.noise[channel])
        outcomes.append(Outcome(np.empty(0), outcome.history, outcome.stop_reason, outcome.seconds))
        taus.append(relative)
        empty.append(solver.empty if isinstance(solver, DouglasRachford) else EmptyPlanes())
        planned = run.memory_used()
        del solver, outcome
        run.close()
    volume = volumes[0] if scaled.flat else np.stack(volumes, axis=-1)
    left_out = np.max(signs, axis=0).tolist() if signs else []
    verdict: Verdict | None = None
    failed: list[str] = []
    if judged:
        try:
            verdict = _verdict(
                measurement, as_measured, volume, outcomes, tolerance, prior, started=initial is not None
            )
        except Exception as error:  # noqa: BLE001 - the result may be hours of work: it is worth more than this
            failed = [not_judged(error)]
    return VolumeReconstruction(
        volume=np.ascontiguousarray(volume),
        grid=grid,
        model=name,
        reason=reason,
        prior=prior,
        tau=max(taus),
        background=_stacked(backgrounds, scaled.flat),
        noise_norm=_noise_norm(scaled),
        histories=tuple(o.history for o in outcomes),
        stop_reasons=tuple(o.stop_reason for o in outcomes),
        seconds=sum(o.seconds for o in outcomes),
        empty_planes=tuple(empty),
        warnings=(*scaled.warnings, *_uncertified(empty), *signs_in_words(left_out), *failed),
        provenance={
            "noise_deviation": [float(v) for v in scaled.noise],
            "memory": planned,
            "precision": precision,
            **({"light_in_planes_left_out": left_out} if signs else {}),
        },
        verdict=verdict,
    )


def _measured(
    solution: Array, window: tuple[slice, slice], factor: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return a solution's window in units of the measurement."""
    return np.asarray(solution[0][:, window[0], window[1]] * factor, np.float32)


def _verdict(
    measurement: npt.ArrayLike,
    scaled: Scaled,
    volume: Array,
    outcomes: list[Outcome],
    tolerance: float,
    prior: str,
    *,
    started: bool,
) -> Verdict:
    # One plane is a picture, whatever solver it takes: it fails as pictures do, by a wrong depth for one.
    picture = len(scaled.depths.z_um) == 1
    evidence = evidence_of(
        measurement,
        scaled.data,
        scaled.valid,
        scaled.noise,
        volume,
        scaled.depths.central,
        [o.history[-1].data_residual for o in outcomes],
        max(unsettled_by(o.history, o.stop_reason, tolerance, started=started) for o in outcomes),
        points=not picture,
    )
    return verdict_on(evidence, method_name("admm" if picture else "volume", prior))


def _noise_norm(scaled: Scaled, channel: int = 0) -> float:
    return float(np.sqrt(np.count_nonzero(scaled.valid[channel])))


def _uncertified(empty: list[EmptyPlanes]) -> list[str]:
    return [
        f"Stopped before it was certain that {len(e.planes)} depth planes are empty: on one of them the "
        f"residual's correlation is {e.worst:.2f} tau. Let it run longer (or, in Python, drop_empty=False)."
        for e in empty
        if not e.certified
    ]


def _stacked(images: list[Array | None], flat: bool) -> npt.NDArray[np.float32] | None:
    found = [np.asarray(i, np.float32) for i in images if i is not None]
    if not found:
        return None
    return found[0] if flat else np.stack(found, axis=-1)


def _channel(volume: Array, channel: int) -> Array:
    chosen: Array = volume if volume.ndim == 3 else volume[..., channel]
    return chosen


def prepare_volume(
    measurement: npt.ArrayLike,
    calibration: Calibration,
    background: npt.ArrayLike | None,
    erasures: npt.ArrayLike | None,
    noise: NoiseModel | float | None,
    extent: Extent | None = None,
) -> Scaled:
    """Check, subtract the background, sort by depth, scale; parameters as :func:`reconstruct_volume`."""
    data, valid, saturated = data_of(measurement, background, erasures)
    depths = sort_by_depth(calibration)
    psfs = depths.central
    if psfs.shape[1] not in (1, len(data)):
        raise InputError(
            f"The PSFs have {psfs.shape[1]} channels and the measurement {len(data)}: give one PSF for all "
            "channels or one for each."
        )
    require_same_pixels(psfs[0], data)
    warnings = [*saturated, *depths.warnings]
    if extent is not None and extent.psf_window is not None:
        depths = depths.within(extent.psf_window)
        psfs = depths.central
    for z, psf in enumerate(psfs):
        warnings += [f"Depth {z}: {text}" for text in check_psf(psf)]
    deviation = np.array([channel_noise(d, v, noise) for d, v in zip(data, valid, strict=True)], np.float32)
    return Scaled(
        data=np.where(valid, data / deviation[:, None, None], 0).astype(np.float32),
        valid=valid,
        noise=deviation,
        energy=float(np.sqrt(np.mean(energies(psfs)))),
        depths=depths,
        warnings=tuple(warnings),
        flat=np.ndim(measurement) == 2,
    )


def window_of(
    field: Field, sensor_shape: tuple[int, int], psf_shape: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the part of the operator's grid that a field takes, and where the axis is in it."""
    (full_height, full_width), (row, column) = field_of(sensor_shape, psf_shape)
    if field == "full":
        return (slice(0, full_height), slice(0, full_width)), (row, column)
    if field != "sensor":
        raise InputError(f'field must be "sensor" or "full", not {field!r}.')
    height, width = sensor_shape
    top, left = max(row - height // 2, 0), max(column - width // 2, 0)
    window = slice(top, min(top + height, full_height)), slice(left, min(left + width, full_width))
    return window, (row - top, column - left)


def grid_of(
    calibration: Calibration,
    z_um: npt.NDArray[np.float64],
    window: tuple[slice, slice],
    centre: tuple[int, int],
) -> VolumeGrid:
    """Return where the voxels of depths ``z_um`` lie, micrometres."""
    pitch, distance = calibration.geometry.pixel_pitch_um, calibration.geometry.diffuser_distance_mm
    pitches = np.full(len(z_um), np.nan)
    if pitch is not None and distance:
        pitches = pitch * z_um / (1000 * distance)
    shape = (len(z_um), window[0].stop - window[0].start, window[1].stop - window[1].start)
    return VolumeGrid(shape, centre, z_um, pitches)
