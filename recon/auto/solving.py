"""Whether a smooth background is estimated as well, when to stop, and in which precision to compute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from recon.auto.choice import Decision, Option
from recon.auto.probe import CoarsePass
from recon.auto.wishes import Wishes
from recon.volume.model import ModelName

STRAY_SHARE = 0.2
"""Share of the data's light, in a coarse l1 pass's smooth background, from which on there is stray light.
Sparse scenes without any had up to 0.15 there, those with some what they were made with, to 0.1."""
OBJECTIVE_FALL = 0.22
"""By how much of itself the objective must fall with a background for one to be taken.

What neither object nor noise explains is made up for by structure that costs more than a background's few
numbers save: stray light, light from beyond the calibrated field, errors of the PSFs. On the scenes it was
tuned on a background gained 0.2 to 5 dB where the objective of quick passes fell by 0.23 or more, and lost
0.4 to 5 dB where it fell by 0.21 or less. Of volumes with total variation, which cannot tell a smooth object
from a background and loses the hold that darkness gives it, it says nothing: there a background always lost.
"""
IDLE_BACKGROUND_DB = {"tv": 2.0, "l1": 0.4}
"""What a background costs that the data do not ask for: the median of the scenes tuned on."""
SETTLED = {"convolution": 1e-3, "varying": 8e-3}
"""Change an iteration at which pictures were seen to be within 0.2 dB of the end: the solver of varying PSFs,
with its exact data term, goes further in one iteration."""
USUAL_ITERATIONS = {"convolution": 100, "varying": 30}


@dataclass(frozen=True, slots=True)
class SmoothLight:
    """What quick passes without (dark) and with (lit) a smooth background say.

    Attributes
    ----------
    share : float
        Of the data's light, in the background of a coarse l1 pass.
    dark, lit : CoarsePass
    telling : bool
        Whether their objectives tell something: with l1, and of a picture by the model that is used.
    """

    share: float
    dark: CoarsePass
    lit: CoarsePass
    telling: bool

    @property
    def fall(self) -> float:
        """By how much of itself the objective falls with a background."""
        return 1 - self.lit.objective / self.dark.objective if self.dark.objective > 0 else 0.0


def is_stray(share: float) -> bool:
    """Tell whether the smooth part of a coarse l1 pass may be stray light."""
    return share >= STRAY_SHARE


def background_of(light: SmoothLight, kind: Literal["tv", "l1"], wishes: Wishes, *, given: bool) -> Decision:
    """Decide whether a smooth background is estimated as well."""
    dark, lit = light.dark, light.lit
    numbers = {
        "misfit_without": dark.misfit,
        "misfit_with": lit.misfit,
        "smooth_share": light.share,
    } | ({"objective_falls": light.fall} if light.telling else {})
    asked = wishes.background is not None
    if given:
        why, on = "a background was given", False
    elif light.telling:
        on = light.fall >= OBJECTIVE_FALL
        why = (
            f"misfit and prior together fall by {light.fall:.0%} with a smooth background in a quick pass "
            f"({OBJECTIVE_FALL:.0%} are asked of it), which takes {light.share:.0%} of the light"
        )
    else:
        on, why = False, "total variation cannot tell a smooth background from a smooth object"
    why += (
        f"; the pass misses the data by {dark.misfit:.2f} of the noise without and {lit.misfit:.2f} with it"
    )
    on = on if wishes.background is None else wishes.background
    cost = lit.seconds / max(dark.seconds, 1e-9)
    change = _change_db(light, kind)
    if on:
        down = Option("none", 1 / cost, -change)
        return Decision("background", "estimated", why, 0.0, None, down, asked, numbers)
    up = Option("estimated", cost, change)
    return Decision("background", "none", why, 0.0, up, None, asked, numbers)


def _change_db(light: SmoothLight, kind: str) -> float:
    """Return what a background changes: rules of thumb of the scenes tuned on."""
    if light.telling and light.fall >= OBJECTIVE_FALL:
        return 10 * float(np.log10(1 + light.fall))
    return -IDLE_BACKGROUND_DB[kind]


def iterations_of(model: ModelName, wishes: Wishes) -> Decision:
    """Say when to stop."""
    kind = "convolution" if model == "convolution" else "varying"
    tolerance = SETTLED[kind] if wishes.tolerance is None else wishes.tolerance
    return Decision(
        "iterations",
        f"until they change by less than {tolerance:g}",
        "pictures were seen to be within 0.2 dB of the end there",
        0.0,
        *steps_of_tolerance(tolerance),
        wishes.tolerance is not None,
        {"tolerance": tolerance},
    )


def steps_of_tolerance(tolerance: float) -> tuple[Option, Option]:
    """Return what stopping later and earlier would be: rules of thumb of the scenes tuned on."""
    return Option(f"until {tolerance / 10:g}", 3.0, 0.2), Option(f"until {tolerance * 3:g}", 0.5, -0.5)
