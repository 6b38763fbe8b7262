"""What a runner counts, waits for and writes, on a bench of mocks and without a disk."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from drivers.errors import LimitError, StoppedError
from instrument.bench.bench import Bench
from instrument.files.atomic import free_bytes, there_now
from instrument.files.errors import FileError
from instrument.plan import Light, Plan, Step
from instrument.runs import runner as module
from instrument.runs.acquire import abilities_of, prepare, record_of
from instrument.runs.run import FinishReason
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.runner import Runner, RunState, RunStatus, StepSettings, discarded
from tests.instrument.runs.test_runner import calls, open_mock_bench, plan

pytestmark = pytest.mark.usefixtures("mock_drivers")


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_mock_bench() as bench:
        yield bench


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> list[FinishReason]:
    """Has the end of a run write nothing; returns why each ended."""
    reasons: list[FinishReason] = []

    def end_run(_bench: Bench, _writer: Any, reason: FinishReason, _error: object) -> Any:
        reasons.append(reason)
        return SimpleNamespace(records=(), n_frames=0, path="runs/one", reason=reason)

    monkeypatch.setattr(module, "end_run", end_run)
    return reasons


def made(bench: Bench, plan: Plan, **kind: Any) -> tuple[Runner, Any]:
    writer = Mock(path=Path("runs/one"), mended=())
    return Runner(bench, plan, writer, **kind), writer


def notes(writer: Any) -> list[str]:
    return [call.args[0] for call in writer.note.call_args_list]


def test_what_is_done_is_counted_and_the_rest_estimated(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, seen = [1000.0], list[RunStatus]()
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def progress(status: RunStatus) -> None:
        if status.newest is not None and (not seen or status.done > seen[-1].done):
            seen.append(status)
        now_s[0] += 1.0

    runner, writer = made(bench, plan(), todo=[1, 2, 4], on_progress=progress)
    assert (runner.status.state, runner.status.done, runner.status.total) == (RunState.IDLE, 2, 5)
    assert runner.mended == ()
    runner.execute()
    assert ended == [FinishReason.COMPLETED]
    writer.start.assert_called_once_with(steps=3)
    stored = [[frame.index for frame in call.args[0]] for call in writer.write.call_args_list]
    assert stored == [[1], [2], [4]]
    assert [(s.done, s.done_here, s.dropped) for s in seen] == [(3, 1, 1), (4, 2, 2), (5, 3, 3)]
    for s in seen:
        assert 0 < s.seconds < 100
        assert s.seconds_left == pytest.approx(s.seconds / s.done_here * (3 - s.done_here))
    assert runner.status.reason is FinishReason.COMPLETED


@pytest.mark.parametrize("todo", [[0, 1, 2], [2], [3, 4], [1, 2, 4, 5]])
def test_a_part_that_goes_on_does_not_wait_for_what_was_done_before(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch, todo: list[int]
) -> None:
    part = {"label": "a", "light": "off", "repeats": 3, "interval_s": 600.0}
    whole = Plan.model_validate({"label": "p", "parts": [part, {**part, "label": "b"}]})
    runner, _ = made(bench, whole, todo=todo)
    waits_s: list[float] = []
    monkeypatch.setattr(runner, "_wait_until", lambda when_s: waits_s.append(when_s - time.monotonic()))
    runner.execute()
    first = {index // 3: index % 3 for index in reversed(todo)}
    expected = [600.0 * (index % 3 - first[index // 3]) for index in todo]
    assert waits_s == pytest.approx(expected, abs=200.0)
    assert ended == [FinishReason.COMPLETED]


@pytest.mark.parametrize("how", ["resume", "abort", "stop"])
def test_a_paused_run_waits_in_the_dark_until_it_is_told_to_go_on_or_to_end(
    bench: Bench, ended: list[FinishReason], how: str
) -> None:
    paused, seen = threading.Event(), list[RunState]()

    def progress(status: RunStatus) -> None:
        seen.append(status.state)
        if status.state is RunState.PAUSED:
            paused.set()

    runner, writer = made(bench, plan(1), on_progress=progress)
    runner.pause()
    assert runner.is_pausing
    thread = threading.Thread(target=runner.execute)
    thread.start()
    assert paused.wait(20)
    time.sleep(0.03)
    assert notes(writer) == ["paused"]
    assert "camera.snap" not in calls(bench)
    getattr(runner, how)()
    thread.join(20)
    assert notes(writer) == ["paused", "resumed"]
    reasons = {"resume": FinishReason.COMPLETED, "abort": FinishReason.ABORTED, "stop": FinishReason.STOPPED}
    assert ended == [reasons[how]]
    assert calls(bench).count("camera.snap") == (3 if how == "resume" else 0)  # a dark mean of two, a PSF
    assert runner.is_pausing == (how != "resume")
    assert seen[:3] == [RunState.RUNNING, RunState.PAUSED, RunState.RUNNING]


@pytest.mark.parametrize("asked", ["pause", "abort", "stop"])
def test_an_interval_is_waited_for_in_the_dark_and_ended_by_what_is_asked(
    bench: Bench, ended: list[FinishReason], asked: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = {"label": "a", "light": "source", "repeats": 2, "interval_s": 600.0}
    runner, writer = made(bench, Plan.model_validate({"label": "p", "parts": [part]}))
    wait_for, asleep = runner._condition.wait_for, threading.Event()

    def waits(*asked: Any) -> bool:
        asleep.set()  # what is asked for from now on has to wait until it sleeps
        return wait_for(*asked)

    monkeypatch.setattr(runner._condition, "wait_for", waits)
    thread = threading.Thread(target=runner.execute)
    thread.start()
    deadline_s = time.monotonic() + 20
    assert asleep.wait(20)
    assert "led_array.off" in calls(bench)
    assert calls(bench).count("camera.snap") == 1
    getattr(runner, asked)()
    if asked == "pause":
        while not notes(writer) and time.monotonic() < deadline_s:
            time.sleep(0.001)
        assert notes(writer) == ["paused"]
        runner.abort()
    thread.join(20)
    assert ended == [FinishReason.STOPPED if asked == "stop" else FinishReason.ABORTED]
    assert calls(bench).count("camera.snap") == 1


@pytest.mark.parametrize("during", ["before", "a setting", "the exposures"])
@pytest.mark.parametrize("takes", ["_take", "_take_sequence"])
def test_nothing_is_taken_once_stop_was_asked_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, during: str, takes: str
) -> None:
    runner, _ = made(bench, plan(2))
    steps, done = list(plan(2).whole_steps()), list[str]()

    def do(what: str) -> Any:
        done.append(what)
        if what == during:
            runner._stopping.set()
        return [], ()

    monkeypatch.setattr(StepSettings, "actions", lambda *_, **__: [lambda: do("a setting")])
    monkeypatch.setattr(module, "take_steps", lambda *_: do("the exposures"))
    monkeypatch.setattr(bench, "snap", lambda *_: do("the exposures"))
    if during == "before":
        runner._stopping.set()
    wire = SimpleNamespace(source=bench.led_array)
    with pytest.raises(module._EndedEarlyError) as caught:
        runner._take(steps[0]) if takes == "_take" else runner._take_sequence(wire, steps)  # type: ignore[arg-type]
    assert caught.value.reason is FinishReason.STOPPED
    assert done == {"before": [], "a setting": ["a setting"]}.get(during, ["a setting", "the exposures"])


def test_a_bench_is_read_once_for_what_plans_are_checked_against(bench: Bench, tmp_path: Path) -> None:
    found = abilities_of(bench, tmp_path / "runs" / "of today")
    assert (found.has_trigger_wire, found.stage_homed, found.n_leds > 1) == (False, True, True)
    assert found.stage_target is not None
    assert found.stage_target((1.0, 0.0, 2.0)) == {"x_um": 1.0, "z_um": 2.0}
    assert found.free_bytes is not None
    assert found.free_bytes > 0
    assert abilities_of(bench).free_bytes is None
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(FileError, match="is a file, not a folder"):
            free_bytes(folder)


def in_one_sequence(monkeypatch: pytest.MonkeyPatch, bench: Bench, runner: Runner, answer: Any) -> None:
    """Have all steps go into one sequence over a wire; what is answered when it is taken."""
    wire: Any = SimpleNamespace(source=bench.led_array)
    monkeypatch.setattr(runner._timed, "groups", lambda steps: [(wire, list(steps))])
    monkeypatch.setattr(module, "take_steps", answer)


def refused(*_: object) -> Any:
    raise LimitError("led_array (mock)", "plays no such sequence.")


def test_a_refused_sequence_is_taken_step_by_step_and_the_run_says_so(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int | None] = []
    runner, writer = made(bench, plan(3), todo=[1, 2, 3])
    runner.on_progress = lambda status: shown.append(status.step and status.step.index)
    in_one_sequence(monkeypatch, bench, runner, refused)
    runner.execute()
    assert ended == [FinishReason.COMPLETED]
    writer.note.assert_called_once_with(
        "stepped", text="led_array (mock): plays no such sequence.", first=1, steps=3
    )
    assert shown == [None, 1, 1, 2, 2, 3, 3, 3, 3]  # each before it is taken and once it is stored
    assert calls(bench).count("camera.snap") == 3


def test_an_abort_between_the_steps_of_a_refused_sequence_is_heeded(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, _ = made(bench, plan(3), todo=[1, 2, 3], on_frame=lambda step, _: runner.abort() is not None)
    in_one_sequence(monkeypatch, bench, runner, refused)
    runner.execute()
    assert ended == [FinishReason.ABORTED]
    assert calls(bench).count("camera.snap") == 1


@pytest.mark.parametrize(("used", "times"), [(True, 3), (False, 1), (None, 1)])
def test_what_a_watcher_has_used_is_set_anew(
    bench: Bench, ended: list[FinishReason], used: bool | None, times: int
) -> None:
    runner, _ = made(bench, plan(3), todo=[1, 2, 3], on_frame=lambda *_: used)
    runner.execute()
    assert ended == [FinishReason.COMPLETED]
    assert calls(bench).count("camera.set_exposure_ms") == times


def test_a_refused_sequence_that_must_be_timed_by_hardware_ends_the_run(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, _ = made(bench, plan(3, timing="hardware"), todo=[1, 2, 3])
    in_one_sequence(monkeypatch, bench, runner, refused)
    with pytest.raises(LimitError, match="no such sequence"):
        runner.execute()
    assert ended == [FinishReason.FAILED]
    assert "camera.snap" not in calls(bench)


def test_a_sequence_that_was_taken_again_is_noted_with_its_steps(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, writer = made(bench, plan(3), todo=[1, 2, 3])
    in_one_sequence(monkeypatch, bench, runner, lambda *_: ([bench.snap() for _ in range(3)], ["one lost"]))
    runner.execute()
    writer.note.assert_called_once_with("sequence taken again", text="one lost", first=1, steps=3)
    runner.keep_text("more.txt", "what a routine knows")
    writer.keep_text.assert_called_once_with("more.txt", "what a routine knows")
    assert ended == [FinishReason.COMPLETED]


def test_after_a_sequence_the_light_is_set_anew(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, _ = made(bench, plan(1, light="source"), todo=[1])
    step = list(plan(1).whole_steps())[1]
    runner._take(step)  # as the step before the sequence left it
    in_one_sequence(monkeypatch, bench, runner, lambda *_: ([bench.snap()], ()))
    runner.execute()
    assert ended == [FinishReason.COMPLETED]
    lit = calls(bench).count("led_array.set_pattern")
    runner._take(step)
    assert calls(bench).count("led_array.set_pattern") == lit + 1


def test_a_camera_that_was_stopped_by_nobody_here_fails_the_run(
    bench: Bench, ended: list[FinishReason], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise StoppedError("camera (mock)", "its exposure was ended.")

    monkeypatch.setattr(bench, "snap", stopped)
    runner, _ = made(bench, plan(1))
    with pytest.raises(StoppedError):
        runner.execute()
    assert ended == [FinishReason.FAILED]


def test_an_interval_is_slept_through_to_its_end(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, slept_s = [100.0], list[float]()

    def sleep(_: object, left_s: float) -> None:
        slept_s.append(left_s)
        now_s[0] += min(left_s, 0.75)

    runner, _ = made(bench, plan(1))
    ticks = iter(range(20))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0] + 0 * next(ticks)))
    monkeypatch.setattr(runner._condition, "wait_for", sleep)
    runner._wait_until(102.0)
    assert slept_s == [2.0, 1.25, 0.5]


def test_a_step_brings_light_and_stage_to_what_it_says(bench: Bench) -> None:
    settings = StepSettings(bench)
    assert bench.led_array is not None
    assert bench.stage is not None
    settings._set_light(Light(kind="source"))
    assert not bench.led_array.pattern.is_dark
    settings._move_stage({"z_um": 20.0})
    assert bench.stage.position()["z_um"] == 20.0
    settings._set_light(Light(kind="off"))
    assert bench.led_array.pattern.is_dark


def test_only_what_differs_is_set_and_a_move_forgets_where_stage_and_source_were() -> None:
    bench = Mock()
    settings = StepSettings(bench)
    names = "exposure_ms", "gain", "source_um", "stage", "slm_image", "scene_lit", "light"

    def done(**wanted: Any) -> list[str]:
        bench.reset_mock()
        for action in settings.actions(cast(Step, SimpleNamespace(**dict.fromkeys(names) | wanted))):
            action()
        return [name for name, *_ in bench.mock_calls]

    here, moved, placed = (0.0, 0.0, 1.0), ["stage.move_to"], ["place_source"]
    assert done(scene_lit=True, source_um=here) == [*placed, "scene_on"]
    assert done(scene_lit=True, source_um=here, exposure_ms=1.0) == ["camera.set_exposure_ms"]
    assert done(scene_lit=False, source_um=here) == ["scene_off"]
    assert done(stage={"z_um": 1.0}) == moved
    assert done(stage={"z_um": 1.0}) == []
    assert done(source_um=here) == placed
    assert done(stage={"z_um": 1.0}) == moved


def test_a_run_that_is_not_carried_out_is_closed(bench: Bench) -> None:
    runner, writer = made(bench, plan())
    with pytest.raises(ZeroDivisionError), discarded(runner):
        raise ZeroDivisionError
    writer.close.assert_called_once_with()
    with discarded(runner):
        pass
    writer.close.assert_called_once_with()


def test_a_run_keeps_the_pitch_of_the_pixels_that_it_stores(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    pitch_um = bench.camera.pixel_pitch_um
    monkeypatch.setattr(type(bench.camera), "binning", 4)
    assert record_of(bench).pixel_pitch_um == 4 * pitch_um


def test_what_is_to_be_stopped_before_it_began_makes_no_run(bench: Bench, tmp_path: Path) -> None:
    control = RunControl()
    control.abort()
    with pytest.raises(EndedEarlyError):
        prepare(bench, plan(1), tmp_path, control=control)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_where_nothing_can_be_kept_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    assert there_now(tmp_path / "a" / "b") == tmp_path
    with pytest.raises(FileError, match="file is a file, not a folder; nothing can be kept there"):
        free_bytes(tmp_path / "file" / "runs")
    monkeypatch.setattr(os, "access", lambda there, mode: there != tmp_path or mode != os.W_OK)
    with pytest.raises(FileError, match=f"you may not write to {tmp_path}; nothing can be kept there"):
        free_bytes(tmp_path / "runs")
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY | os.ST_NOSUID))
    with pytest.raises(FileError, match=f"{tmp_path} is on a read-only disk; nothing can be kept there"):
        free_bytes(tmp_path / "runs")
    monkeypatch.setattr(Path, "exists", lambda _: False)
    with pytest.raises(FileError, match="not even its disk"):
        there_now(tmp_path)
