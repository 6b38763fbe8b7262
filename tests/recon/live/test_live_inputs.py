"""Frames, settings and depths that live pictures take, and refuse; starting again."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import Calibration, InputError
from recon.base.metrics import psnr
from recon.evaluation.scene import make_scene
from recon.streams import live as live_module
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import DARK, UNLIT, UNLIT_SO_FAR, Level
from recon.streams.pace import Spent
from recon.streams.stillness import SceneState, SceneWatch
from tests.recon.live.streams import AMPLE_MS, NOISE, SHAPE, iterated, live, photograph, spots_psf


def test_colour_and_frames_finer_than_the_psf() -> None:
    psf = np.stack([spots_psf()] * 3, axis=2)
    frame = np.stack([photograph(0, seed) for seed in range(3)], axis=2)
    picture = LiveReconstructor(psf, background=20.0, budget_ms=25.0, coarsest=1).feed(frame)
    assert picture.image.shape == (*SHAPE, 3)
    assert picture.image.flags.c_contiguous
    fine = np.kron(photograph(0, 0), np.ones((2, 2), np.uint16))
    coarse = live().feed(photograph(0, 0))
    assert psnr(live().feed(fine).image, coarse.image) > 60


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


def test_a_restart_forgets_that_a_picture_was_settled_or_followed_another() -> None:
    reconstructor = live(budget_ms=AMPLE_MS)
    reconstructor.feed(photograph(0, 0))
    reconstructor._follows = reconstructor._greeted = reconstructor._settled = True
    reconstructor.restart()
    assert [reconstructor._follows, reconstructor._greeted, reconstructor._settled] == [False] * 3


def test_all_depths_of_the_calibration_compete_for_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, int]] = []

    def fitting(problem: Any, now: int) -> int:
        asked.append((problem, now))
        return 2

    monkeypatch.setattr(live_module, "fitting_depth", fitting)
    psfs = np.stack([np.roll(spots_psf(), k, axis=0) for k in (0, 2, 4)])[:, None]
    places = np.array([[0, 0, z] for z in (1e4, 2e4, 4e4)])
    reconstructor = LiveReconstructor(Calibration(psfs, places), noise=NOISE, z_um=19_000.0)
    assert reconstructor.fitting_depth_um(photograph(0, 0)) == 4e4
    ((problem, now),) = asked
    assert now == 1, "the one in use"
    assert problem.n_planes == 3, "an empty one, too"
    assert (problem.options.drop_empty, problem.options.model) == (False, "convolution")


def test_a_depth_that_there_is_not_is_refused() -> None:
    live(plane=0)
    with pytest.raises(InputError, match="plane 1 is none of the 1 depths, counted from 0"):
        live(plane=1)


def test_a_known_background_is_taken_off() -> None:
    frame = photograph(0, 0).astype(np.float32)
    less = live(background=None).feed(frame - 20)
    np.testing.assert_allclose(live().feed(frame).image, less.image, atol=1e-5 * float(less.image.max()))


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


SMALL = (24, 32)


@pytest.mark.parametrize("colours", [None, 3])
def test_a_frame_lies_on_the_calibrations_pixels_channels_first_and_0_where_it_is_erased(
    colours: int | None,
) -> None:
    rng = np.random.default_rng(0)
    shape = SMALL if colours is None else (*SMALL, colours)
    gone, frame = rng.random(shape) < 0.2, rng.random(shape).astype(np.float32) + 1
    psf = spots_psf(SMALL, 5) if colours is None else np.stack([spots_psf(SMALL, 5)] * colours, axis=2)
    reconstructor = LiveReconstructor(psf, erasures=gone, noise=NOISE, coarsest=1, background=0.25)
    measured = reconstructor._measured(frame)
    expected = np.where(gone, 0, frame - 0.25)
    np.testing.assert_allclose(measured, np.atleast_3d(expected).transpose(2, 0, 1), rtol=1e-6)
    np.testing.assert_allclose(reconstructor._as_given(measured), expected, rtol=1e-6)
    finer = np.kron(frame, np.ones((2, 2) if colours is None else (2, 2, 1), np.float32))
    np.testing.assert_allclose(
        reconstructor._on_calibration_pixels(finer), np.moveaxis(np.atleast_3d(frame), 2, 0)
    )
    with pytest.raises(InputError, match=r"call restart\(\)"):
        reconstructor._measured(finer)


@pytest.mark.parametrize("plane", [None, 1])
@pytest.mark.parametrize("done", [None, 0, 5])
def test_a_picture_of_depths_says_which_it_shows_and_brings_all_of_them(
    done: int | None, plane: int | None
) -> None:
    psfs = np.stack([spots_psf(SMALL, n) for n in (5, 8)])[:, None]
    calibration = Calibration(psfs, np.array([[0.0, 0.0, 1e4], [0.0, 0.0, 2e4]]))
    reconstructor = LiveReconstructor(calibration, noise=NOISE, coarsest=1, plane=plane)
    detail = SimpleNamespace(planes=(0, 1), depths=lambda _: "these two")
    level: Any = SimpleNamespace(
        detail=detail,
        binning=1,
        method="admm",
        solver=SimpleNamespace(iterations=9),
        camera=lambda **_: "one",
    )
    volume = np.random.default_rng(0).random((2, *SMALL)).astype(np.float32)
    picture = reconstructor._picture(level, volume, done, Spent(0.0, 0.0))
    assert picture.volume is volume
    np.testing.assert_array_equal(picture.image, volume.max(axis=0) if plane is None else volume[1])
    of = "these two" if done else "2 depths"
    shows = 1 if plane is None and not done else plane  # the filter's is the middle one
    assert picture.shown == (f"brightest of {of}" if shows is None else f"depth {shows} of {of}")
    assert picture.planes == ((0, 1) if done else (shows,))
    assert (picture.iterations, picture.total_iterations) == ((5, 9) if done else (0, 0))
    assert picture.method == {None: "", 0: "wiener", 5: "admm"}[done]
    one = reconstructor._picture(level, volume[:1], done, Spent(0.0, 0.0))
    assert one.volume is None
    np.testing.assert_array_equal(reconstructor.shown(volume), picture.image)
    if plane == 1:
        np.testing.assert_array_equal(reconstructor.shown(volume, (1, 2)), volume[0])


def test_a_level_that_is_being_made_is_waited_for_until_a_newer_frame_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: Any = SimpleNamespace(solver="a solver")
    for answers, newer, found, asked in (
        ([False, False, True], [False, False], made, 2),
        ([True], [], made, 0),
        ([False, False], [False, True], None, 2),
    ):
        reconstructor, left, told = live(), list(answers), list(newer)
        reconstructor._level = SimpleNamespace(solver=None)  # type: ignore[assignment]
        reconstructor._coming = SimpleNamespace(wait=lambda _, left=left: left.pop(0))  # type: ignore[assignment]
        monkeypatch.setattr(
            reconstructor, "_take_up", lambda _, of=reconstructor: setattr(of, "_level", made)
        )
        assert reconstructor._solving_level(lambda told=told: told.pop(0)) is found
        assert (left, told, len(newer)) == ([], [], asked)
    reconstructor._level, reconstructor._coming = SimpleNamespace(solver=None), None  # type: ignore[assignment]
    assert reconstructor._solving_level(lambda: False) is None


def test_a_frame_that_is_fed_has_all_its_iterations_whatever_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    reconstructor, newer = live(budget_ms=AMPLE_MS), list[bool]()
    iterated(reconstructor, photograph(0, 0))

    def iterate(_level: object, _began: object, _most: object, asked: Any) -> tuple[int, Spent]:
        newer.append(asked())
        return 1, Spent(0.0, 0.0)

    noted: list[float] = []
    monkeypatch.setattr(reconstructor, "_iterate", iterate)
    monkeypatch.setattr(reconstructor._pace, "note", lambda fixed, *_: noted.append(fixed.wall_ms))
    began_s = time.perf_counter()
    reconstructor.feed(photograph(0, 1))
    assert newer == [False]
    assert 0 < noted[0] < 1e3 * (time.perf_counter() - began_s)


def test_colours_keep_their_place_in_backgrounds_and_in_whole_reconstructions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    psfs, behind = np.stack([spots_psf(SMALL, 5)] * 3)[None], rng.random((3, *SMALL)).astype(np.float32)
    calibration = Calibration(psfs, np.array([[0.0, 0.0, 1e4]]), background=behind)
    reconstructor = LiveReconstructor(calibration, noise=NOISE, coarsest=1)
    np.testing.assert_array_equal(reconstructor._known["background"], behind.transpose(1, 2, 0))
    monkeypatch.setattr("recon.streams.live.reconstruct", lambda measurement, *_, **__: measurement)
    frame = rng.random((*SMALL, 3)).astype(np.float32)
    np.testing.assert_allclose(reconstructor.full(frame).image, frame)


def test_no_camera_model_is_chosen_for_a_level_of_fewer_depths(monkeypatch: pytest.MonkeyPatch) -> None:
    psfs = np.stack([spots_psf(SMALL, n) for n in (5, 8)])[:, None]
    reconstructor = LiveReconstructor(
        Calibration(psfs, np.array([[0.0, 0.0, 1e4], [0.0, 0.0, 2e4]])), noise=NOISE, coarsest=1
    )
    made, told = live_module.stream_problem, list[tuple[int, bool]]()

    def problem(frame: Any, calibration: Calibration, options: Any, *, choosing: bool = True) -> Any:
        told.append((len(calibration.psfs), choosing))
        return made(frame, calibration, options, choosing=choosing)

    monkeypatch.setattr(live_module, "stream_problem", problem)
    reconstructor._measured(np.random.default_rng(0).random(SMALL))
    detail = replace(next(iter(reconstructor._details.values())), planes=(1,))
    level = reconstructor._level_of(detail, np.random.default_rng(0).random((1, *SMALL)).astype(np.float32))
    assert told == [(2, False), (1, False)]
    assert level.whole.n_planes == 2


def test_without_memory_for_a_level_a_coarser_one_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    reconstructor, made = live(), list[str]()
    reconstructor._level = SimpleNamespace(solver=None, detail=SimpleNamespace(coarseness=2))  # type: ignore[assignment]
    reconstructor._pace = SimpleNamespace(levels=(1, 2, 4, 8))  # type: ignore[assignment]
    reconstructor._details = {1: "1", 2: "2", 4: "4", 8: "8"}  # type: ignore[dict-item]
    monkeypatch.setattr(reconstructor, "_make", lambda detail, _: made.append(detail))
    reconstructor._level_for(np.zeros((1, *SHAPE), np.float32))
    assert made == ["4"]
    reconstructor._pace = SimpleNamespace(levels=(1, 2))  # type: ignore[assignment]
    reconstructor._level_for(np.zeros((1, *SHAPE), np.float32))
    assert made == ["4"], "there is none"


@pytest.mark.parametrize(("binning", "coarseness"), [(2, 2), (2, 3), (4, 4)])
def test_another_level_is_told_to_the_pace_and_other_pixels_know_nothing_of_the_scene(
    binning: int, coarseness: int
) -> None:
    reconstructor, told = live(), list[object]()
    before: Any = SimpleNamespace(
        binning=2,
        detail=SimpleNamespace(coarseness=2),
        solver=SimpleNamespace(close=lambda: told.append("closed")),
    )
    after: Any = SimpleNamespace(binning=binning, detail=SimpleNamespace(coarseness=coarseness))
    reconstructor._level, reconstructor._greeted = before, False
    reconstructor._watch = SimpleNamespace(forget=lambda: told.append("forgotten"))  # type: ignore[assignment]
    reconstructor._pace = SimpleNamespace(enter=told.append)  # type: ignore[assignment]
    reconstructor._enter(after)
    other, anew = coarseness != 2, binning != 2
    assert told == [*["forgotten"] * anew, *[coarseness] * other, "closed"]
    assert (reconstructor._level, reconstructor._greeted) == (after, anew)


def test_the_first_level_is_told_to_the_pace_and_the_next_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reconstructor, told, frame = live(), list[object](), np.zeros((1, *SHAPE), np.float32)
    first: Any = SimpleNamespace(detail=SimpleNamespace(coarseness=3), solving="solving")
    monkeypatch.setattr(reconstructor, "_level_of", lambda *_: first)
    monkeypatch.setattr(
        live_module, "ComingLevel", lambda *what: SimpleNamespace(what=what, wait=told.append)
    )
    reconstructor._pace = SimpleNamespace(enter=told.append, levels=(1,))  # type: ignore[assignment]
    assert reconstructor._level_for(frame) is first
    assert reconstructor._coming.what == (first.detail, "solving")  # type: ignore[union-attr]
    assert reconstructor._level_for(frame) is first
    assert told == [3, 0]


@pytest.mark.parametrize("follows", [True, False])
def test_a_solver_that_does_not_know_the_frame_begins_with_it_when_it_is_refined(
    follows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstructor, told = live(), list[str]()
    solver = SimpleNamespace(begin=lambda: told.append("begins"), take=lambda _: told.append("takes"))
    reconstructor._level = SimpleNamespace(solver=solver, solved=lambda: "volume")  # type: ignore[assignment]
    reconstructor._watch = SimpleNamespace(mean=np.zeros((1, *SHAPE)))  # type: ignore[assignment]
    reconstructor._follows = follows
    monkeypatch.setattr(reconstructor, "_iterate", lambda *_: (4, Spent(0.0, 0.0)))
    monkeypatch.setattr(reconstructor, "_picture", lambda _level, volume, done, _began: (volume, done))
    assert reconstructor.refine() == ("volume", 4)
    assert told == ([] if follows else ["begins", "takes"])


@pytest.mark.parametrize(
    ("dark", "doubt", "words"),
    [(True, "", DARK), (True, "why", DARK), (False, "why", UNLIT), (False, "", UNLIT_SO_FAR)],
)
def test_a_black_picture_says_why(dark: bool, doubt: str, words: str) -> None:
    reconstructor = live()
    reconstructor._dark = dark
    reconstructor._fit = SimpleNamespace(doubt=doubt)  # type: ignore[assignment]
    assert reconstructor._unlit() == words


@pytest.mark.parametrize(("model", "psfs"), [("local", 4), ("convolution", 1)])
def test_a_first_pictures_work_is_told_by_the_psfs_that_are_used(model: str, psfs: int) -> None:
    scene = make_scene("sparse-picture", size=24, grid=2)
    reconstructor = LiveReconstructor(
        scene.calibration, noise=NOISE, coarsest=1, model=model, estimate_background=False
    )
    assert len(scene.calibration.psfs) == 4
    assert reconstructor._first_work == psfs * 24 * 24


def test_options_that_are_not_for_live_pictures_are_named() -> None:
    with pytest.raises(InputError, match="iterations: not for live pictures, which take what fits"):
        live(iterations=5)
