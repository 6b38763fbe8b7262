"""The smallest model that explains the data (docs/decisions/0010-smallest-model.md)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.auto.choice import Choice, Decision, Option
from recon.auto.probe import (
    CHANNEL_NOISE,
    CHANNEL_PSF,
    COARSE_PX,
    CoarsePass,
    acceptance_px,
    coarse_passes,
    colours,
    operator_seconds,
    psf_window,
    resolution_px,
)
from recon.auto.reduced import Colours, binned, reduced_calibration
from recon.errors import InputError
from recon.noise import NoiseModel
from recon.operators.low_rank import principal_psfs
from recon.preparation import channel_noise, data_of, require_same_pixels
from recon.types import Calibration
from recon.volume.channel import VolumePrior
from recon.volume.model import (
    LOW_RANK_ERROR,
    MODELS,
    TOLERATED,
    Depths,
    ModelName,
    choose_model,
    sort_by_depth,
)
from recon.volume.reconstruct import plane_gains, prepare_volume

Array = npt.NDArray[Any]

ERROR_SCALE = 0.5
"""Relative PSF error that costs 3 dB: a round figure of the twelve scenes that auto was tuned on."""
BACKGROUND_GAIN = {"tv": 4.0, "l1": 0.8}
"""How many times smaller the misfit must be with a background for it to be taken.

Total variation cannot tell a smooth object from a background, and loses the hold that darkness gives it: 1 to
6 dB on the scenes it was tuned on. l1 gained 0.3 to 3 dB, with and without stray light, so that the data need
only not speak against it.
"""
LEFT_OUT = 0.02
"""Share of the coarse pass's light, of any channel, that all planes together that are left out may hold."""
LEFT_OUT_SCALE = 0.1
"""Share of the light left out that costs 3 dB: a round figure."""
LEAST_COMMON, LEAST_COMMON_SHARE = 64, 0.05
"""Pixels, and share of all, that must tell all colours for channels to be compared and merged."""
VARYING_COST = 3.0
"""Operator applications an iteration of conjugate gradients, relative to a convolution."""
LEAST_SIDE = 20
"""Pixels along the longest side that binning leaves at least."""
SAMPLES = 7.0
"""Pixels over the full width of a PSF's autocorrelation at half its height. With 5 a soft picture lost 0.6
dB: priors bring back more than the PSF's width says."""
SETTLED = {"convolution": 1e-3, "varying": 8e-3}
"""Change an iteration at which pictures were seen to be within 0.2 dB of the end: the solver of varying PSFs,
with its exact data term, goes further in one iteration."""
USUAL_ITERATIONS = {"convolution": 100, "varying": 30}


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """Choices that the caller makes; None leaves them to the program.

    Attributes
    ----------
    model : str or None
        ``"convolution"``, ``"lowrank"`` or ``"local"``.
    planes : str or None
        ``"all"``: every calibrated depth takes part.
    binning : int or None
    channels : str or None
        ``"all"``: no merging; ``"merged"``.
    background : bool or None
    field : str or None
        ``"all"``: everything that can reach the sensor.
    tolerance : float or None
    """

    model: ModelName | None = None
    planes: str | None = None
    binning: int | None = None
    channels: str | None = None
    background: bool | None = None
    field: str | None = None
    tolerance: float | None = None

    @classmethod
    def parse(cls, text: Mapping[str, str]) -> Wishes:
        """Read wishes from words: ``{"model": "local", "binning": "1", "background": "off"}``.

        Raises
        ------
        InputError
            Which wish is not known, and what is.
        """
        known: dict[str, dict[str, Any] | None] = {
            "model": {m: m for m in MODELS if m != "auto"},
            "planes": {"all": "all"},
            "binning": None,
            "channels": {"all": "all", "merged": "merged"},
            "background": {"on": True, "off": False},
            "field": {"all": "all"},
        }
        values: dict[str, Any] = {}
        for name, value in text.items():
            if name not in known:
                raise InputError(f"There is no choice {name!r}; there are {', '.join(known)}.")
            words = known[name]
            if words is None:
                if not value.isdigit() or int(value) < 1:
                    raise InputError(f"{name}={value}: a whole number from 1 is expected.")
                values[name] = int(value)
            elif value not in words:
                raise InputError(f"{name}={value}: one of {', '.join(words)} is expected.")
            else:
                values[name] = words[value]
        return cls(**values)


def require_choice(wishes: Wishes | None, prevented_by: str) -> None:
    """Refuse wishes where nothing, or only the model, is chosen: they would be ignored.

    Raises
    ------
    InputError
        What prevents the choice that they are about.
    """
    if wishes not in (None, Wishes()):
        raise InputError(
            f"Wishes are about everything that model='auto' chooses, which it does not with {prevented_by}. "
            "Leave one of the two out."
        )


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
    merge, tint = _channels(data, deviation, valid, calibration.psfs, wishes)
    if tint is not None and merge.value == "merged":
        data, valid, calibration = _merged(data, valid, calibration, tint)
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
    kind = "tv" if prior.startswith("tv") else "l1"
    model, why, variation = _model(depths, wishes)
    # One convolution a depth: quick, and good enough to see where light is and whether there is stray light.
    even = [replace(c, depths=c.depths.divided(plane_gains(c))) for c in coarse]
    sparse = coarse_passes(even, "l1", background=True)
    if kind == "l1":
        dark, lit = coarse_passes(even, "l1", background=False), sparse
    else:
        dark, lit = (coarse_passes(coarse, prior, background=b) for b in (False, True))
    smooth = _background(dark, lit, kind, wishes, given=background is not None)
    planes, dropped = _planes(sparse, depths, wishes)
    times = {m: operator_seconds(coarse[0], m) for m in _candidates(depths)}
    binning = _binning(depths, wishes, whole=whole)
    window, reach, field = _field(depths, wishes)
    decisions = (
        _with_options(model, why, variation, depths, times, wishes),
        dropped,
        field,
        binning,
        merge,
        smooth,
        _iterations(model, wishes),
        Decision(
            "precision",
            "float32",
            "it drifts from float64 by about 1e-4 in 500 iterations of the exact-data solver",
        ),
    )
    return Choice(
        model=model,
        planes=planes,
        n_planes=len(depths.z_um),
        binning=int(binning.numbers["binning"]),
        merged=merge.value == "merged",
        background=smooth.value == "estimated",
        psf_window=window,
        acceptance_px=reach,
        tolerance=SETTLED["convolution" if model == "convolution" else "varying"]
        if wishes.tolerance is None
        else wishes.tolerance,
        decisions=decisions,
        seconds=time.perf_counter() - began,
    )


# Pieces ------------------------------------------------------------------------------------------------
def _one_channel(calibration: Calibration, channel: int) -> Calibration:
    own = channel if calibration.psfs.shape[1] > 1 else 0
    return replace(calibration, psfs=calibration.psfs[:, own : own + 1], background=None)


def _merged(
    data: Array, valid: Array, calibration: Calibration, tint: Colours
) -> tuple[Array, Array, Calibration]:
    psfs = calibration.psfs
    if psfs.shape[1] > 1:
        psfs = tint.merged(psfs, tint.psf)[:, None]
    return (
        tint.merged(data, tint.scene)[None],
        np.asarray(valid.all(axis=0))[None],
        replace(calibration, psfs=psfs),
    )


def merged_input(
    data: Array, valid: Array, noise: Array, calibration: Calibration
) -> tuple[Array, Array, Calibration, Colours]:
    """Return data, valid pixels and calibration of one channel in the place of several, and their colours.

    Raises
    ------
    InputError
        Where there is one channel.
    """
    tint = colours(data, noise, valid, calibration.psfs)
    if tint is None:
        raise InputError("There is one channel: nothing can be merged.")
    return (*_merged(data, valid, calibration, tint), tint)


def _channels(
    data: Array, deviation: Array, valid: Array, psfs: Array, wishes: Wishes
) -> tuple[Decision, Colours | None]:
    n = len(data)
    if n == 1:
        return Decision("channels", "one", "the photograph has one channel"), None
    common = int(np.count_nonzero(valid.all(axis=0)))
    if common < max(LEAST_COMMON, LEAST_COMMON_SHARE * valid[0].size):
        why = f"only {common} of {valid[0].size} pixels tell all colours, as with a colour mosaic"
        if wishes.channels == "merged":
            raise InputError(f"Channels cannot be merged: {why}. Leave channels=merged out.")
        return Decision("channels", f"all {n}", why, overruled=wishes.channels is not None), None
    tint = colours(data, deviation, valid, psfs)
    assert tint is not None
    numbers = {"misfit": tint.misfit, "psf_misfit": tint.psf_misfit}
    alike = tint.misfit <= CHANNEL_NOISE and tint.psf_misfit <= CHANNEL_PSF
    asked = wishes.channels is not None
    merge = wishes.channels == "merged" if asked else alike
    why = (
        f"channels proportional to one another miss the data by {tint.misfit:.2f} of its noise and the PSFs "
        f"by {tint.psf_misfit:.1%} (up to {CHANNEL_NOISE:g} and {CHANNEL_PSF:.0%} pass for alike)"
    )
    loss = -10 * float(np.log10(1 + max(tint.misfit**2 - 1, 0) + (tint.psf_misfit / ERROR_SCALE) ** 2))
    if merge:
        up = Option(f"all {n}", float(n), -loss)
        return Decision("channels", "merged", why, loss, up=up, overruled=asked, numbers=numbers), tint
    down = Option("merged", 1 / n, loss)
    return Decision("channels", f"all {n}", why, 0.0, down=down, overruled=asked, numbers=numbers), tint


def _candidates(depths: Depths) -> tuple[ModelName, ...]:
    return ("convolution", "lowrank", "local") if depths.varies else ("convolution",)


def _model(depths: Depths, wishes: Wishes) -> tuple[ModelName, str, float]:
    variation = depths.field_error if depths.varies else 0.0
    if wishes.model is not None:
        return choose_model(depths, wishes.model)[0], "as asked", variation
    model, why = choose_model(depths, "auto")
    return model, why, variation


def _loss_db(error: float) -> float:
    return -10 * float(np.log10(1 + (error / ERROR_SCALE) ** 2))


def _with_options(
    model: ModelName,
    why: str,
    variation: float,
    depths: Depths,
    times: Mapping[ModelName, float],
    wishes: Wishes,
) -> Decision:
    """Add the neighbours on the scale convolution, low-rank, local."""
    scale = _candidates(depths)
    numbers = {"psf_variation": variation, "tolerated": TOLERATED}
    if len(scale) == 1:
        return Decision("model", model, why, numbers=numbers, overruled=wishes.model is not None)
    densest = max(depths.fields, key=lambda f: len(f.points))
    low = principal_psfs(densest, error=LOW_RANK_ERROR)
    numbers |= {"rank": float(len(low.components)), "rank_error": low.error}
    loss = {"convolution": _loss_db(variation), "lowrank": _loss_db(low.error), "local": 0.0}

    def cost(m: ModelName) -> float:
        kind = "convolution" if m == "convolution" else "varying"
        applications = 1.0 if m == "convolution" else VARYING_COST
        return times[m] * applications * USUAL_ITERATIONS[kind]

    def step(by: int) -> Option | None:
        place = scale.index(model) + by
        if not 0 <= place < len(scale):
            return None
        other = scale[place]
        return Option(other, cost(other) / cost(model), loss[other] - loss[model])

    return Decision("model", model, why, loss[model], step(1), step(-1), wishes.model is not None, numbers)


def _background(dark: CoarsePass, lit: CoarsePass, kind: str, wishes: Wishes, *, given: bool) -> Decision:
    ratio = max(dark.misfit, 1e-6) / max(lit.misfit, 1e-6)
    numbers = {"misfit_without": dark.misfit, "misfit_with": lit.misfit, "needed": BACKGROUND_GAIN[kind]}
    asked = wishes.background is not None
    picture = kind == "tv" and dark.light.shape[1] == 1
    on = bool(wishes.background) if asked else ratio >= BACKGROUND_GAIN[kind] and not given and not picture
    why = (
        f"a coarse pass misses the data by {dark.misfit:.2f} of the noise without a smooth background and by "
        f"{lit.misfit:.2f} with one ({BACKGROUND_GAIN[kind]:g} times less is asked of it)"
    )
    if picture and not asked:
        why = (
            "total variation cannot tell a smooth background from a smooth picture (a quick pass misses the "
            f"data by {dark.misfit:.2f} of the noise without one and by {lit.misfit:.2f} with one)"
        )
    if given and not asked:
        why = "a background was given"
    gain = 20 * float(np.log10(ratio))
    cost = lit.seconds / max(dark.seconds, 1e-9)
    if on:
        return Decision(
            "background", "estimated", why, 0.0, None, Option("none", 1 / cost, -gain), asked, numbers
        )
    unknown = min(gain, 0.0) if ratio < 1 else float("nan")
    return Decision("background", "none", why, 0.0, Option("estimated", cost, unknown), None, asked, numbers)


def _planes(passed: CoarsePass, depths: Depths, wishes: Wishes) -> tuple[tuple[int, ...], Decision]:
    n = len(depths.z_um)
    everything = tuple(range(n))
    if n == 1:
        return everything, Decision("planes", "1", "one depth was calibrated")
    lit = np.any([_most_of(light) for light in passed.light], axis=0)
    # The coarse pass may take a plane for its neighbour: those of lit planes stay.
    order = np.argsort(depths.z_um) if np.isfinite(depths.z_um).all() else np.arange(n)
    near = lit[order].copy()
    near[1:] |= lit[order][:-1]
    near[:-1] |= lit[order][1:]
    kept = np.zeros(n, bool)
    kept[order] = near
    asked = wishes.planes == "all"
    planes = everything if asked else tuple(int(z) for z in np.flatnonzero(kept))
    lost = _share(passed.light, ~kept)
    channel = " of any colour" if len(passed.light) > 1 else ""
    why = (
        f"of {n} calibrated depths a coarse pass puts {lost:.1%} of the light{channel} into "
        f"{n - int(kept.sum())} ({LEFT_OUT:.0%} may be left out, and neighbours of those that are not stay)"
    )
    loss = 0.0 if asked else _left_out_db(lost)
    numbers = {"planes": float(len(planes)), "of": float(n), "light_left_out": lost}
    up = None if len(planes) == n else Option(f"all {n}", n / len(planes), -loss)
    fewest = tuple(int(z) for z in np.flatnonzero(lit))
    down = None
    if len(fewest) < len(planes):
        down = Option(
            f"{len(fewest)} without their neighbours",
            len(fewest) / len(planes),
            _left_out_db(_share(passed.light, ~lit)) - loss,
        )
    value = f"all {n}" if len(planes) == n else f"{len(planes)} of {n} ({_ranges(planes)})"
    return planes, Decision("planes", value, why, loss, up, down, asked, numbers)


def _most_of(light: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return the fewest planes that hold all but ``LEFT_OUT`` of the light; all where there is none."""
    if not light.any():
        return np.ones(len(light), bool)
    order = np.argsort(-light, kind="stable")
    left = light.sum() - np.cumsum(light[order])
    chosen = np.zeros(len(light), bool)
    chosen[order[: int(np.argmax(left <= LEFT_OUT * light.sum())) + 1]] = True
    return chosen


def _share(light: npt.NDArray[np.float64], planes: npt.NDArray[np.bool_]) -> float:
    """Largest share of any channel's light in some planes."""
    return float(light[:, planes].sum(axis=1).max())


def _left_out_db(share: float) -> float:
    return -10 * float(np.log10(1 + share / LEFT_OUT_SCALE)) if share > 0 else 0.0


def _ranges(planes: tuple[int, ...]) -> str:
    """Say indices briefly: ``0-2, 5``."""
    parts: list[list[int]] = []
    for z in planes:
        if parts and parts[-1][-1] == z - 1:
            parts[-1].append(z)
        else:
            parts.append([z])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)


def _binning(depths: Depths, wishes: Wishes, *, whole: bool) -> Decision:
    sharpest = min(resolution_px(p) for psfs in depths.central for p in psfs)
    side = max(depths.central.shape[2:])
    if not np.isfinite(sharpest):
        sharpest = float(side)
    fitting = min(max(1, int(sharpest / SAMPLES)), max(1, side // LEAST_SIDE))
    asked = wishes.binning is not None
    binning = wishes.binning or (fitting if whole else 1)
    why = (
        f"the sharpest PSF's autocorrelation is {sharpest:.1f} pixels wide at half its height, and "
        f"{SAMPLES:g} (binned) pixels over that width are enough"
    )
    if not whole and not asked and fitting > 1:
        why = f"erased pixels are not averaged with others; else {why}"
    up = None if binning == 1 else Option(str(binning - 1), (binning / (binning - 1)) ** 2, 0.0)
    down = None
    if side // (binning + 1) >= 16:
        down = Option(
            str(binning + 1),
            (binning / (binning + 1)) ** 2,
            _loss_db(max(SAMPLES * (binning + 1) / sharpest - 1, 0.0) * ERROR_SCALE),
        )
    numbers = {"binning": float(binning), "autocorrelation_px": sharpest}
    return Decision("binning", f"{binning} x {binning}", why, 0.0, up, down, asked, numbers)


def _field(depths: Depths, wishes: Wishes) -> tuple[tuple[int, int], float | None, Decision]:
    height, width = depths.central.shape[2:]
    asked = wishes.field == "all"
    window = (height, width) if asked else psf_window(depths)
    reach = None if asked else acceptance_px(depths)
    full = (2 * height - 1) * (2 * width - 1)
    extent = (height + window[0] - 1, width + window[1] - 1)
    share = extent[0] * extent[1] / full
    why = f"the PSFs' light lies within {window[0]} x {window[1]} of {height} x {width} pixels"
    if reach is not None and reach < 0.5 * float(np.hypot(*extent)):
        why += f"; {reach:.0f} pixels off the axis PSFs are down to 2 % of the central one's light"
    elif reach is not None:
        reach = None
    up = None if share > 0.99 else Option(f"{2 * height - 1} x {2 * width - 1}", 1 / share, 0.0)
    down = Option(f"{height} x {width}", height * width / (extent[0] * extent[1]), float("nan"))
    numbers = {"share_of_largest": share}
    return (
        window,
        reach,
        Decision("field", f"{extent[0]} x {extent[1]} pixels", why, 0.0, up, down, asked, numbers),
    )


def _iterations(model: ModelName, wishes: Wishes) -> Decision:
    kind = "convolution" if model == "convolution" else "varying"
    tolerance = SETTLED[kind] if wishes.tolerance is None else wishes.tolerance
    return Decision(
        "iterations",
        f"until they change by less than {tolerance:g}",
        "pictures were seen to be within 0.2 dB of the end there",
        0.0,
        Option(f"until {tolerance / 10:g}", 3.0, 0.2),
        Option(f"until {tolerance * 3:g}", 0.5, -0.5),
        wishes.tolerance is not None,
        {"tolerance": tolerance},
    )
