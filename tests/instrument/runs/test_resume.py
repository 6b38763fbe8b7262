"""A run goes on with the first step whose data are not safely stored, and repeats none that are."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.registry import claim
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.plan import Part, Plan, PlanError, SourcePoints, StagePoints
from instrument.runs.acquire import look, prepare, prepare_resume
from instrument.runs.inspection import verify
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import RunError
from instrument.runs.runner import RunStatus
from instrument.runs.writer import RunWriter
from tests.mocks.devices import MockWorld

pytestmark = pytest.mark.usefixtures("mock_drivers")


def open_mock_bench() -> Bench:
    tables = "".join(f'[{kind}]\ndriver = "mock"\n' for kind in ("camera", "stage", "led_array", "slm"))
    return Bench(parse_config(f'[scene]\ncontrol = "simulated"\n{tables}', None)).open()


def calls(bench: Bench) -> list[str]:
    world = bench.shared["mock"]
    assert isinstance(world, MockWorld)
    return world.calls


PLAN = Plan(
    label="sweep",
    parts=(
        Part.model_validate(
            {
                "label": "psf",
                "light": "source",
                "exposure_ms": 20,
                "positions": {"kind": "points", "points_um": [(0, 0, 10.0 * i) for i in range(4)]},
            }
        ),
        Part(label="after", repeats=2),
    ),
)


def aborted_run(folder: Path, plan: Plan = PLAN, after: int = 2) -> Path:
    def abort(status: RunStatus) -> None:
        if status.done == after:
            runner.abort()

    with open_mock_bench() as bench:
        runner = prepare(bench, plan, folder, on_progress=abort)
        return runner.execute().path


def image_bytes(path: Path, frames: range) -> list[bytes]:
    run = Run.open(path)
    return [run.array.chunk_path(i).read_bytes() for i in frames]


@pytest.mark.parametrize("after", range(7))
def test_resume_does_what_is_left_and_nothing_twice(tmp_path: Path, after: int) -> None:
    path = aborted_run(tmp_path, after=after) if after < 6 else aborted_run(tmp_path, after=99)
    kept = Run.open(path)
    n_kept = min(after, 6)
    if after:
        assert sorted(kept.records) == list(range(n_kept))
    before = image_bytes(path, range(n_kept))
    with open_mock_bench() as bench:
        findings = look(path)
        runner = prepare_resume(bench, path, findings)
        assert findings.todo == tuple(range(n_kept, 6))
        run = runner.execute()
        assert calls(bench).count("camera.snap") == 6 - n_kept
    assert run.condition is RunCondition.COMPLETED
    assert run.missing() == []
    assert image_bytes(path, range(n_kept)) == before
    assert {i: r for i, r in run.records.items() if i < n_kept} == kept.records
    assert [run.metadata(i).stage_position["z_um"] for i in range(6)] == [0, 10, 20, 30, 30, 30]
    assert [run.metadata(i).exposure_ms for i in range(6)] == [20] * 6


def test_the_camera_and_the_stage_are_as_they_were_when_the_run_began(tmp_path: Path) -> None:
    plan = Plan(label="still", parts=(Part(label="a", repeats=3),))

    def abort(status: RunStatus) -> None:
        if status.done == 1:
            runner.abort()

    with open_mock_bench() as bench:
        assert bench.stage is not None
        bench.stage.move_to({"z_um": 77})
        bench.camera.set_exposure_ms(33)
        bench.camera.set_gain(4)
        runner = prepare(bench, plan, tmp_path, on_progress=abort)
        path = runner.execute().path
    with open_mock_bench() as bench:
        run = prepare_resume(bench, path).execute()
    last = run.metadata(2)
    assert (last.exposure_ms, last.gain, last.stage_position["z_um"]) == (33, 4, 77)


def test_damaged_and_missing_images_are_taken_again_and_named(tmp_path: Path) -> None:
    path = aborted_run(tmp_path, after=5)
    array = Run.open(path).array
    data = bytearray(array.chunk_path(1).read_bytes())
    data[0] ^= 255
    array.chunk_path(1).write_bytes(data)
    array.chunk_path(3).unlink()
    with open_mock_bench() as bench:
        findings = look(path)
        runner = prepare_resume(bench, path, findings)
        assert findings.todo == (1, 3, 5)
        assert [frame.index for frame in findings.damaged] == [1, 3]
        assert "frame 1: its file" in str(findings)
        run = runner.execute()
    assert all(run.verify(i) is None for i in range(6))
    assert [run.metadata(i).stage_position["z_um"] for i in range(6)] == [0, 10, 20, 30, 30, 30]


def test_what_a_crash_leaves_behind_is_found_and_done_again(tmp_path: Path) -> None:
    path = aborted_run(tmp_path, after=4)
    # As after kill -9: state "running", a line cut off in the middle, the image of that line on the disk.
    log = path / "log.jsonl"
    lines = [line for line in log.read_bytes().splitlines(keepends=True) if b'"frame"' in line]
    log.write_bytes(b"".join(lines[:3]) + lines[3][:50])
    state = path / "state.json"
    state.write_text(state.read_text().replace('"finished"', '"running"'))
    (path / ".state.12ab34cd.part.json").write_text("{")
    assert Run.open(path).condition is RunCondition.CRASHED
    with open_mock_bench() as bench:
        findings = look(path)
        runner = prepare_resume(bench, path, findings)
        assert findings.condition is RunCondition.CRASHED
        assert (findings.without_a_line, findings.todo) == ((3,), (3, 4, 5))
        run = runner.execute()
    assert run.reason is FinishReason.COMPLETED
    assert run.missing() == []
    assert not list(path.glob(".*"))
    assert any("half line of 50 bytes" in str(event.get("text")) for event in run.events)


def test_a_run_is_continued_by_one_program_only(tmp_path: Path) -> None:
    path = aborted_run(tmp_path)
    with open_mock_bench() as bench, RunWriter.reopen(path), pytest.raises(RunError, match="another program"):
        prepare_resume(bench, path)


@pytest.mark.parametrize("first", ["folder", "lock"])
def test_a_second_writer_is_kept_out_by_either_lock(tmp_path: Path, first: str) -> None:
    """By the folder's when the file was deleted, by the file's where an older program holds no other."""
    path = aborted_run(tmp_path)
    handle = os.open(path if first == "folder" else path / "lock", os.O_RDONLY)
    assert claim.lock(handle)
    if first == "folder":
        (path / "lock").unlink()
    with pytest.raises(RunError, match="another program"):
        RunWriter.reopen(path)
    assert Run.open(path).is_locked()
    os.close(handle)
    assert not Run.open(path).is_locked()
    RunWriter.reopen(path).close()


def test_a_camera_that_is_another_one_is_refused_and_the_run_stays_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = aborted_run(tmp_path)
    with open_mock_bench() as bench:
        bench.camera.set_gain(2)
        monkeypatch.setattr(type(bench.camera), "set_gain", lambda self, gain: self.gain)
        with pytest.raises(DeviceError, match=r"gain is 2.*was 1"):
            prepare_resume(bench, path)
        assert not Run.open(path).is_locked()
    assert Run.open(path).condition is RunCondition.ABORTED


def test_a_stage_that_lost_its_reference_must_be_homed_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = aborted_run(tmp_path)
    with open_mock_bench() as bench:
        monkeypatch.setattr(type(bench.stage), "is_homed", False)
        with pytest.raises(PlanError, match="not homed"):
            prepare_resume(bench, path)


def test_inspecting_changes_nothing(tmp_path: Path) -> None:
    path = aborted_run(tmp_path)
    before = {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}
    seen: list[tuple[int, int]] = []
    findings = verify(Run.open(path), lambda done, total: seen.append((done, total)))
    assert (findings.frames, findings.todo) == (2, (2, 3, 4, 5))
    assert seen == [(1, 2), (2, 2)]
    assert {p: p.read_bytes() for p in path.rglob("*") if p.is_file()} == before


def test_slm_images_are_the_ones_that_the_run_began_with(tmp_path: Path) -> None:
    images = [tmp_path / "a.png", tmp_path / "b.png"]
    for value, image in enumerate(images):
        cv2.imwrite(str(image), np.full((4, 6), 40 + value, np.uint8))
    plan = Plan(label="slm", parts=(Part(label="a", slm_images=(*images, images[0])), Part(label="b")))
    whole = Run.open(aborted_run(tmp_path / "whole", plan, after=99))
    path = aborted_run(tmp_path / "cut", plan, after=1)
    for image in images:
        image.unlink()
    moved = path.rename(tmp_path / "elsewhere")
    with open_mock_bench() as bench:
        run = prepare_resume(bench, moved).execute()
    hashes = [run.metadata(i).slm_image_hash for i in range(4)]
    assert hashes == [whole.metadata(i).slm_image_hash for i in range(4)]
    assert hashes[0] == hashes[2] == hashes[3] != hashes[1]


def test_positions_by_stage_axes_go_on_as_well(tmp_path: Path) -> None:
    plan = Plan(
        label="axes",
        parts=(
            Part(label="a", positions=StagePoints(points=({"x_um": 5}, {"x_um": 6, "z_um": 9}))),
            Part(label="b", positions=SourcePoints(points_um=((1, 0, 2),))),
            Part(label="c"),
        ),
    )
    whole = Run.open(aborted_run(tmp_path / "whole", plan, after=99))
    path = aborted_run(tmp_path / "cut", plan, after=3)
    with open_mock_bench() as bench:
        run = prepare_resume(bench, path).execute()
    for i in range(4):
        assert run.metadata(i).stage_position == whole.metadata(i).stage_position
        assert np.array_equal(run.frame(i).shape, whole.frame(i).shape)
