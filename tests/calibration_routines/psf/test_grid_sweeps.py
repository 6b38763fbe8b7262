"""Sweeps over the field on the simulated bench: planned from the physics, judged, resumed, usable."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from calibration_routines import (
    CalibrationError,
    PointSweep,
    PointTaken,
    SourceVisit,
    SweepEvent,
    axial_planes,
    calibrate_sweep,
    expose_scene,
    expose_sweep,
    finish_sweep,
    grid_sweep,
    lateral_spacing,
    photograph,
    watch_sweep,
)
from calibration_routines.psf.analysis import feature_size_px, optical_binning
from calibration_routines.psf.stage_fit import MAX_GAIN_ERROR, fit_stage, judge_drift
from calibration_routines.psf.sweep import Retake, read_retakes
from calibration_routines.psf.sweep_options import LateralSweep
from calibration_routines.psf.sweep_procedure import quality_lines
from drivers.camera import Roi
from drivers.simulated.world import Rgb, SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.calibration_file import load_calibration
from instrument.files.errors import BenchError
from instrument.runs.acquire import look, prepare_resume
from instrument.runs.run import FinishReason, RunCondition
from instrument.runs.runner import RunStatus
from recon import reconstruct
from recon.arrays import Float32Array
from recon.base import metrics
from recon.camera.camera_model import ModelName
from recon.optics.fall_off import gaussian_fall_off, no_fall_off
from recon.types import Geometry
from tests.mocks.listeners import Following, KeepingControl

TINY = """
[camera]
driver = "simulated"
binning = 2
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
fall_off = "gaussian"
fall_off_sigma_deg = 12
"""
Z_UM = 100e3
POINTS = tuple((x, y, Z_UM) for y in (-10e3, 0.0, 10e3) for x in (-15e3, 0.0, 15e3))
MODELS_COMPARED: tuple[ModelName, ...] = ("convolution", "local")
SWEEP = PointSweep(points_um=POINTS, kind="lateral", average=2, dark_frames=2, reference_every=4)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY, None)) as opened:
        assert opened.stage is not None
        opened.stage.home()
        yield opened


def world_of(bench: Bench) -> SimulatedWorld:
    world = bench.shared["simulated"]
    assert isinstance(world, SimulatedWorld)
    return world


def test_a_lateral_sweep_is_good_and_agrees_with_the_stage(bench: Bench, tmp_path: Path) -> None:
    done = calibrate_sweep(bench, SWEEP, tmp_path)
    assert done.findings == ()
    assert len(done.runs) == 1
    assert len(done.runs[0].steps("reference")) == 4 * 2  # before point 1, 5 and 9, and at the end
    (stage,) = done.stages
    assert stage.points == 8
    assert stage.gain_error == pytest.approx(0, abs=2e-3)
    assert stage.rotation_mrad == pytest.approx(0, abs=2)
    assert stage.residual_95_px < 0.2
    assert not any(re.search("Distance:|shakes", line) for line in quality_lines(done))
    (told,) = [line for line in quality_lines(done) if "pinhole" in line]
    assert "one depth does not tell how large it is" in told  # and the configuration does not say
    shaken = replace(done, scatter=replace(done.scatter, motion_px=0.25), source_width_px=0.7)
    assert not shaken.findings
    assert any("the picture shakes by 0.25 pixels" in line for line in quality_lines(shaken))
    assert any("0.7 pixels wide" in line for line in quality_lines(shaken))
    assert done.drift is not None
    assert done.drift.before_point == (0, 4, 8, 9)
    assert max(done.drift.shift_px) < 0.1
    loaded = load_calibration(done.path)
    assert loaded.source_positions_um.tolist() == [list(point) for point in POINTS]
    assert loaded.quality["good"] is True
    assert loaded.provenance["sweep"]["kind"] == "lateral"
    # not normalised: the sensor's response dims what comes from the side
    light = loaded.psfs.sum(axis=(1, 2, 3))
    assert light[3] < 0.9 * light[4]


@pytest.mark.parametrize(("off_um", "words"), [(600.0, "0.6. mm farther"), (-900.0, "0.[89]. mm nearer")])
def test_a_mount_that_is_off_along_the_axis_is_told_by_shifts(
    tmp_path: Path, off_um: float, words: str
) -> None:
    """By less than what is called wrong: one depth does not tell it from d."""
    text = TINY.replace("[stage]", f"[stage]\nmount_offset_um = [0.0, 0.0, {off_um}]")
    with open_bench(parse_config(text, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        done = calibrate_sweep(bench, SWEEP, tmp_path)
    (stage,) = done.stages
    assert not stage.findings
    assert abs(stage.gain_error or 0) < MAX_GAIN_ERROR
    (told,) = [line for line in quality_lines(done) if line.startswith("Distance:")]
    assert re.search(words, told), told


@pytest.mark.slow
def test_a_close_scene_needs_the_lateral_calibration(tmp_path: Path) -> None:
    """The whole way: sweep, photograph, reconstruct; light by wave optics at continuous places."""
    text = TINY.replace("fall_off_sigma_deg = 12", "fall_off_sigma_deg = 8")
    text += 'scene = "bars"\nscene_distance_mm = 12\nscene_height_mm = 3.4\nscene_rgb = [0, 1, 0]\n'
    with open_bench(parse_config(text, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        grid = grid_sweep(bench, (12e3,), response=gaussian_fall_off(8.0))
        done = calibrate_sweep(
            bench, PointSweep(points_um=grid.points_um, kind="lateral", average=2), tmp_path
        )
        photo = photograph(bench, expose_scene(bench).exposure_ms, tmp_path, average=2, dark_frames=2)
        truth = world_of(bench).ground_truth(photo.measurement.shape[:2], 26.0)
    assert done.findings == ()
    quality = {}
    for model in MODELS_COMPARED:
        found = reconstruct(
            photo.measurement,
            load_calibration(done.path),
            model=model,
            iterations=30,
            estimate_background=False,
        )
        quality[model] = metrics.psnr(found.volume[0].reshape(truth.shape), truth, fit_scale=True)
    assert quality["local"] > quality["convolution"] + 5


def test_a_point_where_the_stage_slipped_is_taken_again_at_once(bench: Bench, tmp_path: Path) -> None:
    world = world_of(bench)
    carrier = world._carrier
    events: list[SweepEvent] = []

    def slip(status: RunStatus) -> None:
        step = status.step
        here = step is not None and step.label == "psf" and step.source_um == POINTS[5]
        if here and not any(isinstance(e, PointTaken) and e.retaking for e in events):
            x, y, z = POINTS[5]
            world.carry_source(lambda: (x + 2000.0, y, z))

    def hear(event: SweepEvent) -> None:
        events.append(event)
        world.carry_source(carrier)

    done = calibrate_sweep(bench, SWEEP, tmp_path, listener=Following(slip, hear))
    assert [len(run.steps("psf")) for run in done.runs] == [18, 2]
    assert done.findings == ()
    visits = [e for e in events if isinstance(e, SourceVisit)]
    points = [e for e in events if isinstance(e, PointTaken)]
    assert [(v.number, v.before_point, v.findings) for v in visits] == [
        (1, 0, ()),
        (2, 4, ()),
        (3, 8, ()),
        (4, 9, ()),
    ]
    # the point is judged before the next one is taken, and again after its retake
    assert [(p.number, p.take, p.retaking) for p in points[4:8]] == [
        (5, 1, False),
        (6, 1, True),
        (6, 2, False),
        (7, 1, False),
    ]
    assert "from where the stage says" in points[5].quality.findings[0]
    assert all(p.quality.findings == () for p in points if not p.retaking)
    assert all(p.quality.snr > 20 and p.image.shape == (120, 160) for p in points)
    # a crash after the retake would not lose it: the folder says where it is
    assert read_retakes(done.runs[0].path) == [Retake(POINTS[5], done.runs[1].path.name)]


def test_retakes_are_bounded_and_a_point_that_stays_bad_is_flagged(bench: Bench, tmp_path: Path) -> None:
    world = world_of(bench)
    carrier = world._carrier
    x, y, z = POINTS[5]

    def where() -> tuple[float, float, float]:
        here = carrier()
        return (x + 2000.0, y, z) if here == pytest.approx((x, y, z), abs=1.0) else here

    world.carry_source(where)
    control = KeepingControl()
    done = calibrate_sweep(bench, replace(SWEEP, retakes=2), tmp_path, control=control)
    assert [len(run.steps("psf")) for run in done.runs] == [18, 2, 2]
    assert [q.source_um for q in done.quality if q.retake] == [POINTS[5]]
    assert any("beside where the stage says" in finding for finding in done.findings)
    assert [runner.path for runner in control.runners] == [done.runs[0].path]


def test_stop_during_a_retake_stops_the_sweep(bench: Bench, tmp_path: Path) -> None:
    control = KeepingControl()
    found = expose_sweep(bench, SWEEP)
    too_long = replace(found, exposures_ms=tuple(1.6 * e for e in found.exposures_ms))
    stops: list[Thread] = []

    def hear(event: SweepEvent) -> None:
        if isinstance(event, PointTaken) and event.retaking:
            stops.append(Thread(target=control.runners[0].stop))
            stops[-1].start()

    with pytest.raises(CalibrationError, match="ended early"):
        calibrate_sweep(
            bench, SWEEP, tmp_path, exposures=too_long, control=control, listener=Following(on_event=hear)
        )
    for stop in stops:
        stop.join()  # before the bench is closed
    assert control.runners[0].status.reason is FinishReason.STOPPED
    assert bench.led_array is not None
    assert bench.led_array.pattern.is_dark


def test_a_drift_of_brightness_is_taken_out_of_the_psfs(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = world_of(bench)
    exposures = expose_sweep(bench, SWEEP)
    bright, rendered = world.photons_per_s, 0

    def counted(weights: Rgb, binning: int = 1) -> Float32Array | None:
        """Dim from place to place: in step with them, however late their status is heard."""
        nonlocal rendered
        rendered += 1
        light = bright(weights, binning)
        return None if light is None else light * np.float32(1 - dimming * rendered)

    monkeypatch.setattr(world, "photons_per_s", counted)
    dimming = 0.0
    steady = calibrate_sweep(bench, SWEEP, tmp_path / "steady", exposures=exposures).calibration
    dimming, rendered = 0.12 / rendered, 0
    done = calibrate_sweep(bench, SWEEP, tmp_path / "drift", exposures=exposures)
    assert done.findings == ()
    assert done.calibration.quality["drift"]["corrected"] is True
    assert done.calibration.quality["drift"]["brightness"][-1] < 0.93
    before, light = (c.psfs.sum(axis=(1, 2, 3)) for c in (steady, done.calibration))
    # Corrected in proportion to time between two references, while a busy machine's visits take uneven times:
    # wrong by what the light loses between two references at most, a third of the whole.
    assert light / light[4] == pytest.approx(before / before[4], rel=0.12 * 4 / 13)


def test_a_source_that_dims_and_a_wrong_distance_are_reported(tmp_path: Path) -> None:
    text = TINY + "[geometry]\ndiffuser_distance_mm = 9.5\n"  # it is 8.9
    with open_bench(parse_config(text, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        world = world_of(bench)

        def watch(status: RunStatus) -> None:
            if status.step is not None and status.step.source_um == POINTS[6]:
                red, green, blue = world.emission
                world.set_emission((red, 0.8 * green, blue))

        done = calibrate_sweep(bench, SWEEP, tmp_path, listener=Following(watch))
    assert any("moves 6" in finding and "too little for d/z" in finding for finding in done.findings)
    # only the second half of the frames of point 7 are dim: the LED is set anew for the next point
    assert load_calibration(done.path).quality["good"] is False


def test_drift_is_read_from_the_reference() -> None:
    rng = np.random.default_rng(0)
    pattern = rng.random((96, 128)).astype(np.float32) ** 8
    from scipy.ndimage import gaussian_filter, shift

    pattern = gaussian_filter(pattern * (np.hypot(*np.mgrid[-48:48, -64:64]) < 40), 1.5)
    moved = shift(pattern, (1.2, 0.5), order=3)
    steady = judge_drift([pattern, 1.05 * pattern], [0, 10], 10, [0.0, 60.0])
    assert steady.findings == ()
    assert steady.brightness_at(30.0) == pytest.approx(1.025)
    drift = judge_drift([pattern, 0.85 * pattern, 0.85 * moved], [0, 10, 20], 20, [0.0, 60.0, 120.0])
    assert [finding.split(" the ")[0] for finding in drift.findings] == [
        "between points 1 and 10",
        "between points 11 and 20",
    ]
    assert "15.0% dimmer" in drift.findings[0]
    assert "moved from 0.0 to 1.3 pixels" in drift.findings[1]
    steps = [shift(pattern, (0.0, 0.3 * k), order=3) for k in range(4)]
    creeping = judge_drift(steps, [0, 5, 10, 15], 15, [0.0, 20.0, 40.0, 60.0])
    assert ["0.9 pixels off its first place in all" in words for words in creeping.findings] == [True]
    assert judge_drift(steps[:2], [0, 5], 5, [0.0, 20.0]).findings == ()
    set_clock = replace(drift, seconds=(0.0, 60.0, 50.0))
    assert not set_clock.is_correctable
    assert set_clock.brightness_at(30.0) == 1.0
    dark = judge_drift([pattern, 0 * pattern, 0 * pattern], [0, 10, 20], 20, [0.0, 60.0, 120.0])
    assert len(dark.findings) == 4
    assert not dark.is_correctable


def test_a_sweep_that_was_cut_off_is_resumed_and_becomes_a_calibration(bench: Bench, tmp_path: Path) -> None:
    class Cut(BaseException):
        pass

    def cut(status: RunStatus) -> None:
        if status.done == 7:
            raise Cut

    with pytest.raises(Cut):
        calibrate_sweep(bench, SWEEP, tmp_path, listener=Following(cut))
    (run,) = tmp_path.iterdir()
    with pytest.raises(CalibrationError, match="ended early"):
        finish_sweep(run)
    findings = look(run)
    runner = prepare_resume(bench, run, findings)
    assert findings.frames >= 7
    events: list[SweepEvent] = []
    watch_sweep(bench, runner, Following(on_event=events.append))
    assert runner.execute().condition is RunCondition.COMPLETED
    done = finish_sweep(run, bench)
    assert done.findings == ()
    assert done.path == run / "calibration"
    assert len(load_calibration(done.path).psfs) == 9
    # the watch goes on where it was: no point twice, the source held against the first visit of all
    assert [e.number for e in events if isinstance(e, PointTaken)] == [2, 3, 4, 5, 6, 7, 8, 9]
    assert [e.number for e in events if isinstance(e, SourceVisit)] == [2, 3, 4]


def test_the_grid_covers_what_a_reconstruction_shows(bench: Bench) -> None:
    grid = grid_sweep(bench, (Z_UM,), response=gaussian_fall_off(12.0))
    points = np.array(grid.points_um)
    # 320 x 240 pixels of 13 um at d = 8.9 mm, seen from 100 mm
    assert points[:, 0].max() == pytest.approx(160 * 13 * 100 / 8.9, rel=1e-3)
    assert points[:, 1].max() == pytest.approx(120 * 13 * 100 / 8.9, rel=1e-3)
    assert grid.shapes == ((3, 5),)
    steps = np.abs(np.diff(points[:, :2], axis=0)).max(axis=1)
    assert steps.max() < 22e3  # every other row runs backwards: always to a neighbour
    assert any("5.8 and 5.9" in reason for reason in grid.reasons)
    with pytest.raises(BenchError, match="more than 41"):
        grid_sweep(bench, (Z_UM,), spacing_um=100.0)


def test_no_place_is_planned_from_which_the_pattern_leaves_the_sensor(bench: Bench) -> None:
    asked = grid_sweep(bench, (Z_UM,), half_field_um=(50e3, 50e3), spacing_um=10e3)
    x, y = np.abs(np.array(asked.points_um))[:, :2].max(axis=0)
    assert (x, y) == (
        30e3,
        20e3,
    )  # of 10 mm each: farther, less than a tenth is seen
    assert any(reason.startswith("86 of 121 places left out") for reason in asked.reasons)
    with pytest.raises(BenchError, match="leaves the sensor"):
        grid_sweep(bench, (Z_UM,), half_field_um=(0.0, 0.0), spacing_um=10e3, x_um=50e3)


def test_a_depth_from_which_nothing_is_seen_is_refused(bench: Bench) -> None:
    with pytest.raises(BenchError, match=r"At z = 60 mm .* nearer to x = 0, y = 0 mm, or leave such depths"):
        grid_sweep(bench, (60e3, 150e3), half_field_um=(0.0, 10e3), spacing_um=10e3, x_um=40e3)


def test_the_size_of_a_grid_says_how_many_places_are_left(bench: Bench) -> None:
    asked = {"half_field_x_um": 50e3, "half_field_y_um": 50e3, "spacing_um": 10e3}
    reasons = LateralSweep(z_um=Z_UM, **asked).planned(bench).reasons
    assert reasons[-1] == "Grid: 11 x 11 points (y x x) at each depth, of which 35 seen"
    grid = grid_sweep(bench, (Z_UM, 150e3), half_field_um=(50e3, 50e3), spacing_um=10e3)
    assert (grid.shapes, grid.seen) == (((11, 11), (11, 11)), (35, 63))


@pytest.mark.parametrize("binning", [1, 2])
def test_the_field_is_opposite_to_the_region_that_is_read(bench: Bench, binning: int) -> None:
    bench.camera.set_binning(binning)
    bench.camera.set_roi(Roi(0, 240, 240, 80))  # at the right, where patterns of sources at x < 0 fall

    def places(**asked: float) -> set[float]:
        grid = grid_sweep(bench, (Z_UM,), half_field_um=(0.0, 40e3), spacing_um=10e3, **asked)
        return {x for x, _, _ in grid.points_um}

    # 120 pixels of 13 um beside the middle, seen from 100 mm: 17.5 mm; 15.6 mm to both sides
    assert places() == {-30e3, -20e3, -10e3}
    with pytest.raises(BenchError, match=r"nearer to x = -17\.5, y = 0 mm\.$"):
        places(x_um=70e3)


def test_lateral_spacing_is_the_dissertations() -> None:
    # 0.4 mm for the microscope (Kuo 2020, Sec. 6.4), whose nearest depth is 1.7 mm
    assert lateral_spacing(gaussian_fall_off(13.0), 1700.0).value == pytest.approx(400.0, rel=0.06)
    narrow, wide = (lateral_spacing(gaussian_fall_off(s), 1700.0).value for s in (6.5, 13.0))
    assert narrow == pytest.approx(wide / 2, rel=0.1)
    assert lateral_spacing(gaussian_fall_off(13.0), 3400.0).value == pytest.approx(2 * wide, rel=1e-6)
    skewed = gaussian_fall_off(5.0, 20.0)
    assert lateral_spacing(skewed, 1e3, along="y").value < lateral_spacing(skewed, 1e3, along="x").value
    assert "15 degrees" in lateral_spacing(None, 1e3).reason
    with pytest.raises(BenchError, match="same at all angles"):
        lateral_spacing(no_fall_off, 1e3)


def test_axial_spacing_is_the_dissertations() -> None:
    # 33 per metre for lenslets of 250 um and 520 nm: from 1.7 to 3 mm 255 per metre
    planes = axial_planes(1700.0, 3000.0, Geometry(), lenslet_um=250.0, wavelength_nm=520.0)
    assert planes.value == 9
    assert "33.3 per metre" in planes.reason
    with pytest.raises(BenchError, match="wavelength"):
        axial_planes(1700.0, 3000.0, Geometry(), lenslet_um=250.0)
    with pytest.raises(BenchError, match="make no sense together"):
        axial_planes(1700.0, 3000.0, Geometry(), lenslet_um=1e-300, wavelength_nm=520.0)


def test_the_stage_fit_ignores_a_slip_and_finds_scale_and_rotation() -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(-1e4, 1e4, (24, 2))
    angle, gain = 5e-3, 2e-3
    turned = gain * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shifts = -(places @ turned.T) + rng.normal(0, 0.03, places.shape)
    shifts[7] += (4.0, -1.0)
    residuals, error, rotation_mrad, anisotropy = fit_stage(places, shifts, 1.95e-3)
    assert error == pytest.approx(2.0 / 1.95 - 1, abs=2e-3)
    assert rotation_mrad == pytest.approx(5.0, abs=0.5)
    assert anisotropy == pytest.approx(0, abs=2e-3)
    assert residuals[7] == pytest.approx(np.hypot(4, 1), abs=0.2)
    assert np.delete(residuals, 7).max() < 0.2


def test_points_on_a_line_are_held_against_the_stage_too(bench: Bench, tmp_path: Path) -> None:
    line = tuple((x, 0.0, Z_UM) for x in (-12e3, -6e3, 0.0, 6e3, 12e3))
    world = world_of(bench)
    carrier = world._carrier

    def slip(status: RunStatus) -> None:
        step = status.step
        here = step is not None and step.label == "psf" and step.source_um == line[3]
        world.carry_source((lambda: (8e3, 0.0, Z_UM)) if here else carrier)

    sweep = replace(SWEEP, points_um=line, retakes=0)
    done = calibrate_sweep(bench, sweep, tmp_path, listener=Following(slip))
    (stage,) = done.stages
    assert stage.gain_error == pytest.approx(0, abs=5e-3)
    assert [q.source_um for q in done.quality if q.retake] == [line[3]]


@pytest.mark.parametrize(("width", "binning"), [(2.2, 1), (4.6, 2), (9.0, 3)])
def test_binning_stops_at_the_finest_structure(width: float, binning: int) -> None:
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(2)
    points = np.zeros((240, 320))
    points[rng.integers(20, 220, 60), rng.integers(20, 300, 60)] = 1000.0
    sharp = gaussian_filter(points, width / 2.355)
    frames = [sharp + rng.normal(0, 0.02 * sharp.max(), sharp.shape) for _ in range(2)]
    assert feature_size_px(*frames) == pytest.approx(width, rel=0.15)
    assert optical_binning(*frames) == binning


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"points_um": ()}, "at least one point"),
        ({"points_um": (POINTS[0], POINTS[0])}, "listed twice"),
        ({"points_um": ((0.0, 0.0, -1.0),)}, "in front of the diffuser"),
        ({"average": 0}, "average must be a whole number, 1 or more"),
        ({"reference_every": -1}, "reference_every must be a whole number, 0 or more"),
    ],
)
def test_senseless_sweeps_are_refused(wrong: dict[str, int], message: str) -> None:
    with pytest.raises(BenchError, match=message):
        replace(SWEEP, **wrong)  # type: ignore[arg-type]
