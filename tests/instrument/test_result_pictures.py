"""What a result's page shows: a colour mosaic's photograph in its colours, the planes that hold the light."""

from __future__ import annotations

import numpy as np

from instrument.files.seen import as_seen
from instrument.reconstruction.job import Job, Reduction
from instrument.reconstruction.result_figures import lightest, photographed
from recon.types import Calibration


def test_a_mosaics_photograph_is_shown_in_its_colours() -> None:
    valid = np.zeros((6, 8, 3), bool)
    valid[::2, ::2, 0] = valid[1::2, ::2, 1] = valid[::2, 1::2, 1] = valid[1::2, 1::2, 2] = True
    valid[0, 0] = False  # a hot pixel
    white = np.where(valid, np.float32([2, 3, 1]), 0).astype(np.float32)
    calibration = Calibration(np.ones((1, 3, 2, 2), np.float32), np.array([[0.0, 0.0, 1.0]]))
    job = Job(white, calibration, {}, valid, reduction=Reduction(1, 0.0, None, 1, "RGGB"))
    seen = photographed(job)
    assert seen.shape == (3, 4, 3)
    np.testing.assert_array_equal(seen[1, 1], [2, 3, 1])
    assert (as_seen(seen)[1, 1] == 255).all(), "grey is grey"
    assert photographed(Job(white, calibration, {}, valid)) is white


def test_the_planes_that_hold_most_light_are_shown() -> None:
    volume = np.zeros((6, 4, 4), np.float32)
    volume[[0, 4, 5], 1, 1] = 3, 1, 2
    assert lightest(volume) == [0, 4, 5]
    assert lightest(volume[:2]) == [0, 1]
