"""A recording becomes a video: every frame once, the same whoever computes it, whatever is killed."""

from __future__ import annotations

import json
import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from ome_zarr_models.v05 import Image

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError, FileError
from instrument.files.films import as_shown
from instrument.plan import Part, Plan
from instrument.reconstruction import video_work as block_module
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.video import (
    PreparedVideo,
    VideoRequest,
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_files import VideoPictures, levels_of, require_video
from instrument.reconstruction.video_job import VideoJob
from instrument.reconstruction.video_work import BlockReport
from instrument.runs.run import Run
from instrument.tasks.video import choice_in_words
from recon import reconstruct
from recon.base.metrics import psnr
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.reconstruction.options import ReconstructionOptions
from recon.streams.stillness import has_light
from recon.streams.video import VideoSolver
from recon.types import Calibration
from tests.instrument.video.recorded import (
    MISSING,
    SHAPE,
    assert_same,
    cast,
    pictures,
    request,
    scene,
    solved,
)
from tests.mocks.recordings import write_recording


def test_every_frame_is_there_and_like_its_own_reconstruction(recording: Path, video: Path) -> None:
    stack = pictures(video)
    assert stack.shape == (11, *SHAPE)
    assert [t for t in range(11) if np.isnan(stack[t]).any()] == [MISSING]
    for t in (0, 3, 10):  # cold, warm, and the last of a block
        alone = reconstruct(
            scene(t), np.load(recording.parent / "psf.npy"), solver="admm-sensor", background=20.0,
            iterations=200, tolerance=0,
        ).image  # fmt: skip
        assert psnr(stack[t], alone) > 30


def test_others_read_it_with_its_times_and_it_plays(video: Path) -> None:
    group = zarr.open_group(video / "v.ome.zarr", mode="r")
    scale = Image.from_zarr(group).ome_attributes.multiscales[0].datasets[0].coordinateTransformations[0]
    assert scale.scale == pytest.approx([0.04, 1, 1])
    assert group.attrs["diffuserbench"]["missing"] == [MISSING]
    film = cv2.VideoCapture(str(video / "v.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(25)
    stack, shown = pictures(video), []
    while True:
        there, frame = film.read()
        if not there:
            break
        shown.append(frame[..., 0].astype(float))
    assert len(shown) == 10
    indices = [t for t in range(11) if t != MISSING]
    black, white = levels_of(stack[t] for t in indices)
    for index, picture in zip(indices, shown, strict=True):
        meant = as_shown(stack[index], black, white)[..., 0].astype(float)
        assert np.corrcoef(picture.ravel(), meant.ravel())[0, 1] > 0.95
    record = json.loads((video / "v.json").read_text())
    assert (record["frames"], record["prior"], record["simulated"]) == (10, "tv", True)
    assert not list(video.glob(".v.job"))


def test_a_video_cut_off_goes_on_and_ends_the_same(
    recording: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = request(recording, tmp_path)
    prepared = prepare_video(wanted)
    cancel = threading.Event()
    monkeypatch.setattr("instrument.reconstruction.video_work.get_threads", lambda: 1)
    assert not solve_video(prepared, lambda _: cancel.set(), cancel)
    first = {0, 1, 2, 3}
    written = {t for t in range(11) if VideoPictures(wanted.out).is_written(t)}
    assert first <= written < set(range(11)) - {MISSING}
    stamps = {t: VideoPictures(wanted.out)._file(t).stat().st_mtime_ns for t in written}
    again = prepare_video(wanted)
    assert again.resumed
    assert 0 not in again.left
    reports: list[BlockReport] = []
    assert solve_video(again, reports.append, threading.Event())
    assert sum(report.written for report in reports) == 10 - len(written)
    assert {t: VideoPictures(wanted.out)._file(t).stat().st_mtime_ns for t in written} == stamps
    assert_same(pictures(tmp_path), pictures(video))


def test_a_kill_between_pictures_and_mark_loses_nothing(
    recording: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class KilledError(BaseException):
        pass

    def die(*_: object) -> None:
        raise KilledError

    wanted = request(recording, tmp_path)
    prepared = prepare_video(wanted)
    with monkeypatch.context() as patch:
        patch.setattr("instrument.reconstruction.video_job.VideoJob.mark_done", die)
        with pytest.raises(KilledError):
            block_module.solve_block(str(prepared.job.folder), str(wanted.out), 1)
    frame = next(path for path in (wanted.out / "0/c").rglob("0") if path.is_file())
    begun = frame.with_name("0.1234.partial")  # as zarr leaves it when it is killed within a picture
    begun.touch()
    reports = solved(wanted)
    assert sorted((r.block, r.solved, r.written) for r in reports) == [(0, 4, 4), (1, 3, 0), (2, 3, 3)]
    assert_same(pictures(tmp_path), pictures(video))
    assert not begun.exists()


def test_a_damaged_frame_is_named_in_a_sentence(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "recording"
    shutil.copytree(recording, run)
    chunk = run / "frames.ome.zarr" / "0" / "c" / "6" / "0" / "0"
    os.truncate(chunk, 1000)
    psf, out = str(recording.parent / "psf.npy"), str(tmp_path / "v.ome.zarr")
    given = ["--psf", psf, "--dark", "20", "--bin", "1", "--iterations", "2", "--block", "4", "--out", out]
    assert main(["reconstruct", str(run), "--video", *given]) == 2
    said = capsys.readouterr().err
    assert "has 1000 bytes; frame 6 takes 4160: it is damaged" in said
    assert "Traceback" not in said


def test_the_run_of_a_plan_is_no_video_unless_its_frames_are_alike(recording: Path, tmp_path: Path) -> None:
    frames = {t: scene(t) for t in range(4)}
    plan = Plan(label="lapse", parts=(Part(label="a", repeats=4, interval_s=1.0),))
    lit = {t: "off" if t < 2 else "source" for t in range(4)}
    (tmp_path / "different").mkdir()
    different = write_recording(tmp_path / "different", frames, plan=plan, led=lit)
    (tmp_path / "out").mkdir()
    with pytest.raises(FileError, match=r"no video: its frames differ in light.*diffuserbench record"):
        prepare_video(request(recording, tmp_path / "out", run=different))
    assert not list((tmp_path / "out").iterdir())
    (tmp_path / "alike").mkdir()
    alike = write_recording(tmp_path / "alike", frames, plan=plan)
    assert prepare_video(request(recording, tmp_path / "out", run=alike)).left == [0]
    (alike / "calibration").mkdir()
    (alike / "calibration" / "calibration.json").write_text("{}")
    with pytest.raises(FileError, match=r"holds a calibration.*were the two swapped"):
        prepare_video(request(recording, tmp_path / "other", run=alike, out=tmp_path / "w.ome.zarr"))


@pytest.mark.parametrize(
    ("positions", "stands"),
    [
        ([{"x_um": 5.049}, {"x_um": 5.051}, {"x_um": 5.3}], True),
        ([{"x_um": 5.0}, {"x_um": 5.4}, {"x_um": 5.8}], False),  # each near the next: it drifts
        ([{"x_um": -0.04, "roll_mrad": 0.049}, {"x_um": 0.04, "roll_mrad": 0.051}], True),
        ([{"x_um": 0.0, "roll_mrad": 0.01}, {"x_um": 0.0, "roll_mrad": 0.04}], False),
        ([{"x_um": 0.0}, {"x_um": 0.0, "z_um": 0.0}], False),
        ([{"x_um": float("nan")}, {"x_um": 0.0}], False),
        ([{"x_um": 0.0}, {"x_um": float("nan")}], False),
    ],
)
def test_a_stage_stands_as_far_as_its_readings_tell(
    tmp_path: Path, positions: list[dict[str, float]], stands: bool
) -> None:
    plan = Plan(label="lapse", parts=(Part(label="a", repeats=len(positions), interval_s=1.0),))
    frames = {t: np.ones(SHAPE, np.uint16) for t in range(len(positions))}
    run = Run(write_recording(tmp_path, frames, plan=plan, stage=dict(enumerate(positions))))
    if stands:
        require_video(run)
        return
    with pytest.raises(FileError, match="its frames differ in stage position"):
        require_video(run)


def test_frames_without_light_are_told(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    dark = {t: np.clip(rng.normal(20, 2, SHAPE), 0, 4095).round().astype(np.uint16) for t in range(8)}
    (tmp_path / "runs").mkdir()
    run = write_recording(
        tmp_path / "runs", {**{t: scene(t) for t in range(5)}, **{t: dark[t] for t in (5, 6)}}
    )
    psf = str(recording.parent / "psf.npy")
    out = tmp_path / "v.ome.zarr"
    arguments = ["reconstruct", str(run), "--video", "--psf", psf, "--out", str(out), "--dark", "20"]
    assert main([*arguments, "--iterations", "2", "--warm", "1", "--block", "4", "--no-mp4"]) == 0
    assert "2 of 7 frames hold nothing but noise" in capsys.readouterr().err
    assert json.loads((tmp_path / "v.json").read_text())["frames_unlit"] == 2
    (tmp_path / "unlit").mkdir()
    unlit = write_recording(tmp_path / "unlit", dark)
    prepared = prepare_video(request(recording, tmp_path, run=unlit, out=tmp_path / "u.ome.zarr"))
    assert any("first frame holds nothing but noise" in warning for warning in prepared.warnings)


@pytest.mark.parametrize("photons", [3, 30, 3000])
def test_light_is_told_from_noise_however_faint(photons: float) -> None:
    rng = np.random.default_rng(1)
    light = cast([(0, 0, 1.0), (5, -8, 0.7)])
    light *= photons / light.max()
    deviation = np.array([np.sqrt(light.mean() + 1)])
    assert has_light(rng.poisson(light) + rng.normal(0, 1, SHAPE), deviation)
    assert not has_light(rng.normal(0, deviation[0], (24, 24)), deviation), "few blocks still tell"
    assert not has_light(rng.normal(0, deviation[0], SHAPE), deviation)


def test_a_dim_frame_after_a_bright_one_has_light() -> None:
    rng = np.random.default_rng(2)
    light = cast([(0, 0, 1.0), (5, -8, 0.7)])
    light /= light.max()

    def photographed(photons: float) -> np.ndarray:
        return rng.poisson(photons * light) + rng.normal(0, 2, SHAPE)

    # The noise of a first frame with 500 times the light.
    deviation = np.array([np.sqrt(10_000 * light.mean() + 4)])
    assert has_light(photographed(20), deviation)
    assert not has_light(photographed(0), deviation)
    assert has_light(photographed(20) / 4095, deviation / 4095), "of frames whose white is 1, too"
    two = np.stack([photographed(0), photographed(20)], axis=2)
    assert has_light(two, deviation.repeat(2))
    told = [has_light(np.round(photographed(0)), deviation) for _ in range(50)]
    assert sum(told) <= 2


@pytest.mark.parametrize("over_time", ["tv", "lowrank"])
def test_with_a_prior_over_time(recording: Path, video: Path, tmp_path: Path, over_time: str) -> None:
    solved(request(recording, tmp_path, over_time=over_time, film=False))
    stack, alone = pictures(tmp_path), pictures(video)
    there = [t for t in range(11) if t != MISSING]
    assert np.isnan(stack[MISSING]).all()
    assert 15 < psnr(stack[there], alone[there]) < 60  # like, but not the same


def test_turned_cropped_binned(recording: Path, tmp_path: Path) -> None:
    how = {"inputs": InputOptions(dark=20.0, binning=2), "options": ReconstructionOptions(iterations=3)}
    solved(request(recording, tmp_path, rotate_deg=90, film=False, warm_iterations=1, **how))
    assert pictures(tmp_path).shape == (11, 26, 20)
    assert not (tmp_path / "v.mp4").exists()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"options": ReconstructionOptions(tolerance=1e-3)}, "--warm"),
        ({"options": ReconstructionOptions(model="local")}, "several places of the field"),
        ({"out": Path("v.tif")}, "OME-Zarr"),
        ({"out": Path("/nowhere/v.ome.zarr")}, "does not exist"),
        ({"run": Path("/nowhere")}, "no such folder"),
        ({"run": Path(__file__)}, "is a file: --video takes the folder of a recording"),
        ({"run": Path(__file__).parent}, "no run was written to"),
        ({"psf": None}, "--psf"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_made(
    recording: Path, tmp_path: Path, changes: dict[str, object], says: str
) -> None:
    with pytest.raises((BenchError, InputError), match=says):
        prepare_video(request(recording, tmp_path, **changes))
    assert not list(tmp_path.iterdir())


def test_the_command(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "film.ome.zarr"
    psf = recording.parent / "psf.npy"
    arguments = ["reconstruct", str(recording), "--video", "--psf", str(psf), "--out", str(out)]
    options = ["--dark", "20", "--bin", "2", "--iterations", "4", "--warm", "1", "--block", "4"]
    assert main([*arguments, *options]) == 0
    text = capsys.readouterr().out
    assert "10 frames in 3 blocks of 4" in text
    assert "frames/s" in text
    assert {p.name for p in tmp_path.iterdir()} == {"film.ome.zarr", "film.mp4", "film.json"}
    assert main([*arguments, *options]) == 2
    assert main(["reconstruct", "--image", str(psf), "--psf", str(psf), "--warm", "3"]) == 2
    assert "--video" in capsys.readouterr().err
    assert main(["reconstruct", "--video"]) == 2


def test_a_calibration_of_another_camera_is_said(recording: Path, tmp_path: Path) -> None:
    right = prepare_video(request(recording, tmp_path))
    assert not any("calibration" in text for text in right.warnings)
    other = tmp_path / "other.npy"
    np.save(other, np.eye(8, dtype=np.float32))
    with pytest.raises(FileError, match=r"the image [^/]*recording frame 0 is 40 x 52"):
        prepare_video(replace(request(recording, tmp_path, psf=other), out=tmp_path / "o.ome.zarr"))
    np.save(other, np.load(recording.parent / "psf.npy")[::-1, ::-1])
    wrong = replace(request(recording, tmp_path, psf=other), out=tmp_path / "o.ome.zarr")
    prepared = prepare_video(wrong)
    (doubt,) = (text for text in prepared.warnings if "calibration" in text)
    assert doubt[0].isupper()
    assert solve_video(prepared, lambda _: None, threading.Event())
    finish_video(prepared)
    assert doubt in json.loads((tmp_path / "o.json").read_text())["warnings"]


def test_settings_that_change_within_a_recording_are_told(tmp_path: Path) -> None:
    np.save(tmp_path / "psf.npy", cast([(0, 0, 100.0)]).astype(np.float32))
    lit = {number: "off" if number < 3 else "disk" for number in range(6)}
    run = write_recording(tmp_path, {t: scene(t) for t in range(6)}, led=lit)
    told = " ".join(prepare_video(request(run, tmp_path)).warnings)
    assert "frames differ in light: what gets brighter or dimmer with it is not the scene's doing" in told


def test_prepared_is_what_the_window_shows(recording: Path, tmp_path: Path) -> None:
    prepared = prepare_video(request(recording, tmp_path))
    assert isinstance(prepared, PreparedVideo)
    assert prepared.left == [0, 1, 2]
    assert any("1 of 11 frames were lost" in warning for warning in prepared.warnings)
    assert prepared.notes["Dark"].startswith("20 counts")
    assert choice_in_words(prepared, 5.0, 1.0) == "", "one PSF: nothing was chosen"


@pytest.mark.parametrize("times", [1, 2])
def test_a_film_tells_what_was_binned_to_the_calibrations_pixels(tmp_path: Path, times: int) -> None:
    calibration = Calibration(cast([(0, 0, 1.0)])[None, None].astype(np.float32), np.full((1, 3), np.nan))
    save_calibration(calibration, tmp_path / "calibration")
    frames = {t: np.kron(scene(t), np.ones((times, times), np.uint16)) for t in range(2)}
    wanted = VideoRequest(
        run=write_recording(tmp_path, frames),
        out=tmp_path / "v.ome.zarr",
        calibration=tmp_path / "calibration",
        inputs=InputOptions(dark=20.0, binning=1),
        video=VideoOptions(film=False),
    )
    said = prepare_video(wanted).notes["Image"]
    assert said.endswith("2 frames, binned 2 x 2 to the calibration" if times == 2 else "2 frames")


def test_auto_takes_the_model_that_the_film_asks_for_and_depths_become_volumes(tmp_path: Path) -> None:
    """Whoever makes the job again has the same model and the same part of the field; volumes are stored."""
    seen = make_scene("beads", size=48, grid=3, depths=2, aberration=4.0, photons=2e4, density=0.4)
    calibration = tmp_path / "calibration"
    save_calibration(seen.calibration, calibration)
    top = float(np.max(seen.measurement))
    counts = np.clip(3000 * seen.measurement / top + 20, 0, 4095).astype(np.uint16)
    run = write_recording(tmp_path, dict.fromkeys(range(4), counts))
    wanted = VideoRequest(
        run=run,
        out=tmp_path / "v.ome.zarr",
        calibration=calibration,
        inputs=InputOptions(dark=20.0, binning=1),
        options=ReconstructionOptions(iterations=6, prior="l1"),
        video=VideoOptions(warm_iterations=1, film=False),
        rotate_deg=90,
    )
    prepared = prepare_video(wanted)
    assert prepared.notes["Model"].startswith(("local: by the mean of 4 frames", "lowrank: by the mean of 4"))
    model = prepared.notes["Model"].partition(":")[0]
    paid = choice_in_words(prepared, 2.0, 18.0)
    assert "took 2.0 s, 10% of it all" in paid
    assert f"--model {model} leaves it out" in paid
    assert choice_in_words(prepared, 2.0, 60.0) == "", "a long film pays next to nothing"
    again = VideoJob(prepared.job.folder).problem
    assert again.extent.psf_window is not None
    assert ("where PSFs were measured" in prepared.notes["Model"]) == (again.extent.margin is not None)
    assert solve_video(prepared, lambda _: None, threading.Event())
    finish_video(prepared)
    video = VideoPictures(wanted.out)
    assert video.axes == "tzyx"
    assert video.read(3).shape == (2, 48, 48)
    top, left, bottom, right = video.calibrated_px  # turned by 90 degrees, as the pictures
    grid, places = again.grid, again.calibration.source_positions_um
    marked = np.zeros((48, 48))
    for x, y, z in places:
        row, column = grid.pixel_of(int(np.abs(grid.z_um - z).argmin()), x, y)
        assert grid.place_um(0, *grid.pixel_of(0, x, y))[:2] == pytest.approx((x, y))
        if 0 <= round(row) < 48 and 0 <= round(column) < 48:
            marked[round(row), round(column)] = 1
    rows, columns = np.nonzero(np.rot90(marked))
    assert (top, left) == pytest.approx((rows.min(), columns.min()), abs=0.51)
    assert (bottom, right) == pytest.approx((rows.max(), columns.max()), abs=0.51)
    np.testing.assert_array_equal(video.flat(3), video.read(3).sum(axis=0))
    upright = np.rot90(video.read(0), -1, (1, 2))
    direct = VideoSolver(again, cold_iterations=6).next(counts.astype(np.float32) - 20)
    np.testing.assert_allclose(upright, direct, rtol=0, atol=1e-4 * direct.max())
    Image.from_zarr(zarr.open_group(wanted.out, mode="r"))
