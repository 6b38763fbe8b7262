"""A stage with play and a wrong scale is measured by the PSF, and its play is taken out of sweeps."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from scipy import ndimage

from calibration_routines.optics import stage_play
from calibration_routines.optics.stage_play import (
    ROUTINES,
    AxisPlay,
    StageCheck,
    StagePlay,
    StageProcedure,
    StageRecord,
    planned,
    stage_plan,
)
from calibration_routines.plan_procedures import _restore_after_gaps
from calibration_routines.scatter import LARGEST_PX, STEADY, growth
from drivers.simulated.world import SimulatedWorld
from drivers.stage import approached
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.errors import SettingsError
from instrument.plan import Part, Plan, SourcePoints, check, estimate
from instrument.plan.model import PlanError
from instrument.runs.acquire import abilities_of
from recon.camera.registration import moved
from recon.types import Geometry

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
{stage}
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
"""
LARGE = Geometry(pixel_pitch_um=6.5, diffuser_distance_mm=8.9)
LOOSE = "axes = {x_um = {backlash = 200, scale = 1.05}, y_um = {backlash = 120}, z_um = {backlash = 200}}\n"


def tiny(stage: str = "") -> Bench:
    return open_bench(parse_config(TINY.format(stage=stage), None))


def test_play_and_scale_of_each_axis_are_found_and_said(tmp_path: Path) -> None:
    with tiny(LOOSE) as bench:
        done = StageProcedure(StageCheck(turns=2, average=1, dark_frames=2)).carry_out(bench, tmp_path)
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
    found = {axis.name: axis for axis in done.result.axes}  # type: ignore[attr-defined]
    assert [found[name].play_um for name in ("x_um", "y_um", "z_um")] == pytest.approx(
        [210, 120, 200], abs=10
    )
    assert found["x_um"].scale_error == pytest.approx(0.05, abs=0.005)
    assert abs(found["y_um"].scale_error) < 0.005
    assert not done.good
    assert [words.split(" ")[1] for words in done.verdict if words.startswith("Quality")] == [
        "x",
        "x",
        "y",
        "z",
    ]
    assert done.verdict[-1].startswith("For [stage] of bench.toml: play = { x_um = 2")
    with pytest.raises(SettingsError, match="choose another place or a smaller reach"), tiny() as bench:
        StageProcedure(StageCheck(z_um=8.2e3)).outlook(bench)


def test_pixels_that_turn_hot_meanwhile_are_not_taken_for_the_stages(tmp_path: Path) -> None:
    hot = TINY.format(stage="") + "late_hot_pixels = 600\nlate_hot_e_per_s = 1e6\nlate_hot_after_s = 8\n"
    with open_bench(parse_config(hot, None)) as bench:
        done = StageProcedure(StageCheck(turns=2, average=1, dark_frames=2)).carry_out(bench, tmp_path)
    assert done.good, done.verdict
    assert any(line.startswith("Sensor: 600 pixels turned hot") for line in done.verdict)


def test_a_check_that_goes_on_comes_to_its_places_from_where_it_came() -> None:
    asked = StageCheck(turns=2, average=1)
    with tiny(LOOSE) as bench:
        assert bench.stage is not None
        world = bench.shared["simulated"]
        assert isinstance(world, SimulatedWorld)
        plan = stage_plan(planned(bench, asked), asked, 1.0)
        steps = [step for step in plan.steps() if step.stage]
        bench.stage.home()
        came = []
        for step in steps:
            bench.stage.move_to(step.stage)
            came.append(world.source_position_um)
        restore = ROUTINES[0].restore
        assert restore is not None
        for step, place in list(zip(steps, came, strict=True))[1:]:
            bench.stage.home()
            restore(Mock(plan=plan), bench, step.index)
            bench.stage.move_to(step.stage)
            assert world.source_position_um == pytest.approx(place, abs=10), step.label
        runner, seen = Mock(on_frame=None), dict(zip((step.index for step in steps), came, strict=True))
        todo = [steps[2].index, steps[5].index, steps[6].index, steps[11].index]
        _restore_after_gaps(runner, partial(restore, Mock(plan=plan), bench), todo)
        bench.stage.home()
        restore(Mock(plan=plan), bench, todo[0])
        for step in (step for step in steps if step.index in todo):
            bench.stage.move_to(step.stage)
            assert world.source_position_um == pytest.approx(seen[step.index], abs=10), step.label
            runner.on_frame(step, Mock())


def test_a_play_too_unsteady_for_the_line_is_not_told_to_be_put_there() -> None:
    steady, unsteady = (
        AxisPlay("x_um", 200.0, 0.3, 0.5, 0.0, 0.0),
        AxisPlay("y_um", 200.0, 70.0, 0.5, 0.0, 0.0),
    )
    found = StagePlay((steady, unsteady), STEADY, 40e3, 1600.0, 10.0)
    assert list(found.play) == ["x_um"]
    assert "put the line" in found.findings[0]
    assert "y stayed behind by 200 +- 70 um" in found.findings[1]


def there_and_back(z_um: float) -> Plan:
    points = SourcePoints(points_um=((0, 0, 80e3), (0, 0, z_um)))
    return Plan(label="p", parts=(Part(label="p", positions=points),))


def test_the_source_comes_to_every_place_from_one_side() -> None:
    stage = "play = { x_um = 205, y_um = 118, z_um = 207 }\n" + LOOSE.replace(", scale = 1.05", "")
    places = np.random.default_rng(2).uniform((-20e3, -20e3, 60e3), (20e3, 20e3, 150e3), (12, 3))
    places[5] = places[4] + (0.0, 50.0, -20.0)
    with tiny(stage) as bench:
        assert bench.stage is not None
        world = bench.shared["simulated"]
        assert isinstance(world, SimulatedWorld)
        bench.stage.home()
        for place in places:
            bench.place_source(*place)
            assert world.source_position_um == pytest.approx(tuple(place), abs=10)
        with pytest.raises(PlanError, match="cannot be approached from below"):
            check(there_and_back(8.1e3), abilities_of(bench))
        cost = estimate(there_and_back(60e3), abilities_of(bench))
        assert cost.approaches == 2
        assert cost.approach_seconds > 0


def test_an_axis_goes_below_a_place_only_where_it_must() -> None:
    play = {"x_um": 10.0}
    here = {"x_um": 0.0, "y_um": 0.0}
    assert approached(here, {"x_um": 20.0, "y_um": -5.0}, play) == [{"x_um": 20.0, "y_um": -5.0}]
    assert approached(here, {"x_um": 8.0}, play) == [{"x_um": -7.0}, {"x_um": 8.0}]
    assert approached(here, {"x_um": 8.0}, play, ["x_um"]) == [{"x_um": 8.0}]
    assert approached(here, {"x_um": 0.0}, play, ["x_um"]) == [{"x_um": 0.0}]
    assert approached(here, {"x_um": -1.0}, play, ["x_um"]) == [{"x_um": -16.0}, {"x_um": -1.0}]
    assert approached(here, {"y_um": -5.0}, play) == [{"y_um": -5.0}]


def test_the_way_along_z_on_a_large_sensor_is_read_from_larger_pixels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    texture = ndimage.gaussian_filter(np.random.default_rng(3).random((800, 1000)), 5.0)
    reference = ((texture - texture.min()) * 1e5).astype(np.float32)
    z_um, d_um, gone_um = 60e3, 8.9e3, -300.0
    larger = (1 + d_um / (z_um + gone_um)) / (1 + d_um / z_um)
    image = moved(stage_play._resized(reference, larger), 0.7, -1.3)
    asked: list[int] = []

    def asked_of(seen: np.ndarray, other: np.ndarray) -> float:
        asked.append(other.size)
        return growth(seen, other)

    monkeypatch.setattr(stage_play, "growth", asked_of)
    record = StageRecord(z_um, 1000.0, 4, ("z_um",), {}, LARGE, {}, "", simulated=True)
    assert stage_play._moved_um(image, reference, "z_um", record) == pytest.approx(gone_um, abs=2.0)
    assert max(asked) <= LARGEST_PX < reference.size
