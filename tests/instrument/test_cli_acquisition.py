"""Acquisition from the command line: plan, run, resume, record, list, show, verify, export."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.camera import SimulatedCamera
from instrument.bench.lit import LightState, spoilt
from instrument.cli import main
from instrument.plan import Plan
from instrument.plan.model import load_plan, plan_toml, save_plan
from instrument.runs.inspection import verify
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import RunError, refuse_within
from instrument.runs.writer import RunWriter
from recon.base.checks import saturated_share
from tests.mocks.devices import MockCamera, MockStage

pytestmark = pytest.mark.usefixtures("mock_drivers")

BENCH = """\
[camera]
driver = "mock"
[stage]
driver = "mock"
[led_array]
driver = "mock"
[scene]
control = "simulated"
"""
PLAN = """\
label = "sweep"
[[parts]]
label = "dark"
average = 2
[[parts]]
label = "psf"
light = "source"
exposure_ms = 5
[parts.positions]
kind = "grid"
x_um = [-5, 5]
z_um = { start = 100, stop = 400, number = 3, spacing = "dioptric" }
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text(BENCH)
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path


def the_run(here: Path) -> Run:
    (path,) = (here / "runs").iterdir()
    return Run.open(path)


def test_a_plan_is_shown_with_its_cost_and_its_path(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "show", "plan.toml"]) == 0
    shown = capsys.readouterr().out
    for words in (
        "2 parts, 7 frames",
        "Exposures: 8, moves: 6",
        "Time:",
        "Disk:",
        "S",
        "E",
        "z_um 100 to 400",
    ):
        assert words in shown
    assert "The bench can do it" in shown
    assert not (here / "runs").exists()


def test_a_plan_out_of_reach_is_refused_by_show_and_run_alike(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "plan.toml").write_text(PLAN.replace("[-5, 5]", "[-500, 5]"))
    for command in (["plan", "show"], ["run"]):
        assert main([*command, "plan.toml"]) == 2
        assert "steps 1, 3, 5: x_um = -500 is outside" in capsys.readouterr().err
    assert not (here / "runs").exists()


def test_mistakes_of_a_plan_file_are_all_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "plan.toml").write_text('label = "x"\n[[parts]]\nlabel = "a"\nrepeat = 3\naverage = 0\n')
    assert main(["run", "plan.toml"]) == 2
    shown = capsys.readouterr().err
    assert "plan.toml: 2 problems" in shown
    assert "parts[0].repeat" in shown
    assert "parts[0].average" in shown
    (here / "broken.toml").write_text("label =\n")
    assert main(["run", "broken.toml"]) == 2
    assert "line 1" in capsys.readouterr().err
    assert main(["run", "plan.yaml"]) == 2
    assert main(["run", "nowhere.toml"]) == 2
    assert "no such plan file" in capsys.readouterr().err


def test_the_plan_to_start_from_is_a_good_one(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "new", "mine.toml"]) == 0
    plan = load_plan(here / "mine.toml")
    assert {part.label for part in plan.parts} == {"dark", "psf", "scene"}
    assert main(["plan", "new", "mine.toml"]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_a_plan_file_reads_back_as_it_was_written(here: Path, suffix: str) -> None:
    plan = load_plan(here / "plan.toml")
    save_plan(plan, here / f"again{suffix}")
    assert load_plan(here / f"again{suffix}") == plan
    everything = Plan.checked(
        {
            "label": 'quotes " and µ',
            "parts": [
                {
                    "label": "a",
                    "light": ["off", {"kind": "pattern", "description": "two", "leds": [[0, 1, 2, 3]]}],
                    "positions": {"kind": "stage", "points": [{"x_um": 1.5}]},
                    "slm_images": ["/a.png"],
                    "gains": [2],
                    "interval_s": 0.5,
                    "repeats": 2,
                    "order": ["exposure", "slm", "light", "repeat", "position"],
                }
            ],
        }
    )
    save_plan(everything, here / f"all{suffix}")
    assert load_plan(here / f"all{suffix}") == everything
    assert plan_toml(everything).count("[[parts]]") == 1


def test_run_list_show_verify(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "plan.toml", "--figure", "frames.png"]) == 0
    assert main(["run", "plan.toml", "--figure", "frames.png"]) == 2, "it is there already"
    shown = capsys.readouterr()
    assert "Wrote frames.png" in shown.out
    assert "completed: 7 of 7 frames" in shown.out
    assert "SIMULATED" in shown.out + shown.err
    run = the_run(here)
    assert run.condition is RunCondition.COMPLETED
    assert main(["list"]) == 0
    assert "7 of 7" in capsys.readouterr().out
    assert main(["show", str(run.path)]) == 0
    shown_text = capsys.readouterr().out
    assert "psf:" in shown_text
    assert (run.path / "summary.png").stat().st_size > 1000
    assert main(["verify", str(run.path)]) == 0
    assert "sound, completed, 7 of 7" in capsys.readouterr().out


def test_verify_finds_damage_and_resume_mends_it(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "plan.toml"]) == 0
    run = the_run(here)
    chunk = run.array.chunk_path(2)
    chunk.write_bytes(b"\1" + chunk.read_bytes()[1:])
    run.array.chunk_path(4).unlink()
    capsys.readouterr()
    assert main(["verify", str(run.path)]) == 1
    shown = capsys.readouterr()
    assert "DAMAGED" in shown.out
    assert "frame 2" in shown.err
    assert "frame 4: its file is gone" in shown.err
    assert "diffuserbench resume takes frames 2, 4; what it replaces is kept beside." in shown.err
    assert main(["show", str(run.path)]) == 0
    assert "frame 4: its file is gone" in capsys.readouterr().out
    assert main(["resume", str(run.path)]) == 0
    shown = capsys.readouterr()
    assert "completed: 5 frames safely stored, 2 to do, first step 2" in shown.err
    assert "completed: 7 of 7" in shown.out
    assert main(["verify", str(run.path)]) == 0
    assert [file.stat().st_size for file in (run.path / "kept").iterdir()] == [chunk.stat().st_size]


def test_a_run_cut_off_is_resumed(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    original, taken = MockCamera.snap, []

    def interrupted(self: MockCamera):  # type: ignore[no-untyped-def]
        if len(taken) == 4:
            raise KeyboardInterrupt
        taken.append(1)
        return original(self)

    with monkeypatch.context() as patch:
        patch.setattr(MockCamera, "snap", interrupted)
        assert main(["run", "plan.toml"]) == 130
    shown = capsys.readouterr().err
    run = the_run(here)
    assert str(run.path) in shown
    assert run.condition is RunCondition.ABORTED
    assert main(["resume", str(run.path)]) == 0
    shown = capsys.readouterr()
    assert "aborted: 3 frames safely stored, 4 to do, first step 3" in shown.err
    assert "completed: 7 of 7" in shown.out
    assert main(["resume", str(run.path)]) == 0
    assert "complete already" in capsys.readouterr().out


@pytest.mark.usefixtures("here")
def test_a_stage_without_reference_is_homed_before_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def home(self: MockStage) -> None:
        self._call("home")
        self.is_homed = True

    monkeypatch.setattr(MockStage, "is_homed", False)
    monkeypatch.setattr(MockStage, "home", home)
    assert main(["run", "plan.toml"]) == 0
    assert "Homing" in capsys.readouterr().err
    assert main(["plan", "show", "plan.toml"]) == 0


def test_a_recording_cut_off_is_closed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--frames", "5", "--label", "beads", "--figure", "page.png"]) == 0
    assert (here / "page.png").stat().st_size > 1000
    shown = capsys.readouterr()
    assert "of 5 frames" in shown.out
    assert "the camera dropped" in shown.err  # the mock camera says that it drops one before each frame
    run = the_run(here)
    assert "beads" in run.path.name
    assert main(["resume", str(run.path)]) == 0
    assert "nothing to go on with" in capsys.readouterr().out
    state = run.path / "state.json"
    state.write_text(state.read_text().replace('"finished"', '"running"'))
    assert main(["resume", str(run.path)]) == 0
    assert "the recording was cut off; it is closed now" in "".join(capsys.readouterr())
    assert Run.open(run.path).reason is FinishReason.ABORTED
    assert main(["verify", str(run.path)]) == 0


def test_a_recording_that_saturates_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["record", "--as-is", "--scene", "--frames", "3", "--bench", str(here / "sim.toml")]
    (here / "sim.toml").write_text(
        '[camera]\ndriver = "simulated"\n[scene]\ncontrol = "simulated"\n'
        '[simulated]\npreset = "tiny"\ntime_scale = 0\nfixed_pattern = false\n'
    )
    assert main([*words, "--exposure-ms", "20000"]) == 0
    assert "Warning: 3 of 3 frames have saturated pixels, up to " in capsys.readouterr().err
    assert main([*words, "--exposure-ms", "0.1"]) == 0
    assert "saturated" not in capsys.readouterr().err


def test_a_pixel_at_full_scale_is_told_and_no_warning(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "sim.toml").write_text(
        '[camera]\ndriver = "simulated"\n[scene]\ncontrol = "simulated"\n'
        '[simulated]\npreset = "tiny"\ntime_scale = 0\n'
    )
    true = SimulatedCamera._read_out
    monkeypatch.setattr(SimulatedCamera, "_read_out", lambda *given: (true(*given)[0], 2e-6))
    words = ["--as-is", "--bench", str(here / "sim.toml"), "--exposure-ms", "1"]
    assert main(["snap", *words, "--out", str(here / "photo.tif")]) == 0
    told = capsys.readouterr()
    assert "; less than 0.001 % of the pixels are saturated." in told.out
    assert main(["record", "--scene", "--frames", "2", *words]) == 0
    told = "".join((told.err, *capsys.readouterr()))
    assert "2 of 2 frames have saturated pixels, up to less than 0.001 % of them." in told
    assert "Warning" not in told


def test_a_few_hot_pixels_spoil_no_psf_as_its_judge_says() -> None:
    """Of 0.1 and 0.3 megapixels a share alone would be 1 and 3 pixels."""
    for n_pixels in (100_000, 300_000, 5_500_000):
        image = np.linspace(0, 1, n_pixels, dtype=np.float32)
        for n in (1, 2, 3, 4, 56):
            image[:] = np.linspace(0, 1, n_pixels)
            image[:n] = 2
            judged = saturated_share(image) > 0
            assert spoilt(n / n_pixels, n_pixels, LightState.SOURCE) is judged
            assert judged is (n > 3 and n > 1e-5 * n_pixels)
            assert not spoilt(n / n_pixels, n_pixels, LightState.SCENE)


def test_a_point_source_is_warned_of_before_a_scene(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "sim.toml").write_text(
        '[camera]\ndriver = "simulated"\n[scene]\ncontrol = "simulated"\n'
        '[simulated]\npreset = "tiny"\ntime_scale = 0\n'
    )
    true = SimulatedCamera._read_out
    monkeypatch.setattr(SimulatedCamera, "_read_out", lambda *given: (true(*given)[0], 6e-5))
    words = ["--as-is", "--bench", str(here / "sim.toml"), "--exposure-ms", "1"]
    for light, warned in (("--source", True), ("--scene", False)):
        assert main(["snap", *words, light, "--out", str(here / f"photo{light}.tif")]) == 0
        told = capsys.readouterr()
        assert ("Warning: 0.006 % of the pixels are saturated, of a PSF none may be;" in told.err) is warned
        assert ("; 0.006 % of the pixels are saturated." in told.out) is not warned
        assert main(["record", light, "--frames", "2", *words]) == 0
        told = capsys.readouterr()
        assert ("up to 0.006 % of them, of a PSF none may be; shorten" in told.err) is warned


def test_one_program_at_a_time_writes_to_a_run(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "plan.toml"]) == 0
    run = the_run(here)
    run.array.chunk_path(0).unlink()
    state = run.path / "state.json"
    state.write_text(state.read_text().replace('"completed"', '"failed"'))
    with RunWriter.reopen(run.path):
        assert main(["resume", str(run.path)]) == 2
    assert "another program is writing" in capsys.readouterr().err


def test_a_folder_that_may_not_be_written_is_refused_before_anything_moves(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = here / "runs"
    folder.write_text("a file where the folder should be")
    assert main(["run", "plan.toml"]) == 2
    assert "runs" in capsys.readouterr().err
    folder.unlink()
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        if not _is_writable(folder):
            assert main(["run", "plan.toml"]) == 2
            assert "may write to" in capsys.readouterr().err
    finally:
        folder.chmod(stat.S_IRWXU)


def _is_writable(folder: Path) -> bool:
    """Root may write anywhere."""
    try:
        (folder / "probe").touch()
    except OSError:
        return False
    (folder / "probe").unlink()
    return True


def test_no_output_is_written_to_a_runs_own_files(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "plan.toml"]) == 0
    run = the_run(here)
    for name in ("log.jsonl", "state.json", "frames.ome.zarr/c/0/0/0", "kept/a.tif", "slm"):
        assert main(["snap", "--dark", "--force", "--out", str(run.path / name)]) == 2
        assert "is part of it; no output replaces it" in capsys.readouterr().err
    beside = {path.name for path in run.path.iterdir()}
    for words, place in (("is a run", run.path), (f"is within the run {run.path.name}", run.path / "a/b")):
        for command in (["run", "plan.toml"], ["record"], ["calibrate", "axial", "--z-min", "20"]):
            assert main([*command, "--out", str(place)]) == 2
            said = capsys.readouterr().err
            assert f"{words}; no other run is kept there" in said
            assert "Bench:" not in said  # refused before anything is opened
        with pytest.raises(RunError, match=words):
            refuse_within(place)
    assert {path.name for path in run.path.iterdir()} == beside
    assert verify(Run.open(run.path)).is_sound
    assert main(["snap", "--dark", "--out", str(run.path / "beside.tif")]) == 0
    (calibration := here / "calibration").mkdir()
    (calibration / "calibration.json").write_text("{}")
    assert main(["snap", "--dark", "--force", "--out", str(calibration / "psfs.ome.zarr")]) == 2
    assert "is a calibration, and psfs.ome.zarr is part of it" in capsys.readouterr().err


def test_list_says_what_cannot_be_read(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    assert "no such folder" in capsys.readouterr().out
    assert main(["run", "plan.toml"]) == 0
    run = the_run(here)
    copy = here / "runs" / "broken"
    shutil.copytree(run.path, copy)
    state = copy / "state.json"
    state.write_text(state.read_text().replace('"version": 1', '"version": 99'))
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    assert "UNREADABLE" in said
    assert "DAMAGED" not in said
    image = run.array.chunk_path(0)
    image.write_bytes(image.read_bytes()[:-1])
    assert main(["list"]) == 0
    assert "completed, DAMAGED" in capsys.readouterr().out
    assert main(["list", "no-such-folder"]) == 2
    assert "no-such-folder: is no folder" in capsys.readouterr().err
