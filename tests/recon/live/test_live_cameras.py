"""Live pictures and videos through every camera, prior and solver: they become what one picture becomes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon import Calibration, InputError, reconstruct
from recon.camera.camera_model import CAMERAS
from recon.evaluation.scene import make_scene
from recon.priors import PRIORS
from recon.reconstruction.solvers import SOLVERS
from recon.streams.detail import ladder
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LivePicture
from recon.streams.pace import Spent
from recon.streams.video import VideoSolver, stream_problem

OWN = Path(__file__).parents[3] / "examples" / "own_methods"
SIZE = 24
PACE: dict[str, Any] = {"budget_ms": 1e6, "coarsest": 1}
"""A budget that no machine exhausts."""
CASES: dict[str, tuple[dict[str, Any], float]] = {
    "one PSF": ({"model": "convolution"}, 0.04),
    "one PSF, erasures": ({"model": "convolution", "erased": True}, 0.04),
    "l1, erasures": ({"prior": "l1", "model": "convolution", "erased": True}, 0.04),
    "local": ({"model": "local"}, 0.06),
    "low rank, l1, erasures": ({"model": "lowrank", "prior": "l1", "erased": True}, 0.04),
    "smooth background, erasures": ({"estimate_background": True, "erased": True}, 0.06),
    "known background": ({"model": "convolution", "background": 3.0}, 0.04),
    "FISTA": ({"model": "convolution", "solver": "fista", "prior": "l1"}, 0.2),
    "own prior, erasures": ({"model": "convolution", "prior": "colour-groups", "erased": True}, 0.08),
    "own solver": ({"model": "convolution", "solver": "landweber", "prior": "l1"}, 0.4),
    "own camera": ({"model": "vignetting"}, 0.03),
    "float64": ({"model": "convolution", "precision": "float64"}, 0.04),
}
"""Options, and how far from the single picture a stream may end: about twice what was measured.
Landweber's iteration is slow: it is at rest, by its small steps, long before it is at the end."""
SAID = {
    "one PSF, erasures": ", one PSF for all of the field, 9.0% of the pixels left out, ",
    "local": ", local model, ",
    "low rank, l1, erasures": ", low rank, 9.0% of the pixels left out, ",
    "smooth background, erasures": ", background, 9.0% of the pixels left out, ",
    "own camera": ", vignetting, ",
}
"""What pictures say of the camera that made them."""


@pytest.fixture(autouse=True)
def _own_methods(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(OWN))
    import own_camera
    import own_prior
    import own_solver

    own = ((CAMERAS, own_camera.CAMERA), (PRIORS, own_prior.PRIOR), (SOLVERS, own_solver.SOLVER))
    for registry, registered in own:
        registry.register(registered)
    yield
    for registry, registered in own:
        del registry._foreign[registered.name]
    for name in ("own_camera", "own_prior", "own_solver"):
        sys.modules.pop(name)


def settled(reconstructor: LiveReconstructor, frames: list[np.ndarray]) -> LivePicture:
    """Feed frames of a still scene, and refine until nothing is gained."""
    for frame in frames:
        picture = reconstructor.feed(frame)
    for _ in range(40):
        picture = reconstructor.refine() or picture
    return picture


def apart(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


@pytest.mark.parametrize("name", CASES)
def test_a_still_scene_becomes_what_its_mean_frame_becomes(name: str) -> None:
    asked, within = CASES[name]
    options: dict[str, Any] = {"model": "convolution", "noise": 3.0, **asked}
    scene = make_scene("sparse-picture", size=SIZE, grid=3, photons=2000.0)
    frames = [scene.measurement + np.random.default_rng(n).normal(0, 1.0, (SIZE, SIZE)) for n in range(3)]
    if options.pop("erased", False):
        gone = options["erasures"] = np.random.default_rng(0).random((SIZE, SIZE)) < 0.1
        for frame in frames:
            frame[gone] = 4095.0
    mean = np.mean(frames, axis=0).astype(np.float32)
    alone = reconstruct(mean, scene.calibration, **options, iterations=400, tolerance=0).image
    picture = settled(LiveReconstructor(scene.calibration, **PACE, **options), frames)
    assert picture.frames == len(frames)
    assert SAID.get(name, ", one PSF for all of the field, ") in picture.quality
    assert picture.method == stream_problem(frames[0], scene.calibration, **options).solver.name
    assert apart(picture.image, alone) < within
    problem = stream_problem(frames[0], scene.calibration, **options)
    with VideoSolver(problem, cold_iterations=80, warm_iterations=80) as video:
        for _ in range(3):
            film = video.next(mean)
    assert apart(film, alone) < within


@pytest.mark.parametrize("channels", [1, 3])
def test_of_several_depths_the_brightest_is_shown_or_one_that_is_chosen(channels: int) -> None:
    scene = make_scene("beads", size=SIZE, depths=2, channels=channels, density=0.5)
    options: dict[str, Any] = {"prior": "l1", "estimate_background": False, "noise": 2.0}
    alone = reconstruct(
        scene.measurement, scene.calibration, **options, model="convolution", iterations=300, tolerance=0
    ).volume
    live = LiveReconstructor(scene.calibration, **PACE, **options)
    first = live.feed(scene.measurement)
    assert (first.method, first.volume, first.shown) == ("wiener", None, "depth 1 of 2 depths")
    assert first.image.shape == scene.measurement.shape
    picture = settled(live, [scene.measurement])
    assert picture.volume is not None
    assert apart(picture.volume, alone) < 0.05
    np.testing.assert_array_equal(picture.image, picture.volume.max(axis=0))
    assert "brightest of 2 depths" in picture.quality
    np.testing.assert_array_equal(live.shown(alone), alone.max(axis=0))
    for plane in (0, 1):
        view = LiveReconstructor(scene.calibration, plane=plane, **PACE, **options)
        chosen = settled(view, [scene.measurement])
        assert chosen.volume is not None
        np.testing.assert_array_equal(chosen.image, chosen.volume[plane])
        assert f"depth {plane} of 2 depths" in chosen.quality


def caustics(likeness: float, depths: int = 16) -> np.ndarray:
    """PSFs (depths, 1, SIZE, SIZE), each alike to the one before to ``likeness``."""
    rng = np.random.default_rng(0)
    patterns = [gaussian_filter(rng.normal(size=(SIZE, SIZE)), 1.5)]
    for _ in range(depths - 1):
        other = gaussian_filter(rng.normal(size=(SIZE, SIZE)), 1.5)
        patterns.append(likeness * patterns[-1] + (1 - likeness**2) ** 0.5 * other)
    return (np.stack(patterns)[:, None] - np.min(patterns)).astype(np.float32)


@pytest.mark.parametrize(("likeness", "first"), [(0.999, "planes"), (0.2, "pixels")])
def test_planes_hardly_told_apart_go_before_pixels_and_others_after(likeness: float, first: str) -> None:
    whole, then, *_, last = ladder(caustics(likeness), (1, 2), 5).values()
    assert (whole.binning, whole.planes) == (1, tuple(range(16)))
    assert ("pixels" if then.binning > 1 else "planes") == first
    assert last.binning == 2
    assert 5 in then.planes
    assert 5 in last.planes
    assert len(ladder(caustics(likeness, 2), (1, 2), None)) == 2  # of two depths both are kept


def test_depths_give_way_to_the_budget_are_said_and_come_back() -> None:
    psfs, z_um = caustics(0.97), 1e3 * np.linspace(10, 13, 16)
    calibration = Calibration(psfs / psfs.sum(axis=(2, 3), keepdims=True), np.c_[np.zeros((16, 2)), z_um])
    frames = [1e3 * psfs[5, 0] + np.random.default_rng(n).normal(0, 1, (SIZE, SIZE)) for n in range(8)]
    live = LiveReconstructor(
        calibration, prior="l1", estimate_background=False, noise=1.0, plane=5, coarsest=1, budget_ms=10.0
    )
    live.feed(frames[0])

    def taking(step_ms: float, pictures: int) -> LivePicture:
        """Feed frames, each of which is believed to take 1 ms and so much an iteration."""
        for n in range(pictures):
            for _ in range(7):
                live._pace.note(Spent(1.0, 1.0), Spent(step_ms, step_ms), 1)
            picture = live.feed(frames[n % 8])
            if live._coming is not None:
                live._coming.wait()
        return picture

    assert "depth 5 of 16 depths," in taking(2.0, 3).quality
    fewer = taking(6.0, 4)
    assert fewer.planes == (0, 2, 5, 6, 9, 11, 13, 15)
    assert fewer.volume is not None
    np.testing.assert_array_equal(fewer.image, fewer.volume[2])
    assert "depth 5 of 8 of 16 depths (10, 10.4, ..., 13 mm)" in fewer.quality
    live.budget_ms = 20.0
    assert taking(4.0, 25).planes == tuple(range(16))


def test_a_frame_that_is_refused_settles_nothing() -> None:
    rng = np.random.default_rng(0)
    live = LiveReconstructor(rng.random((SIZE, SIZE, 3)).astype(np.float32) ** 8, **PACE)
    with pytest.raises(InputError, match="channel"):
        live.feed(rng.random((SIZE, SIZE)).astype(np.float32))
    assert live.feed(rng.random((SIZE, SIZE, 3)).astype(np.float32)).image.shape == (SIZE, SIZE, 3)


def test_pictures_go_on_where_a_solver_finds_no_room() -> None:
    scene = make_scene("beads", size=SIZE, depths=2, photons=2000.0)
    live = LiveReconstructor(scene.calibration, memory_gib=1e-6, **PACE)
    assert live.feed(scene.measurement).method == "wiener"
    for _ in range(20):
        live.refine()
        live.feed(scene.measurement)
    assert any("no memory" in words for words in live.warnings)


def test_a_picture_to_the_end_has_the_same_options() -> None:
    scene = make_scene("sparse-picture", size=SIZE, grid=3, photons=2000.0)
    live = LiveReconstructor(scene.calibration, model="local", prior="l1", background=2.0)
    live.feed(scene.measurement)
    result = live.full(scene.measurement)
    assert (result.model, result.prior) == ("local", "l1")
    alone = reconstruct(scene.measurement, scene.calibration, model="local", prior="l1", background=2.0)
    np.testing.assert_allclose(result.image, alone.image, rtol=1e-4, atol=1e-4 * alone.image.max())


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"solver": "wiener"}, "no iterations"),
        ({"iterations": 5}, "budget_ms"),
        ({"positive_background": True}, "not for live pictures"),
        ({"solver": "admm-sensor", "model": "local"}, "one convolution"),
        ({"prior": "tv", "solver": "fista", "z_um": None, "tau": -1.0}, "tau"),
        ({"plane": 1}, "plane 1"),
        ({"background": np.zeros((5, 5))}, "background has 5 x 5"),
        ({"erasures": np.ones((SIZE, SIZE), bool)}, "no pixel"),
        ({"patterns": np.ones((2, SIZE, SIZE))}, "one light"),
        ({"priorr": "l1"}, "prior"),
    ],
)
def test_what_has_no_way_is_refused_before_the_stream(asked: dict[str, Any], says: str) -> None:
    scene = make_scene("sparse-picture", size=SIZE, grid=3)
    with pytest.raises(InputError, match=says):
        LiveReconstructor(scene.calibration, **asked)


def test_a_solver_that_cannot_be_halted_is_refused() -> None:
    scene = make_scene("sparse-picture", size=SIZE)

    class Whole:
        solution = np.zeros(1)

        def run(self) -> None: ...

    offered = replace(SOLVERS["landweber"], name="whole", make=lambda part, start: Whole())
    SOLVERS.register(offered)
    try:
        video = VideoSolver(stream_problem(scene.measurement, scene.calibration, solver="whole"))
        with pytest.raises(InputError, match="halted"):
            video.next(scene.measurement)
    finally:
        del SOLVERS._foreign["whole"]


def test_that_one_psf_serves_a_field_of_many_is_said() -> None:
    scene = make_scene("sparse-picture", size=SIZE, grid=3, aberration=4.0)
    (said,) = (text for text in LiveReconstructor(scene.calibration).warnings if "One PSF serves" in text)
    assert "--model l" in said
    assert said in stream_problem(scene.measurement, scene.calibration, choosing=False).warnings
    asked = stream_problem(scene.measurement, scene.calibration, model="local")
    assert not any("One PSF serves" in text for text in asked.warnings)


@pytest.mark.parametrize("stray", [0.0, 2.0])
def test_stray_light_that_a_photograph_would_have_a_background_for_is_said(stray: float) -> None:
    scene = make_scene("sparse-picture", size=48, grid=3, aberration=4.0, background=stray, photons=3000.0)
    reconstructor = LiveReconstructor(scene.calibration, prior="l1", **PACE)
    reconstructor._fit._not_before = 0.0  # at once
    reconstructor.feed(scene.measurement)
    reconstructor._fit.wait()
    picture = reconstructor.feed(scene.measurement)
    assert any("--background" in text for text in reconstructor.warnings) == bool(stray)
    assert not picture.doubt


def test_what_is_erased_in_one_colour_changes_no_picture() -> None:
    scene = make_scene("sparse-picture", size=SIZE, grid=3, photons=3000.0)
    psf = np.stack([scene.calibration.psfs[0, 0]] * 3, axis=-1)
    frame = np.stack([scene.measurement * share for share in (1.0, 0.7, 0.5)], axis=-1).astype(np.float32)
    gone = np.zeros(frame.shape, bool)
    gone[3:6, 4:9, 0] = gone[20, 21, 2] = True
    pictures = []
    for value in (0.0, 4 * float(frame.max())):
        reconstructor = LiveReconstructor(psf, erasures=gone, **PACE)
        pictures.append(reconstructor.feed(np.where(gone, np.float32(value), frame)).image)
    assert pictures[0].shape[2] == 3
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("shown", [0, 1, 4, 6, 7])
def test_the_first_the_last_and_the_depth_shown_are_never_left_out(shown: int) -> None:
    base = np.random.default_rng(0).random((24, 24)).astype(np.float32)
    alike = np.array([base + 1e-3 * k * base**2 for k in range(8)], np.float32)[:, None]
    offered = ladder(alike, [1, 2], shown).values()
    assert min(len(detail.planes) for detail in offered) < 8
    assert all({0, shown, 7} <= set(detail.planes) for detail in offered)
