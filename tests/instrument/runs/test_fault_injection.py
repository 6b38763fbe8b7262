"""A fault at every single call of a run: the bench ends safe, the run says what it is, and goes on."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceError
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.bench.safety import StepsFailedError
from instrument.plan import Part, Plan
from instrument.runs.acquire import prepare, prepare_resume
from instrument.runs.inspection import verify
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_files import RunError
from instrument.runs.runner import RunStatus
from tests.mocks.devices import MockDevice, MockWorld

pytestmark = pytest.mark.usefixtures("mock_drivers")

SAFE = ["led_array.off", "stage.stop", "camera.stop_sequence", "slm.display"]
PLAN = Plan(
    label="faults",
    parts=(
        Part(label="dark", average=2, exposures_ms=(5.0,)),
        Part.model_validate(
            {
                "label": "psf",
                "light": ["source", "off"],
                "exposures_ms": [1, 2],
                "gain": 2,
                "positions": {"kind": "points", "points_um": [[0, 0, 10], [5, 0, 20]]},
            }
        ),
    ),
)


def open_mock_bench() -> Bench:
    tables = "".join(f'[{kind}]\ndriver = "mock"\n' for kind in ("camera", "stage", "led_array", "slm"))
    return Bench(parse_config(f'[scene]\ncontrol = "simulated"\n{tables}', None)).open()


def calls(bench: Bench) -> list[str]:
    world = bench.shared["mock"]
    assert isinstance(world, MockWorld)
    return world.calls


def run_once(folder: Path) -> tuple[Run, list[str]]:
    with open_mock_bench() as bench:
        before = len(calls(bench))
        run = prepare(bench, PLAN, folder).execute()
        return run, calls(bench)[before:]


def at_call(number: int, act: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Have ``act`` called in the device call with this number, counted from now."""
    original, count = MockDevice._call, [0]

    def call(self: MockDevice, method: str) -> None:
        original(self, method)
        here, count[0] = count[0], count[0] + 1
        if here == number:
            act(f"{self.kind}.{method}")

    monkeypatch.setattr(MockDevice, "_call", call)


def assert_safe(bench: Bench) -> None:
    assert bench.led_array is not None
    assert bench.led_array.pattern.is_dark
    done = calls(bench)
    last_lit = max((i for i, call in enumerate(done) if call == "led_array.set_pattern"), default=-1)
    last_move = max((i for i, call in enumerate(done) if call == "stage.move_to"), default=-1)
    assert "led_array.off" in done[last_lit + 1 :]
    assert "stage.stop" in done[last_move + 1 :]
    # Light first, then motion: the last of each safe step stand in this order.
    last = [len(done) - 1 - done[::-1].index(step) for step in SAFE]
    assert last == sorted(last)


def device_fault(name: str) -> None:
    raise DeviceError(name, "was unplugged.", "Plug it in.")


def ctrl_c(_: str) -> None:
    raise KeyboardInterrupt


def sigterm(_: str) -> None:
    raise SystemExit(143)


@pytest.mark.parametrize("fault", [device_fault, ctrl_c, sigterm])
def test_a_fault_at_any_device_call_leaves_the_bench_safe_and_a_run_that_goes_on(
    tmp_path: Path, fault: Callable[[str], None]
) -> None:
    whole, reference = run_once(tmp_path / "whole")
    assert len(reference) > 25
    for number in range(len(reference)):
        folder = tmp_path / str(number)
        with pytest.MonkeyPatch.context() as patch, open_mock_bench() as bench:
            runner = prepare(bench, PLAN, folder)
            at_call(number, fault, patch)
            # In the safe state after the last step it is the failure to make the bench safe that is raised.
            with pytest.raises((DeviceError, StepsFailedError, KeyboardInterrupt, SystemExit)):
                runner.execute()
            assert_safe(bench)
        run = Run.open(runner.path)
        in_safe_state = number >= len(reference) - len(SAFE)
        ended = {RunCondition.FAILED} if fault is device_fault else {RunCondition.ABORTED}
        # Every frame was there already when the fault came in the safe state after the last step.
        assert run.condition in (ended if not in_safe_state else ended | {RunCondition.COMPLETED})
        assert verify(run).is_sound
        with open_mock_bench() as bench:
            taken = len(run.records)
            run = prepare_resume(bench, run.path).execute()
            exposures = calls(bench).count("camera.snap")
        assert run.condition is RunCondition.COMPLETED
        assert sorted(run.records) == list(range(len(PLAN)))
        assert exposures == sum(step.average for step in PLAN.steps() if step.index >= taken)
        for index in range(len(PLAN)):
            ours, theirs = run.metadata(index), whole.metadata(index)
            assert (ours.exposure_ms, ours.gain) == (theirs.exposure_ms, theirs.gain)
            assert (ours.stage_position, ours.led_pattern) == (theirs.stage_position, theirs.led_pattern)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_disk_that_fails_at_any_write_loses_nothing_that_was_written(tmp_path: Path, code: int) -> None:
    """The n-th fsync of the run fails; afterwards the disk works again and the run goes on."""
    original = os.fsync
    count, number, finished = 0, 0, False

    def failing(handle: int) -> None:
        nonlocal count
        count += 1
        if count >= number:
            raise OSError(code, os.strerror(code))
        original(handle)

    stride = 7 if code == errno.ENOSPC else 19  # every kind of write is met; all of them would take minutes
    while not finished:
        number += stride
        with open_mock_bench() as bench:
            runner = prepare(bench, PLAN, tmp_path / str(number))
            with pytest.MonkeyPatch.context() as patch:
                count = 0
                patch.setattr(os, "fsync", failing)
                try:
                    runner.execute()
                    finished = True
                except RunError as error:
                    said = str(error)
                else:
                    said = os.strerror(code)
            assert os.strerror(code) in said
            assert_safe(bench)
        run = Run.open(runner.path)
        frames = {i: run.array.chunk_path(i).read_bytes() for i in run.records}
        assert all(run.verify(i) is None for i in run.records)
        if run.condition is RunCondition.COMPLETED:
            continue
        with open_mock_bench() as bench:
            run = prepare_resume(bench, run.path).execute()
        assert run.missing() == []
        assert all(run.array.chunk_path(i).read_bytes() == data for i, data in frames.items())
        assert verify(run).is_sound
    assert number > 50


def test_the_message_of_a_full_disk_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_mock_bench() as bench:
        runner = prepare(bench, PLAN, tmp_path)

        def full(*_: object) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(RunError, match=r"No space left.*Free some disk space.*resume"):
            runner.execute()


def test_a_stage_that_fails_mid_run_loses_nothing(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch, open_mock_bench() as bench:
        runner = prepare(bench, PLAN, tmp_path)
        moves: list[str] = []

        def stall(name: str) -> None:
            raise DeviceError(name, "stalled.", "Free its way.")

        original = MockDevice._call

        def call(self: MockDevice, method: str) -> None:
            original(self, method)
            if method == "move_to":
                moves.append(method)
                if len(moves) == 2:
                    stall("stage (mock)")

        patch.setattr(MockDevice, "_call", call)
        with pytest.raises(DeviceError, match=r"stalled.*Free its way") as caught:
            runner.execute()
    assert f"5 of {len(PLAN)} frames are kept. For the others: diffuserbench resume" in "".join(
        caught.value.__notes__
    )
    run = Run.open(runner.path)
    assert sorted(run.records) == [0, 1, 2, 3, 4]
    assert "stalled" in run.error
    assert np.all(run.frame(4) > 0)


@pytest.mark.parametrize("deleted", [".", ".."])
def test_a_run_whose_folder_is_deleted_meanwhile_ends_dark_and_says_so(tmp_path: Path, deleted: str) -> None:
    def delete(status: RunStatus) -> None:
        if status.done == 3:
            shutil.rmtree((runner.path / deleted).resolve(), ignore_errors=True)

    with open_mock_bench() as bench:
        runner = prepare(bench, PLAN, tmp_path / "runs", on_progress=delete)
        with pytest.raises(RunError) as caught:
            runner.execute()
        assert_safe(bench)
    assert "which is gone or moved" in "".join(caught.value.__notes__)
    assert "no run folder" not in str(caught.value)


def test_a_run_whose_folder_is_moved_meanwhile_keeps_what_its_log_says(tmp_path: Path) -> None:
    moved = tmp_path / "moved"

    def move(status: RunStatus) -> None:
        if status.done == 3 and runner.path.exists():
            runner.path.rename(moved)

    with open_mock_bench() as bench:
        runner = prepare(bench, PLAN, tmp_path / "runs", on_progress=move)
        with pytest.raises(RunError, match="deleted or moved meanwhile") as caught:
            runner.execute()
        assert_safe(bench)
    assert "which is gone or moved" in "".join(caught.value.__notes__)
    assert not runner.path.exists(), "nothing is made anew under the old name"
    run = Run.open(moved)
    assert 3 <= len(run.records) < len(PLAN)
    assert all(run.frame(index).size for index in run.records)
