"""``diffuserbench points --fit`` and points of films: whose photograph, which frame, mistakes in words."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.reconstruction.video_files import VideoPictures, create_output
from instrument.tasks.points import left_over
from instrument.volumes.grid_facts import grid_facts
from recon.analysis import point_places
from recon.camera.grid import Grid
from tests.recon.reconstruction.test_fitted_places import CALIBRATION, LIGHT, photograph, true_um

Z_UM = 1 / np.linspace(1 / 10e3, 1 / 20e3, 5)
GRID = Grid((5, 40, 50), (20, 25), Z_UM, 1e-3 * Z_UM)


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """A volume with the photograph and the calibration that it was reconstructed from."""
    photo, volume = tmp_path / "photo.tif", tmp_path / "v.ome.zarr"
    tifffile.imwrite(photo, photograph() + 100)
    save_calibration(CALIBRATION, tmp_path / "cal")
    argv = ["reconstruct", "--volume", str(tmp_path / "cal"), "--image", str(photo), "--prior", "l1"]
    argv += ["--model", "convolution"]
    assert main([*argv, "-n", "60", "--dark", "100", "--noise", "1", "--out", str(volume)]) == 0
    return volume


def test_places_are_fitted_to_the_photograph_that_the_record_names(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "points.csv"
    assert main(["points", str(made), "--out", str(out)]) == 0
    assert "of the volume alone (--fit" in " ".join(capsys.readouterr().out.split())
    assert {row["fitted"] for row in csv.DictReader(out.read_text().splitlines())} == {"0"}
    assert main(["points", str(made), "--out", str(out), "--force", "--fit"]) == 0
    told = capsys.readouterr()
    assert "fitted to the photograph; " in " ".join(told.out.split())
    assert "times the noise of the photograph, " not in " ".join((told.out + told.err).split())
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert {row["fitted"] for row in rows} == {"1"}
    found = np.array([[float(row[f"{axis}_um"]) for axis in "xyz"] for row in rows])
    known = np.array([[float(row[f"{axis}_deviation_um"]) for axis in "xyz"] for row in rows])
    for place in true_um():
        nearest = int(np.linalg.norm(found - place, axis=1).argmin())
        assert (np.abs(found[nearest] - place) < 4 * known[nearest] + [3, 3, 20]).all()
    assert main(["points", str(made), "--out", str(out), "--force", "--fit", "--least", "0.95"]) == 0
    assert list(csv.DictReader(out.read_text().splitlines())) == rows[:1], "told are fewer, fitted all"
    capsys.readouterr()
    out.unlink()
    # What the volume is told and made of by is an input, too.
    read = [tmp_path / name for name in ("v.json", "photo.tif", "cal/calibration.json")]
    before = [path.read_bytes() for path in read]
    (tmp_path / "hard.tif").hardlink_to(tmp_path / "photo.tif")
    for into in (*read, tmp_path / "hard.tif"):
        assert main(["points", str(made), "--fit", "--out", str(into), "--force"]) == 2
        assert "replaces" in " ".join(capsys.readouterr().err.split())
    assert [path.read_bytes() for path in read] == before
    # Another photograph by now, none, and a record that does not tell which.
    fit = ["points", str(made), "--fit", "--out", str(out)]
    tifffile.imwrite(tmp_path / "photo.tif", photograph(2.0) + 100)
    assert main(fit) == 2
    assert "is not the photograph any more that" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "photo.tif").unlink()
    assert main(fit) == 2
    assert "photo.tif: there is no such file" in " ".join(capsys.readouterr().err.split())
    record = json.loads((tmp_path / "v.json").read_text())
    del record["inputs"]["options"]
    (tmp_path / "v.json").write_text(json.dumps(record))
    assert main(fit) == 2
    assert "does not tell of which photograph and PSFs it was made" in " ".join(
        capsys.readouterr().err.split()
    )
    assert not out.exists()


@pytest.fixture
def moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A volume of a named array and a dark frame by relative names, looked at from another folder."""
    data, volume = tmp_path / "data", tmp_path / "volumes" / "w.ome.zarr"
    for folder in (data, volume.parent, tmp_path / "elsewhere"):
        folder.mkdir()
    save_calibration(CALIBRATION, tmp_path / "cal")
    photo = np.rint(photograph() + 100).astype(np.uint16)
    np.savez(data / "two.npz", other=photo[::-1], photo=photo)
    tifffile.imwrite(data / "dark.tif", np.full(photo.shape, 100, np.uint16))
    tifffile.imwrite(tmp_path / "elsewhere" / "dark.tif", np.full(photo.shape, 160, np.uint16))
    monkeypatch.chdir(data)
    argv = ["reconstruct", "--volume", "../cal", "--image", "two.npz::photo", "--prior", "l1", "-n", "20"]
    argv += ["--model", "convolution", "--dark", "dark.tif", "--noise", "1", "--out", str(volume)]
    assert main(argv) == 0
    monkeypatch.chdir(tmp_path / "elsewhere")
    return volume


def test_what_a_volume_was_made_of_is_found_again_and_refused_where_it_has_changed(
    moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, calibration, fit = tmp_path / "data", tmp_path / "cal", ["points", str(moved), "--fit", "--force"]

    def said(returns: int) -> str:
        capsys.readouterr()
        assert main(fit) == returns
        told = capsys.readouterr()
        return " ".join((told.out + told.err).split())

    assert "to the last bit" not in (words := said(0))
    assert "fitted to the photograph" in words
    (data / "two.npz").rename(moved.parent / "two.npz")
    assert "fitted to the photograph" in said(0), "beside the volume"
    shutil.copytree(calibration, tmp_path / "kept")
    shutil.rmtree(calibration)
    save_calibration(replace(CALIBRATION, psfs=np.roll(CALIBRATION.psfs, 3, axis=3)), calibration)
    assert "cal: holds other PSFs than those that" in said(2)
    shutil.rmtree(calibration)
    (tmp_path / "kept").rename(calibration)
    dark = tifffile.imread(data / "dark.tif")
    tifffile.imwrite(data / "dark.tif", dark + 7)
    assert "its dark frame, the calibration's background or the mask" in said(2)
    beside = moved.parent / "w.json"
    record = json.loads(beside.read_text())
    del record["inputs"]["image"]["pixels_sha256"]
    beside.write_text(json.dumps(record))
    assert "mask of --erasures has changed since, or it is another photograph" in said(2)
    tifffile.imwrite(data / "dark.tif", dark)
    words = said(0)
    assert "does not tell its photograph from others" in words
    assert "pixels differ" not in words
    told = record["inputs"]["prepared"]
    for name in ("psfs_marks", "measurement_marks"):  # as another processor rounds
        told[name][0]["marks"] = [value * (1 + 1e-7) + 1e-7 for value in told[name][0]["marks"]]
        told[name][0]["crc32"] = [0.0]
    beside.write_text(json.dumps(record))
    words = said(0)
    assert "fitted to the photograph" in words
    assert "its PSFs, dark frame, background and mask are not to the last bit those of then" in words
    for name in ("psfs_marks", "measurement_marks"):
        del told[name][0]["crc32"]
    beside.write_text(json.dumps(record))
    assert "not to the last bit those" not in (words := said(0)), "which nobody knows"
    assert "does not tell whether its PSFs, dark frame, background and mask are those of then" in words
    del record["inputs"]["prepared"]
    beside.write_text(json.dumps(record))
    assert "its photograph, PSFs, dark frame, background and mask from others" in said(0)
    (moved.parent / "two.npz").unlink()
    words = said(2)
    assert "two.npz: there is no such file any more" in words
    assert "a copy beside the volume" in words


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("options", "binning"), "x", "binning must be"),
        (("options", "noise"), {"a": 1}, "options that this version does not know"),
        (("options", "crop"), [1, 2], "options that this version does not know"),
        (("options", "mosaic"), 5, "mosaic must be"),
        (("options", "sharpness"), 5, "sharpness is not known"),
        (("options", "erasures"), "none.tif", "none.tif: there is no such file"),
        (("options",), [1], "does not tell of which photograph"),
        ((), [1], "is damaged: 'inputs' is no object"),
    ],
)
def test_a_damaged_record_is_refused_in_words(
    place: tuple[str, ...], value: object, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volume = tmp_path / "v.npy"
    np.save(volume, np.ones(GRID.shape, np.float32))
    inputs = {"image": {"path": "photo.tif"}, "calibration": "cal", "options": {}}
    record = {"inputs": inputs, "grid": grid_facts(GRID)}
    *to, last = ("inputs", *place)
    inside: Any = record
    for name in to:
        inside = inside[name]
    inside[last] = value
    (tmp_path / "v.json").write_text(json.dumps(record))
    assert main(["points", str(volume), "--fit", "--out", str(tmp_path / "p.csv")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Three volumes: a point that moves, and dims; one is lost, one is dark."""
    path = tmp_path / "film.ome.zarr"
    create_output(path, 5, GRID.shape, period_s=0.1, grid=GRID, attributes={})
    volumes = VideoPictures(path, write=True)
    for index, light in ((0, 30.0), (1, 20.0), (3, 2.0), (4, 0.0)):
        voxels = np.zeros(GRID.shape, np.float32)
        voxels[2, 12, 20 + index] = light
        volumes.write(index, voxels)
    return path


def test_a_film_tells_points_frame_by_frame(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tracks.csv"
    assert main(["points", str(film), "--out", str(out)]) == 0
    assert "Points 2, 0 to 1 a volume" in " ".join(capsys.readouterr().out.split())
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [(row["frame"], row["time_s"], row["column"]) for row in rows] == [
        ("0", "0", "20"),
        ("1", "0.1", "21"),
    ], "the third is a fifteenth of the brightest of all"
    assert main(["points", str(film), "--out", str(out), "--least", "0.05", "--force"]) == 0
    assert [row["frame"] for row in csv.DictReader(out.read_text().splitlines())] == ["0", "1", "3"]
    capsys.readouterr()
    assert main(["points", str(film), "--out", str(out), "--fit", "--force"]) == 2
    assert "--fit is for the volume of one photograph" in " ".join(capsys.readouterr().err.split())


def test_a_frame_of_too_many_points_is_left_out_and_said(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "tracks.csv"
    monkeypatch.setattr(point_places, "MOST", 1)
    voxels = np.zeros(GRID.shape, np.float32)
    voxels[2, 12, 5::20] = 20.0
    VideoPictures(film, write=True).write(1, voxels)
    assert main(["points", str(film), "--out", str(out), "--least", "0.05"]) == 0
    assert [row["frame"] for row in csv.DictReader(out.read_text().splitlines())] == ["0", "3"]
    assert "no points are told of frame 1: There are more than 1 points" in " ".join(
        capsys.readouterr().err.split()
    )


def test_channels_that_were_merged_are_fitted_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo, volume, out = tmp_path / "photo.tif", tmp_path / "v.ome.zarr", tmp_path / "points.csv"
    noise = np.random.default_rng(1).normal(0, 1, (3, 64, 64))
    colours = np.array([1.0, 0.7, 0.4])[:, None, None] * photograph(0.0) + noise + 100
    tifffile.imwrite(photo, np.moveaxis(np.rint(colours), 0, -1).astype(np.uint16), photometric="rgb")
    save_calibration(CALIBRATION, tmp_path / "cal")
    argv = ["reconstruct", "--volume", str(tmp_path / "cal"), "--image", str(photo), "--prior", "l1"]
    argv += ["-n", "30", "--dark", "100", "--noise", "1", "--out", str(volume), "--choose", "channels=merged"]
    assert main(argv) == 0
    assert main(["points", str(volume), "--out", str(out)]) == 0
    assert "(--fit: fitted to its photograph)" in " ".join(capsys.readouterr().out.split())
    record = json.loads((tmp_path / "v.json").read_text())
    assert main(["points", str(volume), "--out", str(out), "--fit", "--force"]) == 0
    rows = list(csv.DictReader(out.read_text().splitlines()))
    found = np.array([[float(row[f"{axis}_um"]) for axis in "xyz"] for row in rows])
    for place, light in zip(true_um(), LIGHT, strict=True):
        nearest = int(np.linalg.norm(found - place, axis=1).argmin())
        assert (np.abs(found[nearest] - place) < [15, 15, 100]).all()
        assert float(rows[nearest]["light"]) == pytest.approx(2.1 * light, rel=0.1)
    record["provenance"]["auto"]["channels_merged"] = False
    (tmp_path / "v.json").write_text(json.dumps(record))
    capsys.readouterr()
    assert main(["points", str(volume), "--out", str(out), "--force"]) == 0
    assert "--fit" not in capsys.readouterr().out, "of colours it is not named"
    assert main(["points", str(volume), "--out", str(out), "--fit", "--force"]) == 2
    assert "take the places in the volume" in " ".join(capsys.readouterr().err.split())


def test_a_film_of_pictures_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flat.ome.zarr"
    create_output(path, 1, (8, 8), period_s=None, grid=None, attributes={})
    VideoPictures(path, write=True).write(0, np.ones((8, 8), np.float32))
    assert main(["points", str(path), "--out", str(tmp_path / "points.csv")]) == 2
    assert "is a film of pictures" in " ".join(capsys.readouterr().err.split())


def test_what_points_do_not_explain_is_told_as_a_share_only_where_it_is_one() -> None:
    assert "4.0 times the noise of the photograph, 12% of what is seen" in left_over(3, 4.0, 0.12)
    assert "more than what is seen of them" in left_over(3, 4.0, 5.3e18)
    none = left_over(0, 76.3, 5.3e18)
    assert none.startswith("the photograph holds 76.3 times its noise, and no point explains any of it")
    assert "Places" not in none
