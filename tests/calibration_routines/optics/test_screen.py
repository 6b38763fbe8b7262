"""A PSF by random pictures on a screen, on the simulated bench: propagated light, not the solver's model."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from calibration_routines.optics.screen_bench import ScreenProcedure, draw_pictures
from calibration_routines.optics.screen_pictures import (
    ScreenMap,
    ScreenTone,
    bars,
    dead_leaves,
    field_along,
    random_cells,
)
from calibration_routines.optics.screen_search import SEARCH
from calibration_routines.optics.screen_solve import (
    PICTURE,
    TONE,
    ScreenCalibration,
    ScreenOptions,
    findings_of,
    moved_meanwhile,
)
from calibration_routines.procedure import Listener
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import compare
from calibration_routines.times import first_guess
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config, template
from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from instrument.files.errors import BenchError
from instrument.runs.run import Run
from instrument.runs.run_control import EndedEarlyError, RunControl
from recon.camera.registration import aligned, register

ROOT = Path(__file__).parents[3]
ASKED = ScreenOptions(pictures=6, judged=0, average=2, dark_frames=2, z_um=300e3)
SMALL = (
    template("screen")
    .replace("color = false", "color = false\nbinning = 2\nexposure_ms = 20.0")
    .replace("[1080, 1920]", "[140, 180]")
    .replace("270.0", "700.0")
    .replace('preset = "tiny"', 'preset = "tiny"\naperture_mm = [0.8, 1.0]')
)
ASKEW = ScreenMap(((-1.2, 0.03, 240.0), (-0.02, -1.25, 200.0), (1e-4, -2e-4, 1.0)), 25, 0.0)


def small_bench(text: str = SMALL) -> Bench:
    return open_bench(parse_config(text, None))


def true_psf(bench: Bench) -> np.ndarray:
    world = bench.shared["simulated"]
    assert isinstance(world, SimulatedWorld)
    return world.psf((0.0, 0.0, 300e3), (0.55, 0.6, 0.5), 2)


def test_the_psf_is_that_of_a_point_and_gamma_is_the_screens(tmp_path: Path) -> None:
    shares: list[float] = []

    class Shares(Listener):
        def share(self, done: float, total: float, *, at_most: bool = False) -> None:
            if total == SEARCH:
                shares.append(done)

    with small_bench() as bench:
        done = ScreenProcedure(ASKED).carry_out(bench, tmp_path, listener=Shares())
        truth = true_psf(bench)
        assert not bench.slm or not bench.slm.displayed.any()
    assert shares == list(range(1, SEARCH + 1))
    found = done.result
    assert isinstance(found, ScreenCalibration)
    assert done.good, found.findings
    psf = found.calibration.psfs[0, 0]
    # Where the pictures' middle is, is the calibration's to choose: within a few pixels of the axis.
    place = register(psf, truth)
    assert np.hypot(place.rows, place.columns) < 4
    assert np.corrcoef(aligned(psf, place).ravel(), truth.ravel())[0, 1] > 0.95
    assert found.calibration.source_positions_um[0, 2] == 300e3
    assert found.tone.gamma == pytest.approx(2.2, abs=0.03)
    quality = json.loads((done.runs[0] / "calibration" / "calibration.json").read_text())["quality"]
    assert quality["registration_px"] < 0.2
    assert quality["misfit"] < 0.1


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """PSF of a run that nothing ended."""
    with small_bench() as bench:
        done = ScreenProcedure(ASKED).carry_out(bench, tmp_path_factory.mktemp("whole"))
    assert isinstance(done.result, ScreenCalibration)
    return done.result.calibration.psfs


def ended_by(number: int, folder: Path, kept: int) -> tuple[Path, dict[Path, bytes]]:
    """Give the program a signal once so many frames are kept; return the run, and its frames as logged."""
    (folder / "bench.toml").write_text(SMALL)
    heeding = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    typed = "from instrument.cli import main; sys.exit(main(sys.argv[1:]))"
    numbers = {"--pictures": 6, "--judged": 0, "--average": 2, "--dark-frames": 2, "--z": 300}
    words = ["calibrate", "screen", *(str(word) for pair in numbers.items() for word in pair)]
    with subprocess.Popen(
        [sys.executable, "-c", heeding + typed, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as program:
        while (
            sum(log.read_bytes().count(b'"kind": "frame"') for log in folder.glob("runs/*/log.jsonl")) < kept
        ):
            assert program.poll() is None, program.communicate()[0]
            time.sleep(0.002)
        program.send_signal(number)
        said, _ = program.communicate()
    (run,) = (folder / "runs").iterdir()
    if number != signal.SIGKILL:
        assert f"resume {run}" in said
    assert program.returncode in (-signal.SIGKILL, 128 + number)
    files = (run / f"frames.ome.zarr/0/c/{index}/0/0" for index in Run.open(run).records)
    return run, {file: file.read_bytes() for file in files}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_a_signal_ended_is_resumed_to_the_same_psf(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], uninterrupted: np.ndarray, number: int
) -> None:
    run, kept = ended_by(number, tmp_path, 12)
    assert main(["resume", str(run)]) == 0
    assert "PSF: leaves" in capsys.readouterr().out
    assert len(kept) >= 10
    assert all(file.read_bytes() == frame for file, frame in kept.items())
    psf = load_calibration(run / "calibration").psfs
    # The other frames have other noise; PSFs of two runs of which neither was ended are alike to 0.995, too.
    assert np.corrcoef(psf.ravel(), uninterrupted.ravel())[0, 1] > 0.99
    assert psf.sum() == pytest.approx(uninterrupted.sum(), rel=0.02)


def test_killed_while_it_solves_its_frames_give_the_psf_itself(
    tmp_path: Path, uninterrupted: np.ndarray
) -> None:
    run, kept = ended_by(signal.SIGKILL, tmp_path, 34)
    assert len(kept) == 34  # every one
    assert not (run / "calibration").exists()
    assert main(["resume", str(run)]) == 0
    np.testing.assert_array_equal(load_calibration(run / "calibration").psfs, uninterrupted)


def test_who_interrupts_the_search_is_told_that_it_begins_anew(tmp_path: Path) -> None:
    class Stop(Listener):
        def share(self, done: float, total: float, *, at_most: bool = False) -> None:
            if done == 2:
                control.abort()

    control = RunControl()
    with small_bench() as bench, pytest.raises(EndedEarlyError) as ended:
        ScreenProcedure(ASKED).carry_out(bench, tmp_path, control=control, listener=Stop())
    assert "nothing is kept" in ended.value.__notes__[0]
    assert "53 photographs are taken anew" in ended.value.__notes__[0]
    assert not list(tmp_path.iterdir())


def test_the_outlook_tells_frames_and_what_each_step_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    with small_bench() as bench:
        outlook, binned = (
            ScreenProcedure(replace(ASKED, binning=binning)).outlook(bench) for binning in (1, 2)
        )
        monkeypatch.setattr(Bench, "simulated_kinds", ())
        real = ScreenProcedure(ASKED).outlook(bench)
        (words,) = first_guess(bench, real)
    assert outlook.cost is not None
    assert outlook.cost.frames == 2 + 2 * (9 + 6 + 1)
    assert outlook.beside_s == 0  # a simulated bench that waits for nothing
    assert [step for step, _ in outlook.work] == [
        "finding the screen",
        "showing pictures",
        "solving for the PSF",
    ]
    work, less, computed = (dict(one.work) for one in (outlook, binned, real))
    assert work["solving for the PSF"] > 2 * less["solving for the PSF"]
    assert work["finding the screen"] > work["showing pictures"] > computed["showing pictures"] == 0
    assert words.startswith("In all, by a first guess: about")


def test_a_bench_without_a_screen_and_a_dark_screen_are_said_in_words(tmp_path: Path) -> None:
    without = SMALL[: SMALL.index("\n[slm]")] + SMALL[SMALL.index("\n[scene]") :]
    with small_bench(without) as bench, pytest.raises(BenchError, match=r"has no \[slm\]"):
        ScreenProcedure(ASKED).outlook(bench)
    with small_bench(template()) as bench, pytest.raises(BenchError, match="is no screen"):
        ScreenProcedure(ASKED).outlook(bench)
    dark = SMALL.replace("black = 0.001", "black = 0.001\nwhite = 1e-7")
    with small_bench(dark) as bench, pytest.raises(CalibrationError, match="hardly lights the camera") as no:
        ScreenProcedure(ASKED).carry_out(bench, tmp_path)
    assert not hasattr(no.value, "__notes__")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("creep_px_per_min = 8", "its picture moved by"),
        ("ambient_e_per_s = 80000\nambient_period_s = 120", "other light"),
    ],
)
def test_what_moves_or_shines_while_the_screen_is_looked_for_is_said(
    fault: str, said: str, tmp_path: Path
) -> None:
    with small_bench(f"{SMALL.rstrip()}\n{fault}\n") as bench, pytest.raises(CalibrationError, match=said):
        ScreenProcedure(ASKED).carry_out(bench, tmp_path)


def test_pixels_that_turn_hot_do_not_mislead_the_search_and_shaking_is_said(tmp_path: Path) -> None:
    faults = "late_hot_pixels = 300\nlate_hot_e_per_s = 1e6\nlate_hot_after_s = 1\nvibration_px = 0.4\n"
    with small_bench(f"{SMALL.rstrip()}\n{faults}") as bench:
        done = ScreenProcedure(replace(ASKED, pictures=4, binning=2)).carry_out(bench, tmp_path)
    assert not done.good
    assert any("the picture shakes by" in line for line in done.verdict)
    assert done.result.calibration.quality["registration_px"] < 2


def test_a_white_in_whose_noise_no_place_is_found_is_not_said_to_have_moved() -> None:
    """An even white through a diffuser has little structure: "moved by inf pixels" made it doubtful."""
    rng = np.random.default_rng(0)
    even = [rng.normal(1000, 5, (96, 128)).astype(np.float32) for _ in range(2)]
    assert not np.isfinite(compare(*even).shift_px)
    assert moved_meanwhile(*even, binning=1) == ()
    structured = 1000 + 1000 * ndimage.gaussian_filter(rng.normal(size=(96, 128)), 1.5).astype(np.float32)
    assert moved_meanwhile(np.roll(structured, 2, axis=1), structured, binning=2)[0].startswith(
        "the picture moved by "
    )
    assert moved_meanwhile(structured, structured, binning=1) == ()


def test_a_map_is_found_from_marks_but_for_one_that_is_wrong() -> None:
    screen = np.array([(r, c) for r in (20.0, 60.0, 100.0) for c in (20.0, 80.0, 140.0)])
    sensor = ASKEW.on_sensor(screen)
    assert ASKEW.on_screen(sensor) == pytest.approx(screen)
    sensor[4] += 9
    found = ScreenMap.of_marks(screen, sensor)
    assert found is not None
    assert found.marks == 8
    assert found.misfit_px < 1e-3
    assert found.on_sensor(screen[4]) == pytest.approx(sensor[4] - 9, abs=1e-2)
    assert ScreenMap.of_marks(screen[:5], sensor[:5]) is None


def test_what_is_drawn_for_the_sensor_is_seen_there() -> None:
    sensor, screen = (120, 160), (170, 210)
    picture = random_cells((8, 10), 3)
    drawn = ASKEW.drawn(picture, (19.5, 29.5), 10.0, screen)
    seen = ASKEW.seen(drawn.astype(np.float32) / 255, sensor)
    middles = seen[20:100, 30:130].reshape(8, 10, 10, 10)[:, 3:7, :, 3:7].mean(axis=(1, 3))
    assert middles == pytest.approx(picture / 255.0, abs=0.01)
    assert seen[:15].max() == seen[:, :25].max() == 0
    binned = ASKEW.seen(drawn.astype(np.float32) / 255, sensor, 2)
    assert binned == pytest.approx(seen.reshape(60, 2, 80, 2).mean(axis=(1, 3)), abs=1e-6)


def test_tone_goes_through_what_was_measured_and_must_rise() -> None:
    levels = (32, 96, 160, 255)
    tone = ScreenTone.of(levels, [4 * (n / 255) ** 1.8 for n in levels])
    table = tone.of_picture(np.arange(256, dtype=np.uint8))
    assert table == pytest.approx((np.arange(256) / 255) ** 1.8, abs=2e-3)
    assert tone.gamma == pytest.approx(1.8, abs=1e-6)
    with pytest.raises(ValueError, match="does not rise"):
        ScreenTone.of(levels, [1.0, 2.0, 1.9, 3.0])


def test_bars_tell_which_part_of_a_side_is_seen() -> None:
    assert sum(picture.astype(int) for picture in bars((20, 30), 7, 1)) == pytest.approx(255)
    light = np.array([0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0])
    assert field_along(light, 80) == pytest.approx((25.0, 65.0))
    assert field_along(np.ones(8), 80) == (0.0, 80.0)


def test_pictures_are_as_asked_and_the_same_for_a_seed() -> None:
    drawn = draw_pictures(ASKED, ASKEW, (120, 160), (140, 180))
    assert len(drawn[PICTURE]) == 6
    assert all((white >= picture).all() for white in drawn[TONE][-1:] for picture in drawn[PICTURE])
    again = draw_pictures(ASKED, ASKEW, (120, 160), (140, 180))
    assert np.array_equal(drawn[PICTURE], again[PICTURE])
    other = draw_pictures(replace(ASKED, seed=1), ASKEW, (120, 160), (140, 180))
    assert not np.array_equal(drawn[PICTURE], other[PICTURE])
    assert 0.1 < (random_cells((60, 60), 0) > 0).mean() < 0.3
    assert len(np.unique(dead_leaves((60, 60), 0))) > 100


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"flicker": 0.05}, "5.0% from frame to frame"),
        ({"drift": -0.04}, "changed by 4.0% during the run"),
        ({"wander": 0.03}, "changed by 3.0% during the run"),
        ({"saturated_frames": 2}, "2 frames have saturated pixels"),
        ({"unsteady": ["the picture moved by 2.0 pixels"]}, "the picture moved by 2.0 pixels"),
        ({"left_out": [{"psnr_db": 11.0, "even_db": 10.0}]}, "hardly reconstructed"),
        ({}, None),
    ],
)
def test_what_is_wrong_with_the_light_is_named(changed: dict[str, object], words: str | None) -> None:
    good = {"flicker": 1e-4, "drift": 0.0, "wander": 0.0, "saturated_frames": 0, "unsteady": []}
    said = findings_of({**good, "left_out": [{"psnr_db": 20.0, "even_db": 10.0}], **changed})
    assert len(said) == (words is not None)
    assert words is None or words in said[0]


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (["--pairs", "pairs", "--pictures", "5"], "leave out --pictures"),
        (["--gamma", "2"], "Only with --pairs: --gamma"),
    ],
)
def test_options_of_bench_and_files_do_not_mix(
    typed: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "screen.toml"
    bench.write_text(SMALL)
    assert main(["calibrate", "screen", *typed, *([] if "--pairs" in typed else ["-b", str(bench)])]) != 0
    assert words in capsys.readouterr().err
