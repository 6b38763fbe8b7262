"""What a display could reach for a picture, and what would help, in figures and in words."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

from instrument.display.hologram import prepare_target
from instrument.files.images import Pixels
from recon.holography import Display, HologramOptions, HologramRecord, HologramStop, Limit, hologram_limit
from recon.holography.limit import BANDS
from recon.holography.target import band_of

LIFTS = (0.1, 0.3)
"""How far black is lifted to see what would help."""
_NO_LIMIT_DB = 60.0


def lifts_of(options: HologramOptions) -> tuple[float, ...]:
    """Return the amounts of lift that are looked at: what was asked for, and more."""
    return (options.lift, *(lift for lift in LIFTS if lift > options.lift))


def limits_of_lifts(
    picture: Pixels,
    display: Display,
    options: HologramOptions,
    *,
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

        found.append(hologram_limit(display, target, options, callback=show, cancel=cancel))
        if found[-1].stop_reason is HologramStop.CANCELLED:
            break
    return found


def limit_lines(found: Sequence[Limit], display: Display, options: HologramOptions) -> list[str]:
    """Return what could be reached, which frequencies fall short and why, and what would help, in lines."""
    here = found[0]
    lines = [
        f"limit: no number of frames shows this picture better than {_decibels(here.bound_db)} through this "
        f"mask (a bound; {here.reached_db:.2f} dB is reached by what need not be frames of phases)"
    ]
    cutoff = band_of(display).cutoff
    least, coarse = display.factor / cutoff, "set by the mask within an SLM pixel, not by the SLM"
    if display.near:  # a period is farther than a mask pixel's first order goes aside
        aside_mm = display.wavelength_nm * (display.distance_mm or 0.0) / display.mask_pitch_um * 1e-3
        least, coarse = display.field_mm / aside_mm / cutoff, "light does not go so far aside this near"
    for (low, high), wanted, reached in zip(pairwise(BANDS), here.wanted, here.reached, strict=True):
        why = ""
        if reached < 0.7 and low < least:
            why = f"   {coarse}"
        elif reached < 0.7:
            why = "   more contrast than so many SLM pixels can make"
        lines.append(
            f"  {low:.2f} to {high:.2f} of the finest the eye resolves: contrast {wanted:.2f}, "
            f"{reached:.0%} reached{why}"
        )
    for lift, better in zip(lifts_of(options)[1:], found[1:], strict=False):
        best = _decibels(better.bound_db)
        lines.append(f"  black at {lift:g} of white (--lift {lift:g}): at most {best} of it")
    return lines


def _decibels(bound_db: float) -> str:
    if bound_db < _NO_LIMIT_DB:
        return f"{bound_db:.2f} dB"
    return f"{_NO_LIMIT_DB:.0f} dB (no limit in sight)"
