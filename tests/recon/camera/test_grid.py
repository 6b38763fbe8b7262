"""Volumes on voxels of one size: beads at their places, light that stays, and grids that cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from recon.camera.grid import (
    LEAN,
    Grid,
    _between,
    _centred,
    _nearer,
    _shares,
    depth_in_words,
    metric_grid,
    metric_volume,
)
from recon.errors import InputError

Z_UM = 1 / np.linspace(1 / 9000, 1 / 15000, 7)
GRID = Grid((7, 90, 110), (40, 60), Z_UM, 2e-3 * Z_UM, None, np.linspace((30.0, -80.0), (60.0, 120.0), 7))


def _middle(volume, grid):
    """Where the light of a volume lies, (x, y, z), and how much there is."""
    total = volume.sum(dtype=float)
    z, y, x = (np.average(np.arange(n), weights=volume.sum(axis=tuple({0, 1, 2} - {axis})))
               for axis, n in enumerate(volume.shape))  # fmt: skip
    assert grid.upright
    x_um, y_um, _ = grid.place_um(0, y, x)
    return np.array([x_um, y_um, grid.z_um[0] + z * grid.spacing_um[0]]), total


@pytest.mark.parametrize("voxel_um", [None, 28.0, 60.0])
@pytest.mark.parametrize("order", [1, -1])
def test_beads_come_out_at_their_places_with_their_light(voxel_um, order):
    grid = replace(GRID, z_um=Z_UM[::order], pitch_um=2e-3 * Z_UM[::order], axis_um=GRID.axis_um[::order])
    rng = np.random.default_rng(0)
    for _ in range(2):
        z, row, column = rng.integers(1, 6), *rng.integers(10, 80, 2)
        volume = np.zeros(GRID.shape, np.float32)
        volume[z, row, column] = 5
        metric, placed = metric_volume(volume, grid, voxel_um)
        (x, y, depth), light = _middle(metric, placed)
        expected = grid.place_um(z, row, column)
        largest = max(placed.pitch_um[0], grid.pitch_um[z])
        assert np.abs(np.array([x, y]) - expected[:2]).max() < largest / 2
        assert abs(depth - expected[2]) < max(placed.spacing_um[0], grid.spacing_um[z]) / 2
        assert light == pytest.approx(5, rel=0.1)


@pytest.mark.parametrize(
    ("z_mm", "most_voxels"),
    [
        (np.linspace(10, 20, 21), 0.15),
        (1 / np.linspace(1 / 10, 1 / 20, 21), 0.15),
        (1 / np.linspace(1 / 10, 1 / 20, 7), 0.3),  # at the field's edge a ray crosses 4 pixels a plane
        ((10, 10.2, 11, 11.5, 13, 13.6, 15, 18, 20), 1.2),  # steps of 0.2 to 3 mm
    ],
)
def test_a_perfect_volume_s_beads_are_within_half_a_voxel_unless_steps_differ_widely(z_mm, most_voxels):
    """What a perfect reconstruction has of a bead: its light on the two planes beside it, at one pixel."""
    z_um = 1e3 * np.asarray(z_mm, float)
    grid = Grid((len(z_um), 64, 80), (32, 40), z_um, 8e-4 * z_um)
    rng, rows, columns = np.random.default_rng(0), *np.mgrid[:64, :80]
    off = []
    for depth in rng.uniform((z_um[0] + z_um[1]) / 2, (z_um[-1] + z_um[-2]) / 2, 12):
        row, column = rng.uniform((10, 10), (54, 70))
        spot = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 2 / 0.8**2)
        shares = np.stack([np.interp(depth, z_um, one) for one in np.eye(len(z_um))])
        metric, placed = metric_volume(np.float32(shares[:, None, None] * spot), grid)
        found, light = _middle(metric, placed)
        place = np.array([*(8e-4 * depth * np.array([40 - column, 32 - row])), depth])
        sizes = np.array([*(placed.pitch_um[:1].repeat(2)), placed.spacing_um[0]])
        off.append(np.abs(found - place) / sizes)
        assert light == pytest.approx(spot.sum(), rel=0.05)
    assert np.max(off) < most_voxels


def test_an_even_glow_is_even_and_colours_stay_apart():
    """As much light a cubic micrometre everywhere is as much a voxel: wide voxels of far planes hold more."""
    size = GRID.pitch_um**2 * np.gradient(Z_UM)
    glow = np.broadcast_to(size[:, None, None, None].astype(np.float32), (*GRID.shape, 2)).copy()
    glow[..., 1] *= 3
    metric, placed = metric_volume(glow, GRID)
    assert placed.is_metric
    assert not GRID.is_metric
    inside = metric[1:-3, 30:-40, 40:-40, 0]
    assert np.ptp(inside) < 0.1 * inside.mean()
    np.testing.assert_allclose(metric[..., 1], 3 * metric[..., 0], rtol=1e-5)
    assert metric[0, 0, 0, 0] == 0  # beside what the nearest plane shows


def test_the_pixel_on_the_axis_looks_along_it():
    assert replace(GRID, axis_um=None).place_um(3, 40, 60) == (0.0, 0.0, Z_UM[3])
    assert replace(GRID, axis_um=None).direction_deg(40, 60) == (0.0, 0.0)
    assert GRID.place_um(3, 40, 60) == (*GRID.axis_um[3], Z_UM[3])


@pytest.mark.parametrize("upright", [False, True])
def test_a_metric_grid_reaches_as_far_as_the_volume_about_its_middle(upright):
    grid = Grid(
        (4, 90, 110), (20, 30), 1e3 * np.array([10.0, 11.0, 13.0, 17.0]), np.full(4, 25.0), 6.5, None, upright
    )
    made = metric_grid(grid, 800.0)
    np.testing.assert_allclose(made.z_um, 10000 + 800 * np.arange(-1, 12))  # in 9500 to 19000
    fine = metric_grid(replace(grid, z_um=1e3 * np.arange(10.0, 14.0)), 25.0)
    for axis, number in ((0, 2), (1, 1)):
        ends, reached = (
            sorted(
                of.place_um(0, *((at, 0) if axis else (0, at)))[axis]
                for at in (least, of.shape[number] - 1 - least)
            )
            for of, least in ((grid, -0.5), (fine, 0))
        )
        assert reached == pytest.approx(ends, abs=25.0)


@pytest.mark.parametrize("plane", range(4))
def test_the_light_of_a_plane_stays_where_steps_differ(plane):
    grid = Grid((4, 40, 40), (20, 20), 1e3 * np.array([10.0, 12.0, 13.0, 17.0]), np.full(4, 25.0))
    volume = np.zeros(grid.shape, np.float32)
    volume[plane, 10:30, 10:30] = 1
    made, _ = metric_volume(volume, grid, 25.0)
    assert made.sum(dtype=float) == pytest.approx(volume.sum(), rel=0.02)


@pytest.mark.parametrize(("z_mm", "voxel_um"), [((5, 20), 1000.0), ((5, 20), 700.0), ((1, 10, 12, 14), None)])
def test_a_metric_grid_ends_before_the_diffuser(z_mm, voxel_um):
    """Half a step before the nearest plane may lie behind it, where no ray of a scene comes from."""
    z_um = 1e3 * np.array(z_mm, float)
    grid = Grid((len(z_um), 60, 80), (30, 40), z_um, 0.05 * z_um)
    for plane in range(len(z_um)):
        volume = np.zeros(grid.shape, np.float32)
        volume[plane, 20:40, 20:60] = 1
        made, placed = metric_volume(volume, grid, voxel_um)
        assert placed.z_um[0] >= 0.499 * placed.spacing_um[0]
        assert made.min() >= 0
        assert made.sum(dtype=float) == pytest.approx(volume.sum(), rel=0.05)


def test_a_deep_voxel_is_the_mean_of_what_lies_about_it():
    """Light that grows evenly with depth does so on voxels five planes deep, too, and is centred on them."""
    z = np.arange(40) * 10.0 + 1e5
    even = Grid((40, 9, 9), (4, 4), z, np.full(40, 50.0), upright=True)
    ramp = np.broadcast_to(np.arange(40, dtype=np.float32)[:, None, None], even.shape)
    metric, placed = metric_volume(np.ascontiguousarray(ramp), even, 50.0)
    np.testing.assert_allclose(metric[3:-3, 4, 4], 5 * (placed.z_um[3:-3] - 1e5) / 10, rtol=1e-5)


def test_equal_voxels_stay_as_they_are():
    even = Grid((4, 9, 7), (4, 3), np.arange(4) * 50.0 + 1000, np.full(4, 5.0), upright=True)
    volume = np.random.default_rng(1).random(even.shape, np.float32)
    metric, placed = metric_volume(volume, even)
    np.testing.assert_allclose(metric, volume, rtol=1e-5)
    assert placed.place_um(2, 1, 6) == even.place_um(2, 1, 6)


@pytest.mark.parametrize(
    ("grid", "voxel_um", "words"),
    [
        (replace(GRID, pitch_um=np.full(7, np.nan)), None, "are not known"),
        (replace(GRID, z_um=np.r_[Z_UM[:6], Z_UM[5]]), None, "same depth"),
        (Grid((1, 9, 9), (4, 4), Z_UM[:1], Z_UM[:1]), None, "one plane"),
        (GRID, -3.0, "above 0"),
        (GRID, 1e5, "too large"),
    ],
)
def test_what_cannot_be_brought_to_equal_voxels_is_refused(grid, voxel_um, words):
    with pytest.raises(InputError, match=words):
        metric_grid(grid, voxel_um)


@pytest.mark.parametrize(
    ("z_um", "deep"), [((10, 10.5), 0.5), ((10, 12), 2), ((10, 12, 15), 3), ((10, 12, 15, 19, 24, 30), 5)]
)
def test_a_voxel_is_as_deep_as_the_step_beside_the_middle_plane(z_um, deep):
    n = len(z_um)
    metric = metric_grid(Grid((n, 9, 9), (4, 4), np.array(z_um, float), np.ones(n)))
    np.testing.assert_allclose(np.diff(metric.z_um), deep)


@pytest.mark.parametrize(("planes", "reach"), [(2, 3.6), (2, 20), (3, 4), (3, 20), (4, 8), (4, 20)])
def test_few_planes_that_lie_far_apart_have_voxels_too(planes, reach):
    z = 22e3 / np.linspace(1, 1 / reach, planes)
    metric = metric_grid(Grid((planes, 9, 9), (4, 4), z, 2e-3 * z))
    assert 2 <= len(metric.z_um) <= 2 * planes
    assert metric.z_um[0] > 0


@pytest.mark.parametrize(("n", "middle"), [(2, 1), (3, 1), (6, 3), (7, 3)])
def test_a_voxel_is_as_wide_as_a_pixel_of_the_middle_plane(n, middle):
    z = 1000.0 + 10 * np.arange(n)
    metric = metric_grid(Grid((n, 40, 40), (20, 20), z[::-1], z[::-1] / 100))
    np.testing.assert_allclose(metric.pitch_um, z[middle] / 100)


@pytest.mark.parametrize(("off", "metric"), [(0.0, True), (0.02, True), (0.03, False)])
def test_voxels_that_differ_by_a_thousandth_have_one_size(off, metric):
    sizes = np.array([25.0, 25.0 + off, 25.0])
    assert Grid((3, 9, 9), (4, 4), np.array([500.0, 550, 600]), sizes).is_metric == metric
    assert Grid((3, 9, 9), (4, 4), np.array([500.0, 525, 550 + off]), np.full(3, 9.0)).is_metric == metric


def test_the_mean_over_a_deep_voxel_is_that_of_eighths_of_its_triangle():
    """By hand: a voxel two planes deep looks at 0, +-1/2, +-1 and +-3/2 planes with weights 4, 3, 2 and 1."""
    weights = _between(np.arange(5.0), np.array([2.0]), 2.0)
    np.testing.assert_allclose(weights, np.array([[1, 8, 14, 8, 1]]) / 32)


@pytest.mark.parametrize(("z_um", "reach"), [((10, 12, 20), 1), ((1, 10, 20), 1), ((4, 10, 20), 3)])
def test_a_volume_goes_on_half_a_step_before_its_nearest_plane_or_to_the_diffuser(z_um, reach):
    assert _nearer(np.array(z_um, float)) == reach


def test_places_of_one_plane_span_the_pixels_that_see_them():
    grid = Grid((2, 20, 30), (10, 15), np.array([1000.0, 3000.0]), np.array([2.0, 6.0]), 2.0, None, True)
    places = np.array([[4.0, -2.0, 1100.0], [-12.0, 18.0, 2900.0]])  # 2 and -1 pixels; -2 and 3 pixels
    assert grid.spanned_by(places) == (9.0, 13.0, 13.0, 17.0)
    turned = replace(grid, upright=False)
    assert turned.spanned_by(places) == (7.0, 13.0, 11.0, 17.0)
    assert grid.spanned_by(np.full((1, 3), np.nan)) is None
    assert replace(grid, pitch_um=np.array([np.nan, 6.0])).spanned_by(places) is None


def test_differences_weigh_by_the_faces_between_voxels():
    """A z face is pitch^2, an x face pitch times spacing; the last plane's spacing is that before it."""
    grid = Grid((3, 9, 9), (4, 4), np.array([1000.0, 1400.0, 1500.0]), np.array([10.0, 14.0, 15.0]))
    np.testing.assert_allclose(grid.axis_weights(), [[10 / 400, 1, 1], [14 / 100, 1, 1], [15 / 100, 1, 1]])
    unknown = replace(grid, pitch_um=np.array([10.0, np.nan, 15.0]))
    np.testing.assert_array_equal(unknown.axis_weights(), np.ones((3, 3)))
    one = Grid((1, 9, 9), (4, 4), np.array([1000.0]), np.array([10.0]))
    np.testing.assert_array_equal(one.axis_weights(), [[0, 1, 1]])
    assert np.isnan(one.spacing_um).all()
    assert len(one.spacing_um) == 1


@pytest.mark.parametrize("upright", [False, True])
def test_a_pixel_looks_where_the_pitch_says_and_a_place_is_seen_there(upright):
    grid = replace(GRID, upright=upright)
    sign = 1 if upright else -1
    x, y, z = grid.place_um(2, 43.0, 55.0)
    pitch = sign * 2e-3 * Z_UM[2]
    assert (x, y, z) == pytest.approx(
        (GRID.axis_um[2, 0] - 5 * pitch, GRID.axis_um[2, 1] + 3 * pitch, Z_UM[2])
    )
    assert grid.pixel_of(2, x, y) == pytest.approx((43.0, 55.0))
    assert grid.pixel_mrad == pytest.approx(2.0)
    plain = replace(grid, axis_um=None)
    angles = [np.degrees(np.arctan(sign * 2e-3 * pixels)) for pixels in (-5, 3)]
    assert plain.direction_deg(43.0, 55.0) == pytest.approx(tuple(angles))
    assert plain.pixel_of(2, 0.0, 0.0) == (40.0, 60.0)


def test_two_voxels_fit_into_the_depth_from_half_a_step_before_the_planes_to_half_a_step_behind():
    grid = Grid((3, 9, 9), (4, 4), np.array([1000.0, 1100, 1200]), np.full(3, 100.0))
    assert metric_grid(grid, 150.0).is_metric
    with pytest.raises(InputError, match="depth of 300 um"):
        metric_grid(grid, 151.0)
    np.testing.assert_array_equal(
        replace(grid, z_um=np.array([1200.0, 1100, 1050])).spacing_um, [100, 50, 50]
    )
    two = Grid((2, 9, 9), (4, 4), np.array([1000.0, 1100]), np.full(2, 100.0))
    np.testing.assert_array_equal(two.spacing_um, [100, 100])


def test_voxels_whose_middles_are_on_the_outermost_pixels_edges_belong_to_the_volume():
    grid = Grid((4, 9, 7), (4, 3), np.arange(4) * 50.0 + 1000, np.full(4, 5.0), upright=True)
    assert metric_grid(grid, 2.5).shape[1:] == (19, 15)  # 4.5 and 3.5 pixels on either side


def test_one_column_of_pixels_has_voxels_too():
    metric = metric_grid(Grid((4, 9, 1), (4, 0), np.arange(4) * 50.0 + 1000, np.full(4, 5.0), upright=True))
    assert metric.shape == (4, 9, 1)


def test_shares_add_up_about_their_plane_and_lie_wherever_it_is_the_nearest_on_a_side():
    nodes, places = np.array([100.0, 110.0, 122.0, 132.0]), np.arange(86.0, 147.0, 3.0)
    shares = _shares(nodes, places, 3.0)
    assert (shares >= 0).all()
    np.testing.assert_allclose(shares.sum(axis=0), 1)
    np.testing.assert_allclose(places @ shares, nodes, atol=1e-6)
    assert not shares[(places < 93) | (places > 139)].any()  # half a step before and behind it ends
    for k, (near, far) in enumerate([(100.0, 110.0), (100.0, 122.0), (110.0, 132.0)]):
        if k:
            np.testing.assert_array_equal(shares[:, k] > 0, (places > near) & (places < far))


def test_a_plane_on_the_outermost_place_is_there_alone():
    nodes = np.array([100.0, 112.0, 121.0])
    shares = _shares(nodes, np.arange(100.0, 122.0, 3.0), 3.0)
    np.testing.assert_allclose(shares[:, 0], np.eye(8)[0])
    np.testing.assert_allclose(shares[:, 2], np.eye(8)[7])


def test_shares_are_tilted_until_their_mean_is_in_the_middle_or_they_lean_as_far_as_they_may():
    off = np.array([-1.0, 0.0, 1.0, 2.0])
    shares = _centred(np.array([2.0, 3.0, 3.0, 1.0]), off)
    assert shares.sum() == pytest.approx(1)
    assert shares @ off == pytest.approx(0, abs=1e-9)
    lean = np.log(shares / np.array([2.0, 3.0, 3.0, 1.0]))
    np.testing.assert_allclose(np.diff(lean), np.diff(lean)[0])
    far = np.array([-0.1, 5.0, 9.9])
    expected = np.exp(-LEAN * far / 10)
    np.testing.assert_allclose(_centred(np.ones(3), far), expected / expected.sum(), rtol=1e-9)
    np.testing.assert_allclose(_centred(np.ones(3), -far[::-1])[::-1], expected / expected.sum(), rtol=1e-9)


@pytest.mark.parametrize(("z_um", "words"), [(12_500.0, "12.5 mm"), (1e9, "infinity"), (0.99e9, "990000 mm")])
def test_a_depth_is_told_in_millimetres_up_to_what_counts_as_infinity(z_um, words):
    assert depth_in_words(z_um) == words
