"""Axes of a controller as axes of the bench: units, directions, limits."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from drivers.common.stage_axes import AXIS_NAMES, AxisMap, AxisName, AxisOptions, check_target
from drivers.errors import LimitError
from drivers.stage import StageAxis

X = StageAxis("x_um", -10.0, 10.0, 1.0, 0.1)
YAW = StageAxis("yaw_mrad", 0.0, 5.0, 1.0, 0.01)


@given(
    steps=st.integers(-(2**31), 2**31 - 1),
    scale=st.floats(1e-4, 1e4).flatmap(lambda size: st.sampled_from([size, -size])),
)
def test_steps_survive_the_way_to_the_bench_and_back(steps: int, scale: float) -> None:
    axis = AxisMap("x_um", "axis X", scale)
    assert round(axis.to_controller(axis.to_bench(steps))) == steps


def test_a_reversed_axis_swaps_its_ends() -> None:
    axis = AxisMap("z_um", "axis Z", -1000.0).stage_axis(
        "stage (test)", AxisOptions(upper_limit=150_000.0), ends=(-200.0, 0.0), speed_per_s=5, resolution=0.01
    )
    assert axis == StageAxis("z_um", 0.0, 150_000.0, 5000.0, 10.0)
    assert str(axis.lower_limit) == "0.0"  # not -0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (AxisOptions(upper_limit=2001.5), "reach beyond the controller's own, 0 to 2000"),
        (AxisOptions(lower_limit=-2.0), "reach beyond"),
        (AxisOptions(lower_limit=2000.5), "no range is left between 2000.5 and 2000"),
    ],
)
def test_soft_limits_that_are_none_are_refused(options: AxisOptions, words: str) -> None:
    axis = AxisMap("x_um", "device 3 axis 1", 0.5)
    with pytest.raises(LimitError, match=words) as caught:
        axis.stage_axis("stage (test)", options, ends=(0, 4000), speed_per_s=1, resolution=1)
    assert "x_um (device 3 axis 1)" in str(caught.value)


def test_soft_limits_may_be_a_step_beyond_and_a_range_is_more_than_a_place() -> None:
    axis = AxisMap("x_um", "axis X", 0.5)

    def made(**limits: float) -> StageAxis:
        return axis.stage_axis(
            "stage (test)", AxisOptions(**limits), ends=(4000, 0), speed_per_s=-3, resolution=-2
        )

    assert made(lower_limit=-1.0, upper_limit=2001.0) == StageAxis("x_um", 0.0, 2000.0, 1.5, 1.0)
    assert made(lower_limit=5.0) == StageAxis("x_um", 5.0, 2000.0, 1.5, 1.0)
    for limits in ({"lower_limit": 2000.0}, {"upper_limit": 0.0}, {"upper_limit": -1.0}):
        with pytest.raises(LimitError, match="no range is left"):
            made(**limits)


@pytest.mark.parametrize("upper", [500.0, 100.0, math.nan])
def test_an_upper_limit_not_above_the_lower_is_a_mistake_of_the_configuration(upper: float) -> None:
    with pytest.raises(ValidationError, match="must be above lower_limit = 500") as caught:
        AxisOptions(lower_limit=500.0, upper_limit=upper)
    assert caught.value.errors()[0]["loc"] == ("upper_limit",)  # the line that is named


@pytest.mark.parametrize("scale", [0.0, math.nan, math.inf])
def test_a_scale_must_scale(scale: float) -> None:
    with pytest.raises(ValueError, match="is no scale"):
        AxisMap("x_um", "axis X", scale)


def test_every_mistake_of_a_target_is_named() -> None:
    target = {"x_um": 10.1, "yaw_mrad": math.nan, "warp_um": 0.0}
    with pytest.raises(LimitError) as caught:
        check_target("stage (test)", (X, YAW), target, homed=True)
    for words in ("x_um = 10.1 lies outside -10 to 10", "yaw_mrad = nan", "no axis warp_um", "Nothing moved"):
        assert words in str(caught.value)
    check_target("stage (test)", (X, YAW), {"x_um": 10.0, "yaw_mrad": 0.0}, homed=True)
    with pytest.raises(LimitError, match="not homed"):
        check_target("stage (test)", (X, YAW), {}, homed=False)


def test_axis_names_are_the_benchs() -> None:
    class Model(BaseModel):
        axes: dict[AxisName, AxisOptions]

    Model.model_validate({"axes": {name: {} for name in AXIS_NAMES}})
    with pytest.raises(ValidationError, match=r"must be an axis of the bench \(x_um, y_um"):
        Model.model_validate({"axes": {"x_mm": {}}})
