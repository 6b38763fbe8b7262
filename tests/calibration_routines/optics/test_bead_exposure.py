"""Slides of beads that saturate are photographed again, shorter, and that is said; what was left goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration_routines import CalibrationError
from calibration_routines.optics import bead_photographs as beads
from calibration_routines.optics.bead_photographs import BEADS, BeadSlides, photograph_slides
from calibration_routines.optics.beads import BeadProcedure
from calibration_routines.options import Size
from calibration_routines.plan_procedures import ResumeProcedure, goes_on_with_frames, left_unfinished
from calibration_routines.procedure import Listener
from calibration_routines.scatter import STEADY
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.files.calibration_file import load_calibration
from instrument.runs.run import Run
from instrument.runs.run_control import EndedEarlyError, RunControl


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
            shared={"world": changer},
            ask=None,
            camera=camera,
            label="bench",
            simulated_kinds=(),
            geometry=None,
        )

        def photograph(_series: Any, _number: int, exposure_ms: float) -> Any:
            taken_ms.append(exposure_ms)
            many = 7 if exposure_ms > saturate_ms[slide[0]] else 0
            run = SimpleNamespace(path=Path("run"))
            picture = np.ones((4, 4), np.float32)
            return SimpleNamespace(
                saturated_pixels=many, findings=(), run=run, measurement=picture, scatter=STEADY
            )

        monkeypatch.setattr(beads._Series, "_take", photograph)
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
    assert ended.value.__notes__[0].startswith("1 slide photographed before. To go on: diffuserbench resume")
    with pytest.raises(CalibrationError, match="taken 2 times, at 8 ms, the camera's shortest exposure: dim"):
        photographed([1.0, 1.0], 8.0)
    with pytest.raises(CalibrationError, match="taken 1 time, at 10 ms, the camera's"):
        photographed([1.0, 1.0], 10.0)


BENCH = """
[bench]
data_folder = "{folder}"
[camera]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
scene = "beads"
scene_distance_mm = 80.0
beads = 4
time_scale = 0
"""


class Ends(Listener):
    """Ends a procedure at a step, or after so many frames of it."""

    def __init__(self, control: RunControl, step: str, frames: int = 0) -> None:
        self._control, self._step, self._frames = control, step, frames
        self._there = False

    def step(self, words: str) -> None:
        self._there = words.startswith(self._step)
        if self._there and not self._frames:
            self._control.abort()

    def frame(self, status: Any) -> None:
        if self._there and status.done == self._frames:
            self._control.abort()


def test_slides_that_were_left_go_on_wherever_they_were_left(tmp_path: Path) -> None:
    """In the middle of a photograph, between two, and while they are solved: each is taken once."""
    folder = tmp_path / "runs"
    slides = BeadSlides(z_um=80e3, images=3, average=1, binning=8, grid=Size(1, 1), rank=1, iterations=3)
    procedure = BeadProcedure(replace(slides, degree=0))
    with open_bench(parse_config(BENCH.format(folder=folder), None)) as bench:
        control = RunControl()
        ends = Ends(control, "photographing bead slide 2", frames=3)
        with pytest.raises(CalibrationError):
            procedure.carry_out(bench, folder, control=control, listener=ends)
        shown: list[int] = []
        changer = next(part for part in bench.shared.values() if hasattr(part, "change_slide"))
        change = changer.change_slide
        changer.change_slide = lambda number: (shown.append(number), change(number))
        for step in ("photographing bead slide 3", "blind deconvolution"):
            left = left_unfinished(folder, ["beads"])
            assert left is not None
            control = RunControl()
            with pytest.raises((EndedEarlyError, CalibrationError)):
                ResumeProcedure(left).carry_out(bench, control=control, listener=Ends(control, step))
        assert shown == [1, 2, 2]
        left = left_unfinished(folder, ["beads"])
        assert left is not None
        assert goes_on_with_frames(left)
        done = ResumeProcedure(left).carry_out(bench)
    runs = sorted(path for path in folder.iterdir() if (path / BEADS.file).is_file())
    whole = [run for run in runs if (run / "beads.tif").is_file()]
    assert [BEADS.read(run).number for run in whole] == [0, 1, 2]
    assert set(done.runs) == set(whole)
    assert all(len(Run.open(run).records) == 5 for run in whole)
    kept = load_calibration(done.calibration)
    assert kept.psfs.shape[0] == 1
    assert kept.quality["good"]
    assert kept.quality["scatter"]["frames"] == 1
    assert left_unfinished(folder, ["beads"]) is None
    assert not any(BEADS.lacks_result(run) for run in runs)
