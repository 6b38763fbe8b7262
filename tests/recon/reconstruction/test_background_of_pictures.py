"""Stray light in pictures through one PSF: found, taken for what it is, and not looked for in vain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon import reconstruct
from recon.base.blocks import block_mean
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.evaluation.scene import Family, TestScene, make_scene
from recon.reconstruction import selection
from recon.reconstruction.background import (
    DARKEST,
    DARKEST_PERCENTILE,
    GAIN,
    LIT_PICTURE,
    VOLUME,
    Trial,
    floor,
    trial_of,
)
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.reconstruction.residual import background_in_words, beyond_in_words
from recon.verdict.judge import Region

measured = pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the measured hand is not in {data_folder()}"
)


def lit(stray: float) -> TestScene:
    return make_scene("sparse-picture", size=40, background=stray, photons=3000.0, seed=4)


@pytest.mark.parametrize("array", [True, False])
def test_stray_light_is_found_through_one_psf(array: bool) -> None:
    scene = lit(2.0)
    psf: Any = scene.calibration.psfs[0, 0] if array else scene.calibration
    found = reconstruct(scene.measurement, psf, prior="l1", iterations=40, judged=False)
    assert found.background is not None
    assert found.background.mean() == pytest.approx(scene.background.mean(), rel=0.15)
    told = " ".join(found.warnings) if found.choice is None else " ".join(found.choice.lines())
    assert "held-out pixels" in told


def test_without_room_for_stray_light_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(_: object) -> None:
        raise AssertionError("a trial was made")

    monkeypatch.setattr(selection, "trial_of", never)
    scene = lit(0.0)
    image = scene.measurement - np.percentile(scene.measurement, 10)
    assert reconstruct(image, scene.calibration.psfs[0, 0], iterations=5, judged=False).background is None


def test_no_channels_pass_ends_early_where_several_are_judged_together() -> None:
    scene = make_scene("texture", size=32, photons=3000.0, seed=4)
    options = ReconstructionOptions(z_um=float(scene.z_um[0]))
    one = Problem.of(Measurement(scene.measurement), scene.calibration, options)
    alone, wholly = trial_of([one]), trial_of([one], whole=True)
    assert alone.without > wholly.without  # a bound: nothing was left to decide
    assert trial_of([one, one]).without == pytest.approx(wholly.without)


@pytest.mark.parametrize(
    ("family", "stray", "found"), [("sparse-picture", 0.6, True), ("texture", 0.0, False)]
)
def test_moderate_stray_light_is_told_from_a_scene_that_is_lit(
    family: Family, stray: float, found: bool
) -> None:
    scene = make_scene(family, size=40, background=stray, photons=3000.0, seed=4)
    options = ReconstructionOptions(z_um=float(scene.z_um[0]))
    problem = Problem.of(Measurement(scene.measurement), scene.calibration, options)
    choice = selection.choice_for(problem)
    assert choice.background == found
    (why,) = (d.why for d in choice.decisions if d.name == "background")
    assert ("dark under it" if found else "too little for one") in why


def test_total_variation_leaves_even_light_to_the_background() -> None:
    scene = lit(1.0)
    found = reconstruct(scene.measurement, scene.calibration, estimate_background=True, judged=False)
    assert found.background is not None
    assert 0.6 < found.background.mean() / scene.background.mean() < 1.1


def test_a_dark_frame_does_not_settle_the_background_of_later_ones() -> None:
    scene = lit(1.0)
    dark = np.random.default_rng(0).normal(0, 0.3, scene.measurement.shape)
    options = ReconstructionOptions(estimate_background=True, model="convolution")
    problem = Problem.of(Measurement(dark, noise=1.0), scene.calibration, options)
    part = Part(problem, slice(0, 1))
    assert part.removal is not None
    before = part.removal.restraint
    part.set_data(problem.with_data(scene.measurement))
    assert part.removal.restraint < 0.1 * before
    assert part.removal.taken > 0.9


def test_a_background_below_zero_is_said() -> None:
    scene = lit(0.0)
    problem = Problem.of(Measurement(scene.measurement), scene.calibration)
    mean = problem.data.mean()
    assert background_in_words(problem, np.full(problem.data.shape, -0.1 * mean)) == []
    (text,) = background_in_words(problem, np.full(problem.data.shape, -0.8 * mean))
    assert "-0.80 of the data's light" in text


def test_light_is_counted_beside_its_own_channels() -> None:
    scene = lit(0.0)
    red = scene.measurement[..., None]
    problem = Problem.of(np.concatenate([red, 0.1 * red], axis=-1), scene.calibration)
    faint = problem.data[1:]
    (text,) = background_in_words(problem, -0.8 * faint, slice(1, 2))
    assert "-0.80 of the data's light" in text
    (text,) = beyond_in_words(problem, 0.3 * faint, slice(1, 2))
    assert text.startswith("30% of the light")


def test_held_out_pixels_prove_no_stray_light_where_the_darkest_have_none():
    # As measured of a photograph whose darkest hundredth has 0.02 of the mean: a background cost it 4.2 dB.
    trial = Trial(without=1.28, lit=0.98, light=0.27, dark=0.65, taken=LIT_PICTURE)
    assert trial.helps
    assert not replace(trial, dim=True).helps
    assert replace(trial, dim=True, dark=0.7).helps, "a dark scene under even light"
    assert not replace(trial, least=-0.1).helps, "light is nowhere negative"
    assert not replace(trial, dark=0.7, least=-0.1).helps
    black = np.full((20, 20), 1.0)
    black[:3] = 0.02
    assert floor(black, DARKEST_PERCENTILE) < DARKEST < floor(black + 0.1, DARKEST_PERCENTILE)


def test_a_background_that_is_no_light_explains_most_of_what_nothing_else_does():
    # As of a film of an animal, which lost its cells in haze by it, and of the measured USAF target.
    film = Trial(without=5.5, lit=5.1, light=-0.43, dark=0.94, taken=LIT_PICTURE)
    usaf = Trial(without=7.5, lit=1.4, light=-0.3, dark=0.95, taken=VOLUME)
    assert film.without**2 - film.lit**2 > GAIN
    assert not film.helps
    assert not film.explains
    assert usaf.helps
    assert usaf.explains


@pytest.mark.parametrize(
    ("light", "least", "picture", "asked"),
    [
        (-0.07, -0.9, True, False),  # what a PSF cut to a circle lacks
        (0.18, -0.25, True, False),  # a photograph less a tenth of its mean
        (0.18, -0.1, True, True),
        (-0.3, -0.9, False, True),  # a volume's, of light from beyond its depths
    ],
)
def test_what_a_background_below_zero_explains_by_half_is_no_light(
    light: float, least: float, picture: bool, asked: bool
) -> None:
    trial = Trial(5.9, 1.7, light, 0.3, LIT_PICTURE if picture else VOLUME, least=least, picture=picture)
    assert trial.asks() is asked
    assert replace(trial, without=22.0).asks()  # hardly anything is left: a PSF over light of the room


@measured
def test_a_psf_cut_to_a_circle_is_no_reason_for_a_background() -> None:
    psfs, photograph = measured_set("hand")
    psf, image = block_mean(psfs[0], 8), block_mean(photograph, 8)
    image = image + np.float32(0.02 * image.mean())  # of a dark level: else nobody looks
    y, x = (np.arange(n) - n / 2 for n in psf.shape)
    cut = np.where(y[:, None] ** 2 + x**2 < (0.45 * len(y)) ** 2, psf, 0).astype(np.float32)
    assert reconstruct(image, cut, iterations=5, judged=False).background is None


@measured
def test_the_hand_through_a_psf_on_a_hill_of_light_is_not_reliable() -> None:
    psfs, photograph = measured_set("hand")
    psf, seen = block_mean(psfs[0], 16), block_mean(photograph, 16)
    y, x = (np.linspace(-1, 1, n) for n in psf.shape)
    hill = 0.3 * psf.max() * np.exp(-(y[:, None] ** 2) - x**2)
    verdict = reconstruct(seen, psf + hill.astype(np.float32)).verdict
    assert verdict is not None
    assert verdict.region is not Region.INSIDE
