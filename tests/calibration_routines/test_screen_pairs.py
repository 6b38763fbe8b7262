"""``calibrate screen --pairs``: a PSF from files of photographs and what they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration_routines.optics.screen_pairs import PairFiles, read_pairs, solve_pairs
from calibration_routines.optics.screen_solve import ScreenOptions
from calibration_routines.procedure import Listener, Outcome
from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from instrument.files.errors import FileError
from instrument.runs.run_control import RunControl
from tests.recon.blind.test_known_pictures import taken


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    folder = tmp_path / "pairs"
    folder.mkdir()
    data, pictures, _ = taken()
    for number in range(len(data)):
        np.save(folder / f"raw_{number}.npy", data[number, 0])
        np.save(folder / f"truth_{number}.npy", pictures[number, 0])
    return folder


def solve(files: PairFiles, asked: ScreenOptions, out: Path) -> Outcome:
    return solve_pairs(asked, files, out, RunControl(), Listener())


def test_pairs_become_a_calibration_that_says_how_left_out_pictures_fare(pairs: Path, tmp_path: Path) -> None:
    files = PairFiles(pairs=pairs, pixel_um=5.0)
    done = solve(files, ScreenOptions(judged=1, z_um=2e5), tmp_path / "calibration")
    assert done.calibration is not None
    found = load_calibration(done.calibration)
    assert found.psfs.shape == (1, 1, 48, 56)
    assert found.source_positions_um[0, 2] == 2e5
    assert found.geometry.pixel_pitch_um == 5.0
    (judged,) = found.quality["left_out"]
    assert judged["psnr_db"] > judged["even_db"] + 3
    assert done.good
    assert any(f"{judged['psnr_db']:.1f} dB" in line for line in done.verdict)


def test_pictures_that_do_not_belong_to_their_photographs_are_told_of(pairs: Path, tmp_path: Path) -> None:
    for number in range(5):
        np.save(pairs / f"truth_{number}.npy", np.load(pairs / f"truth_{number}.npy")[::-1, ::-1])
    (pairs / "truth_3.npy").replace(pairs / "keep.npy")
    (pairs / "truth_4.npy").replace(pairs / "truth_3.npy")
    (pairs / "keep.npy").replace(pairs / "truth_4.npy")
    done = solve(PairFiles(pairs=pairs), ScreenOptions(judged=1), tmp_path / "calibration")
    assert not done.good
    assert "belong together" in done.verdict[-2]
    assert done.calibration == tmp_path / "doubtful_calibration"


def _remove(folder: Path) -> None:
    (folder / "truth_2.npy").unlink()


def _shrink(folder: Path) -> None:
    np.save(folder / "truth_2.npy", np.ones((4, 5), np.float32))


def _empty(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


def _double(folder: Path) -> None:
    np.save(folder / "photograph_2.npy", np.ones((48, 56), np.float32))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_remove, "raw_2.npy: has no partner truth_2"),
        (_shrink, r"truth_2.npy: is 4 x 5 grey float32, but raw_0.npy is 48 x 56"),
        (_empty, "holds 0 pairs"),
        (_double, "photograph_2.npy: has the name 2 of raw_2.npy, too"),
    ],
)
def test_a_folder_without_proper_pairs_is_refused(pairs: Path, spoil: object, words: str) -> None:
    spoil(pairs)  # type: ignore[operator]
    with pytest.raises(FileError, match=words):
        read_pairs(pairs)


def test_a_file_instead_of_a_folder_is_refused(pairs: Path) -> None:
    with pytest.raises(FileError, match="is no folder"):
        read_pairs(pairs / "raw_0.npy")


def test_the_terminal_takes_pairs_or_the_bench_and_never_mixes_them(
    pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", "screen"]
    assert main([*words, "--pairs", str(pairs), "--dry-run"]) == 0
    assert "5 pairs of 48 x 56 pixels, 1 channel: 0, 1, 2, 3, 4" in capsys.readouterr().out
    assert main([*words, "--pairs", str(pairs), "--pictures", "12"]) == 2
    assert "leave out --pictures" in capsys.readouterr().err
    assert main([*words, "--gamma", "2.2"]) == 2
    assert "Only with --pairs: --gamma" in capsys.readouterr().err
