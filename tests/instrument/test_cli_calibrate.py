"""``diffuserbench calibrate axial``: what it prints, what it leaves, what it refuses."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from instrument.runs.writer import FrameToStore, RunWriter

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
        (["--z-min", "0"], "above 0"),
        (["--z-min", "200", "--z-max", "100"], "nearest first"),
        (["--z-min", "60", "--z-max", "900", "--planes", "3"], "outside the stage's limits"),
        (["--z-min", "60", "--z-max", "150", "--planes", "1"], "one plane needs z min = z max"),
        (["--z-min", "60", "--average", "0"], "must be a whole number, 1 or more"),
        (["--z-min", "60", "--target", "2"], "must be a number, 0.05 or more, 0.9 or less"),
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


@pytest.mark.parametrize("dry_run", [["--dry-run"], []])
@pytest.mark.parametrize(
    ("option", "message"),
    [
        (["--binning", "500"], "binning 500 leaves 0 x 0 pixels"),
        (["--dct", "9999"], "9999 DCT coefficients"),
        (["--dct", "100", "--binning", "4"], "100 DCT coefficients"),
    ],
)
def test_binning_and_dct_that_do_not_fit_the_camera_are_found_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str], message: str, dry_run: list[str]
) -> None:
    assert main(["calibrate", "axial", "--z-min", "100", *option, *dry_run]) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert "Exposure" not in out
    assert not (tmp_path / "runs").exists()


def test_resume_says_in_words_that_a_binning_does_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "axial", "--z-min", "100", "--average", "1"]) == 0
    (run,) = tmp_path.glob("runs/*")
    shutil.rmtree(run / "calibration")
    right = (run / "sweep.json").read_text()
    (run / "sweep.json").write_text(right.replace('"binning": 1', '"binning": 500'))
    assert main(["resume", str(run)]) == 2
    err = capsys.readouterr().err
    assert "binning 500 leaves" in err
    assert "sweep.json" in err
    (run / "sweep.json").write_text(right)
    assert main(["resume", str(run)]) == 0
    assert (run / "calibration").is_dir()


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("axial --z-min 100", "z-min z-max x y target lenslet wavelength"),
        (
            "lateral --z 100",
            "z spacing x y target fall-off-deg half-field-x half-field-y",
        ),
        (
            "volume --z-min 60 --z-max 100",
            "z-min z-max spacing x y target fall-off-deg half-field-x half-field-y lenslet wavelength",
        ),
        ("angular", "z largest step"),
    ],
)
def test_numbers_that_are_not_finite_are_mistakes(
    capsys: pytest.CaptureFixture[str], command: str, options: str, bad: str
) -> None:
    for option in options.split():
        assert main(["calibrate", *command.split(), f"--{option}", bad, "--dry-run"]) == 2
        err = capsys.readouterr().err
        assert f"--{option} must be a number" in err


@pytest.mark.parametrize(
    "arguments",
    [
        "lateral --z 0",
        "lateral --z 100 --spacing 0",
        "lateral --z 100 --spacing 1e-300",
        "lateral --z 100 --fall-off-deg 0",
        "lateral --z 100 --average 0",
        "lateral --z 100 --dark-frames 0",
        "lateral --z 100 --target 0",
        "lateral --z 100 --binning 0",
        "volume --z-min 0 --z-max 100",
        "volume --z-min 60 --z-max 0",
        "volume --z-min 60 --z-max 100 --planes 0",
        "volume --z-min 60 --z-max 100 --lenslet 0",
        "axial --z-min 60 --z-max 100 --wavelength 0",
        "axial --z-min 60 --z-max 100 --planes 0",
        "angular --z 0",
        "angular --largest 0",
        "angular --step 0",
        "angular --step 1e-9",
        "angular --average 0",
        "angular --dark-frames 0",
    ],
)
def test_zeros_are_mistakes(capsys: pytest.CaptureFixture[str], arguments: str) -> None:
    assert main(["calibrate", *arguments.split(), "--dry-run"]) == 2
    assert capsys.readouterr().err


def test_planes_the_wrong_way_round_are_one_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "axial", "--z-min", "300", "--z-max", "100"]) == 2
    err = capsys.readouterr().err
    assert "nearest first" in err
    assert "one plane" not in err


def test_one_is_no_plural(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["calibrate", "axial", "--z-min", "100", "--average", "1", "--dark-frames", "1", "--dry-run"]
    assert main(arguments) == 0
    assert "Plan: 1 plane x 1 frame + 1 dark frame = 2 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    "command",
    [
        "axial --z-min 60 --z-max 150 --planes 2",
        "axial --z-min 60",
        "lateral --z 100 --half-field-x 10 --half-field-y 0 --spacing 10",
    ],
)
def test_a_dry_run_plans_what_the_run_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    (tmp_path / "bench.toml").write_text(TINY + 'fall_off = "gaussian"\nfall_off_sigma_deg = 12\n')
    plans = []
    for dry_run in ("--dry-run", "--average=1"):
        assert main(["calibrate", *command.split(), "--average", "1", dry_run]) == 0
        (plan,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Plan: ")]
        plans.append(plan.split(" frames, ")[0])
    assert plans[0] == plans[1]


def test_an_interrupted_sweep_says_what_is_kept_and_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write, written = RunWriter.write, 0

    def interrupted(self: RunWriter, frames: Sequence[FrameToStore]) -> None:
        nonlocal written
        if written == 5:
            raise KeyboardInterrupt
        written += 1
        write(self, frames)

    monkeypatch.setattr(RunWriter, "write", interrupted)
    assert main(["calibrate", "axial", "--z-min", "100"]) == 130
    (run,) = tmp_path.glob("runs/*")
    err = capsys.readouterr().err
    assert "5 of 8 frames are kept" in err
    assert f"diffuserbench resume {run}" in err
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert main(["resume", str(run)]) == 0
    assert (run / "calibration").is_dir()


@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("calibration_routines.psf.sweep.expose_sweep", "no frame was kept"),
        (
            "calibration_routines.psf.sweep.analyse_sweep",
            "All frames of the sweep are kept. For its calibration: ",
        ),
    ],
)
def test_an_interruption_before_or_after_the_frames_says_so(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    function: str,
    says: str,
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(function, interrupted)
        assert main(["calibrate", "axial", "--z-min", "100", "--average", "1"]) == 130
    assert says in capsys.readouterr().err
    for run in tmp_path.glob("runs/*"):
        assert main(["resume", str(run)]) == 0
        assert (run / "calibration").is_dir()
