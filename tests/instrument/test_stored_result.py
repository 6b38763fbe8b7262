"""Results are read back as they were written, and volumes without reading what is not looked at."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
import zarr

from instrument.cli import main
from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.files.results import find_results, free_result
from instrument.reconstruction.result_figures import in_colour_of_depth, project
from instrument.reconstruction.stored_result import open_result, record_file
from instrument.volumes.opening import open_volume
from instrument.volumes.source import volume_in_memory
from instrument.volumes.writing import write_volume_zarr
from recon.camera.grid import Grid

SHAPE = (5, 40, 30)
UNKNOWN = Grid(SHAPE, (20, 15), np.full(5, np.nan), np.full(5, np.nan))


@pytest.fixture
def volume():
    return np.random.default_rng(0).random(SHAPE, np.float32)


def _write(kind, folder, voxels):
    if kind == "zarr":
        path = folder / "v.ome.zarr"
        write_volume_zarr(path, voxels, voxels.shape, UNKNOWN, {})
        return path
    if kind == "npy":
        np.save(folder / "v.npy", voxels)
        return folder / "v.npy"
    path = folder / "v.tif"
    stored = voxels if voxels.ndim == 3 else np.moveaxis(voxels, -1, 1)
    axes = "ZYX" if voxels.ndim == 3 else "ZCYX"
    compression = "zlib" if kind == "compressed" else None
    tifffile.imwrite(
        path, stored, ome=True, metadata={"axes": axes}, compression=compression, photometric="minisblack"
    )
    return path


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["tiff", "compressed", "zarr", "npy"])
def test_every_format_gives_the_same_planes_and_slices(tmp_path, volume, kind, channels):
    voxels = volume if channels == 1 else np.stack([volume, 2 * volume, 3 * volume], axis=-1)
    source = open_volume(_write(kind, tmp_path, voxels))
    assert source.shape == SHAPE
    assert source.n_channels == channels
    np.testing.assert_array_equal(source.plane(3), voxels[3])
    np.testing.assert_array_equal(source.across_y(7), voxels[:, 7])
    np.testing.assert_array_equal(source.across_x(11), voxels[:, :, 11])
    source.close()


def test_a_tiff_in_one_piece_is_mapped_not_read(tmp_path, volume, monkeypatch):
    path = _write("tiff", tmp_path, volume)
    monkeypatch.setattr(tifffile.TiffPage, "asarray", lambda *a, **k: pytest.fail("read whole"))
    assert open_volume(path).plane(2)[5, 6] == volume[2, 5, 6]


def test_side_views_of_large_planes_come_from_a_coarser_level(tmp_path, monkeypatch):
    monkeypatch.setattr("instrument.volumes.source._SIDE_PIXELS", 128 * 128)
    voxels = np.random.default_rng(1).random((2, 256, 256), np.float32)
    write_volume_zarr(tmp_path / "v.ome.zarr", voxels, voxels.shape, UNKNOWN, {})
    source = open_volume(tmp_path / "v.ome.zarr")
    assert source.plane(0).shape == (256, 256)
    expected = voxels[:, 200:202].reshape(2, 2, 128, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(source.across_y(201), expected, rtol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_projections_are_the_brightest_along_each_axis(volume, tmp_path, channels):
    voxels = volume if channels == 1 else np.stack([volume, 0 * volume, volume], axis=-1)
    plain = volume if channels == 1 else volume * np.float32(2 / 3)
    told = []
    views = project(volume_in_memory(voxels, tmp_path), lambda done, total: told.append((done, total)))
    np.testing.assert_allclose(views.front, plain.max(axis=0), rtol=1e-6)
    np.testing.assert_allclose(views.top, plain.max(axis=1), rtol=1e-6)
    np.testing.assert_allclose(views.side, plain.max(axis=2), rtol=1e-6)
    np.testing.assert_array_equal(views.deepest, plain.argmax(axis=0))
    assert told[-1] == (5, 5)


def test_depth_is_blue_in_front_and_red_behind():
    shown = in_colour_of_depth(np.array([[1.0, 1.0, 0.0]], np.float32), np.array([[0, 9, 4]]), 10, 1.0)
    assert shown[0, 0, 2] > 2 * shown[0, 0, 0]
    assert shown[0, 1, 0] > 2 * shown[0, 1, 2]
    assert not shown[0, 2].any()


def test_a_picture_is_told_from_a_volume_and_its_record_read(tmp_path):
    picture = np.random.default_rng(0).random((20, 30), np.float32)
    write_image(tmp_path / "p.tif", picture)
    (tmp_path / "p.png").write_bytes(b"never read")
    record = {
        "grid": {"shape": [20, 30], "object_pitch_um": 12.5},
        "provenance": {"model": "local", "model_reason": "the PSFs differ by 12 %"},
        "method": "admm",
        "prior": "tv",
        "tau": 1e-3,
        "stop_reason": "cancelled",
        "seconds": 2.0,
        "noise_norm": 24.0,
        "history": [{"iteration": 1, "seconds": 0.5, "data_residual": 30.0, "change": None}],
        "warnings": ["Dust."],
        "simulated": True,
    }
    (tmp_path / "p.json").write_text(json.dumps(record))
    for name in ("p.tif", "p.json", "p.png"):
        result = open_result(tmp_path / name)
        assert result.path == tmp_path / "p.tif"
        np.testing.assert_array_equal(result.image, picture)
        assert result.volume is None
        assert result.pitch_um == 12.5
        assert result.simulated
        assert result.warnings == ("Dust.",)
        assert result.noise_norm == 24.0
        ((first,),) = result.histories
        assert first.data_residual == 30.0
        assert np.isnan(first.change)
        facts = dict(result.facts())
        assert facts["Model"] == "local: the PSFs differ by 12 %"
        assert "after 1 iterations, 2.0 s: cancelled" in facts["Stopped"]
        assert "12.5 um" in facts["Size"]


@pytest.mark.parametrize("kind", ["tiff", "zarr", "npy"])
def test_a_volume_from_elsewhere_opens_without_a_record(tmp_path, volume, kind):
    result = open_result(_write(kind, tmp_path, volume))
    assert result.image is None
    assert result.volume.shape == SHAPE
    assert result.histories == ()
    assert result.planes_um is None
    assert dict(result.facts())["Size"].startswith("5 x 40 x 30 voxels")


def test_what_the_program_chose_is_told_with_its_reasons(tmp_path):
    write_image(tmp_path / "p.tif", np.ones((20, 30), np.float32))
    decisions = [
        {"name": "model", "value": "convolution", "why": "the PSFs differ by 2 %"},
        {"name": "binning", "value": "2", "why": "nothing finer is resolved", "overruled": True},
    ]
    verdict = {"region": "outside", "sentences": ["not reliable: outside."]}
    record = {
        "grid": {"shape": [20, 30]},
        "prior": "tv",
        "verdict": verdict,
        "provenance": {"model": "convolution", "auto": {"decisions": decisions}},
    }
    (tmp_path / "p.json").write_text(json.dumps(record))
    result = open_result(tmp_path / "p.tif")
    facts = result.facts()
    assert [value for name, value in facts if name == "Model"] == ["convolution: the PSFs differ by 2 %"]
    assert ("Binning", "2: nothing finer is resolved (as asked)") in facts
    assert ("Verdict", "not reliable: outside.") in facts
    assert result.warnings == ("not reliable: outside.",)


def test_names_of_records():
    assert record_file(Path("a/v.ome.zarr")).name == "v.json"
    assert record_file(Path("a/v.x.tif")).name == "v.x.json"


def test_what_is_no_result_is_refused_in_words(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        open_result(tmp_path / "absent.tif")
    (tmp_path / "lonely.json").write_text("{}")
    with pytest.raises(FileError, match="beside this record"):
        open_result(tmp_path / "lonely.json")
    (tmp_path / "p.json").write_text("{")
    write_image(tmp_path / "p.tif", np.zeros((4, 4), np.float32))
    with pytest.raises(FileError, match="cannot be read as JSON"):
        open_result(tmp_path / "p.tif")
    (tmp_path / "v.ome.zarr").mkdir()
    with pytest.raises(FileError, match="no OME-Zarr"):
        open_result(tmp_path / "v.ome.zarr")
    (tmp_path / "t.tif").write_bytes(b"no tiff at all")
    with pytest.raises(FileError):
        open_result(tmp_path / "t.tif")
    np.save(tmp_path / "five.npy", np.zeros((1, 2, 3, 4, 5)))
    with pytest.raises(FileError, match=r"\(1, 2, 3, 4, 5\)"):
        open_volume(tmp_path / "five.npy")


def test_export_command_takes_results_too(tmp_path, volume, capsys):
    np.save(tmp_path / "v.npy", volume)
    assert main(["export", str(tmp_path / "v.npy"), str(tmp_path / "v.ome.zarr")]) == 0
    assert main(["export", str(tmp_path / "v.ome.zarr"), str(tmp_path / "v.tif")]) == 0
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "v.tif"), volume)
    colour = np.stack([volume, 2 * volume, 3 * volume], axis=-1)
    np.save(tmp_path / "c.npy", colour)
    assert main(["export", str(tmp_path / "c.npy"), str(tmp_path / "c.tif")]) == 0
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "c.tif"), np.moveaxis(colour, -1, 1))
    assert main(["export", str(tmp_path / "v.tif"), str(tmp_path / "v.jpg")]) == 2
    assert main(["export", str(tmp_path / "v.tif"), str(tmp_path / "c.tif")]) == 2
    assert main(["export", str(tmp_path / "v.tif"), str(tmp_path / "n.npy"), "--label", "psf"]) == 2
    said = capsys.readouterr().err
    assert "a volume is exported as .tif" in said
    assert "exists already" in said
    assert "--label (for a run)" in said


def test_export_brings_a_volume_to_voxels_of_one_size(tmp_path, capsys):
    """A bead is where it was: read by tifffile and zarr, whose scales and origins are the scene's."""
    z_um = np.array([9000.0, 10000.0, 11200.0])
    grid = Grid((3, 40, 30), (18, 16), z_um, 2e-3 * z_um, None, np.full((3, 2), 40.0))
    voxels = np.zeros(grid.shape, np.float32)
    voxels[2, 8, 25] = 1
    write_volume_zarr(tmp_path / "v.ome.zarr", voxels, voxels.shape, grid, {})
    for name in ("m.ome.zarr", "m.tif"):
        assert main(["export", str(tmp_path / "v.ome.zarr"), str(tmp_path / name), "--metric"]) == 0
    group = zarr.open_group(tmp_path / "m.ome.zarr", mode="r")
    first, second = group.attrs["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]
    scale, shift = first["scale"], second["translation"]
    stored = group["0"][...]
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "m.tif"), stored)
    x, y, z = grid.place_um(2, 8, 25)
    found = np.array(shift) + np.array(scale) * np.unravel_index(stored.argmax(), stored.shape)
    assert (np.abs(found - [z, y, x]) <= np.array(scale) / 2).all()
    assert open_result(tmp_path / "m.ome.zarr").grid.is_metric
    assert "voxels of plane z" not in str(group.attrs["diffuserbench"])
    source = open_result(tmp_path / "v.ome.zarr").metric().volume
    row = int(stored.max(axis=(0, 2)).argmax())
    np.testing.assert_array_equal(source.across_y(row), stored[:, row])
    np.save(tmp_path / "n.npy", voxels)
    for arguments in (["n.npy", "--metric"], ["v.ome.zarr", "--voxel-um", "5"]):
        assert main(["export", str(tmp_path / arguments[0]), str(tmp_path / "o.tif"), *arguments[1:]]) == 2
    told = capsys.readouterr()
    assert "z 9 to 11.4, y" in told.out
    assert "are not known" in told.err
    assert "give --metric too" in told.err


def test_results_of_a_folder_are_listed_newest_first(tmp_path):
    for number, place in enumerate(("a", "runs/b")):
        folder = tmp_path / place
        folder.mkdir(parents=True)
        write_image(folder / "r.tif", np.zeros((4, 4), np.float32))
        record = {"program": "diffuserbench 1", "grid": {}, "prior": "tv", "inputs": {}}
        (folder / "r.json").write_text(json.dumps(record))
        os.utime(folder / "r.json", (1e9 + number, 1e9 + number))
    (tmp_path / "other.json").write_text('{"program": "diffuserbench 1"}')
    (tmp_path / "gone.json").write_text((tmp_path / "a" / "r.json").read_text())
    assert find_results(tmp_path) == [tmp_path / "runs/b/r.json", tmp_path / "a/r.json"]
    assert find_results(tmp_path / "absent") == []
    assert free_result(tmp_path / "a", "r", ".tif").name == "r-2.tif"
    assert free_result(tmp_path / "a", "new", ".tif").name == "new.tif"
