"""A picture through a camera whose PSF changes over the field: one depth of the volume engine."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.camera.camera_model import Extent, ModelName, choose_model, one_depth, sort_by_depth
from recon.errors import InputError
from recon.reconstruction.channel import PRIORS
from recon.reconstruction.preparation import Field, Precision
from recon.reconstruction.result import ImageGrid, Reconstruction
from recon.reconstruction.volume import reconstruct_volume
from recon.solvers.base import Keeper
from recon.solvers.stopping import IterationRecord
from recon.types import Calibration

Progress = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]


def model_of(
    calibration: Calibration, z_um: float | None, model: ModelName
) -> tuple[ModelName, str, tuple[str, ...]]:
    """Return the camera model to use at a depth, why, and warnings.

    Where the PSFs cannot be told to vary or not, because they cannot be registered, ``"auto"`` takes one
    convolution and says so.

    Raises
    ------
    InputError
        When the model is not known, or needs more PSFs than there are.
    """
    depth = one_depth(calibration, z_um)
    try:
        depths = sort_by_depth(depth)
    except InputError as error:
        if model != "auto":
            raise
        return "convolution", "the PSFs could not be registered", (f"One PSF for the whole field: {error}",)
    return (*choose_model(depths, model), ())


def reconstruct_varying(
    measurement: npt.ArrayLike,
    calibration: Calibration,
    *,
    z_um: float | None,
    model: ModelName,
    reason: str,
    prior: str,
    tau: float | None,
    iterations: int | None,
    time_s: float | None,
    tolerance: float | None,
    noise: NoiseModel | float | None,
    background: npt.ArrayLike | None,
    erasures: npt.ArrayLike | None,
    field: Field,
    callback: Progress | None,
    cancel: threading.Event | None,
    keeper: Keeper | None,
    stop_at_noise: bool,
    judged: bool = True,
    estimate_background: bool = False,
    extent: Extent | None = None,
    precision: Precision = "float32",
) -> Reconstruction:
    """Reconstruct a picture with the local or low-rank model. Parameters as :func:`recon.reconstruct`."""
    if prior not in PRIORS:
        raise InputError(
            f"The {model} model takes the priors {', '.join(PRIORS)}, not {prior!r}; use model='convolution'."
        )
    depth = one_depth(calibration, z_um)

    def show(record: IterationRecord, volume: Callable[[], npt.NDArray[np.float32]]) -> None:
        assert callback is not None
        callback(record, lambda: volume()[0])

    result = reconstruct_volume(
        measurement,
        depth,
        prior=prior,
        tau=tau,
        axis_weights=(0.0, 1.0, 1.0),
        model=model,
        estimate_background=estimate_background,
        extent=extent,
        background=background,
        erasures=erasures,
        noise=noise,
        iterations=iterations,
        time_s=time_s,
        tolerance=1e-3 if tolerance is None else tolerance,
        field=field,
        callback=None if callback is None else show,
        cancel=cancel,
        judged=judged,
        keeper=keeper,
        stop_at_noise=stop_at_noise,
        precision=precision,
    )
    z, pitch = float(result.grid.z_um[0]), float(result.grid.pitch_um[0])
    provenance: dict[str, Any] = {**result.provenance, "model": model, "model_reason": reason}
    # Channels run one after the other; the slowest to converge speaks for all.
    longest = max(range(len(result.histories)), key=lambda c: len(result.histories[c]))
    return Reconstruction(
        image=np.ascontiguousarray(result.volume[0]),
        grid=ImageGrid(
            (result.grid.shape[1], result.grid.shape[2]),
            result.grid.centre,
            calibration.geometry.pixel_pitch_um,
            pitch if np.isfinite(pitch) else None,
            z if np.isfinite(z) else None,
        ),
        method=f"admm, {model} model",
        prior=prior,
        tau=result.tau,
        noise_norm=result.noise_norm,
        history=result.histories[longest],
        stop_reason=result.stop_reasons[longest],
        seconds=result.seconds,
        warnings=result.warnings,
        provenance={**provenance, "psf_z_um": z if np.isfinite(z) else None},
        verdict=result.verdict,
    )
