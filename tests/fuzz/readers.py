"""Every reader of files, with a sound file for each: what the fuzzer and its test feed with damaged bytes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

from instrument.bench.config_file import load_config, template
from instrument.display.alignment import load_alignment
from instrument.display.spots import read_spots
from instrument.files.calibration_file import calibrated_depths_um, load_calibration, save_calibration
from instrument.files.images import read_image, read_stack
from instrument.files.record import plain
from instrument.files.slm_image import load_slm_correction
from instrument.files.stability_file import read_stability
from instrument.plan.model import load_plan
from instrument.reconstruction.again import can_be_fitted, made_of
from instrument.reconstruction.film import Film
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.patterned import _patterns_from_file
from instrument.reconstruction.request import VolumeRequest
from instrument.reconstruction.stored_result import StoredResult, open_result
from instrument.reconstruction.video_files import VideoPictures, create_output
from instrument.runs.inspection import verify
from instrument.runs.run import Run
from instrument.volumes.grid_facts import grid_facts
from instrument.volumes.opening import open_volume
from recon.analysis.point_places import PointOptions, point_places
from recon.camera.grid import Grid
from recon.types import Calibration

FIXTURES = Path(__file__).parents[1] / "fixtures" / "v813d646"


@dataclass(frozen=True)
class Reader:
    """A reader: ``make`` puts a sound file or folder somewhere and returns it, ``read`` reads it."""

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    spoil: tuple[str, ...] = ("",)
    """Files in a folder that are damaged, one at a time; empty: the file itself."""


def _pixels(side: int = 12) -> np.ndarray[Any, np.dtype[np.uint16]]:
    return np.random.default_rng(1).integers(0, 4096, (side, side + 4)).astype(np.uint16)


def _tiff(folder: Path) -> Path:
    path = folder / "a.tif"
    tifffile.imwrite(
        path, np.stack([_pixels()] * 3), photometric="minisblack", compression="zlib", description='{"a": 1}'
    )
    return path


def _png(folder: Path) -> Path:
    cv2.imwrite(str(folder / "a.png"), _pixels())
    (folder / "a.json").write_text('{"simulated": true}')
    return folder / "a.png"


def _npy(folder: Path) -> Path:
    np.save(folder / "a.npy", _pixels())
    return folder / "a.npy"


def _patterns(folder: Path) -> Path:
    np.save(folder / "patterns.npy", np.ones((3, 12, 16), np.float32))
    return folder / "patterns.npy"


def _npz(folder: Path) -> Path:
    np.savez_compressed(folder / "a.npz", a=_pixels())
    return folder / "a.npz"


def _hdf5(folder: Path) -> Path:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("psf", data=np.stack([_pixels()] * 3), compression="gzip")
    return folder / "a.h5"


def _matlab(folder: Path) -> Path:
    from scipy.io import savemat

    savemat(folder / "a.mat", {"psf": _pixels(), "z_um": 1e5}, do_compression=True)
    return folder / "a.mat"


def _written(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def _copied(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        source, target = FIXTURES / name, folder / Path(name).name
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            shutil.copyfile(source, target)
        return target

    return make


def _result(folder: Path) -> Path:
    for end in ("json", "tif"):
        shutil.copyfile(FIXTURES / f"results/picture.{end}", folder / f"picture.{end}")
    return folder


def _calibration(folder: Path) -> Path:
    psfs = np.random.default_rng(1).random((2, 1, 12, 20), np.float32)
    made = Calibration(psfs=psfs, source_positions_um=np.array([[0.0, 0.0, 1e5], [0.0, 0.0, 2e5]]))
    return save_calibration(made, folder / "calibration")


def _volume_made(folder: Path) -> Path:
    """A volume with its record, and the photograph and PSFs that it was made of."""
    calibration = _calibration(folder)
    cv2.imwrite(str(folder / "photo.png"), np.pad(_pixels(), ((0, 0), (0, 4))))
    cv2.imwrite(str(folder / "dark.png"), np.full((12, 20), 7, np.uint16))
    inputs = InputOptions(dark=folder / "dark.png", noise=1.0)
    request = VolumeRequest(image=folder / "photo.png", psfs=calibration, inputs=inputs)
    told = request.prepare().provenance
    grid = Grid((2, 12, 20), (6, 10), np.array([1e5, 2e5]), np.array([10.0, 20.0]))
    np.save(folder / "volume.npy", np.random.default_rng(1).random(grid.shape, np.float32))
    record = {"model": "convolution", "inputs": told, "grid": grid_facts(grid)}
    (folder / "volume.json").write_text(json.dumps(plain(record)))
    return folder / "volume.npy"


def _shown(path: Path) -> StoredResult:
    """Open a result and ask it for all that is shown of it."""
    result = open_result(path)
    for name, kind in vars(StoredResult).items():
        if isinstance(kind, property):
            getattr(result, name)
    result.facts()
    repr(result)
    can_be_fitted(result)
    return result


def _made_of(path: Path) -> None:
    result = _shown(path)
    if result.grid is not None and result.volume is not None:
        point_places(result.volume.plane, result.grid, PointOptions())
    made_of(result)


def _video(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / "film.ome.zarr"
    made = {"calibrated_px": [1.0, 1.0, 11.0, 15.0], "simulated": True}
    create_output(path, 2, (12, 16), period_s=0.1, grid=None, attributes=made)
    pictures = VideoPictures(path, write=True)
    for index in range(2):
        pictures.write(index, _pixels().astype(np.float32))
    return path


def _film(path: Path) -> None:
    film = Film(path)
    film.levels()
    film.whole(0)
    _ = film.grid, film.fps, film.facts


def _volume(path: Path) -> None:
    source = open_volume(path)
    try:
        source.plane(0)
        source.across_x(0)
    finally:
        source.close()


def _image_and_stack(path: Path) -> None:
    try:
        read_stack(path)
    finally:
        read_image(path)


PLAN = """label = "sweep"
[[parts]]
label = "psf"
light = "source"
exposure_ms = 20
repeats = 2
positions = { kind = "points", points_um = [[0, 0, 10], [0, 0, 20]] }
"""
READERS: dict[str, Reader] = {
    "bench": Reader(_written("bench.toml", template("default")), load_config),
    "plan": Reader(_written("plan.toml", PLAN), lambda path: len(load_plan(path))),
    "plan-json": Reader(_copied("run/plan.json"), lambda path: len(load_plan(path))),
    "tiff": Reader(_tiff, _image_and_stack),
    "tiff-volume": Reader(_copied("results/volume.tif"), _volume),
    "png": Reader(_png, read_image),
    "npy": Reader(_npy, _image_and_stack),
    "npy-volume": Reader(_npy, _volume),
    "npz": Reader(_npz, read_image),
    "hdf5": Reader(_hdf5, _image_and_stack),
    "matlab": Reader(_matlab, _image_and_stack),
    "side-car": Reader(_png, lambda path: read_image(path), ("../a.json",)),
    "result": Reader(_result, lambda path: _shown(path / "picture.tif"), ("picture.json",)),
    "volume-record": Reader(_volume_made, _made_of, ("../volume.json",)),
    "run": Reader(
        _copied("run"),
        lambda path: verify(Run.open(path)),
        (
            "state.json",
            "plan.json",
            "provenance.json",
            "log.jsonl",
            "frames.ome.zarr/zarr.json",
            "frames.ome.zarr/0/zarr.json",
        ),
    ),
    "calibration": Reader(
        _calibration,
        lambda path: (calibrated_depths_um(path), load_calibration(path)),
        ("calibration.json", "psfs.ome.zarr/0/zarr.json", "psfs.ome.zarr/0/c/0/0/0/0"),
    ),
    "ome-zarr": Reader(
        lambda folder: _calibration(folder) / "psfs.ome.zarr", _volume, ("zarr.json", "0/zarr.json")
    ),
    "video": Reader(_video, _film, ("zarr.json", "0/zarr.json", "0/c/0/0/0")),
    "spots": Reader(_written("spots.csv", "y,x,intensity,z_mm\n0.2,0.3,1,0\n0.7,0.6,0.5,2\n"), read_spots),
    "patterns": Reader(_patterns, lambda path: _patterns_from_file(path, (3, 12, 16))),
    "alignment": Reader(_copied("alignment.json"), load_alignment),
    "slm-calibration": Reader(_copied("slm-calibration.json"), load_slm_correction),
    "stability": Reader(_copied("stability/stability.json"), read_stability),
}
