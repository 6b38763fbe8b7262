"""A plan is data: it iterates, counts, survives JSON, and names every step a bench cannot do."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.led_array import LedPattern
from drivers.stage import StageAxis
from instrument.plan import (
    OFF,
    SOURCE,
    BenchAbilities,
    Light,
    Part,
    Plan,
    PlanError,
    SourceGrid,
    SourcePoints,
    Span,
    StagePoints,
    check,
    estimate,
)
from instrument.plan.abilities import BYTES_A_FRAME_BESIDE_THE_IMAGE as BESIDE
from instrument.plan.model import load_plan

AXES = (
    StageAxis("x_um", -100.0, 100.0, 1000.0, 0.1),
    StageAxis("y_um", -100.0, 100.0, 1000.0, 0.1),
    StageAxis("z_um", 0.0, 50_000.0, 1000.0, 0.1),
)


def abilities(**changes: object) -> BenchAbilities:
    given: dict[str, object] = {
        "frame_shape": (10, 20),
        "frame_dtype": np.dtype(np.uint16),
        "exposure_ms": 10.0,
        "exposure_limits_ms": (0.1, 1000.0),
        "gain_limits": (1.0, 16.0),
        "stage_axes": AXES,
        "stage_position": {"x_um": 0.0, "y_um": 0.0, "z_um": 0.0},
        "stage_target": lambda p: dict(zip(("x_um", "y_um", "z_um"), p, strict=True)),
        "n_leds": 4,
        "slm_shape": (4, 6),
        "slm_settle_ms": 500.0,
    }
    return BenchAbilities(**(given | changes))  # type: ignore[arg-type]


def sweep() -> Plan:
    return Plan(
        label="axial sweep",
        parts=(
            Part(label="dark", average=4, exposures_ms=(5.0,)),
            Part(
                label="psf",
                light=(SOURCE,),
                exposures_ms=(5.0, 20.0),
                positions=SourceGrid(z_um=Span(start=10_000, stop=40_000, number=3, spacing="dioptric")),
            ),
            Part(label="scene", scene_lit=True),
        ),
    )


def test_steps_are_numbered_through_and_carry_their_part() -> None:
    steps = list(sweep().steps())
    assert len(sweep()) == len(steps) == 1 + 3 * 2 + 1
    assert [step.index for step in steps] == list(range(8))
    assert [step.label for step in steps] == ["dark", *["psf"] * 6, "scene"]
    assert [step.exposure_ms for step in steps] == [5, 5, 20, 5, 20, 5, 20, None]
    assert steps[0].light == OFF
    assert steps[1].light == SOURCE
    assert steps[-1].scene_lit
    assert sweep().exposures == 4 + 6 + 1


def test_dioptric_depths_are_even_in_one_over_z() -> None:
    depths = [step.source_um[2] for step in sweep().steps() if step.source_um and step.exposure_ms == 5]
    assert depths[0] == 10_000
    assert depths[-1] == 40_000
    assert np.allclose(np.diff(1 / np.array(depths)), -0.75 / 10_000 / 2)


def test_a_span_across_zero_has_no_dioptric_spacing() -> None:
    with pytest.raises(ValueError, match="one sign"):
        Span(start=-1, stop=1, number=3, spacing="dioptric")


def test_a_serpentine_moves_one_neighbour_at_a_time_and_misses_none() -> None:
    grid = SourceGrid(x_um=(0, 1, 2), y_um=(0, 1, 2), z_um=(0, 1), serpentine=True)
    points = list(grid.sources())
    assert len(set(points)) == len(points) == len(grid) == 18
    assert all(sum(abs(a - b) for a, b in zip(p, q, strict=True)) == 1 for p, q in pairwise(points))


def test_the_order_of_a_grid_and_of_the_loops_is_the_users() -> None:
    grid = SourceGrid(x_um=(0, 1), z_um=(5, 6), order="xyz")
    assert [p[::2] for p in grid.sources()] == [(0, 5), (0, 6), (1, 5), (1, 6)]
    part = Part(
        label="a",
        exposures_ms=(1, 2),
        repeats=2,
        order=("exposure", "light", "slm", "position", "repeat"),
    )
    assert [(s.exposure_ms, s.repeat) for s in part.steps()] == [(1, 0), (1, 1), (2, 0), (2, 1)]


def test_gains_run_with_exposures() -> None:
    part = Part(label="a", exposures_ms=(1, 2), gains=(8, 4))
    assert [(s.exposure_ms, s.gain) for s in part.steps()] == [(1, 8), (2, 4)]
    with pytest.raises(ValueError, match="as many exposures"):
        Part(label="a", exposures_ms=(1, 2), gains=(8, 4, 2))


def test_a_plan_survives_json() -> None:
    pattern = LedPattern("two LEDs", ((0, (255, 0, 0)), (3, (0, 0, 9))))
    plan = Plan(
        label="everything",
        parts=(
            Part(label="a", light=(Light.of(pattern), OFF), positions=SourcePoints(points_um=((1, 2, 3),))),
            Part(label="b", positions=StagePoints(points=({"x_um": 1},)), slm_images=(Path("x.png"),)),
            *sweep().parts,
        ),
    )
    again = Plan.from_json(plan.to_json())
    assert again == plan
    assert again.digest == plan.digest
    assert list(again.steps()) == list(plan.steps())
    assert next(again.steps()).light.pattern() == pattern


def test_every_mistake_of_a_plan_is_named() -> None:
    with pytest.raises(PlanError) as caught:
        Plan.checked(
            {
                "label": "x",
                "parts": [{"label": "a", "avrage": 3}, {"label": "b", "exposure_ms": -1, "light": "on"}],
            }
        )
    text = str(caught.value)
    assert all(words in text for words in ("parts[0].avrage", "parts[1].exposures_ms[0]", "parts[1].light"))
    assert len(caught.value.problems) == 3
    with pytest.raises(PlanError) as caught:
        Plan.checked({"label": "x", "parts": [{"light": "source", "average": "many"}]})
    missing, other = caught.value.problems
    assert missing == "parts[0].label: this key is missing"
    assert other.startswith("parts[0].average: must be an integer")


def test_everything_out_of_reach_is_named_with_its_steps() -> None:
    plan = Plan(
        label="far",
        parts=(
            Part(label="psf", positions=SourceGrid(x_um=(0, 300, 400), z_um=(10.0, 60_000.0))),
            Part(label="b", exposures_ms=(0.01,), gains=(99,)),
            Part(label="c", light=(Light(kind="pattern", leds=((9, 1, 1, 1),)),)),
            Part(label="d", positions=StagePoints(points=({"roll_mrad": 1},))),
        ),
    )
    with pytest.raises(PlanError) as caught:
        check(plan, abilities())
    text = str(caught.value)
    for words in (
        "steps 3-5: z_um = 60000 is outside",
        "steps 1, 4: x_um = 300",
        "steps 2, 5: x_um = 400",
        "step 6: exposure 0.01 ms",
        "step 6: gain 99",
        "step 7: LED 9 does not exist",
        "step 8: stage axis 'roll_mrad' does not exist",
    ):
        assert words in text
    assert len(caught.value.problems) == 7


def test_a_bench_without_stage_leds_or_slm_refuses_what_needs_them() -> None:
    plan = Plan(
        label="x",
        parts=(
            Part(label="a", positions=SourcePoints(points_um=((0, 0, 1),))),
            Part(label="b", light=(Light(kind="pattern", leds=((0, 1, 1, 1),)),)),
            Part(label="c", slm_images=(Path("a.png"),)),
        ),
    )
    bare = abilities(stage_axes=(), stage_target=None, n_leds=0, slm_shape=None)
    with pytest.raises(PlanError) as caught:
        check(plan, bare)
    assert [problem[:6] for problem in caught.value.problems] == ["step 0", "step 1", "step 2"]
    with pytest.raises(PlanError) as caught:
        check(sweep(), abilities(no_source="The LEDs light the scene."))
    assert caught.value.problems == ('steps 1-6: light "source": The LEDs light the scene.',)


def test_slm_images_are_looked_at_before_anything_moves(tmp_path: Path) -> None:
    good, large, colour = (tmp_path / f"{name}.png" for name in ("good", "large", "colour"))
    cv2.imwrite(str(good), np.zeros((4, 6), np.uint8))
    cv2.imwrite(str(large), np.zeros((8, 6), np.uint8))
    cv2.imwrite(str(colour), np.zeros((4, 6, 3), np.uint8))
    check(Plan(label="x", parts=(Part(label="a", slm_images=(good,)),)), abilities())
    bad = Plan(label="x", parts=(Part(label="a", slm_images=(large, colour, tmp_path / "none.png")),))
    with pytest.raises(PlanError) as caught:
        check(bad, abilities())
    assert len(caught.value.problems) == 3


def test_a_disk_that_is_too_small_is_refused() -> None:
    with pytest.raises(PlanError, match="only 1 kB are free"):
        check(sweep(), abilities(free_bytes=1000))


def test_the_estimate_counts_frames_bytes_moves_and_seconds() -> None:
    plan = Plan(
        label="x",
        parts=(
            Part(
                label="a",
                exposures_ms=(100,),
                positions=SourcePoints(points_um=((0, 0, 1000), (50, 0, 3000))),
            ),
        ),
    )
    found = estimate(plan, abilities())
    assert (found.frames, found.moves, found.total_bytes) == (2, 2, 2 * (10 * 20 * 2 + BESIDE))
    assert found.seconds == pytest.approx(1 + 2 + 0.2)
    averaged = Plan(label="x", parts=(Part(label="a", average=10, repeats=3, interval_s=60),))
    found = estimate(averaged, abilities())
    assert found.total_bytes == 3 * (10 * 20 * 4 + BESIDE)
    assert found.exposures == 30
    assert found.seconds == pytest.approx(120 + 0.1)
    # A simulated bench that waits for nothing waits for intervals all the same.
    found = estimate(averaged, abilities(time_scale=0.0))
    assert (found.seconds, found.waited_s) == pytest.approx((120 + 0.1, 120))
    short = Plan(label="x", parts=(Part(label="a", exposures_ms=(2,)),))
    assert estimate(short, abilities()).time == "less than 0.1 s"
    long = Plan(label="x", parts=(Part(label="a", average=10, exposures_ms=(200,)),))
    found = estimate(long, abilities(time_scale=0.0))
    assert found.time == "2.0 s (simulated: less than 0.1 s by the clock)"
    assert found.time_of_motion == ("2.0 s of exposure and motion (simulated: less than 0.1 s by the clock)")


def test_a_key_that_stands_twice_in_a_plan_is_a_mistake(tmp_path: Path) -> None:
    part = '{"label": "a", "exposures_ms": [1], "exposures_ms": [2]}'
    (path := tmp_path / "plan.json").write_text(f'{{"label": "x", "parts": [{part}]}}')
    with pytest.raises(PlanError, match="the key 'exposures_ms' stands there twice"):
        load_plan(path)
