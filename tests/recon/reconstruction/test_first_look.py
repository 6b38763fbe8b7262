from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from recon import Measurement, Problem, reconstruct
from recon.evaluation.chart_judge import score
from recon.evaluation.scene import make_scene
from recon.priors import TotalVariation
from recon.reconstruction.first_look import LAWS, STEEPEST, FirstLook, look_at
from recon.reconstruction.options import ReconstructionOptions


def seen(family, **options):
    scene = make_scene(family, size=40)
    asked = ReconstructionOptions(model="convolution", **options)
    return look_at(Problem.of(Measurement(scene.measurement), scene.calibration, asked))


def test_light_on_black_weighs_less_than_a_full_picture():
    lights, slope = seen("lights"), seen("gradient")
    assert lights.lit < 0.2 < 0.5 < slope.lit
    assert lights.steepness > slope.steepness
    for prior in ("tv", "l1"):
        assert lights.weight(prior) < slope.weight(prior) / 2


@pytest.mark.parametrize("erased", [0.4, 0.8])
def test_erased_pixels_make_less_light_not_more_noise(erased):
    looks = []
    for share in (0.0, erased):
        scene = make_scene("filaments", size=64, photons=3000.0, erased=share)
        photograph = Measurement(scene.measurement, erasures=scene.erasures, noise=scene.noise)
        asked = ReconstructionOptions(model="convolution")
        looks.append(look_at(Problem.of(photograph, scene.calibration, asked)))
    whole, holes = looks
    kept = np.sqrt(1 - erased)
    assert holes.passed_on == pytest.approx(kept, rel=0.05)
    assert holes.steepness == pytest.approx(kept * whole.steepness, rel=0.35)


def test_the_weight_does_not_depend_on_solver_precision_or_prior_of_its_kind():
    look = seen("lights")
    for options in ({"solver": "admm-sensor"}, {"precision": "float64"}, {"prior": "tv-isotropic"}):
        other = seen("lights", **options)
        assert other.weight("tv") == pytest.approx(look.weight("tv"), rel=1e-3)


def test_a_misfit_far_above_the_noise_asks_for_more_and_all_stays_within_limits():
    def weight(*found):
        return FirstLook(*found, 0.0).weight("tv")

    assert weight(1, 0.3, 3.0) > 3 * weight(1, 0.3, 1.0)
    assert weight(1, 0.3, 90.0) == weight(1, 0.3, LAWS["tv"].most_misfit)
    assert weight(10, 0.3, 4.0) < weight(2.5, 0.3, 4.0) / 2  # steps count beside what is left
    assert weight(0, 1.0, 2.0) == LAWS["tv"].most
    assert weight(1e9, 0.0, 0.0) == weight(STEEPEST, 0.0, 1.0) > 0


def test_where_psfs_vary_the_central_one_looks_and_its_own_law_weighs():
    scene = make_scene("text", size=32, grid=3)

    def look(model, **options):
        asked = ReconstructionOptions(model=model, **options)
        return look_at(Problem.of(Measurement(scene.measurement), scene.calibration, asked))

    plain, varying, lit = look("convolution"), look("lowrank"), look("local", estimate_background=True)
    assert (varying.steepness, varying.lit, varying.misfit) == (plain.steepness, plain.lit, plain.misfit)
    assert lit.weight("tv") == varying.weight("tv") == replace(varying, misfit=9.0).weight("tv")
    assert varying.weight("tv") != plain.weight("tv")
    assert look("lowrank", prior="l1") is None


def test_nobody_looks_where_nothing_is_to_be_weighed():
    assert seen("lights", tau=1e-3) is None
    assert seen("lights", prior="nonnegative") is None
    assert seen("lights", prior=TotalVariation(1.0)) is None
    assert seen("lights", solver="wiener") is None
    # With a background l1 counts light as it is seen, and the law does not hold.
    assert seen("lights", prior="l1", estimate_background=True) is None
    assert seen("lights", estimate_background=True) is not None


def test_the_default_is_near_the_best_of_a_search_and_says_why():
    scene = make_scene("text", size=48, field=0.7, photons=1e4)

    def solve(**options):
        return reconstruct(scene.measurement, scene.calibration, model="convolution", judged=False, **options)

    result = solve()
    own = score(result.image, scene.truth).psnr_db
    best = max(
        score(solve(tau=result.tau * t).image, scene.truth).psnr_db for t in (0.125, 0.25, 0.5, 2, 4, 8)
    )
    assert own > best - 0.6
    assert "a first look found" in result.provenance["weight"]
    assert "weight" not in solve(tau=1e-3).provenance


def test_a_cancelled_look_ends_at_once_and_counts_as_time():
    scene = make_scene("lights", size=40)
    stop = threading.Event()
    stop.set()
    problem = Problem.of(
        Measurement(scene.measurement), scene.calibration, ReconstructionOptions(model="convolution")
    )
    cancelled, whole = look_at(problem, stop), look_at(problem)
    assert cancelled is not None
    assert whole is not None
    assert cancelled.seconds > 0
    assert np.isfinite(cancelled.weight("tv"))
    asked = {"model": "convolution", "judged": False}
    limited = reconstruct(scene.measurement, scene.calibration, time_s=1e-6, **asked)
    assert len(limited.history) == 1


def test_the_solver_is_admm_sensor_from_many_pixels_on():
    psf = np.zeros((140, 150))
    psf[50:60, 55:60] = np.arange(50).reshape(10, 5)
    image = np.random.default_rng(0).poisson(50.0, psf.shape)

    def solver(shape, **options):
        asked = ReconstructionOptions(**{"model": "convolution", **options})
        rows, columns = shape
        return Problem.of(Measurement(image[:rows, :columns]), psf[:rows, :columns], asked).solver.name

    assert solver((140, 150)) == "admm-sensor"
    assert solver((130, 140)) == "admm"
    assert solver((130, 140), estimate_background=True) == "admm-sensor"
    assert solver((140, 150), solver="admm") == "admm"
