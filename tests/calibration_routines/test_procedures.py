"""Procedures from the request to the result, and how they are paused, aborted and stopped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from calibration_routines import CalibrationError, times
from calibration_routines.optics import photograph
from calibration_routines.optics.angular import AngularProcedure, AngularSweep
from calibration_routines.optics.photograph import PhotographProcedure
from calibration_routines.plan_procedures import PlanProcedure, ResumeProcedure, left_unfinished
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.sweep_options import AxialSweep, LateralSweep, VolumeSweep
from calibration_routines.psf.sweep_procedure import SweepProcedure
from calibration_routines.purpose import RunEndedError
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files import kept_times
from instrument.files.atomic import SPARE_BYTES
from instrument.files.errors import SettingsError, duration
from instrument.files.images import read_image, write_image
from instrument.plan import Part, Plan, PlanError, estimate
from instrument.runs import acquire
from instrument.runs.acquire import abilities_of
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.run_files import RunError
from instrument.runs.runner import RunState, RunStatus
from tests.mocks.listeners import Following

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = {time_scale}
"""
AXIAL = SweepProcedure(AxialSweep(z_min_um=60e3, z_max_um=150e3, planes=4, average=2, dark_frames=2))


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY.format(time_scale=0), None)) as opened:
        yield opened


@pytest.fixture
def slow_bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY.format(time_scale=0.3), None)) as opened:
        yield opened


def test_an_outlook_moves_nothing_and_counts_what_the_run_then_takes(bench: Bench, tmp_path: Path) -> None:
    before = bench.source_position_um
    outlook = AXIAL.outlook(bench, tmp_path)
    assert bench.source_position_um == before
    assert list(tmp_path.iterdir()) == []
    assert sorted({round(place["z_um"]) for place in outlook.path}) == [60000, 75000, 100000, 150000]
    assert outlook.path[0] == outlook.path[-1]  # the reference
    following = Following()
    done = AXIAL.carry_out(bench, tmp_path, listener=following)
    assert following.steps == ["homing the stage", "finding exposures", "sweeping", "analysing"]
    assert following.found is not None
    assert outlook.cost is not None
    assert Run.open(done.runs[0]).n_frames == outlook.cost.frames
    assert done.good, done.verdict
    assert done.calibration is not None
    assert (done.calibration / "calibration.json").is_file()


CLOCK = [0.0]


@dataclass(frozen=True)
class Waiting(Procedure):
    """Takes two seconds a frame of its plan, by a clock of the test's; without one what it is told."""

    plan: Plan | None = None
    seconds: float = 0.0
    out: Path | None = None

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        cost = None if self.plan is None else estimate(self.plan, abilities_of(bench, Path()))
        return Outlook(("A reason.",), self.plan, cost)

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        if self.seconds < 0:
            raise CalibrationError("It failed.")
        cost = self.outlook(bench).cost
        CLOCK[0] += self.seconds if cost is None else 2.0 * cost.frames
        return Outcome((), good=True)


def test_what_it_took_last_time_tells_how_long_all_of_it_takes(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_times, "_window", True)
    monkeypatch.setattr(time, "monotonic", lambda: CLOCK[0])

    def told(procedure: Procedure) -> tuple[str, ...]:
        return procedure.foretold(bench).reasons[1:]

    few, many = (Plan(label="wait", parts=(Part(label="scene", repeats=n),)) for n in (10, 40))
    assert told(Waiting(few)) == ()
    Waiting(few).carry_out(bench)
    assert told(Waiting(many)) == ("In all, by what it took last time: about 80.0 s.",)
    assert told(Waiting(Plan(label="another", parts=few.parts))) == ()
    # Without a plan the options tell, but for where the result goes.
    Waiting(seconds=7.0, out=tmp_path / "a").carry_out(bench)
    assert told(Waiting(seconds=7.0)) == ("In all, by what it took last time: about 7.0 s.",)
    assert told(Waiting(seconds=8.0)) == ()
    with pytest.raises(CalibrationError):
        Waiting(seconds=-1.0).carry_out(bench)
    assert told(Waiting(seconds=-1.0)) == ()
    # What is exposed or moved longer takes longer by that; what came on top goes with the frames.
    slow = Plan(label="wait", parts=(Part(label="scene", repeats=10, exposures_ms=(9000.0,)),))
    costs_s = [estimate(plan, abilities_of(bench, Path())).seconds for plan in (few, slow)]
    assert told(Waiting(slow)) == told(Waiting(few))  # a bench that waits for nothing
    with monkeypatch.context() as patched:
        patched.setattr("instrument.runs.acquire.time_scale", lambda bench: 1.0)
        Waiting(few).carry_out(bench)
        assert told(Waiting(slow)) == (
            f"In all, by what it took last time: about {duration(20 - costs_s[0] + costs_s[1])}.",
        )
    key = times._key(Waiting(few), bench, Waiting(few).outlook(bench))
    for damaged in (
        "[10, NaN, 1]",
        "[10, Infinity, 1]",
        "[10, -5, 1]",
        f"[10, 1{400 * '0'}, 1]",
        "[0, 9, 1]",
    ):
        kept_times.place().write_text(f'{{"{key}": {damaged}}}')
        assert told(Waiting(few)) == ()
    kept_times.place().write_text(90_000 * "[")
    assert told(Waiting(few)) == ()


def test_what_was_aborted_does_not_tell_how_long_the_whole_takes(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_times, "_window", True)
    wanted = PlanProcedure(Plan(label="three", parts=(Part(label="scene", repeats=3),)))
    control = RunControl()

    class Impatient(Listener):
        def frame(self, status: RunStatus) -> None:
            control.abort()

    ended = wanted.carry_out(bench, tmp_path, control=control, listener=Impatient())
    assert isinstance(ended.result, Run)
    assert ended.result.condition is RunCondition.ABORTED
    assert not ended.whole
    assert wanted.foretold(bench).reasons == wanted.outlook(bench).reasons
    assert wanted.carry_out(bench, tmp_path).whole
    assert len(wanted.foretold(bench).reasons) == len(wanted.outlook(bench).reasons) + 1


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: AxialSweep(z_min_um=-1.0), "z_min_um"),
        (lambda: AxialSweep(z_min_um=2e5, z_max_um=1e5), "z_max_um"),
        (lambda: AxialSweep(z_min_um=1e5, average=0), "average"),
        (lambda: AxialSweep(z_min_um=1e5, x_um=np.inf), "x_um"),
        (lambda: AxialSweep(z_min_um=1e5, binning=500), "binning"),
        (lambda: AxialSweep(z_min_um=50.0, z_max_um=15e4), "planes"),
        (lambda: LateralSweep(z_um=0.0), "z_um"),
        (lambda: LateralSweep(z_um=1e5, target=2.0), "target"),
        (lambda: LateralSweep(z_um=1e5, half_field_x_um=1.0), "half_field_y_um"),
        (lambda: LateralSweep(z_um=1e5, spacing_um=0.0), "spacing_um"),
        (lambda: LateralSweep(z_um=1e5, fall_off_deg=95.0), "fall_off_deg"),
        (lambda: LateralSweep(z_um=1e5, fall_off_deg=9.0, response=Path("x.json")), "fall_off_deg"),
        (lambda: VolumeSweep(z_min_um=1e5, z_max_um=9e4), "z_max_um"),
        (lambda: VolumeSweep(z_min_um=1e5, z_max_um=2e5, planes=1), "planes"),
        (lambda: VolumeSweep(z_min_um=1e5, z_max_um=2e5, reference_every=-1), "reference_every"),
    ],
)
def test_a_mistake_names_its_setting(
    bench: Bench, make: Callable[[], AxialSweep | LateralSweep | VolumeSweep], field: str
) -> None:
    with pytest.raises(SettingsError) as refused:
        SweepProcedure(make()).outlook(bench)
    assert field in [name for name, _ in refused.value.problems]


def test_what_leaves_the_stage_is_refused(bench: Bench) -> None:
    with pytest.raises(SettingsError, match="z = 900 mm is outside the stage's limits") as refused:
        SweepProcedure(AxialSweep(z_min_um=60e3, z_max_um=9e5, planes=3)).outlook(bench)
    assert [name for name, _ in refused.value.problems] == ["z_max_um"]
    with pytest.raises(PlanError, match="outside the stage's limits"):
        SweepProcedure(
            LateralSweep(z_um=2.9e5, half_field_x_um=6.5e4, half_field_y_um=0, spacing_um=6.5e4)
        ).outlook(bench)


def test_abort_between_two_frames_keeps_them_and_resume_makes_the_calibration(
    bench: Bench, tmp_path: Path
) -> None:
    control = RunControl()

    def at_five(status: RunStatus) -> None:
        if status.done == 5:
            control.abort()

    with pytest.raises(RunEndedError) as ended:
        AXIAL.carry_out(bench, tmp_path, control=control, listener=Following(at_five))
    run = ended.value.run
    assert run.condition is RunCondition.ABORTED
    assert len(run.records) == 5
    resume = ResumeProcedure(run.path)
    outlook = resume.outlook(bench)
    assert outlook.cost is not None
    assert outlook.cost.frames == run.n_frames - 5
    done = resume.carry_out(bench)
    assert done.good
    assert done.calibration == run.path / "calibration"


def test_a_photograph_that_was_left_becomes_a_picture_when_it_goes_on(bench: Bench, tmp_path: Path) -> None:
    control = RunControl()
    at_five = Following(lambda status: control.abort() if status.done == 5 else None)
    wanted = PhotographProcedure(exposure_ms=2.0, binning=2)
    with pytest.raises(RunEndedError):
        wanted.carry_out(bench, tmp_path, control=control, listener=at_five)
    left = left_unfinished(tmp_path, ["photograph"])
    assert left is not None
    done = ResumeProcedure(left).carry_out(bench)
    assert [file.name for file in done.files] == ["photograph.tif"]
    kept = read_image(done.files[0])
    assert kept.pixels.shape == (120, 160)
    assert kept.metadata["scatter"]["frames"] == 4
    assert "pixel_format" not in kept.metadata, "binned, a mosaic's colours are mixed"
    assert left_unfinished(tmp_path, ["photograph"]) is None


def test_a_photograph_tells_its_mosaic(bench: Bench, tmp_path: Path) -> None:
    wanted = PhotographProcedure(exposure_ms=2.0, average=1, dark_frames=1)
    kept = read_image(wanted.carry_out(bench, tmp_path).files[0])
    assert kept.metadata["pixel_format"] == "Mono12"


def test_who_interrupts_the_analysis_is_told_how_the_result_is_made(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All frames are there then, of which a run says nothing any more."""
    with monkeypatch.context() as patched:
        patched.setattr(photograph, "write_image", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt) as caught:
            PhotographProcedure(exposure_ms=2.0, binning=2).carry_out(bench, tmp_path)
    (note,) = caught.value.__notes__
    run = Path(note.removeprefix("Its frames are kept. For its result: diffuserbench resume "))
    assert [file.name for file in ResumeProcedure(run).carry_out(bench).files] == ["photograph.tif"]


def test_who_interrupts_what_comes_after_the_result_is_told_where_that_is(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def written(path: Path, *given: Any, **named: Any) -> None:
        write_image(path, *given, **named)
        raise KeyboardInterrupt

    monkeypatch.setattr(photograph, "write_image", written)
    with pytest.raises(KeyboardInterrupt) as caught:
        PhotographProcedure(exposure_ms=2.0, binning=2).carry_out(bench, tmp_path)
    (note,) = caught.value.__notes__
    assert read_image(Path(note.removeprefix("Its result is saved: "))).pixels.shape == (120, 160)


def _aborted(bench: Bench, folder: Path) -> Run:
    """Return the sweep's run, ended after five frames."""
    control = RunControl()
    at_five = Following(lambda status: control.abort() if status.done == 5 else None)
    with pytest.raises(RunEndedError) as ended:
        AXIAL.carry_out(bench, folder, control=control, listener=at_five)
    return ended.value.run


def test_a_resume_needs_room_for_frames_as_the_run_has_them(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.camera.set_binning(4)
    run = _aborted(bench, tmp_path)
    bench.camera.set_binning(1)  # as it is opened another day
    binned = 2 * 60 * 80  # bytes of a frame
    monkeypatch.setattr(acquire, "free_bytes", lambda _: SPARE_BYTES + 3 * run.n_frames * binned)
    assert ResumeProcedure(run.path).carry_out(bench).good


def test_a_resume_that_fails_before_its_first_frame_gives_the_run_up_again(
    bench: Bench, tmp_path: Path
) -> None:
    run = _aborted(bench, tmp_path)
    record = run.path / "sweep.json"
    whole = record.read_text()
    record.write_text("{}")
    with pytest.raises(CalibrationError, match="cannot be read"):
        ResumeProcedure(run.path).carry_out(bench)
    record.write_text(whole)
    assert ResumeProcedure(run.path).carry_out(bench).good


def test_a_sweep_within_another_run_is_to_be_moved_out_before_anything_moves(
    bench: Bench, tmp_path: Path
) -> None:
    outer, run = (_aborted(bench, tmp_path).path for _ in range(2))
    nested = run.rename(outer / run.name)
    for step in (ResumeProcedure(nested).outlook, ResumeProcedure(nested).carry_out):
        with pytest.raises(RunError, match=f"lies within another run.*Move it to {tmp_path}"):
            step(bench)
    assert len(Run.open(nested).records) == 5
    assert ResumeProcedure(nested.rename(run)).carry_out(bench).good


def test_a_damaged_record_comes_from_its_copy(bench: Bench, tmp_path: Path) -> None:
    run = _aborted(bench, tmp_path)
    record = run.path / "sweep.json"
    whole = record.read_text()
    record.write_text(whole[: len(whole) // 2])
    assert ResumeProcedure(run.path).carry_out(bench).good
    assert record.read_text() == whole


def test_pause_waits_dark_until_it_goes_on(bench: Bench, tmp_path: Path) -> None:
    control, states = RunControl(), []

    def watch(status: RunStatus) -> None:
        states.append(status.state)
        if status.done == 6 and status.state is RunState.RUNNING and not control.is_pausing:
            control.pause()
        if status.state is RunState.PAUSED:
            assert bench.led_array is not None
            assert bench.led_array.pattern.is_dark
            threading.Timer(0.05, control.resume).start()

    done = AXIAL.carry_out(bench, tmp_path, control=control, listener=Following(watch))
    assert RunState.PAUSED in states
    assert done.good


@pytest.mark.parametrize("step", ["homing the stage", "finding exposures", "sweeping"])
def test_stop_ends_at_once_in_every_step(slow_bench: Bench, tmp_path: Path, step: str) -> None:
    bench, control, reached = slow_bench, RunControl(), threading.Event()
    outcome: list[BaseException | Outcome] = []

    class Watch(Listener):
        def step(self, words: str) -> None:
            if words == step:
                reached.set()

    def work() -> None:
        try:
            outcome.append(AXIAL.carry_out(bench, tmp_path, control=control, listener=Watch()))
        except Exception as error:  # noqa: BLE001 - looked at below
            outcome.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    assert reached.wait(60)
    time.sleep(0.1)
    control.stop()
    assert bench.led_array is not None
    assert bench.stage is not None
    assert bench.led_array.pattern.is_dark
    assert not bench.stage.is_moving
    thread.join(30)
    assert not thread.is_alive()
    assert control.ending is FinishReason.STOPPED
    assert bench.led_array.pattern.is_dark
    assert isinstance(outcome[0], Exception), outcome


def test_abort_before_it_begins_begins_nothing(bench: Bench, tmp_path: Path) -> None:
    control = RunControl()
    control.abort()
    with pytest.raises(EndedEarlyError, match="aborted"):
        AXIAL.carry_out(bench, tmp_path, control=control)
    assert list(tmp_path.iterdir()) == []


def test_a_plan_is_carried_out_with_the_stage_homed(bench: Bench, tmp_path: Path) -> None:
    part = Part.model_validate(
        {
            "label": "psf",
            "light": "source",
            "positions": {"kind": "points", "points_um": [[0, 0, 8e4], [0, 0, 9e4]]},
        }
    )
    procedure = PlanProcedure(Plan(label="two", parts=(part,)))
    assert procedure.outlook(bench, tmp_path).path == (
        {"x_um": 0.0, "y_um": 0.0, "z_um": 8e4},
        {"x_um": 0.0, "y_um": 0.0, "z_um": 9e4},
    )
    done = procedure.carry_out(bench, tmp_path)
    assert done.verdict[0] == "completed: 2 of 2 frames SIMULATED"


def test_the_angular_procedure_fills_in_the_distance(bench: Bench, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="fewer than 2"):
        AngularProcedure(AngularSweep(largest_deg=20.0, step_deg=10.0)).outlook(bench, tmp_path)
    procedure = AngularProcedure(AngularSweep(largest_deg=20.0, step_deg=7.0))
    outlook = procedure.outlook(bench, tmp_path)
    assert "the farthest from which the stage spans the angles" in outlook.reasons[0]
    assert "9 places" in outlook.reasons[0]  # at 20 degrees nothing is left of the pattern
    assert "leaves the sensor" in outlook.reasons[0]
    with pytest.raises(SettingsError):
        AngularSweep(average=0)
    with pytest.raises(CalibrationError):  # four angles an axis, most of which leave the tiny sensor
        procedure.carry_out(bench, tmp_path)
    assert bench.led_array is not None
    assert bench.led_array.pattern.is_dark
