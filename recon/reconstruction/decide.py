"""The smallest model that explains the data (docs/decisions/0010-smallest-model.md)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.camera.camera_model import ModelName, sort_by_depth
from recon.camera.light import plane_gains
from recon.errors import InputError
from recon.reconstruction.between import between_of
from recon.reconstruction.channel import Scaled, VolumePrior
from recon.reconstruction.channels import channels_of, merged
from recon.reconstruction.choice import Choice
from recon.reconstruction.extent import binning_of, field_of
from recon.reconstruction.overrides import Wishes
from recon.reconstruction.planes import planes_of
from recon.reconstruction.precision import precision_of
from recon.reconstruction.preparation import channel_noise, data_of, require_same_pixels
from recon.reconstruction.probe import COARSE_PX, VARYING_ITERATIONS, CoarsePass, camera_cost, coarse_passes
from recon.reconstruction.reduced import binned, reduced_calibration
from recon.reconstruction.selected_camera import candidates, model_decision, model_of
from recon.reconstruction.solving import USUAL_ITERATIONS, SmoothLight, background_of, is_stray, iterations_of
from recon.reconstruction.volume import prepare_volume
from recon.types import Calibration

Array = npt.NDArray[Any]


def choose(
    measurement: npt.ArrayLike,
    calibration: Calibration,
    *,
    prior: VolumePrior = "tv",
    noise: NoiseModel | float | None = None,
    background: npt.ArrayLike | None = None,
    erasures: npt.ArrayLike | None = None,
    wishes: Wishes | None = None,
) -> Choice:
    """Choose what to reconstruct with. Parameters as :func:`recon.reconstruct_volume`.

    Returns
    -------
    Choice
        With the reasons, and what one step up and down would cost.

    Raises
    ------
    InputError
        When the input is unusable.
    """
    began = time.perf_counter()
    wishes = wishes or Wishes()
    data, valid, _ = data_of(measurement, background, erasures)
    if len(calibration.psfs) == 0:
        raise InputError("The calibration holds no PSF: at least one is needed.")
    if calibration.psfs.shape[1] not in (1, len(data)):
        raise InputError(
            f"The PSFs have {calibration.psfs.shape[1]} channels and the measurement {len(data)}: give one "
            "PSF for all channels or one for each."
        )
    require_same_pixels(calibration.psfs[0], data)
    deviation = np.array([channel_noise(d, v, noise) for d, v in zip(data, valid, strict=True)])
    merge, tint = channels_of(data, deviation, valid, calibration.psfs, wishes)
    if tint is not None and merge.value == "merged":
        data, valid, calibration = merged(data, valid, calibration, tint)
    whole = bool(valid.all())
    # Erased pixels cannot be averaged with others: the coarse pass then has all pixels.
    factor = max(1, max(data.shape[1:]) // COARSE_PX) if whole else 1
    depths = sort_by_depth(calibration)
    coarse = [
        prepare_volume(
            binned(data[c], factor),
            reduced_calibration(_one_channel(calibration, c), factor, None),
            None,
            None if whole else ~np.asarray(valid[c], bool),
            None,
        )
        for c in range(len(data))
    ]
    kind: Literal["tv", "l1"] = "tv" if prior.startswith("tv") else "l1"
    costs = {m: camera_cost(coarse[0], m) for m in candidates(depths)}
    contrast = None if kind == "l1" or len(depths.z_um) == 1 else _contrast(data, valid, deviation)
    model, why, variation = model_of(depths, wishes, contrast, lambda m: costs[m].fft_pixels)
    # One convolution a depth: quick, and good enough to see where light is and whether there is stray light.
    even = [replace(c, depths=c.depths.divided(plane_gains(c.depths))) for c in coarse]
    sparse = coarse_passes(even, "l1", background=True)
    light = _smooth_light(coarse, sparse, prior, model)
    given = background is not None
    smooth = background_of(light, kind, wishes, given=given)
    estimated = smooth.value == "estimated"
    planes, dropped = planes_of(sparse, depths, wishes)
    between, added = between_of(calibration, depths, planes, wishes)
    binning = binning_of(depths, wishes, whole=whole)
    # A background of a few numbers takes what light from beyond the field has of them, not all of it.
    haze = is_stray(light.share) and not given and not (estimated and kind == "l1")
    window, reach, field = field_of(depths, wishes, model, haze=haze)
    usual = USUAL_ITERATIONS["convolution" if model == "convolution" else "varying"]
    side = max(data.shape[1:]) // int(binning.numbers["binning"])
    precise = precision_of(wishes, usual, side)
    tolerance, end = iterations_of(
        model, wishes, picture=len(depths.z_um) == 1, merged=merge.value == "merged"
    )
    decisions = (
        model_decision(model, why, variation, depths, {m: c.seconds for m, c in costs.items()}, wishes),
        dropped,
        *([added] if len(depths.z_um) > 1 else []),
        field,
        binning,
        merge,
        smooth,
        end,
        precise,
    )
    return Choice(
        model=model,
        planes=planes,
        n_planes=len(depths.z_um),
        between=between,
        binning=int(binning.numbers["binning"]),
        merged=merge.value == "merged",
        background=estimated,
        precision="float64" if precise.value == "float64" else "float32",
        psf_window=window,
        acceptance_px=reach,
        tolerance=tolerance,
        decisions=decisions,
        seconds=time.perf_counter() - began,
    )


def _one_channel(calibration: Calibration, channel: int) -> Calibration:
    own = channel if calibration.psfs.shape[1] > 1 else 0
    return replace(calibration, psfs=calibration.psfs[:, own : own + 1], background=None)


def _contrast(data: Array, valid: Array, deviation: Array) -> float:
    """Return the largest channel's standard deviation in units of its noise."""
    spread = [float(d[v].std(dtype=np.float64)) for d, v in zip(data, valid, strict=True)]
    return max(s / max(float(n), 1e-30) for s, n in zip(spread, deviation, strict=True))


def _smooth_light(
    coarse: list[Scaled], sparse: CoarsePass, prior: VolumePrior, model: ModelName
) -> SmoothLight:
    """Look for light that a smooth background would explain."""
    share = sparse.smooth_share
    picture = len(coarse[0].depths.z_um) == 1
    # A picture that l1 explains has no smooth light; that of a volume total variation does not tell.
    if not (prior.startswith("tv") and picture and is_stray(share) and model != "convolution"):
        return SmoothLight(share)
    dark, lit = (
        coarse_passes(coarse, prior, background=b, model=model, iterations=VARYING_ITERATIONS)
        for b in (False, True)
    )
    return SmoothLight(share, dark, lit)
