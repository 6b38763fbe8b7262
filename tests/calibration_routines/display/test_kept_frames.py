"""Frames of the display's routines are kept: a routine goes on with them, or sees all of them again."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from calibration_routines.display import display_learning, kept_frames
from calibration_routines.display.display_learning import LearningProcedure
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.kept_frames import KeptFrames, kept_words
from calibration_routines.display.mask_alignment import (
    AlignmentFailedError,
    AlignmentProcedure,
    AlignmentSettings,
)
from calibration_routines.display.slm_calibration import SlmProcedure
from calibration_routines.plan_procedures import ResumeProcedure
from calibration_routines.procedure import Listener, Outcome
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.files.atomic import SPARE_BYTES
from instrument.files.errors import BenchError
from instrument.files.slm_image import load_slm_correction
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.writer import RunWriter
from recon.errors import InputError
from tests.calibration_routines.display.test_mask_alignment import BENT, small

BENCH = small(shape="[120, 160]")
TEXT = BENCH.replace("settle_ms = 30.0", BENT)
ENDS_AT = 2
"""Before the levels, which one sequence of the hardware takes."""


class Ends(Listener):
    """Asks a routine to end after some frames."""

    def __init__(self, control: RunControl) -> None:
        self.control = control

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        if done >= ENDS_AT:
            self.control.abort()


def measured(
    folder: Path, out: str, control: RunControl | None = None, again: Path | None = None, levels: int = 9
) -> Outcome:
    control = control or RunControl()
    with Bench(parse_config(TEXT, None)).open() as bench:
        procedure = SlmProcedure(levels=levels, out=folder / out, again=again)
        listener = Ends(control) if again is None and out == "first.json" else Listener()
        return procedure.carry_out(bench, folder, control=control, listener=listener)


def test_a_table_that_ended_early_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(EndedEarlyError) as ended:
        measured(tmp_path, "first.json")
    (path,) = (p for p in tmp_path.iterdir() if p.is_dir())
    typed = f"diffuserbench calibrate slm --levels 9 --out {tmp_path / 'first.json'} --again {path}"
    typed = f"{typed} --bench {path / 'bench.toml'}"
    assert typed in ended.value.__notes__[0]
    run = Run.open(path)
    assert (run.condition, len(run.records)) == (RunCondition.ABORTED, ENDS_AT)
    with Bench(parse_config(TEXT, None)).open() as bench:
        words = ResumeProcedure(path).carry_out(bench, tmp_path).verdict
    assert typed in " ".join(words)

    began = run.metadata(1).host_time_ns
    gone_on = measured(tmp_path, "on.json", again=path)
    run = Run.open(path)
    assert gone_on.runs == (path,)
    assert (run.condition, run.plan) == (RunCondition.COMPLETED, None)
    assert run.metadata(1).host_time_ns == began  # seen again, not taken again
    assert not run.missing()

    monkeypatch.setattr(Bench, "snap", lambda *_: pytest.fail("a frame was taken"))
    measured(tmp_path, "anew.json", again=path)
    tables = [load_slm_correction(tmp_path / name).phase_of_level_rad for name in ("on.json", "anew.json")]
    np.testing.assert_array_equal(*tables)
    assert len(Run.open(path).records) == len(run.records)
    with pytest.raises(BenchError, match="of another picture"):
        measured(tmp_path, "other.json", again=path, levels=17)


def test_frames_of_a_sequence_are_kept_when_ctrl_c_comes_while_they_are_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of one sequence are there when the first is noted, and may have taken minutes."""
    note = RunWriter.note

    def interrupted(writer: RunWriter, kind: str, **fields: Any) -> None:
        note(writer, kind, **fields)
        if fields.get("index") == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RunWriter, "note", interrupted)
    with (
        Bench(parse_config(TEXT, None)).open() as bench,
        pytest.raises(KeyboardInterrupt) as ended,
        KeptFrames(bench, tmp_path, "calibrate slm", SlmProcedure()) as kept,
    ):
        kept.answers(["a", "b", "c"], lambda _: [bench.snap()] * 3)
    (path,) = tmp_path.iterdir()
    assert len(Run.open(path).records) == 3
    assert ended.value.__notes__[0].startswith("3 frames are kept.")


def test_frames_that_were_not_seen_again_yet_are_told_as_kept(tmp_path: Path) -> None:
    def interrupted(asked: list[str], again: Path | None) -> None:
        with KeptFrames(bench, tmp_path, "calibrate slm", SlmProcedure(again=again)) as kept:
            kept.answers(asked, lambda _: [bench.snap()])
            raise KeyboardInterrupt

    told: list[str] = []
    run: Path | None = None
    with Bench(parse_config(TEXT, None)).open() as bench:
        for asked in (["a"], ["a", "b", "c"], ["a"]):
            with pytest.raises(KeyboardInterrupt) as ended:
                interrupted(asked, run)
            (run,) = tmp_path.iterdir()
            told.append(ended.value.__notes__[0].partition(".")[0])
    assert told == ["1 frame is kept", "3 frames are kept", "3 frames are kept"]


def test_an_alignment_that_was_interrupted_says_where_the_stage_is_and_goes_on(tmp_path: Path) -> None:
    near = AlignmentSettings(reach=8.0, depth_um=100.0, spots=25, section_pictures=1, refinements=1)
    settings = replace(near, max_frames=10, out=tmp_path / "a.json")
    control = RunControl()
    with Bench(parse_config(BENCH, None)).open() as bench, pytest.raises(EndedEarlyError) as ended:
        AlignmentProcedure(settings).carry_out(bench, tmp_path, control=control, listener=Ends(control))
    (path,) = (p for p in tmp_path.iterdir() if p.is_dir())
    notes = " ".join(ended.value.__notes__)
    assert "The stage stands at x_um 0, y_um 0" in notes
    assert "align mask --reach 8" in notes
    assert f"--again {path}" in notes
    kept = len(Run.open(path).records)
    assert 0 < kept < 10
    began = Run.open(path).metadata(kept - 1).host_time_ns
    going_on = AlignmentProcedure(replace(settings, again=path))
    with (
        Bench(parse_config(BENCH, None)).open() as bench,
        pytest.raises(AlignmentFailedError, match="gave up after 10 frames"),
    ):
        going_on.carry_out(bench, tmp_path)
    run = Run.open(path)
    assert len(run.records) == 10
    assert run.metadata(kept - 1).host_time_ns == began  # seen again, not taken again


def test_frames_that_are_all_there_are_a_complete_run_whatever_becomes_of_the_learning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display_learning, "learn_display", Mock(side_effect=InputError("too little")))
    monkeypatch.setattr(HologramCamera, "registered", lambda io, _: Mock(io=io))
    monkeypatch.setattr(
        display_learning, "photograph_series", lambda seen, _: Mock(looks=[seen.io.photograph(10.0)])
    )
    learning = LearningProcedure(out=tmp_path / "d.json")
    with Bench(parse_config(BENCH, None)).open() as bench, pytest.raises(InputError) as ended:
        learning.carry_out(bench, tmp_path)
    (path,) = (p for p in tmp_path.iterdir() if p.is_dir())
    run = Run.open(path)
    assert (run.condition, len(run.records)) == (RunCondition.COMPLETED, 2)
    assert "All 2 frames are kept. To see them again: " in " ".join(ended.value.__notes__)


def test_a_run_of_something_else_is_refused(tmp_path: Path) -> None:
    from instrument.runs.recorder import record

    with Bench(parse_config(TEXT, None)).open() as bench:
        run = record(bench, tmp_path, n_frames=1)
    with pytest.raises(BenchError, match="no frames of such a routine"):
        measured(tmp_path, "no.json", again=run.path)


def test_a_disk_without_room_is_said_before_anything_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = SimpleNamespace(frame_shape=(100, 100), frame_dtype=np.dtype(np.uint16))
    bench: Any = SimpleNamespace(camera=camera, config=SimpleNamespace(data_folder=tmp_path))
    monkeypatch.setattr(kept_frames, "free_bytes", lambda _: SPARE_BYTES + 200_000)
    assert "200 kB at most" in kept_words(bench, 10, None, tmp_path)
    with pytest.raises(BenchError, match="11 frames need 220 kB and 268 MB to spare, but only"):
        kept_words(bench, 11, None)
    assert kept_words(bench, 11, tmp_path)
