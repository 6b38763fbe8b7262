"""Runs that are damaged in several files' tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from instrument.plan import Part, Plan
from instrument.runs.run import FinishReason
from instrument.runs.writer import FrameToStore, RunWriter
from tests.instrument.runs.test_store import BENCH, frame


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two completed runs of plans that differ, frames distinct."""
    paths = []
    for number in (0, 1):
        plan = Plan(label=f"run {number}", parts=(Part(label="a", repeats=3 + number, exposures_ms=(5.0,)),))
        with RunWriter.create(
            tmp_path_factory.mktemp("runs"), label=plan.label, bench=BENCH, plan=plan
        ) as writer:
            writer.start(steps=len(plan))
            stored = [frame(100 * number + i) for i in range(3 + number)]
            writer.write([FrameToStore(i, one.image, one.metadata) for i, one in enumerate(stored)])
            paths.append(writer.finish(FinishReason.COMPLETED).path)
    return paths[0], paths[1]
