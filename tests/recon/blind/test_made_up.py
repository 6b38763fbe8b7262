"""Two halves of the images give one PSF where the beads are there, and two where they were made up."""

from __future__ import annotations

import numpy as np
import pytest

from recon.blind.made_up import LEAST_ALIKE, alike_by_halves
from recon.blind.polish import Polished
from recon.camera.points import FieldFunctions, Points
from tests.recon.blind.test_points import PSF, slide, spots


def polished(beads: list[Points], degree: int) -> Polished:
    functions = FieldFunctions(degree, np.concatenate([points.places for points in beads]))
    psfs = np.zeros((functions.count, *PSF), np.float32)
    psfs[0] = spots(PSF, 0, 0)
    return Polished(psfs, functions, tuple(beads), (0.1,))


@pytest.mark.parametrize(("images", "degree"), [(2, 0), (2, 2), (6, 1), (6, 2)])
def test_halves_agree_where_beads_are_right_and_not_where_they_were_made_up(images: int, degree: int) -> None:
    rng = np.random.default_rng(3)
    seen = [slide(rng) for _ in range(images)]
    data = np.stack([image for image, _ in seen])
    right = polished([points for _, points in seen], degree)
    assert alike_by_halves(data, right, 60) > (LEAST_ALIKE + 1) / 2
    made_up = [Points(rng.uniform(-10, 10, (8, 2)), rng.uniform(0.5, 1, 8)) for _ in seen]
    assert alike_by_halves(data, polished(made_up, degree), 60) < LEAST_ALIKE


@pytest.mark.parametrize(("images", "beads", "noise"), [(9, 6, 0.3), (4, 12, 0.3), (3, 6, 0.2), (2, 12, 0.2)])
def test_few_and_noisy_photographs_of_beads_that_are_right_agree(
    images: int, beads: int, noise: float
) -> None:
    rng = np.random.default_rng(4)
    seen = [slide(rng, beads, noise) for _ in range(images)]
    data, degree = np.stack([image for image, _ in seen]), int(images * beads >= 12)
    assert alike_by_halves(data, polished([points for _, points in seen], degree), 60) > 0.98
    made_up = [Points(rng.uniform(-10, 10, (8, 2)), rng.uniform(0.5, 1, 8)) for _ in seen]
    assert alike_by_halves(data, polished(made_up, degree), 60) < 0.8


def test_noise_alone_is_not_taken_for_agreement() -> None:
    rng = np.random.default_rng(4)
    beads = [slide(rng)[1] for _ in range(4)]
    noise = rng.normal(0, 1, (4, 40, 44)).astype(np.float32)
    assert abs(alike_by_halves(noise, polished(beads, 1), 60)) < 0.5
    assert alike_by_halves(np.zeros_like(noise), polished(beads, 1), 5) == 0
