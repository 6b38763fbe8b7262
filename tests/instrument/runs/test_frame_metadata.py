"""A field added to a frame's metadata reaches photographs, runs and recordings by its declaration alone."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import drivers.simulated.camera
import instrument.bench.photograph_file
import instrument.runs.log
from drivers.frame import FrameMetadata, filled_in_by_bench, over_frames
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.bench.lit import LightState
from instrument.bench.photograph_file import read_snapshot, write_snapshot
from instrument.files.errors import FileError
from instrument.files.images import read_image, write_image
from instrument.plan import OFF, Light, Part, Plan, PlanError, SourceGrid
from instrument.runs.acquire import acquire
from instrument.runs.log import log_line
from instrument.runs.recorder import record
from instrument.runs.run import Run
from instrument.runs.run_files import LOG, PLAN, PROVENANCE, STATE, RunError

BENCH = """
[bench]
name = "tiny"
[camera]
driver = "simulated"
replay_frames = 2
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 1.0
"""


@dataclass(frozen=True, slots=True)
class Warmer(FrameMetadata):
    """As a later version may declare it."""

    sensor_temperature_c: float | None = None
    voltages: Mapping[str, float] = field(default_factory=dict)
    hottest_c: float = over_frames(max, default=0.0)
    room: str = filled_in_by_bench(default="")


@pytest.fixture
def later_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read with the later version's declaration."""
    for module in (instrument.runs.log, instrument.bench.photograph_file):
        monkeypatch.setattr(module, "FrameMetadata", Warmer)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The simulated bench, whose camera gives two of the new fields, and which itself gives one."""
    temperatures = itertools.count(30)

    def take(**known: Any) -> Warmer:
        now_c = float(next(temperatures))
        return Warmer(**known, sensor_temperature_c=now_c, voltages={"core_v": 1.8}, hottest_c=100 - now_c)

    monkeypatch.setattr(drivers.simulated.camera, "FrameMetadata", take)
    with open_bench(parse_config(BENCH, None)) as opened:
        complete = opened.with_surroundings

        def surrounded(metadata: FrameMetadata) -> FrameMetadata:
            values = {f.name: getattr(complete(metadata), f.name) for f in fields(metadata)}
            return Warmer(**{**values, "room": "dark"})

        monkeypatch.setattr(opened, "with_surroundings", surrounded)
        yield opened


def assert_all_there(metadata: FrameMetadata) -> None:
    assert isinstance(metadata, Warmer)
    assert metadata.sensor_temperature_c is not None
    assert metadata.sensor_temperature_c >= 30
    assert metadata.voltages == {"core_v": 1.8}
    assert metadata.room == "dark"
    assert metadata.led_pattern == "off"


@pytest.mark.usefixtures("later_reader")
@pytest.mark.parametrize("suffix", [".tif", ".png", ".npy"])
def test_photographs_have_it(tmp_path: Path, bench: Bench, suffix: str) -> None:
    taken, path = bench.snap(1), tmp_path / f"photo{suffix}"
    write_snapshot(bench, path, taken, LightState.DARK)
    back = read_snapshot(path)
    assert back.metadata == taken.metadata
    assert (back.image == taken.image).all()
    assert_all_there(back.metadata)
    assert read_image(path).metadata["voltages"] == {"core_v": 1.8}


def test_a_mean_combines_it_as_declared(bench: Bench) -> None:
    first, mean = bench.snap(1).metadata, bench.snap(3).metadata
    assert isinstance(first, Warmer)
    assert isinstance(mean, Warmer)
    assert first.sensor_temperature_c is not None
    assert mean.sensor_temperature_c == first.sensor_temperature_c + 3  # the last one's
    assert mean.hottest_c == first.hottest_c - 1  # the first of the three


@pytest.mark.usefixtures("later_reader")
def test_runs_and_recordings_have_it(tmp_path: Path, bench: Bench) -> None:
    run = acquire(bench, Plan(label="few", parts=(Part(label="dark", repeats=2),)), tmp_path)
    recording = record(bench, tmp_path, n_frames=3)
    for made in (run, recording):
        again = Run.open(made.path)
        assert again.records
        for index in again.records:
            assert_all_there(again.metadata(index))


def test_what_a_newer_version_added_is_kept_with_a_word(
    tmp_path: Path, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """This version's reader, which knows nothing of the new fields."""
    run = acquire(bench, Plan(label="few", parts=(Part(label="dark", repeats=2),)), tmp_path)
    assert "which this program does not know" in caplog.text
    assert "'sensor_temperature_c'" in caplog.text
    assert type(run.metadata(0)) is FrameMetadata
    assert run.metadata(0).led_pattern == "off"
    written = [json.loads(line) for line in (run.path / LOG).read_text().splitlines()]
    frame = next(line for line in written if line.get("kind") == "frame")
    assert run.records[0].unknown["voltages"] == {"core_v": 1.8}
    assert frame.pop("line_crc32")
    assert run.records[0].to_json() == frame


def test_a_frames_line_is_read_when_it_is_asked_for(tmp_path: Path, bench: Bench) -> None:
    run = acquire(bench, Plan(label="few", parts=(Part(label="dark", repeats=3),)), tmp_path)
    lines = (run.path / LOG).read_bytes().splitlines(keepends=True)
    _, second, third = (i for i, line in enumerate(lines) if b'"kind": "frame"' in line)
    lines[second] = log_line({"kind": "frame", "index": 1, "n_bytes": 3})  # as if somebody had made it so
    lines[third] = lines[third].replace(b'"index": 2', b'"index": 1')  # a changed number: no line of ours
    (run.path / LOG).write_bytes(b"".join(lines))
    again = Run.open(run.path)
    assert sorted(again.records) == [0, 1]
    assert [bad.number for bad in again.bad_lines] == [third + 1]
    assert again.records[0] == run.records[0]
    with pytest.raises(RunError, match="is damaged: frame 1"):
        again.metadata(1)


def test_every_field_of_today_comes_back(tmp_path: Path, bench: Bench) -> None:
    taken = bench.snap(1)
    write_snapshot(bench, tmp_path / "photo.tif", taken, LightState.DARK)
    back = read_snapshot(tmp_path / "photo.tif").metadata
    for declared in fields(FrameMetadata):
        assert getattr(back, declared.name) == getattr(taken.metadata, declared.name), declared.name
    mean = bench.snap(3)
    write_snapshot(bench, tmp_path / "mean.tif", mean, LightState.DARK)
    assert read_snapshot(tmp_path / "mean.tif").frame_means == mean.frame_means
    assert len(mean.frame_means) == 3


def test_an_image_from_elsewhere_is_no_photograph_of_ours(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((2, 3), np.uint8))
    with pytest.raises(FileError, match="tells not how it was photographed"):
        read_snapshot(tmp_path / "a.png")


def test_a_run_of_a_newer_version_opens(
    tmp_path: Path, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """Fields that it added anywhere in the folder are left out, and those of the plan are told."""
    positions = SourceGrid(z_um=(bench.source_position_um[2],))
    part = Part(label="dark", repeats=2, positions=positions, light=(Light(kind="single"), OFF))
    assert bench.stage is not None
    bench.stage.home()
    run = acquire(bench, Plan(label="few", parts=(part,)), tmp_path)

    def add(name: str, *way: int | str) -> None:
        record = json.loads((run.path / name).read_text())
        inner = record
        for step in way:
            inner = inner[step]
        inner["novelty"] = {"a": [1]}
        (run.path / name).write_text(json.dumps(record))

    for name in (STATE, PROVENANCE, PLAN):
        add(name)
    for way in (("parts", 0), ("parts", 0, "positions"), ("parts", 0, "light", 0)):
        add(PLAN, *way)
    lines = [json.loads(line) for line in (run.path / LOG).read_text().splitlines()]
    lines = [line for line in lines if line["kind"] != "file"]  # of which it makes its own, too
    lines = [*({**line, "novelty": 1} for line in lines), {"kind": "novelty", "utc": "now"}]
    for line in lines:
        line.pop("line_crc32", None)  # which the newer version makes itself
    (run.path / LOG).write_bytes(b"".join(map(log_line, lines)))
    caplog.clear()
    again = Run.open(run.path)
    assert again.plan == run.plan
    assert again.provenance["novelty"] == {"a": [1]}
    assert [again.metadata(i) for i in again.records] == [run.metadata(i) for i in run.records]
    assert len(again.records) == 4
    for place in ("'novelty'", "'parts.0.novelty'", "parts.0.positions", "parts.0.light.0.novelty"):
        assert place in caplog.text
    plan = json.loads((run.path / PLAN).read_text())
    plan["parts"][0]["average"] = "many"
    (run.path / PLAN).write_text(json.dumps(plan))
    with pytest.raises(PlanError, match=r"plan\.json: 1 problem"):
        _ = Run.open(run.path).plan
