"""Films as OME-TIFF: every value, each picture's time, sizes and places, read by somebody else's readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.reconstruction.film import Film
from instrument.reconstruction.video_files import VideoPictures, create_output
from recon.camera.grid import Grid

Z_UM = np.array([9000.0, 10000.0, 11500.0])
DEEP = Grid((3, 24, 32), (12, 16), Z_UM, 2e-3 * Z_UM)
FLAT = Grid((1, 24, 32), (12, 16), Z_UM[:1], 2e-3 * Z_UM[:1])
LOST = 2


@pytest.mark.parametrize(
    ("grid", "shape", "axes"),
    [
        (None, (24, 32), "TYX"),
        (FLAT, (24, 32, 3), "TCYX"),
        (DEEP, (3, 24, 32), "TZYX"),
        (DEEP, (3, 24, 32, 3), "TZCYX"),
    ],
)
def test_a_film_is_read_by_others(
    tmp_path: Path, grid: Grid | None, shape: tuple[int, ...], axes: str
) -> None:
    ome_types = pytest.importorskip("ome_types")
    path, out = tmp_path / "fish.ome.zarr", tmp_path / "fish.ome.tif"
    create_output(path, 5, shape, period_s=0.05, grid=grid, attributes={"simulated": True})
    pictures = VideoPictures(path, write=True)
    taken = np.random.default_rng(0).random((5, *shape), np.float32)
    for index in set(range(5)) - {LOST}:
        pictures.write(index, taken[index])
    assert main(["export", str(path), str(out)]) == 0
    there = np.delete(taken, LOST, axis=0)
    with tifffile.TiffFile(out) as tiff:
        assert tiff.series[0].axes == axes
        stored = tiff.asarray()
    np.testing.assert_array_equal(np.moveaxis(stored, axes.index("C"), -1) if "C" in axes else stored, there)
    image = ome_types.from_tiff(out).images[0]
    assert image.name == "fish"
    told = image.pixels
    at_s = {plane.the_t: (plane.delta_t, str(plane.delta_t_unit.value)) for plane in told.planes}
    assert at_s == {k: (pytest.approx(at), "s") for k, at in enumerate([0, 0.05, 0.15, 0.2])}
    assert told.time_increment is None  # one is missing
    if grid is None:
        assert told.physical_size_x is None
    else:
        assert told.physical_size_x == grid.pitch_um[len(grid.z_um) // 2]
    if grid is DEEP:
        assert {plane.position_z for plane in told.planes if plane.the_z == 1} == {10000.0}
    if "C" in axes:
        assert [channel.name for channel in told.channels] == ["red", "green", "blue"]
    assert main(["export", str(path), str(out)]) == 2, "what is there stays"
    assert Film(path).facts["simulated"] is True


def test_even_times_are_told_as_one_increment(tmp_path: Path) -> None:
    ome_types = pytest.importorskip("ome_types")
    path = tmp_path / "film.ome.zarr"
    create_output(path, 3, (8, 8), period_s=0.1, grid=None, attributes={})
    pictures = VideoPictures(path, write=True)
    for index in range(3):
        pictures.write(index, np.full((8, 8), index, np.float32))
    assert main(["export", str(path), str(tmp_path / "film.tif")]) == 0
    told = ome_types.from_tiff(tmp_path / "film.tif").images[0].pixels
    assert (told.time_increment, told.time_increment_unit.value) == (pytest.approx(0.1), "s")
