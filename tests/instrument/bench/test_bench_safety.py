"""Whatever fails: the light goes off, motion stops, every device is closed, and what failed is named."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import fmean, stdev
from types import SimpleNamespace

import pytest

from drivers.errors import DeviceError, DeviceLostError, LimitError, StoppedError
from drivers.sequence import SequenceLimits
from instrument.bench import bench as bench_module
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.bench.safety import StepsFailedError, note_failures, stop_until, try_all
from instrument.files.errors import BenchError, OperatorNeededError
from instrument.runs.run_control import RunControl
from tests.mocks.devices import MockCamera, MockDevice, MockLedArray, MockWorld

pytestmark = pytest.mark.usefixtures("mock_drivers")

KINDS = ("camera", "stage", "led_array", "slm")
SAFE_STEPS = ["led_array.off", "stage.stop", "camera.stop_sequence", "slm.display"]
CLOSING = ["slm.close", "led_array.close", "stage.close", "camera.close"]


def bench_with(
    faults: dict[str, Sequence[str]] | None = None,
    *,
    interrupts: dict[str, Sequence[str]] | None = None,
    extra: str = "",
    kinds: Sequence[str] = KINDS,
) -> Bench:
    text = extra
    for kind in kinds:
        fail, interrupt = list((faults or {}).get(kind, ())), list((interrupts or {}).get(kind, ()))
        text += f'\n[{kind}]\ndriver = "mock"\nfail = {fail}\ninterrupt = {interrupt}\n'
    return Bench(parse_config(text, None))


def calls(bench: Bench) -> list[str]:
    world = bench.shared["mock"]
    assert isinstance(world, MockWorld)
    return world.calls


def test_devices_open_in_order_and_close_safe_in_reverse() -> None:
    with bench_with().open() as bench:
        opened = list(calls(bench))
    assert opened == [f"{kind}.open" for kind in KINDS]
    assert calls(bench)[len(opened) :] == SAFE_STEPS + CLOSING


@pytest.mark.parametrize("kind", KINDS)
def test_a_device_that_does_not_open_is_named_and_the_others_are_closed(kind: str) -> None:
    bench = bench_with({kind: ["open"]})
    with pytest.raises(DeviceError, match=rf"{kind} \(mock\): open failed"):
        bench.open()
    assert not any(device.is_open for device in bench.devices.values())
    assert all(call in calls(bench) for call in CLOSING)


FAULTS = {
    "led_array": ["off", "close"],
    "stage": ["stop", "close"],
    "camera": ["stop_sequence", "close"],
    "slm": ["display", "close"],
}


@pytest.mark.parametrize(("kind", "method"), [(k, m) for k, methods in FAULTS.items() for m in methods])
@pytest.mark.parametrize("how", ["fail", "interrupt"])
def test_every_step_is_tried_even_when_one_fails(kind: str, method: str, how: str) -> None:
    fault = {kind: [method]}
    bench = bench_with(fault).open() if how == "fail" else bench_with(interrupts=fault).open()
    with pytest.raises(StepsFailedError if how == "fail" else KeyboardInterrupt) as caught:
        bench.close()
    assert calls(bench)[len(KINDS) :] == SAFE_STEPS + CLOSING
    told = str(caught.value) + "".join(getattr(caught.value, "__notes__", ()))
    assert f"{kind} (mock)" in told


def test_when_everything_fails_everything_is_still_tried_and_named() -> None:
    bench = bench_with(FAULTS).open()
    with pytest.raises(StepsFailedError) as caught:
        bench.close()
    assert calls(bench)[len(KINDS) :] == SAFE_STEPS + CLOSING
    assert len(caught.value.failures) == 8


def test_the_first_interruption_is_the_one_that_is_raised_once_all_was_tried() -> None:
    tried: list[str] = []

    def step(name: str, error: BaseException | None) -> tuple[str, Callable[[], None]]:
        def run() -> None:
            tried.append(name)
            if error is not None:
                raise error

        return name, run

    first = KeyboardInterrupt()
    errors = {"fails": OSError("broken"), "first": first, "second": SystemExit(3), "works": None}
    with pytest.raises(KeyboardInterrupt) as caught:
        try_all([step(name, error) for name, error in errors.items()])
    assert caught.value is first
    assert tried == list(errors)
    assert all(name in first.__notes__[0] for name in ("fails", "broken", "first", "second"))


def test_an_error_inside_the_context_stays_the_error_and_carries_what_could_not_be_made_safe() -> None:
    with pytest.raises(ZeroDivisionError) as caught, bench_with({"led_array": ["off"]}).open() as bench:
        raise ZeroDivisionError
    assert calls(bench)[len(KINDS) :] == SAFE_STEPS + CLOSING
    assert "light off, led_array (mock)" in "".join(caught.value.__notes__)


def test_what_fails_twice_on_the_way_out_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    bench = bench_with({"led_array": ["off", "close"]}).open()
    with pytest.raises(ZeroDivisionError) as caught, bench, RunControl().procedure(bench):
        raise ZeroDivisionError("by zero")
    told = "\n".join(caught.value.__notes__)
    assert [told.count(words) for words in ("light off, led_array", "close led_array")] == [1, 1]
    assert not [one for one in caplog.records if one.levelno >= logging.WARNING]

    note_failures(caught.value, DeviceError("stage", "was unplugged."))
    said = [*caught.value.__notes__]
    assert said[-1] == "stage: was unplugged."
    for again in (DeviceError("stage", "was unplugged."), ValueError("by zero")):
        note_failures(caught.value, again)
        note_failures(caught.value, StepsFailedError([("close stage", ValueError("by zero"))]))
    assert caught.value.__notes__[:-1] == said
    assert caught.value.__notes__[-1].endswith(":\n  close stage: as above.")  # named, its words not repeated


@pytest.mark.parametrize(
    ("kind", "words"), [("led_array", "The light may be on"), ("stage", "The stage may be moving")]
)
@pytest.mark.parametrize("fails", [True, False])
def test_a_device_that_was_lost_never_counts_as_safe(kind: str, words: str, fails: bool) -> None:
    step = {"led_array": "off", "stage": "stop"}[kind]
    bench = bench_with({kind: [step]} if fails else None).open()
    device = bench.devices[kind]  # type: ignore[index]
    assert isinstance(device, MockDevice)
    device._open = False
    for leave in (bench.stop, bench.close):
        with pytest.raises(
            StepsFailedError, match=rf"may not be safe[^$]*{kind} \(mock\).*{words}: look"
        ) as caught:
            leave()
        assert caught.value.exit_code == 1
        assert (f"{step} failed." in str(caught.value)) == fails
        assert len(caught.value.failures) == 1
    assert calls(bench)[-4:] == CLOSING
    bench.close()  # closed: nothing left to doubt


def test_the_error_that_a_lost_array_ends_with_carries_that_the_light_may_be_on() -> None:
    bench = bench_with().open()
    assert isinstance(bench.led_array, MockDevice)
    bench.led_array._open = False
    with pytest.raises(ZeroDivisionError) as caught, bench:
        raise ZeroDivisionError
    assert "led_array (mock): was lost. The light may be on" in "".join(caught.value.__notes__)


def test_a_device_that_was_never_opened_is_safe() -> None:
    bench = bench_with({"led_array": ["off"], "stage": ["stop"]})
    bench.open_device("camera")
    bench.close()
    assert "led_array.off" not in calls(bench)


def test_the_slm_keeps_its_image_when_so_configured() -> None:
    bench = bench_with(kinds=("camera",), extra='[slm]\ndriver = "mock"\nblank_when_safe = false').open()
    bench.stop()
    assert "slm.display" not in calls(bench)
    bench.close()


def test_an_unapplied_camera_setting_is_an_error_and_the_camera_is_closed() -> None:
    extra = '[camera]\ndriver = "mock"\nexposure_ms = 5000'
    bench = bench_with(kinds=(), extra=extra)
    with pytest.raises(LimitError, match="5000"):
        bench.open()
    assert calls(bench)[-1] == "camera.close"


def test_a_source_of_leds_that_the_array_lacks_is_refused() -> None:
    bench = bench_with(extra="[source]\nleds = [0, 90000]\n")
    with pytest.raises(LimitError, match=r"LEDs 0 to \d+, but .* names 90000\."):
        bench.open()
    assert not bench.camera.is_open


def test_all_settings_that_the_camera_refuses_are_named_at_once() -> None:
    camera = '[camera]\ndriver = "simulated"\nexposure_ms = 1e9\nbinning = 3\ngain = 100\n'
    bench = Bench(parse_config(camera + '[simulated]\npreset = "tiny"\n', None))
    with pytest.raises(LimitError, match="3 of its configured settings") as caught:
        bench.open()
    assert all(name in str(caught.value) for name in ("exposure_ms", "binning", "gain"))
    assert not bench.camera.is_open


def test_snap_averages_and_completes_the_metadata() -> None:
    with bench_with().open() as bench:
        single, mean = bench.snap(), bench.snap(average=3)
    assert single.image.dtype == "uint16"
    assert single.image[0, 0] == 101
    assert mean.image.dtype == "float32"
    assert mean.image[0, 0] == pytest.approx(103.0)
    assert len(mean.frame_means) == 3
    assert sum(mean.frame_means) / 3 == pytest.approx(mean.image.mean())
    assert mean.unsteadiness == pytest.approx(stdev(mean.frame_means) / fmean(mean.frame_means))
    assert single.unsteadiness == 0
    assert mean.metadata.dropped_before == 3
    assert mean.metadata.stage_position == {"x_um": 0.0, "z_um": 0.0}
    assert mean.metadata.led_pattern == "off"
    assert len(mean.metadata.slm_image_hash) == 64
    with pytest.raises(BenchError, match="not 0"):
        bench.snap(average=0)


def test_a_photograph_ends_at_once_when_the_led_array_is_lost() -> None:
    bench = bench_with().open()
    leds = bench.led_array
    assert isinstance(leds, MockDevice)
    taken: list[int] = []

    def lose(count: int, of: int) -> None:
        assert of == 80
        taken.append(count)
        leds._open = count < 2

    with pytest.raises(DeviceLostError, match=r"led_array \(mock\): was lost") as caught, bench:
        bench.snap(average=80, on_progress=lose)
    assert taken == [1, 2]
    assert "The light may be on" in "".join(caught.value.__notes__)


def test_the_source_is_placed_through_the_configured_offset() -> None:
    with bench_with(extra="[source]\noffset_um = [5.0, 0.0, 1000.0]\n").open() as bench:
        assert bench.place_source(x_um=15.0, y_um=0.0, z_um=3000.0) == (15.0, 0.0, 3000.0)
        assert bench.stage is not None
        assert bench.stage.position() == {"x_um": 10.0, "z_um": 2000.0}
        with pytest.raises(BenchError, match="no axis y_um"):
            bench.place_source(y_um=1.0)
        with pytest.raises(LimitError):
            bench.place_source(x_um=1000.0)
        bench.source_on()
        assert bench.led_array is not None
        assert not bench.led_array.pattern.is_dark
        bench.source_off()
        assert bench.led_array.pattern.is_dark


def test_an_axis_with_play_comes_from_below_unless_it_has_done_so() -> None:
    extra = '[stage]\ndriver = "mock"\nplay = { x_um = 2.0 }\n'
    with bench_with(extra=extra, kinds=("camera",)).open() as bench:
        for place, moves in ({"x_um": 50.0}, 1), ({"x_um": 51.0}, 1), ({"x_um": 50.0}, 2), ({"z_um": 3.0}, 1):
            before = len(calls(bench))
            bench.place_source(**place)
            assert calls(bench)[before:] == ["stage.move_to"] * moves
        assert bench.stage is not None
        bench.stage.move_to({"x_um": 20.0})  # by someone else: nobody knows from where it came
        before = len(calls(bench))
        bench.place_source(x_um=21.0)
        assert calls(bench)[before:] == ["stage.move_to"] * 2


def test_the_simulated_scene_is_switched_and_dark_after_closing() -> None:
    with bench_with(extra='[scene]\ncontrol = "simulated"\n').open() as bench:
        world = bench.shared["mock"]
        assert isinstance(world, MockWorld)
        bench.scene_on()
        assert world.scene_lit
    assert not world.scene_lit


def test_an_operator_is_asked_once_for_each_change() -> None:
    asked: list[str] = []
    with open_bench(bench_with().config, ask=asked.append) as bench:
        assert bench.can_switch_scene
        assert not bench.scene_lit
        bench.scene_on()
        bench.scene_on()
        assert bench.scene_lit
        bench.scene_off()
    assert asked == ["Please light the scene.", "Please darken the scene."]


def test_where_nobody_can_be_asked_that_is_an_error() -> None:
    with bench_with().open() as bench:
        assert not bench.can_switch_scene
        with pytest.raises(OperatorNeededError, match="light the scene"):
            bench.scene_on()


def test_closing_a_device_has_twenty_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, waits_s = bench_with().open(), list[float]()
    monkeypatch.setattr("instrument.bench.bench.within", lambda seconds, *_, **__: waits_s.append(seconds))
    bench.close()
    assert waits_s == [20.0] * 4


def test_the_bench_says_that_it_is_simulated() -> None:
    with bench_with().open() as bench:
        assert "SIMULATED" in bench.label
        assert str(bench).count("SIMULATED") == 5


@pytest.mark.parametrize(
    ("simulated", "mark"), [((), ""), (("camera", "slm"), " SIMULATED: camera, slm"), (KINDS, " SIMULATED")]
)
def test_the_label_names_what_is_simulated_of_a_mixed_bench(
    monkeypatch: pytest.MonkeyPatch, simulated: tuple[str, ...], mark: str
) -> None:
    bench = bench_with(extra='[bench]\nname = "ours"\n')
    monkeypatch.setattr(Bench, "simulated_kinds", simulated)
    assert bench.label == f"{bench.config.label}{mark}"


@pytest.mark.parametrize(("once", "ends_after", "stops"), [(True, 9, 1), (False, 3, 3), (False, 1, 1)])
def test_stopping_goes_on_until_what_runs_has_ended(*, once: bool, ends_after: int, stops: int) -> None:
    ended, tried = threading.Event(), list[int]()

    def stop() -> None:
        tried.append(1)
        if len(tried) == ends_after:
            ended.set()
        raise StepsFailedError([(f"step {len(tried)}", DeviceError("stage", "failed."))])

    with pytest.raises(StepsFailedError, match=f"step {stops}:"):
        stop_until(stop, ended, once=once)
    assert len(tried) == stops


def test_stopping_what_does_not_end_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock_s = iter((0.0, 1.9, 2.1))
    monkeypatch.setattr("instrument.bench.safety.time", SimpleNamespace(monotonic=lambda: next(clock_s)))
    tried: list[int] = []
    stop_until(lambda: tried.append(1), threading.Event())
    assert len(tried) == 2


def test_stop_from_another_thread_ends_a_move_and_darkens_the_source() -> None:
    text = """
        camera.driver = "simulated"
        stage.driver = "simulated"
        led_array.driver = "simulated"
        simulated.preset = "tiny"
    """
    with open_bench(parse_config(text, None)) as bench:
        assert bench.stage is not None
        assert bench.led_array is not None
        bench.stage.home()
        bench.source_on()
        start = bench.source_position_um
        target_um = bench.stage.limits["x_um"][1]
        ended: list[BaseException] = []

        def move() -> None:
            try:
                bench.place_source(x_um=target_um)
            except StoppedError as error:
                ended.append(error)

        mover = threading.Thread(target=move)
        mover.start()
        while bench.source_position_um[0] == start[0]:
            time.sleep(0.001)
        bench.stop()
        mover.join(timeout=10)
        assert len(ended) == 1
        assert bench.source_position_um[0] < target_um - 1000
        assert bench.led_array.pattern.is_dark


def test_a_bench_that_was_closed_is_not_closed_again_when_the_program_ends() -> None:
    bench = bench_with().open()
    assert bench in bench_module._at_exit._open
    bench.close()
    assert bench not in bench_module._at_exit._open


@pytest.mark.parametrize(("leds", "missing"), [([0, 3], ""), ([2, 4, 5], "4, 5")])
def test_leds_of_the_source_that_the_array_has_not_are_named(leds: list[int], missing: str) -> None:
    bench = bench_with(extra=f"[source]\nleds = {leds}\n")
    if missing:
        with pytest.raises(LimitError, match=rf"has LEDs 0 to 3, but \[source\] .* names {missing}\."):
            bench.open()
        assert "led_array.close" in calls(bench)
    else:
        bench.open().close()


def test_a_setting_that_the_camera_refuses_is_told_with_where_it_stands() -> None:
    bench = bench_with()
    settings = bench.config.devices["camera"].settings
    object.__setattr__(settings, "exposure_ms", 5000.0)
    with pytest.raises(LimitError) as caught:
        bench.open()
    assert any("The value is from [camera]" in note for note in caught.value.__notes__)


def test_what_cannot_do_its_part_in_a_sequence_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(output: int = 0) -> str:
        bench = bench_with(extra=f'[trigger]\nsent_by = "led_array"\noutput = {output}\n')
        assert bench.trigger_source is None
        try:
            with bench.open():
                assert bench.trigger_source is bench.led_array
        except LimitError as error:
            return str(error)
        return ""

    assert opened().startswith("camera (mock): takes no hardware trigger, which [trigger] of")
    monkeypatch.setattr(MockCamera, "trigger_modes", ("free", "hardware"))
    assert opened().startswith("led_array (mock): plays no sequences with pulses, which")
    monkeypatch.setattr(MockLedArray, "sequence_limits", SequenceLimits(8, 1.0, 2))
    assert opened(2).startswith("led_array (mock): has trigger outputs 0 to 1, not 2, which")
    assert opened(1) == ""


def test_what_a_device_says_of_its_own_doubt_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_with().open()

    def off(_: object) -> None:
        raise DeviceError("led_array (mock)", "did not answer.", "The light may be on: look.")

    monkeypatch.setattr(MockLedArray, "off", off)
    with pytest.raises(StepsFailedError) as caught:
        bench.stop()
    assert str(caught.value).count("The light may be on") == 1


def test_a_lost_device_that_was_made_safe_after_all_is_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_with().open()
    leds = bench.led_array
    assert isinstance(leds, MockDevice)
    leds._open = False
    monkeypatch.setattr(MockLedArray, "off", lambda self: setattr(self, "_open", True))
    bench.stop()
    monkeypatch.undo()
    bench.close()


@pytest.mark.parametrize(
    ("step", "error", "line"),
    [
        ("close stage", DeviceError("stage", "was unplugged."), "close stage: was unplugged."),
        ("close camera", DeviceError("stage", "was unplugged."), "close camera: stage: was unplugged."),
        ("close stage", ValueError("stage"), "close stage: stage"),
        ("close stage", ValueError(), "close stage: ValueError"),
    ],
)
def test_a_failed_step_is_told_without_naming_its_device_twice(
    step: str, error: Exception, line: str
) -> None:
    assert str(StepsFailedError([(step, error)])).endswith(f":\n  {line}")


def test_only_open_devices_count_as_simulated() -> None:
    bench = bench_with()
    bench.open_device("camera")
    assert bench.simulated_kinds == ("camera",)
    bench.close()


def test_the_source_is_lit_while_its_leds_alone_are() -> None:
    with bench_with(extra="[source]\nleds = [3]\n").open() as bench:
        assert bench.led_array is not None
        told = [bench.source_lit]
        bench.source_on()
        told.append(bench.source_lit)
        bench.led_array.set_pattern(replace(bench.source_pattern, levels=((4, (255, 255, 255)),)))
        told.append(bench.source_lit)
        bench.source_on()
        assert isinstance(bench.led_array, MockDevice)
        bench.led_array._open = False
        told.append(bench.source_lit)
        bench.led_array._open = True
        assert told == [False, True, False, False]
    with bench_with(kinds=("camera",)).open() as bench:
        assert not bench.source_lit
        with pytest.raises(BenchError, match=r"has no \[stage\]"):
            _ = bench.source_mount


def test_times_are_foretold_by_the_sensor_and_by_what_its_light_costs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[tuple[object, ...]] = []

    def about(of: str, *, megapixels: float, simulated: bool, awaits_light: Callable[[], bool]) -> None:
        told.append((of, megapixels, simulated, awaits_light()))

    monkeypatch.setattr(bench_module.kept_times, "about", about)
    with bench_with().open() as bench:
        bench.foretell("ours")
        monkeypatch.setattr(Bench, "simulated_kinds", ("stage",))
        bench.foretell("yours")
    assert told == [(of, pytest.approx(24 * 32e-6), of == "ours", False) for of in ("ours", "yours")]


def test_a_place_as_far_as_an_axis_settles_within_is_the_one_that_it_came_to_from_below() -> None:
    extra = '[stage]\ndriver = "mock"\nplay = { x_um = 2.0 }\n'
    with bench_with(extra=extra, kinds=("camera",)).open() as bench:
        assert bench.stage is not None
        assert bench.stage.position()["x_um"] == 0
        (axis,) = (axis for axis in bench.stage.axes if axis.name == "x_um")
        for off, moves in (1.0, 1), (1.01, 2):
            bench.stage.move_to({"x_um": 0.0})
            bench._seated["x_um"] = off * bench.stage.settles_within(axis)
            before = len(calls(bench))
            bench.place_source(x_um=1.0)
            assert calls(bench)[before:] == ["stage.move_to"] * moves
