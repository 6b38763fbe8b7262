from __future__ import annotations

import json
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon import InputError, Options, Problem
from recon.base.blocks import block_mean, enlarged
from recon.camera.camera_model import CAMERAS, OfferedCamera
from recon.evaluation.chart_judge import score
from recon.evaluation.scene import make_scene
from recon.reconstruction.options import Overrides
from recon.reconstruction.pilot import LOOKED_AT, pilot
from recon.reconstruction.planes import put_back
from recon.reconstruction.reduction import reduced, reduced_calibration
from recon.reconstruction.rules import drift, precision_of
from recon.solvers.base import StopReason
from tests.device import played

solving = sys.modules[recon.solve.__module__]


def choose(measurement, calibration, **asked):
    """Return what is chosen for a measurement."""
    background = asked.pop("background", None)
    problem = recon.Problem.of(
        recon.Measurement(measurement, background=background), calibration, recon.Options(**asked)
    )
    return recon.choose(problem).choice


def decision(choice, name):
    return next(d for d in choice.decisions if d.name == name)


@pytest.fixture(scope="module")
def beads():
    return make_scene("beads", size=40, depths=6, grid=3, layers=(0.0, 0.15), density=0.5, seed=31)


@pytest.fixture(scope="module")
def chosen_beads(beads):
    return recon.reconstruct(beads.measurement, beads.calibration, prior="l1")


def test_empty_planes_are_left_out_and_come_back_empty(beads, chosen_beads):
    choice = chosen_beads.choice
    assert choice is not None
    assert 1 < len(choice.planes) < 6
    assert 5 in choice.planes
    assert chosen_beads.volume.shape == beads.truth.shape
    rest = [z for z in range(6) if z not in choice.planes]
    assert not chosen_beads.volume[rest].any()
    np.testing.assert_allclose(chosen_beads.grid.z_um, beads.calibration.source_positions_um[::9, 2])
    assert chosen_beads.provenance["auto"]["planes"] == list(choice.planes)
    json.dumps(chosen_beads.provenance["auto"], allow_nan=False)


def test_what_is_left_out_is_said(chosen_beads):
    planes = decision(chosen_beads.choice, "planes")
    assert 0 < planes.numbers["light_left_out"] <= 0.02
    assert planes.up == "all 6"


def test_light_in_many_depths_keeps_them():
    scene = make_scene("beads", size=48, depths=48, density=2.0, seed=1)
    choice = choose(scene.measurement, scene.calibration, prior="l1")
    light = scene.truth.sum(axis=(1, 2))
    assert light[list(choice.planes)].sum() > 0.9 * light.sum()


def test_planes_of_every_colour_stay():
    near, far = (
        make_scene("beads", size=40, depths=8, layers=layers, density=0.5, seed=31)
        for layers in ((0.0, 0.1), (0.9, 1.0))
    )
    np.testing.assert_array_equal(near.calibration.psfs, far.calibration.psfs)
    colours = np.stack([far.measurement, near.measurement, near.measurement], axis=-1)
    choice = choose(colours, near.calibration, prior="l1")
    assert not choice.merged
    for scene in (near, far):
        light = scene.truth.sum(axis=(1, 2))
        assert light[list(choice.planes)].sum() > 0.9 * light.sum()


def test_the_sharpest_colour_and_the_widest_decide():
    scene = make_scene("sparse-picture", size=64, spot_px=5.0, photons=1000.0, channels=3, grid=1)
    assert choose(scene.measurement, scene.calibration).binning > 1
    hot = np.zeros(scene.measurement.shape[:2], bool)
    hot[20, 30] = True  # few erased pixels change no choice, many that are scattered forbid to average
    scattered = np.random.default_rng(0).random(hot.shape) < 0.4
    for erased, binned in ((hot, True), (scattered, False)):
        seen = recon.Measurement(scene.measurement, erasures=erased)
        assert (recon.choose(recon.Problem.of(seen, scene.calibration)).choice.binning > 1) == binned
    psfs = np.repeat(scene.calibration.psfs[:, :1], 3, axis=1)
    psfs[:, 2] = make_scene("sparse-picture", size=64, grid=1).calibration.psfs[:, 0]
    apart = replace(scene.calibration, psfs=psfs)
    assert choose(scene.measurement, apart, choose=Overrides(channels="all")).binning == 1


def test_planes_with_light_that_were_left_out_are_put_back(beads, chosen_beads, monkeypatch):
    assert 0 < max(chosen_beads.provenance["light_in_planes_left_out"]) < 1
    assert not any("left out" in w for w in chosen_beads.warnings)
    wrong = replace(chosen_beads.choice, planes=(0, 1, 2), n_planes=6)
    monkeypatch.setattr("recon.reconstruction.selection.choice_for", lambda *_: wrong)
    result = recon.reconstruct(beads.measurement, beads.calibration, prior="l1", judged=False)
    assert result.choice is not None
    assert set(result.choice.planes) > {0, 1, 2}
    assert "were tried" in decision(result.choice, "planes").why
    assert not any("left out" in w for w in result.warnings)
    light = beads.truth.sum(axis=(1, 2))
    assert light[list(result.choice.planes)].sum() > 0.9 * light.sum()


@pytest.mark.parametrize(
    ("prior", "tried", "stopped_at", "later"), [("tv", (0, 4, 5), 3, False), ("l1", (0, 1, 2), 12, True)]
)
def test_a_run_with_planes_put_back_that_is_cut_short_serves_only_where_it_came_further(
    prior, tried, stopped_at, later, monkeypatch
):
    scene = make_scene("beads", size=40, depths=6, grid=3, layers=(0.0, 0.3), density=0.5, seed=31)
    wrong = replace(choose(scene.measurement, scene.calibration, prior=prior), planes=tried)
    monkeypatch.setattr("recon.reconstruction.selection.choice_for", lambda *_: wrong)
    runs = []
    solve = solving._solve

    def second_is_cancelled(problem, warm, _progress, _cancel, *kept):
        stop = threading.Event()

        def count(record, _):
            if runs and record.iteration == stopped_at:
                stop.set()

        runs.append(solve(problem, warm, count, stop, *kept))
        return runs[-1]

    monkeypatch.setattr(solving, "_solve", second_is_cancelled)
    result = recon.reconstruct(scene.measurement, scene.calibration, prior=prior, judged=False)
    assert [len(run.histories[0]) for run in runs][1:] == [stopped_at]
    assert result.stop_reasons == (StopReason.CANCELLED,)
    assert result.histories == runs[later].histories
    assert (result.choice.planes == tried) is not later
    # In decibels 26.9 against 23.3, and 23.0 against 36.
    assert score(result.volume, scene.truth).psnr_db > 25


def test_planes_that_the_user_left_out_stay_so_and_light_there_is_warned_of(beads):
    result = recon.reconstruct(
        beads.measurement,
        beads.calibration,
        prior="l1",
        judged=False,
        choose=Overrides.parse({"planes": "0-2"}),
    )
    assert result.choice is not None
    assert result.choice.planes == (0, 1, 2)
    assert not result.volume[3:].any()
    assert max(result.provenance["light_in_planes_left_out"]) > 1
    assert any("light in the depth planes that were left out" in w for w in result.warnings)


def test_planes_are_put_back_with_their_neighbours_and_then_all(chosen_beads):
    choice = replace(chosen_beads.choice, planes=(0,), n_planes=8)
    assert put_back(choice, [0.5] * 7, everything=True) is None
    some = put_back(choice, [0.5, 0.5, 0.5, 1.5, 0.5, 0.5, 0.5], everything=False)
    assert some is not None
    assert some.planes == (0, 3, 4, 5)
    every = put_back(some, [0.2, 0.1, 1.2, 0.3], everything=True)
    assert every is not None
    assert every.planes == tuple(range(8))


def test_unlike_depths_get_planes_between_and_their_light_comes_back_to_the_calibrated_ones():
    scene = make_scene("beads", size=48, depths=3, density=0.3, seed=52)
    fine, coarse = (
        recon.reconstruct(
            scene.measurement, scene.calibration, prior="l1", judged=False, choose=Overrides(between=between)
        )
        for between in (None, False)
    )
    assert fine.choice is not None
    assert fine.choice.between == (0, 1)
    assert decision(fine.choice, "between").numbers["least_likeness"] < 0.8
    assert coarse.choice is not None
    assert coarse.choice.between == ()
    assert fine.volume.shape == coarse.volume.shape == scene.truth.shape
    np.testing.assert_array_equal(fine.grid.z_um, coarse.grid.z_um)
    assert score(fine.volume, scene.truth).psnr_db > score(coarse.volume, scene.truth).psnr_db + 0.3
    assert fine.volume.sum() == pytest.approx(coarse.volume.sum(), rel=0.1)


def test_a_depth_that_gets_light_of_a_plane_between_is_not_called_empty():
    scene = make_scene("beads", size=48, depths=4, density=0.1, seed=53)
    found = recon.reconstruct(scene.measurement, scene.calibration, prior="l1", judged=False)
    assert found.choice is not None
    assert found.choice.between
    (empty,) = found.empty_planes
    assert empty.planes
    assert not found.volume[list(empty.planes)].any()


def test_like_depths_get_no_planes_between_and_fields_where_asked_for(beads):
    scene = make_scene("beads", size=32, depths=8, density=0.3, seed=1)
    choice = choose(scene.measurement, scene.calibration, prior="l1")
    assert choice.between == ()
    assert decision(choice, "between").numbers["least_likeness"] > 0.8
    asked = choose(beads.measurement, beads.calibration, prior="l1", choose=Overrides(between=True))
    assert asked.between
    smaller = reduced(asked, Problem.of(beads.measurement, beads.calibration, Options(prior="l1")))
    assert {len(f.points) for f in smaller.depths.fields} == {9}
    assert len(smaller.depths.fields) == len(asked.planes) + len(asked.between)


def test_float64_is_offered_everywhere(beads):
    scene = make_scene("sparse-picture", size=32, grid=1)
    usual, exact = (
        recon.reconstruct(scene.measurement, scene.calibration, choose=Overrides(precision=p), judged=False)
        for p in (None, "float64")
    )
    assert usual.choice is not None
    assert usual.choice.precision == "float32"
    assert decision(usual.choice, "precision").numbers["expected_difference"] < 1e-3
    assert exact.choice is not None
    assert exact.choice.precision == "float64"
    assert exact.state is not None
    assert exact.state.dtype == np.float64
    np.testing.assert_allclose(exact.image, usual.image, atol=1e-3 * float(usual.image.max()))
    volume = choose(beads.measurement, beads.calibration, prior="l1", choose=Overrides(precision="float64"))
    assert volume.precision == "float64"


def test_float32_gives_way_where_the_map_says_so(monkeypatch):
    assert drift(1000, 4096) >= drift(100, 64) > 0
    rough = {"precision": {
        "x": {"values": [30, 100]},
        "y": {"values": [32, 64]},
        "methods": {"admm tv": {"error": [[1e-4, 1e-3], [1e-3, 1e-2]]}},
    }}  # fmt: skip
    monkeypatch.setattr("recon.reconstruction.rules.shipped_maps", lambda: rough)
    assert drift(1000, 64) > 5 * drift(100, 64)
    assert precision_of(Overrides(), 1000, 64).value == "float64"
    assert precision_of(Overrides(precision="float32"), 1000, 64).value == "float32"


def test_what_was_chosen_is_as_good_as_everything(beads, chosen_beads):
    whole = recon.reconstruct(beads.measurement, beads.calibration, prior="l1", model="local")
    auto_db = score(chosen_beads.volume, beads.truth).psnr_db
    assert auto_db > score(whole.volume, beads.truth).psnr_db - 0.5
    assert auto_db > score(np.roll(chosen_beads.volume, 1, axis=1), beads.truth).psnr_db + 1


def test_every_choice_says_why_and_can_be_overruled(beads):
    overrides = Overrides.parse(
        {"model": "local", "planes": "all", "binning": "1", "background": "off", "field": "all"}
    )
    choice = choose(beads.measurement, beads.calibration, prior="l1", choose=overrides)
    assert (choice.model, choice.planes, choice.background) == ("local", tuple(range(6)), False)
    assert choice.psf_window == (40, 40)
    assert [d.name for d in choice.decisions if d.overruled] == [
        "model", "planes", "field", "binning", "background"
    ]  # fmt: skip
    free = choose(beads.measurement, beads.calibration, prior="l1")
    assert free.model != "convolution"
    model = decision(free, "model")
    assert model.down in ("convolution", "lowrank")
    assert all(d.why for d in free.decisions)
    assert any(line.lstrip().startswith("one step down") for line in free.lines())


def test_one_psf_that_does_not_vary_takes_a_convolution():
    scene = make_scene("sparse-picture", size=40, grid=1)
    result = recon.reconstruct(scene.measurement, scene.calibration)
    assert result.choice is not None
    assert result.choice.model == "convolution"
    assert decision(result.choice, "model").up is None
    fixed = recon.reconstruct(scene.measurement, scene.calibration, model="convolution")
    assert fixed.choice is None
    if not result.choice.background and result.choice.binning == 1:
        np.testing.assert_array_equal(result.image, fixed.image)


def test_pictures_of_one_convolution_stop_where_the_choice_says():
    scene = make_scene("sparse-picture", size=40, grid=1)
    usual = recon.reconstruct(scene.measurement, scene.calibration)
    wished = recon.reconstruct(scene.measurement, scene.calibration, choose=Overrides(tolerance=5e-2))
    assert usual.choice is not None
    assert wished.choice is not None
    assert (usual.choice.model, usual.choice.background) == ("convolution", False)
    assert usual.history[-1].change < usual.choice.tolerance
    assert wished.choice.tolerance == 5e-2
    assert len(wished.history) < len(usual.history)


def test_an_unfinished_pass_through_varying_psfs_is_not_taken_for_stray_light():
    scene = make_scene("dense-picture", size=44, grid=3, photons=2e4, density=0.6, seed=27)
    choice = choose(scene.measurement, scene.calibration, z_um=float(scene.z_um[0]))
    assert (choice.model, choice.background) == ("lowrank", False)
    assert scene.background.max() == 0


def test_a_pilot_ends_when_it_is_enough():
    scene = make_scene("sparse-picture", size=24, grid=1)
    problem = Problem.of(
        recon.Measurement(scene.measurement), scene.calibration, Options(model="convolution")
    )
    left = []
    ended = pilot(problem, 9, enough=lambda rest: left.append(rest) or len(left) == 2)
    assert len(ended.outcome.history) == 2 * LOOKED_AT
    np.testing.assert_array_equal(ended.left, left[-1])
    assert len(pilot(problem, 9).outcome.history) == 9


def test_soft_psfs_are_binned_and_sharp_ones_are_not():
    soft = make_scene("sparse-picture", size=64, spot_px=5.0, photons=1000.0)
    result = recon.reconstruct(soft.measurement, soft.calibration)
    assert result.choice is not None
    assert result.choice.binning > 1
    assert result.image.shape == soft.truth.shape
    fine = recon.reconstruct(soft.measurement, soft.calibration, model="convolution")
    assert score(result.image, soft.truth).psnr_db > score(fine.image, soft.truth).psnr_db - 0.5
    # In the same units, not only of the same look.
    assert result.image.sum() == pytest.approx(fine.image.sum(), rel=0.05)
    sharp = make_scene("sparse-picture", size=64)
    assert choose(sharp.measurement, sharp.calibration).binning == 1


def test_equal_colours_are_merged_and_different_ones_are_not():
    grey = make_scene("sparse-picture", size=40, channels=3, grid=1)
    result = recon.reconstruct(grey.measurement, grey.calibration)
    assert result.choice is not None
    assert result.choice.merged
    assert result.image.shape == (40, 40, 3)
    apart = recon.reconstruct(grey.measurement, grey.calibration, choose=Overrides(channels="all"))
    assert score(result.image, grey.truth).psnr_db > score(apart.image, grey.truth).psnr_db - 0.3
    assert result.image.sum() == pytest.approx(apart.image.sum(), rel=0.03)
    colourful = make_scene("sparse-picture", size=40, channels=3, colourful=True)
    assert not choose(colourful.measurement, colourful.calibration).merged
    # A prism: colours differ in the PSF and not in the scene.
    rainbow = make_scene("sparse-picture", size=40, channels=3, dispersion=0.8, optics="smooth")
    assert not choose(rainbow.measurement, rainbow.calibration).merged


def test_a_strong_background_is_noticed_and_none_is_added_to_one_that_was_given():
    stray = make_scene("beads", size=40, depths=4, density=0.5, background=2.0)
    assert choose(stray.measurement, stray.calibration, prior="l1").background
    given = choose(stray.measurement, stray.calibration, prior="l1", background=stray.background)
    assert not given.background
    assert "given" in decision(given, "background").why


@pytest.mark.parametrize("n", [12, 13, 20, 21])
@pytest.mark.parametrize("factor", [2, 3])
def test_binned_and_enlarged_keep_place_and_light(n, factor):
    rng = np.random.default_rng(0)
    from recon.camera.convolution import Convolution

    psf = np.zeros((1, n, n), np.float32)
    psf[0, n // 2, n // 2] = 1
    image = np.zeros((n, n), np.float32)
    place = n // 2 + factor
    image[place, n // 2] = 1.0
    # A point two blocks' worth off the axis: the binned camera finds it at its binned place.
    small_psf, small = (block_mean(i, factor, about_axis=True) for i in (psf, image))
    m = small.shape[0]
    camera = Convolution(small_psf / small_psf.sum(), (m, m))
    x = np.zeros(camera.domain_shape, np.float32)
    x[0, camera.centre[0] + 1, camera.centre[1]] = 1
    seen = camera.forward(x)[0]
    assert np.unravel_index(np.argmax(seen), seen.shape) == np.unravel_index(np.argmax(small), small.shape)
    found = np.zeros((m, m), np.float32)
    found[m // 2 + 1, m // 2] = factor**2
    back = enlarged(found, factor, (n, n))
    assert np.unravel_index(np.argmax(back), back.shape) == (place, n // 2)
    smooth = rng.random((m, m)).astype(np.float32)
    assert enlarged(np.full_like(smooth, 3.0), factor, (n, n)).sum() == pytest.approx(3 * n * n / factor**2)


def test_fewer_depths_keep_their_psfs(beads):
    small = reduced_calibration(beads.calibration, 2, (1, 4))
    assert small.psfs.shape == (18, 1, 20, 20)
    np.testing.assert_array_equal(
        np.unique(small.source_positions_um[:, 2]), np.sort(beads.calibration.source_positions_um[[9, 36], 2])
    )
    assert small.geometry.pixel_pitch_um == 2 * beads.calibration.geometry.pixel_pitch_um


def test_mistakes_are_named(beads):
    with pytest.raises(InputError, match="no choice 'modle'"):
        Overrides.parse({"modle": "local"})
    with pytest.raises(InputError, match="whole number"):
        Overrides.parse({"binning": "0"})
    with pytest.raises(InputError, match="counted from 0"):
        Overrides.parse({"planes": "3-1"})
    assert Overrides.parse({"planes": "0-2,5"}).planes == (0, 1, 2, 5)
    with pytest.raises(InputError, match="numbered from 0 to 5"):
        choose(beads.measurement, beads.calibration, prior="l1", choose=Overrides(planes=(2, 6)))
    with pytest.raises(InputError, match="one of on, off"):
        Overrides.parse({"background": "maybe"})


def test_wishes_that_would_be_ignored_are_refused():
    picture = make_scene("sparse-picture", size=32, grid=1)
    for given in (picture.calibration, picture.calibration.psfs[0, 0]):
        with pytest.raises(InputError, match="model='convolution'"):
            recon.reconstruct(
                picture.measurement, given, choose=Overrides(binning=1), model="convolution", judged=False
            )
    # No wish is none that is ignored.
    recon.reconstruct(
        picture.measurement,
        picture.calibration,
        model="convolution",
        iterations=2,
        choose=Overrides(),
        judged=False,
    )


class Kept:
    """Keeps nothing, and counts what it is shown."""

    def __init__(self):
        self.parts = set()

    def resume(self, part, solver):
        return ()

    def keep(self, part, solver, history, *, ended):
        self.parts.add(part)


SAME_FOR_ALL = {
    "checkpoint": {"keeper": True},
    "float64": {"precision": "float64"},
    "memory limit": {"memory_gib": 1.0},
    "scratch files": {"scratch": "."},
    "start": {"warm": True},
    "device": {"device": "gpu"},
    "end": {"iterations": 3, "tolerance": 0.0, "time_s": 60.0},
    "end at the noise": {"stop_at_noise": True},
}


@pytest.fixture
def a_gpu():
    with played():
        yield


def solved(scene, warm, asked):
    """Reconstruct in a few iterations as asked; also return what was kept."""
    keeper = Kept() if asked.get("keeper") else None
    given = {name: value for name, value in asked.items() if name not in ("keeper", "warm")}
    if asked.get("solver") != "wiener":
        given = {"iterations": 3} | given
    result = recon.reconstruct(
        scene.measurement, scene.calibration, **given, judged=False, keeper=keeper,
        warm=warm if asked.get("warm") else None,
    )  # fmt: skip
    assert result.choice is not None
    assert result.choice.precision == asked.get("precision", "float32")
    return result, keeper


PICTURE_SOLVERS = {
    "fista": {"solver": "fista", "prior": "tv-haar"},
    "admm": {"solver": "admm"},
    "admm-sensor": {"solver": "admm-sensor"},
    "wiener": {"solver": "wiener"},
    "no prior": {"prior": "none"},
}


@pytest.mark.usefixtures("a_gpu")
@pytest.mark.parametrize("what", [*SAME_FOR_ALL, *PICTURE_SOLVERS])
def test_nothing_switches_the_choice_off_for_a_picture(what):
    scene = make_scene("sparse-picture", size=64, spot_px=5.0, photons=1000.0)
    warm = None
    if what == "start":
        warm = recon.reconstruct(scene.measurement, scene.calibration, iterations=40, judged=False)
    result, keeper = solved(scene, warm, (SAME_FOR_ALL | PICTURE_SOLVERS)[what])
    assert result.choice.binning > 1
    assert result.image.shape == scene.truth.shape
    if keeper is not None:
        assert keeper.parts == {f"auto-{result.choice.key}"}
    if warm is not None:
        cold = recon.reconstruct(scene.measurement, scene.calibration, iterations=3, judged=False)
        apart, further = (float(np.linalg.norm(r.image - warm.image)) for r in (result, cold))
        assert apart < 0.3 * further


@pytest.mark.usefixtures("a_gpu")
@pytest.mark.parametrize("what", [*SAME_FOR_ALL, "solver"])
def test_nothing_switches_the_choice_off_for_a_volume(beads, chosen_beads, what):
    asked = SAME_FOR_ALL.get(what, {"solver": "admm"})
    result, keeper = solved(beads, chosen_beads, asked | {"prior": "l1"})
    assert 1 < len(result.choice.planes) < 6
    assert result.choice.model == chosen_beads.choice.model
    if keeper is not None:
        assert f"auto-{result.choice.key}-channel-0" in keeper.parts


def test_kept_work_belongs_to_what_was_chosen(chosen_beads):
    choice = chosen_beads.choice
    assert replace(choice, seconds=9.0, tolerance=0.0).key == choice.key
    assert replace(choice, planes=(0, 1)).key != choice.key
    assert replace(choice, binning=choice.binning + 1).key != choice.key


def test_a_camera_model_of_ones_own_that_cannot_be_judged_is_named(beads, monkeypatch):
    own = OfferedCamera(name="own", help="As the convolution.", make=lambda central, _depths: central)
    unfit = replace(own, name="unfit", refuses=lambda _: "it is for one depth")
    monkeypatch.setattr(CAMERAS, "_foreign", {"own": own, "unfit": unfit})
    why = decision(choose(beads.measurement, beads.calibration, prior="l1"), "model").why
    assert "left out: own, of which nobody knows what it costs and gains (--model own takes it)" in why
    taken = choose(beads.measurement, beads.calibration, prior="l1", choose=Overrides(model="own"))
    assert taken.model == "own"
    assert decision(taken, "model").overruled
    assert "left out" not in decision(taken, "model").why


def test_a_solver_that_has_no_way_for_varying_psfs_has_one_convolution_and_says_so():
    scene = make_scene("sparse-picture", size=64, grid=3, seed=7)
    assert choose(scene.measurement, scene.calibration).model != "convolution"
    held = choose(scene.measurement, scene.calibration, solver="admm-sensor")
    assert held.model == "convolution"
    assert "one PSF" in decision(held, "model").why
    assert not decision(held, "model").overruled


def test_a_volume_whose_colours_are_alike_is_solved_as_one_by_default() -> None:
    made = make_scene("dense-volume", seed=1, size=32, channels=3)
    found = recon.reconstruct(made.measurement, made.calibration, iterations=1, judged=False)
    assert found.choice is not None
    assert found.choice.merged
