"""Damage of a run, and of what was made of its frames, is told in the same words by all who look at it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibration_routines.routine import routines
from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.images import write_image
from instrument.runs.acquire import look, settle
from instrument.runs.results import PHOTOGRAPH_FILE, RESULT_FILES
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import FRAMES, RunError
from recon.types import Calibration
from tests.instrument.runs.damages import DAMAGES, anothers, deleted, newer, older, one_bit, truncated, zeroed
from tests.instrument.runs.test_store import frame, new_run

pytestmark = pytest.mark.usefixtures("mock_drivers")


def test_no_two_commands_contradict_each_other_about_a_changed_pixel(
    tmp_path: Path, runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "runs" / "run"
    shutil.copytree(runs[0], path)
    chunk = path / f"{FRAMES}/0/c/1/0/0"
    whole = chunk.read_bytes()
    (path / "damaged.json").write_text("no note at all")
    one_bit(chunk, path)

    def said(*words: str) -> tuple[int, str]:
        status = main([*words, str(path.parent if words == ("list",) else path)])
        return status, "".join(capsys.readouterr())

    assert said("list")[1].count("DAMAGED") == 0  # by its size, and the list says so
    assert "by their sizes" in said("list")[1]
    with pytest.raises(RunError, match="frame 1 is damaged: its file has the CRC-32"):
        Run.open(path).frame(1)
    assert main(["export", str(path), str(tmp_path / "frames.npy")]) == 2
    assert "frame 1 is damaged" in capsys.readouterr().err
    words = "\n".join(look(path).lines())
    assert words.startswith("frame 1: its file has the CRC-32")
    status, verified = said("verify")
    assert status == 1
    assert words in verified
    assert f"DAMAGED:      {words}" in said("show")[1]
    assert "DAMAGED" in said("list")[1]
    chunk.write_bytes(whole)  # from a backup: no note outlives what it tells of
    assert "DAMAGED" not in said("list")[1]
    assert not (path / "damaged.json").exists()
    one_bit(chunk, path)
    assert said("verify")[0] == 1
    (path / "damaged.json").write_text('{"frames": [7]}')
    assert said("list")[0] == 0
    chunk.write_bytes(whole)
    assert said("verify")[0] == 0
    assert not (path / "damaged.json").exists()


_PSFS = "calibration/psfs.ome.zarr"
CALIBRATION = {
    "calibration/calibration.json": DAMAGES,
    f"{_PSFS}/0/zarr.json": (deleted, truncated, zeroed, newer),
    f"{_PSFS}/0/c/0/0/0/0": (deleted, truncated, one_bit, zeroed, anothers),
}


@pytest.fixture(scope="module")
def calibrated(runs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Copies of the runs, with a calibration in each."""
    paths = []
    for number, run in enumerate(runs):
        path = tmp_path_factory.mktemp("calibrated") / "run"
        shutil.copytree(run, path)
        psfs = np.random.default_rng(number).random((2, 1, 8, 9)).astype(np.float32)
        made = Calibration(psfs, np.array([[0.0, 0.0, 1e4], [0.0, 0.0, 2e4 + number]]))
        save_calibration(made, path / "calibration")
        paths.append(path)
    return paths[0], paths[1]


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        (name, damage)
        for name, damages in CALIBRATION.items()
        for damage in damages
        if (name, damage) != ("calibration/calibration.json", older)  # nothing in it is of an earlier state
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_no_two_commands_contradict_each_other_about_a_damaged_calibration(
    tmp_path: Path,
    calibrated: tuple[Path, Path],
    capsys: pytest.CaptureFixture[str],
    name: str,
    damage: Callable[[Path, Path], None],
) -> None:
    path = tmp_path / "runs" / "run"
    shutil.copytree(calibrated[0], path)
    whole = (path / name).read_bytes()
    damage(path / name, calibrated[1] / name)

    def said(*words: str) -> tuple[int, str]:
        status = main([*words, str(path.parent if words == ("list",) else path)])
        return status, " ".join("".join(capsys.readouterr()).split())

    (words,) = look(path).lines()
    assert words.startswith("calibration")
    words = " ".join(words.split())
    status, verified = said("verify")
    assert status == 1
    assert words in verified
    assert "DAMAGED, completed, 3 of 3 frames read back" in verified
    assert f"DAMAGED: {words}" in said("show")[1]
    for _ in range(2):
        assert said("resume")[0] == 1
        status, resumed = said("resume")
        assert "complete already, 3 frames read back, all as they were written." in resumed
        assert f"What was made of the frames is damaged: {words}" in resumed
    assert "DAMAGED" in said("list")[1]
    (path / name).write_bytes(whole)  # from a backup
    assert "DAMAGED" not in said("list")[1]
    assert not (path / "damaged.json").exists()
    assert said("verify")[0] == said("resume")[0] == 0


def test_a_photograph_made_of_a_run_is_read_as_a_picture(
    tmp_path: Path, runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    write_image(path / "photograph.tif", np.arange(20, dtype=np.float32).reshape(4, 5))
    (path / "photograph_run.json").write_text("{}")
    assert main(["resume", str(path)]) == main(["verify", str(path)]) == 0
    assert "damaged" not in capsys.readouterr().out
    truncated(path / "photograph.tif", path)
    assert main(["resume", str(path)]) == main(["verify", str(path)]) == 1
    said = "".join(capsys.readouterr())
    assert "What was made of the frames is damaged: photograph.tif: " in said


def test_what_an_operator_puts_into_a_runs_folder_is_no_result(
    tmp_path: Path, runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    (path / "notes.json").write_text("the lamp was changed")
    (path / "old.json").mkdir()
    assert main(["verify", str(path)]) == main(["resume", str(path)]) == 0
    assert "damaged" not in "".join(capsys.readouterr()).lower()
    (path / "doubtful_dpc.json").write_text("no surface")
    assert main(["verify", str(path)]) == main(["resume", str(path)]) == 1
    assert "doubtful_dpc.json: is damaged: " in "".join(capsys.readouterr())


def test_the_results_of_all_routines_are_known_by_name() -> None:
    made = {one.purpose.result for one in routines.values() if one.purpose is not None}
    assert made <= {*RESULT_FILES, PHOTOGRAPH_FILE, "calibration"}, "a calibration by what it holds"


def test_the_window_tells_a_changed_pixel_in_the_words_of_verify(
    tmp_path: Path, runs: tuple[Path, Path]
) -> None:
    window = pytest.importorskip("gui.run_looks")
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    one_bit(path / f"{FRAMES}/0/c/1/0/0", path)
    (words,) = look(path).lines()
    opened = window.look_into(path)
    assert f"DAMAGED: {words}" in opened.about
    assert "frame 1 is damaged" in window.read_frame(opened, 1)


@pytest.mark.parametrize("name", CALIBRATION)
def test_the_window_tells_a_damaged_calibration_in_the_words_of_verify(
    tmp_path: Path, calibrated: tuple[Path, Path], name: str
) -> None:
    window = pytest.importorskip("gui.run_looks")
    path = tmp_path / "run"
    shutil.copytree(calibrated[0], path)
    truncated(path / name, path)
    (words,) = look(path).lines()
    for read in (False, True):
        assert f"DAMAGED: {words}" in window.look_into(path, read=read).about


def test_the_window_counts_images_without_a_line_as_verify_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    window = pytest.importorskip("gui.run_looks")
    with new_run(tmp_path, plan=None) as writer:
        writer.start()
        writer.write([frame(i) for i in range(4)])
        path = writer.finish(FinishReason.COMPLETED).path
    log = path / "log.jsonl"
    data = bytearray(log.read_bytes())
    data[data.index(b'"frame", "index": 3') + 20] = 7
    log.write_bytes(data)
    settle(path)
    about = window.look_into(path, read=True).about
    assert about[0].startswith("completed: 4 of 4 frames taken, 1 of them without metadata")
    assert about[1] == "4 of 4 frames read back are as they were written"
    assert main(["verify", str(path)]) == 0
    assert "4 of 4 frames read back" in capsys.readouterr().out
    one_bit(path / f"{FRAMES}/0/c/3/0/0", path)
    assert "3 of 4 frames read back are as they were written" in window.look_into(path, read=True).about
