"""The depth that explains a frame best is found, from whichever one is in use; noise speaks for none."""

from __future__ import annotations

import numpy as np
import pytest

from recon.arrays import Float32Array
from recon.camera.transformed import Transformation, transformed
from recon.streams.live import LiveReconstructor
from recon.types import Calibration
from tests.recon.verdict.test_calibration_check import seen

__all__ = ["seen"]
DEPTHS_UM = (1e5, 1.4e5, 1.9e5)


def calibration_of(psf: Float32Array, true: int) -> Calibration:
    """Return one of three depths, of which ``true`` has the PSF itself, and the others larger and smaller."""
    sizes = [0.95 ** (depth - true) for depth in range(3)]
    psfs = np.concatenate([transformed(psf[None, None], Transformation(scale=size)) for size in sizes])
    return Calibration(psfs, np.array([[0.0, 0.0, z_um] for z_um in DEPTHS_UM]))


@pytest.mark.parametrize("true", [0, 2])
def test_it_is_found_from_every_other(seen: tuple[Float32Array, Float32Array], true: int) -> None:
    photograph, psf = seen
    for now_um in DEPTHS_UM:
        live = LiveReconstructor(calibration_of(psf, true), z_um=now_um)
        assert live.fitting_depth_um(photograph) == DEPTHS_UM[true]


def test_noise_and_all_depths_leave_it_where_it_is(seen: tuple[Float32Array, Float32Array]) -> None:
    photograph, psf = seen
    noise = np.random.default_rng(1).poisson(100.0, photograph.shape).astype(np.uint16)
    live = LiveReconstructor(calibration_of(psf, 0), z_um=DEPTHS_UM[1])
    assert live.fitting_depth_um(noise) == DEPTHS_UM[1]
    assert LiveReconstructor(calibration_of(psf, 0)).fitting_depth_um(photograph) is None
