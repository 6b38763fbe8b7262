"""What was lit during a frame, from when the light changed."""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.frame import FrameMetadata
from instrument.bench.config import SceneTable, SourceTable
from instrument.bench.source_and_scene import Lights
from instrument.live.light_log import LightLog, light_words

MS = 1_000_000


def test_a_frame_has_the_light_of_its_exposure_not_that_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    now: list[tuple[int, str]] = []
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[-1][0] * MS)
    log = LightLog(lambda: now[-1][1])
    for change in ((0, "nothing lit"), (1000, "scene"), (1001, "scene"), (3000, "point source")):
        now.append(change)
        log.note()
    frame = FrameMetadata(0, None, 2000 * MS, datetime.now(UTC), 100.0, 1.0, "Mono8", 8, 0.0, (0, 0, 4, 4), 1)
    assert log.during(frame) == "scene"
    assert log.during(replace(frame, host_time_ns=900 * MS)) == "nothing lit"
    assert log.during(replace(frame, host_time_ns=1050 * MS)) == "nothing lit, then scene"
    assert log.during(replace(frame, host_time_ns=4000 * MS, exposure_ms=3500.0)) == (
        "nothing lit, then scene, then point source"
    )
    assert log.during(replace(frame, host_time_ns=-500 * MS)) == "", "before anything was known"
    assert log.during(replace(frame, host_time_ns=1129 * MS)) == "nothing lit, then scene", (
        "it may have come 30 ms late"
    )
    assert log.during(replace(frame, host_time_ns=1130 * MS)) == "scene"
    assert log.during(replace(frame, host_time_ns=3000 * MS)) == "scene, then point source"
    assert log.during(replace(frame, host_time_ns=50 * MS)) == "nothing lit"
    since_before = replace(frame, host_time_ns=1050 * MS, exposure_ms=2000.0)
    assert log.during(since_before) == "nothing lit, then scene"


def test_what_the_operator_lights_is_not_known_before_he_was_asked() -> None:
    lights = Lights(SourceTable(), SceneTable(control="operator"), None, None, lambda _: None)

    def words() -> str:
        bench: Any = SimpleNamespace(
            led_array=None, slm=None, scene_lit=lights.scene_lit, knows_scene=lights.knows_scene
        )
        return light_words(bench)

    assert words() == "not known"
    lights.switch_scene(lit=False)
    assert words() == "nothing lit"
    lights.switch_scene(lit=True)
    assert words() == "scene"


@pytest.mark.parametrize(
    ("pattern", "scene", "knows_scene", "source", "words"),
    [
        ("half", False, True, False, "LEDs: half"),
        ("half", True, True, False, "scene and LEDs: half"),
        ("one LED", False, True, True, "point source"),
        ("one LED", True, True, True, "scene and LEDs: one LED"),
        ("", True, True, False, "scene"),
        ("", False, True, False, "nothing lit"),
        ("", False, False, False, "LEDs dark, scene not known"),
    ],
)
def test_what_leds_and_scene_give_is_named(
    pattern: str, scene: bool, knows_scene: bool, source: bool, words: str
) -> None:
    leds = SimpleNamespace(
        is_open=True, pattern=SimpleNamespace(is_dark=not pattern, description=pattern or "dark")
    )
    bench: Any = SimpleNamespace(
        led_array=leds, slm=None, scene_lit=scene, knows_scene=knows_scene, source_lit=source
    )
    assert light_words(bench) == words
    leds.is_open = False
    without = {(True, True): "scene", (False, True): "nothing lit", (False, False): "not known"}
    assert light_words(bench) == without[scene, knows_scene]


def test_a_screen_that_shows_something_is_light() -> None:
    slm = SimpleNamespace(is_screen=True, displayed=np.zeros((2, 3), np.uint8))
    bench: Any = SimpleNamespace(led_array=None, slm=slm, scene_lit=False, knows_scene=True)
    assert light_words(bench) == "nothing lit"
    slm.displayed[1, 1] = 1
    assert light_words(bench) == "screen"
    slm.is_screen = False  # a phase gives no light
    assert light_words(bench) == "nothing lit"
