"""Optimisers: the plain one as reference, reproducible, ended by what was asked for."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    HologramOptions,
    HologramStop,
    Target,
    compute_hologram,
    foveal_weights,
    judge,
    random_mask,
)
from recon.holography.display import no_mask
from recon.holography.variables import Bounded

SHAPE, K = (48, 64), 2


def picture(shape=(SHAPE[0] * K, SHAPE[1] * K)):
    """Smooth shapes and edges between 0 and 1."""
    y, x = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j]
    image = 0.5 + 0.3 * np.sin(7 * x + 3 * y)
    image[(y - 0.6) ** 2 + (x - 0.4) ** 2 < 0.04] = 0.9
    image[(abs(y - 0.3) < 0.1) & (abs(x - 0.7) < 0.2)] = 0.15
    return image


def make_model(loss=None, *, display=None, frames=1, grid="alias-free", image=None):
    display = display or Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1))
    target = Target(picture() if image is None else image)
    return HologramModel(display, [target], frames=frames, grid=grid, **(loss or {}))


def test_one_step_is_the_phase_of_the_back_propagated_target():
    model = make_model(grid="dissertation")
    found = compute_hologram(model, method="one-step", seed=5)
    rng = np.random.default_rng(5)
    image = np.fft.ifftshift(picture())
    field = np.sqrt(image) * np.exp(1j * rng.uniform(0, 2 * np.pi, image.shape))
    back = np.fft.ifft2(field) * np.conj(model.display.mask.field())
    binned = back.reshape(SHAPE[0], K, SHAPE[1], K).sum(axis=(1, 3))
    np.testing.assert_allclose(found.slm[0], np.exp(1j * np.angle(binned)), atol=2e-3)
    assert found.stop_reason is HologramStop.ONE_STEP


def test_lbfgs_gets_further_than_the_projected_gradient_in_as_many_iterations():
    model = make_model()
    quick = compute_hologram(model, iterations=40)
    plain = compute_hologram(model, method="nesterov", iterations=40)
    baseline = compute_hologram(model, method="one-step")
    assert quick.history[-1].loss < plain.history[-1].loss < 0.2 * baseline.history[-1].loss
    for found in (quick, plain):
        np.testing.assert_allclose(np.abs(found.slm), 1, atol=1e-5)


def test_each_loss_wins_where_it_counts():
    """The order of Table 7.1, judged apart from the model: whole field, then crop."""
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1))
    weights = foveal_weights((64, 64), radius=0.3, periphery=0.05)
    scores = {
        "one-step": judge(compute_hologram(make_model(), method="one-step").slm, display, Target(picture()))
    }
    for loss in ({"loss": "none"}, {"loss": "frequency"}, {"loss": "spatial", "weights": weights}):
        scores[loss["loss"]] = judge(
            compute_hologram(make_model(loss), iterations=60).slm, display, Target(picture())
        )
    whole = {name: score.psnr_db for name, score in scores.items()}
    crop = {name: score.crop_psnr_db for name, score in scores.items()}
    assert whole["one-step"] < whole["none"] < whole["frequency"]
    assert whole["spatial"] < whole["frequency"]
    assert crop["frequency"] + 5 < crop["spatial"]


def test_alias_free_optimisation_beats_the_dissertations_grid():
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1))
    ours, theirs = (
        judge(compute_hologram(make_model(grid=grid), iterations=60).slm, display, Target(picture())).psnr_db
        for grid in ("alias-free", "dissertation")
    )
    assert ours > theirs + 6


def test_same_seed_same_hologram_other_seed_another():
    model = make_model()
    first, second, other = (compute_hologram(model, iterations=5, seed=seed).slm for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 0.1


def test_two_frames_gain_at_least_four_decibels_at_fourfold_expansion():
    one, two = (compute_hologram(make_model(frames=n), iterations=80).history[-1].psnr_db for n in (1, 2))
    assert two > one + 4


def test_a_modelled_dc_term_costs_little_and_an_ignored_one_much():
    mask = random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1)
    clean, dirty = Display(SHAPE, mask), Display(SHAPE, mask, dc=DcTerm(0.1, 0.5))
    ideal, modelled = (compute_hologram(make_model(display=d), iterations=80) for d in (clean, dirty))
    ignored = judge(ideal.slm, dirty, Target(picture())).psnr_db
    assert modelled.history[-1].psnr_db > ideal.history[-1].psnr_db - 0.7
    assert modelled.history[-1].psnr_db > ignored + 3


def test_dc_light_that_no_mask_scatters_costs_light_and_hardly_a_picture():
    """Its spot is taken away by an opposite mean, which leaves 1 - 2 p of all light."""
    clean = Display(SHAPE, no_mask(SHAPE))
    dirty = replace(clean, dc=DcTerm(0.1, 0.5))
    shown = [make_model(display=d, image=picture(SHAPE)) for d in (clean, dirty)]
    found = [compute_hologram(model, iterations=80) for model in shown]
    target = Target(picture(SHAPE))
    seen = [judge(f.slm, d, target).psnr_db for f, d in zip(found, (clean, dirty), strict=True)]
    assert seen[1] > seen[0] - 1  # 5 dB less where all of the light was asked for
    assert shown[1].efficiency(found[1].slm) == pytest.approx(0.8, abs=0.01)
    assert dirty.dimmed() == pytest.approx(0.2)
    assert dirty.dimmed(100.0) < 0.02  # out of focus there is no spot
    assert clean.dimmed() == 0
    mask = random_mask((SHAPE[0] * K, SHAPE[1] * K), design_wavelength_nm=660.0)
    scattering = Display(SHAPE, mask, dc=DcTerm(0.1, 0.5))
    assert scattering.dimmed() == 0
    blue = replace(scattering, wavelength_nm=450.0)  # of which 0.45 passes undiffracted
    assert blue.dimmed() == pytest.approx(0.2 * 0.45 / (0.45 + 0.55 / K**2), rel=0.05)


def test_a_complex_slm_beats_a_phase_slm_beside_a_dc_term_at_the_light_that_was_asked_for():
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1), dc=DcTerm(0.1, 0.6))
    target = Target(picture())
    phase = compute_hologram(make_model(display=display), iterations=60)
    for light in (0.3, 0.05):
        model = make_model({"complex_slm": True, "light": light}, display=display)
        free = compute_hologram(model, iterations=60)
        assert np.abs(free.slm).max() <= 1 + 1e-6
        gain = judge(free.slm, display, target).psnr_db - judge(phase.slm, display, target).psnr_db
        assert gain > 4
        behind = np.mean(np.abs(display.dc.modulated * free.slm + display.dc.amplitude) ** 2)
        assert model.efficiency(free.slm) == pytest.approx(behind, rel=1e-3)
        assert behind == pytest.approx(light, rel=0.05)
    plain = compute_hologram(model, iterations=30, method="nesterov")
    assert np.abs(plain.slm).max() <= 1 + 1e-6
    assert plain.history[-1].loss < 0.1 * plain.history[0].loss


def test_the_gradient_of_a_bounded_amplitude_is_its_finite_difference():
    model = HologramModel(
        Display((8, 8), random_mask((16, 16)), dc=DcTerm(0.1, 0.6)),
        [Target(np.random.default_rng(1).random((16, 16)))],
        complex_slm=True,
        light=0.6,
        dtype=np.complex128,
    )
    variable = Bounded(model)
    x, step = np.random.default_rng(2).normal(0, 1.2, (2, 128))
    sides = [variable.evaluate(x + h * step)[0].loss for h in (1e-5, -1e-5)]
    assert (sides[0] - sides[1]) / 2e-5 == pytest.approx(float(variable.evaluate(x)[1] @ step), rel=1e-6)
    assert variable.field(variable.pack(variable.field(x) * 0.9)) == pytest.approx(variable.field(x) * 0.9)


def test_planes_share_the_hologram():
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=1))
    near, far = np.zeros((64, 64)) + 0.02, np.zeros((64, 64)) + 0.02
    near[10:20, 10:30], far[40:50, 35:50] = 1, 1
    targets = [Target(near, 0.0), Target(far, 400.0)]
    found = compute_hologram(HologramModel(display, targets), iterations=40)
    shown = HologramModel(display, targets)
    for plane in (0, 1):
        right = np.corrcoef(shown.seen(found.slm, plane).ravel(), shown.wanted(plane).ravel())[0, 1]
        wrong = np.corrcoef(shown.seen(found.slm, plane).ravel(), shown.wanted(1 - plane).ravel())[0, 1]
        assert right > 0.8 > 0.4 > wrong


def test_a_warm_start_saves_most_iterations_on_a_slowly_moving_image():
    before, after = picture(), np.roll(picture(), 2, axis=1)
    last = compute_hologram(make_model(image=before), iterations=60)
    warm = compute_hologram(make_model(image=after), iterations=10, initial=last.slm)
    cold = compute_hologram(make_model(image=after), iterations=30)
    assert warm.history[-1].psnr_db >= cold.history[-1].psnr_db


def test_the_budget_ends_the_run_and_says_which_part():
    model = make_model()
    assert compute_hologram(model, iterations=3).stop_reason is HologramStop.ITERATIONS
    good = compute_hologram(model, psnr_db=18.0)
    assert good.stop_reason is HologramStop.QUALITY
    assert good.history[-2].psnr_db < 18.0 <= good.history[-1].psnr_db
    assert compute_hologram(model, time_s=1e-9).stop_reason is HologramStop.TIME
    stop = threading.Event()
    cancelled = compute_hologram(model, callback=lambda record, _: stop.set(), cancel=stop)
    assert cancelled.stop_reason is HologramStop.CANCELLED
    assert cancelled.history[-1].iteration == 1
    loose = compute_hologram(model, iterations=500, tolerance=0.02)
    assert loose.stop_reason is HologramStop.CONVERGED


def test_bad_requests_are_refused_in_words():
    model = make_model()
    with pytest.raises(InputError, match="The start must be"):
        compute_hologram(model, initial=np.ones((1, 3, 3), complex))
    with pytest.raises(InputError, match="method must be one of"):
        compute_hologram(model, method="adam")
    with pytest.raises(InputError, match="takes no start"):
        compute_hologram(make_model({"complex_slm": True}), method="one-step")
    with pytest.raises(InputError, match="light is of a complex SLM"):
        HologramOptions(light=0.5)


@pytest.mark.parametrize("levels", [2, 4, 64])
def test_phases_on_levels_do_better_than_rounded_ones(levels):
    model = make_model()
    free = compute_hologram(model, iterations=60, tolerance=0)
    step = 2 * np.pi / levels
    rounded = np.exp(1j * np.rint(np.angle(free.slm) / step) * step)
    found = compute_hologram(model, iterations=60, tolerance=0, phase_levels=levels)
    phase = np.angle(found.slm) / step
    np.testing.assert_allclose(phase, np.rint(phase), atol=1e-4)
    assert found.history[-1].iteration == 60
    reached = model.evaluate(found.slm).seen_psnr_db
    assert found.history[-1].psnr_db == pytest.approx(reached, abs=1e-3)
    gain = reached - model.evaluate(rounded).seen_psnr_db
    assert gain > (0.4 if levels < 32 else -0.01)


def test_levels_need_the_phase_and_lbfgs():
    for options, words in (
        ({"method": "nesterov"}, "need the method 'lbfgs'"),
        ({"phase_levels": 1}, "phase_levels must be a whole number, 2 or more"),
    ):
        with pytest.raises(InputError, match=words):
            compute_hologram(make_model(), **{"phase_levels": 4, **options})
    with pytest.raises(InputError, match="Phase levels are of a phase SLM"):
        compute_hologram(make_model({"complex_slm": True}), phase_levels=4)


def test_what_made_the_model_is_not_overridden_by_the_search():
    with pytest.raises(InputError, match="loss, frames: this is the model's"):
        compute_hologram(make_model(), loss="none", frames=2)


def test_what_a_callback_keeps_stays_as_it_was():
    kept = []
    model = make_model({"complex_slm": True})
    compute_hologram(model, iterations=3, callback=lambda _, s: kept.append(s))
    assert np.abs(kept[0] - kept[1]).max() > 1e-3
