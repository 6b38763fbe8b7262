"""Which camera model: one convolution, a few weighted ones, or the local model."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from recon.camera.camera_model import CAMERAS, LOW_RANK_ERROR, TOLERATED, Depths, ModelName, choose_model
from recon.camera.varying_psfs import FieldOfPsfs, principal_psfs
from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.estimates import loss_db
from recon.reconstruction.overrides import Overrides
from recon.reconstruction.solving import USUAL_ITERATIONS

VARYING_COST = 3.0
"""Operator applications an iteration of conjugate gradients, relative to a convolution."""
HIDDEN, HIDDEN_VARIATION = 4.0, 0.4
"""Volumes by total variation: the PSFs' relative differences times the data's contrast in units of its
noise, and the differences themselves, up to which one convolution serves. Below, in 16 dim volumes, the true
camera was 0.1 dB worse in the mean (between 1.4 better and 1.6 worse), for four times the time; where PSFs
differed by 0.7 it was up to 1.3 dB better however dim, as it was with l1 and in pictures at any light."""


def candidates(depths: Depths) -> tuple[ModelName, ...]:
    """Return the camera models that a calibration allows, the smallest first."""
    return ("convolution", "lowrank", "local") if depths.varies else ("convolution",)


def model_of(
    depths: Depths, overrides: Overrides, contrast: float | None, pixels: Callable[[ModelName], int]
) -> tuple[ModelName, str, float]:
    """Return the camera model, why, and by how much PSFs vary over the field.

    Parameters
    ----------
    depths : Depths
    overrides : Overrides
    contrast : float or None
        Standard deviation of the data in units of its noise, of a volume with total variation; None: of
        anything else.
    pixels : callable
        Pixels that a model transforms in one forward and adjoint: its cost.
    """
    variation = depths.field_error if depths.varies else 0.0
    if overrides.model is not None:
        return choose_model(depths, overrides.model)[0], "as asked", variation
    model, why = choose_model(depths, "auto")
    if model == "convolution":
        return model, why, variation
    differ = f"PSFs differ by {variation:.1%} over the field"
    if contrast is not None and contrast * variation <= HIDDEN and variation <= HIDDEN_VARIATION:
        return (
            "convolution",
            f"{differ}; in data whose contrast is {contrast:.1f} times the noise that is "
            f"{contrast * variation:.1f} times the noise, and up to {HIDDEN:g} is hidden in that of a volume",
            variation,
        )
    rank = len(principal_psfs(_densest(depths), error=LOW_RANK_ERROR).components)
    components = f"{differ}; {rank} component{'s' if rank > 1 else ''} tell all but {LOW_RANK_ERROR:.0%}"
    share = pixels("lowrank") / max(pixels("local"), 1)
    if share < 1:
        return "lowrank", f"{components}, at {share:.2f} of the local model's transforms", variation
    return "local", f"{components}, at {share:.2f} times the local model's transforms", variation


def _densest(depths: Depths) -> FieldOfPsfs:
    return max(depths.fields, key=lambda f: len(f.points))


def model_decision(
    model: ModelName,
    why: str,
    variation: float,
    depths: Depths,
    times: Mapping[ModelName, float],
    overrides: Overrides,
) -> Decision:
    """Add the neighbours on the scale convolution, low-rank, local, and what was not judged."""
    scale = candidates(depths)
    unjudged = [name for name, offered in CAMERAS.items() if offered.refuses(depths) is None]
    if unjudged and overrides.model is None:
        why += (
            f"; left out: {', '.join(unjudged)}, of which nobody knows what it costs and gains "
            f"(--model {unjudged[0]} takes it)"
        )
    numbers = {"psf_variation": variation, "tolerated": TOLERATED}
    if len(scale) == 1 or model not in scale:
        return Decision("model", model, why, numbers=numbers, overruled=overrides.model is not None)
    low = principal_psfs(_densest(depths), error=LOW_RANK_ERROR)
    numbers |= {"rank": float(len(low.components)), "rank_error": low.error}
    loss = {"convolution": loss_db(variation), "lowrank": loss_db(low.error), "local": 0.0}

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

    return Decision("model", model, why, loss[model], step(1), step(-1), overrides.model is not None, numbers)
