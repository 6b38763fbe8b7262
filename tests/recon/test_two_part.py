"""Angular fall-off: the two-part model against its definition, and how many PSFs it needs."""

import numpy as np
import pytest

from recon.camera.local_convolution import local_convolution
from recon.camera.two_part import two_part_field
from recon.optics.fall_off import gaussian_fall_off

PITCH_UM, Z_UM, DISTANCE_UM = 40.0, 3000.0, 2000.0
SENSOR, PSF = (33, 35), 15
FALL_OFF = gaussian_fall_off(13.0)


def on_axis():
    return np.random.default_rng(0).random((1, PSF, PSF))


def grid(spacing, extent=20):
    axis = np.arange(-extent, extent + 1, spacing, dtype=float)
    return [(y, x) for y in axis for x in axis]


def optics():
    return {"pitch_um": PITCH_UM, "z_um": Z_UM, "distance_um": DISTANCE_UM}


def seen_directly(psf, row, column):
    """Eq. 5.1 pixel by pixel: the shifted pattern times the response at each sensor pixel."""
    image = np.zeros(SENSOR)
    source = -np.array([row, column]) * PITCH_UM * Z_UM / DISTANCE_UM
    for i in range(SENSOR[0]):
        for j in range(SENSOR[1]):
            u = np.array([i - SENSOR[0] // 2, j - SENSOR[1] // 2])
            v = u - (row, column) + PSF // 2
            if (v >= 0).all() and (v < PSF).all():
                angle = np.arctan(np.linalg.norm(u * PITCH_UM - source) / (DISTANCE_UM + Z_UM))
                axis = np.arctan(np.linalg.norm((v - PSF // 2) * PITCH_UM) / (DISTANCE_UM + Z_UM))
                f = np.exp(-0.5 * (np.degrees(angle) / 13) ** 2) / np.exp(-0.5 * (np.degrees(axis) / 13) ** 2)
                image[i, j] = psf[0, v[0], v[1]] * f
    return image


def error(points, at=((4, -7), (-11, 3), (6, 6))):
    psf = on_axis()
    field = two_part_field(psf, points, FALL_OFF, **optics())
    model = local_convolution([field], SENSOR, dtype=np.float64)
    height, width = model.domain_shape[2:]
    centre = SENSOR[0] // 2 + PSF - 1 - PSF // 2, SENSOR[1] // 2 + PSF - 1 - PSF // 2
    missed = total = 0.0
    for row, column in at:
        x = np.zeros((1, 1, height, width))
        x[0, 0, centre[0] + row, centre[1] + column] = 1
        truth = seen_directly(psf, row, column)
        missed += np.sum((model.forward(x)[0] - truth) ** 2)
        total += np.sum(truth**2)
    return np.sqrt(missed / total)


def test_is_eq_5_1_at_the_calibration_points():
    assert error(grid(20), at=[(0, 0), (20, 0), (-20, 20)]) < 1e-3


def test_more_calibration_points_tell_more():
    """Fig. 5.3: close enough, interpolation is right; too far apart, or one alone, it is not."""
    dense, sparse = error(grid(5)), error(grid(20))
    alone = error([(0, 0)])
    assert dense < 0.03
    assert dense < 0.3 * sparse < 0.3 * alone


@pytest.mark.parametrize("points", [[(0, 0)], grid(20)])
def test_no_fall_off_gives_the_same_psf_everywhere(points):
    field = two_part_field(on_axis(), points, lambda y, x: np.ones_like(y * x), **optics())
    np.testing.assert_allclose(field.psfs, np.broadcast_to(on_axis(), field.psfs.shape))
