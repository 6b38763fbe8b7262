"""How pictures fare that a PSF was not made from; on measured pairs where they are."""

from __future__ import annotations

import numpy as np
import pytest

from recon.blind.left_out import fare, leave_out
from recon.errors import InputError
from recon.evaluation.measured_sets import measured_pairs


def test_shift_gain_and_offset_are_not_held_against_a_reconstruction() -> None:
    rng = np.random.default_rng(0)
    picture = rng.random((20, 24, 2))
    psnr_db, image = fare(np.roll(picture, (2, -3), axis=(0, 1)) * [3, 0.2] + 5, picture)
    assert psnr_db > 100
    np.testing.assert_allclose(image, picture, atol=1e-5)
    error = 0.01 * rng.standard_normal(picture.shape)
    assert fare(picture + error, picture)[0] == pytest.approx(40, abs=0.3)


def test_a_measured_picture_left_out_is_reconstructed() -> None:
    try:
        names, photographs, pictures = measured_pairs()
    except InputError as missing:
        pytest.skip(str(missing))
    said: list[float] = []
    (found,) = leave_out(
        photographs,
        pictures,
        names,
        only=["394"],
        binning=6,  # where a background takes 4.6 dB
        on_progress=lambda _words, share: said.append(share),
    )
    assert found.psnr_db > found.flat_db + 8
    assert said == sorted(said)
