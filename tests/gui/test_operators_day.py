"""An operator's day, sampled: start page, a lit picture, the end. All of it: benchmarks/gui_day.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.gui.day import STEPS, Operator
from tests.gui.looks import SIZES


@pytest.mark.usefixtures("qapp")
def test_the_day_begins_and_ends(tmp_path: Path) -> None:
    assert len(STEPS) == 60
    operator = Operator(tmp_path, SIZES["1366x768"])
    for step in (*STEPS[:3], *STEPS[4:9], STEPS[-1]):
        step.do(operator)
