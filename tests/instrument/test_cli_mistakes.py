"""Wrong inputs of a first hour: one clear sentence each, with what to do, and never a traceback."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.images import write_image
from recon.evaluation.scene import make_scene
from recon.types import Calibration

RECONSTRUCT = ["reconstruct", "--out", "o.tif"]
PAIR = [*RECONSTRUCT, "--psf", "psf.tif", "--image", "photo.tif"]
MISTAKES: list[tuple[list[str], str]] = [
    ([*RECONSTRUCT, "--psf", "photo.tif", "--image", "psf.tif"], "seem to be swapped"),
    ([*RECONSTRUCT, "--psf", "psf.tif", "--image", "psf.tif"], "the same image"),
    ([*RECONSTRUCT, "--psf", "small.tif", "--image", "photo.tif"], "both must have one shape"),
    ([*RECONSTRUCT, "--psf", "eight.tif", "--image", "photo.tif"], "--mixed-depth"),
    ([*RECONSTRUCT, "--psf", "black.tif", "--image", "photo.tif"], "Was the point source on?"),
    ([*RECONSTRUCT, "--psf", "psf.tif", "--image", "black.tif"], "Was the scene lit?"),
    ([*RECONSTRUCT, "--psf", "holes.tif", "--image", "photo.tif"], "no finite number"),
    ([*RECONSTRUCT, "--psf", "absent.tif", "--image", "photo.tif"], "there is no such file"),
    ([*RECONSTRUCT, "--psf", "plain", "--image", "photo.tif"], "in a folder are given by --volume"),
    ([*RECONSTRUCT, "--psf", "/proc", "--image", "photo.tif"], "is a folder; a file is expected"),
    ([*RECONSTRUCT, "--psf", "psf.tif", "--image", "film.tif"], "by diffuserbench import FILE"),
    ([*RECONSTRUCT, "--psf", "text.tif", "--image", "photo.tif"], "is no image that can be read"),
    ([*RECONSTRUCT, "--psf", "empty.tif", "--image", "photo.tif"], "is empty"),
    ([*RECONSTRUCT, "--image", "photo.tif"], "Give either --psf FILE or --calibration FOLDER"),
    ([*RECONSTRUCT, "--psf", "psf.tif"], "Give a photograph with --image FILE"),
    ([*PAIR, "--calibration", "cal"], "one of them"),
    ([*PAIR, "--prior", "TV"], "Did you mean 'tv'?"),
    ([*PAIR, "--solver", "admn"], "Did you mean 'admm'?"),
    ([*PAIR, "--iterations", "0"], "1 or more"),
    ([*PAIR, "--bin", "40"], "Take --bin"),
    ([*PAIR, "--crop", "10"], "HEIGHTxWIDTH"),
    ([*PAIR, "--crop", "99x99"], "but the image has"),
    ([*PAIR, "--dark", "absent.tif"], "there is no such file"),
    ([*PAIR, "--erasures", "1"], "a share from 0 to below 1"),
    ([*PAIR, "--solver", "wiener", "--iterations", "3"], "one shot"),
    ([*PAIR, "--z-mm", "-3"], "above 0"),
    ([*PAIR, "--z-mm", "30"], "cannot be brought to 30 mm"),
    ([*RECONSTRUCT, "--calibration", "near", "--image", "photo.tif", "--z-mm", "30"], "has one depth, 20 mm"),
    (["demo", "nothing"], "there are camera, film, display"),
    (["plan", "shwo"], "Did you mean show?"),
    (["chart", "--hologram", "head"], "Did you mean diffuserbench chart hologram ...?"),
    ([*PAIR, "photo.tif"], "photo.tif: no option says what it is for"),
    ([*PAIR, "--figure", "o.gif"], ".png, .pdf or .svg"),
    (["reconstruct", *PAIR[3:], "--out", "/proc/o.tif"], "Choose another place"),
    (["reconstruct", *PAIR[3:], "--out", "o.jpg"], "must end in .tif"),
    (["reconstruct", *PAIR[3:], "--out", "absent/o.tif"], "Make it first"),
    (["reconstruct", "psf.tif", "photo.tif"], "Did you mean --psf psf.tif --image photo.tif?"),
    (["reconstruct", "cal", "photo.tif"], "Did you mean --calibration cal --image photo.tif?"),
    (["reconstruct", "photo.tif", "sweep"], "Did you mean --image photo.tif --calibration sweep?"),
    (["reconstruct", "photo.tif"], "by --image photo.tif"),
    ([*RECONSTRUCT, "--calibration", "plain", "--image", "photo.tif"], "--volume FOLDER"),
    ([*RECONSTRUCT, "--volume", "plain", "--image", "photo.tif", "--z-mm", "30"], "do not apply: --z-mm"),
    ([*RECONSTRUCT, "--volume", "plain", "--image", "photo.tif", "--prior", "tv-haar"], "not for volumes"),
    (["snap", "photo2.tif"], "Did you mean --out photo2.tif?"),
    (["check", "other.toml"], "Did you mean --bench other.toml?"),
    (["gui", "bench.toml", "--bench", "bench.toml"], "Two benches are named"),
    (["snap", "--out", "a.png", "--figure", "a.png"], "the photograph itself has that name"),
    (["snap", "--out", "/proc/photo.tif"], "Choose another place"),
    (["analyze", "plain"], "--volume FOLDER"),
    (["compare", "cal", "plain"], "--volume FOLDER"),
    (["refocus", "psf.tif", "--z-mm", "20", "--out", "near"], "--psf FILE"),
    (["chart", "photograph", "--calibration", "plain", "--image", "photo.tif"], "--volume FOLDER"),
    ([*PAIR, "--dark", "photo.tif"], "nothing would be left of it"),
    ([*RECONSTRUCT, "--psf", "psf.tif", "--image", "huge.tif"], "no light has more"),
    (["calibrate", "axial", "--z-min", "100", "--z-max", "200", "--planes", "100000000"], "10000 or less"),
    (["completion", "tcsh"], "there are for bash, zsh, fish"),
    (["chart", "calibrations", "--out", "photo.tif"], "a folder is expected"),
    (["reconstruct", "cal"], "by --calibration cal"),
    (["show", "plain"], "plain"),
    (["verify", "cal"], "is no run folder"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    scene = make_scene("sparse-picture", size=64)
    photo, psf = (
        (100 + 40_000 * image / image.max()).astype(np.uint16)
        for image in (np.asarray(scene.measurement).clip(0), scene.calibration.psfs[0, 0])
    )
    images = {
        "photo": photo,
        "psf": psf,
        "small": psf[:20, :24],
        "eight": (psf >> 8).astype(np.uint8),
        "black": np.zeros_like(psf),
        "film": np.stack([photo] * 5),
        "huge": (psf * 1e33).astype(np.float32),
        "holes": np.where(psf == psf.max(), np.nan, psf).astype(np.float32),
    }
    for name, image in images.items():
        write_image(folder / f"{name}.tif", image)
    (folder / "plain").mkdir()
    for z in range(2):
        write_image(folder / "plain" / f"psf{z}.tif", psf)
    save_calibration(scene.calibration, folder / "cal")
    shutil.copytree(folder / "cal", folder / "sweep" / "calibration")
    save_calibration(Calibration(scene.calibration.psfs[:1], np.array([[0, 0, 2e4]])), folder / "near")
    (folder / "text.tif").write_text("psf")
    (folder / "empty.tif").touch()
    (folder / "other.toml").touch()
    return folder


def test_every_mistake_is_answered(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = shutil.copytree(files, tmp_path / "here")
    monkeypatch.chdir(here)
    before, unanswered = sorted(here.rglob("*")), []
    for words, answer in MISTAKES:
        status = main(words)
        said = " ".join("".join(capsys.readouterr()).replace("│", " ").split())
        if status != 2 or answer not in said or "Traceback" in said:
            unanswered.append(f"{' '.join(words)}\n    {status}: {said[-300:]}")
    assert not unanswered, "\n".join(unanswered)
    assert sorted(here.rglob("*")) == before


def test_a_float_photograph_with_a_raw_psf_is_doubted(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(files)
    write_image(tmp_path / "float.tif", np.random.default_rng(0).random((64, 64), np.float32))
    words = ["--psf", "psf.tif", "--image", str(tmp_path / "float.tif"), "--out", str(tmp_path / "o.tif")]
    assert main(["reconstruct", *words, "--iterations", "1"]) == 0
    assert "it was converted" in capsys.readouterr().err
    assert main(["reconstruct", *words, "--iterations", "1", "--dark", "0", "--force"]) == 0
    assert "give --dark" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (
            "analyze",
            "'CALIBRATION'. A calibration, or a run with one. For example: diffuserbench analyze runs/",
        ),
        ("compare runs/a", "'NEW'. A later one of the same camera. For example: diffuserbench compare runs/"),
        ("plan show", "'FILE'. The plan, .toml or .json. For example: diffuserbench plan show plan.toml"),
    ],
)
def test_a_missing_argument_is_described_with_an_example(
    typed: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(typed.split()) == 2
    assert f"Missing argument {said}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("--PSF psf.tif", "--psf"),
        ("--mosaic rggb", "--bayer"),
        ("--warm-iterations 3", "--warm"),
        ("--lambda 0.1", "--tau"),
        ("--output scene.tif", "--out"),
    ],
)
def test_an_option_in_capitals_or_by_another_name_is_found(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", *typed.split()]) == 2
    assert f"(Possible options: {meant})" in capsys.readouterr().err
