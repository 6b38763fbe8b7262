from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.blocks import block_mean
from recon.errors import InputError
from recon.evaluation.chart_judge import Judge
from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.scene import make_scene
from recon.evaluation.scored import HELD_OUT, KINDS, Point, even_with_best, pareto
from recon.evaluation.trial import Setting
from recon.priors import PRIORS
from recon.reconstruction.reconstruct import reconstruct
from recon.types import Calibration


def problem(family="sparse-picture", **changes):
    return ChartProblem.of_scene(make_scene(family, size=32, **changes))


def test_scores_come_on_the_way_and_get_better():
    points = problem().run(Setting("admm", "convolution", "tv"), counts=(2, 10, 40)).points
    assert [p.iterations for p in points] == [2, 10, 40]
    assert points[0].seconds < points[1].seconds < points[2].seconds
    assert points[0].psnr_db < points[2].psnr_db
    assert points[0].held_out > points[2].held_out
    assert points[2].held_out > points[2].residual


def test_held_out_pixels_were_not_looked_at():
    """A pixel that was used would be predicted about as well as the others."""
    whole = problem()
    garbled = ChartProblem(
        whole.measurement + np.float32(0), whole.calibration, False, None, whole.noise, whole.truth
    )
    judge = Judge(garbled, Setting("admm", "convolution", "nonnegative"), 0)
    assert 0.02 < judge.held.mean() < 0.1
    spoilt = whole.measurement.copy()
    spoilt[judge.held] = 1e5
    points = [
        ChartProblem(m, whole.calibration, False, None, 5.0, whole.truth)
        .run(
            Setting("admm", "convolution", "tv"),
            counts=(20,),
        )
        .points[0]
        for m in (whole.measurement, spoilt)
    ]
    assert points[0].psnr_db == pytest.approx(points[1].psnr_db, abs=1e-3)
    assert points[1].held_out > 100 * points[0].held_out


@pytest.mark.parametrize("shape", [(102, 98), (100, 97), (96, 110), (99, 103)])
def test_held_out_scores_are_of_the_same_light_at_every_binning(shape, monkeypatch):
    rng = np.random.default_rng(0)
    psf = np.zeros((1, 1, *shape), np.float32)
    psf[0, 0, shape[0] // 2, shape[1] // 2] = 1
    measurement = (100 + rng.normal(0, 3, shape)).astype(np.float32)
    case = ChartProblem(measurement, Calibration(psf, np.array([[0, 0, 1e4]])), False, None, 3.0)
    monkeypatch.setattr(Judge, "_predict", lambda judge, _: np.full_like(judge.measurement, 100))
    one = Judge(case, Setting("admm", "convolution", "tv"), 0)
    scores = []
    for factor in (1, 2, 4):
        judge = Judge(case, Setting("admm", "convolution", "tv", factor), 0)
        share = block_mean(one.held.astype(np.float32), factor, about_axis=True)
        assert set(np.unique(share)) == {0.0, 1.0}  # whole pixels, none half held out
        np.testing.assert_array_equal(judge.held, share > 0.5)
        assert judge.held.sum() * factor**2 == one.held.sum()
        scores.append(judge.point(np.zeros(judge.measurement.shape), 1, 1.0).held_out)
    assert scores == pytest.approx([scores[0]] * 3, rel=1e-4)
    assert scores[0] == pytest.approx(1, abs=0.4)  # noise alone, in its own units


@pytest.mark.parametrize(
    "setting", [Setting("fista", "convolution", "tv"), Setting("admm", "convolution", "l1", 1, True)]
)
def test_a_run_says_whether_time_cut_it_off(setting):
    assert not problem().run(setting, limit_s=1e-6, counts=(1, 1000)).finished
    assert problem().run(setting, limit_s=1000.0, counts=(1, 2)).finished


def test_what_is_not_charted_is_said():
    said = " ".join(problem(erased=0.2).left_out())
    assert "erased pixels cannot be averaged" in said
    assert "one PSF a depth" in said
    assert "tv-haar" in said
    assert "admm-sensor beside a background: it estimates no background where pixels are erased" in said
    varying = " ".join(problem("beads", depths=3, grid=3).left_out())
    assert "one PSF a depth" not in varying
    assert "too few pixels" in varying
    assert "wiener" in varying


@pytest.mark.parametrize("family", ["sparse-picture", "dense-picture"])
def test_brightness_and_slow_waves_do_not_count_on_held_out_pixels(family, monkeypatch):
    case = replace(problem(family), truth=None)
    judge = Judge(case, Setting("admm", "convolution", "tv"), 0)
    rng = np.random.default_rng(1)
    wrong = rng.normal(0, 3 * judge.noise, judge.measurement.shape).astype(np.float32)
    slow = 50 * judge.noise * np.cos(np.pi * (np.arange(32) + 0.5) / 32)[:, None]

    def scored(predicted):
        monkeypatch.setattr(Judge, "_predict", lambda *_: predicted.astype(np.float32))
        point = judge.point(np.zeros(judge.measurement.shape), 1, 1.0)
        assert np.sqrt(np.mean(point.held_out_parts)) == pytest.approx(point.held_out, rel=0.1)
        return point.held_out

    right = scored(judge.measurement)
    assert right < 1e-3
    assert scored(judge.measurement / 3) == pytest.approx(right, abs=1e-3)
    assert scored(judge.measurement + slow) == pytest.approx(right, abs=1e-3)
    worse = scored(judge.measurement + wrong)
    assert 1.5 < worse < 4
    assert scored(judge.measurement + wrong + slow) == pytest.approx(worse, rel=1e-3)


def test_scores_that_scatter_more_than_they_differ_are_even():
    rng = np.random.default_rng(0)
    common = rng.uniform(1, 3, 12)  # noise of the pixels, which all settings share

    def made(name, worse, scatter, iterations=40, seconds=1.0):
        parts = common + worse + scatter * rng.normal(size=12)
        return Point(
            name, iterations, seconds, held_out=float(np.mean(parts)) ** 0.5, held_out_parts=tuple(parts)
        )

    best = made("best", 0.0, 0.0)
    even = made("even", 0.05, 0.2, seconds=0.1)
    apart = made("apart", 0.05, 0.01)
    early = made("early", 0.0, 0.0, iterations=5)
    coarser = replace(best, setting="coarser", binning=2.0)
    found = even_with_best([early, apart, even, best, coarser, Point("other", 40, 1.0, held_out=1.0)])
    assert {p.setting for p in found} == {"best", "even"}
    assert found[0].held_out == min(p.held_out for p in found)
    assert even_with_best([Point("other", 40, 1.0, held_out=1.0)]) == ()


def test_one_bright_pixel_does_not_make_settings_even():
    best = Point("best", 40, 1.0, held_out=10.0, held_out_parts=(1200.0, *np.linspace(1, 2, 11)))
    worse = [3 * p for p in best.held_out_parts]
    found = even_with_best([best, Point("worse", 40, 0.1, held_out=17.3, held_out_parts=tuple(worse))])
    assert found == (best,)


def test_settings_fit_the_problem():
    single = problem().settings()
    for method in {s.solver for s in single}:
        assert {s.precision for s in single if s.solver == method} == {"float32", "float64"}
    assert {s.prior for s in single if s.solver == "fista"} == set(PRIORS)
    assert not any(s.prior == "tv-haar" for s in single if s.solver != "fista")
    assert {s.model for s in single} == {"convolution"}
    assert single[0].solver == "wiener"
    varying = problem(grid=3).settings()
    assert {s.model for s in varying} == {"convolution", "lowrank", "local"}
    volume = problem("beads", depths=3).settings()
    assert {s.solver for s in volume} == {"admm"}
    assert len({s.name for s in varying}) == len(varying)
    assert not any(s.binning > 1 for s in problem(erased=0.2).settings())


@pytest.mark.parametrize(
    "setting",
    [
        Setting("wiener", "convolution", "none"),
        Setting("fista", "convolution", "l1"),
        Setting("admm", "lowrank", "l1", 1, True),
    ],
)
def test_kinds_of_settings_run(setting):
    points = problem(grid=3).run(setting, counts=(3,)).points
    assert len(points) == 1
    assert np.isfinite([points[0].psnr_db, points[0].held_out, points[0].ssim]).all()


def test_the_front_is_what_nothing_beats():
    made = [
        Point("slow good", 1, 9.0, 1.0, 1.0, 30.0),
        Point("slow bad", 1, 8.0, 1.0, 4.0, 20.0),
        Point("quick", 1, 1.0, 1.0, 2.0, 25.0),
        Point("same time, worse", 1, 1.0, 1.0, 3.0, 24.0),
    ]
    psnr, *_ = KINDS["reconstruction"].scores
    assert [p.setting for p in pareto(made, psnr)] == ["quick", "slow good"]
    assert [p.setting for p in pareto(made, HELD_OUT)] == ["quick", "slow good"]


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("method", ["wiener", "admm", "admm-sensor", "fista"])
def test_precisions_agree(precision, method):
    scene = make_scene("sparse-picture", size=24)
    given = {"solver": method, "model": "convolution", "judged": False, "prior": "nonnegative"}
    given |= {} if method == "wiener" else {"iterations": 5}
    found = reconstruct(scene.measurement, scene.calibration, precision=precision, **given)
    again = reconstruct(scene.measurement, scene.calibration, **given)
    assert found.state.dtype == precision
    np.testing.assert_allclose(found.image, again.image, atol=2e-3 * again.image.max())


def test_every_setting_of_a_picture_runs_and_no_other():
    """What the table of methods and priors says is what the solvers take."""
    case = problem()
    for setting in case.settings():
        if setting.precision == "float32" and setting.binning == 1:
            assert case.run(setting, counts=(1,)).points
    assert any(setting.background for setting in case.settings())
    for method in ("admm", "admm-sensor"):
        with pytest.raises(InputError, match="takes the priors"):
            reconstruct(
                case.measurement, case.calibration, solver=method, model="convolution", prior="tv-haar"
            )
        with pytest.raises(InputError, match="does not apply"):
            case.run(Setting(method, "convolution", "tv-haar"))
