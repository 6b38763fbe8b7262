"""``diffuserbench points``: from a volume on disk to a table of places; mistakes in words."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.volumes.writing import write_volume_zarr
from recon.camera.grid import Grid

Z_UM = 1 / np.linspace(1 / 10e3, 1 / 20e3, 5)
GRID = Grid((5, 40, 50), (20, 25), Z_UM, 1e-3 * Z_UM)


@pytest.fixture
def volume(tmp_path: Path) -> Path:
    voxels = np.zeros(GRID.shape, np.float32)
    voxels[2, 12, 30:32] = 30, 10
    voxels[0, 30, 9] = 4
    path = tmp_path / "beads.ome.zarr"
    write_volume_zarr(path, voxels, voxels.shape, GRID, {})
    return path


def test_the_table_has_places_deviations_and_light(
    volume: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "beads.csv"
    assert main(["points", str(volume), "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert "Points      2" in told.out
    assert "1 point is brightest in an outermost plane; it may lie beyond it" in " ".join(told.err.split())
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [float(row["light"]) for row in rows] == [40, 4]
    place = GRID.place_um(2, 12, 30)
    quarter = 0.25 * GRID.pitch_um[2]
    found = [float(rows[0][f"{axis}_um"]) for axis in "xyz"]
    np.testing.assert_allclose(found, [place[0] - quarter, place[1], place[2]], rtol=1e-5)
    assert [float(rows[0][name]) for name in ("plane", "row", "column")] == [2, 12, 30.25]
    assert all(float(rows[0][f"{axis}_deviation_um"]) > 0 for axis in "xyz")
    assert [row["in_outermost_plane"] for row in rows] == ["0", "1"]
    assert main(["points", str(volume), "--out", str(out), "--least", "0.5"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["points", str(volume), "--out", str(out), "--least", "0.5", "--force"]) == 0
    assert len(out.read_text().splitlines()) == 2


def test_a_volume_that_knows_no_places_gives_voxels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stack, out = tmp_path / "stack.npy", tmp_path / "points.csv"
    voxels = np.zeros((3, 20, 20), np.float32)
    voxels[1, 7, 9] = 1
    np.save(stack, voxels)
    assert main(["points", str(stack), "--out", str(out)]) == 0
    (row,) = csv.DictReader(out.read_text().splitlines())
    assert (row["x_um"], row["z_deviation_um"], row["plane"], row["column"]) == ("", "", "1", "9")
    assert "A .npy keeps no places" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("depth", "value", "words"),
    [
        (3, -1, "nothing in the volume is above 0"),
        (3, 1, "other programs' tell steps at most"),
        (2, 1, "the volume has two planes"),
    ],
)
def test_volumes_from_elsewhere_are_not_blamed_for_another_thing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], depth: int, value: int, words: str
) -> None:
    stack = tmp_path / "stack.ome.tif"
    voxels = np.full((depth, 20, 20), min(value, 0), np.float32)
    voxels[1, 7, 9] = value
    tifffile.imwrite(stack, voxels, metadata={"axes": "ZYX", "PhysicalSizeZ": 2, "PhysicalSizeX": 1})
    assert main(["points", str(stack), "--out", str(tmp_path / "points.csv")]) == 0
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["metric.ome.zarr", "metric.tif"])
def test_an_export_with_finer_voxels_has_as_many_points(
    tmp_path: Path, volume: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    metric, out = tmp_path / name, tmp_path / "points.csv"
    assert main(["export", str(volume), str(metric), "--metric", "--voxel-um", "60"]) == 0
    assert main(["points", str(metric), "--out", str(out), "--least", "0.02"]) == 0
    assert "does not tell the planes it was made of" not in " ".join(capsys.readouterr().err.split())
    assert [row["in_outermost_plane"] for row in csv.DictReader(out.read_text().splitlines())] == ["0", "1"]


def test_a_metric_volume_that_tells_no_planes_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, z_um = tmp_path / "metric.ome.zarr", 1e4 + 10.0 * np.arange(5)
    voxels = np.zeros(GRID.shape, np.float32)
    voxels[2, 12, 30] = 1
    grid = replace(GRID, z_um=z_um, pitch_um=np.full(5, 10.0), upright=True)
    write_volume_zarr(path, voxels, voxels.shape, grid, {})
    assert main(["points", str(path), "--out", str(tmp_path / "points.csv")]) == 0
    assert "does not tell the planes it was made of" in " ".join(capsys.readouterr().err.split())


def test_psfs_without_places_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, nowhere = tmp_path / "beads.ome.zarr", np.full(5, np.nan)
    voxels = np.zeros(GRID.shape, np.float32)
    voxels[2, 12, 30] = 1
    write_volume_zarr(path, voxels, voxels.shape, replace(GRID, z_um=nowhere, pitch_um=nowhere), {})
    assert main(["points", str(path), "--out", str(tmp_path / "points.csv")]) == 0
    assert "--pixel-um and --distance-mm" in " ".join(capsys.readouterr().err.split())


def test_a_picture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "picture.tif"
    tifffile.imwrite(picture, np.ones((8, 8), np.float32))
    assert main(["points", str(picture), "--out", str(tmp_path / "points.csv")]) == 2
    assert "is a picture; points in depth are found in a volume" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "points.csv").exists()
