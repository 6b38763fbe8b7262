"""``diffuserbench calibrate axial``: what it prints, what it leaves, what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from instrument.calibration_file import load_calibration
from instrument.cli import main

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
"""


@pytest.fixture(autouse=True)
def bench_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bench.toml").write_text(TINY)
    monkeypatch.chdir(tmp_path)


def test_a_sweep_says_its_plan_its_verdict_and_where_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["calibrate", "axial", "--z-min", "60", "--z-max", "150", "--planes", "3", "--average", "2"])
        == 0
    )
    out, err = capsys.readouterr()
    assert "SIMULATED" in err
    assert "Planes (mm): 60, 85.71, 150" in out
    assert "3 planes x 2 frames + 8 dark frames = 14 frames" in out
    assert "all 3 PSFs good" in out
    (path,) = tmp_path.glob("runs/*/calibration")
    assert str(path) in out
    assert len(load_calibration(path).psfs) == 3


def test_the_number_of_planes_follows_from_the_optics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "axial", "--z-min", "60", "--z-max", "150", "--average", "1"]) == 0
    out = capsys.readouterr().out
    assert "5 planes every 2.5 per metre: the edge of the pattern moves by up to 2 pixels" in out
    (path,) = tmp_path.glob("runs/*/calibration")
    assert len(load_calibration(path).psfs) == 5


def test_one_psf_is_not_held_against_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "axial", "--z-min", "100", "--out", "here", "--average", "1"]) == 0
    out = capsys.readouterr().out
    assert "Quality: 1 PSF good" in out
    assert "centroids" not in out
    (path,) = tmp_path.glob("here/*/calibration")
    assert load_calibration(path).source_positions_um.tolist() == [[0.0, 0.0, 100e3]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--z-min", "0"], "in front of the diffuser"),
        (["--z-min", "200", "--z-max", "100"], "nearest first"),
        (["--z-min", "60", "--z-max", "900", "--planes", "3"], "outside the stage's limits"),
        (["--z-min", "60", "--z-max", "150", "--planes", "1"], "one plane needs z min = z max"),
        (["--z-min", "60", "--average", "0"], "average must be at least 1"),
        (["--z-min", "60", "--target", "2"], "target must lie between"),
        (["--z-min", "0.05", "--z-max", "150"], "these optics need"),
        (["--z-max", "60"], "--z-min"),
    ],
)
def test_mistakes_end_with_2_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["calibrate", "axial", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_source_too_weak_ends_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bench.toml").write_text(TINY + "source_brightness = 1e-7\n")
    assert main(["calibrate", "axial", "--z-min", "100"]) == 1
    assert "too dark" in capsys.readouterr().err
