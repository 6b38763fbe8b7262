"""An axial sweep on the simulated bench: good PSFs, bad ones found and taken again, clear refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration_routines import (
    AxialSweep,
    CalibrationError,
    PointTaken,
    SweepEvent,
    axial_planes,
    calibrate_sweep,
    expose_sweep,
    sweep_plan,
)
from calibration_routines.psf.sweep_plan import SWEEP as SWEEP_RUN
from calibration_routines.psf.sweep_procedure import sweep_outcome
from calibration_routines.routine import routines
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.calibration_file import load_calibration, newest_calibration
from instrument.files.errors import BenchError, SettingsError
from instrument.runs.run import RunCondition
from instrument.runs.runner import RunStatus
from recon.types import Geometry
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
time_scale = 0
"""
ASKED = AxialSweep(z_min_um=60e3, z_max_um=150e3, planes=5, average=2, dark_frames=2)
SWEEP = ASKED.points()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY, None)) as opened:
        assert opened.stage is not None
        opened.stage.home()
        yield opened


def test_a_form_begins_where_the_source_stands(bench: Bench) -> None:
    start = routines["axial"].start
    assert start is not None
    assert start(bench)["z_min_um"] == 100e3, "where it homes, as the scene"
    bench.place_source(z_um=70.4e3)
    assert start(bench)["z_min_um"] == start(bench)["z_um"] == 70.4e3


def world_of(bench: Bench) -> SimulatedWorld:
    world = bench.shared["simulated"]
    assert isinstance(world, SimulatedWorld)
    return world


def slip_at(bench: Bench, z_um: float, shift_um: float) -> Callable[[RunStatus], None]:
    """Return a progress callback that shifts the source sideways when a plane is first taken."""
    world = world_of(bench)
    slipped: list[bool] = []

    def watch(status: RunStatus) -> None:
        step = status.step
        here = step is not None and step.label == "psf" and step.source_um is not None
        if here and not slipped and step is not None and step.source_um == (0.0, 0.0, z_um):
            world.carry_source(lambda: (shift_um, 0.0, z_um))
            slipped.append(True)

    return watch


def carried_again(bench: Bench) -> Callable[[SweepEvent], None]:
    """Return an event callback that ends the slip once the plane has been judged."""
    world = world_of(bench)
    carrier = world._carrier
    return lambda event: world.carry_source(carrier)


def test_a_sweep_gives_good_psfs_that_scale_with_depth_and_survive_the_disk(
    bench: Bench, tmp_path: Path
) -> None:
    done = calibrate_sweep(bench, SWEEP, tmp_path)
    assert done.findings == ()
    assert [run.condition for run in done.runs] == [RunCondition.COMPLETED]
    assert done.calibration.psfs.shape == (5, 1, 240, 320)
    assert all(q.saturated_pixels == 0 for q in done.quality)
    radii = [q.radius_px for q in done.quality]
    d_um = 8900.0
    assert radii[0] / radii[-1] == pytest.approx((1 + d_um / 60e3) / (1 + d_um / 150e3), rel=0.01)
    inverse_z = 1 / done.calibration.source_positions_um[:, 2]
    assert np.diff(inverse_z) == pytest.approx(np.full(4, (1 / 150e3 - 1 / 60e3) / 4))
    # counts of one exposure: the light through the aperture falls off with the square of the distance
    light = done.calibration.psfs.sum(axis=(1, 2, 3))
    assert light[0] / light[-1] == pytest.approx((150 / 60) ** 2, rel=0.05)
    loaded = load_calibration(done.path)
    assert np.array_equal(loaded.psfs, done.calibration.psfs)
    assert loaded.provenance["simulated"] is True
    assert loaded.provenance["runs"] == [done.runs[0].path.name]
    assert loaded.quality["good"] is True
    assert bench.led_array is not None
    assert bench.led_array.pattern.is_dark


def test_psfs_match_the_light_that_fell_on_the_sensor(bench: Bench, tmp_path: Path) -> None:
    sweep = AxialSweep(z_min_um=80e3, average=4)
    psf = calibrate_sweep(bench, sweep, tmp_path).calibration.psfs[0, 0]
    truth = world_of(bench).psf((0.0, 0.0, 80e3), (0.0, 1.0, 0.0))
    assert np.corrcoef(psf.ravel(), truth.ravel())[0, 1] > 0.995


def test_a_source_that_slipped_is_found_and_the_plane_taken_again(bench: Bench, tmp_path: Path) -> None:
    watch = slip_at(bench, ASKED.z_um[2], 1000.0)
    done = calibrate_sweep(bench, SWEEP, tmp_path, listener=Following(watch, carried_again(bench)))
    assert [len(run.steps("psf")) for run in done.runs] == [10, 2]
    assert done.findings == ()


def test_without_retakes_the_slip_is_reported(bench: Bench, tmp_path: Path) -> None:
    watch = slip_at(bench, ASKED.z_um[2], 1000.0)
    once = replace(SWEEP, retakes=0)
    done = calibrate_sweep(bench, once, tmp_path, listener=Following(watch, carried_again(bench)))
    assert len(done.findings) == 1
    assert "z = 85.71 mm: the pattern lies" in done.findings[0]
    assert load_calibration(done.path).quality["good"] is False
    assert done.path.name == "doubtful_calibration"
    assert SWEEP_RUN.kept(done.path.parent) == done.path
    assert newest_calibration(tmp_path) is None
    assert sweep_outcome(done).verdict[-1] == "Not to be relied on, hence kept as doubtful_calibration."


def test_a_third_of_a_millimetre_lost_along_the_axis_is_told_by_two_visits(
    tmp_path: Path,
) -> None:
    slips = TINY.replace("[stage]", "[stage]\naxes.z_um.slip = 300\naxes.z_um.slip_at_move = 6")
    with open_bench(parse_config(slips, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        (said,) = calibrate_sweep(bench, SWEEP, tmp_path).findings
    assert "smaller: the source came farther. z lost steps" in said


def test_pixels_that_turn_hot_meanwhile_are_not_taken_for_other_light_nor_for_a_cut_pattern(
    tmp_path: Path,
) -> None:
    late = TINY + "late_hot_pixels = 300\nlate_hot_e_per_s = 1e6\nlate_hot_after_s = 8\n"
    seen: list[SweepEvent] = []
    with open_bench(parse_config(late, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        done = calibrate_sweep(bench, SWEEP, tmp_path, listener=Following(lambda _status: None, seen.append))
    assert done.late_hot > 250
    said = [event.quality.findings if isinstance(event, PointTaken) else event.findings for event in seen]
    assert len(said) >= 7
    assert not [words for each in said for words in each if "other light" in words or "edge" in words]


def test_a_plane_that_saturates_is_taken_again_with_a_shorter_exposure(bench: Bench, tmp_path: Path) -> None:
    found = expose_sweep(bench, SWEEP)
    too_long = [1.3 * e if i == 1 else e for i, e in enumerate(found.exposures_ms)]
    done = calibrate_sweep(bench, SWEEP, tmp_path, exposures=replace(found, exposures_ms=tuple(too_long)))
    assert len(done.runs) == 2
    assert done.exposures.exposures_ms[1] == pytest.approx(0.7 * too_long[1], abs=1e-3)
    assert done.findings == ()
    assert done.quality[1].saturated_pixels == 0


def test_a_source_too_weak_for_the_camera_is_refused_in_words(tmp_path: Path) -> None:
    weak = TINY + "source_brightness = 1e-7\n"
    with open_bench(parse_config(weak, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        with pytest.raises(CalibrationError, match=r"too dark.*longest exposure"):
            calibrate_sweep(bench, SWEEP, tmp_path)
        assert bench.led_array is not None
        assert bench.led_array.pattern.is_dark
    assert list(tmp_path.iterdir()) == []


def test_planes_out_of_reach_are_refused_before_anything_moves(bench: Bench, tmp_path: Path) -> None:
    before = bench.source_position_um
    with pytest.raises(SettingsError, match="outside the stage's limits"):
        calibrate_sweep(bench, AxialSweep(z_min_um=60e3, z_max_um=900e3, planes=3), tmp_path)
    assert bench.source_position_um == before
    assert list(tmp_path.iterdir()) == []


def test_a_bench_without_a_stage_takes_one_psf_by_hand(tmp_path: Path) -> None:
    text = TINY.replace('[stage]\ndriver = "simulated"\n', "")
    with open_bench(parse_config(text, None)) as bench:
        done = calibrate_sweep(bench, AxialSweep(z_min_um=100e3, by_hand=True), tmp_path)
    assert done.findings == ()
    assert done.calibration.source_positions_um.tolist() == [[0.0, 0.0, 100e3]]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"z_min_um": 0.0}, "z_min_um must be a number, above 0"),
        ({"z_min_um": 200e3}, "0 < z min <= z max"),
        ({"planes": 1}, "one plane needs z min = z max"),
        ({"average": 0}, "average must be a whole number, 1 or more"),
        ({"target": 1.0}, "target must be a number, 0.05 or more, 0.9 or less"),
        ({"by_hand": True}, "5 planes need a stage"),
    ],
)
def test_senseless_sweeps_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(BenchError, match=message):
        replace(ASKED, **wrong)


def test_the_plan_counts_its_frames() -> None:
    plan = sweep_plan(SWEEP, [1.0, 2.0, 3.0, 4.0, 5.0])
    assert len(plan) == 2 * 2 + (1 + 5 + 1) * 2  # dark frames; the reference before and after the planes
    assert len(sweep_plan(SWEEP, [2.0] * 5)) == 2 + 7 * 2  # one exposure: one set of dark frames
    with pytest.raises(ValueError, match="as many exposures"):
        sweep_plan(SWEEP, [1.0])


def test_the_number_of_planes_follows_from_the_optics() -> None:
    pco = Geometry(13.0, 8.9, (5.5, 7.5))
    # the shadow's edge moves by 7.5/2 mm * 8.9 mm * (1/100 - 1/300) / mm = 222 um = 17.1 pixels: 9 steps of 2
    assert axial_planes(100e3, 300e3, pco).value == 10
    with pytest.raises(BenchError, match="aperture_mm"):
        axial_planes(100e3, 300e3, Geometry(13.0, 8.9))
