"""Videos through every camera: frame after frame of one problem, by the code that solves a photograph."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift
from scipy.signal import fftconvolve

from recon import InputError, Measurement, solve
from recon.evaluation.scene import make_scene
from recon.reconstruction import selection
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.probe import MARGIN, Within
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose
from recon.solvers import SensorAdmm, memory
from recon.solvers.base import IterationRecord, Solver, StoppingRules
from recon.solvers.moving import move, move_spectra
from recon.solvers.splitting import VolumeSplitting
from recon.streams.joint import solve_together
from recon.streams.motion import Panning
from recon.streams.video import VideoSolver, stream_problem

CASES: dict[str, dict[str, Any]] = {
    "one PSF": {},
    "local": {"model": "local"},
    "low rank": {"model": "lowrank", "prior": "l1"},
    "background": {"estimate_background": True},
    "local, background": {"model": "local", "estimate_background": True},
    "FISTA, Haar": {"solver": "fista", "prior": "tv-haar"},
    "on the ADMM of photographs": {"solver": "admm"},
    "float64": {"precision": "float64"},
}


@pytest.mark.parametrize("erased", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_a_still_video_becomes_what_a_photograph_becomes(name: str, erased: bool) -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    gone = np.random.default_rng(0).random(scene.measurement.shape) < 0.1 if erased else None
    problem = stream_problem(Measurement(scene.measurement, erasures=gone), scene.calibration, **CASES[name])
    video = VideoSolver(problem, cold_iterations=30, warm_iterations=30)
    picture = video.next(scene.measurement)
    as_long = replace(problem.options, iterations=30, tolerance=0.0)
    np.testing.assert_array_equal(picture, solve(replace(problem, options=as_long)).image)
    for _ in range(3):
        picture = video.next(scene.measurement)
    alone = solve(problem).image
    assert picture.shape == alone.shape
    assert picture.dtype == np.float32
    assert np.linalg.norm(picture - alone) < 0.03 * np.linalg.norm(alone)


def test_what_nobody_asked_for_is_not_said_to_be_asked_for() -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    middle = scene.calibration.psfs[len(scene.calibration.psfs) // 2][0]
    assert stream_problem(scene.measurement, middle).reason == "there is one PSF"
    assert stream_problem(scene.measurement, middle, model="convolution").reason == "as asked"
    live = stream_problem(scene.measurement, scene.calibration, choosing=False)
    assert live.reason == "one PSF a depth, as is quickest"


@pytest.mark.parametrize("solver", ["admm", "admm-sensor"])
def test_where_no_depth_was_left_out_nothing_takes_part_again(solver: str) -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    problem = stream_problem(scene.measurement, scene.calibration, solver=solver)
    video = VideoSolver(problem, cold_iterations=5, warm_iterations=2)
    video.next(scene.measurement)
    assert video.confirm()


def test_a_frame_goes_on_from_the_one_before_whatever_the_camera() -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    problem = stream_problem(scene.measurement, scene.calibration, model="local")
    warm, cold = (VideoSolver(problem, cold_iterations=n, warm_iterations=2) for n in (40, 2))
    best = warm.next(scene.measurement)
    apart = [np.linalg.norm(v.next(scene.measurement) - best) for v in (warm, cold)]
    assert apart[0] < 0.5 * apart[1]


@pytest.mark.parametrize("channels", [1, 3])
def test_several_depths_and_colours(channels: int) -> None:
    scene = make_scene("beads", size=24, depths=3, channels=channels, density=0.5)
    problem = stream_problem(scene.measurement, scene.calibration, prior="l1", estimate_background=False)
    video = VideoSolver(problem, cold_iterations=60, warm_iterations=20)
    for _ in range(2):
        volume = video.next(scene.measurement)
    alone = solve(problem).volume
    assert volume.shape == alone.shape == (3, 24, 24, *((3,) if channels > 1 else ()))
    assert np.linalg.norm(volume - alone) < 0.1 * np.linalg.norm(alone)


def test_a_depth_that_was_empty_for_long_takes_part_again_with_the_first_frame_that_has_light_there() -> None:
    calibration = make_scene("beads", size=24, depths=3).calibration
    psfs = calibration.psfs[:, 0]
    noise = np.random.default_rng(0).normal(0, 1, (24, 24))
    near, far = (np.float32(1e4 * psfs[z] / psfs[z].sum() + noise) for z in (0, 2))
    problem = stream_problem(
        near, calibration, prior="l1", estimate_background=False, noise=1.0, model="convolution"
    )
    with VideoSolver(problem, cold_iterations=60, warm_iterations=8) as video:
        assert video.next(near).sum(axis=(1, 2)).argmax() == 0
        assert not video.solvers[0].watch.active[1:].any()
        video.next(far)
        assert video.solvers[0].watch.active[2]
        assert [video.next(far) for _ in range(4)][-1].sum(axis=(1, 2)).argmax() == 2


def test_what_a_stream_has_no_way_for_is_refused_in_words() -> None:
    scene = make_scene("sparse-picture", size=24, grid=3)
    with pytest.raises(InputError, match="no iterations"):
        VideoSolver(stream_problem(scene.measurement, scene.calibration, solver="wiener"))
    local = stream_problem(scene.measurement, scene.calibration, model="local")
    with pytest.raises(InputError, match="one PSF, one depth"):
        solve_together(local, np.stack([scene.measurement] * 2).astype(np.float32), "tv")
    with pytest.raises(InputError, match="those before"):
        VideoSolver(local).next(np.zeros((8, 8), np.float32))


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_a_stream_s_scratch_files_do_not_grow_with_frames_and_go_with_it(
    prior: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "lies_in_memory", lambda _: False)  # where the tests' folder is a tmpfs
    scene = make_scene("beads", size=48, depths=12, density=0.5)
    options = ReconstructionOptions(prior=prior, estimate_background=False)
    part = Part(stream_problem(scene.measurement, scene.calibration, options), slice(0, 1))
    assert part.plan is not None
    room = (1.05 * part.plan.work + 0.2 * part.plan.state) / (1 - memory.KEPT_FREE)
    limited = replace(options, memory_gib=room / memory.GIB, scratch=tmp_path)
    problem = stream_problem(scene.measurement, scene.calibration, limited)
    free = stream_problem(scene.measurement, scene.calibration, options)
    on_disk = []
    with VideoSolver(problem) as video, VideoSolver(free) as in_memory:
        for n in range(5):
            if n == 3:
                video.begin()
                in_memory.begin()
            np.testing.assert_array_equal(video.next(scene.measurement), in_memory.next(scene.measurement))
            on_disk.append(sum(path.stat().st_size for path in tmp_path.rglob("*.dat")))
    assert min(on_disk) > 0
    assert max(on_disk) <= part.plan.state
    assert list(tmp_path.iterdir()) == []


def test_a_video_has_the_background_that_a_photograph_would_have() -> None:
    told = []
    for stray in (0.0, 2.0):
        scene = make_scene(
            "sparse-picture", size=48, grid=3, aberration=4.0, background=stray, photons=3000.0
        )
        asked = {"prior": "l1"}
        chosen = choose(Problem.of(scene.measurement, scene.calibration, ReconstructionOptions(**asked)))
        assert chosen.choice is not None
        problem = stream_problem(scene.measurement, scene.calibration, **asked)
        assert problem.smooth == chosen.choice.background
        assert any("background is estimated" in text for text in problem.warnings) == problem.smooth
        assert not stream_problem(
            scene.measurement, scene.calibration, estimate_background=False, **asked
        ).smooth
        told.append(problem.smooth)
    assert told == [False, True]


def test_a_film_s_object_is_shut_in_where_pixels_held_out_ask_for_it_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(selection, "within_of", lambda _: Within(1.0, 0.97))
    scene = make_scene("sparse-picture", size=48, grid=3, aberration=2.0, photons=8000.0, seed=3)
    shut = stream_problem(scene.measurement, scene.calibration)
    assert shut.extent.margin == MARGIN
    assert "the object lies where PSFs were measured" in shut.reason
    everywhere = stream_problem(scene.measurement, scene.calibration, choose=Overrides(field="all"))
    assert everywhere.extent.margin is None
    assert "the object lies" not in everywhere.reason
    with pytest.raises(InputError, match="only field=all is for films"):
        stream_problem(scene.measurement, scene.calibration, choose=Overrides(binning=2))


@pytest.mark.parametrize("camera", ["one PSF", "erased"])
def test_what_a_solver_knows_moves_with_a_scene_that_moves_as_a_whole(camera: str) -> None:
    rng = np.random.default_rng(0)
    psf = np.zeros((48, 64), np.float32)
    psf[rng.integers(16, 32, 30), rng.integers(20, 44, 30)] = 1
    scene = gaussian_filter(rng.random((96, 160)), 2)
    scene = (scene - scene.min()) ** 3
    light = fftconvolve(scene, psf, "same")
    frames = [
        rng.poisson(1e4 * shift(light, (0, -2 * n))[24:72, 48:112] / light.max()).astype(np.float32)
        for n in range(6)
    ]
    gone = rng.random(frames[0].shape) < 0.05 if camera == "erased" else None
    problem = stream_problem(Measurement(frames[0], erasures=gone), psf, estimate_background=False)
    moves = Panning()
    seen = [moves.next(problem.with_data(frame).data, problem.valid) for frame in frames]
    np.testing.assert_allclose(seen[1:], [(0, -2)] * 5, atol=0.3)
    still = problem.with_data(rng.poisson(np.maximum(frames[5], 0))).data
    assert moves.next(still, problem.valid) == (0, 0)
    apart = []
    for forgets in (False, True):
        video = VideoSolver(problem, cold_iterations=60, warm_iterations=2)
        for frame in frames:
            if forgets:
                video._panning.forget()
            picture = video.next(frame)
        best = VideoSolver(problem, cold_iterations=100).next(frames[-1])
        apart.append(np.linalg.norm(picture - best) / np.linalg.norm(best))
    assert apart[0] < 0.85 * apart[1]


def test_motion_farther_than_details_are_wide_is_told_from_lights_that_go_on_and_off() -> None:
    rng = np.random.default_rng(0)
    places = rng.integers(0, 64, 90), rng.integers(0, 160, 90)

    def seen(by: float, lit: np.ndarray) -> np.ndarray:
        scene = np.zeros((64, 160))
        np.add.at(scene, places, lit)
        light = shift(gaussian_filter(scene, 1), (0, by), order=1)[:, 32:128]
        return (20 * light / light.std() + rng.normal(0, 1, light.shape)).astype(np.float32)[None]

    moves, blinks = Panning(), Panning()
    valid, lit = np.ones((1, 64, 96), bool), np.ones(90)
    told = [moves.next(seen(7.0 * n, lit), valid) for n in range(4)]
    np.testing.assert_allclose(told, [(0, 0)] + [(0, 7)] * 3, atol=0.2)
    line = Panning()
    assert {line.next(seen(7.0 * n, lit)[:, :1], valid[:, :1]) for n in range(3)} == {(0.0, 0.0)}
    assert {blinks.next(seen(0, rng.random(90) > 0.5), valid) for _ in range(12)} == {(0.0, 0.0)}


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_what_is_known_through_varying_psfs_moves_with_the_scene(prior: str) -> None:
    scene = make_scene("beads", size=24, depths=2, grid=3)
    posed = stream_problem(
        scene.measurement, scene.calibration, prior=prior, model="lowrank", estimate_background=False
    )
    video = VideoSolver(posed, cold_iterations=3, warm_iterations=1)
    video.next(scene.measurement)
    (solver,) = video.solvers
    before = solver.solution
    solver.move(0.0, 2.0)
    np.testing.assert_array_equal(solver.solution, np.roll(before, 2, axis=-1))
    assert np.isfinite(video.next(scene.measurement)).all()


@pytest.mark.parametrize("by", [(0.0, 3.0), (-2.5, 0.3)])
def test_images_and_their_spectra_move_alike(by: tuple[float, float]) -> None:
    smooth = gaussian_filter(np.random.default_rng(0).random((2, 24, 30)), (0, 3, 3), mode="wrap")
    moved, spectra = smooth.copy(), np.fft.rfft2(smooth)
    move(moved, *by)
    move_spectra(spectra, *by, 30)
    expected = np.stack([shift(image, by, order=3, mode="grid-wrap") for image in smooth])
    np.testing.assert_allclose(moved, expected, atol=1e-3)
    np.testing.assert_allclose(np.fft.irfft2(spectra, (24, 30)), expected, atol=1e-3)


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_depths_move_with_the_scene_and_take_new_data_at_once(prior: str) -> None:
    scene = make_scene("beads", size=32, depths=3, density=0.5)
    posed = stream_problem(scene.measurement, scene.calibration, prior=prior, estimate_background=False)
    moved = np.roll(scene.measurement, 1, axis=1)
    apart = []
    for by in ((0.0, 1.0), (0.0, 0.0)):
        video = VideoSolver(posed, cold_iterations=60, warm_iterations=1)
        video.next(scene.measurement)
        solver = video.solvers[0]
        kept = solver._total.copy()
        video._panning.next = lambda *_, by=by: by
        picture = video.next(moved)
        assert not np.array_equal(solver._total, kept)
        best = VideoSolver(posed, cold_iterations=120).next(moved)
        apart.append(np.linalg.norm(picture - best) / np.linalg.norm(best))
    assert apart[0] < 0.5 * apart[1]


class OtherMoves(Solver):
    """A solver whose changes are given; it solves nothing."""

    solution = np.zeros(1)

    def __init__(self, *changes: float, confirms: bool = True) -> None:
        self.changes, self.confirms, self.asked = list(changes), confirms, 0

    def step(self) -> IterationRecord:
        raise NotImplementedError

    def advance(self) -> IterationRecord:
        self.asked += 1
        return IterationRecord(self.asked, 0.0, change=self.changes.pop(0))

    def confirm(self) -> bool:
        return self.confirms


class Moves(OtherMoves, SensorAdmm):
    """One of pictures, as :meth:`VideoSolver.advance` tells them apart."""


@cache
def small_problem() -> Problem:
    scene = make_scene("sparse-picture", size=24, grid=3)
    return stream_problem(scene.measurement, scene.calibration, choosing=False)


def video_of(*solvers: OtherMoves, **counts: int) -> VideoSolver:
    video = VideoSolver(small_problem(), times_noise=1.0, **counts)
    video.solvers = list(solvers)
    return video


def test_a_frame_of_pictures_is_at_rest_when_its_largest_change_is_below_what_settles_it() -> None:
    video = video_of(Moves(0.5, 0.1, 0.0, 0.09), Moves(0.01, 0.01, 0.1, 0.0))
    assert [video.advance(0.1) for _ in range(4)] == [False, False, False, True]
    assert video.iterations == 4
    assert video_of(Moves(0.0)).advance(0.1)


def test_other_solvers_are_at_rest_when_they_are_calm_for_long_and_still_move() -> None:
    calm, still = 0.01, 0.0
    patience = StoppingRules().patience
    for solvers in ([OtherMoves], [OtherMoves, Moves]):
        changes = [*[calm] * (patience - 1), 0.2, *[calm] * (patience - 1), still, *[calm] * (patience + 1)]
        video = video_of(*(kind(*changes) for kind in solvers))
        told = [video.advance(0.1) for _ in changes]
        assert told == [False] * (len(changes) - 2) + [True, True]


def test_a_frame_has_its_iterations_and_as_many_again_where_a_depth_takes_part_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(VideoSolver, "take", lambda *_: None)
    monkeypatch.setattr(VideoSolver, "picture", lambda _: "a picture")
    for cold, confirms, changes, asked in (
        (True, True, [1.0] * 50, 5),
        (False, True, [1.0] * 50, 3),
        (True, False, [1.0] * 50, 10),
        (False, True, [1.0, 1e-5, 1.0], 2),
        (False, False, [1.0, 1e-5, 1.0, 1e-5], 4),
    ):
        solver = Moves(*changes, confirms=confirms)
        video = video_of(solver, cold_iterations=5, warm_iterations=3)
        video._cold = cold
        assert video.next(np.zeros((24, 24), np.float32)) == "a picture"
        assert solver.asked == asked
    calm = OtherMoves(*[0.01] * 9, confirms=False)
    video = video_of(calm)
    assert [video.advance(0.1) for _ in range(3)][-1]
    assert not video.confirm()
    assert [video.advance(0.1) for _ in range(3)] == [False, False, True], "calm is counted anew"
    calm.confirms = True
    assert video.confirm()
    assert video.advance(0.1)


def test_iterations_are_counted_from_the_last_frame_that_began_cold() -> None:
    with pytest.raises(InputError, match="got 1 cold and 0 warm"):
        VideoSolver(small_problem(), cold_iterations=1, warm_iterations=0)
    video = video_of(cold_iterations=1, warm_iterations=1)
    video.solvers = [None]
    assert video.iterations == 0
    counts = []
    for begins in (False, False, False, True, False):
        if begins:
            video.begin()
        video.take(np.asarray(small_problem().measurement.image))
        video.advance(0.0)
        counts.append(video.iterations)
    assert counts == [1, 2, 3, 1, 2]


@pytest.mark.parametrize("depths", [1, 2])
def test_of_one_depth_there_is_a_picture_of_several_a_volume(
    depths: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VideoSolver, "volume", lambda _: np.zeros((depths, 4, 5), np.float32))
    video = video_of()
    video.problem = SimpleNamespace(n_planes=depths)  # type: ignore[assignment]
    assert video.picture().shape == ((4, 5) if depths == 1 else (2, 4, 5))


@pytest.mark.parametrize("asked", [None, True])
@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("margin", [None, 0.5])
def test_what_is_chosen_for_a_film_is_taken_and_said(
    asked: bool | None, background: bool, margin: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Problem] = []
    whys = [SimpleNamespace(name=name, why=f"why {name}") for name in ("model", "background", "field")]

    def chosen(posed: Problem, *, film: bool) -> SimpleNamespace:
        assert film
        seen.append(posed)
        return SimpleNamespace(
            model="local", psf_window=None, acceptance_px=None, margin=margin, background=background,
            decisions=whys,
        )  # fmt: skip

    monkeypatch.setattr("recon.streams.video.choice_for", chosen)
    monkeypatch.setattr("recon.streams.video._by_one_psf", lambda *_: ("doubt", "reason"))
    scene = make_scene("sparse-picture", size=24, grid=3)
    frame = scene.measurement
    problem = stream_problem(
        frame, scene.calibration, others=[frame + 4, frame + 2], estimate_background=asked, noise=1.5
    )
    (posed,) = seen
    np.testing.assert_allclose(posed.measurement.image, frame + 2, rtol=1e-5)
    assert posed.measurement.noise == 1.5
    assert posed.options.choose == Overrides(
        planes="all", between=False, beyond=False, binning=1, channels="all"
    )
    assert problem.options.model == "local"
    assert problem.extent.margin == margin
    where = "" if margin is None else "; the object lies where PSFs were measured: why field"
    assert problem.reason == f"by the mean of 3 frames: why model{where}"
    said = "A smooth background is estimated as well: why background."
    assert (said in problem.warnings) == (background and asked is None)
    assert "" not in problem.warnings
    stream_problem(frame, scene.calibration, others=[frame + 4, frame + 2])
    alone = Measurement(frame)
    assert seen[-1].measurement.noise == pytest.approx(float(alone.deviations(alone.counts())[0]))


def test_a_camera_that_is_named_has_the_background_that_it_needs_and_two_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("recon.streams.video.require_two_images", lambda _: asked.append("images"))
    monkeypatch.setattr(
        "recon.streams.video.with_background",
        lambda problem, _, restoring: asked.append("background") or problem,
    )
    scene = make_scene("sparse-picture", size=24, grid=3)
    quick = stream_problem(scene.measurement, scene.calibration, choosing=False)
    assert asked == []
    assert sum("One PSF serves the whole field" in text for text in quick.warnings) == 1
    named = stream_problem(scene.measurement, scene.calibration, model="convolution")
    assert asked == ["images", "background"]
    assert "" not in named.warnings


class Asked(OtherMoves):
    """Notes what it is asked to do."""

    state_names = ()

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Any] = []

    def move(self, *by: float) -> None:
        self.told.append(by)

    def set_data(self, data: Any) -> None:
        self.told.append(data)

    def restart(self, data: Any) -> None:
        self.told.append(f"anew: {data}")


class AskedOfPicture(Asked, SensorAdmm):
    """One of pictures."""


class AskedOfVolume(Asked, VolumeSplitting):
    """One of volumes, whose data term is solved exactly."""


@pytest.mark.parametrize("by", [(0.0, 0.0), (0.0, 2.0), (1.0, 2.0)])
@pytest.mark.parametrize("cold", [True, False])
def test_a_frame_begins_cold_and_forgets_motion_or_moves_what_there_is_and_takes_its_data(
    cold: bool, by: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    solvers: Any = [AskedOfPicture(), AskedOfVolume(), Asked()]
    video, forgot, given = video_of(*solvers), list[bool](), list[Problem]()
    assert video._cold
    video.parts = [SimpleNamespace(set_data=given.append, data="d", sensor_data="s")] * 3  # type: ignore[list-item]
    video._panning = SimpleNamespace(forget=lambda: forgot.append(True), next=lambda *_: by)  # type: ignore[assignment]
    monkeypatch.setattr(VideoSolver, "_renewed", lambda _self, _part, before: ("renewed", before))
    video._cold, video.iterations, video._calm = cold, 7, 3
    video.take(np.asarray(small_problem().measurement.image))
    assert forgot == [True] * cold
    assert given == [video.problem] * 3
    moved = [by] if any(by) else []
    picture, volume, other = solvers
    assert picture.told == [*moved, "anew: d" if cold else "d"]
    assert volume.told == ([*moved] if cold else [*moved, "s"])
    assert other.told == moved
    renewed = [("renewed", volume)] if cold else [volume]
    assert video.solvers == [picture, *renewed, ("renewed", other)]
    assert (video.iterations, video._cold, video._calm) == (0 if cold else 7, False, 0)


def test_what_a_solver_kept_on_disk_goes_once_the_next_one_is_made() -> None:
    order: list[str] = []
    video = video_of()
    part: Any = SimpleNamespace(storage=SimpleNamespace(turn=lambda: lambda: order.append("removed")))
    video._made = lambda _part, _start: order.append("made") or "solver"  # type: ignore[method-assign, assignment]
    assert video._renewed(part, None) == "solver"
    assert order == ["made", "removed"]


def test_a_solver_that_cannot_be_halted_is_refused_and_the_prior_weighs_as_told() -> None:
    one, two = (VideoSolver(small_problem(), times_noise=times) for times in (1.0, 2.0))
    assert two.weights == pytest.approx([2 * weight for weight in one.weights])
    assert min(one.weights) > 0
    one._offered = SimpleNamespace(name="whole", make=lambda *_: object())  # type: ignore[assignment]
    with pytest.raises(InputError, match="whole cannot be halted after each iteration"):
        one._made(one.parts[0], None)


def test_a_film_of_its_own_psf_is_refused_before_anything_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def refuse(_: Problem) -> None:
        asked.append("images")
        raise InputError("one image twice")

    monkeypatch.setattr("recon.streams.video.require_two_images", refuse)
    monkeypatch.setattr("recon.streams.video.choice_for", lambda *_, **__: asked.append("choice"))
    monkeypatch.setattr("recon.streams.video._by_one_psf", lambda *_: ("doubt", "reason"))
    scene = make_scene("sparse-picture", size=24, grid=3)
    with pytest.raises(InputError, match="one image twice"):
        stream_problem(scene.measurement, scene.calibration)
    assert asked == ["images"]


def test_closing_gives_up_the_solvers_and_what_each_part_keeps() -> None:
    video, closed = video_of(Moves()), list[int]()
    video.parts = [SimpleNamespace(close=lambda n=n: closed.append(n)) for n in range(2)]  # type: ignore[misc]
    with video:
        pass
    assert (closed, video.solvers) == ([0, 1], [None, None])


@pytest.mark.parametrize(
    ("cold", "before", "expected"),
    [
        (True, "stateful", ["made from None"]),
        (True, "none", ["made from None"]),
        (False, "none", ["made from None"]),
        (False, "stateful", ["made from None", "all that it knew"]),
        (False, "other", ["made from 5.0"]),
    ],
)
def test_a_solver_made_anew_knows_what_the_one_before_knew_unless_the_frame_begins_cold(
    cold: bool, before: str, expected: list[str]
) -> None:
    told: list[str] = []
    solver, video = Asked(), video_of()
    solver.state_names = ("_y",) if before == "stateful" else ()  # type: ignore[misc]
    solver.checkpoint = lambda *, copy: "all that it knew"  # type: ignore[method-assign, assignment]
    new = SimpleNamespace(restore=told.append)
    storage = SimpleNamespace(turn=lambda: lambda: None)
    part: Any = SimpleNamespace(storage=storage, lifted=lambda _: 5.0)
    video._made = lambda _, start: told.append(f"made from {start}") or new  # type: ignore[method-assign, assignment]
    video._cold = cold
    assert video._renewed(part, None if before == "none" else solver) is new
    assert told == expected
