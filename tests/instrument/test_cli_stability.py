"""``diffuserbench stability`` as a user types it, on a map that costs nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from instrument.cli import COMMANDS
from instrument.evaluation.figures import ticks_of
from instrument.files.errors import BenchError, FileError
from instrument.files.stability_file import CellLog, read_stability
from recon.evaluation import maps
from recon.evaluation.maps import run_map
from recon.verdict.map import Failure, Stress, StressMap, Trial

CALLS: list[tuple[str, float, float]] = []


def trial(method: str, x: float, y: float, _seed: int, _size: str) -> Trial:
    CALLS.append((method, x, y))
    if len(CALLS) == 4 and method == "stops":
        raise KeyboardInterrupt
    return Trial(0.1 * y / x, {Failure.TRIVIAL: 3 * y / x}, {"snr": x})


AXES = (
    Stress("x", "light", "electrons", (1, 3, 10, 30), (1, 10), logarithmic=True),
    Stress("y", "noise", "electrons", (1, 4), (1, 4)),
)


@pytest.fixture(autouse=True)
def one_map(monkeypatch: pytest.MonkeyPatch) -> None:
    CALLS.clear()
    stress = StressMap("easy", "Easy", "Is it easy?", *AXES, ("first", "stops"), trial)
    monkeypatch.setattr(maps, "MAPS", {"easy": stress})


def run(*arguments: str) -> str:
    result = CliRunner().invoke(COMMANDS["stability"].load(), arguments, catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_a_map_is_made_drawn_and_written(tmp_path: Path) -> None:
    output = run("easy", "--method", "first", "--out", str(tmp_path))
    assert "3 of 4 cells fail" in output
    record = read_stability(tmp_path / "stability.json")
    made = record["maps"]["easy"]["methods"]["first"]
    assert made["failure"] == [["trivial", None], ["trivial", "trivial"]]
    assert made["boundary"][0][0] == pytest.approx(3)
    assert len(made["evidence"]) == 4
    assert (tmp_path / "easy.png").stat().st_size > 5000


def test_an_interrupted_map_goes_on_where_it_was(tmp_path: Path) -> None:
    assert CliRunner().invoke(COMMANDS["stability"].load(), ["easy", "-o", str(tmp_path)]).exit_code != 0
    done = len((tmp_path / "cells.jsonl").read_text().splitlines())
    assert done == 3
    # Cut off in the middle of a line, as a power failure would leave it.
    with (tmp_path / "cells.jsonl").open("a") as file:
        file.write('{"map": "ea')
    CALLS.extend([("", 0, 0)] * 10)
    before = len(CALLS)
    run("easy", "-o", str(tmp_path))
    assert len(CALLS) - before == 8 - done
    assert len((tmp_path / "cells.jsonl").read_text().splitlines()) == 8


def test_cells_of_another_program_or_scene_are_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stress = replace(maps.MAPS["easy"], methods=("first",), base="ten points")
    (cell, *_) = run_map(stress, "quick")
    CellLog(tmp_path).add(stress, "quick", cell)
    assert CellLog(tmp_path).of(stress, "quick") == [cell]
    assert CellLog(tmp_path).of(replace(stress, base="twenty points"), "quick") == []
    with monkeypatch.context() as patch:
        patch.setattr("instrument.files.stability_file.version", lambda _: "99.0")
        assert CellLog(tmp_path).of(stress, "quick") == []
    # As it was written before these were told apart.
    entry = json.loads((tmp_path / "cells.jsonl").read_text())
    old = {name: value for name, value in entry.items() if name not in ("program", "scene")}
    (tmp_path / "cells.jsonl").write_text(json.dumps(old) + "\n")
    assert CellLog(tmp_path).of(stress, "quick") == []


def test_redraw_needs_no_trial(tmp_path: Path) -> None:
    run("easy", "-m", "first", "-o", str(tmp_path))
    (tmp_path / "easy.png").unlink()
    before = len(CALLS)
    run("--redraw", "-o", str(tmp_path))
    assert (tmp_path / "easy.png").exists()
    assert len(CALLS) == before


def test_mistakes_are_sentences(tmp_path: Path) -> None:
    def fails(*arguments: str) -> None:
        CliRunner().invoke(COMMANDS["stability"].load(), arguments, catch_exceptions=False)

    with pytest.raises(BenchError, match="No map has the method nothing"):
        fails("easy", "--method", "nothing", "-o", str(tmp_path))
    with pytest.raises(ValueError, match="no map 'hard'"):
        fails("hard", "-o", str(tmp_path))
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match="folder is expected"):
        fails("easy", "-o", str(tmp_path / "file"))
    with pytest.raises(FileError, match="no such file"):
        fails("--redraw", "-o", str(tmp_path))
    (tmp_path / "stability.json").write_text(json.dumps({"format": "else"}))
    with pytest.raises(FileError, match="holds no stability maps"):
        fails("--redraw", "-o", str(tmp_path))
    (tmp_path / "cells.jsonl").write_text("nonsense\n{}\n")
    with pytest.raises(FileError, match="line 1"):
        CellLog(tmp_path)


def test_the_list_names_maps_and_methods() -> None:
    assert "first; stops" in run("--list")


def test_an_axis_may_name_its_values_in_other_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = replace(AXES[0], named=lambda value, size: f"{value:g} e in {size}")
    stress = StressMap("easy", "Easy", "Is it easy?", named, AXES[1], ("first",), trial)
    monkeypatch.setattr(maps, "MAPS", {"easy": stress})
    run("easy", "--out", str(tmp_path))
    record = read_stability(tmp_path / "stability.json")["maps"]["easy"]
    assert record["x"]["ticks"] == ["1 e in quick", "10 e in quick"]
    assert ticks_of(record["x"]) == record["x"]["ticks"]
    assert ticks_of(record["y"]) == ["1", "4"]
