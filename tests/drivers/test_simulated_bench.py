"""The simulated devices act on each other as real ones on a bench do."""

from __future__ import annotations

import queue
import threading
import time
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.camera import Roi
from drivers.common.checked import call_limit_s
from drivers.errors import DeviceError, StoppedError
from drivers.led_array import LedPattern
from drivers.simulated import world
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.camera_settings import CameraOptions
from drivers.simulated.led_array import LedArrayOptions, SimulatedLedArray
from drivers.simulated.options import WorldOptions
from drivers.simulated.slm import SimulatedSlm, SlmOptions
from drivers.simulated.stage import AxisOptions, SimulatedStage, StageOptions
from drivers.simulated.world import Rgb, SimulatedWorld
from recon.arrays import Float32Array, Float64Array

Z_UM = 100e3


class Bench:
    """All simulated devices of a small bench, open, homed, dark."""

    def __init__(
        self,
        camera: CameraOptions | None = None,
        stage: StageOptions | None = None,
        **options: object,
    ) -> None:
        settings = {"preset": "tiny", "time_scale": 0.0, "noise": 0.0, "fixed_pattern": False} | options
        self.world = SimulatedWorld(WorldOptions.model_validate(settings))
        self.camera = SimulatedCamera(camera or CameraOptions(), self.world)
        self.stage = SimulatedStage(stage or StageOptions(), self.world)
        self.leds = SimulatedLedArray(LedArrayOptions(), self.world)
        for device in (self.camera, self.stage, self.leds):
            device.open()
        self.stage.home()
        self.camera.set_exposure_ms(1.0)

    def lit(self, rgb: tuple[int, int, int] = (0, 255, 0)) -> Float64Array:
        """Photograph with LED 0 on; counts above the black level."""
        self.leds.set_pattern(self.leds.single(0, rgb))
        return self.counts()

    def counts(self) -> Float64Array:
        return self.camera.snap().image.astype(np.float64) - round(self.camera.black_level)


# Light ---
def test_dark_without_leds_and_without_scene() -> None:
    bench = Bench()
    assert bench.counts().max() <= 1
    assert bench.lit().max() > 100
    bench.leds.off()
    assert bench.counts().max() <= 1
    bench.world.scene_lit = True
    bench.camera.set_exposure_ms(300.0)
    assert bench.counts().mean() > 50


def test_an_animals_first_light_is_waited_for_on_a_busy_computer() -> None:
    assert call_limit_s(Bench().camera, "snap") < 200
    assert call_limit_s(Bench(scene="animal").camera, "snap") > 3600


def test_light_adds_up() -> None:
    bench = Bench()
    bench.camera.set_exposure_ms(0.25)
    bench.camera.set_gain(8.0)
    half, full = bench.lit((0, 51, 0)), bench.lit((0, 102, 0))
    # Counts are rounded: one more or less.
    np.testing.assert_allclose(full, 2 * half, atol=2)
    red, both = bench.lit((51, 0, 0)), bench.lit((51, 51, 0))
    np.testing.assert_allclose(both, red + half, atol=2)
    bench.camera.set_exposure_ms(0.5)
    np.testing.assert_allclose(bench.lit((0, 51, 0)), full, atol=1)
    assert 100 < full.max() < 4000


def test_outer_leds_light_the_source_less() -> None:
    bench = Bench()
    inner = bench.lit().sum()
    bench.leds.set_pattern(bench.leds.single(256, (0, 255, 0)))
    assert 0 < bench.counts().sum() < inner


# Stage and camera ---
def test_the_pattern_moves_against_the_stage() -> None:
    bench = Bench()
    grid = bench.world.sensor_grid()
    bench.stage.move_to({"x_um": 0.0, "y_um": 0.0, "z_um": Z_UM})

    def centre(image: Float64Array) -> Float64Array:
        return np.array([image.sum(axis=0) @ grid.x_um, image.sum(axis=1) @ grid.y_um]) / image.sum()

    start = centre(bench.lit())
    bench.stage.move_to({"x_um": 5000.0, "y_um": -4000.0})
    # The stage is where it says only within its errors; the light knows the true place.
    true = np.array(bench.world.source_position_um[:2])
    np.testing.assert_allclose(true, [5000.0, -4000.0], atol=10.0)
    expected = -true * bench.world.distance_um / Z_UM
    np.testing.assert_allclose(centre(bench.lit()) - start, expected, atol=8.0)


def test_a_frame_sees_the_world_after_it_was_asked_for() -> None:
    bench = Bench()
    bench.camera.start_sequence(n_buffers=2)
    bench.leds.set_pattern(bench.leds.single(0))
    asked = time.monotonic_ns()
    # Whatever the ring still holds was exposed before; frames that began later all show the light.
    for _ in range(50):
        frame = bench.camera.next_frame(10.0)
        began = (frame.metadata.device_time_ns or 0) - frame.metadata.exposure_ms * 1e6
        if began >= asked:
            assert frame.image.max() > 200
    bench.camera.stop_sequence()
    bench.leds.off()
    assert bench.camera.snap().image.max() < 200


def test_places_that_the_source_has_left_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.simulated.world.SOURCES_KEPT", 4)
    world = Bench().world
    sweep = [(0.0, 0.0, Z_UM + 1000 * n) for n in range(12)]
    first = world.psf(sweep[0], (0.0, 1.0, 0.0))
    tracemalloc.start()
    try:
        for place in sweep[1:]:
            world.psf(place, (0.0, 1.0, 0.0))
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes < 5 * first.nbytes
    assert np.array_equal(world.psf(sweep[0], (0.0, 1.0, 0.0)), first)


def test_without_a_stage_the_source_rests_on_the_axis() -> None:
    world = SimulatedWorld(WorldOptions(preset="tiny"))
    assert world.source_position_um == (0.0, 0.0, Z_UM)
    SimulatedStage(StageOptions(axis_names=("z_um",), mount_offset_um=(10.0, 20.0, 0.0)), world)
    assert world.source_position_um[:2] == (10.0, 20.0)


# The stage's errors ---
def still(**errors: float) -> StageOptions:
    """One axis with exactly these errors."""
    options = {"backlash": 0.0, "repeatability": 0.0} | errors
    return StageOptions(axis_names=("x_um",), axes={"x_um": AxisOptions.model_validate(options)})


def true_x(bench: Bench, target: float) -> float:
    bench.stage.move_to({"x_um": target})
    return bench.world.source_position_um[0]


def test_play_shows_when_the_direction_turns() -> None:
    bench = Bench(stage=still(backlash=40.0))
    assert true_x(bench, 1000.0) == pytest.approx(1000.0)
    assert true_x(bench, 2000.0) == pytest.approx(2000.0)
    assert true_x(bench, 1990.0) == pytest.approx(2000.0)
    assert true_x(bench, 1000.0) == pytest.approx(1040.0)
    assert true_x(bench, 1010.0) == pytest.approx(1040.0)
    assert true_x(bench, 2000.0) == pytest.approx(2000.0)
    assert bench.stage.position()["x_um"] == pytest.approx(2000.0)


def test_moves_repeat_within_the_repeatability() -> None:
    bench = Bench(stage=still(repeatability=2.0))
    errors = []
    for _ in range(200):
        true_x(bench, 0.0)
        errors.append(true_x(bench, 500.0) - 500.0)
    assert np.std(errors) == pytest.approx(2.0, rel=0.2)
    assert abs(np.mean(errors)) < 0.6


def test_positions_are_whole_steps() -> None:
    bench = Bench(stage=still(resolution=2.5))
    assert bench.stage.move_to({"x_um": 101.0})["x_um"] == 100.0


def test_moves_take_their_time_and_pass_through() -> None:
    bench = Bench(time_scale=0.02)
    start, target = bench.stage.position(), {"x_um": 40e3}
    seconds = bench.stage.move_duration_s(start, target) * 0.02
    began = time.monotonic()
    bench.stage.move_to(target, wait=False)
    seen = []
    while bench.stage.is_moving:
        seen.append(bench.stage.position()["x_um"])
        time.sleep(seconds / 20)
    assert time.monotonic() - began >= 0.9 * seconds
    assert np.all(np.diff(seen) >= 0)
    assert any(4e3 < x < 36e3 for x in seen)
    assert bench.stage.position()["x_um"] == pytest.approx(40e3)


def test_without_time_nothing_waits() -> None:
    bench = Bench()
    bench.camera.set_exposure_ms(20_000.0)
    began = time.monotonic()
    for x in (1e4, -1e4):
        bench.stage.move_to({"x_um": x})
        bench.counts()
    assert time.monotonic() - began < 20


# Faults ---
def test_an_unplugged_camera_says_so_even_while_streaming() -> None:
    bench = Bench()
    bench.camera.start_sequence(n_buffers=2)
    bench.camera.next_frame(10.0)
    bench.world.unplug("camera")
    with pytest.raises(DeviceError, match=r"camera .*unplugged"):
        bench.camera.next_frame(10.0)
    with pytest.raises(DeviceError, match="unplugged"):
        bench.camera.snap()
    bench.camera.close()
    with pytest.raises(DeviceError, match="unplugged"):
        bench.camera.open()
    bench.world.plug_in("camera")
    bench.camera.open()
    bench.camera.snap()


def test_a_sequence_that_dies_says_so_to_who_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(bench.world, "photons_per_s", lambda *_: 1 / 0)
    reported: queue.Queue[threading.ExceptHookArgs] = queue.Queue()
    monkeypatch.setattr(threading, "excepthook", reported.put)
    bench.camera.start_sequence()
    with pytest.raises(DeviceError, match="ended by an error"):
        bench.camera.next_frame(10.0)
    assert not bench.camera.is_streaming
    assert reported.get(timeout=10.0).exc_type is ZeroDivisionError


def test_an_end_that_was_asked_for_is_no_failure_however_quickly_it_comes() -> None:
    camera = Bench().camera
    camera.start_sequence(n_buffers=2)
    producer = camera._producer
    assert producer is not None
    camera._abort.set()  # what stop_sequence does first: the sequence may have ended before it does the rest
    producer.join(10.0)
    with pytest.raises(StoppedError):
        [camera.next_frame(10.0) for _ in range(3)]  # one more than it may have in its buffers
    camera.stop_sequence()


@pytest.mark.parametrize("kind", ["stage", "led_array"])
def test_other_devices_say_so_too(kind: str) -> None:
    bench = Bench()
    bench.world.unplug(kind)
    action: Callable[[], object] = bench.stage.stop if kind == "stage" else bench.leds.off
    with pytest.raises(DeviceError, match=kind):
        action()


def test_a_stuck_axis_is_named() -> None:
    bench = Bench(time_scale=0.01)
    bench.stage.carriage.set_jammed("x_um", True)
    with pytest.raises(DeviceError, match="x_um does not move"):
        bench.stage.move_to({"x_um": 1000.0})
    assert not bench.stage.is_homed
    bench.stage.carriage.set_jammed("x_um", False)
    bench.stage.home()
    assert bench.stage.move_to({"x_um": 1000.0})["x_um"] == 1000.0


def test_lost_steps_end_at_the_limit_switch() -> None:
    bench = Bench()
    bench.stage.carriage.slip("x_um", 3000.0)
    with pytest.raises(DeviceError, match=r"x_um ran into its limit switch"):
        bench.stage.move_to({"x_um": bench.stage.limits["x_um"][1]})
    assert not bench.stage.is_homed
    assert not bench.stage.is_moving
    bench.stage.home()
    assert true_x(bench, 100.0) == pytest.approx(100.0, abs=5.0)


def test_stop_cuts_a_long_exposure_short() -> None:
    bench = Bench(time_scale=1.0, stage=StageOptions(axis_names=("x_um",)))
    bench.camera.set_exposure_ms(20_000.0)
    threading.Timer(0.1, bench.camera.stop_sequence).start()
    with pytest.raises(StoppedError):
        bench.camera.snap()


def test_stop_does_not_wait_until_a_new_light_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    begun, computed = threading.Event(), threading.Event()
    see = bench.world.photons_per_s

    def slowly(weights: Rgb, binning: int = 1) -> object:
        begun.set()
        assert computed.wait(30.0)
        return see(weights, binning)

    monkeypatch.setattr(bench.world, "photons_per_s", slowly)
    bench.camera.start_sequence()
    assert begun.wait(10.0)
    time.sleep(0.1)  # until the exposure waits for its light
    late = threading.Timer(20.0, computed.set)
    late.start()
    bench.camera.stop_sequence()
    assert not bench.camera.is_streaming
    assert not computed.is_set()
    late.cancel()
    computed.set()
    bench.camera.snap()
    bench.camera.close()
    assert not any(thread.name == "simulated light" for thread in threading.enumerate())


@pytest.mark.parametrize("shared", [False, True], ids=["in its thread", "in others that it waits for"])
def test_what_a_light_takes_of_the_processor_is_told_and_waiting_is_none(
    monkeypatch: pytest.MonkeyPatch, shared: bool
) -> None:
    bench = Bench()
    waits, ends = threading.Event(), threading.Event()
    see = bench.world.photons_per_s

    def busy() -> None:
        until_s = time.thread_time() + 0.05
        while time.thread_time() < until_s:
            pass

    def busy_then_waiting(weights: Rgb, binning: int = 1) -> object:
        busy()
        waits.set()
        assert ends.wait(20.0)
        return see(weights, binning)

    def seen(weights: Rgb, binning: int = 1) -> object:
        if not shared:
            return busy_then_waiting(weights, binning)
        with ThreadPoolExecutor(1, "render") as pool:  # as beads are
            return pool.submit(busy_then_waiting, weights, binning).result()

    monkeypatch.setattr(bench.world, "photons_per_s", seen)
    assert bench.camera.computed_s() == 0
    bench.camera.start_sequence()
    assert waits.wait(20.0)
    time.sleep(0.05)
    computed_s = bench.camera.computed_s()
    other = threading.Thread(target=busy)  # as a window's
    other.start()
    other.join()
    assert bench.camera.computed_s() == computed_s > 0
    ends.set()
    bench.camera.stop_sequence()


def test_frames_that_nobody_asks_for_are_not_computed_where_nothing_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.simulated.camera._UNWANTED_S", 0.05)
    bench = Bench()
    bench.camera.start_sequence(2)
    frame_id = bench.camera.next_frame(20).metadata.frame_id
    time.sleep(0.3)
    computed = bench.camera._next_id
    time.sleep(0.3)
    assert bench.camera._next_id == computed
    for _ in range(4):
        frame_id, before = bench.camera.next_frame(20).metadata.frame_id, frame_id
        assert frame_id > before
    bench.camera.stop_sequence()


# The camera's electronics ---
def test_stop_ends_homing_on_the_reference_mark_too() -> None:
    bench = Bench()
    bench.world.clock.time_scale = 1.0
    threading.Timer(0.1, bench.stage.stop).start()
    with pytest.raises(StoppedError, match="homing was stopped"):
        bench.stage.home()
    assert not bench.stage.is_homed
    assert not bench.stage.is_moving


def test_a_region_is_cut_out_of_the_whole_frame() -> None:
    bench = Bench()
    whole = bench.lit()
    roi = bench.camera.set_roi(Roi(40, 60, 100, 120))
    np.testing.assert_array_equal(bench.counts(), whole[40:140, 60:180])
    assert roi == Roi(40, 60, 100, 120)


def test_binning_sums_light() -> None:
    bench = Bench()
    bench.camera.set_exposure_ms(0.2)
    whole = bench.lit()
    bench.camera.set_binning(2)
    binned = bench.counts()
    summed = whole.reshape(120, 2, 160, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(binned, summed, atol=4)


def test_each_pixel_that_is_summed_is_read_with_its_own_noise() -> None:
    bench = Bench(noise=1.0)
    bench.camera.set_gain(16.0)  # far above rounding
    noise = []
    for binning in (1, 4):
        bench.camera.set_binning(binning)
        noise.append(np.std(bench.counts() - bench.counts()))
    assert noise[1] / noise[0] == pytest.approx(4, rel=0.1)


def test_a_large_sensor_tells_coarsely_what_its_frame_will_show(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "COARSE_PIXELS", 1200)
    bench = Bench()
    bench.world.scene_lit = True
    found: list[tuple[Float64Array, int] | None] = []
    absorbed = bench.camera._absorbed

    def watched(*given: object) -> Float32Array:
        found.append(bench.camera.coarse())
        return absorbed(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(bench.camera, "_absorbed", watched)
    bench.camera.set_roi(Roi(0, 160, 240, 160))
    bench.camera.set_exposure_ms(300.0)
    bench.camera.coarse_first = True
    frame = bench.camera.snap().image.astype(float)
    assert bench.camera.coarse() is None  # the frame is there
    assert found[0] is not None
    coarse, factor = found[0]
    assert (factor, coarse.shape) == (8, (30, 20))
    blocks = frame.reshape(30, 8, 20, 8).mean(axis=(1, 3))
    assert np.abs(coarse - blocks).max() < 0.1 * (blocks.max() - blocks.min())
    bench.camera.set_roi(Roi(0, 0, 240, 320))
    bench.camera.snap()
    assert found[1] is None  # its light is known, whatever the region
    bench.world.set_scene(bench.world.scene)
    bench.camera.coarse_first = False
    bench.camera.snap()
    assert found[2] is None  # nobody looks


def test_a_mosaic_separates_colours() -> None:
    bench = Bench(camera=CameraOptions(color=True, crosstalk=0.1), source_diameter_um=3000.0)
    assert bench.camera.pixel_formats[0].startswith("BayerRG")
    bench.camera.set_exposure_ms(60.0)
    # Blurred by a large source, neighbouring pixels of different colour get the same light.
    red = bench.lit((255, 0, 0))
    bright = red[0::2, 0::2] > 300
    red_pixels, green_pixels, blue_pixels = (
        plane[bright].mean() for plane in (red[0::2, 0::2], red[0::2, 1::2], red[1::2, 1::2])
    )
    assert bright.sum() > 100
    assert red.max() < 4000
    assert green_pixels == pytest.approx(0.1 * red_pixels, rel=0.1)
    assert blue_pixels == pytest.approx(0.1 * red_pixels, rel=0.1)
    green = bench.lit((0, 255, 0))
    assert green[0::2, 1::2].sum() > 5 * green[0::2, 0::2].sum()


def test_frames_repeat_from_session_to_session_but_not_within() -> None:
    sessions = []
    for _ in range(2):
        bench = Bench(noise=1.0, fixed_pattern=True)
        bench.lit()
        sessions.append([bench.camera.snap().image for _ in range(2)])
    np.testing.assert_array_equal(sessions[0][0], sessions[1][0])
    np.testing.assert_array_equal(sessions[0][1], sessions[1][1])
    assert not np.array_equal(sessions[0][0], sessions[0][1])
    other = Bench(noise=1.0, fixed_pattern=True, seed=1)
    other.lit()
    assert not np.array_equal(other.camera.snap().image, sessions[0][0])


def test_a_dark_frame_of_the_same_number_has_other_noise() -> None:
    # Else subtracting it would take away read noise that no real dark frame takes away.
    # The sensor's upper left corner, which the light does not reach.
    corners = []
    for exposure_ms, rgb in ((1.0, (0, 0, 0)), (2.0, (0, 0, 0)), (1.0, (0, 1, 0))):
        bench = Bench(noise=1.0)
        bench.camera.set_exposure_ms(exposure_ms)
        corners.append(bench.lit(rgb)[:100, :60].ravel())
    correlations = np.corrcoef(corners)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < 0.1


def test_repeated_frames_have_noise_of_their_own() -> None:
    bench = Bench(camera=CameraOptions(replay_frames=3), noise=1.0)
    bench.lit()
    bench.camera.set_exposure_ms(0.5)
    images = [bench.camera.snap().image for _ in range(6)]
    assert not np.array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[3])
    bench.leds.off()
    assert bench.camera.snap().image.max() < images[0].max()


# The SLM ---
def test_grey_levels_become_phase_through_the_table() -> None:
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    with SimulatedSlm(SlmOptions(shape=(2, 2), lut_gamma=1.5), world) as slm:
        slm.display(np.array([[0, 255], [128, 64]], np.uint8))
        full = 2 * np.pi * 255 / 256
        expected = full * (np.array([[0, 255], [128, 64]]) / 255) ** 1.5
        np.testing.assert_allclose(slm.phase_rad, expected, rtol=1e-5)


# Races ---
def test_a_scene_changed_while_a_frame_is_made_is_not_mistaken_for_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench, other = Bench(scene="beads", beads=2), Bench(scene="beads", beads=1)
    bench.world.scene_lit = other.world.scene_lit = True
    glow = bench.world._glow

    def change(light: Rgb) -> Rgb:
        bench.world.set_scene(other.world.scene)
        return glow(light)

    with monkeypatch.context() as patch:
        patch.setattr(bench.world, "_glow", change)
        bench.world.photons_per_s((0, 1, 0))
    seen, expected = (b.world.photons_per_s((0, 1, 0)) for b in (bench, other))
    assert seen is not None
    np.testing.assert_array_equal(seen, expected)


def test_a_light_switched_while_a_frame_is_made_is_seen_by_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    lit = bench.lit()
    bench.leds.off()
    bench.counts()
    key = bench.world.light_key

    def switch_off() -> object:
        lit_key = key()
        bench.leds.off()
        return lit_key

    bench.leds.set_pattern(bench.leds.single(0, (0, 255, 0)))
    with monkeypatch.context() as patch:
        patch.setattr(bench.world, "light_key", switch_off)
        bench.counts()
    np.testing.assert_array_equal(bench.lit(), lit)


# Truth, options ---
def test_ground_truth_follows_the_scene() -> None:
    bench = Bench(scene="beads", beads=5, bead_diameter_um=0.0)
    truth = bench.world.ground_truth((240, 320), 13.0)
    assert np.count_nonzero(truth) == 5
    near, far = bench.world.scene.depths_um  # type: ignore[union-attr]
    volume = bench.world.ground_truth((240, 320), 13.0, np.linspace(near, far, 4))
    np.testing.assert_allclose(volume.sum(axis=0), truth, rtol=1e-5)
    assert bench.world.ground_truth((240, 320), 13.0, color=True).shape == (240, 320, 3)
    dimmer = bench.world.ground_truth((240, 320), 13.0, collected=True)
    assert 0.5 < dimmer.sum() / truth.sum() < 1
    bench.world.set_scene(None)
    with pytest.raises(ValueError, match="no scene"):
        bench.world.ground_truth((240, 320), 13.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"preset": "huge"},
        {"noise": -1},
        {"fall_off": "table"},
        {"fall_off": "table", "fall_off_table": [[0, 1], [0, 0.5]]},
        {"fall_off_table": [[0, 1], [30, 0.5]]},
        {"aperture_mm": [0, 1]},
        {"mean_slope_deg": 45},
        {"typo": 1},
        {"aperture_mm": [300.0, 300.0]},
        {"feature_size_um": 2.0},
        {"diffuser": "random_microlens", "focal_length_um": 300.0},
        {"scene": "beads", "scene_depth_mm": 200.0},
    ],
)
def test_wrong_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        WorldOptions.model_validate({"preset": "tiny"} | wrong)


@pytest.mark.parametrize("kind", ["random_microlens", "regular_microlens"])
def test_the_shortest_focal_length_allowed_can_be_made(kind: str) -> None:
    bench = Bench(diffuser=kind, lenslet_um=100.0, focal_length_um=170.0)
    assert np.isfinite(bench.world.diffuser.heights_um).all()


def test_a_fall_off_table_is_what_the_pixels_do() -> None:
    table = ((0.0, 1.0), (10.0, 0.6), (40.0, 0.0))
    plain, shaded = Bench(), Bench(fall_off="table", fall_off_table=table)
    for bench in (plain, shaded):
        bench.stage.move_to({"x_um": float(np.tan(np.deg2rad(10.0)) * Z_UM)})
    ratio = shaded.lit().sum() / plain.lit().sum()
    assert ratio == pytest.approx(0.6, abs=0.03)


# LEDs on the scene ---
def test_leds_light_the_scene_part_by_part_and_add_up() -> None:
    leds = LedArrayOptions(leds=9, led_pitch_mm=5.0, distance_mm=4.0)
    bench = Bench(led_light="scene", scene="sheet", scene_distance_mm=30.0)
    bench.leds = SimulatedLedArray(leds, bench.world)
    bench.leds.open()
    bench.camera.set_exposure_ms(0.2)
    assert bench.counts().max() <= 1

    def lit(*numbers: int) -> Float32Array:
        bench.leds.set_pattern(LedPattern("some", tuple((n, (255, 255, 255)) for n in numbers)))
        light = bench.world.photons_per_s((1.0, 1.0, 1.0))
        assert light is not None
        return light

    left, right = (int(i) for i in (np.argmin(leds_x(bench)), np.argmax(leds_x(bench))))
    one, other = lit(left), lit(right)
    np.testing.assert_allclose(lit(left, right), one + other, rtol=1e-4)
    columns = np.arange(one.shape[1])
    places = [float((frame.sum(axis=0) * columns).sum() / frame.sum()) for frame in (one, other)]
    assert places[0] > places[1] + 10  # the picture stands upside down
    bench.leds.off()
    assert bench.counts().max() <= 1


def leds_x(bench: Bench) -> Float64Array:
    return bench.leds.led_positions_mm[:, 0]
