"""Slides of beads that saturate are photographed again, shorter, and that is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration_routines import CalibrationError
from calibration_routines.optics import beads
from calibration_routines.optics.beads import BeadSlides, photograph_slides
from calibration_routines.procedure import Listener
from instrument.runs.run_control import RunControl


class Told(Listener):
    def __init__(self) -> None:
        self.words: list[str] = []

    def said(self, words: str) -> None:
        self.words.append(words)


@pytest.fixture
def photographed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[list[float], Told]]:
    """Photograph slides that saturate beyond an exposure each; returns the exposures and what was said."""

    def take(saturate_ms: list[float], shortest_ms: float) -> tuple[list[float], Told]:
        told, taken_ms, slide = Told(), [], [0]
        changer = SimpleNamespace(slide_z_um=80e3, change_slide=lambda number: slide.__setitem__(0, number))
        camera = SimpleNamespace(exposure_limits_ms=(shortest_ms, 1e3))
        bench: Any = SimpleNamespace(
            shared={"world": changer}, ask=None, camera=camera, label="bench", simulated_kinds=()
        )

        def photograph(_bench: Any, exposure_ms: float, *_: Any, **__: Any) -> Any:
            taken_ms.append(exposure_ms)
            many = 7 if exposure_ms > saturate_ms[slide[0]] else 0
            run = SimpleNamespace(path=Path("run"))
            return SimpleNamespace(
                saturated_pixels=many, findings=(), run=run, measurement=np.ones((4, 4), np.float32)
            )

        monkeypatch.setattr(beads, "photograph", photograph)
        monkeypatch.setattr(beads, "expose_scene", lambda *_, **__: SimpleNamespace(exposure_ms=10.0))
        monkeypatch.setattr(beads, "write_image", lambda *_: None)
        monkeypatch.setattr(beads, "photograph_findings", lambda _: ())
        photograph_slides(bench, BeadSlides(images=len(saturate_ms)), None, RunControl(), told)
        return taken_ms, told

    return take


def test_a_slide_that_saturates_is_taken_shorter_and_so_are_those_after_it(
    photographed: Callable[..., tuple[list[float], Told]],
) -> None:
    taken_ms, told = photographed([20.0, 8.0, 20.0], 0.1)
    assert taken_ms == pytest.approx([10.0, 10.0, 7.0, 7.0])
    assert told.words == [
        "Photograph 2 saturates in 7 pixels at 10 ms: it is taken again at 7 ms, "
        "and those that follow as short."
    ]
    taken_ms, told = photographed([8.5, 8.5], 8.0)
    assert taken_ms == pytest.approx([10.0, 8.0, 8.0])
    with pytest.raises(CalibrationError, match=r"taken 3 times, at 4.9 ms: dim"):
        photographed([1.0, 1.0], 0.1)
    with pytest.raises(CalibrationError) as ended:
        photographed([20.0, 1.0], 0.1)
    assert ended.value.__notes__ == ["1 slide photographed before: run"]
    with pytest.raises(CalibrationError, match="taken 2 times, at 8 ms, the camera's shortest exposure: dim"):
        photographed([1.0, 1.0], 8.0)
    with pytest.raises(CalibrationError, match="taken 1 time, at 10 ms, the camera's"):
        photographed([1.0, 1.0], 10.0)
