"""``diffuserbench calibrate beads``, on the simulated bench and with files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from calibration_routines import rehearsal
from calibration_routines.optics import beads
from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from recon.blind import BlindResult, Points

BENCH = """
[bench]
data_folder = "runs"
[camera]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "microscope"
scene = "beads"
beads = 4
aperture_mm = [0.3, 0.3]
lenslet_um = 100
time_scale = 0
"""


def bead_images(count: int = 4, size: int = 48) -> list[np.ndarray]:
    """Images of one pattern of spots at random places, in counts."""
    rng = np.random.default_rng(5)
    pattern = [(rng.uniform(-7, 7), rng.uniform(-7, 7)) for _ in range(9)]
    y, x = np.mgrid[:size, :size] - size / 2
    images = []
    for _ in range(count):
        image = rng.normal(100, 2, (size, size))
        for row, column in rng.uniform(-10, 10, (4, 2)):
            for r, c in pattern:
                image += 900 * np.exp(-((y - row - r) ** 2 + (x - column - c) ** 2) / 2.4)
        images.append(np.clip(image, 0, 65535).astype(np.uint16))
    return images


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    names = []
    for number, image in enumerate(bead_images()):
        names.append(str(tmp_path / f"slide-{number}.tif"))
        tifffile.imwrite(names[-1], image)
    return names


def test_files_from_anywhere(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "calibration"
    words = ["calibrate", "beads", *files, "--z", "2.5", "--pixel-um", "11.6", "--distance-mm", "3.8"]
    words += [
        "--dark",
        "100",
        "--window",
        "21x21",
        "--psfs",
        "2x2",
        "--rank",
        "2",
        "-n",
        "15",
        "--out",
        str(out),
    ]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "Misfit by rank" in said
    made = load_calibration(out)
    assert made.psfs.shape == (4, 1, 48, 48)
    light = made.psfs.sum(axis=(1, 2, 3))  # unit, less what falls beside the sensor
    assert (light > 0.4).all()
    assert (light < 1.1).all()
    assert (made.source_positions_um[:, 2] == 2500.0).all()
    # A PSF shifted to the right belongs to a source on the left, d/z times nearer to the axis.
    first = made.source_positions_um[0]
    assert first[0] > 0
    assert first[1] > 0
    assert made.quality["misfits"][0] < 0.6
    assert main(words) == 2  # it is there already


@pytest.mark.parametrize(
    ("alike", "count", "said"),
    [
        (0.96, 20, ""),
        (0.6, 20, "Quality: either half of the photographs gives another PSF: 0.60 alike"),
        (0.96, 60, "Quality: 20 to 60 beads were found in a photograph: more than 50"),
    ],
)
def test_psfs_that_are_made_up_have_a_doubtful_name(
    alike: float,
    count: int,
    said: str,
    files: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = BlindResult(
        psfs=np.full((1, 9, 9), 1 / 81, np.float32),
        points=np.zeros((1, 2)),
        beads=tuple(Points(np.zeros((n, 2)), np.ones(n)) for n in (20, count, count, count)),
        rank=1,
        misfits=(0.2,),
        point_misfits=(0.18,),
        stopped="the last rank was reached",
        sensor_shape=(48, 48),
        halves_alike=alike,
    )
    monkeypatch.setattr(beads, "calibrate_from_beads", lambda *_, **__: found)
    words = ["calibrate", "beads", *files, "--z", "2.5", "--pixel-um", "11.6", "--distance-mm", "3.8"]
    assert main([*words, "--window", "9x9", "--out", str(tmp_path / "calibration")]) == 0
    words_said = " ".join(capsys.readouterr().out.split())
    assert ("Quality: " in words_said) == bool(said)
    assert said in words_said
    (made,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert made.name == ("doubtful_calibration" if said else "calibration")
    quality = load_calibration(made).quality
    assert (quality["good"], quality["halves_alike"]) == (not said, alike)


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        (["--window", "200"], "rows x columns"),
        (["--z", "-1"], "above 0"),
        (["--psfs", "0x3"], "rows x columns"),
    ],
)
def test_mistakes(
    changed: list[str], part: str, files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", "beads", *files, "--pixel-um", "11.6", "--distance-mm", "3.8", "--window", "21x21"]
    words += ["--z", "2.5"]
    assert main([*words, *changed, "--out", str(tmp_path / "x")]) == 2
    assert part in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_without_geometry_it_says_what_is_missing(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "beads", *files, "--out", str(tmp_path / "x")]) == 2
    assert "--pixel-um and --distance-mm" in capsys.readouterr().err


def test_a_dry_run_says_what_it_would_do_and_writes_nothing(
    files: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "x")
    words = ["calibrate", "beads", *files, "--pixel-um", "11.6", "--distance-mm", "3.8", "--window", "21x21"]
    assert main([*words, "--dry-run", "--out", out]) == 2  # nothing tells how far the slide was
    assert "the slide's distance from the diffuser" in capsys.readouterr().err
    words += ["--z", "2.5"]
    assert main([*words, "--dry-run", "--out", out]) == 0
    said = capsys.readouterr().out
    assert "4 files, read and found alike" in said
    assert "5 x 5 PSFs of 21 x 21 pixels at z = 2.5 mm, over 80% of the field of 48 x 48 pixels" in said
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rehearsal, "ENOUGH_S", 0.0)
    (tmp_path / "bench.toml").write_text(BENCH + "scene_distance_mm = 3.1\n")
    assert main(["calibrate", "beads", "--dry-run", "--out", out]) == 0
    said = capsys.readouterr().out
    assert "at z = 3.1 mm" in said  # where that bench has its slides
    assert "9 photographs of 4 frames" in said
    assert "take long to solve" in said
    assert 'of "photographing bead slide" and the sizes of what follows' in said
    assert not (tmp_path / "runs").exists()
    assert not Path(out).exists()


def test_options_of_files_are_refused_on_the_bench(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "beads", "--dark", "100", "--pixel-um", "3"]) == 2
    assert "--dark and --pixel-um go with image files" in capsys.readouterr().err


def test_the_same_file_twice_is_refused(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", "beads", files[0], files[1], files[0], "--pixel-um", "11.6", "--distance-mm", "3.8"]
    assert main([*words, "--z", "2.5", "--window", "21x21", "--out", str(tmp_path / "x")]) == 2
    assert "Images 1 and 3 are the same" in capsys.readouterr().err


def test_the_simulated_bench_changes_its_slides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text(BENCH)
    words = ["calibrate", "beads", "--z", "2.5", "--images", "2", "--average", "1", "--binning", "8"]
    words += ["--psfs", "2x2", "--rank", "1", "-n", "5", "--out", "made"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "SIMULATED" in said
    assert "beads were found in a photograph: more than 50" in said  # of too coarse pixels
    made = load_calibration(tmp_path / "doubtful_made")
    assert made.provenance["simulated"] is True
    assert made.geometry.pixel_pitch_um == pytest.approx(8 * 2.9)
    assert len(list((tmp_path / "runs").iterdir())) == 2
