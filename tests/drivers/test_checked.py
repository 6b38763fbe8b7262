"""Drivers that lie, or fail in their own ways, under what the bench makes of them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.camera import Camera, Roi
from drivers.common.checked import call_limit_s, checked, given_up
from drivers.device import Device
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError
from drivers.frame import Frame
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.slm import Slm
from drivers.stage import Stage, StageAxis
from tests.mocks.devices import (
    MockCamera,
    MockLedArray,
    MockOptions,
    MockSlm,
    MockStage,
    MockWorld,
    MockWorldOptions,
)


def made(driver: type[Device]) -> Any:
    return checked(driver)(MockOptions(), MockWorld(MockWorldOptions()))


# Cameras ---
@pytest.mark.parametrize("said", [float("nan"), float("inf"), 0.0, -20.0, 17.9, 22.1, 5000.0])
def test_an_exposure_that_is_none_or_another_is_refused(said: float) -> None:
    class Lying(MockCamera):
        def set_exposure_ms(self, exposure_ms: float) -> float:
            self.exposure_ms = said
            return said

    with pytest.raises(DeviceError, match=r"was asked for an exposure \(ms\) of 20 and says "):
        made(Lying).set_exposure_ms(20.0)


@pytest.mark.parametrize(
    ("what", "asked", "said", "is_refused"),
    [
        ("exposure_ms", 0.1, 0.0, True),
        ("exposure_ms", 1.0, 1.3, True),
        ("gain", 4.0, 5.0, False),
        ("gain", 1.0, 1.75, True),
    ],
)
def test_how_far_a_setting_may_be_off(what: str, asked: float, said: float, *, is_refused: bool) -> None:
    class Other(MockCamera):
        pass

    setattr(Other, f"set_{what}", lambda *_: said)
    setattr(Other, what, said)
    with pytest.raises(DeviceError, match="was asked for") if is_refused else nullcontext():
        assert getattr(made(Other), f"set_{what}")(asked) == said


@pytest.mark.parametrize(
    ("said", "is_refused"), [(9.9, True), (9.999985, True), (10.0, False), (17.0, False), (17.1, True)]
)
def test_a_sequence_is_no_faster_than_asked_nor_far_slower(said: float, *, is_refused: bool) -> None:
    class Playing(MockLedArray):
        def arm(self, patterns: Any, period_ms: float, output: int = 0) -> float:
            return said

    refused = pytest.raises(DeviceError, match="a sequence with a period of 10 ms")
    with refused if is_refused else nullcontext():
        assert made(Playing).arm((), 10.0) == said


def test_an_exposure_read_back_otherwise_is_refused() -> None:
    class Forgetful(MockCamera):
        def set_exposure_ms(self, exposure_ms: float) -> float:
            return exposure_ms  # and stays at 10

    with pytest.raises(DeviceError, match="of 500 and says 10"):
        made(Forgetful).set_exposure_ms(500.0)


def test_steps_of_honest_cameras_are_no_lies() -> None:
    class Stepping(MockCamera):
        def set_exposure_ms(self, exposure_ms: float) -> float:
            return super().set_exposure_ms(max(0.1, round(exposure_ms, 1)))

        def set_gain(self, gain: float) -> float:
            return super().set_gain(10 ** (round(20 * np.log10(gain) / 2) * 2 / 20))

    camera = made(Stepping)
    assert camera.set_roi(None) == camera.roi
    for exposure_ms in np.geomspace(0.1, 900, 60):
        camera.set_exposure_ms(float(exposure_ms))
    for gain in np.geomspace(1, 16, 60):
        camera.set_gain(float(gain))


def test_settings_without_tolerance_and_frames() -> None:
    class Stubborn(MockCamera):
        def set_gain(self, gain: float) -> float:
            return super().set_gain(1.3 * gain)

        def set_binning(self, binning: int) -> int:
            return 1

        def set_pixel_format(self, pixel_format: str) -> str:
            return "Mono8"

        def set_trigger_mode(self, mode: Any) -> Any:
            return "free_run"

        def set_roi(self, roi: Roi | None) -> Roi:
            return Roi(0, 0, 24, 32)

        def snap(self) -> Frame:
            frame = super().snap()
            return Frame(frame.image[:, ::2], frame.metadata)

    camera: Camera = made(Stubborn)
    for call, said in (
        (lambda: camera.set_gain(4.0), "a gain of 4 and says 5.2"),
        (lambda: camera.set_binning(2), "a binning of 2 and says 1"),
        (lambda: camera.set_pixel_format("Mono12"), "a pixel format of Mono12 and says Mono8"),
        (lambda: camera.set_trigger_mode("software"), "a trigger mode of software and says free_run"),
        (lambda: camera.set_roi(Roi(2, 2, 8, 8)), r"the region \(2, 2, 8, 8\) and says \(0, 0, 24, 32\)"),
        (camera.snap, r"a frame of \(24, 32\) pixels and says \(24, 16\)"),
    ):
        with pytest.raises(DeviceError, match=said):
            call()


@pytest.mark.parametrize("said", [float("nan"), 0.0])
def test_a_frame_without_an_exposure_is_none(said: float) -> None:
    class Unsure(MockCamera):
        def snap(self) -> Frame:
            frame = super().snap()
            return Frame(frame.image, replace(frame.metadata, exposure_ms=said))

    with pytest.raises(DeviceError, match=rf"a frame with an exposure \(ms\) and says {said:g}"):
        made(Unsure).snap()


# Stages ---
class Coloured(MockCamera):
    def snap(self) -> Frame:
        frame = super().snap()
        return Frame(np.repeat(frame.image[..., None], 3, axis=2), frame.metadata)


def test_a_frame_in_colour_or_of_an_odd_region_has_its_shape() -> None:
    assert made(Coloured).snap().image.ndim == 3

    class Odd(MockCamera):
        def snap(self) -> Frame:
            frame = super().snap()
            return Frame(frame.image[:12, :16], replace(frame.metadata, roi=(0, 0, 25, 33), binning=2))

        next_frame = lambda self, timeout_s: self.snap()  # noqa: E731

    assert made(Odd).next_frame(1.0).image.shape == (12, 16)
    for call in (
        made(Short).next_frame,
        lambda _: made(Short).next_frame_into(np.empty((24, 16), np.uint8), 1),
    ):
        with pytest.raises(DeviceError, match="a frame of"):
            call(1.0)


class Short(MockCamera):
    def next_frame(self, timeout_s: float) -> Frame:
        frame = super().snap()
        return Frame(frame.image[:, ::2].astype(np.uint8), frame.metadata)

    def next_frame_into(self, buffer: Any, timeout_s: float) -> Any:
        return super().snap().metadata


class Misses(MockStage):
    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        return {name: place + 50.0 for name, place in super().move_to(target).items()}


class Afar(MockStage):
    axes = (StageAxis("x_um", -2e6, -1e6, 1000.0, 0.1), StageAxis("y_um", 0.0, 1.0, 1000.0, 0.1))


def test_a_call_has_the_time_that_its_device_needs() -> None:
    stage, leds = made(Afar), made(MockLedArray)
    times_s = [call_limit_s(stage, name) for name in ("settings", "open", "move_to", "home")]
    assert times_s == [30, 120, 3000, 3000]  # three times 1 m at 1 mm/s
    assert [call_limit_s(leds, name) for name in ("set_pattern", "open", "arm")] == [30, 120, 600]
    assert call_limit_s(made(MockCamera), "snap") == pytest.approx(2 + 3 * 0.01 + 20)
    assert call_limit_s(made(type("Bare", (MockStage,), {"axes": ()})), "wait") == 600


@pytest.mark.parametrize("said", [0.0, -1.0, 1e6, float("nan")])
def test_a_camera_that_takes_no_time_or_weeks_for_a_frame_is_not_believed(said: float) -> None:
    camera = made(type("Slow", (MockCamera,), {"longest_wait_s": property(lambda _: said)}))
    with pytest.raises(DeviceError, match=r"how long a frame may take|longest_wait_s"):
        _ = camera.longest_wait_s
    week = made(type("Patient", (MockCamera,), {"longest_wait_s": property(lambda _: 7 * 86_400.0)}))
    assert week.longest_wait_s == 604_800


class Stays(MockStage):
    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        return dict(target)


class Lost(MockStage):
    def position(self) -> dict[str, float]:
        return {"x_um": float("nan")}


class NeverHome(MockStage):
    is_homed = False


def test_a_stage_that_does_not_move_is_found_out() -> None:
    stage: Stage = made(Stays)
    with pytest.raises(DeviceError, match="x_um = 50 and says x_um = 0"):
        stage.move_to({"x_um": 50.0})
    stage.move_to({"x_um": 50.0}, wait=False)  # it has not arrived
    with pytest.raises(DeviceError, match="x_um = 20 and says x_um = 70"):
        made(Misses).move_to({"x_um": 20.0})
    stage.move_to({"x_um": 0.2})  # within three times its resolution of where it stands
    with pytest.raises(DeviceError, match="no number, for x_um, z_um"):
        made(Lost).position()
    stage._position["z_um"] = 9.9e9  # type: ignore[attr-defined]
    with pytest.raises(
        DeviceError, match=r"its place, which is within 0 to 1e\+06 and says z_um = 9\.9e\+09"
    ):
        stage.position()
    stage._position = {"x_um": -9e3, "z_um": 3 * 0.1}  # type: ignore[attr-defined] # far out, and just there
    stage.move_to({"z_um": 0.0})
    with pytest.raises(DeviceError, match="was asked for homing and says that it is not homed"):
        made(NeverHome).home()
    lost = made(NeverHome)
    assert "stage.home" not in lost.world.calls
    lost._position["z_um"] = 9.9e9
    assert lost.position()["z_um"] == 9.9e9
    (homed := made(MockStage)).home()
    assert homed.world.calls == ["stage.home"]


class Equal(MockStage):
    """As a ``@dataclass`` is: equal to others, and without a hash."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = None  # type: ignore[assignment]


def test_a_device_is_equal_to_no_other_whatever_its_driver_says() -> None:
    one, other = made(Equal), made(Equal)
    one.home()
    assert one != other
    assert len({one, other}) == 2


# Light, SLM ---
class Dark(MockLedArray):
    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        return pattern  # and shows nothing


class Burning(MockLedArray):
    def off(self) -> None:
        pass


class Frozen(MockSlm):
    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        pass


def test_light_that_is_not_shown_or_not_put_out_is_found_out() -> None:
    leds: LedArray = made(Dark)
    with pytest.raises(DeviceError, match=r"the pattern 'LED 2 .* and says 'off'"):
        leds.set_pattern(leds.single(2))
    leds = made(Burning)
    assert leds.pattern == OFF
    leds.set_pattern(leds.single(2))
    with pytest.raises(DeviceError, match="was asked for darkness"):
        leds.off()
    for shown in (OFF, leds.single(2)):
        named = {"pattern": shown, "play": lambda self: self.world.calls.append("play")}
        playing = made(type("Playing", (MockLedArray,), named))
        with nullcontext() if shown is OFF else pytest.raises(DeviceError, match="darkness after a sequence"):
            playing.play()
        assert playing.world.calls == ["play"]
    slm: Slm = made(Frozen)
    with pytest.raises(DeviceError, match="was asked for an image"):
        slm.display(np.full(slm.shape, 3, np.uint8))


# Failures of any type ---
class Faulty(MockStage):
    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        raise ZeroDivisionError("float division by zero")

    @property
    def is_moving(self) -> bool:  # type: ignore[override]
        raise KeyError("busy")

    @property
    def is_homed(self) -> bool:  # type: ignore[override]
        raise DeviceError(self.name, "does not answer.")


def test_a_drivers_mistake_is_a_sentence_and_its_traceback_is_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage = made(Faulty)
    with caplog.at_level(logging.ERROR), pytest.raises(DeviceError) as caught:
        stage.move_to({"x_um": 1.0})
    assert str(caught.value).startswith(
        "stage (mock): its driver failed in move_to: ZeroDivisionError: float division by zero."
    )
    assert "Traceback" in caplog.text
    with pytest.raises(DeviceError, match="its driver failed in is_moving: KeyError"):
        _ = stage.is_moving
    with pytest.raises(DeviceError, match=r"^stage \(mock\): does not answer\."):
        _ = stage.is_homed


def test_what_a_driver_says_in_words_and_an_interruption_pass() -> None:
    stage = made(MockStage)
    with pytest.raises(LimitError, match="x_um = 500 is outside"):
        stage.move_to({"x_um": 500.0})
    interrupted = checked(MockStage)(MockOptions(interrupt=("home",)), MockWorld(MockWorldOptions()))
    with pytest.raises(KeyboardInterrupt):
        interrupted.home()
    assert isinstance(stage, MockStage)
    assert type(stage).__name__ == "MockStage"


class Reads(MockCamera):
    """Tells in which thread it is asked, and asks itself for something by what lies in another room."""

    @property
    def gain(self) -> float:  # type: ignore[override]
        self.asked_in = {threading.current_thread().name}
        return float(eval("device.exposure_ms", {"__name__": "somewhere.else"}, {"device": self}))

    @property
    def exposure_ms(self) -> float:  # type: ignore[override]
        self.asked_in.add(threading.current_thread().name)
        return 10.0


@pytest.mark.parametrize(
    ("asker", "is_its_own"),
    [
        ("instrument.bench.bench", False),
        ("somewhere.drivers", False),
        ("drivers.common.stream", False),
        ("drivers.common.checked", False),
        ("drivers.basler.camera", True),
        ("tests.mocks.other", True),
    ],
)
def test_what_a_driver_asks_of_its_own_device_is_not_asked_in_another_thread(
    asker: str, is_its_own: bool
) -> None:
    """It may hold a lock; others are not kept waiting without end."""
    camera = made(Reads)
    assert eval("device.gain", {"__name__": asker}, {"device": camera}) == 10.0
    assert camera.asked_in == {
        threading.current_thread().name if is_its_own else f"{camera.name}: reading gain"
    }


def test_nothing_is_read_while_a_reading_hangs_and_all_is_while_another_call_does() -> None:
    camera, let_go = made(Reads), threading.Event()
    for call, is_read in ("snap", True), ("reading gain", False):
        thread = threading.Thread(target=let_go.wait, args=(20,), name=f"{camera.name}: {call}")
        thread.start()
        given_up(camera).append(thread)
        with nullcontext() if is_read else pytest.raises(DeviceTimeoutError, match="still hangs"):
            assert eval("device.gain", {"__name__": "instrument.bench.bench"}, {"device": camera}) == 10.0
    let_go.set()
