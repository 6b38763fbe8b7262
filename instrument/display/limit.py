"""What a display could reach for a picture, and what would help, in figures and in words."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

from instrument.display.hologram import prepare_target
from instrument.files.pictures import Pixels
from recon.holography import (
    Display,
    HologramOptions,
    HologramRecord,
    HologramStop,
    Limit,
    hologram_limit,
    random_mask,
)
from recon.holography.display import no_mask
from recon.holography.limit import BANDS
from recon.holography.target import band_of

LIFTS = (0.1, 0.3)
"""How far black is lifted to see what would help."""
_NO_LIMIT_DB = 60.0


def lifts_of(options: HologramOptions) -> tuple[float, ...]:
    """Return the amounts of lift that are looked at: what was asked for, and more."""
    return (options.lift, *(lift for lift in LIFTS if lift > options.lift))


class SharedTime:
    """Seconds that several searches share: each may take an equal part of what those before left.

    What is computed beside them, bounds and what frames gain, has no part in it.
    """

    def __init__(self, options: HologramOptions, searches: int) -> None:
        self._left, self._time_s = searches, options.time_s

    def next(self, options: HologramOptions) -> HologramOptions:
        """Return a search's options with the time that it may take."""
        if self._time_s is not None:
            options = replace(options, time_s=max(self._time_s, 1e-3) / max(self._left, 1))
        self._left -= 1
        return options

    def took(self, seconds: float) -> None:
        """Take off what a search has taken."""
        if self._time_s is not None:
            self._time_s -= seconds


def limits_of_lifts(
    picture: Pixels,
    display: Display,
    options: HologramOptions,
    *,
    shared: SharedTime,
    z_mm: float = 0.0,
    callback: Callable[[float, HologramRecord], object] | None = None,
    cancel: threading.Event | None = None,
) -> list[Limit]:
    """Return the limit at each of :func:`lifts_of`, fewer when it was cancelled.

    ``callback(lift, record)`` is called after each iteration. Errors as
    :func:`recon.holography.hologram_limit`.
    """
    found: list[Limit] = []
    for lift in lifts_of(options):
        target = prepare_target(picture, display, replace(options, lift=lift), z_mm=z_mm)

        def show(record: HologramRecord, _slm: Any, lift: float = lift) -> None:
            if callback is not None:
                callback(lift, record)

        before = found[-1].columns if found else None
        timed = shared.next(options)
        found.append(hologram_limit(display, target, timed, initial=before, callback=show, cancel=cancel))
        shared.took(found[-1].seconds)
        if found[-1].stop_reason is HologramStop.CANCELLED:
            break
    return found


def coarser_mask(display: Display) -> Display | None:
    """Return a display with a random mask of pixels twice as wide (or without one), in its place.

    None where there is no mask to make coarser, and near, where a mask's pixels set how wide the picture is.
    """
    side = display.factor // 2
    if side == 0 or display.near:
        return None
    shape = (display.slm_shape[0] * side, display.slm_shape[1] * side)
    make = random_mask if side > 1 else no_mask
    mask = make(shape, design_wavelength_nm=display.mask.design_wavelength_nm)
    return replace(display, mask=mask, displacement=None)


def limit_lines(found: Sequence[Limit], display: Display, options: HologramOptions) -> list[str]:
    """Return what could be reached, which frequencies fall short and why, and what lifts are worth."""
    here = found[0]
    behind = "through this mask" if display.factor > 1 else "with these phases"
    if here.bound_db < _NO_LIMIT_DB:
        lines = [
            f"limit: no number of frames shows this picture better than {here.bound_db:.2f} dB {behind} "
            f"(a bound; {here.reached_db:.2f} dB is reached by what need not be frames of phases)"
        ]
    else:
        none = (
            f"none is in sight {behind}" if is_told(here) else f"not known {behind} after so short a search"
        )
        lines = [f"limit: {none}; {here.reached_db:.2f} dB is reached by what need not be frames of phases"]
    cutoff = band_of(display).cutoff
    least, coarse = display.factor / cutoff, "set by the mask within an SLM pixel, not by the SLM"
    if display.near:  # a period is farther than a mask pixel's first order goes aside
        aside_mm = display.wavelength_nm * (display.distance_mm or 0.0) / display.mask_pitch_um * 1e-3
        least, coarse = display.field_mm / aside_mm / cutoff, "light does not go so far aside this near"
    for (low, high), wanted, reached in zip(pairwise(BANDS), here.wanted, here.reached, strict=True):
        why = ""
        if not is_told(here):  # the search may not have come to it yet
            why = " so far"
        elif reached < 0.7 and low < least:
            why = f"   {coarse}"
        elif reached < 0.7:
            why = "   more contrast than so many SLM pixels can make"
        lines.append(
            f"  {low:.2f} to {high:.2f} of the finest the eye resolves: contrast {wanted:.2f}, "
            f"{reached:.0%} reached{why}"
        )
    for lift, better in zip(lifts_of(options)[1:], found[1:], strict=False):
        lines.append(f"  black at {lift:g} of white (--lift {lift:g}): {at_most(better)}")
    return lines


def at_most(limit: Limit) -> str:
    """Return a bound in words."""
    if not is_told(limit):
        return "not known after so short a search"
    return f"at most {limit.bound_db:.2f} dB" if limit.bound_db < _NO_LIMIT_DB else "no limit in sight"


def is_told(limit: Limit) -> bool:
    """Return whether there is a bound, or a search that was not cut short found none."""
    short = (HologramStop.TIME, HologramStop.CANCELLED, HologramStop.ITERATIONS)
    return limit.bound_db < _NO_LIMIT_DB or limit.stop_reason not in short


def frames_line(gain_db: float) -> str:
    """Return what frames are worth, of :func:`gain_of_frames`; nothing where that is not known."""
    return f"  more frames (--frames): up to about {gain_db:.1f} dB above one" if gain_db > 0 else ""
