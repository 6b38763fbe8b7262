"""Files that commit 813d646 wrote still open, through the command line (``tests/fixtures/v813d646``)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from instrument.cli import main

OLD = Path(__file__).parent / "fixtures" / "v813d646"
Command = Callable[..., str]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the old files, as the working folder."""
    folder = tmp_path / "old"
    shutil.copytree(OLD, folder)
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def command(here: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command among the old files; it must succeed, unless another exit status is expected."""

    def run(*words: str, status: int = 0) -> str:
        assert Path.cwd() == here
        code = main(list(words))
        said = capsys.readouterr()
        assert code == status, said.out + said.err
        return said.out + said.err

    return run


RUNS = {"run": "3 of 3", "sweep": "7 of 7", "recording": "2"}


@pytest.mark.parametrize("name", RUNS)
def test_runs_are_shown_verified_and_exported(here: Path, command: Command, name: str) -> None:
    assert RUNS[name] in command("show", name)
    assert (here / name / "summary.png").exists()
    assert "sound" in command("verify", name)
    command("export", name, "frames.npy")
    assert np.load("frames.npy").shape[1:] == (240, 320)


def test_runs_are_listed(command: Command) -> None:
    said = command("list", ".")
    assert all(name in said for name in RUNS)


def test_a_run_that_was_cut_off_is_resumed(here: Path, command: Command) -> None:
    run = here / "run"
    *before, _, _ = (run / "log.jsonl").read_text().splitlines()  # without its last frame and its end
    (run / "log.jsonl").write_text("\n".join(before) + "\n")
    (run / "frames.ome.zarr/0/c/2/0/0").unlink()
    state = json.loads((run / "state.json").read_text())
    (run / "state.json").write_text(json.dumps(state | {"reason": "aborted"}))
    command("verify", "run")
    command("resume", "run")
    assert "3 of 3" in command("verify", "run")


def test_a_sweep_becomes_its_calibration_by_its_old_record(here: Path, command: Command) -> None:
    shutil.move(here / "sweep/calibration", here / "before")
    assert "PSFs good" in command("resume", "sweep")
    assert "RECALIBRATE" not in command("compare", "before", "sweep/calibration")


def test_bench_and_plan_are_read(command: Command) -> None:
    assert "SIMULATED" in command("check", "--bench", "bench.toml")
    assert "2 parts, 3 frames" in command("plan", "show", "plan.toml", "--bench", "bench.toml")


@pytest.mark.parametrize("folder", ["sweep/calibration", "sweep"])
def test_a_calibration_makes_a_picture(here: Path, command: Command, folder: str) -> None:
    given = (
        "--calibration",
        folder,
        "--image",
        "photo.tif",
        "--z-mm",
        "86",
        "-n",
        "15",
        "--solver",  # solver and weight that version chose by itself
        "admm",
        "--tau",
        str(json.loads((here / "results/picture.json").read_text())["tau"]),
        "--out",
        "again.tif",
    )
    command("reconstruct", *given)
    old, new = tifffile.imread(here / "results/picture.tif"), tifffile.imread(here / "again.tif")
    assert np.linalg.norm(new - old) < 0.02 * np.linalg.norm(old)


def test_a_calibration_makes_a_volume(here: Path, command: Command) -> None:
    given = (
        "--volume",
        "sweep/calibration",
        "--image",
        "photo.tif",
        "--prior",
        "l1",
        "--model",
        "convolution",
    )
    command("reconstruct", *given, "-n", "8", "--out", "again.tif")
    old, new = tifffile.imread(here / "results/volume.tif"), tifffile.imread(here / "again.tif")
    # Its background was not restrained then (decision 0059).
    assert np.linalg.norm(new - old) < 0.15 * np.linalg.norm(old)


def test_a_recording_becomes_a_video(here: Path, command: Command) -> None:
    command(
        *("reconstruct", "--video", "recording", "--calibration", "sweep/calibration", "--z-mm", "86"),
        *("--out", "video.ome.zarr"),
    )
    assert (here / "video.ome.zarr").exists()


def test_a_calibration_is_analysed_compared_and_refocused(here: Path, command: Command) -> None:
    command("analyze", "sweep/calibration", "--out", "page.pdf")
    assert (here / "page.pdf").stat().st_size > 5000
    command("compare", "sweep/calibration", "sweep/calibration")
    command("refocus", "sweep/calibration", "--z-mm", "100", "--out", "refocused")


@pytest.mark.parametrize(("name", "shape"), [("picture", (120, 160)), ("volume", (3, 120, 160))])
def test_results_are_opened(here: Path, command: Command, name: str, shape: tuple[int, ...]) -> None:
    command("export", f"results/{name}.tif", f"{name}.npy")
    assert np.load(here / f"{name}.npy").shape == shape


def test_alignment_slm_table_and_pattern_are_used(here: Path, command: Command) -> None:
    display = ("--bench", "display.toml", "--alignment", "alignment.json")
    command("hologram", "photo.tif", *display, "-n", "2", "--out", "again.png")
    assert (here / "again.png").exists()
    command("show", "slm.png", *display, "--slm-calibration", "slm-calibration.json", "--seconds", "0")


def test_stability_maps_are_drawn_and_gone_on_with(here: Path, command: Command) -> None:
    command("stability", "--redraw", "--out", "stability")
    assert (here / "stability/light-dense.png").stat().st_size > 5000
    before = json.loads((here / "stability/stability.json").read_text())
    assert before["maps"]["light-dense"]["methods"]["wiener"]


def test_a_chart_is_gone_on_with(here: Path, command: Command) -> None:
    before = len(json.loads((here / "chart/chart.json").read_text())["points"])
    command("chart", "scene", "sparse-picture", "--size", "16", "--budget", "1", "--out", "chart")
    assert len(json.loads((here / "chart/chart.json").read_text())["points"]) >= before
    assert (here / "chart/chart.png").exists()
