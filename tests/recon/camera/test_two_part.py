"""The two-part model pixel by pixel, and patterns that go on beyond the sensor."""

from dataclasses import replace

import numpy as np
import pytest

from recon.camera.two_part import is_cut, two_part
from recon.errors import InputError
from recon.types import Calibration, Geometry

PITCH_UM, DISTANCE_MM = 100.0, 4.0


def skew(tan_y, tan_x):
    """An angular response that no two directions share, and that is too dim in a corner to tell anything."""
    return np.clip(1 - 6 * tan_y + 3 * tan_x, 0.0, None) + 0.01


def lit(row, column, place, shape):
    """Light of a source at (x, y, z) on a pixel: by its response and the cube of the angle's cosine."""
    across = place[2] + 1e3 * DISTANCE_MM
    tan_y = ((row - (shape[0] - 1) / 2) * PITCH_UM - place[1]) / across
    tan_x = ((column - (shape[1] - 1) / 2) * PITCH_UM - place[0]) / across
    return skew(tan_y, tan_x), skew(tan_y, tan_x) * (1 + tan_y**2 + tan_x**2) ** -1.5


@pytest.mark.parametrize("points", [1, 2, 3])
def test_each_pixel_is_the_patterns_by_the_response_to_the_source_at_its_place(points):
    """Of two depths, the source of each beside the axis, the farther one's place across not known."""
    shape = 12, 15
    sources = np.array([[150.0, -230.0, 2000.0], [np.nan, np.nan, 5000.0]])
    psfs = np.random.default_rng(0).random((2, 1, *shape)).astype(np.float32) + 1
    made = two_part(Calibration(psfs, sources, geometry=Geometry(PITCH_UM, DISTANCE_MM)), skew, points=points)
    assert len(made.psfs) == 2 * points**2
    number = dim = 0
    for psf, source in zip(psfs[:, 0], np.nan_to_num(sources), strict=True):
        to_scene = PITCH_UM * source[2] / (1e3 * DISTANCE_MM)
        for down in range(points):
            for right in range(points):
                steps = [
                    round(n * ((k + 0.5) / points - 0.5)) for n, k in zip(shape, (down, right), strict=True)
                ]
                place = source - to_scene * np.array([steps[1], steps[0], 0])
                np.testing.assert_allclose(made.source_positions_um[number], place)
                expected = np.zeros(shape)
                for row, column in np.ndindex(*shape):
                    to = row + steps[0], column + steps[1]
                    answer, light = lit(row, column, source, shape)
                    cosine = light / answer
                    dim += answer * cosine <= 0.02
                    if answer * cosine > 0.02 and 0 <= to[0] < shape[0] and 0 <= to[1] < shape[1]:
                        expected[to] = psf[row, column] / light * lit(*to, place, shape)[1]
                np.testing.assert_allclose(made.psfs[number, 0], expected, rtol=1e-5, atol=1e-6)
                number += 1
    assert dim > 0


def test_what_a_field_needs_is_asked_for():
    known = Calibration(
        np.ones((1, 1, 6, 7), np.float32),
        np.array([[0.0, 0, 2000]]),
        geometry=Geometry(PITCH_UM, DISTANCE_MM),
    )
    lacking = [
        *(replace(known, geometry=geometry) for geometry in (Geometry(None, 4.0), Geometry(PITCH_UM, None))),
        *(replace(known, source_positions_um=np.array([[0, 0, z]])) for z in (-1e4, 0.0, np.nan, np.inf)),
    ]
    for calibration in lacking:
        with pytest.raises(InputError, match="does not say all"):
            two_part(calibration, skew)
    near = replace(known, source_positions_um=np.array([[0, 0, 0.5]]))
    assert len(two_part(near, skew, points=1).psfs) == 1
    with pytest.raises(InputError, match="1 place a side or more, not 0"):
        two_part(known, skew, points=0)


@pytest.mark.parametrize("side", [np.s_[0], np.s_[1], np.s_[-1], np.s_[-2], np.s_[:, 0], np.s_[:, -2]])
def test_a_pattern_that_is_bright_within_two_pixels_of_a_side_goes_on_beyond_it(side):
    dark = np.zeros((12, 15))
    dark[4:8, 5:9] = 1
    bright = dark.copy()
    bright[side] = 1
    places = np.array([[0, 0, 2000.0], [0, 0, 3000.0], [900, 0, 3000.0]])

    def cut(*psfs):
        return is_cut(Calibration(np.array(psfs, np.float32)[:, None], places[: len(psfs)]))

    assert not cut(dark, dark)
    assert cut(dark, bright)
    assert not cut(dark, dark, bright)  # of each depth that on the axis counts
    inner = dark.copy()
    inner[2], inner[-3], inner[:, 2], inner[:, -3] = 1, 1, 1, 1
    inner[:2] = inner[-2:] = inner[:, :2] = inner[:, -2:] = 0
    assert not cut(inner)
