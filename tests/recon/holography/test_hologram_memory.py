"""Work arrays of a whole optimisation, model and optimiser, at the size that the limits are stated for."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from recon.holography import (
    Display,
    HologramModel,
    Target,
    compute_hologram,
    random_mask,
)
from recon.holography.pose import Pose

SLM = (540, 960)


def peak_bytes(display: Display, kind: str) -> int:
    """Largest memory held at once, from building the model to the last of four iterations."""
    image = np.random.default_rng(0).random((1296, 1296))

    def run(on: Display) -> None:
        model = HologramModel(on, [Target(image)], loss=kind)
        compute_hologram(model, iterations=4, tolerance=0)

    k = display.factor
    small = Display((32, 48), random_mask((32 * k, 48 * k)))
    if display.displacement is not None:
        small = replace(small, displacement=display.displacement)
    run(small)  # compiles, which takes memory of its own
    tracemalloc.start()
    try:
        run(display)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["none", "frequency", "spatial"])
def test_at_4x_100_megabytes_suffice(kind):
    display = Display(SLM, random_mask((SLM[0] * 2, SLM[1] * 2)))
    assert peak_bytes(display, kind) < 100e6


def test_a_displaced_mask_needs_no_more():
    mask = random_mask((SLM[0] * 2, SLM[1] * 2))
    pose = Pose(shift_x=3.0, shift_y=-30.0, roll_mrad=2.0)
    display = Display(SLM, mask, displacement=pose.displacement(mask.shape))
    assert peak_bytes(display, "frequency") < 100e6


@pytest.mark.slow
@pytest.mark.parametrize(("k", "limit"), [(4, 250e6), (6, 450e6)])
@pytest.mark.parametrize("kind", ["none", "frequency", "spatial"])
def test_at_16x_and_36x_the_stated_limits_hold(k, limit, kind):
    display = Display(SLM, random_mask((SLM[0] * k, SLM[1] * k)))
    assert peak_bytes(display, kind) < limit
