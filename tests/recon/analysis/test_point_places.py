"""Points in volumes come out where they are: between voxels, along their rays, on any grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon import InputError
from recon.analysis import point_places as module
from recon.analysis.point_places import PointOptions, PointPlaces, point_places
from recon.camera.grid import Grid, metric_volume

D_UM, PITCH_UM = 6000.0, 6.5
SHAPE = (60, 80)


def grid_of(z_um: np.ndarray, lean_um: float = 0.0) -> Grid:
    """Return a camera's grid; its calibration's sources wander sideways by ``lean_um`` along the rail."""
    axis = lean_um * np.linspace(0, 1, len(z_um))[:, None] * [1.0, -0.5]
    return Grid((len(z_um), *SHAPE), (30, 40), z_um, PITCH_UM * z_um / D_UM, PITCH_UM, axis)


def even_in_inverse(count: int) -> np.ndarray:
    return 1 / np.linspace(1 / 10e3, 1 / 20e3, count)


def lit(grid: Grid, points: np.ndarray, lights: np.ndarray | None = None) -> np.ndarray:
    """Return a volume with each point's light shared by the planes and pixels beside it, along its ray."""
    volume = np.zeros(grid.shape, np.float32)
    for light, (x, y, z) in zip(np.ones(len(points)) if lights is None else lights, points, strict=True):
        order = np.argsort(1 / grid.z_um)
        plane = np.interp(1 / z, 1 / grid.z_um[order], np.arange(len(order))[order])
        for k in range(grid.shape[0]):
            if (share := 1 - abs(k - plane)) <= 0:
                continue
            row, column = grid.pixel_of(k, x * grid.z_um[k] / z, y * grid.z_um[k] / z)
            down, across = (
                np.maximum(1 - np.abs(np.arange(n) - at), 0)
                for n, at in zip(SHAPE, (row, column), strict=True)
            )
            volume[k] += light * share * np.outer(down, across)
    return volume


def random_points(count: int = 12) -> np.ndarray:
    """Return points apart from one another in direction, at any depth between the outermost planes."""
    rng = np.random.default_rng(3)
    rows, columns = np.divmod(rng.permutation(20)[:count], 5)
    z = 1 / rng.uniform(1 / 19e3, 1 / 10.5e3, count)
    tangents = np.stack([columns * 14 - 28, rows * 12 - 18], 1) + rng.uniform(-2, 2, (count, 2))
    return np.column_stack([tangents * PITCH_UM / D_UM * z[:, None], z])


def farthest_off(found: PointPlaces, points: np.ndarray, voxel_um: list[float]) -> float:
    """Return how many voxels the worst of the points is beside the nearest that was found."""
    off = np.abs(found.places_um[:, None] - points) / voxel_um
    return float(off.max(axis=2).min(axis=0).max())


@pytest.mark.parametrize("lean_um", [0.0, 60.0])
@pytest.mark.parametrize(("count", "step"), [(4, 1), (9, -1)], ids=["4", "9, farthest first"])
def test_points_between_planes_and_pixels_come_out_at_their_places(
    count: int, step: int, lean_um: float
) -> None:
    grid, points = grid_of(even_in_inverse(count)[::step], lean_um), random_points()
    found = point_places(lit(grid, points), grid)
    assert len(found) == len(points)
    pitch = float(grid.pitch_um.min())
    # Light in pixels that go on elsewhere on the other plane, where the rail leans, has its centre beside.
    assert farthest_off(found, points, [pitch, pitch, float(grid.spacing_um.min())]) < (
        0.3 if lean_um else 0.02
    )


def test_in_a_metric_volume_a_point_is_followed_along_its_ray() -> None:
    grid, points = grid_of(even_in_inverse(6)), random_points()
    volume, metric = metric_volume(lit(grid, points), grid)
    found = point_places(volume, metric)
    assert len(found) == len(points), "where its light goes across other columns it is no second point"
    assert farthest_off(found, points, [*metric.pitch_um[:2].tolist(), float(metric.spacing_um[0])]) < 0.5


@pytest.mark.parametrize("voxel_um", [None, 100.0, 30.0, 12.0])
def test_in_a_finer_metric_volume_a_point_is_one_and_no_better_known(voxel_um: float | None) -> None:
    z_um = 1 / np.linspace(1 / 2000, 1 / 3600, 8)
    grid = Grid((8, 31, 31), (15, 15), z_um, 20 * z_um / 2000)
    voxels = np.zeros(grid.shape, np.float32)
    voxels[4:6, 16, 23] = 0.5
    own = point_places(voxels, grid)
    volume, metric = metric_volume(voxels, grid, voxel_um)
    found = point_places(volume, metric)
    assert len(found) == len(own) == 1
    off = np.abs(found.places_um - own.places_um)[0] / [*metric.pitch_um[:2], grid.spacing_um[4]]
    assert off[2] < 0.2
    assert off[:2].max() < 0.75
    assert (found.deviations_um >= 0.7 * own.deviations_um).all()
    assert found.light[0] == pytest.approx(1, rel=0.1)
    plane, row, column = found.voxels[0]
    told = metric.place_um(round(plane), row, column)[:2]
    np.testing.assert_allclose(told, found.places_um[0, :2], atol=metric.pitch_um[0])
    assert metric.z_um[0] + plane * metric.spacing_um[0] == pytest.approx(found.places_um[0, 2], rel=0.01)


def test_the_dim_end_of_a_point_counts() -> None:
    grid = grid_of(even_in_inverse(6))
    z = 1 / (0.92 / grid.z_um[2] + 0.08 / grid.z_um[3])
    found = point_places(lit(grid, np.array([[0.0, 0.0, z]])), grid)
    np.testing.assert_allclose(found.voxels[0], [2.08, 30, 40], atol=1e-6)


def test_neighbours_keep_their_own_light() -> None:
    grid = grid_of(even_in_inverse(9))
    across, deep = 2.6 * grid.pitch_um[4], grid.z_um[7]
    points = np.array([[0, 0, grid.z_um[4]], [across, 0, grid.z_um[4]], [0, 0, deep]])
    found = point_places(lit(grid, points, np.array([1.0, 0.8, 0.3])), grid)
    np.testing.assert_allclose(found.places_um, points, atol=1e-6)
    np.testing.assert_allclose(found.light, [1.0, 0.8, 0.3], rtol=1e-5)
    assert len(point_places(lit(grid, points, np.array([1.0, 0.8, 0.3])), grid, PointOptions(least=0.4))) == 2


def test_x_and_y_are_as_unsure_as_depth_makes_them() -> None:
    grid = grid_of(even_in_inverse(6))
    z = grid.z_um[3]
    points = np.array([[0.0, 0.0, z], [25 * grid.pitch_um[3], 0.0, z]])
    found = point_places(lit(grid, points, np.array([1.0, 0.5])), grid)
    (x0, y0, z0), (x1, y1, z1) = found.deviations_um
    assert x0 == pytest.approx(module.OFF_PX * grid.pitch_um[3])
    assert (y1, z1) == pytest.approx((y0, z0))
    assert x1 == pytest.approx(np.hypot(x0, points[1, 0] / z * z1))
    blurred = lit(grid, points) + np.roll(lit(grid, points), (2, -2), (1, 2))
    assert point_places(blurred, grid).deviations_um[0, 1] > 1.5 * y0, "wider light is known less well"


def test_colours_ends_and_places_that_nobody_knows() -> None:
    grid = grid_of(even_in_inverse(5))
    points = np.array([[0, 0, grid.z_um[0]], [0, 9 * grid.pitch_um[2], grid.z_um[2]]])
    grey = lit(grid, points, np.array([2.0, 1.0]))
    coloured = np.stack([grey, 0 * grey, 2 * grey], axis=-1)
    found = point_places(coloured.__getitem__, grid)
    np.testing.assert_allclose(found.light, [6, 3], rtol=1e-6)
    assert found.at_end.tolist() == [True, False]
    nowhere = np.full(5, np.nan)
    unknown = point_places(grey, replace(grid, z_um=nowhere, pitch_um=nowhere, axis_um=None))
    assert np.isnan(unknown.places_um).all()
    np.testing.assert_allclose(unknown.voxels, [[0, 30, 40], [2, 21, 40]], atol=1e-6)
    assert len(point_places(0 * grey, grid)) == 0
    assert point_places(0 * grey, grid).places_um.shape == (0, 3)


def test_a_point_is_compared_with_those_near_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, asked = replace(grid_of(even_in_inverse(5)), shape=(5, 180, 180)), 0
    volume = np.zeros(grid.shape, np.float32)
    volume[2, 6::12, 6::12] = 1 + np.random.default_rng(0).random((15, 15))
    on_ray = module._Search._on_ray

    def counted(self: module._Search, voxel: module.Voxel, z: int) -> tuple[float, float]:
        nonlocal asked
        asked += 1
        return on_ray(self, voxel, z)

    monkeypatch.setattr(module._Search, "_on_ray", counted)
    assert len(point_places(volume, grid)) == 225
    assert asked < 60 * 225, "by pairs it is a thousand a point"


def test_the_search_for_too_many_points_can_be_stopped() -> None:
    grid, told = replace(grid_of(even_in_inverse(5)), shape=(5, 30, 40), centre=(15, 20)), []
    volume = np.random.default_rng(0).random(grid.shape).astype(np.float32)
    found = point_places(volume, grid, on_progress=told.append)
    assert told == sorted(told)
    assert len(told) > 2 * len(found) + 5, "while they are told apart, too"


def test_voxels_as_bright_as_their_neighbours_are_one_candidate() -> None:
    peaks = np.zeros((12, 12), bool)
    peaks[1:6, 1:6] = peaks[8, 2:4] = peaks[9, 9] = peaks[10, 10] = True
    rows, columns = module._plateaus(peaks)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(3, 3), (8, 3), (10, 10)]
    flat = np.zeros((5, *SHAPE), np.float32)
    flat[2, 20:40, 20:60] = 1
    assert len(point_places(flat, grid_of(even_in_inverse(5)))) == 1


def test_what_is_no_volume_of_points_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = grid_of(even_in_inverse(5))
    with pytest.raises(InputError, match="two planes or more; this has one"):
        point_places(np.ones((1, *SHAPE)), grid_of(np.array([10e3])))
    for z_um in ([-10.0, 0.0, 10.0], [0.0, 10.0, 20.0]):
        with pytest.raises(InputError, match=r"Plane 0 is at .* above 0"):
            point_places(np.ones((3, *SHAPE)), grid_of(np.array(z_um)))
    monkeypatch.setattr(module, "MOST", 3)
    with pytest.raises(InputError, match="more than 3 points as bright"):
        point_places(lit(grid, random_points()), grid)


def test_planes_of_very_different_depths_are_searched_no_farther_than_their_edges() -> None:
    """A pixel of the near plane looks at as wide an angle as 20000 of the far one (a damaged record's)."""
    grid = grid_of(np.array([1e5, 5.0]))
    volume = np.random.default_rng(2).random(grid.shape).astype(np.float32)
    search = module._Search(volume.__getitem__, grid, lambda _share: None)
    search.angles = np.array([1.0, 2e4])
    looked: list[object] = []

    class Watched(dict):  # type: ignore[type-arg]
        def get(self, key, default=None):  # type: ignore[no-untyped-def]
            looked.append(key)
            return super().get(key, default)

    search.found = Watched()
    found = search.brightest(0.9)
    cells = 2 * (SHAPE[0] // module.CELL + 1) * (SHAPE[1] // module.CELL + 1)
    assert found
    assert len(looked) <= cells * np.count_nonzero(volume >= 0.9 * volume.max())


@pytest.mark.parametrize(
    ("z_um", "said"), [([2e4, 1e4, 2e4], "Planes 0 and 2"), ([1.0, 1.0], "Planes 0 and 1")]
)
def test_planes_at_the_same_depth_are_refused(z_um: list[float], said: str) -> None:
    grid = grid_of(np.array(z_um))
    with pytest.raises(InputError, match=f"{said} are at the same depth"):
        point_places(np.ones(grid.shape, np.float32), grid)
