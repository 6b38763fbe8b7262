"""What a video replaces, keeps and goes on with."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from instrument.cli import main
from instrument.cli.app import Terminated
from instrument.files.errors import FileError
from instrument.reconstruction import video_work as block_module
from instrument.reconstruction.video import (
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_files import VideoPictures
from instrument.runs.acquire import settle
from tests.instrument.video.recorded import MISSING, assert_same, pictures, request


def test_a_video_goes_on_without_a_frame_that_was_lost_meanwhile(
    recording: Path, video: Path, tmp_path: Path
) -> None:
    """Its block begins anew, as its pictures hang together; blocks that are done stay."""
    run = tmp_path / "recording"
    shutil.copytree(recording, run)
    shutil.copy(recording.parent / "psf.npy", tmp_path)
    wanted = request(run, tmp_path)
    prepared = prepare_video(wanted)
    for block in (0, 1):
        block_module.solve_block(str(prepared.job.folder), str(wanted.out), block)
    stamps = [VideoPictures(wanted.out)._file(t).stat().st_mtime_ns for t in range(4)]
    os.truncate(run / "frames.ome.zarr/0/c/6/0/0", 1000)
    assert "marked as lost: frame 6" in "\n".join(settle(run))
    with pytest.raises(FileError, match=r"frames, warm_iterations"):
        prepare_video(request(run, tmp_path, warm_iterations=7))
    again = prepare_video(wanted)
    assert (again.resumed, again.left) == (True, [1, 2])
    assert not VideoPictures(wanted.out).is_written(6)
    plan = again.job.plan
    assert again.job.goes_on_without(replace(plan, frames=plan.frames[1:])) == [0]
    assert again.job.goes_on_without(replace(plan, frames=plan.frames[4:])) is None, (
        "blocks have other numbers"
    )
    assert solve_video(again, lambda _: None, threading.Event())
    assert [VideoPictures(wanted.out)._file(t).stat().st_mtime_ns for t in range(4)] == stamps
    whole, found = pictures(video), pictures(tmp_path)
    assert np.isnan(found[6]).all()
    left = [t for t in range(11) if t not in (MISSING, *range(4, 8))]
    assert_same(found[left], whole[left])


def test_other_settings_do_not_go_on_and_finished_videos_stay(
    recording: Path, video: Path, tmp_path: Path
) -> None:
    prepare_video(request(recording, tmp_path))
    with pytest.raises(FileError, match=r"other settings or frames \(warm_iterations\)"):
        prepare_video(request(recording, tmp_path, warm_iterations=7))
    assert not prepare_video(request(recording, tmp_path, warm_iterations=7), force=True).resumed
    with pytest.raises(FileError, match="exists"):
        prepare_video(request(recording, video))


@pytest.mark.parametrize("name", ["v.mp4", "v.json"])
def test_files_beside_a_new_video_stay(recording: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileError, match=f"{name}: exists"):
        prepare_video(request(recording, tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"
    assert not prepare_video(request(recording, tmp_path), force=True).resumed


def test_force_never_replaces_what_is_read(recording: Path, tmp_path: Path) -> None:
    frames = recording / "frames.ome.zarr"
    before = sorted(frames.rglob("*"))
    with pytest.raises(FileError, match="it is read"):
        prepare_video(request(recording, tmp_path, out=frames), force=True)
    assert sorted(frames.rglob("*")) == before
    assert not prepare_video(request(recording, recording), force=True).resumed
    assert prepare_video(request(recording, recording)).resumed


def test_a_film_that_is_not_written_may_be_there(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_text("mine")
    prepared = prepare_video(request(recording, tmp_path, film=False))
    prepared.request.film_path.unlink()
    prepared.request.record_path.write_text("{}")  # as when finishing was cut off
    assert prepare_video(request(recording, tmp_path, film=False)).resumed


def test_force_begins_anew_whatever_there_is(recording: Path, tmp_path: Path) -> None:
    wanted = request(recording, tmp_path)
    job = prepare_video(wanted).job
    job.mark_done(0)
    anew = prepare_video(wanted, force=True)
    assert (anew.resumed, anew.left) == (False, [0, 1, 2])
    (job.folder / "job.json").write_text("{")
    with pytest.raises(FileError, match="--force"):
        prepare_video(wanted)
    assert not prepare_video(wanted, force=True).resumed


def test_another_noise_or_a_changed_calibration_file_is_another_video(
    recording: Path, tmp_path: Path
) -> None:
    psf = tmp_path / "psf.npy"
    lens = np.load(recording.parent / "psf.npy")
    np.save(psf, lens)
    wanted = request(recording, tmp_path, psf=psf)
    prepare_video(wanted)
    noisier = replace(wanted, inputs=replace(wanted.inputs, noise=9.0))
    with pytest.raises(FileError, match="noise_deviation"):
        prepare_video(noisier)
    assert prepare_video(noisier, force=True).job.plan.settings["noise_deviation"] == [9.0]
    lens[20, 26] += 100
    np.save(psf, lens)
    with pytest.raises(FileError, match="optics_sha256"):
        prepare_video(noisier)


def test_a_full_disk_is_said_with_what_is_kept_and_the_video_goes_on(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    psf, out = str(recording.parent / "psf.npy"), str(tmp_path / "v.ome.zarr")
    given = ["--psf", psf, "--dark", "20", "--bin", "2", "--iterations", "2", "--block", "4", "--out", out]
    write = VideoPictures.write

    def until_full(self: VideoPictures, index: int, picture: np.ndarray) -> None:
        if index > 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, index, picture)

    monkeypatch.setattr("instrument.reconstruction.video_work.get_threads", lambda: 1)
    with monkeypatch.context() as patch:
        patch.setattr(VideoPictures, "write", until_full)
        assert main(["reconstruct", str(recording), "--video", *given]) == 2
    said = capsys.readouterr().err
    assert "no space left" in said
    assert f"4 of 10 frames are in {out}: the same command goes on" in said
    assert main(["reconstruct", str(recording), "--video", *given]) == 0
    assert "4 frames are done already" in capsys.readouterr().out


def test_a_signal_that_ends_it_is_said_with_what_is_kept(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(*_: object) -> bool:
        raise Terminated(143)

    monkeypatch.setattr("instrument.tasks.video.solve_video", ended)
    psf, out = str(recording.parent / "psf.npy"), str(tmp_path / "v.ome.zarr")
    given = ["--psf", psf, "--dark", "20", "--bin", "2", "--out", out]
    assert main(["reconstruct", str(recording), "--video", *given]) == 143
    said = capsys.readouterr().err
    assert f"0 of 10 frames are in {out}: the same command goes on" in said


@pytest.mark.parametrize("what", ["numpy.savez", "zarr.Group.create_array"])
def test_a_disk_that_is_full_at_the_beginning_leaves_nothing_in_the_way(
    what: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    wanted = request(recording, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(what, full)
        with pytest.raises(OSError, match="No space left"):
            prepare_video(wanted)
    assert not wanted.out.exists()
    assert not prepare_video(wanted).resumed
    assert {path.name for path in tmp_path.iterdir()} == {"v.ome.zarr", ".v.job"}
