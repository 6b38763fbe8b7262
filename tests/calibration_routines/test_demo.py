"""The demo makes a good picture, keeps what it did, and can be stopped at any moment."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration_routines.demos.camera import run_demo
from calibration_routines.demos.picture import compare, scene_field
from calibration_routines.demos.result import DemoResult
from calibration_routines.demos.settings import DemoSettings, read_picture
from calibration_routines.procedure import Listener
from calibration_routines.psf.sweep_plan import SweepExposures
from drivers.errors import DeviceError
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config import BenchConfig
from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from instrument.files.errors import FileError
from instrument.files.images import read_image
from instrument.runs.run import Run, RunCondition

SMALL = DemoSettings(
    preset="tiny",
    camera_binning=1,
    binning=1,
    z_mm=(60.0, 150.0),
    planes=3,
    scene_plane=1,
    half_field_deg=5.0,
    lights=4,
    photograph_average=4,
    reconstruction_s=5.0,
    chart_s=0.3,
    time_scale=0.0,
)


SOLVING = ("reconstruct the picture", "reconstruct the volume", "chart methods")
PHOTOGRAPHING = ("photograph the scene in three colours", "photograph lights in a volume")
MOVING = ("dark frames and axial sweep", "response over the field", *PHOTOGRAPHING, *SOLVING)
WITHIN = ("sweeping", "analysing", "photographing", "finding the scene's exposure")
"""Steps of what is done in a stage."""
SAFE = {"light": "off", "stage_moving": False, "scene_lit": False}


class Troubling(Listener):
    """Keeps the demo's stages, and can raise when one begins or moves on."""

    def __init__(self, trouble_in: str = "", trouble: BaseException | None = None) -> None:
        self.stages: list[str] = []
        self.within: list[str] = []
        self.trouble_in, self.trouble = trouble_in, trouble

    def make_trouble(self) -> None:
        trouble, self.trouble = self.trouble, None
        if trouble is not None:
            raise trouble

    def step(self, words: str) -> None:
        if words in WITHIN:
            self.within.append(words)
            return
        self.stages.append(words)
        if words == self.trouble_in and words not in MOVING:
            self.make_trouble()

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        name = self.stages[-1]
        if name == self.trouble_in and (done >= total / 2 or name in SOLVING):
            self.make_trouble()

    def exposures(self, found: SweepExposures) -> None:
        assert not found.warnings


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[DemoResult, Troubling]:
    listener = Troubling()
    return run_demo(tmp_path_factory.mktemp("demo"), listener, SMALL), listener


def test_the_small_demo_reconstructs_its_scene(shown: tuple[DemoResult, Troubling]) -> None:
    result, listener = shown
    assert result.comparison.psnr_db > 24
    assert result.comparison.ssim > 0.7
    assert list(result.seconds) == listener.stages
    assert listener.within[:2] == ["sweeping", "analysing"]
    assert not any(photo.saturated_pixels for photo in (*result.measured.photos, result.measured.lights))
    assert result.placed.in_plane == SMALL.lights
    assert {point.psnr_db > 0 for point in result.chart.points} == {True}
    assert result.measured.calibration.findings == ()


def test_everything_it_made_is_in_its_folder(shown: tuple[DemoResult, Troubling]) -> None:
    result, _ = shown
    for path in result.files.values():
        assert path.is_relative_to(result.folder)
        assert path.exists()
    figure = cv2.imread(str(result.files["summary figure"]))
    assert figure is not None
    assert figure.std() > 20
    record = json.loads((result.folder / "demo.json").read_text())
    assert record["state"] == "completed"
    assert record["simulated"] is True
    assert record["psnr_db"] == pytest.approx(result.comparison.psnr_db, abs=0.01)
    assert record["left"] == SAFE
    assert len(load_calibration(result.files["calibration"]).psfs) == SMALL.planes


def test_a_picture_shifted_or_turned_over_scores_worse(shown: tuple[DemoResult, Troubling]) -> None:
    result, _ = shown
    truth = read_image(result.files["ground truth, linear float32"]).pixels
    picture = read_image(result.files["picture, linear float32"]).pixels
    height, width = truth.shape[:2]
    field = scene_field((height, width), (height // 2, width // 2), (height - 8.0, width - 8.0), 1.0)
    right = compare(picture, truth, field).psnr_db
    assert compare(picture[::-1], truth, field).psnr_db < right - 5
    assert compare(picture[:, ::-1], truth, field).psnr_db < right - 5
    assert compare(np.roll(picture, 2, axis=1), truth, field).psnr_db < right - 2


def test_pictures_stand_upright(shown: tuple[DemoResult, Troubling]) -> None:
    result, _ = shown
    original = read_picture()
    for name in ("picture", "ground truth, linear float32"):
        image = read_image(result.files[name]).pixels[4:-4, 4:-4]  # without the margin
        expected = cv2.resize(original, image.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.9


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_demo_as_it_is_keeps_its_promise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("instrument.cli.demo.DemoSettings", partial(DemoSettings, time_scale=0.0))
    assert main(["demo", "--out", str(tmp_path), "--reconstruction-s", "30"]) == 0
    out = capsys.readouterr().out
    found = re.search(r"PSNR ([0-9.]+) dB, SSIM ([0-9.]+) against the ground truth", out)
    assert found
    assert float(found[1]) > 28  # promised: 24
    assert float(found[2]) > 0.8
    assert "SIMULATED" in out
    lights = re.search(r"Lights: (\d+) of (\d+) found", out)
    assert lights
    assert int(lights[1]) >= 0.9 * int(lights[2])
    for stage in ("home the stage", "dark frames and axial sweep", *PHOTOGRAPHING, *SOLVING):
        assert re.search(rf"[0-9.]+  {stage}", out)
    (folder,) = tmp_path.iterdir()
    assert (folder / "summary.png").stat().st_size < 800_000


STOP, FAIL = KeyboardInterrupt(), DeviceError("camera (simulated)", "was unplugged.")


@pytest.mark.parametrize(
    ("stage", "trouble"),
    [
        ("home the stage", STOP),
        ("expose without saturating", STOP),
        ("dark frames and axial sweep", STOP),
        ("dark frames and axial sweep", FAIL),
        (PHOTOGRAPHING[0], STOP),
        (PHOTOGRAPHING[1], FAIL),
        ("reconstruct the picture", STOP),
        ("write the pictures", STOP),
    ],
)
def test_whatever_ends_it_the_bench_is_safe_and_the_record_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str, trouble: BaseException
) -> None:
    benches: list[Bench] = []

    def opened(config: BenchConfig) -> Bench:
        benches.append(open_bench(config))
        return benches[0]

    monkeypatch.setattr("calibration_routines.demos.journal.open_bench", opened)
    with pytest.raises(type(trouble)):
        run_demo(tmp_path, Troubling(stage, trouble), SMALL)
    (folder,) = tmp_path.iterdir()
    record = json.loads((folder / "demo.json").read_text())
    assert record["state"] == ("aborted" if isinstance(trouble, KeyboardInterrupt) else "failed")
    assert record["stage"] == stage
    assert record["left"] == SAFE
    assert not any(device.is_open for device in benches[0].devices.values())
    runs = sorted(path for path in folder.iterdir() if (path / "state.json").exists())
    if stage in MOVING and stage not in SOLVING:
        expected = RunCondition.ABORTED if record["state"] == "aborted" else RunCondition.FAILED
        assert [Run.open(run).condition for run in runs][-1] is expected


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match=r"is no folder|cannot be made"):
        run_demo(tmp_path / "file", Troubling(), SMALL)


PROGRAM = """
import sys
from calibration_routines.demos.settings import DemoSettings
from instrument.cli import main
small = DemoSettings(
    preset="tiny", camera_binning=1, binning=1, z_mm=(60.0, 150.0), planes=3, scene_plane=1,
    half_field_deg=5.0, lights=4, chart_s=0.3, reconstruction_s=5.0, time_scale=1.0,
)
import instrument.cli.demo as command
command.DemoSettings = lambda **_: small
print("ready", flush=True)
sys.exit(main(["demo", "--out", sys.argv[1]]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("wait_s", [0.0, 2.5])
def test_ctrl_c_ends_the_command_with_130_and_a_safe_bench(tmp_path: Path, wait_s: float) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("demo-*/demo.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(wait_s)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    (folder,) = tmp_path.iterdir()
    record = json.loads((folder / "demo.json").read_text())
    if record["state"] == "completed":
        pytest.skip("this machine was done before it was interrupted")
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert str(folder) in errors
    assert record["state"] == "aborted"
    conditions = [Run.open(state.parent).condition for state in folder.glob("*/state.json")]
    assert set(conditions) <= {RunCondition.COMPLETED, RunCondition.ABORTED}
    assert record.get("left", SAFE) == SAFE  # stopped before the bench was open, it is not there
