"""Volumes as OME-Zarr, read back by zarr-python and held against the OME-Zarr model library."""

from dataclasses import replace

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05 import Image

from instrument.reconstruction.job import Job
from instrument.reconstruction.result_file import Outputs, write_reconstruction
from instrument.volumes.grid_facts import grid_facts
from instrument.volumes.opening import open_volume
from instrument.volumes.writing import write_volume_tiff, write_volume_zarr
from recon import Calibration, Options, Problem, solve
from recon.camera.grid import Grid

Z_UM = np.array([9000.0, 10000.0, 11500.0])
GRID = Grid((3, 300, 200), (150, 100), Z_UM, 2e-3 * Z_UM)
UNKNOWN = Grid((3, 300, 200), (150, 100), np.full(3, np.nan), np.full(3, np.nan))


@pytest.fixture
def volume():
    return np.random.default_rng(0).random((3, 300, 200), np.float32)


def test_levels_scales_and_every_planes_own_size(tmp_path, volume):
    path = tmp_path / "v.ome.zarr"
    write_volume_zarr(path, volume, volume.shape, GRID, {"simulated": True})
    group = zarr.open_group(path, mode="r")
    model = Image.from_zarr(group)
    np.testing.assert_array_equal(group["0"][...], volume)
    first, second, third = model.ome_attributes.multiscales[0].datasets
    assert first.coordinateTransformations[0].scale == [1500.0, 20.0, 20.0]
    assert second.coordinateTransformations[0].scale == [1500.0, 40.0, 40.0]
    assert first.coordinateTransformations[1].translation == [9000.0, -3000.0, -2000.0]
    assert second.coordinateTransformations[1].translation == [9000.0, -2990.0, -1990.0]
    assert third.path == "2"
    np.testing.assert_allclose(group["1"][1, 7, 9], volume[1, 14:16, 18:20].mean(), rtol=1e-6)
    assert group["0"].chunks == (1, 300, 200)
    assert group.attrs["diffuserbench"]["z_um"] == Z_UM.tolist()
    assert group.attrs["diffuserbench"]["simulated"] is True


def test_an_ome_tiff_says_where_its_planes_lie(tmp_path, volume):
    ome_types = pytest.importorskip("ome_types")
    colour = np.stack([volume, 2 * volume, 3 * volume], -1)
    write_volume_tiff(tmp_path / "v.ome.tif", iter(colour), colour.shape, GRID)
    pixels = ome_types.from_tiff(tmp_path / "v.ome.tif").images[0].pixels
    assert [(p.the_z, p.the_c, p.position_z) for p in pixels.planes] == [
        (z, c, Z_UM[z]) for z in range(3) for c in range(3)
    ]
    assert (pixels.planes[0].position_x, pixels.planes[0].position_y) == (-2000.0, -3000.0)
    for planes in (volume, colour):  # and the program itself knows the grid again
        write_volume_tiff(tmp_path / "again.tif", iter(planes), planes.shape, GRID)
        source = open_volume(tmp_path / "again.tif")
        assert source.facts == {"words": source.facts["words"], **grid_facts(GRID)}
        assert source.facts["words"].startswith("Perspective grid")
        source.close()


def test_an_ome_tiff_in_colour_says_which_channel_is_which(tmp_path, volume):
    ome_types = pytest.importorskip("ome_types")
    path = tmp_path / "fish.ome.tif"
    write_volume_tiff(path, volume[..., None] * np.float32([1, 2, 3]), (*volume.shape, 3), GRID)
    image = ome_types.from_tiff(path).images[0]
    assert image.name == "fish"
    channels = image.pixels.channels
    assert [channel.name for channel in channels] == ["red", "green", "blue"]
    colours = [channel.color.as_rgb_tuple(alpha=False) for channel in channels]
    assert colours == [(255, 0, 0), (0, 255, 0), (0, 0, 255)]


def test_colour_goes_first_and_unknown_sizes_have_no_unit(tmp_path, volume):
    path = tmp_path / "v.ome.zarr"
    colour = np.stack([volume, 2 * volume, 3 * volume], -1)
    write_volume_zarr(path, colour, colour.shape, UNKNOWN, {})
    group = zarr.open_group(path, mode="r")
    axes = Image.from_zarr(group).ome_attributes.multiscales[0].axes
    assert [a.name for a in axes] == ["c", "z", "y", "x"]
    assert axes[1].unit is None
    shown = group.attrs["ome"]["omero"]["channels"]
    assert [channel["color"] for channel in shown] == ["FF0000", "00FF00", "0000FF"]
    assert shown[0]["window"]["end"] == pytest.approx(3 * volume.max())
    np.testing.assert_array_equal(group["0"][2], 3 * volume)
    assert group.attrs["diffuserbench"]["pitch_um"] is None


def test_a_volume_there_before_survives_a_failure(tmp_path, volume, monkeypatch):
    path = tmp_path / "v.ome.zarr"
    write_volume_zarr(path, volume, volume.shape, GRID, {})

    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("instrument.files.atomic.sync_folder", full)
    with pytest.raises(OSError, match="No space"):
        write_volume_zarr(path, 2 * volume, volume.shape, GRID, {})
    np.testing.assert_array_equal(zarr.open_group(path, mode="r")["0"][...], volume)
    assert [p.name for p in tmp_path.iterdir()] == ["v.ome.zarr"]
    monkeypatch.undo()
    write_volume_zarr(path, 2 * volume, volume.shape, GRID, {})
    np.testing.assert_array_equal(zarr.open_group(path, mode="r")["0"][...], 2 * volume)
    assert [p.name for p in tmp_path.iterdir()] == ["v.ome.zarr"]


def test_a_folder_that_is_no_zarr_is_never_taken(tmp_path):
    place = tmp_path / "v.ome.zarr"
    place.mkdir()
    (place / "thesis.tex").write_text("all of it")
    outputs = Outputs.named(place, volume=True)
    assert outputs.preview.name == "v.png"
    with pytest.raises(Exception, match="is no Zarr folder"):
        outputs.check(0, overwrite=True)


def test_what_an_older_result_left_beside_goes_with_it(tmp_path):
    """An older residual beside a new picture would be taken for the new one's."""
    calibration = Calibration(np.eye(16, dtype=np.float32)[None, None] + 0.1, np.full((1, 3), np.nan))
    image = np.random.default_rng(0).random((16, 16)).astype(np.float32)
    result = solve(Problem.of(image, calibration, Options(model="convolution", iterations=2, judged=False)))
    outputs, job = Outputs.named(tmp_path / "a.tif"), Job(image, calibration, {})
    write_reconstruction(outputs, replace(result, residual=image), job)
    assert outputs.residual.exists()
    write_reconstruction(outputs, replace(result, residual=None), job)
    assert not outputs.residual.exists()
    assert outputs.image.exists()
    assert outputs.record.exists()
