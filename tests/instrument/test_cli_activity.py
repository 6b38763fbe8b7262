"""From a video to traces, regions, dF/F, a page and a film; mistakes in words."""

from __future__ import annotations

import csv
import errno
import json
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr

from instrument.cli import main
from instrument.files.errors import BenchError
from instrument.reconstruction.activity import COPIES, ActivitySettings, find_activity
from instrument.reconstruction.video_files import VideoPictures, create_output
from recon.camera.grid import Grid

COUNT, SHAPE, MISSING = 120, (32, 40), 7


def course() -> np.ndarray:
    spikes = np.zeros(COUNT)
    spikes[[20, 55, 90]] = 1
    return np.convolve(spikes, np.exp(-np.arange(40) / 8))[:COUNT]


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "film.ome.zarr"
    grid = Grid((1, *SHAPE), (SHAPE[0] // 2, SHAPE[1] // 2), np.array([1e4]), np.array([3.0]))
    create_output(path, COUNT, SHAPE, period_s=0.1, grid=grid, attributes={"simulated": True})
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = np.exp(-((y - 12) ** 2 + (x - 25) ** 2) / 8)
    rng = np.random.default_rng(0)
    pictures = VideoPictures(path, write=True)
    for index, active in enumerate(course()):
        if index != MISSING:
            noise = 0.02 * rng.standard_normal(SHAPE)
            pictures.write(index, (0.4 + spot * (1 + active) + noise).astype(np.float32))
    return path


def test_a_full_disk_is_told_with_what_could_not_be_written(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")  # zarr's names no file

    out = tmp_path / "found"
    with monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "__setitem__", full)
        assert main(["activity", str(film), "--out", str(out)]) == 2
    told = "".join(capsys.readouterr().err.split("\n"))
    assert f"{out / 'dff.ome.zarr'}: no space left on the disk. Free some" in told
    assert main(["activity", str(film), "--out", str(out)]) == 0, "the same command works once there is room"


def test_the_command_writes_what_it_found(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found"
    assert main(["activity", str(film), "--out", str(out), "--window", "6"]) == 0
    assert "Regions     1" in capsys.readouterr().out
    with (out / "traces.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [t for t in range(COUNT) if t != MISSING]
    assert float(rows[10]["time_s"]) == pytest.approx(1.1)
    trace = np.array([float(row["region_0_dff"]) for row in rows])
    assert np.corrcoef(trace, np.delete(course(), MISSING))[0, 1] > 0.98
    (region,) = csv.DictReader((out / "regions.csv").read_text().splitlines())
    assert (float(region["row"]), float(region["column"])) == pytest.approx((12, 25), abs=0.5)
    dff = VideoPictures(out / "dff.ome.zarr")
    scale = dff.attributes["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"][0]["scale"]
    assert scale == [0.1, 3.0, 3.0]  # as its film
    assert np.isnan(dff.read(MISSING)).all()
    assert dff.read(20)[12, 25] > 0.4
    assert cv2.imread(str(out / "activity.png")).shape[1] > 1000
    shown = cv2.VideoCapture(str(out / "activity.mp4"))
    frames = [shown.read()[1] for _ in range(COUNT - 1)]
    active, calm = (frames[t][12, 25].astype(int) for t in (20, 15))
    assert active[2] - active[0] > calm[2] - calm[0] + 60  # red over grey (OpenCV: blue, green, red)
    record = json.loads((out / "activity.json").read_text())
    assert record["regions"] == 1
    assert record["simulated"]


@pytest.mark.parametrize(("warm", "warned"), [(4, True), (6, False)])
def test_a_video_of_few_warm_iterations_is_warned_of(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], warm: int, warned: bool
) -> None:
    group = zarr.open_group(film, mode="r+")
    group.attrs["diffuserbench"] = {"simulated": True, "warm_iterations": warm}
    assert main(["activity", str(film), "--out", str(tmp_path / "found"), "--window", "6"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert ("with 6 or more ('reconstruct --video --warm')" in told) == warned


def test_results_are_not_replaced_and_mistakes_are_said(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "activity.json").write_text("{}")
    for arguments, says in (
        ([str(film), "--out", str(tmp_path / "full")], "holds results"),
        ([str(tmp_path / "none.ome.zarr")], "does not exist"),
        ([str(tmp_path / "full")], "neither"),
        ([str(film), "--psf", str(film)], "for recordings"),
    ):
        assert main(["activity", *arguments]) == 2
        assert says in capsys.readouterr().err.replace("\n", " ")


def static_point(path: Path, frames: int) -> Path:
    """A point on black that does not change: noise on it, zeros nearly everywhere else."""
    create_output(path, frames, SHAPE, period_s=None, grid=None, attributes={})
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = 1000 * np.exp(-((y - 12) ** 2 + (x - 20) ** 2) / 2)
    rng, pictures = np.random.default_rng(0), VideoPictures(path, write=True)
    for index in range(frames):
        pictures.write(index, np.maximum(spot + 5 * rng.standard_normal(SHAPE) - 10, 0).astype(np.float32))
    return path


def test_a_recording_too_short_to_tell_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = static_point(tmp_path / "six.ome.zarr", 6)
    assert main(["activity", str(film), "--out", str(tmp_path / "found")]) == 2
    assert "6 pictures; activity" in capsys.readouterr().err.replace("\n", " ")


def test_a_recording_too_short_is_refused_before_it_is_reconstructed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = Path(__file__).parents[1] / "fixtures" / "v813d646" / "recording"
    words = ["activity", str(recording), "--psf", str(tmp_path / "psf.tif"), "--out", str(tmp_path / "found")]
    assert main(words) == 2  # nobody has looked for the PSF
    assert "pictures; activity" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "found").exists()


def test_what_is_dark_has_no_baseline_to_be_divided_by(tmp_path: Path) -> None:
    film = static_point(tmp_path / "static.ome.zarr", 60)
    found = find_activity(VideoPictures(film), ActivitySettings(least_correlation=0.0))
    assert np.abs(found.dff).max() < 1
    assert np.abs(found.traces).max(initial=0) < 1
    assert not find_activity(VideoPictures(film)).regions


def test_too_large_for_the_memory_is_refused(film: Path) -> None:
    with pytest.raises(BenchError, match="GiB of memory"):
        find_activity(VideoPictures(film), ActivitySettings(), free_bytes=1000)


def test_alignment_is_offered_where_frames_move(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "moving.ome.zarr"
    create_output(path, 40, SHAPE, period_s=None, grid=None, attributes={})
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    pictures = VideoPictures(path, write=True)
    for index in range(40):
        spot = np.exp(-((y - 12 - 0.1 * index) ** 2 + (x - 20) ** 2) / 20)
        pictures.write(index, (0.2 + spot).astype(np.float32))
    assert main(["activity", str(path), "--out", str(tmp_path / "found")]) == 0
    assert "--align" in capsys.readouterr().err


@pytest.mark.parametrize("align", [False, True])
def test_memory_is_not_more_than_is_said_before(film: Path, tmp_path: Path, align: bool) -> None:
    settings = ActivitySettings(align=align)
    find_activity(VideoPictures(film), settings)  # what is imported and compiled is not the video's
    path, shape, count = tmp_path / "larger.ome.zarr", (80, 96), 60
    create_output(path, count, shape, period_s=None, grid=None, attributes={})
    video = VideoPictures(path, write=True)
    rng = np.random.default_rng(0)
    for index in range(count):
        video.write(index, (100 + rng.standard_normal(shape)).astype(np.float32))
    peaks = []
    for _ in range(2):  # what threads of other tests take meanwhile is not the video's
        tracemalloc.start()
        try:
            find_activity(video, settings)
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert min(peaks) < COPIES * count * shape[0] * shape[1] * 4
