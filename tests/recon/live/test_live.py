"""Live pictures: as good as converged while the scene is still, coarser rather than later."""

from __future__ import annotations

import re
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import Calibration, InputError, NoiseModel, reconstruct
from recon.base.metrics import psnr
from recon.streams.detail import Detail
from recon.streams.fit import CalibrationWatch
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import DARK, NOISE_ONLY, UNLIT, UNLIT_SO_FAR, Level, LivePicture
from recon.streams.pace import HOLD, Pace, Spent
from recon.streams.stillness import SceneState, SceneWatch, has_light
from recon.streams.video import VideoSolver

SHAPE = (64, 96)
AMPLE_MS = 5000.0
"""A budget that no machine exhausts: iterations go on until the picture has settled."""
NOISE = NoiseModel(read_noise=2.0, counts_per_electron=0.05)


def spots_psf(shape: tuple[int, int] = SHAPE, count: int = 40) -> np.ndarray:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    psf = np.zeros(shape)
    for cy, cx in rng.uniform((8, 8), (shape[0] - 8, shape[1] - 8), (count, 2)):
        psf += np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 1.3**2))
    return (psf / psf.sum()).astype(np.float32)


def photograph(column: float, seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """A frame of discs, spot by spot at continuous places (no FFT, no grid), with photon and read noise."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    centres = rng.uniform((8, 8), (shape[0] - 8, shape[1] - 8), (40, 2)) - np.array(shape) // 2
    image = np.zeros(shape)
    for dy, dx, light in ((-6.3, -9.1, 1.0), (7.2, 4.4, 0.6), (0.4, 14.7, 0.8)):
        for cy, cx in centres + np.array(shape) // 2:
            image += light * np.exp(-((y - cy - dy) ** 2 + (x - cx - dx - column) ** 2) / (2 * 2.2**2))
    noisy = np.random.default_rng(seed)
    counts = noisy.poisson(image * 8000) * NOISE.counts_per_electron + noisy.normal(0, 2, shape)
    return np.clip(np.round(counts + 20), 0, 4095).astype(np.uint16)


def live(**settings: object) -> LiveReconstructor:
    settings = {"background": 20.0, "budget_ms": 25.0, "noise": NOISE, "coarsest": 1, **settings}
    return LiveReconstructor(spots_psf(), **settings)  # type: ignore[arg-type]


def iterated(reconstructor: LiveReconstructor, frame: np.ndarray) -> LivePicture:
    """Feed a first frame and wait until its picture is iterated."""
    assert reconstructor.feed(frame).method == "wiener"
    picture = reconstructor.refine()
    assert picture is not None
    return picture


def taking(reconstructor: LiveReconstructor, fixed_ms: float, step_ms: float) -> None:
    """Have the reconstructor believe that pictures take so long."""
    fixed, step = (Spent(ms, ms) for ms in (fixed_ms, step_ms))
    for _ in range(7):
        reconstructor._pace.note(fixed, step, 1)


def test_a_frame_gets_the_iterations_that_its_time_allows() -> None:
    reconstructor = live(budget_ms=AMPLE_MS, average=1)
    iterated(reconstructor, photograph(0, 1))
    taking(reconstructor, 1.0, AMPLE_MS / 20)
    began = time.monotonic()
    moved = [reconstructor.feed(photograph(0.7 * k, k)) for k in (1, 2)]
    assert moved[-1].iterations > 5, [str(picture.scene) for picture in moved]
    assert 0 < sum(picture.work_ms for picture in moved) <= 1e3 * (time.monotonic() - began)


def test_a_still_scene_converges_to_the_reconstruction() -> None:
    reconstructor = live(average=1)
    frame = photograph(0, 1)
    first = iterated(reconstructor, frame)
    assert first.scene is SceneState.NEW
    assert (first.binning, first.method, first.frames) == (1, "admm-sensor", 1)
    reference = reconstruct(
        frame, spots_psf(), solver="admm-sensor", background=20.0, noise=NOISE, iterations=200, tolerance=0
    ).image
    picture = first
    for _ in range(200):
        picture = reconstructor.refine() or picture
    assert picture.settled
    assert picture.total_iterations > first.iterations or first.settled
    assert reconstructor.refine() is None
    assert psnr(picture.image, reference) > 45
    assert "settled" in picture.quality


def test_averaging_frames_of_a_still_scene_lessens_noise() -> None:
    clean = reconstruct(
        np.mean([photograph(0, seed) for seed in range(100, 140)], axis=0) - 20.0,
        spots_psf(),
        solver="admm-sensor",
        noise=NOISE,
        iterations=300,
    ).image
    alone, averaging = live(average=1), live(average=8)
    for seed in range(12):
        one, many = (r.feed(photograph(0, seed)) for r in (alone, averaging))
    # To the end, however little time this machine had for each.
    for _ in range(100):
        one, many = alone.refine() or one, averaging.refine() or many
    assert (one.frames, many.frames) == (1, 8)
    assert many.scene is SceneState.STILL
    assert psnr(many.image, clean) > psnr(one.image, clean) + 1


def test_warm_start_follows_a_moving_scene() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    moved = reconstructor.feed(photograph(0.5, 1))
    assert (moved.scene, moved.frames, moved.method) == (SceneState.MOVING, 1, "admm-sensor")
    assert moved.total_iterations > moved.iterations
    assert np.unravel_index(np.argmax(moved.image), SHAPE)[1] >= 22


def test_a_cut_is_shown_by_a_wiener_filter_at_once_then_iterated_from_the_start() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    cut = reconstructor.feed(photograph(0, 2)[:, ::-1])
    assert (cut.scene, cut.method, cut.iterations) == (SceneState.NEW, "wiener", 0)
    assert "Wiener filter" in cut.quality
    after = reconstructor.feed(photograph(0, 3)[:, ::-1])
    assert (after.scene, after.method) == (SceneState.STILL, "admm-sensor")
    assert after.total_iterations == after.iterations
    # Scene after scene: only the first is a filter's.
    reconstructor.feed(photograph(0, 4))
    again = reconstructor.feed(photograph(0, 5)[::-1])
    assert (again.scene, again.method) == (SceneState.NEW, "admm-sensor")


def test_refining_goes_on_from_the_wiener_picture_of_the_newest_frame() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    iterated(reconstructor, photograph(0, 0))
    rough = reconstructor.feed(photograph(0, 2)[:, ::-1])
    better = reconstructor.refine()
    assert better is not None
    assert better.method == "admm-sensor"
    assert better.total_iterations == better.iterations
    for _ in range(100):
        better = reconstructor.refine() or better
    reference = reconstruct(
        photograph(0, 2)[:, ::-1], spots_psf(), solver="admm-sensor", background=20.0, noise=NOISE,
        iterations=200, tolerance=0,
    ).image  # fmt: skip
    assert psnr(better.image, reference) > psnr(rough.image, reference) + 6


def test_quality_gives_way_not_time() -> None:
    reconstructor = live(coarsest=8, budget_ms=100.0)
    assert iterated(reconstructor, photograph(0, 0)).binning == 1
    # Room for one iteration and a half: too few, so the pixels get coarser, after a few frames.
    fed = 0
    while reconstructor._coming is None:
        taking(reconstructor, fixed_ms=10, step_ms=60)
        assert reconstructor.feed(photograph(0.5 * (fed % 2), fed)).binning == 1
        fed += 1
    assert fed == 3
    reconstructor._coming.wait()
    assert reconstructor._level is not None
    finer = reconstructor._level.solver
    coarse = reconstructor.feed(photograph(0, 0))
    assert finer is not None
    assert finer.solvers == [None], "its memory is given up"
    assert (coarse.binning, coarse.method) == (2, "admm-sensor")
    assert coarse.image.shape == (32, 48)
    assert "binned 2 x 2" in coarse.quality
    # Room for nothing: the Wiener filter.
    taking(reconstructor, fixed_ms=90, step_ms=60)
    rough = reconstructor.feed(photograph(3, 1))
    assert (rough.method, rough.iterations) == ("wiener", 0)
    assert "Wiener filter" in rough.quality


def test_no_pixels_are_given_up_where_they_are_not_what_costs_time() -> None:
    reconstructor = live(coarsest=8, budget_ms=100.0)
    iterated(reconstructor, photograph(0, 0))
    waiting = Spent(90.0, 1.0)
    for n in range(12):
        for _ in range(7):
            reconstructor._pace.note(waiting, waiting, 1)
        picture = reconstructor.feed(photograph(3.0 * n, n))
    assert reconstructor._coming is None
    assert (picture.binning, picture.method) == (1, "wiener")


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """The binnings for whose solver there is no memory."""
    binnings: set[int] = set()

    solving = Level.solving

    def if_there_is_memory(level: Level) -> Level:
        if level.binning in binnings:
            raise MemoryError("none left")
        return solving(level)

    monkeypatch.setattr(Level, "solving", if_there_is_memory)
    return binnings


def test_a_coarser_binning_without_memory_is_told_once_and_pictures_go_on(lacking: set[int]) -> None:
    reconstructor = live(coarsest=4, budget_ms=100.0)
    iterated(reconstructor, photograph(0, 0))
    lacking.add(2)
    tried: list[int] = []
    picture = None
    while picture is None or picture.binning == 1:
        taking(reconstructor, fixed_ms=10, step_ms=60)
        picture = reconstructor.feed(photograph(0.5 * (len(tried) % 2), len(tried)))
        if reconstructor._coming is not None:
            tried.append(reconstructor._coming.detail.binning)
            reconstructor._coming.wait()
    assert tried == [2, 3]
    assert picture.binning == 3
    (told,) = reconstructor.warnings
    assert "no memory" in told
    assert "2 x 2" in told
    assert "go on binned 1 x 1" in told
    reconstructor.restart()
    assert reconstructor.warnings == ()
    assert 2 in reconstructor._pace.levels


def test_a_finer_binning_without_memory_is_not_tried_again(
    lacking: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstructor = live(coarsest=4, budget_ms=AMPLE_MS)
    monkeypatch.setattr("recon.streams.live.AT_ONCE", 500)  # begins coarse
    lacking.add(1)
    assert iterated(reconstructor, photograph(0, 0)).binning == 4
    tried: list[int] = []
    for n in range(12):
        picture = reconstructor.feed(photograph(0.5 * (n % 2), n))
        if reconstructor._coming is not None:
            tried.append(reconstructor._coming.detail.binning)
            reconstructor._coming.wait()
    assert tried == [1]
    assert (picture.binning, picture.method) == (4, "admm-sensor")
    assert len(reconstructor.warnings) == 1


def test_without_memory_for_the_first_solver_a_coarser_one_is_made(lacking: set[int]) -> None:
    lacking.update((1, 2))
    reconstructor = live(coarsest=4, budget_ms=AMPLE_MS)
    for n in range(6):
        picture = reconstructor.feed(photograph(0, n))
        assert reconstructor._coming is None or reconstructor._coming.wait()
    assert (picture.binning, picture.method) == (3, "admm-sensor")
    assert [w.split(":")[0][-5:] for w in reconstructor.warnings] == ["1 x 1", "2 x 2"]


def test_without_memory_for_any_solver_the_wiener_filter_goes_on(lacking: set[int]) -> None:
    lacking.update((1, 2))
    reconstructor = live(coarsest=2, budget_ms=AMPLE_MS)
    for n in range(6):
        picture = reconstructor.feed(photograph(0, n))
        if reconstructor._coming is not None:
            reconstructor._coming.wait()
        assert picture.method == "wiener"
    assert reconstructor.refine() is None
    assert len(reconstructor.warnings) == 2
    assert "Wiener filter's" in reconstructor.warnings[0]


def test_an_error_in_making_a_level_is_told_by_the_next_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: Level) -> Level:
        raise ValueError("broken")

    monkeypatch.setattr(Level, "solving", broken)
    reconstructor = live()
    reconstructor.feed(photograph(0, 0))
    assert reconstructor._coming is not None
    reconstructor._coming.wait()
    with pytest.raises(ValueError, match="broken"):
        reconstructor.feed(photograph(0, 1))


def test_brightness_does_not_depend_on_binning() -> None:
    pictures = [iterated(live(finest=b, coarsest=b, budget_ms=AMPLE_MS), photograph(0, 0)) for b in (1, 2, 4)]
    sums = [float(p.image.sum()) * p.binning**2 for p in pictures]
    assert sums == pytest.approx([sums[0]] * 3, rel=0.1)


def test_refining_ends_when_a_newer_frame_is_there() -> None:
    reconstructor = live()
    iterated(reconstructor, photograph(0, 0))
    reconstructor._settled = False
    refined = reconstructor.refine(lambda: True)
    assert refined is not None
    assert refined.iterations == 1


def test_colour_and_frames_finer_than_the_psf() -> None:
    psf = np.stack([spots_psf()] * 3, axis=2)
    frame = np.stack([photograph(0, seed) for seed in range(3)], axis=2)
    picture = LiveReconstructor(psf, background=20.0, budget_ms=25.0, coarsest=1).feed(frame)
    assert picture.image.shape == (*SHAPE, 3)
    assert picture.image.flags.c_contiguous
    fine = np.kron(photograph(0, 0), np.ones((2, 2), np.uint16))
    coarse = live().feed(photograph(0, 0))
    assert psnr(live().feed(fine).image, coarse.image) > 60


def test_calibration_with_background_and_depths() -> None:
    psfs = np.stack([spots_psf(), np.roll(spots_psf(), 5, 1)])[:, None]
    places = np.array([[0, 0, 1000.0], [0, 0, 2000.0]])
    calibration = Calibration(psfs, places, np.full((1, *SHAPE), 20.0, np.float32))
    reconstructor = LiveReconstructor(calibration, z_um=1000.0, noise=NOISE, budget_ms=25.0, coarsest=1)
    assert psnr(reconstructor.feed(photograph(0, 0)).image, live().feed(photograph(0, 0)).image) > 60


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (np.zeros((10, 10), np.uint16), "10 x 10 pixels and the PSF 64 x 96"),
        (np.zeros((128, 96), np.uint16), "whole factor"),
        (np.full(SHAPE, np.nan, np.float32), "not finite"),
        (np.zeros(5, np.uint16), "must be"),
    ],
)
def test_unusable_frames_are_refused(frame: np.ndarray, says: str) -> None:
    with pytest.raises(InputError, match=says):
        live().feed(frame)


def test_a_frame_that_is_not_finite_spoils_none_of_those_after_it() -> None:
    reconstructor = live()
    frame = photograph(0, 0).astype(np.float32)
    reconstructor.feed(frame)
    spoilt = frame.copy()
    spoilt[3, 4] = np.nan
    with pytest.raises(InputError, match="not finite"):
        reconstructor.feed(spoilt)
    assert np.isfinite(reconstructor.feed(photograph(0, 1).astype(np.float32)).image).all()


def test_the_watch_begins_anew_after_what_is_not_finite() -> None:
    watch = SceneWatch()
    frames = np.random.default_rng(0).normal(100, 3, (4, 1, *SHAPE)).astype(np.float32)
    watch.see(frames[0])
    spoilt = frames[1].copy()
    spoilt[0, 3, 4] = np.nan
    assert watch.see(spoilt) is SceneState.NEW
    assert watch.see(frames[2]) is SceneState.NEW
    assert watch.see(frames[3]) is SceneState.STILL
    assert np.isfinite(watch.mean).all()


@pytest.mark.parametrize("settings", [{"budget_ms": 0}, {"finest": 3, "coarsest": 2}, {"average": 0}])
def test_unusable_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(settings))):
        live(**settings)


def test_what_has_seen_nothing_can_be_restarted() -> None:
    reconstructor = live()
    reconstructor.restart()
    assert iterated(reconstructor, photograph(0, 1)).iterations > 0


def test_a_change_of_format_needs_a_restart() -> None:
    reconstructor = live()
    reconstructor.feed(photograph(0, 0))
    fine = np.kron(photograph(0, 0), np.ones((2, 2), np.uint16))
    with pytest.raises(InputError, match="restart"):
        reconstructor.feed(fine)
    reconstructor.restart()
    assert reconstructor.feed(fine).scene is SceneState.NEW


def test_a_restart_gives_up_what_solvers_hold_and_before_the_first_frame_does_nothing() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    reconstructor.restart()
    iterated(reconstructor, photograph(0, 0))
    assert reconstructor._level is not None
    solver = reconstructor._level.solver
    assert solver is not None
    assert solver.solvers != [None]
    reconstructor.restart()
    assert solver.solvers == [None]


def test_a_depth_that_there_is_not_is_refused() -> None:
    live(plane=0)
    with pytest.raises(InputError, match="plane 1 is none of the 1 depths, counted from 0"):
        live(plane=1)


def test_one_frame_is_not_called_an_average() -> None:
    reconstructor = live(budget_ms=AMPLE_MS, average=1)
    iterated(reconstructor, photograph(0, 0))
    still = reconstructor.feed(photograph(0, 1))
    assert (still.scene, still.frames) == (SceneState.STILL, 1)
    assert ", still" in still.quality
    assert "averaged" not in still.quality


# Whether the scene stands still ----------------------------------------------------------------------
@pytest.mark.parametrize("photons", [0.3, 30, 3000])
def test_noise_alone_is_still_whatever_its_size(photons: float) -> None:
    light = photograph(0, 0).astype(float) / 100
    rng = np.random.default_rng(3)
    watch = SceneWatch()
    states = [watch.see(rng.poisson(light * photons)[None].astype(np.float32)) for _ in range(20)]
    assert states == [SceneState.NEW] + [SceneState.STILL] * 19
    assert watch.count == 8


def test_a_flickering_lamp_is_no_movement_but_a_shift_of_half_a_pixel_is() -> None:
    watch = SceneWatch()
    for seed, gain in enumerate((1.0, 1.1, 0.9)):
        state = watch.see(gain * photograph(0, seed)[None].astype(np.float32))
    assert state is SceneState.STILL
    assert watch.see(photograph(0.5, 9)[None].astype(np.float32)) is SceneState.MOVING


def test_a_slow_drift_is_noticed_because_frames_are_compared_with_their_mean() -> None:
    watch = SceneWatch(average=8)
    states = [watch.see(photograph(0.02 * n, n)[None].astype(np.float32)) for n in range(60)]
    assert SceneState.MOVING in states


def test_identical_frames_are_still() -> None:
    watch = SceneWatch()
    frame = np.zeros((1, 32, 32), np.float32)
    assert [watch.see(frame) for _ in range(2)] == [SceneState.NEW, SceneState.STILL]


# The pace -------------------------------------------------------------------------------------------
def tell(pace: Pace, fixed_ms: float, step_ms: float, busy: float = 1.0, waiting_ms: float = 0.0) -> None:
    """Seven pictures of two iterations; everything takes ``busy`` times its work, and ``waiting_ms`` more."""
    for _ in range(7):
        fixed = Spent(busy * fixed_ms + waiting_ms, fixed_ms)
        pace.note(fixed, Spent(2 * busy * step_ms, 2 * step_ms), 2)


def turns(pace: Pace, budget_ms: float, at_most: int = 400) -> tuple[int, int]:
    """Return after how many pictures another level is wanted, and which; 0 if none is."""
    here = pace.next_level(budget_ms)
    for count in range(1, at_most):
        if here != pace._level:
            return count, here
        here = pace.next_level(budget_ms)
    return 0, here


def test_pace_goes_coarser_soon_and_finer_late() -> None:
    pace = Pace([1, 2, 3, 4])
    assert pace.affordable(1, 33) == 2  # before anything is known
    tell(pace, 2, 12)
    assert pace.affordable(1, 33) == 2
    assert turns(pace, 33) == (0, 1)
    tell(pace, 2, 30)
    assert turns(pace, 33) == (3, 2)
    pace.enter(2)
    tell(pace, 0.5, 7)
    assert turns(pace, 33) == (0, 2)  # the finer one is known not to fit
    tell(pace, 0.5, 3)
    assert pace.cost(1).step.work_ms == 30
    assert turns(pace, 100) == (20, 1)


def test_pace_tries_a_finer_level_it_does_not_know_sooner() -> None:
    pace = Pace([1, 2, 3, 4])
    pace.enter(3)
    tell(pace, 1, 2)
    assert turns(pace, 33) == (5, 2)


def test_pace_takes_one_slow_picture_for_what_it_is() -> None:
    pace = Pace([1, 2])
    tell(pace, 2, 12)
    pace.note(Spent(5000, 2), Spent(24, 24), 2)
    assert pace.affordable(1, 33) == 2


def test_pace_takes_back_a_coarser_level_that_did_not_help() -> None:
    pace = Pace([1, 2, 3, 4])
    tell(pace, 5, 20, busy=2.5)  # work of 45 ms takes 112: pixels seem to matter
    assert turns(pace, 33) == (3, 2)
    pace.enter(2)
    tell(pace, 1, 5, waiting_ms=95)  # they did not
    assert pace.next_level(33) == 1
    pace.enter(1)
    tell(pace, 5, 20, busy=2.5)
    count, level = turns(pace, 33)
    assert (level, count) == (2, HOLD + 2)  # tried again, much later


def test_pace_keeps_a_coarser_level_that_helped_though_not_enough() -> None:
    pace = Pace([1, 2, 3, 4])
    tell(pace, 5, 20, busy=4)
    pace.enter(2)
    tell(pace, 1, 5, waiting_ms=60)
    assert pace.next_level(33) == 2
    assert turns(pace, 33) == (0, 2)  # it is not work that takes the time: no coarser


@pytest.mark.parametrize(("took_ms", "level"), [(89, 10), (92, 9)])
def test_pace_asks_of_a_small_step_half_of_what_it_can_save(took_ms: float, level: float) -> None:
    """Pixels a tenth larger are 19 % fewer: 9.5 % less time is what helps."""
    pace = Pace([9, 10])
    tell(pace, 20, 40)
    pace.enter(10)
    tell(pace, 20, (took_ms - 20) / 2)
    assert pace.next_level(33) == level


def test_pace_waits_longer_for_a_finer_level_that_failed() -> None:
    pace = Pace([1, 2])
    tell(pace, 2, 30)
    pace.enter(2)
    tell(pace, 1, 3)
    assert turns(pace, 100)[0] == 20
    pace.enter(1)
    tell(pace, 2, 30, busy=3)
    assert turns(pace, 100)[1] == 2
    pace.enter(2)
    tell(pace, 1, 3)
    assert turns(pace, 100)[0] == 40


def test_pace_tells_from_wiener_pictures_that_there_is_time_again() -> None:
    pace = Pace([1])
    tell(pace, 2, 12)
    pace.note_filter(Spent(5, 5))
    for _ in range(7):
        pace.note_filter(Spent(50, 5))
    assert pace.affordable(1, 33) == 0
    for _ in range(7):
        pace.note_filter(Spent(5, 5))
    assert pace.affordable(1, 33) == 2


def test_a_frame_of_noise_is_called_so_and_one_with_light_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    reconstructor = live(budget_ms=AMPLE_MS, coarsest=2)
    dark = [np.round(20 + rng.normal(0, 2, SHAPE)).astype(np.uint16) for _ in range(8)]
    for frame in dark[:4]:
        picture = reconstructor.feed(frame)
        assert picture.doubt == NOISE_ONLY
        assert picture.quality.startswith(NOISE_ONLY)
    refined = reconstructor.refine()
    assert refined is not None
    assert refined.doubt == NOISE_ONLY
    # Light on: what was settled on noise is settled anew, and the picture is that of a fresh start.
    assert not reconstructor.feed(photograph(0, 1)).doubt
    assert reconstructor._coming is not None
    reconstructor._coming.wait()
    assert not reconstructor.feed(photograph(0, 1)).doubt
    for _ in range(60):
        picture = reconstructor.refine() or picture
    fresh = live(budget_ms=AMPLE_MS, coarsest=2)
    reference = iterated(fresh, photograph(0, 1))
    for _ in range(60):
        reference = fresh.refine() or reference
    assert psnr(picture.image, reference.image) > 40
    for frame in dark[4:]:
        assert reconstructor.feed(frame).doubt == NOISE_ONLY
    reconstructor._fit._doubt = "Found when something was lit"
    black = reconstructor.feed(dark[4], lit=False)
    assert black.quality == black.doubt == DARK
    assert black.image.shape == refined.image.shape
    assert not black.image.any()
    assert reconstructor.refine() is None, "there is nothing to go on with"
    untold = reconstructor.feed(photograph(0, 1), lit=False)
    assert untold.quality == untold.doubt == UNLIT_SO_FAR, (
        "what was found of frames in another light is not said"
    )
    assert not untold.image.any()
    reconstructor._fit._not_before = 0.0  # at once
    reconstructor.feed(photograph(0, 1), lit=False)
    reconstructor._fit.wait()
    assert reconstructor.feed(photograph(0, 1), lit=False).doubt == "", "a lamp that nobody told of is seen"
    monkeypatch.setattr(CalibrationWatch, "doubt", "Any PSF would explain it as well")
    unlit = reconstructor.feed(photograph(0, 2), lit=False)  # a sensor's own pattern, say
    assert unlit.quality == unlit.doubt == UNLIT
    assert not unlit.image.any()
    assert reconstructor.feed(photograph(0, 3)).image.any(), "what is lit is shown with its doubt"


@pytest.mark.parametrize("side", [16, 24])
def test_small_frames_of_noise_are_told_from_small_frames_with_light(side: int) -> None:
    noise = np.random.default_rng(0).normal(0, 2, (side, side)).astype(np.float32)
    lit = noise + np.where(np.arange(side) < side // 2, 20, 0).astype(np.float32)
    assert not has_light(noise, np.array([2.0]))
    assert has_light(lit, np.array([2.0]))


def test_erased_pixels_are_no_light() -> None:
    erasures = np.zeros(SHAPE, bool)
    erasures[20:40, 30:60] = True
    reconstructor = live(background=None, erasures=erasures)
    dark = np.random.default_rng(0).normal(20, 2, SHAPE)
    assert reconstructor.feed(dark.astype(np.float32)).doubt == NOISE_ONLY


@pytest.mark.parametrize(
    ("psf", "says"),
    [(spots_psf(), ""), (spots_psf()[:, ::-1], "calibration"), (spots_psf()[::-1], "calibration")],
)
def test_a_calibration_that_does_not_fit_is_said_of_every_picture(psf: np.ndarray, says: str) -> None:
    reconstructor = LiveReconstructor(
        np.ascontiguousarray(psf), background=20.0, budget_ms=AMPLE_MS, noise=NOISE, coarsest=1
    )
    reconstructor.feed(photograph(0, 0))
    assert reconstructor._fit._running is None, "the first pictures are not held up by it"
    reconstructor._fit._not_before = 0.0  # at once
    assert not reconstructor.feed(photograph(0, 1)).doubt
    reconstructor._fit.wait()
    picture = reconstructor.feed(photograph(0, 2))
    assert says in picture.doubt
    assert bool(says) == bool(picture.doubt)
    assert not says or re.match("(The|This|What|It|A) [a-z]", picture.doubt), picture.doubt


# What fits into a budget, by a clock that only pictures turn ------------------------------------------
@pytest.fixture
def _clocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """An iteration takes 10 ms, 8 of them work, a picture of it 5 and 4, a filter's 2 and 1."""
    now_ms = [1e6, 1e5]
    clock = SimpleNamespace(perf_counter=lambda: now_ms[0] / 1e3, thread_time=lambda: now_ms[1] / 1e3)
    monkeypatch.setattr("recon.streams.live.time", clock)

    def takes(wall_ms: float, work_ms: float, owner: type, name: str) -> None:
        of_itself = getattr(owner, name)

        def call(*args: Any) -> Any:
            now_ms[0] += wall_ms
            now_ms[1] += work_ms
            result = of_itself(*args)
            return False if name == "advance" else result  # never settled

        monkeypatch.setattr(owner, name, call)

    takes(10, 8, VideoSolver, "advance")
    takes(5, 4, VideoSolver, "volume")
    takes(2, 1, Level, "filtered")


@pytest.mark.usefixtures("_clocked")
def test_iterations_are_those_that_fit_into_the_budget() -> None:
    reconstructor = live(budget_ms=100.0, average=1)
    first = reconstructor.feed(photograph(0, 0))
    assert (first.method, first.iterations, first.total_iterations) == ("wiener", 0, 0)
    assert first.work_ms == pytest.approx(2)
    assert first.volume is None
    refined = reconstructor.refine()
    assert refined is not None
    assert (refined.iterations, refined.total_iterations) == (11, 11), "what one takes was not known"
    assert (first.shown, refined.shown) == ("", "")
    assert refined.work_ms == pytest.approx(115)
    assert refined.volume is None
    total, frames = 11, iter(range(1, 99))

    def moved(budget_ms: float) -> LivePicture:
        reconstructor.budget_ms = budget_ms
        n = next(frames)
        picture = reconstructor.feed(photograph(0.7 * n, n))
        assert picture.scene is SceneState.MOVING
        return picture

    for budget_ms, iterations in ((100.0, 2), (104.0, 9), (95.0, 9), (94.0, 8), (25.0, 2), (24.0, 1)):
        picture = moved(budget_ms)
        total += iterations
        assert (picture.method, picture.iterations) == ("admm-sensor", iterations)
        assert picture.total_iterations == total, "each goes on from the one before"
        assert picture.work_ms == pytest.approx(10 * iterations + 5)
        cost = reconstructor._pace.cost(1)
        assert cost is not None
        took = (cost.fixed.wall_ms, cost.fixed.work_ms, cost.step.wall_ms, cost.step.work_ms)
        assert took == pytest.approx((5, 4, 10, 8))
    for budget_ms, iterations in ((94.0, 9), (92.6, 9), (92.4, 8), (91.5, 8), (82.6, 8), (10.0, 1)):
        reconstructor.budget_ms = budget_ms
        refined = reconstructor.refine()
        assert refined is not None
        assert refined.iterations == iterations, "the next one and half of a picture must fit as well"
    rough = moved(14.0)
    assert (rough.method, rough.iterations, rough.total_iterations) == ("wiener", 0, 0)
    assert rough.work_ms == pytest.approx(2)
    reconstructor.budget_ms = 100.0
    anew = reconstructor.refine()
    assert anew is not None
    assert anew.total_iterations == anew.iterations


@pytest.mark.parametrize(
    ("at_once", "binning"), [(700, 3), (800, 3), (1535, 3), (1536, 2), (6144, 1), (90, 4)]
)
def test_the_first_picture_is_the_finest_that_takes_no_time_to_speak_of(
    at_once: int, binning: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recon.streams.live.AT_ONCE", at_once)
    reconstructor = live(coarsest=8)
    assert reconstructor._pace.levels == (1, 2, 3, 4), "below 16 pixels no binning goes"
    assert reconstructor._first_detail().binning == binning


def test_a_known_background_is_taken_off() -> None:
    frame = photograph(0, 0).astype(np.float32)
    less = live(background=None).feed(frame - 20)
    np.testing.assert_allclose(live().feed(frame).image, less.image, atol=1e-5 * float(less.image.max()))


def test_what_the_calibration_is_checked_by_and_what_is_advised_is_said_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Any] = []

    class Looked:
        doubt = ""

        def __init__(self, calibration: Calibration | None = None) -> None:
            self.calibration, self.advice, self.seen = calibration, "", []
            made.append(self)

        def see(self, posed: Any, binning: int, scene: SceneState, frames: int) -> None:
            self.seen.append((binning, scene, frames, posed()))

    monkeypatch.setattr("recon.streams.live.CalibrationWatch", Looked)
    psf_alone = live()
    assert made.pop().calibration is None
    psf_alone.restart()
    assert made.pop().calibration is None
    calibration = Calibration(spots_psf()[None, None], np.array([[0.0, 0.0, 1000.0]]))
    reconstructor = LiveReconstructor(
        calibration, background=20.0, noise=NOISE, budget_ms=AMPLE_MS, coarsest=1
    )
    frames = [photograph(0, n) for n in range(3)]
    for frame in frames[:2]:
        reconstructor.feed(frame)
    (watch,) = made
    assert watch.calibration is calibration
    assert [seen[:3] for seen in watch.seen] == [(1, SceneState.NEW, 1), (1, SceneState.STILL, 2)]
    of_the_mean = reconstructor._level.whole.with_data(  # type: ignore[union-attr]
        np.mean(frames[:2], axis=0, dtype=np.float32) - 20
    )
    np.testing.assert_allclose(watch.seen[1][3].data, of_the_mean.data, rtol=1e-4, atol=1e-4)
    before = reconstructor.warnings
    watch.advice = "a lens cap"
    for frame in frames:
        reconstructor.feed(frame)
    assert reconstructor.warnings == (*before, "a lens cap")
    reconstructor.restart()
    assert made[1].calibration is calibration
    assert reconstructor.warnings == before


def test_what_was_settled_on_noise_is_made_anew_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    make = LiveReconstructor._make

    def counted(self: LiveReconstructor, *given: Any) -> None:
        made.append(given)
        make(self, *given)

    monkeypatch.setattr(LiveReconstructor, "_make", counted)
    reconstructor = live(budget_ms=AMPLE_MS)
    rng = np.random.default_rng(0)
    dark = [np.round(20 + rng.normal(0, 2, SHAPE)).astype(np.uint16) for _ in range(2)]
    for n, frame in enumerate([*dark, *[photograph(0, seed) for seed in range(4)]]):
        reconstructor.feed(frame)
        if reconstructor._coming is not None:
            reconstructor._coming.wait()
        assert len(made) == (n >= 2)
    reconstructor._settled = True
    assert reconstructor.refine() is None


@pytest.mark.parametrize("plane", [None, 2])
def test_a_picture_says_which_depths_it_is_of(plane: int | None) -> None:
    psfs = np.stack([np.roll(spots_psf((32, 32), 9), 3 * k, 1) for k in range(4)])[:, None]
    z_um = np.c_[np.zeros((4, 2)), [1000.0, 2000.0, 3000.0, 4000.0]]
    reconstructor = LiveReconstructor(Calibration(psfs, z_um), noise=1.0, coarsest=1, plane=plane)
    reconstructor._shape = (32, 32)
    volume = np.random.default_rng(0).random((4, 32, 32)).astype(np.float32)
    solver = SimpleNamespace(iterations=7)

    def picture(planes: tuple[int, ...], volume: np.ndarray, done: int | None, **known: Any) -> LivePicture:
        level: Any = SimpleNamespace(
            **{
                "detail": Detail(2, planes),
                "binning": 2,
                "method": "admm",
                "solver": solver,
                "camera": lambda **_: "",
            }
            | known
        )
        return reconstructor._picture(level, volume, done, Spent(0.0, 0.0))

    every = (0, 1, 2, 3)
    iterated = picture(every, volume, 3)
    assert (iterated.method, iterated.iterations, iterated.total_iterations) == ("admm", 3, 7)
    assert iterated.volume is volume
    assert iterated.planes == every
    if plane is None:
        np.testing.assert_array_equal(iterated.image, volume.max(axis=0))
        assert iterated.shown == "brightest of 4 depths"
    else:
        np.testing.assert_array_equal(iterated.image, volume[2])
        assert iterated.shown == "depth 2 of 4 depths"
    two = picture((2, 3), volume[:2], 3)
    assert two.planes == (2, 3)
    np.testing.assert_array_equal(two.image, volume[:2].max(axis=0) if plane is None else volume[0])
    assert "2 of 4 depths (3, 4 mm)" in two.shown
    for planes, middle in ((every, 2), ((0, 1, 3), 1)):
        filtered = picture(planes, volume[:1], 0)
        assert (filtered.method, filtered.iterations, filtered.total_iterations) == ("wiener", 0, 0)
        assert filtered.volume is None
        assert filtered.planes == (middle if plane is None else 2,)
        assert filtered.shown == f"depth {middle if plane is None else 2} of 4 depths"
        np.testing.assert_array_equal(filtered.image, volume[0])
    assert picture(every, volume, 1, solver=None).total_iterations == 0
    reconstructor._dark, reconstructor._settled = True, True
    black = picture(every, volume[:1], None)
    assert (black.method, black.iterations, black.doubt, black.settled) == ("", 0, DARK, True)
    assert picture(every, volume, 2).doubt == NOISE_ONLY
    reconstructor._dark, reconstructor._fit._doubt = False, "It is another's"
    assert picture(every, volume[:1], None).doubt == UNLIT
    assert picture(every, volume, 2).doubt == "It is another's"


@pytest.mark.parametrize(("binning", "planes"), [(1, (0, 1, 2, 3)), (1, (0, 2)), (2, (1, 3))])
def test_a_level_has_its_pixels_and_depths_and_is_judged_by_all_depths(
    binning: int, planes: tuple[int, ...]
) -> None:
    psfs = np.stack([np.roll(spots_psf((32, 32), 9), 3 * k, 1) for k in range(4)])[:, None]
    z_um = np.c_[np.zeros((4, 2)), [1000.0, 2000.0, 3000.0, 4000.0]]
    reconstructor = LiveReconstructor(Calibration(psfs, z_um), noise=1.0, coarsest=2)
    frame = reconstructor._measured(np.random.default_rng(0).poisson(900 * psfs[1, 0]).astype(np.float32))
    level = reconstructor._level_of(Detail(binning, planes), frame)
    side = 32 // binning
    for problem, n_planes in ((level.problem, len(planes)), (level.whole, 4)):
        assert (problem.n_planes, problem.sensor_shape) == (n_planes, (side, side))
        assert problem.depths.central.shape[2:] == (side, side)
    assert level.problem is level.whole or len(planes) < 4
    kept = level.problem.depths.z_um
    np.testing.assert_array_equal(kept, 1000.0 * (1 + np.array(planes)))
    shown = planes[len(planes) // 2]
    assert level.preview.problem.n_planes == 1
    own = level.whole.depths.central[shown, 0]
    seen = level.preview.problem.depths.central[0, 0]
    np.testing.assert_allclose(seen / seen.sum(), own / own.sum(), atol=1e-6)


@pytest.mark.parametrize("channels", [None, 3])
def test_a_whole_picture_has_the_frame_on_the_calibration_s_pixels(
    channels: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr("recon.streams.live.reconstruct", lambda *given, **more: asked.append((given, more)))
    reconstructor = live()
    frame = np.random.default_rng(0).random((2 * SHAPE[0], 2 * SHAPE[1], channels or 1)) * 99
    frame = frame if channels else frame[..., 0]
    reconstructor.full(frame, cancel=None)
    ((measurement, psf, options), more) = asked[0]
    binned = frame.reshape(SHAPE[0], 2, SHAPE[1], 2, -1).mean(axis=(1, 3))
    np.testing.assert_allclose(
        measurement.image,
        binned if channels else binned[..., 0],
        rtol=1e-5,
        err_msg="height, width, channels",
    )
    assert measurement.background == 20.0
    assert options is reconstructor.options
    np.testing.assert_array_equal(psf, spots_psf())
    assert more == {"on_progress": None, "cancel": None}
    frame[3, 4] = np.nan
    with pytest.raises(InputError, match="frame"):
        reconstructor.full(frame)
    assert len(asked) == 1


def test_the_filter_s_time_is_noted_where_frames_come_too_fast_only(monkeypatch: pytest.MonkeyPatch) -> None:
    affordable = [5.0]
    monkeypatch.setattr(Pace, "affordable", lambda *_: affordable[-1])
    reconstructor = live(average=1)
    iterated(reconstructor, photograph(0, 0))
    noted: list[float] = []
    monkeypatch.setattr(Pace, "note_filter", lambda _, took: noted.append(took.wall_ms))
    assert reconstructor.feed(photograph(0, 2)[:, ::-1]).method == "wiener"
    assert noted == [], "another scene"
    reconstructor.feed(photograph(0, 3)[:, ::-1])
    affordable.append(0.5)
    fast = reconstructor.feed(photograph(0.7, 4)[:, ::-1])
    assert (fast.scene, fast.method) == (SceneState.MOVING, "wiener")
    assert len(noted) == 1


def test_the_options_of_live_pictures_are_settled_before_the_first_frame() -> None:
    with pytest.raises(InputError, match="no iterations"):
        live(solver="wiener")
    assert live()._options.estimate_background is False, "a known background is not estimated"
    assert live(estimate_background=True)._options.estimate_background is True
    psfs = spots_psf()[None, None] * np.ones((2, 1, 1, 1), np.float32)
    places = np.array([[0.0, 0, 1e4], [0, 0, 2e4]], np.float32)
    for at, many in ((places, False), (places[[0, 0]] + [[0, 0, 0], [50, 0, 0]], True)):
        calibration = Calibration(psfs, at)
        assert LiveReconstructor(calibration, noise=NOISE)._one_of_many == many


def test_a_frame_that_no_level_takes_settles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    reconstructor = live()

    def refuses(*_: object) -> Level:
        raise InputError("no way")

    with monkeypatch.context() as patch:
        patch.setattr(LiveReconstructor, "_level_of", refuses)
        with pytest.raises(InputError, match="no way"):
            reconstructor.feed(photograph(0, 0))
    assert reconstructor._shape == ()
    assert reconstructor.feed(photograph(0, 0)).method == "wiener"
