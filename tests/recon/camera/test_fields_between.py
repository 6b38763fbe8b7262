"""Fields of PSFs at depths between, and by an angular response, against PSFs that light makes there."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.correlation import similarity
from recon.camera.refocus_field import at_depth, refocus_field
from recon.camera.two_part import two_part
from recon.optics.fall_off import gaussian_fall_off
from recon.types import Calibration

WORLD = SimulatedWorld(
    WorldOptions(preset="tiny", time_scale=0.0, fall_off="gaussian", fall_off_sigma_deg=13.0)
)
GREEN = (0.0, 1.0, 0.0)
PLACES = [(0.0, 0.0), (2000.0, 0.0), (0.0, -1500.0), (2000.0, -1500.0)]


def _taken(places):
    psfs = np.stack([WORLD.psf((float(x), float(y), float(z)), GREEN) for x, y, z in places])[:, None]
    return Calibration(psfs, np.array(places, float), geometry=WORLD.geometry)


def _at(z_um, places=PLACES):
    return [(x, y, z_um) for x, y in places]


NEAR, FAR = 11e3, 14e3


@pytest.mark.parametrize("angles", [False, True])
def test_a_field_between_two_depths_is_that_measured_there(angles):
    """At the same places, or at the same angles, of both depths."""
    scale = FAR / NEAR if angles else 1.0
    both = _taken(_at(NEAR) + _at(FAR, [(scale * x, scale * y) for x, y in PLACES[::-1]]))
    made, how = at_depth(both, 12.3e3)
    assert how.from_z_um == (NEAR, FAR)
    assert len(made.psfs) == 4
    for psf, place in zip(made.psfs[:, 0], made.source_positions_um, strict=True):
        truth = WORLD.psf(tuple(place.tolist()), GREEN)
        assert similarity(psf, truth) > 0.985
        assert psf.sum() == pytest.approx(truth.sum(), rel=0.03)
    assert refocus_field(both, NEAR).source_positions_um.tolist() == [list(p) for p in _at(NEAR)]


@pytest.mark.parametrize("z_um", [1e7, 9.8e8, 1e30])
def test_a_field_brought_far_away_keeps_its_angles(z_um: float) -> None:
    """At the same x and y all of it would be one direction, and no field."""
    near = _taken(_at(NEAR, PLACES[:3]))
    made = refocus_field(near, z_um)
    assert (made.source_positions_um[:, 2] == min(z_um, 1e9)).all()
    pixel = 13.0 / 8900.0
    angles = made.source_positions_um[:, :2] / min(z_um, 1e9)
    np.testing.assert_allclose(angles, np.array(PLACES[:3]) / NEAR, atol=pixel)


def test_depths_with_other_places_are_interpolated_at_those_of_the_fuller_one():
    line = [(-2000.0, 0.0), (0.0, 0.0), (2000.0, 0.0)]
    made = refocus_field(_taken([*_at(NEAR, line), *_at(FAR, line[:2])]), 12.3e3)
    np.testing.assert_allclose(made.source_positions_um[:, 0], [-2000, 0, 2000], atol=15)
    psf, place = made.psfs[0, 0], made.source_positions_um[0]
    assert similarity(psf, WORLD.psf(tuple(place.tolist()), GREEN)) > 0.98


def test_one_psf_and_the_angular_response_tell_those_of_the_field():
    """Where the pattern of the diffuser is the same everywhere, Eq. 5.1 is all there is to it."""
    alone = _taken(_at(NEAR, [(0.0, 0.0)]))
    made = two_part(alone, gaussian_fall_off(13.0), points=3)
    assert len(made.psfs) == 9
    for psf, place in zip(made.psfs[:, 0], made.source_positions_um, strict=True):
        truth = WORLD.psf(tuple(place.tolist()), GREEN)
        seen = psf > 0
        assert similarity(psf[seen][None], truth[seen][None]) > 0.985
        assert psf[seen].sum() == pytest.approx(truth[seen].sum(), rel=0.03)


def test_a_point_that_shines_evenly_lights_a_pixel_by_the_cube_of_the_cosine():
    """Tilted by arctan sqrt(t_y^2 + t_x^2) it looks smaller, from further away, and falls in at a slant."""
    alone = _taken(_at(NEAR, [(0.0, 0.0)]))
    alone = replace(alone, psfs=np.ones_like(alone.psfs))
    made = two_part(alone, lambda tan_y, tan_x: np.ones(np.broadcast(tan_y, tan_x).shape), points=3)
    height, width = made.psfs.shape[2:]
    pitch = WORLD.geometry.pixel_pitch_um
    across = NEAR + 1e3 * WORLD.geometry.diffuser_distance_mm
    y, x = (pitch * (np.arange(n) - (n - 1) / 2) for n in (height, width))

    def cube(place):
        square = (y[:, None] - place[1]) ** 2 + (x - place[0]) ** 2
        return (1 + square / across**2) ** -1.5

    for psf, place in zip(made.psfs[:, 0], made.source_positions_um, strict=True):
        lit = psf > 0
        assert lit.mean() > 0.4
        row, column = (round(-p / (pitch * NEAR) * 1e3 * WORLD.geometry.diffuser_distance_mm)
                       for p in (place[1], place[0]))  # fmt: skip
        before = np.roll(1 / cube((0.0, 0.0)), (row, column), axis=(0, 1)) * cube(place)
        np.testing.assert_allclose(psf[lit], before[lit], rtol=1e-4)
