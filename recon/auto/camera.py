"""Which camera model: one convolution, a few weighted ones, or the local model."""

from __future__ import annotations

from collections.abc import Mapping

from recon.auto.choice import Decision, Option
from recon.auto.estimates import loss_db
from recon.auto.solving import USUAL_ITERATIONS
from recon.auto.wishes import Wishes
from recon.operators.low_rank import principal_psfs
from recon.volume.model import LOW_RANK_ERROR, TOLERATED, Depths, ModelName, choose_model

VARYING_COST = 3.0
"""Operator applications an iteration of conjugate gradients, relative to a convolution."""


def candidates(depths: Depths) -> tuple[ModelName, ...]:
    """Return the camera models that a calibration allows, the smallest first."""
    return ("convolution", "lowrank", "local") if depths.varies else ("convolution",)


def model_of(depths: Depths, wishes: Wishes) -> tuple[ModelName, str, float]:
    """Return the camera model, why, and by how much PSFs vary over the field."""
    variation = depths.field_error if depths.varies else 0.0
    if wishes.model is not None:
        return choose_model(depths, wishes.model)[0], "as asked", variation
    model, why = choose_model(depths, "auto")
    return model, why, variation


def model_decision(
    model: ModelName,
    why: str,
    variation: float,
    depths: Depths,
    times: Mapping[ModelName, float],
    wishes: Wishes,
) -> Decision:
    """Add the neighbours on the scale convolution, low-rank, local."""
    scale = candidates(depths)
    numbers = {"psf_variation": variation, "tolerated": TOLERATED}
    if len(scale) == 1:
        return Decision("model", model, why, numbers=numbers, overruled=wishes.model is not None)
    densest = max(depths.fields, key=lambda f: len(f.points))
    low = principal_psfs(densest, error=LOW_RANK_ERROR)
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

    return Decision("model", model, why, loss[model], step(1), step(-1), wishes.model is not None, numbers)
