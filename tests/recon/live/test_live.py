"""Live pictures: as good as converged while the scene is still, coarser rather than later."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import Calibration, InputError, reconstruct
from recon.base.metrics import psnr
from recon.streams.detail import Detail
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import DARK, NOISE_ONLY, UNLIT, Level, LivePicture
from recon.streams.pace import Pace, Spent
from recon.streams.stillness import SceneState, SceneWatch
from recon.streams.video import VideoSolver
from tests.recon.live.streams import AMPLE_MS, NOISE, SHAPE, iterated, live, photograph, spots_psf, taking


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
        (np.full(SHAPE, np.nan, np.float32), "not finite .* nothing else in it"),
        (np.where(np.eye(*SHAPE) > 0, np.nan, 1), "not finite .* Put the mean of their neighbours there"),
        (np.full(SHAPE, 1e39), "frame must hold real numbers up to"),
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
