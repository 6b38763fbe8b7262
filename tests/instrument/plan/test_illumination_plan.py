"""A plan of active illumination takes one dark frame and one a group."""

from __future__ import annotations

import pytest

from instrument.files.errors import BenchError
from instrument.plan import Plan
from instrument.plan.illumination import illumination_plan
from instrument.plan.patterns import group_lights


def test_each_group_is_lit_once_after_the_dark() -> None:
    plan = illumination_plan(group_lights([[0, 1], [5], [7, 8, 9]], 100), exposure_ms=20)
    steps = list(plan.steps())
    assert [step.label for step in steps] == ["dark", "pattern", "pattern", "pattern"]
    assert [tuple(led[0] for led in step.light.leds) for step in steps] == [(), (0, 1), (5,), (7, 8, 9)]
    assert {led[1:] for step in steps for led in step.light.leds} == {(100, 100, 100)}
    assert {step.exposure_ms for step in steps} == {20}
    assert Plan.from_json(plan.to_json()) == plan


@pytest.mark.parametrize(("groups", "level"), [([], 9), ([[1], []], 9), ([[1]], 0), ([[1]], 256)])
def test_impossible_groups_are_refused(groups: list[list[int]], level: int) -> None:
    with pytest.raises(BenchError):
        illumination_plan(group_lights(groups, level), exposure_ms=1)
