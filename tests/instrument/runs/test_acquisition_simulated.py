"""Acquisition on the simulated bench: what is stored is what the bench's physics shows there and then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.plan import OFF, SOURCE, Part, Plan, SourceGrid
from instrument.runs.acquire import acquire, prepare, prepare_resume
from instrument.runs.inspection import verify
from instrument.runs.recorder import record
from instrument.runs.run import Run, RunCondition
from instrument.runs.runner import RunStatus

BENCH = """
[bench]
name = "tiny"
[camera]
driver = "simulated"
replay_frames = {replay}
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = {time_scale}
"""


def open_tiny(time_scale: float = 0.0, replay: int = 0) -> Bench:
    bench = open_bench(parse_config(BENCH.format(time_scale=time_scale, replay=replay), None))
    assert bench.stage is not None
    bench.stage.home()
    return bench


def world(bench: Bench) -> SimulatedWorld:
    part = bench.shared["simulated"]
    assert isinstance(part, SimulatedWorld)
    return part


def sweep(bench: Bench) -> Plan:
    x, y, z = bench.source_position_um
    return Plan(
        label="lateral",
        parts=(
            Part(label="dark", average=4),
            Part(
                label="psf",
                light=(OFF, SOURCE),
                positions=SourceGrid(x_um=(x - 300, x, x + 300), y_um=(y,), z_um=(z,)),
            ),
        ),
    )


def test_frames_show_the_light_and_the_place_of_their_step(tmp_path: Path) -> None:
    with open_tiny() as bench:
        plan = sweep(bench)
        run = acquire(bench, plan, tmp_path)
        distance_um = world(bench).distance_um
        assert bench.geometry.diffuser_distance_mm == pytest.approx(distance_um / 1000)
        pitch_um = bench.camera.pixel_pitch_um
    assert verify(run).is_sound
    dark = run.images("dark")[0]
    steps = run.steps("psf")
    lit = [step for step in steps if step.light == SOURCE]
    brightness = {step.index: float((run.frame(step) - dark).mean()) for step in steps}
    faintest = min(brightness[step.index] for step in lit)
    assert all(abs(brightness[step.index]) < 0.05 * faintest for step in steps if step.light == OFF)
    # The caustic moves against the source, by d / z of its way (Kuo 2020, Eq. 3.1).
    columns = np.arange(dark.shape[1])
    places = [np.average(columns, weights=np.clip(run.frame(s) - dark, 0, None).sum(axis=0)) for s in lit]
    assert lit[0].source_um is not None
    expected = -300 * distance_um / lit[0].source_um[2] / pitch_um
    assert np.diff(places) == pytest.approx([expected] * 2, rel=0.25)


@pytest.mark.parametrize("kind", ["camera", "stage"])
def test_a_device_unplugged_mid_run_loses_nothing_and_the_run_goes_on(tmp_path: Path, kind: str) -> None:
    with open_tiny() as bench:

        def unplug(status: RunStatus) -> None:
            if status.done == 3:
                world(bench).unplug(kind)

        plan = sweep(bench)
        runner = prepare(bench, plan, tmp_path, on_progress=unplug)
        with pytest.raises(DeviceError, match=rf"{kind} \(simulated\).*unplugged"):
            runner.execute()
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
        world(bench).plug_in(kind)  # so that closing the bench finds it again
    run = Run.open(runner.path)
    assert run.condition is RunCondition.FAILED
    assert "unplugged" in run.error
    kept = {i: run.frame(i) for i in run.records}
    assert len(kept) >= 3
    with open_tiny() as bench:
        run = prepare_resume(bench, runner.path).execute()
    assert run.condition is RunCondition.COMPLETED
    assert verify(run).is_sound
    assert all(np.array_equal(run.frame(i), frame) for i, frame in kept.items())


def test_a_recording_of_the_simulated_camera_is_whole(tmp_path: Path) -> None:
    with open_tiny(time_scale=1.0, replay=4) as bench:
        bench.source_on()
        run = record(bench, tmp_path, n_frames=30)
    assert verify(run).is_sound
    assert len(run.records) + sum(gap.count for gap in run.gaps) == 30
    numbers = [run.metadata(i).frame_id for i in sorted(run.records)]
    first = numbers[0] - min(run.records)
    assert numbers == [first + i for i in sorted(run.records)]
    started = next(event for event in run.events if event["kind"] == "started")
    assert started["drops_counted_by"] == "device frame numbers"


def test_replayed_frames_differ_from_each_other_and_follow_the_light() -> None:
    with open_tiny(replay=3) as bench:
        dark = [bench.snap().image for _ in range(4)]
        assert not np.array_equal(dark[0], dark[1])
        assert np.array_equal(dark[0], dark[3])
        bench.source_on()
        assert bench.snap().image.mean() > dark[0].mean() + 1
        bench.source_off()
        assert bench.snap().image.mean() < dark[0].mean() + 1
        bench.camera.set_exposure_ms(500)
        bench.source_on()
        assert bench.snap().metadata.exposure_ms == 500
