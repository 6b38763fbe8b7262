"""Kept settings on a camera that does as it is told: what is refused, and what comes back in which order."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from drivers.camera import Roi
from drivers.common.camera_settings import GainScale, KeptSettings
from drivers.errors import DeviceError, LimitError


class Told(KeptSettings):
    """Notes what is written to it, and rounds."""

    name = "camera (told)"
    exposure_limits_ms = (1.0, 100.0)
    gain_limits = (1.0, 8.0)
    trigger_modes = ("free_run", "software", "hardware")
    trigger_lines = ("1", "2")
    trigger_edges = ("rising", "falling")
    _black_limits = (-5.0, 20.0)
    _roi = Roi(0, 0, 4, 6)
    _exposure_ms, _gain, black_level = 10.0, 1.0, 0.0
    _identity: Any = "who"

    def __init__(self) -> None:
        super().__init__()
        self.written: list[tuple[object, ...]] = []
        self.lost, self.idle = False, True
        self.refused: set[tuple[object, ...]] = set()

    def _require(self) -> None:
        if self.lost:
            raise DeviceError(self.name, "is not open.")

    def _require_idle(self, what: str) -> None:
        self._require()
        if not self.idle:
            raise DeviceError(self.name, f"takes frames: no new {what} now.")

    def _write(self, *what: object) -> None:
        if what in self.refused:
            raise DeviceError(self.name, f"refuses {what}")
        self.written.append(what)

    def _write_exposure(self, exposure_ms: float) -> float:
        self._write("exposure", exposure_ms)
        return round(exposure_ms) + 0.25

    def _write_gain(self, gain: float) -> float:
        self._write("gain", gain)
        return round(gain) + 0.5

    def _write_black(self, black_level: float) -> None:
        self._write("black", black_level)
        self.black_level = black_level + 0.125

    def set_own(self, name: str, value: str) -> str:
        self._write("own", name, value)
        self._remember_own(name, value)
        return value

    def _write_trigger(self, mode: str) -> None:
        self._write("trigger", mode, self._trigger_line, self._trigger_edge)


Told.__abstractmethods__ = frozenset()  # of a camera's frames nothing is asked here


def told() -> Told:
    """Return a camera that is open and idle."""
    return Told()  # type: ignore[abstract]


SETTERS: dict[str, tuple[str, object, object]] = {
    "exposure_ms": ("set_exposure_ms", 12.2, 12.25),
    "gain": ("set_gain", 3.1, 3.5),
    "black_level": ("set_black_level", 7.0, 7.125),
    "trigger_line": ("set_trigger_line", "2", "2"),
    "trigger_edge": ("set_trigger_edge", "falling", "falling"),
    "trigger_mode": ("set_trigger_mode", "hardware", "hardware"),
}
WRITTEN = [
    ("black", 7.0),
    ("gain", 3.1),
    ("exposure", 12.2),
    ("trigger", "hardware", "2", "falling"),
]


@pytest.mark.parametrize("name", SETTERS)
def test_a_setting_is_what_the_device_made_of_it(name: str) -> None:
    camera = told()
    setter, value, made = SETTERS[name]
    assert getattr(camera, setter)(value) == made
    assert getattr(camera, name) == made


def test_what_was_set_comes_back_in_the_order_in_which_settings_bind_each_other() -> None:
    camera = told()
    for setter, value, _ in reversed(SETTERS.values()):
        getattr(camera, setter)(value)
    camera.written.clear()
    camera._trigger_line, camera._trigger_edge, camera._trigger_mode = "", "rising", "free_run"  # opened anew
    camera._bring_back()
    assert camera.written == WRITTEN
    camera._forget("gain")
    camera._forget("gain")  # twice is no mistake
    camera.set_black_level(9.0)  # the latest counts
    camera.written.clear()
    camera._bring_back()
    assert camera.written[:2] == [("black", 9.0), ("exposure", 12.2)]


def test_its_own_settings_come_back_first_as_they_were_set_last() -> None:
    camera = told()
    camera.set_gain(2.0)
    for name, value in (("flip", "1"), ("lens", "near"), ("flip", "0")):
        camera.set_own(name, value)
    camera.written.clear()
    camera._bring_back()
    assert camera.written == [("own", "lens", "near"), ("own", "flip", "0"), ("gain", 2.0)]


def test_where_one_fails_to_come_back_all_stay_remembered() -> None:
    camera = told()
    for setter, value, _ in SETTERS.values():
        getattr(camera, setter)(value)
    camera.refused = {("exposure", 12.2)}
    with pytest.raises(DeviceError, match="refuses"):
        camera._bring_back()
    camera.refused = set()
    camera.written.clear()
    camera._trigger_mode = "free_run"
    camera._bring_back()
    assert camera.written == WRITTEN


READ: dict[str, Callable[[Told], object]] = {
    name: (lambda camera, name=name: getattr(camera, name))  # type: ignore[misc]
    for name in ("identity", "exposure_ms", "gain", "roi")
}


@pytest.mark.parametrize("name", READ)
def test_a_device_that_is_lost_says_nothing(name: str) -> None:
    camera = told()
    READ[name](camera)
    camera.lost = True
    with pytest.raises(DeviceError, match="is not open"):
        READ[name](camera)


@pytest.mark.parametrize("name", ["black_level", "binning", "trigger_mode", "trigger_line", "trigger_edge"])
def test_some_settings_wait_for_the_end_of_a_sequence(name: str) -> None:
    camera = told()
    camera.idle = False
    setter, value, _ = (*SETTERS.get(name, ("set_binning", 1, 1)),)
    with pytest.raises(DeviceError, match=f"no new {name.replace('_', ' ')} now"):
        getattr(camera, setter)(value)
    assert camera.written == []


@pytest.mark.parametrize(
    ("setter", "wrong", "words"),
    [
        ("set_exposure_ms", 0.99, "cannot expose 0.99 ms. Its exposure is 1 to 100 ms."),
        ("set_exposure_ms", 101.0, "cannot expose 101 ms"),
        ("set_gain", 0.5, "has no gain 0.5. Its gain is 1 to 8."),
        ("set_black_level", -1.0, "has no black level -1. It is 0 to 20 counts."),
        ("set_black_level", 21.0, "has no black level 21"),
        ("set_binning", 2, "has no binning 2. It does not bin."),
        ("set_trigger_mode", "level", "has no trigger mode 'level'. It offers free_run, software, hardware."),
        ("set_trigger_line", "3", "has no trigger line '3'"),
        ("set_trigger_edge", "both", "has no trigger edge 'both'"),
    ],
)
def test_what_the_device_does_not_offer_is_refused_and_changes_nothing(
    setter: str, wrong: object, words: str
) -> None:
    camera = told()
    with pytest.raises(LimitError, match=words.replace(".", r"\.")):
        getattr(camera, setter)(wrong)
    assert (camera.written, camera._remembered) == ([], {})


def test_the_smallest_and_the_largest_are_taken() -> None:
    camera = told()
    for setter, values in {
        "set_exposure_ms": (1.0, 100.0),
        "set_gain": (1.0, 8.0),
        "set_black_level": (0.0, 20.0),
    }.items():
        for value in values:
            getattr(camera, setter)(value)
    assert camera.set_binning(1) == camera.binning == 1
    assert camera.binnings == (1,)


@pytest.mark.parametrize(("setter", "value"), [("set_trigger_line", "2"), ("set_trigger_edge", "falling")])
def test_line_and_edge_are_as_before_where_the_trigger_cannot_be_made_again(setter: str, value: str) -> None:
    camera = told()
    camera.set_trigger_line("1")
    assert camera.written == []  # not in force: nothing to write
    camera.set_trigger_mode("hardware")
    getattr(camera, setter)(value)
    line, edge = camera.trigger_line, camera.trigger_edge
    assert camera.written[-1] == ("trigger", "hardware", line, edge)
    camera.refused = {("trigger", "hardware", "1", edge), ("trigger", "hardware", line, "rising")}
    camera.refused.discard(camera.written[-1])
    remembered = dict(camera._remembered)
    with pytest.raises(DeviceError, match="refuses"):
        getattr(camera, setter)({"2": "1", "falling": "rising"}[value])
    assert (camera.trigger_line, camera.trigger_edge) == (line, edge)
    assert camera.written[-2:] == [("trigger", "hardware", line, edge)] * 2, "a part may have been written"
    assert camera._remembered == remembered


def test_a_trigger_mode_that_cannot_be_made_leaves_the_one_before_it_made_again() -> None:
    camera = told()
    camera.set_trigger_mode("software")
    camera.refused = {("trigger", "hardware", "", "rising")}
    with pytest.raises(DeviceError, match="hardware") as failed:
        camera.set_trigger_mode("hardware")
    assert (camera.trigger_mode, getattr(failed.value, "__notes__", [])) == ("software", [])
    assert camera.written == [("trigger", "software", "", "rising")] * 2
    camera.refused |= {("trigger", "software", "", "rising")}
    with pytest.raises(DeviceError, match="hardware") as failed:
        camera.set_trigger_mode("hardware")
    assert "Nor could trigger mode software be made again" in " ".join(failed.value.__notes__)


@pytest.mark.parametrize(
    ("scale", "factor", "number"),
    [
        (GainScale("dB", 0.1, 0), 0.5, 200 * math.log10(0.5)),
        (GainScale("dB", 2.0, 0), 100.0, 20.0),
        (GainScale("dB", 1.0, 0), 0.0, -math.inf),
        (GainScale("dB", 1.0, 0), -1.0, -math.inf),
        (GainScale("factor", 0.25, 1), 3.0, 12.0),
        (GainScale("steps", 0.25, 10), 1.0, 10.0),
        (GainScale("steps", 0.25, 10), 2.0, 14.0),
    ],
)
def test_gain_scales(scale: GainScale, factor: float, number: float) -> None:
    assert scale.number(factor) == pytest.approx(number)
    assert scale.factor(number) == pytest.approx(max(factor, 0.0))
