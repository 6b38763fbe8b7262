"""The simulated screen: its pixels are where geometry puts them, and glow as its gamma says."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from drivers.simulated.options import WorldOptions
from drivers.simulated.screen import ScreenOptions, SimulatedScreen
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array
from recon.camera.registration import register

WHITE = (1.0, 1.0, 1.0)
ASKEW = ScreenOptions(
    shape=(180, 320),
    pixel_pitch_um=300.0,
    distance_mm=200.0,
    roll_deg=5.0,
    yaw_deg=25.0,
    pitch_deg=-10.0,
    center_mm=(6.0, -4.0),
    black=0.0,
    room=0.0,
    settle_ms=0.0,
)


def lit(world: SimulatedWorld) -> Float32Array:
    light = world.photons_per_s(WHITE)
    assert light is not None
    return light


@pytest.fixture
def world() -> SimulatedWorld:
    return SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0, scene="none"))


def spot(row: int, column: int) -> npt.NDArray[np.uint8]:
    levels = np.zeros(ASKEW.shape, np.uint8)
    levels[row - 1 : row + 2, column - 1 : column + 2] = 255
    return levels


def test_a_spot_on_a_turned_screen_is_seen_where_a_point_in_space_would_be(world: SimulatedWorld) -> None:
    with SimulatedScreen(ASKEW, world) as screen:
        seen = []
        for row, column in ((90, 160), (50, 220)):
            screen.display(spot(row, column))
            # Without the driver's own geometry: a point turned about x, y and z, then moved.
            turn_x, turn_y, turn_z = np.deg2rad((ASKEW.pitch_deg, ASKEW.yaw_deg, ASKEW.roll_deg))
            cx, sx, cy, sy = np.cos(turn_x), np.sin(turn_x), np.cos(turn_y), np.sin(turn_y)
            cz, sz = np.cos(turn_z), np.sin(turn_z)
            about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
            about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
            about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
            flat = np.array([column - 159.5, row - 89.5, 0.0]) * ASKEW.pixel_pitch_um
            x, y, z = about_z @ about_y @ about_x @ flat + (6e3, -4e3, 200e3)
            shift = register(lit(world), world.psf((x, y, z), WHITE))
            assert (shift.rows, shift.columns) == pytest.approx((0.0, 0.0), abs=0.1)
            assert shift.reliable
            seen.append(lit(world))
    assert not np.allclose(seen[0], seen[1])
    assert world.photons_per_s(WHITE) is None, "a screen that is switched off glows"


def test_radiance_follows_gamma_above_black_and_the_lit_room(world: SimulatedWorld) -> None:
    options = ASKEW.model_copy(update={"gamma": 2.0, "black": 0.01, "room": 0.02})
    with SimulatedScreen(options, world) as screen:
        totals = {}
        for level in (0, 128, 255):
            screen.display(np.full(screen.shape, level, np.uint8))
            totals[level] = float(lit(world).sum())
        black = totals[0]
    share = (totals[128] - black) / (totals[255] - black)
    assert share == pytest.approx((128 / 255) ** 2, rel=1e-3)
    assert 0.01 < black / totals[255] < 0.06


def test_the_same_light_is_not_rendered_twice_and_another_picture_is(world: SimulatedWorld) -> None:
    with SimulatedScreen(ASKEW, world) as screen:
        screen.display(spot(45, 80))
        key, first = world.light_key(), lit(world)
        assert world.photons_per_s(WHITE) is first
        screen.display(spot(40, 80))
        assert world.light_key() != key
