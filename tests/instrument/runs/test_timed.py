"""Frames timed by hardware: frame k is pattern k's, or the fault is named; never one in another's place."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.camera import TriggerMode
from drivers.errors import DeviceError, LimitError
from drivers.led_array import LedArray, LedPattern
from drivers.sequence import SequenceLimits
from drivers.simulated.wire import Wires
from drivers.slm import Slm
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.bench.sequence import Wire, _placed, take_sequence
from instrument.files.errors import BenchError, ConfigError
from instrument.plan import Light, Part, Plan, PlanError
from instrument.runs.acquire import acquire
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_control import RunControl
from instrument.runs.timed import TimedSteps, left_to

LEVELS = (40, 80, 120, 160, 200, 240)


def open_bench(simulated: str = "", camera: str = "", wire: str = 'sent_by = "led_array"') -> Bench:
    return Bench(
        parse_config(
            f"""
            [camera]
            driver = "simulated_led_microscope"
            exposure_ms = 5.0
            {camera}
            [led_array]
            driver = "simulated_led_microscope"
            [trigger]
            {wire}
            [scene]
            control = "simulated"
            [simulated_led_microscope]
            pixels = 64
            time_scale = 0.0
            {simulated}
            """,
            None,
        )
    ).open()


def steps_of_light(**more: Any) -> Plan:
    lights = tuple(Light(kind="pattern", description=f"level {n}", leds=((0, n, n, n),)) for n in LEVELS)
    part = {"label": "lit", "light": lights, **more}
    return Plan(label="p", parts=(Part(label="dark", repeats=2), Part.model_validate(part)))


def brightness(run: Run) -> np.ndarray[Any, np.dtype[np.float64]]:
    dark = run.images("dark").mean()
    return np.asarray(run.images("lit").mean(axis=(1, 2)) - dark)


def notes(run: Run, kind: str) -> list[str]:
    return [str(event["text"]) for event in run.events if event["kind"] == kind]


@pytest.mark.parametrize(
    ("simulated", "fault"),
    [
        ("", ""),
        ("pulse_jitter_us = 20", ""),
        ("missed_pulses = 0.02\nseed = 2", "no frame came of pattern"),  # seeds whose first attempt has one
        ("extra_pulses = 0.04\nseed = 3", "no pattern asked for frames at"),
    ],
    ids=["clean", "jitter", "missed", "extra"],
)
def test_frame_k_is_of_pattern_k(tmp_path: Path, simulated: str, fault: str) -> None:
    # A fast camera between slow pulses: one that nobody sent finds it idle.
    wire = 'sent_by = "led_array"\nperiod_ms = 30.0'
    with open_bench(simulated, "frames_per_s = 1000.0", wire) as bench:
        run = acquire(bench, steps_of_light(average=2), tmp_path)
        assert bench.camera.trigger_mode == "free_run"
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
    assert run.reason is FinishReason.COMPLETED
    assert brightness(run) / brightness(run)[-1] == pytest.approx(np.array(LEVELS) / 240, abs=0.02)
    assert [run.metadata(n).led_pattern for n in range(8)] == ["off"] * 2 + [f"level {n}" for n in LEVELS]
    assert run.records[5].average == 2
    again = notes(run, "sequence taken again")
    assert [fault in words for words in again] == [True] * bool(fault)


def test_faults_are_named_and_the_sequence_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = Wires._pulses
    attempts: list[int] = []

    def third_lost(self: Wires, count: int, period_s: float, settle_s: float) -> Any:
        attempts.append(count)
        pulses = sent(self, count, period_s, settle_s)
        return np.delete(pulses, 2 + 2 + 2) if len(attempts) == 1 else pulses

    monkeypatch.setattr(Wires, "_pulses", third_lost)
    with open_bench() as bench:
        run = acquire(bench, steps_of_light(), tmp_path)
        assert TimedSteps(bench, steps_of_light()).words() == (
            "8 of 8 frames are timed by hardware, in 1 sequence; "
            "the camera's pulses come on Line1, rising edge."
        )
    assert notes(run, "sequence taken again") == ["no frame came of pattern 5"]
    assert [event["first"] for event in run.events if "first" in event] == [0]
    assert attempts == [2 + 2 + 6] * 2
    assert brightness(run)[2] / brightness(run)[-1] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("pulses", "words"),
    [
        (lambda at, period: np.append(at[1:], at[-1] + 0.99 * period), "as if they were shifted"),
        (lambda at, period: at[:-1], "1 of 10 frames are missing at the beginning or the end"),
        (lambda at, period: at + 0.6 * period * (np.arange(10) == 5), r"late: pattern 4 by \d"),
        (lambda at, period: at[:0], "no frame came on Line1"),
    ],
    ids=["shifted", "last", "late", "none"],
)
def test_a_sequence_that_is_never_whole_is_refused(
    monkeypatch: pytest.MonkeyPatch, pulses: Any, words: str
) -> None:
    monkeypatch.setattr(
        Wires, "_pulses", lambda _, count, period, settle: pulses(np.arange(count) * period + settle, period)
    )
    patterns = [LedPattern(f"{n}", ((0, (n, n, n)),)) for n in (*LEVELS, 20, 60)]
    with open_bench() as bench, pytest.raises(DeviceError, match=words):
        take_sequence(Wire(bench), patterns)


@pytest.mark.parametrize("ctrl_c", [True, False])
def test_what_fails_while_the_camera_is_put_back_is_named_and_hides_no_ctrl_c(
    ctrl_c: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(_: object) -> None:
        if ctrl_c:
            raise KeyboardInterrupt

    def no_stop(_: object) -> None:
        raise DeviceError("camera", "does not stop.")

    patterns = [LedPattern("lit", ((0, (200, 200, 200)),))] * 2
    with open_bench() as bench:
        set_trigger_mode = type(bench.camera).set_trigger_mode

        def lost(camera: Any, mode: TriggerMode) -> TriggerMode:
            if mode == "free_run":
                raise DeviceError("camera", "was unplugged.")
            return set_trigger_mode(camera, mode)

        monkeypatch.setattr(type(bench.camera), "set_trigger_mode", lost)
        monkeypatch.setattr(type(bench.camera), "stop_sequence", no_stop)
        with pytest.raises(KeyboardInterrupt if ctrl_c else DeviceError) as caught:
            take_sequence(Wire(bench), patterns, on_frame=pressed)
        monkeypatch.undo()
    said = [*([] if ctrl_c else [str(caught.value)]), *caught.value.__notes__]
    assert said == ["camera: does not stop.", "camera: was unplugged."]


def test_times_are_put_to_places() -> None:
    rng = np.random.default_rng(1)
    times = 5.003 * np.arange(400.0) + rng.normal(0, 0.05, 400)  # clocks that differ: two periods in all
    on_time, late, extra = _placed(np.sort(np.append(np.delete(times, [7, 300]), times[50] + 2.4)), 5.0, 0.25)
    assert set(range(400)) - {n - min(on_time) for n in on_time} == {7, 300}
    assert not late
    assert extra == pytest.approx([times[50] + 2.4 - times[0]])


def test_stop_ends_a_sequence(tmp_path: Path) -> None:
    control = RunControl()
    with open_bench() as bench:
        plan = steps_of_light(repeats=20)
        original = Wires.play

        def stopping(self: Wires, *args: Any, **named: Any) -> bool:
            threading.Thread(target=control.stop).start()
            return original(self, *args, **named)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Wires, "play", stopping)
            run = acquire(bench, plan, tmp_path, control=control)
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
    assert run.reason is FinishReason.STOPPED
    assert run.records == {}


def test_what_a_sequence_needs_is_asked_for_beforehand(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\[trigger\] sent_by.*no \[slm\]"):
        open_bench(wire='sent_by = "slm"')
    with pytest.raises(LimitError, match="has trigger outputs 0 to 0, not 1, which"):
        open_bench(wire='sent_by = "led_array"\noutput = 1')
    with open_bench(wire="") as bench, pytest.raises(PlanError, match="the bench has no trigger wire"):
        acquire(bench, steps_of_light(timing="hardware"), tmp_path)
    with (
        open_bench() as bench,
        pytest.raises(PlanError, match="trigger_line 'Line9', but the camera's are Line1"),
    ):
        acquire(bench, steps_of_light(trigger_line="Line9"), tmp_path)


@pytest.mark.parametrize("kind", [LedArray, Slm])
def test_what_goes_into_one_sequence(kind: type[Any]) -> None:
    slm, most = kind is Slm, 6
    limits = SequenceLimits(most if slm else most + 2, 1.0, 1)  # two dark patterns go before light
    own = dict.fromkeys(kind.__abstractmethods__) | {"__init__": lambda _: None, "sequence_limits": limits}
    camera = SimpleNamespace(frame_shape=(8, 8), frame_dtype=np.dtype(np.uint16))
    wired: Any = SimpleNamespace(trigger_source=type("Plays", (kind,), own)(), camera=camera)
    one: dict[str, Any] = {"slm_image": "a.png"} if slm else {}

    def groups(*parts: dict[str, Any]) -> list[tuple[bool, int]]:
        plan = Plan(label="p", parts=tuple(Part.model_validate({"label": "a"} | part) for part in parts))
        made = TimedSteps(wired, plan).groups(plan.steps())
        return [(wire is not None, len(steps)) for wire, steps in made]

    assert Wire(wired).most == most
    assert left_to(Wire(wired)) == ("slm_image" if slm else "light")
    exposures = [one | {"exposure_ms": exposure_ms, "repeats": 8} for exposure_ms in (1.0, 2.0)]
    assert groups(*exposures) == [(True, 6), (True, 2)] * 2
    assert groups(one) == [(False, 1)]
    assert groups(one | {"timing": "hardware"}) == [(True, 1)]
    assert groups(one | {"average": most}) == [(True, 1)]
    assert groups(one | {"average": most + 1}) == [(False, 1)]
    assert groups(one | {"average": 4}, one | {"average": 2}) == [(True, 2)]
    assert groups(one | {"average": 4}, one | {"average": 3}) == [(True, 1), (True, 1)]
    assert groups(one | {"timing": "stepped", "repeats": 2}) == [(False, 1)] * 2
    with pytest.raises(BenchError, match=r"more frames than one sequence \(6\)"):
        groups(one | {"average": most + 1, "timing": "hardware"})
    if slm:
        assert groups({"repeats": 2}) == [(False, 1)] * 2
        with pytest.raises(BenchError, match="has no SLM image"):
            groups({"timing": "hardware"})


def test_a_falling_edge_and_another_line(tmp_path: Path) -> None:
    with open_bench(camera='trigger_edge = "falling"') as bench:
        run = acquire(bench, steps_of_light(), tmp_path)
        assert run.reason is FinishReason.COMPLETED
        with pytest.raises(DeviceError, match="no frame came on Line2"):
            acquire(bench, steps_of_light(trigger_line="Line2", trigger_edge="rising"), tmp_path)
        camera = bench.camera
        assert (camera.trigger_line, camera.trigger_edge, camera.trigger_mode) == (
            "Line1",
            "falling",
            "free_run",
        )
