"""Films of other programs become recordings."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.files.images import ImageFile, read_stack
from instrument.reconstruction.video_files import require_video
from instrument.runs.imported import FilmFacts, _metadata, import_film
from instrument.runs.inspection import verify
from instrument.runs.run import Run
from tests.mocks.recordings import write_recording

FRAMES = np.random.default_rng(0).integers(0, 4096, (40, 12, 10)).astype(np.uint16)


def imported(path: Path) -> Run:
    (folder,) = path.iterdir()
    return Run.open(folder)


def test_a_recording_goes_out_as_ome_tiff_and_comes_back(tmp_path: Path) -> None:
    own = Run.open(write_recording(tmp_path / "own", dict(enumerate(FRAMES)), pixel_format="BayerRG12"))
    film = tmp_path / "film.ome.tif"
    assert main(["export", str(own.path), str(film)]) == 0
    assert main(["import", str(film), "--out", str(tmp_path / "runs"), "--label", "fish"]) == 0
    run = imported(tmp_path / "runs")
    require_video(run)
    assert verify(run).is_sound
    assert run.path.name.endswith("_fish")
    assert run.frame_period_s == pytest.approx(own.frame_period_s)
    assert (run.is_simulated, run.provenance["pixel_pitch_um"]) == (True, 6.5)
    for index in (0, 39):
        np.testing.assert_array_equal(run.frame(index), FRAMES[index])
        facts, before = run.metadata(index), own.metadata(index)
        for name in ("exposure_ms", "pixel_format", "significant_bits", "black_level"):
            assert getattr(facts, name) == getattr(before, name), name


@pytest.mark.parametrize(
    ("unit", "written"), [("ms", 20.0), ("Sec", 0.02), ("Seconds", 0.02), ("ns", 2e7), ("min", 0.02 / 60)]
)
def test_imagejs_time_has_a_unit(tmp_path: Path, unit: str, written: float) -> None:
    film = tmp_path / "film.tif"
    told = {"axes": "TYX", "finterval": written, "tunit": unit}
    tifffile.imwrite(film, FRAMES, imagej=True, metadata=told)
    assert read_stack(film).metadata["frame_period_s"] == pytest.approx(0.02)
    tifffile.imwrite(film, FRAMES, imagej=True, metadata=told | {"tunit": "generation"})
    told_so = read_stack(film)
    assert "frame_period_s" not in told_so.metadata
    assert "its unit of time, 'generation', is not known" in " ".join(told_so.notes)


def test_what_a_file_does_not_tell_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "film.tif"
    tifffile.imwrite(film, FRAMES, imagej=True, metadata={"axes": "TYX", "finterval": 0.02})
    words = ["import", str(film), "--out", str(tmp_path / "runs")]
    assert main(words) == 2
    assert "how large the camera's pixels are: give --pixel-um" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
    assert main([*words, "--pixel-um", "6.5"]) == 0
    assert "nothing tells the exposure time" in capsys.readouterr().err
    run = imported(tmp_path / "runs")
    assert run.frame_period_s == pytest.approx(0.02)
    assert run.metadata(3).exposure_ms == pytest.approx(20)
    assert (run.metadata(3).pixel_format, run.is_simulated) == ("Mono16", False)
    np.save(tmp_path / "film.npy", FRAMES)
    assert main(["import", str(tmp_path / "film.npy"), "--pixel-um", "6.5"]) == 2
    assert "give --fps" in capsys.readouterr().err
    np.save(tmp_path / "one.npy", FRAMES[0])
    assert main(["import", str(tmp_path / "one.npy")]) == 2
    assert "holds one image; a film has several" in capsys.readouterr().err


def test_colour_and_floats_and_what_is_said_over_what_the_file_tells(tmp_path: Path) -> None:
    said = FilmFacts(frames_per_s=25.0, pixel_um=3.0, exposure_ms=5.0)
    colour = (FRAMES[:4, ..., None] // np.array([16, 32, 64])).astype(np.uint8)
    told = {"axes": "TYXS", "TimeIncrement": 1.0, "PhysicalSizeX": 9.0, "PhysicalSizeXUnit": "µm"}
    tifffile.imwrite(tmp_path / "c.ome.tif", colour, ome=True, photometric="rgb", metadata=told)
    np.save(tmp_path / "f.npy", FRAMES[:4].astype(np.float32) / 7)
    done: list[tuple[int, int]] = []
    for name, kind in (("c.ome.tif", "RGB8"), ("f.npy", "Mono16")):
        film = read_stack(tmp_path / name)
        run = import_film(film, tmp_path / f"runs-{kind}", "x", said, lambda *n: done.append(n))
        np.testing.assert_array_equal(run.frame(3), film.pixels[3])
        assert run.frame_period_s == pytest.approx(0.04)
        assert run.metadata(3).utc - run.metadata(0).utc == timedelta(seconds=0.12)
        assert run.provenance["pixel_pitch_um"] == 3.0
        assert run.metadata(0).pixel_format == kind
    assert done == [(4, 4)] * 2


@pytest.mark.parametrize(
    ("told", "gain", "black"), [({"gain": 4.5, "black_level": 64.0}, 4.5, 64.0), ({}, 1.0, 0.0)]
)
def test_what_a_film_tells_of_its_camera_is_taken(
    tmp_path: Path, told: dict[str, float], gain: float, black: float
) -> None:
    path = tmp_path / "film.tif"
    path.touch()
    first = _metadata(ImageFile(path, FRAMES, metadata=told), 12.5)
    assert (first.gain, first.black_level, first.exposure_ms) == (gain, black, 12.5)
    assert (first.pixel_format, first.significant_bits, first.roi) == ("Mono16", 16, (0, 0, 12, 10))
