"""Exported frames are the run's frames, read back with others' tools."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
import zarr
from ome_zarr_models.v05 import Image

from drivers.frame import FrameMetadata
from instrument.cli import main
from instrument.files.errors import FileError
from instrument.plan import Part, Plan
from instrument.runs.export import export
from instrument.runs.inspection import verify
from instrument.runs.log import Gap
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import RunError
from instrument.runs.writer import BenchRecord, FrameToStore, RunWriter

METADATA = FrameMetadata(
    frame_id=0,
    device_time_ns=None,
    host_time_ns=0,
    utc=datetime(2026, 1, 1, tzinfo=UTC),
    exposure_ms=10.0,
    gain=1.0,
    pixel_format="Mono12",
    significant_bits=12,
    black_level=0.0,
    roi=(0, 0, 32, 48),
    binning=1,
)
BENCH = BenchRecord({}, "", {"camera": "mock"}, True, 6.5, {"exposure_ms": 1.0, "gain": 1.0}, {})
STORED = [0, 1, 2, 4, 5]


def image(index: int, colour: bool) -> np.ndarray:
    shape = (32, 48, 3) if colour else (32, 48)
    return np.random.default_rng(index).integers(0, 4096, shape).astype(np.uint16)


@pytest.fixture(params=[False, True], ids=["grey", "colour"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Run:
    return a_recording(tmp_path, colour=request.param)


def a_recording(folder: Path, *, colour: bool) -> Run:
    """Six frames at 20 frames/s, of which the fourth was lost."""
    with RunWriter.create(folder, label="video", bench=BENCH) as writer:
        for i in STORED:
            stamp = replace(
                METADATA,
                frame_id=i,
                host_time_ns=7_000_000_000 + i * 50_000_000,
                utc=METADATA.utc + timedelta(seconds=i / 20),
            )
            if i == 4:
                writer.gap(Gap(3, 1, 0))
            writer.write([FrameToStore(i, image(i, colour), stamp)])
        return writer.finish(FinishReason.COMPLETED)


def frames_of(run: Run) -> np.ndarray:
    return np.stack([run.frame(i) for i in STORED])


def test_the_run_is_as_made(run: Run) -> None:
    assert np.array_equal(frames_of(run), [image(i, run.array.is_colour) for i in STORED])


@pytest.mark.parametrize("name", ["a.tif", "a.ome.tif", "a.TIFF"])
def test_tiff(run: Run, tmp_path: Path, name: str) -> None:
    assert export(run, tmp_path / name) == STORED
    assert np.array_equal(tifffile.imread(tmp_path / name), frames_of(run))
    with tifffile.TiffFile(tmp_path / name) as tiff:
        assert tiff.is_ome == (".ome" in name)
        assert not tiff.is_bigtiff, "which fewer programs read"
        if tiff.is_ome:
            assert 'PhysicalSizeX="6.5"' in tiff.ome_metadata
            assert 'TimeIncrement="0.05"' in tiff.ome_metadata
            assert 'DeltaT="0.2"' in tiff.ome_metadata
            assert 'SignificantBits="12"' in tiff.ome_metadata
        else:
            assert json.loads(tiff.shaped_metadata[0]["frames"]) == STORED


def test_ome_tiff_tells_when_and_where_each_frame_was_taken(tmp_path: Path) -> None:
    ome_types = pytest.importorskip("ome_types")
    plan = Plan(label="axial", parts=(Part(label="a", repeats=3),))
    with RunWriter.create(tmp_path, label="axial", bench=BENCH, plan=plan) as writer:
        for i in range(3):
            place = {"x_um": 5.0, "y_um": -2.0, "z_um": 1000.0 + 250 * i}
            stamp = replace(METADATA, host_time_ns=i * 10**9, black_level=64.0, stage_position=place)
            stamp = replace(stamp, led_pattern=f"level {i}")
            writer.write([FrameToStore(i, image(i, False), stamp)])
        run = writer.finish(FinishReason.COMPLETED)
    export(run, tmp_path / "a.ome.tif")
    picture = ome_types.from_tiff(tmp_path / "a.ome.tif")
    pixels = picture.images[0].pixels
    assert (pixels.size_z, pixels.size_t) == (3, 1)
    assert (pixels.physical_size_z, pixels.significant_bits) == (250.0, 12)
    assert [plane.position_z for plane in pixels.planes] == [1000.0, 1250.0, 1500.0]
    assert [(plane.position_x, plane.exposure_time, plane.delta_t) for plane in pixels.planes] == [
        (5.0, 0.01, 0.0), (5.0, 0.01, 1.0), (5.0, 0.01, 2.0)]  # fmt: skip
    assert picture.images[0].acquisition_date == datetime(2026, 1, 1)
    told = dict(picture.structured_annotations[0].value)
    assert (told["black_level"], told["pixel_format"], told["simulated"]) == ("64.0", "Mono12", "true")
    assert told["led_pattern"] == "level 0; level 1; level 2"
    np.testing.assert_array_equal(
        tifffile.imread(tmp_path / "a.ome.tif"), [image(i, False) for i in range(3)]
    )
    export(run, tmp_path / "a.mp4")
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10, rel=0.02), "a plan's frames have no rate"
    video.release()
    # The frames' own OME-Zarr says the same.
    group = zarr.open_group(run.path / "frames.ome.zarr", mode="r")
    multiscale = Image.from_zarr(group).ome_attributes.multiscales[0]
    assert (multiscale.axes[0].name, multiscale.axes[0].unit) == ("z", "micrometer")
    scale, shift = multiscale.datasets[0].coordinateTransformations
    assert (scale.scale[0], shift.translation[0]) == (250.0, 1000.0)
    assert group.attrs["ome"]["omero"]["channels"][0]["window"]["max"] == 4095
    facts = group.attrs["diffuserbench"]
    assert (facts["black_level"], facts["significant_bits"], facts["exposure_ms"]) == (64.0, 12, 10.0)
    assert facts["frames"]["z_um"] == [1000.0, 1250.0, 1500.0]
    assert facts["frames"]["time_s"] == [0.0, 1.0, 2.0]
    assert verify(run).is_sound


def test_numpy(run: Run, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    export(run, tmp_path / "a.npy", [4, 1], on_progress=lambda *done: told.append(done))
    assert told == [(1, 2), (2, 2)]
    assert np.array_equal(np.load(tmp_path / "a.npy"), [run.frame(4), run.frame(1)])


def test_hdf5(run: Run, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    export(run, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["frames"], frames_of(run))
        assert list(file["frame_number"]) == STORED
        assert json.loads(file["metadata"][3])["index"] == 4
        assert file.attrs["simulated"]
        facts = run.metadata(STORED[0])
        told = file["frames"].attrs
        assert (told["significant_bits"], told["black_level"]) == (facts.significant_bits, facts.black_level)
        assert (told["pixel_format"], told["gain"]) == (facts.pixel_format, facts.gain)
        assert told["axes"] == ("t,y,x", "t,y,x,c")[file["frames"].ndim - 3]
        np.testing.assert_allclose(file["time_s"], [0, 0.05, 0.1, 0.2, 0.25])
        for axis, place in facts.stage_position.items():
            assert file["stage"][axis][0] == place


def test_png(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "of" / "pictures"
    export(run, folder)
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"frame-{i}.png" for i in STORED]
    read = cv2.imread(str(folder / "frame-4.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(read[..., ::-1] if read.ndim == 3 else read, run.frame(4))


def test_a_picture_that_is_there_is_not_replaced(run: Run, tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "frame-4.png").write_text("mine")
    with pytest.raises(FileError, match="exists already"):
        export(run, tmp_path / "pictures", [4])
    assert (tmp_path / "pictures" / "frame-4.png").read_text() == "mine"


def test_mp4(run: Run, tmp_path: Path) -> None:
    export(run, tmp_path / "a.mp4")
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(STORED)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20, rel=0.02)
    assert (video.get(cv2.CAP_PROP_FRAME_HEIGHT), video.get(cv2.CAP_PROP_FRAME_WIDTH)) == (32, 48)
    assert video.read()[1].mean() == pytest.approx(run.frame(0).mean() / 4095 * 255, abs=4)
    video.release()


def test_averaged_frames_go_to_tiff_but_not_to_png(tmp_path: Path) -> None:
    plan = Plan(label="x", parts=(Part(label="a", average=2),))
    with RunWriter.create(tmp_path, label="x", bench=BENCH, plan=plan) as writer:
        writer.write([FrameToStore(0, image(0, False).astype(np.float32) + 0.5, METADATA, 2)])
        run = writer.finish(FinishReason.COMPLETED)
    export(run, tmp_path / "a.tif")
    assert np.array_equal(tifffile.imread(tmp_path / "a.tif")[0], run.frame(0))
    with pytest.raises(RunError, match="float32"):
        export(run, tmp_path / "pictures")


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    run = a_recording(tmp_path, colour=False)
    with pytest.raises(FileError, match="no known format"):
        export(run, tmp_path / "a.gif")
    with pytest.raises(FileError, match=r"frames are an OME-Zarr already: .*/frames\.ome\.zarr"):
        export(run, tmp_path / "a.ome.zarr")
    with pytest.raises(RunError, match="frame 3 is not there"):
        export(run, tmp_path / "a.tif", [2, 3])
    (tmp_path / "old.tif").write_text("old")
    with pytest.raises(FileError, match="exists already"):
        export(run, tmp_path / "old.tif")
    with pytest.raises(FileError, match="does not exist"):
        export(run, tmp_path / "nowhere" / "a.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["old.tif", run.path.name])


def test_room_for_all_that_is_written_is_asked_for_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = a_recording(tmp_path, colour=False)
    room = SimpleNamespace(free=3 * run.array.frame_bytes)

    monkeypatch.setattr(
        "instrument.files.atomic.os.statvfs",
        lambda _: SimpleNamespace(f_flag=0, f_blocks=1, f_bavail=room.free, f_frsize=1),
    )
    assert export(run, tmp_path / "a.npy", [0, 1, 2]) == [0, 1, 2]
    with pytest.raises(FileError, match=r"needs 0.0 MB, and 0.0 MB are free"):
        export(run, tmp_path / "b.npy", [0, 1, 2, 4])
    assert not (tmp_path / "b.npy").exists()
    room.free = 0  # a film's size nobody knows before
    assert export(run, tmp_path / "a.mp4", [0, 1]) == [0, 1]


def test_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_recording(tmp_path, colour=False)
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(run.path), "a.npy", "--frames", "1:5"]) == 0
    shown = capsys.readouterr()
    assert "Wrote 3 frames" in shown.out
    assert "1 frames that are not in the run" in shown.err
    assert np.array_equal(np.load("a.npy"), [run.frame(i) for i in (1, 2, 4)])
    assert main(["export", str(run.path), "b.npy", "--frames", "one"]) == 2
    assert main(["export", str(run.path), "b.npy", "--label", "psf"]) == 2
    assert "recording" in capsys.readouterr().err
