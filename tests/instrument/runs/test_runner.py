"""A runner does every step once, can be paused, aborted and stopped, and always leaves the bench safe."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from drivers.errors import DeviceError, DeviceLostError
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.bench.safety import StepsFailedError
from instrument.files.errors import BenchError
from instrument.plan import SOURCE, Light, Part, Plan, PlanError, SourcePoints
from instrument.runs.acquire import abilities_of, acquire, prepare
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.runner import Runner, RunState, RunStatus, StepSettings
from instrument.runs.writer import RunWriter
from tests.mocks.devices import MockDevice, MockWorld

pytestmark = pytest.mark.usefixtures("mock_drivers")

KINDS = ("camera", "stage", "led_array", "slm")
SAFE = ["led_array.off", "stage.stop", "camera.stop_sequence", "slm.display"]


def open_mock_bench(kinds: Sequence[str] = KINDS) -> Bench:
    tables = "".join(f'[{kind}]\ndriver = "mock"\n' for kind in kinds)
    return Bench(parse_config(f'[scene]\ncontrol = "simulated"\n{tables}', None)).open()


def calls(bench: Bench) -> list[str]:
    world = bench.shared["mock"]
    assert isinstance(world, MockWorld)
    return world.calls


def plan(n: int = 4, **changes: object) -> Plan:
    points = SourcePoints(points_um=tuple((0, 0, 10.0 * i) for i in range(n)))
    part = {"label": "psf", "light": "source", "positions": points, "exposure_ms": 20} | changes
    return Plan(label="sweep", parts=(Part(label="dark", average=2), Part.model_validate(part)))


def on_call(monkeypatch: pytest.MonkeyPatch, act: Callable[[str, int], None]) -> None:
    """Have ``act(call, how many of it)`` run before each call of a mock device."""
    seen: dict[str, int] = {}
    original = MockDevice._call

    def call(self: MockDevice, method: str) -> None:
        name = f"{self.kind}.{method}"
        seen[name] = seen.get(name, 0) + 1
        original(self, method)
        act(name, seen[name])

    monkeypatch.setattr(MockDevice, "_call", call)


def test_every_step_is_done_once_and_stored(tmp_path: Path) -> None:
    reports: list[RunStatus] = []
    with open_mock_bench() as bench:
        run = acquire(bench, plan(), tmp_path, on_progress=reports.append)
        moves = [c for c in calls(bench) if c == "stage.move_to"]
        assert calls(bench)[-4:] == SAFE
    assert run.reason is FinishReason.COMPLETED
    assert run.missing() == []
    assert len(moves) == 4
    assert [run.metadata(i).stage_position["z_um"] for i in range(1, 5)] == [0, 10, 20, 30]
    assert run.metadata(0).led_pattern == "off"
    assert run.metadata(1).led_pattern.startswith("point source")
    assert run.records[0].average == 2
    assert run.images("psf").shape == (4, 24, 32)
    assert run.images("dark").dtype == np.float32
    assert reports[-1].state is RunState.FINISHED
    assert [r.done for r in reports] == sorted(r.done for r in reports)
    assert reports[-1].done == reports[-1].total == 5
    assert reports[-1].dropped == 2 + 4  # the mock camera says that it drops one before each frame


def test_settings_that_stay_are_set_once(tmp_path: Path) -> None:
    with open_mock_bench() as bench:
        acquire(bench, plan(), tmp_path)
        assert calls(bench).count("camera.set_exposure_ms") == 1
        assert calls(bench).count("led_array.set_pattern") == 1


def test_a_plan_out_of_reach_moves_and_writes_nothing(tmp_path: Path) -> None:
    far = Plan(label="far", parts=(Part(label="a", positions=SourcePoints(points_um=((500, 0, 0),))),))
    with open_mock_bench() as bench:
        before = list(calls(bench))
        with pytest.raises(PlanError, match="x_um = 500"):
            acquire(bench, far, tmp_path / "runs")
        assert calls(bench) == before
    assert not (tmp_path / "runs").exists()


def test_a_plan_that_needs_an_operator_is_refused_before_it_starts(tmp_path: Path) -> None:
    bench = Bench(parse_config('[camera]\ndriver = "mock"\n', None))
    with bench.open(), pytest.raises(PlanError) as caught:
        acquire(bench, Plan(label="a", parts=(Part(label="a", scene_lit=True),)), tmp_path)
    assert len(caught.value.problems) == 2


FAULTS = ["camera.snap", "stage.move_to", "led_array.set_pattern", "camera.set_exposure_ms"]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("error", [DeviceError("x", "unplugged."), KeyboardInterrupt()])
def test_whatever_fails_the_bench_is_safe_and_the_run_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str, error: BaseException
) -> None:
    with open_mock_bench() as bench:

        def fail(name: str, count: int) -> None:
            if name == fault and (count == 3 or fault not in ("camera.snap", "stage.move_to")):
                raise error

        on_call(monkeypatch, fail)
        runner = prepare(bench, plan(), tmp_path)
        with pytest.raises(type(error)) as caught:
            runner.execute()
        assert calls(bench)[-4:] == SAFE
    (path,) = tmp_path.iterdir()
    assert str(path) in str(caught.value.__notes__)
    interrupted = isinstance(error, KeyboardInterrupt)
    assert runner.status.reason is (FinishReason.ABORTED if interrupted else FinishReason.FAILED)


def test_a_run_whose_led_array_is_lost_fails_and_keeps_only_the_frames_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = open_mock_bench()
    leds = bench.led_array
    assert isinstance(leds, MockDevice)

    def lose(name: str, count: int) -> None:
        if name == "camera.snap" and count == 4:  # two dark frames, then the second of the PSF
            leds._open = False

    on_call(monkeypatch, lose)
    runner = prepare(bench, plan(), tmp_path)
    with pytest.raises(DeviceLostError, match=r"led_array \(mock\): was lost") as caught, bench:
        runner.execute()
    assert "The light may be on" in "".join(caught.value.__notes__)
    run = Run.open(runner.path)
    assert run.condition is RunCondition.FAILED
    assert sorted(run.records) == [0, 1]


def test_a_second_ctrl_c_before_the_ending_begins_skips_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end, reasons = Runner._end, []

    def interrupted_end(self: Runner, reason: FinishReason, error: BaseException | None = None) -> Run:
        reasons.append(reason)
        if len(reasons) == 1:
            raise KeyboardInterrupt
        return end(self, reason, error)

    monkeypatch.setattr(Runner, "_end", interrupted_end)
    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path)
        with pytest.raises(KeyboardInterrupt):
            runner.execute()
        assert calls(bench)[-4:] == SAFE
    assert reasons == [FinishReason.COMPLETED, FinishReason.ABORTED]
    assert Run.open(runner.path).condition is RunCondition.ABORTED


@pytest.mark.parametrize("pressed_before", [True, False])
def test_a_ctrl_c_while_the_run_is_closed_waits_until_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pressed_before: bool
) -> None:
    note = RunWriter.note

    def interrupted_note(self: RunWriter, kind: str, **fields: object) -> None:
        note(self, kind, **fields)
        if kind == "finished":
            signal.raise_signal(signal.SIGINT)

    def press(name: str, count: int) -> None:
        if pressed_before and (name, count) == ("camera.snap", 3):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RunWriter, "note", interrupted_note)
    on_call(monkeypatch, press)
    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path)
        with pytest.raises(KeyboardInterrupt) as caught:
            runner.execute()
        assert calls(bench)[-4:] == SAFE
    assert str(runner.path) in str(caught.value.__notes__)
    ended = RunCondition.ABORTED if pressed_before else RunCondition.COMPLETED
    assert Run.open(runner.path).condition is ended


@pytest.mark.parametrize("kept", [0, 2])
def test_a_listener_that_keeps_raising_ctrl_c_cannot_keep_the_run_from_being_marked_as_aborted(
    tmp_path: Path, kept: int
) -> None:
    def pass_on(status: RunStatus) -> None:  # as the demo does: once pressed, every report raises
        if status.done >= kept:
            raise KeyboardInterrupt

    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path, on_progress=pass_on)
        with pytest.raises(KeyboardInterrupt) as caught:
            runner.execute()
        assert calls(bench)[-4:] == SAFE
    run = Run.open(runner.path)
    assert run.condition is RunCondition.ABORTED
    assert len(run.records) == kept
    assert str(runner.path) in str(caught.value.__notes__)


def test_ctrl_c_at_the_last_report_is_passed_on_and_the_run_is_complete(tmp_path: Path) -> None:
    def pass_on(status: RunStatus) -> None:
        if status.state is RunState.ENDING:
            raise KeyboardInterrupt

    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path, on_progress=pass_on)
        with pytest.raises(KeyboardInterrupt):
            runner.execute()
        assert calls(bench)[-4:] == SAFE
    assert Run.open(runner.path).condition is RunCondition.COMPLETED


def test_every_safe_step_is_tried_and_the_first_error_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_mock_bench() as bench:
        broken = {"camera.snap", "led_array.off", "stage.stop"}

        def fail(name: str, _: int) -> None:
            if name in broken:
                raise DeviceError(name, "broke.")

        with monkeypatch.context() as patch:
            on_call(patch, fail)
            runner = prepare(bench, Plan(label="a", parts=(Part(label="a", light=(SOURCE,)),)), tmp_path)
            with pytest.raises(DeviceError, match=r"camera.snap: broke") as caught:
                runner.execute()
        assert calls(bench)[-4:] == SAFE
    notes = "\n".join(caught.value.__notes__)
    assert "led_array.off: broke" in notes
    assert "stage.stop: broke" in notes


def test_abort_ends_between_steps(tmp_path: Path) -> None:
    with open_mock_bench() as bench:

        def abort(status: RunStatus) -> None:
            if status.done == 2:
                runner.abort()

        runner = prepare(bench, plan(), tmp_path, on_progress=abort)
        run = runner.execute()
        assert calls(bench)[-4:] == SAFE
    assert run.condition is RunCondition.ABORTED
    assert sorted(run.records) == [0, 1]


def test_pause_darkens_and_resume_goes_on_where_it_was(tmp_path: Path) -> None:
    paused = threading.Event()

    def report(status: RunStatus) -> None:
        if status.done == 3 and status.state is RunState.RUNNING and not paused.is_set():
            runner.pause()
        if status.state is RunState.PAUSED:
            paused.set()

    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path, on_progress=report)
        thread = threading.Thread(target=runner.execute)
        thread.start()
        assert paused.wait(10)
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
        assert runner.status.done == 3
        runner.resume()
        thread.join(10)
        assert not thread.is_alive()
    assert runner.status.reason is FinishReason.COMPLETED
    assert runner.status.done == 5
    assert [e["kind"] for e in Run.open(runner.path).events if e["kind"] in ("paused", "resumed")] == [
        "paused",
        "resumed",
    ]


def test_stop_during_an_exposure_keeps_no_frame_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposing, stopped = threading.Event(), threading.Event()
    with open_mock_bench() as bench:

        def hang(name: str, count: int) -> None:
            if name == "camera.snap" and count == 4:
                exposing.set()
                assert stopped.wait(10)
            if name == "camera.stop_sequence" and exposing.is_set():
                stopped.set()

        on_call(monkeypatch, hang)
        runner = prepare(bench, plan(), tmp_path)
        runs: list[object] = []
        thread = threading.Thread(target=lambda: runs.append(runner.execute()))
        thread.start()
        assert exposing.wait(10)
        runner.stop()
        thread.join(10)
        assert not thread.is_alive()
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
    (run,) = runs
    assert run.reason is FinishReason.STOPPED  # type: ignore[attr-defined]
    assert sorted(run.records) == [0, 1]  # type: ignore[attr-defined]


def test_stop_from_the_executing_thread_itself_does_not_wait_for_itself(tmp_path: Path) -> None:
    with open_mock_bench() as bench:
        runner = prepare(
            bench, plan(), tmp_path, on_progress=lambda s: runner.stop() if s.done == 1 else None
        )
        run = runner.execute()
    assert run.reason is FinishReason.STOPPED


def test_repeats_wait_for_their_interval_dark(tmp_path: Path) -> None:
    interval_s = 4.0
    lapse = Plan(label="lapse", parts=(Part(label="a", light=(SOURCE,), repeats=2, interval_s=interval_s),))
    with open_mock_bench() as bench:
        run = acquire(bench, lapse, tmp_path)
        between = calls(bench)[calls(bench).index("camera.snap") :]
        assert between[:4] == ["camera.snap", "led_array.off", "led_array.set_pattern", "camera.snap"]
    times = [run.metadata(i).host_time_ns for i in range(2)]
    assert times[1] - times[0] > 0.9 * interval_s * 1e9


def test_stop_tries_again_until_the_run_has_ended_and_names_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposing, stopped = threading.Event(), threading.Event()
    with open_mock_bench() as bench:

        def hang(name: str, count: int) -> None:
            if name == "camera.snap" and count == 3:
                exposing.set()
                assert stopped.wait(10)
            if name == "camera.stop_sequence" and count == 3:
                stopped.set()
            if name == "stage.stop" and count == 1:
                raise DeviceError("stage (mock)", "did not answer.")

        on_call(monkeypatch, hang)
        runner = prepare(bench, plan(), tmp_path)
        thread = threading.Thread(target=runner.execute)
        thread.start()
        assert exposing.wait(10)
        with pytest.raises(StepsFailedError, match="did not answer"):
            runner.stop()
        thread.join(10)
        assert not thread.is_alive()
    assert runner.status.reason is FinishReason.STOPPED


def test_a_runner_executes_once(tmp_path: Path) -> None:
    with open_mock_bench() as bench:
        runner = prepare(bench, plan(), tmp_path)
        runner.execute()
        with pytest.raises(RuntimeError, match="once"):
            runner.execute()


@pytest.mark.parametrize("asked", ["pause", "abort", "stop", ""])
def test_what_was_asked_of_a_control_before_a_run_holds_for_it(asked: str) -> None:
    control, runner = RunControl(), Mock()
    getattr(control, asked, bool)()
    control.follow(runner)
    assert [name for name in ("pause", "abort", "stop") if getattr(runner, name).called] == [asked] * bool(
        asked
    )


def test_a_bench_of_a_camera_has_nothing_else() -> None:
    with open_mock_bench(["camera"]) as bench:
        able = abilities_of(bench)
        assert (able.n_leds, able.slm_shape, able.stage_axes, able.slm_settle_ms) == (0, None, (), 0.0)


def test_darkening_leaves_alone_what_no_step_has_lit() -> None:
    with open_mock_bench() as bench:
        before = list(calls(bench))
        StepSettings(bench).darken()
        assert calls(bench) == before


def test_what_a_bench_lacks_is_said_when_a_step_needs_it() -> None:
    with open_mock_bench(["camera"]) as bench:
        settings, red = StepSettings(bench), Light(kind="pattern", leds=((0, 255, 0, 0),))
        for call, lacking in (
            (lambda: settings._move_stage({"x_um": 1.0}), "no stage"),
            (lambda: settings._display(Path("a.png")), "no SLM"),
            (lambda: settings._set_light(red), "no LED array"),
        ):
            with pytest.raises(BenchError, match=lacking):
                call()
