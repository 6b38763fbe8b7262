"""The one call: pictures against the truth, independence of exposure, refusals in words."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from recon import Calibration, Geometry, InputError, Measurement, NoiseModel
from recon import reconstruct as reconstruct_and_judge
from recon.base.metrics import psnr
from recon.camera.refocus import refocus
from recon.priors import PRIORS
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.solvers import StopReason

ROOT = Path(__file__).parents[2]
reconstruct = partial(reconstruct_and_judge, judged=False)
"""Whether a result can be trusted costs more than such small ones, and is held in tests/recon/verdict."""


@pytest.fixture(scope="module")
def shot(shoot):
    return shoot()


@pytest.mark.parametrize(
    ("method", "prior", "least_db"),
    [
        ("admm", "tv", 26),
        ("admm", "tv-isotropic", 26),
        ("fista", "tv-haar", 22),
        ("admm", "l1", 12),
        ("wiener", "nonnegative", 8),
    ],
)
def test_finds_the_scene(shot, method, prior, least_db):
    result = reconstruct(shot.measurement, shot.psf, solver=method, prior=prior)
    assert result.image.shape == shot.truth.shape
    assert result.image.dtype == np.float32
    found = psnr(result.image, shot.truth)
    print(method, prior, f"{found:.1f} dB, {len(result.history)} iterations: {result.stop_reason}")
    assert found > least_db


def test_default_is_independent_of_exposure_and_psf_brightness(shot):
    plain = reconstruct(shot.measurement, shot.psf, iterations=40)
    for exposure in (1e-3, 1e5):
        for brightness in (1e-4, 1e4):
            other = reconstruct(exposure * shot.measurement, brightness * shot.psf, iterations=40)
            assert other.image * brightness / exposure == pytest.approx(plain.image, rel=1e-3, abs=1e-3)
            assert other.tau == pytest.approx(plain.tau, rel=1e-3)


@pytest.mark.parametrize("snr", [5, 20, 1000])
def test_default_holds_over_noise(shoot, snr):
    shot = shoot(snr=snr)
    default = psnr(reconstruct(shot.measurement, shot.psf).image, shot.truth)
    tuned = max(
        psnr(reconstruct(shot.measurement, shot.psf, tau=10.0**e).image, shot.truth)
        for e in np.arange(-5, -1, 0.5)
    )
    print(f"snr {snr}: default {default:.2f} dB, tuned {tuned:.2f} dB")
    assert default > tuned - 1.0


def test_compilation_is_not_counted_as_solving(tmp_path):
    """In a fresh process with an empty cache the first iteration must be about as fast as the next ones."""
    code = (
        "import numpy as np, time; from recon import reconstruct\n"
        "psf = np.random.default_rng(0).random((60, 80)) ** 8\n"
        "plain = {'estimate_background': False, 'model': 'convolution', 'judged': False}\n"
        "for method in 'wiener', 'fista', 'admm':\n"
        "    limits = {} if method == 'wiener' else {'iterations': 3, 'tolerance': 0}\n"
        "    began = time.perf_counter()\n"
        "    result = reconstruct(psf[::-1] + 1, psf, solver=method, **plain, **limits)\n"
        "    print(method, result.seconds, time.perf_counter() - began)"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True, cwd=ROOT
    )
    for line in run.stdout.splitlines():
        method, solving, whole = line.split()
        assert float(solving) < 0.3 * float(whole), method


def test_colour_channels_are_solved_each_with_its_psf(shot, shoot):
    other = shoot(seed=7)
    measurement = np.stack([shot.measurement, 3 * other.measurement], axis=-1)
    asked = {"prior": PRIORS["tv"](1.0), "iterations": 60, "tolerance": 0}  # a default weight is that of both
    both = reconstruct(measurement, np.stack([shot.psf, other.psf], axis=-1), **asked)
    assert both.image.shape == (*shot.truth.shape, 2)
    alone = reconstruct(shot.measurement, shot.psf, **asked)
    assert np.linalg.norm(both.image[..., 0] - alone.image) < 1e-3 * np.linalg.norm(alone.image)
    assert psnr(both.image[..., 1] / 3, other.truth) > 24
    shared = reconstruct(measurement[..., :1], shot.psf, **asked)
    assert shared.image.shape == (*shot.truth.shape, 1)
    assert shared.image[..., 0] == pytest.approx(alone.image)


def test_erased_pixels_are_not_looked_at(shot):
    valid = np.random.default_rng(0).random(shot.measurement.shape) > 0.4
    spoilt = np.where(valid, shot.measurement, 1e6)
    result = reconstruct(spoilt, shot.psf, erasures=~valid)
    zeroed = reconstruct(np.where(valid, shot.measurement, 0), shot.psf, erasures=~valid)
    assert np.array_equal(result.image, zeroed.image)
    assert psnr(result.image, shot.truth) > 22
    assert result.noise_norm == pytest.approx(np.sqrt(valid.sum()))


@pytest.mark.parametrize(("erased", "least_db"), [(0.5, 22), (0.8, 18)])
def test_survives_many_erasures(shoot, erased, least_db):
    """Half, or a fifth, of the pixels still give a picture (Kuo 2020, Fig. 3.7)."""
    shot = shoot(105, 121)
    gone = np.random.default_rng(0).random(shot.measurement.shape) < erased
    found = psnr(reconstruct(shot.measurement, shot.psf, erasures=gone).image, shot.truth)
    print(f"{erased:.0%} erased: {found:.1f} dB")
    assert found > least_db


def test_background_is_subtracted(shot):
    plain = reconstruct(shot.measurement, shot.psf, iterations=10)
    dark = np.full_like(shot.measurement, 500.0)
    for background in (dark, 500, 500.0):
        other = reconstruct(shot.measurement + 500, shot.psf, iterations=10, background=background)
        assert other.image == pytest.approx(plain.image, rel=1e-3, abs=1e-3)


def test_integers_and_floats_are_one(shot):
    counts = np.round(shot.measurement).astype(np.uint16)
    a, b = (reconstruct(m, shot.psf, iterations=10) for m in (counts, counts.astype(float)))
    assert np.array_equal(a.image, b.image)


def test_stops_by_rule_and_says_which(shot):
    assert reconstruct(shot.measurement, shot.psf, iterations=7).stop_reason is StopReason.ITERATIONS
    assert reconstruct(shot.measurement, shot.psf, time_s=0.05, tolerance=0).stop_reason is StopReason.TIME
    noisy = reconstruct(shot.measurement, shot.psf, noise=20 * shot.noise, stop_at_noise=True)
    assert noisy.stop_reason is StopReason.NOISE_LEVEL
    assert noisy.history[-1].data_residual <= noisy.noise_norm
    cancel = threading.Event()
    pictures = []

    def watch(record, volume):
        pictures.append(volume()[0])
        if record.iteration == 4:
            cancel.set()

    stopped = reconstruct(shot.measurement, shot.psf, on_progress=watch, cancel=cancel)
    assert stopped.stop_reason is StopReason.CANCELLED
    assert len(pictures) == len(stopped.history) == 4
    assert np.array_equal(pictures[-1], stopped.image)


def test_noise_is_estimated_and_taken_from_a_model(shot):
    measured = reconstruct(shot.measurement, shot.psf, iterations=1).provenance["noise_deviation"][0]
    assert measured == pytest.approx(shot.noise, rel=0.5)
    model = NoiseModel(read_noise=3.0, counts_per_electron=0.5)
    told = reconstruct(shot.measurement, shot.psf, iterations=1, noise=model).provenance["noise_deviation"][0]
    assert told == pytest.approx(np.sqrt(9 + 0.5 * shot.measurement.mean()), rel=1e-3)


def test_continues_from_an_earlier_result(shot):
    done = reconstruct(shot.measurement, shot.psf)
    warm = reconstruct(shot.measurement, shot.psf, warm=done, iterations=5)
    cold = reconstruct(shot.measurement, shot.psf, iterations=5)
    assert psnr(warm.image, shot.truth) > psnr(cold.image, shot.truth) + 3


def test_wiener_s_regularisation_is_chosen_and_can_be_given(shot):
    def error(**options):
        return psnr(reconstruct(shot.measurement, shot.psf, solver="wiener", **options).image, shot.truth)

    chosen = error()
    assert chosen > max(error(tau=10.0**e) for e in range(-6, 3)) - 1.0
    assert error(tau=1e-6) < chosen
    assert reconstruct(shot.measurement, shot.psf, solver="wiener", prior="nonnegative").image.min() == 0
    free = reconstruct(shot.measurement, shot.psf, solver="wiener")
    assert free.image.min() < 0
    assert free.prior == "none"
    assert free.tau is not None
    again = reconstruct(shot.measurement, shot.psf, solver="wiener", tau=free.tau)
    np.testing.assert_array_equal(again.image, free.image)
    with pytest.raises(InputError, match="evaluates no prior"):
        reconstruct(shot.measurement, shot.psf, solver="wiener", prior="tv")
    with pytest.raises(InputError, match="one shot"):
        reconstruct(shot.measurement, shot.psf, solver="wiener", iterations=3)


def test_grid_tells_where_pixels_lie(shot):
    geometry = Geometry(pixel_pitch_um=10.0, diffuser_distance_mm=5.0)
    calibration = Calibration(
        psfs=np.stack([shot.psf, shot.psf[::-1]]).astype(np.float32)[:, None],
        source_positions_um=np.array([[0, 0, 20_000.0], [0, 0, 40_000.0]]),
        geometry=geometry,
    )
    result = reconstruct(shot.measurement, calibration, z_um=21_000.0, iterations=2)
    assert result.grid.pitch_um[0] == pytest.approx(10 * 21 / 5)
    assert result.grid.z_um.tolist() == [21_000.0]
    assert result.grid.centre == (32, 40)
    assert result.provenance["psf_z_um"] == 21_000  # brought there, as the terminal's --z-mm has it
    problem = Problem.of(shot.measurement, calibration, ReconstructionOptions(z_um=21_000.0))
    np.testing.assert_array_equal(problem.calibration.psfs[0], refocus(calibration, 21_000.0).psf)
    assert result.provenance["refocused"]["from_z_um"][0] == 20_000
    # At a depth as calibrated the PSF fills its frame, so that both fields are one problem.
    result = reconstruct(shot.measurement, calibration, z_um=20_000.0, iterations=2)
    full = reconstruct(shot.measurement, calibration, z_um=20_000.0, iterations=2, field="full")
    assert full.image.shape == (129, 161)
    row, column = (f - s for f, s in zip(full.grid.centre, result.grid.centre, strict=True))
    assert np.array_equal(full.image[row : row + 65, column : column + 81], result.image)


GOOD = np.ones((12, 14)) + np.eye(12, 14)
BAD = np.where(np.arange(12 * 14).reshape(12, 14) == 30, np.nan, GOOD)


class ValueAlone:
    """Half a prior."""

    def value(self, x):
        return 0.0


class LikeAPrior:
    """Has a prior's methods and is none."""

    def value(self, x):
        return 0.0

    def prox(self, x, step):
        return x


@pytest.mark.parametrize(
    ("measurement", "psf", "options", "message"),
    [
        (GOOD, 0 * GOOD, {}, "zero everywhere: the point source was not seen"),
        (GOOD, 0 * GOOD + 3, {}, "constant .3 everywhere."),
        (GOOD, BAD, {}, r"PSF holds 1 values that are not finite numbers, the first at .2, 2."),
        (np.nan_to_num(BAD, nan=np.inf), GOOD, {}, r"measurement holds 1 values that .* pixels NaN: erased"),
        (BAD * np.nan, GOOD, {}, "holds 168 values that are not finite .* nothing else in it"),
        (
            Measurement([BAD, BAD], patterns=np.ones((2, 12, 14))),
            GOOD,
            {},
            "holds 2 values that are not finite .* Put numbers there, and mark them in erasures",
        ),
        (GOOD, GOOD, {"background": BAD}, "background holds 1 values .* the mean of their neighbours there"),
        (GOOD, GOOD, {"background": np.nan}, "background must be finite, not nan"),
        (GOOD, GOOD, {"erasures": BAD}, "erasures holds 1 values that are not finite .* Put 1 or 0 there"),
        (GOOD * 1e39, GOOD, {}, r"measurement must hold real numbers up to 3.4e.38 .float32., not 2e.39"),
        (GOOD, GOOD, {"background": 1e39}, r"background must hold real numbers up to 3.4e.38"),
        (GOOD, GOOD - 2, {}, "sums to a negative number"),
        (GOOD[1:], GOOD, {}, "PSF has 12 x 14 pixels and the measurement 11 x 14"),
        (np.ones((12, 14, 2)), np.dstack([GOOD] * 3), {}, "PSF has 3 channels and the measurement 2"),
        (GOOD[0], GOOD, {}, r"must be .height, width. or .height, width, n_channels.; it is .14,."),
        (GOOD[:0], GOOD, {}, "is empty"),
        (GOOD * 1j, GOOD, {}, "must hold real numbers, not complex128"),
        (GOOD, GOOD, {"erasures": np.ones((12, 14))}, "leave no pixel"),
        (GOOD, GOOD, {"erasures": np.ones((3, 3))}, "erasures has 3 x 3 pixels"),
        (GOOD, GOOD, {"background": np.ones((3, 3))}, "background has 3 x 3 pixels"),
        (GOOD, GOOD, {"solver": "adm"}, "'adm' is not known. .* Did you mean 'admm'"),
        (GOOD, GOOD, {"prior": "tb"}, "prior must be one of .*, not 'tb'"),
        (GOOD, GOOD, {"prior": "tv-haar", "solver": "admm"}, "takes the priors tv, .*, not 'tv-haar'"),
        (GOOD, GOOD, {"tau": -1.0}, "tau must be a number, 0 or more"),
        (GOOD, GOOD, {"noise": -1.0}, "noise must be .* counts, 0 or more, not -1.0"),
        (GOOD, GOOD, {"noise": "x"}, "noise must be a NoiseModel, or .* not 'x'"),
        (GOOD, GOOD, {"noise": np.nan}, "noise must be"),
        (GOOD, GOOD, {"erasures": 0.5}, "erasures is 0.5: a mask of the measurement's pixels is expected"),
        (GOOD, GOOD, {"erasures": GOOD}, "erasures holds values from"),
        (GOOD, GOOD, {"iterations": 2.5}, "iterations must be a whole number, 1 or more, not 2.5"),
        (GOOD, GOOD, {"iterations": 0}, "iterations must be a whole number"),
        (GOOD, GOOD, {"iterations": True}, "iterations must be a whole number"),
        (GOOD, GOOD, {"time_s": 0.0}, "time_s must be a number, above 0 .s., not 0.0"),
        (GOOD, GOOD, {"tolerance": -1e-3}, "tolerance must be a number, 0 or more"),
        (GOOD, GOOD, {"z_um": -5}, "z_um must be a number, above 0 .um., or inf, not -5"),
        (GOOD, GOOD, {"prior": 3}, "prior must be one of tv, .* or a Prior, not 3"),
        (
            GOOD,
            GOOD,
            {"prior": LikeAPrior()},
            r"LikeAPrior, .* is none: derive .* class LikeAPrior\(db.Prior\)",
        ),
        (GOOD, GOOD, {"prior": LikeAPrior}, "LikeAPrior, which has value and prox, is none"),
        (
            GOOD,
            GOOD,
            {"prior": ValueAlone()},
            r"ValueAlone, which has value alone, is none: .*\(db.Prior\) with value and prox",
        ),
        ("photo.tif", GOOD, {}, r"must be an array, .* not 'photo.tif'\. db.read reads a file"),
        (None, GOOD, {}, r"must be an array, .* not None\.$"),
        (GOOD, GOOD, {"field": "half"}, "field must be one of sensor, full, not 'half'"),
        (np.ones((1, 1)), np.ones((1, 1)), {}, "constant"),
    ],
)
def test_unusable_input_is_refused_in_words(measurement, psf, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(measurement, psf, **options)


def test_a_depth_is_chosen_where_there_are_several_and_all_are_taken_where_none_is_asked_for():
    psfs = np.stack([GOOD, GOOD]).astype(np.float32)[:, None]
    calibration = Calibration(psfs, np.array([[0, 0, 1e4], [0, 0, 2e4]]))
    volume = reconstruct(GOOD, calibration, iterations=1)
    assert volume.volume.shape == (2, 12, 14)
    assert not volume.is_picture
    with pytest.raises(ValueError, match="volume of 2 planes"):
        assert volume.image.any()
    nearest = reconstruct(GOOD, calibration, z_um=1.1e4, iterations=1)
    assert nearest.image.shape == (12, 14)
    assert "not refocused to 11 mm: the diffuser's distance" in " ".join(nearest.warnings)
    with pytest.raises(InputError, match=r"one depth, 10 mm, .* cannot be brought to 11 mm"):
        reconstruct(GOOD, calibration.part([0]), z_um=1.1e4)
    with pytest.raises(InputError, match="above 0"):
        reconstruct(GOOD, calibration, z_um=0)
    unknown = Calibration(psfs, np.full((2, 3), np.nan))
    with pytest.raises(InputError, match=r"depths .* not known"):
        reconstruct(GOOD, unknown, z_um=1e4)


def test_saturated_images_are_warned_of(shot):
    psf = np.minimum(shot.psf, np.percentile(shot.psf, 99))
    measurement = np.minimum(shot.measurement, np.percentile(shot.measurement, 95))
    text = " ".join(reconstruct(measurement, psf, iterations=1).warnings)
    assert "The PSF looks saturated: 1.0" in text
    assert "The measurement's channel 0 looks saturated: 5.0" in text
    assert reconstruct_and_judge(shot.measurement, shot.psf, iterations=1).warnings == ()
    photons = np.random.default_rng(0).poisson(2 * shot.measurement / shot.measurement.max())
    assert (
        reconstruct_and_judge(photons, shot.psf, iterations=1).warnings == ()
    )  # the brightest count of few is shared


def test_tiny_measurements_work():
    for shape in ((2, 2), (1, 5), (3, 2)):
        psf = np.zeros(shape)
        psf[-1, -1] = 1
        result = reconstruct(np.ones(shape), psf, iterations=5)
        assert result.image.shape == shape
        assert np.isfinite(result.image).all()


def test_a_dark_measurement_gives_a_dark_picture():
    result = reconstruct(np.zeros((12, 14)), GOOD)
    assert not result.image.any()
    assert any("channel 0 is constant (0 everywhere)" in text for text in result.warnings)


def test_what_is_no_solver_any_more_says_what_replaces_it(shot):
    with pytest.raises(InputError, match="device='gpu'"):
        reconstruct(shot.measurement, shot.psf, solver="admm-gpu")


@pytest.mark.parametrize("prior", ["none", "nonnegative"])
def test_bounds_have_no_weight(shot, prior):
    assert reconstruct(shot.measurement, shot.psf, prior=prior, iterations=2).tau is None
    with pytest.raises(InputError, match="has no weight"):
        reconstruct(shot.measurement, shot.psf, prior=prior, iterations=2, tau=0.01)
