"""What napari is given of the program's files, and that napari itself shows it where it stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

import instrument
from instrument.files.atomic import write_json
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.napari_reader import get_reader, read
from instrument.reconstruction.video_files import VideoPictures, create_output
from instrument.volumes.writing import write_volume_tiff, write_volume_zarr
from recon.camera.grid import Grid
from recon.types import Calibration, Geometry
from tests.mocks.recordings import write_recording

GRID = Grid((3, 8, 9), (4, 4), np.array([100.0, 120.0, 140.0]), np.array([4.0, 5.0, 6.0]), 10.0, None, False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("files")
    pixels = np.random.default_rng(0).random((4, 2, 8, 9)).astype(np.float32)
    write_recording(made, {t: 100 * pixels[t, 0] for t in range(4)}).rename(made / "run")
    places = np.array([[0, 0, 1000.0], [50, 0, 1000.0], [0, 50, 1000.0], [50, 50, 1000.0]])
    save_calibration(Calibration(pixels, places, geometry=Geometry(6.5, 2.0)), made / "calibration")
    write_volume_zarr(made / "volume.ome.zarr", iter(pixels[:3, 0]), (3, 8, 9), GRID, {})
    create_output(made / "film.ome.zarr", 4, (8, 9), period_s=0.5, grid=None, attributes={})
    film = VideoPictures(made / "film.ome.zarr", write=True)
    for t in range(4):
        film.write(t, pixels[t, 0])
    tifffile.imwrite(made / "picture.tif", pixels[0, 0])
    write_json(made / "picture.json", {"program": "diffuserbench 1", "grid": {"object_pitch_um": 7.5}})
    tifffile.imwrite(made / "other.tif", pixels[0, 0])
    tifffile.imwrite(made / "other.ome.tif", pixels[:, 0], ome=True, metadata={"axes": "ZYX"})
    write_volume_tiff(made / "exported.tif", iter(pixels[:3, 0]), (3, 8, 9), GRID)
    write_image(made / "photo.ome.tif", pixels[0, 0], {"pixel_pitch_um": 6.5})
    return made


SHOWN = {
    "run": [(4, 8, 9), (0.04, 6.5, 6.5), ("s", "um", "um")],
    "volume.ome.zarr": [(3, 8, 9), (20.0, 5.0, 5.0), ("um", "um", "um")],
    "film.ome.zarr": [(4, 8, 9), (0.5, 1.0, 1.0), ("s", "pixel", "pixel")],
    "picture.tif": [(8, 9), (7.5, 7.5), ("um", "um")],
    "exported.tif": [(3, 8, 9), (20.0, 5.0, 5.0), ("um", "um", "um")],
    "photo.ome.tif": [(8, 9), (6.5, 6.5), ("um", "um")],
}


@pytest.mark.parametrize("name", SHOWN)
def test_each_is_shown_with_its_scale(folder: Path, name: str) -> None:
    assert get_reader(str(folder / name)) is read
    [(data, layer, kind)] = read(str(folder / name))
    shape, scale, units = SHOWN[name]
    assert (tuple(data.shape), kind) == (shape, "image")
    assert layer["scale"] == pytest.approx(scale)
    assert tuple(layer["units"]) == units
    assert "diffuserbench" in layer["metadata"]
    if name == "exported.tif":
        assert layer["translate"] == read(str(folder / "volume.ome.zarr"))[0][1]["translate"]


def test_colours_are_shown_in_themselves(tmp_path: Path) -> None:
    """Napari's own choice for three channels is cyan, magenta and yellow."""
    pixels = np.random.default_rng(1).random((2, 8, 9, 3)).astype(np.float32)
    create_output(tmp_path / "film.ome.zarr", 2, (8, 9, 3), period_s=0.5, grid=None, attributes={})
    film = VideoPictures(tmp_path / "film.ome.zarr", write=True)
    for t in range(2):
        film.write(t, pixels[t])
    film.say_white([0, 1])
    shown = film.attributes["ome"]["omero"]["channels"]
    assert [channel["color"] for channel in shown] == ["FF0000", "00FF00", "0000FF"]
    assert pixels.max() > shown[0]["window"]["end"] > 0.9  # a percentile of some of them
    [(_, layer, _)] = read(str(tmp_path / "film.ome.zarr"))
    assert (layer["channel_axis"], layer["colormap"]) == (1, ["red", "green", "blue"])


def test_a_film_of_volumes_has_its_place_as_a_volume_has(tmp_path: Path) -> None:
    z_um = np.array([9e3, 10e3, 11e3])
    grid = Grid((3, 8, 9), (4, 5), z_um, 1e-3 * z_um)
    create_output(tmp_path / "film.ome.zarr", 2, grid.shape, period_s=0.5, grid=grid, attributes={})
    [(_, layer, _)] = read(str(tmp_path / "film.ome.zarr"))
    assert layer["scale"] == [0.5, 1e3, 10.0, 10.0]
    assert layer["translate"] == [0.0, 9e3, -40.0, -50.0]


def test_a_run_without_frames_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no frames"):
        read(str(write_recording(tmp_path, {})))


def test_what_is_not_the_program_s_is_left_to_others(folder: Path) -> None:
    for other in ("other.tif", "other.ome.tif", "nothing", "picture.json", "run/frames.ome.zarr/0"):
        assert get_reader(str(folder / other)) is None
    assert get_reader([str(folder / "run"), str(folder / "film.ome.zarr")]) is None


@pytest.mark.filterwarnings("ignore")  # of what napari imports
def test_napari_opens_them(folder: Path) -> None:
    npe2 = pytest.importorskip("npe2", reason="napari is not installed: pip install 'diffuserbench[napari]'")
    components = pytest.importorskip("napari.components", reason="napari is not installed")
    manifest = npe2.PluginManifest.from_file(Path(instrument.__file__).parent / "napari.yaml")
    npe2.PluginManager.instance().register(manifest)
    viewer = components.ViewerModel()
    for name in SHOWN:
        viewer.open(str(folder / name), plugin="diffuserbench")
    assert [tuple(layer.scale) for layer in viewer.layers] == [pytest.approx(s) for _, s, _ in SHOWN.values()]
    viewer.open(str(folder / "calibration"), plugin="diffuserbench")
    psfs = list(viewer.layers)[len(SHOWN) :]
    assert [layer.data.shape for layer in psfs] == [(4, 8, 9), (4, 8, 9)]
    assert psfs[0].metadata["diffuserbench"]["source_positions_um"][1] == [50.0, 0.0, 1000.0]
