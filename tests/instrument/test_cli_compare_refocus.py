"""``diffuserbench compare`` and ``refocus``, and ``reconstruct --z-mm`` between calibrated depths."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from calibration_routines.optics.angular_response import AngularResponse, Curve, save_response
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from instrument.cli import main
from instrument.files.calibration_file import load_calibration, save_calibration
from instrument.files.images import write_image
from recon.types import Calibration

WORLD = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
GREEN = (0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hold a calibration at 60 and 100 mm, another camera's, and a photograph of a point at 75 mm."""
    here = tmp_path_factory.mktemp("refocus")
    for name, world in (
        ("calibration", WORLD),
        ("other", SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0, diffuser_seed=3))),
    ):
        psfs = np.stack([world.psf((0.0, 0.0, z), GREEN) for z in (60e3, 100e3)])[:, None]
        save_calibration(
            Calibration(
                psfs * np.float32(1e3 / psfs.max()),
                np.array([(0.0, 0.0, z) for z in (60e3, 100e3)]),
                geometry=world.geometry,
                provenance={"simulated": True},
            ),
            here / name,
        )
    light = WORLD.psf((0.0, 0.0, 75e3), GREEN)
    tifffile.imwrite(here / "photo.tif", (light * (50_000 / light.max())).astype(np.uint16))
    return here


def test_a_psf_at_another_depth_is_a_calibration(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "at75"
    page = tmp_path / "at75.png"
    words = ["refocus", str(folder / "calibration"), "--z-mm", "75", "--out", str(out), "--figure", str(page)]
    assert main(words) == 0
    assert cv2.imread(str(page)).std() > 10
    said = capsys.readouterr().out
    assert "60 and 100 mm" in said
    assert "SIMULATED" in said
    made = load_calibration(out)
    assert made.source_positions_um[0, 2] == 75e3
    assert made.quality["refocused"][0]["from_z_um"] == [60e3, 100e3]
    truth = WORLD.psf((0.0, 0.0, 75e3), GREEN)
    psf = made.psfs[0, 0]
    assert np.vdot(psf, truth) / np.linalg.norm(psf) / np.linalg.norm(truth) > 0.98
    assert main(words) == 2  # it is there already
    assert main([*words, "--force"]) == 0


def test_a_psf_beyond_the_calibrated_depths_is_warned_of_wherever_it_is_used(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depths = ["--z-mm", "75", "--z-mm", "150", "--z-mm", "200"]
    assert main(["refocus", str(folder / "calibration"), *depths, "--out", str(tmp_path / "far")]) == 0
    capsys.readouterr()
    words = ["--calibration", str(tmp_path / "far"), "--image", str(folder / "photo.tif"), "--dark", "0"]
    words += ["--z-mm", "150", "--method", "wiener", "--tau", "0.01", "--out", str(tmp_path / "picture.tif")]
    assert main(["reconstruct", *words]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "150 mm lies outside the calibrated 60 to 100 mm" in told
    assert "200 mm" not in told, "that PSF takes no part"
    words[words.index("150")] = "75"
    assert main(["reconstruct", *words, "--force"]) == 0
    assert "lies outside" not in capsys.readouterr().err


def test_the_angular_response_makes_a_field_of_one_psf(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    angles = np.arange(-40.0, 41.0, 5.0)
    curve = Curve(tuple(angles), tuple(np.exp(-((angles / 13) ** 2) / 2)), (1.0,) * len(angles))
    save_response(AngularResponse(curve, curve), tmp_path / "response.json")
    words = ["refocus", str(folder / "calibration"), "--z-mm", "75", "--out", str(tmp_path / "field")]
    assert main([*words, "--points", "2"]) == 2
    assert "give --response too" in capsys.readouterr().err
    assert main([*words, "--points", "2", "--response", str(tmp_path / "response.json")]) == 0
    told = capsys.readouterr()
    assert "(4 places of the field)" in told.out
    assert "beyond the sensor" not in told.err
    made = load_calibration(tmp_path / "field")
    assert len(made.psfs) == 4
    assert len(set(map(tuple, made.source_positions_um[:, :2].tolist()))) == 4
    given = load_calibration(folder / "calibration")
    save_calibration(replace(given, psfs=given.psfs[..., 80:-80, 120:-120]), tmp_path / "small")
    words = ["refocus", str(tmp_path / "small"), "--z-mm", "75", "--out", str(tmp_path / "cut")]
    assert main([*words, "--response", str(tmp_path / "response.json")]) == 0
    assert "goes on beyond the sensor" in capsys.readouterr().err


@pytest.mark.parametrize("depths", [["--z-mm", "0"], ["--z-mm", "75", "--z-mm", "75"]])
def test_depths_that_make_no_sense_are_refused(depths: list[str], folder: Path, tmp_path: Path) -> None:
    assert main(["refocus", str(folder / "calibration"), *depths, "--out", str(tmp_path / "x")]) == 2
    assert not (tmp_path / "x").exists()


def test_what_is_no_calibration_is_said_before_the_options_that_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    psf = tmp_path / "psf.tif"
    write_image(psf, np.ones((8, 8), np.uint16))
    assert main(["refocus", str(psf)]) == 2
    first, second, third = capsys.readouterr().err.splitlines()[-3:]
    assert "psf.tif: is no folder; a calibration or a run folder is expected." in first
    assert "reconstruct takes one by --psf FILE" in first
    assert second.startswith("--z-mm must be given")
    assert third.startswith("--out must be given")


def test_a_reconstruction_between_depths_says_how_its_psf_was_made(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "reconstruct",
        "--calibration",
        str(folder / "calibration"),
        "--image",
        str(folder / "photo.tif"),
    ]
    words += ["--dark", "0", "--method", "wiener", "--tau", "0.01", "--force"]
    peaks = {}
    for z_mm in ("75", "60"):
        out = tmp_path / f"{z_mm}.tif"
        assert main([*words, "--z-mm", z_mm, "--out", str(out)]) == 0
        image = tifffile.imread(out)
        peaks[z_mm] = float(image.max() / np.abs(image).sum())
        said = capsys.readouterr().out
        assert ("refocused to 75 mm" in said) == (z_mm == "75")
    assert peaks["75"] > 1.5 * peaks["60"]  # in focus
    assert json.loads((tmp_path / "75.json").read_text())


def test_comparing_tells_whether_a_calibration_is_due(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    same = str(folder / "calibration")
    assert main(["compare", same, same]) == 0
    assert "No recalibration is due" in capsys.readouterr().out
    out, page = tmp_path / "bump.json", tmp_path / "bump.png"
    other = str(folder / "other")
    assert main(["compare", same, other, "--out", str(out), "--figure", str(page)]) == 1
    assert "RECALIBRATE" in capsys.readouterr().out
    assert np.ptp(cv2.imread(str(page)).astype(int), axis=2).max() > 100, "what differs is coloured"
    record = json.loads(out.read_text())
    assert record["due"] is True
    assert len(record["changes"]) == 2
    assert main(["compare", same, same, "--out", str(out)]) == 2
    assert main(["compare", same, str(tmp_path / "nothing")]) == 2


def test_what_was_compared_is_named_and_computed_psfs_are_no_measurement(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "calibration").symlink_to(folder / "calibration")
    assert main(["compare", str(folder / "calibration"), str(run)]) == 0
    assert str(run / "calibration") in "".join(capsys.readouterr().out.split("\n"))
    computed = tmp_path / "at75"
    assert main(["refocus", str(folder / "calibration"), "--z-mm", "75", "--out", str(computed)]) == 0
    assert main(["compare", str(folder / "calibration"), str(computed)]) == 2
    assert "was computed from" in " ".join(capsys.readouterr().err.split())
