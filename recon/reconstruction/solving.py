"""Whether a smooth background is estimated as well, when to stop, and in which precision to compute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from recon.camera.camera_model import ModelName
from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.overrides import Overrides
from recon.reconstruction.probe import CoarsePass

STRAY_SHARE = 0.2
"""Share of the data's light, in a coarse l1 pass's smooth background, from which on there may be stray light
in a picture: sparse ones without any had up to 0.15 there, dense ones, which l1 does not explain, 0.75."""
POINTS_SHARE = 0.11
"""The same from which on points have a background estimated. Where there was stray light of 0.3 to 1.2 times
the scene's one gained 1.6 to 12 dB, with few points and with many; without any it changed -3 to 0.9 dB."""
OBJECTIVE_FALL = 0.15
"""By how much of itself misfit and prior together must fall in a picture with total variation.

What neither object nor noise explains is made up for by structure that costs more than a background's few
numbers save: stray light, light from beyond the calibrated field. On the scenes it was tuned on a background
gained 1.3 to 5.7 dB where the objective of twenty iterations fell by 0.17 or more (once by 0.09), and lost
0.3 to 5 dB where it fell by less. Of volumes with total variation, which cannot tell a smooth object from a
background and loses the hold that darkness gives it, it says nothing: there one lost up to 8, gained 1.6 dB.
"""
IDLE_BACKGROUND_DB = {"tv": 2.5, "l1": 0.3}
"""What a background costs that the data do not ask for: the median of the scenes tuned on."""
GAINED_DB = {"tv": 12.0, "l1": 15.0}
"""What one gains for each unit of what decides on it: a rule of thumb of the same scenes."""
SETTLED = {"convolution": 1e-3, "merged": 1e-3, "varying picture": 2e-3, "varying volume": 3e-3}
"""Change an iteration at which pictures were seen to be within 0.2 dB of the end: the solver of varying PSFs,
with its exact data term, goes further in one iteration. Merged colours have the light of all: less noise, and
more to be gained at the end, in a third of the time."""
USUAL_ITERATIONS = {"convolution": 100, "varying": 60}


@dataclass(frozen=True, slots=True)
class SmoothLight:
    """What quick passes say of smooth light.

    Attributes
    ----------
    share : float
        Of the data's light, in the background of a coarse l1 pass.
    dark, lit : CoarsePass or None
        Of a picture with total variation in which there may be stray light: passes by the model that is used,
        without and with a background.
    """

    share: float
    dark: CoarsePass | None = None
    lit: CoarsePass | None = None

    @property
    def fall(self) -> float | None:
        """By how much of itself the objective falls with a background; None where nobody looked."""
        if self.dark is None or self.lit is None:
            return None
        return 1 - self.lit.objective / self.dark.objective if self.dark.objective > 0 else 0.0


def is_stray(share: float) -> bool:
    """Tell whether the smooth part of a coarse l1 pass may be stray light."""
    return share >= STRAY_SHARE


def background_of(
    light: SmoothLight, kind: Literal["tv", "l1"], overrides: Overrides, *, given: bool
) -> Decision:
    """Decide whether a smooth background is estimated as well."""
    fall = light.fall
    numbers = {"smooth_share": light.share}
    if light.dark is not None and light.lit is not None and fall is not None:
        numbers |= {
            "objective_falls": fall,
            "misfit_without": light.dark.misfit,
            "misfit_with": light.lit.misfit,
        }
    found = f"a coarse pass puts {light.share:.0%} of the light into a smooth background"
    if given:
        why, on = "a background was given", False
    elif kind == "l1":
        on = light.share >= POINTS_SHARE
        why = f"{found} ({POINTS_SHARE:.0%} are asked of it)"
    elif fall is not None:
        on = fall >= OBJECTIVE_FALL
        why = (
            f"{found}; with one misfit and prior together {'fall' if fall >= 0 else 'rise'} by "
            f"{abs(fall):.0%} (a fall of {OBJECTIVE_FALL:.0%} is asked of it)"
        )
    else:
        on, why = False, f"{found}; total variation cannot tell a smooth background from a smooth object"
    asked = overrides.background is not None
    on = on if overrides.background is None else overrides.background
    change = _change_db(light, kind)
    # A few more numbers in the solver's equations: the time is the same.
    if on:
        down = Option("none", 1.0, -change)
        return Decision("background", "estimated", why, 0.0, None, down, asked, numbers)
    up = Option("estimated", 1.0, change)
    return Decision("background", "none", why, 0.0, up, None, asked, numbers)


def _change_db(light: SmoothLight, kind: Literal["tv", "l1"]) -> float:
    """Return what a background changes: rules of thumb of the scenes tuned on."""
    told, least = (light.share, POINTS_SHARE) if kind == "l1" else (light.fall, OBJECTIVE_FALL)
    return -IDLE_BACKGROUND_DB[kind] if told is None or told < least else GAINED_DB[kind] * told


def iterations_of(
    model: ModelName, overrides: Overrides, *, picture: bool, merged: bool
) -> tuple[float, Decision]:
    """Say at what change an iteration to stop."""
    kind = "convolution" if model == "convolution" else f"varying {'picture' if picture else 'volume'}"
    if merged and kind == "varying picture":
        kind = "merged"
    tolerance = SETTLED[kind] if overrides.tolerance is None else overrides.tolerance
    return tolerance, Decision(
        "iterations",
        f"until they change by less than {tolerance:g}",
        "as asked"
        if overrides.tolerance is not None
        else "pictures were seen to be within 0.2 dB of the end there",
        0.0,
        *steps_of_tolerance(tolerance),
        overrides.tolerance is not None,
        {"tolerance": tolerance},
    )


def steps_of_tolerance(tolerance: float) -> tuple[Option, Option]:
    """Return what stopping later and earlier would be: rules of thumb of the scenes tuned on."""
    return Option(f"until {tolerance / 10:g}", 3.0, 0.2), Option(f"until {tolerance * 3:g}", 0.5, -0.5)
