"""Who can switch which light, what is known of it, and what the devices know of the optics: tables."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.led_array import LedPattern
from instrument.bench.config import GeometryTable, SceneTable, SourceTable
from instrument.bench.source_and_scene import Lights, SourceMount, known_geometry
from instrument.files.errors import BenchError, OperatorNeededError


def lights(control: Any, *, leds: bool, switch: bool, asked: list[str] | None) -> tuple[Lights, list[str]]:
    done: list[str] = []
    array: Any = SimpleNamespace(
        set_pattern=lambda pattern: done.append(pattern.description), off=lambda: done.append("off")
    )
    scene: Any = SimpleNamespace(scene_lit=False)
    source = SourceTable(leds=(3, 4), rgb=(0, 200, 0))
    ask = None if asked is None else asked.append
    return Lights(
        source, SceneTable(control=control), array if leds else None, scene if switch else None, ask
    ), done


@pytest.mark.parametrize("leds", [True, False])
@pytest.mark.parametrize("can_ask", [True, False])
def test_the_source_is_switched_by_its_leds_or_else_by_who_can_be_asked(*, leds: bool, can_ask: bool) -> None:
    asked: list[str] = []
    found, done = lights("operator", leds=leds, switch=False, asked=asked if can_ask else None)
    assert found.can_switch_source == (leds or can_ask)
    if not (leds or can_ask):
        with pytest.raises(OperatorNeededError, match="darken the point source"):
            found.switch_source(lit=False)
        return
    for lit in (True, True, False):
        found.switch_source(lit=lit)
    words = "point source: LED 3, 4 rgb (0, 200, 0)"
    assert done == ([words, words, "off"] if leds else [])
    assert asked == ([] if leds else ["Please light the point source.", "Please darken the point source."])


def test_no_source_is_lit_by_leds_that_light_the_scene() -> None:
    """A sweep took the scene for the PSF, and called it good."""
    found, done = lights("simulated", leds=True, switch=True, asked=None)
    found.scene_switch = SimpleNamespace(scene_lit=False, leds_light_scene=True)
    assert found.no_source.startswith("The LED array lights the scene here, and no point source")
    with pytest.raises(BenchError, match=re.escape(found.no_source)):
        found.switch_source(lit=True)
    found.switch_source(lit=False)
    assert done == ["off"]


@pytest.mark.parametrize("switch", [True, False])
@pytest.mark.parametrize("can_ask", [True, False])
@pytest.mark.parametrize("control", ["operator", "simulated"])
def test_the_scene_is_switched_by_whom_the_configuration_says(
    control: str, *, switch: bool, can_ask: bool
) -> None:
    found, _ = lights(control, leds=True, switch=switch, asked=[] if can_ask else None)
    can = can_ask if control == "operator" else switch
    assert found.can_switch_scene == can
    assert found.knows_scene == (control == "simulated")
    assert not found.scene_lit
    if not can:
        with pytest.raises((BenchError, OperatorNeededError), match=r"no device of this bench|Nobody can be"):
            found.switch_scene(lit=True)
        assert not found.scene_lit
        return
    for lit in (True, False, True):
        found.switch_scene(lit=lit)
        assert found.scene_lit == lit
        assert found.knows_scene


@pytest.mark.parametrize(
    ("levels", "is_source"),
    [
        (((3, (0, 200, 0)), (4, (0, 200, 0))), True),
        (((4, (0, 200, 0)), (5, (0, 0, 0)), (3, (0, 200, 0))), True),
        (((3, (0, 200, 0)),), False),
        (((3, (0, 200, 0)), (4, (0, 200, 0)), (5, (1, 0, 0))), False),
        (((3, (0, 200, 0)), (4, (0, 100, 0))), False),
        (((3, (0, 0, 0)), (4, (0, 0, 0))), False),
        ((), False),
    ],
)
def test_a_pattern_is_the_source_where_it_lights_these_leds_so_and_no_others(
    levels: Any, *, is_source: bool
) -> None:
    found, _ = lights("operator", leds=True, switch=False, asked=None)
    assert found.is_source(LedPattern("any", levels)) == is_source
    assert found.is_source(found.source_pattern)


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("binning", [1, 4])
def test_what_is_configured_counts_before_what_the_devices_know(
    *, configured: bool, known: bool, binning: int
) -> None:
    ours: Any = {"pixel_pitch_um": 3.0, "diffuser_distance_mm": 7.0, "aperture_mm": (1.0, 2.0)}
    table = GeometryTable(**ours if configured else {})
    camera: Any = SimpleNamespace(pixel_pitch_um=5.0, binning=binning)
    shared: list[Any] = [SimpleNamespace()]
    if known:
        shared.append(SimpleNamespace(distance_um=8_500.0, aperture_mm=(4.0, 6.0)))
    found = known_geometry(table, camera, shared)
    assert found.pixel_pitch_um == (3.0 if configured else 5.0) * binning
    assert found.diffuser_distance_mm == (7.0 if configured else 8.5 if known else None)
    assert found.aperture_mm == ((1.0, 2.0) if configured else (4.0, 6.0) if known else None)
    assert found.wavelength_nm == table.wavelength_nm


def test_the_source_is_where_the_stage_is_and_what_it_is_mounted_with() -> None:
    axes = [SimpleNamespace(name=name) for name in ("x_um", "z_um")]
    stage: Any = SimpleNamespace(name="stage", axes=axes, position=lambda: {"x_um": 10.0, "z_um": 5.0})
    mount = SourceMount(stage, (1.0, -2.0, 100.0))
    assert mount.position_um == (11.0, -2.0, 105.0)
    assert mount.target(4.0, None, 90.0) == {"x_um": 3.0, "z_um": -10.0}
    assert mount.target(None, -2.0, None) == {}
    for y_um in (-2.0 + 1.5e-6, 2.0):
        with pytest.raises(BenchError, match="no axis y_um, so the source stays at y_um = -2; it cannot go"):
            mount.target(None, y_um, None)
