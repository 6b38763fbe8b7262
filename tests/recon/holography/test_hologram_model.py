"""The hologram model against plain NumPy, and its gradient against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.threads import get_threads, set_threads
from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    HologramOptions,
    Target,
    foveal_weights,
    painted_weights,
    random_mask,
)
from recon.holography.scores import intensity, judge, low_pass, seen_image
from recon.holography.target import weights_on

RNG = np.random.default_rng(7)


def make_display(shape=(12, 16), k=2, **options):
    return Display(shape, random_mask((shape[0] * k, shape[1] * k), seed=3), **options)


def random_field(frames, shape):
    return RNG.normal(size=(frames, *shape)) + 1j * RNG.normal(size=(frames, *shape))


@pytest.mark.parametrize("grid", ["alias-free", "dissertation"])
@pytest.mark.parametrize("kind", ["none", "frequency", "spatial"])
@pytest.mark.parametrize("everything", [False, True])
def test_gradient_agrees_with_finite_differences(grid, kind, everything):
    options, planes, frames = {}, [0.0], 1
    if everything:
        options = {"dc": DcTerm(0.1, 0.7), "mask_fill": 0.9, "displacement": RNG.normal(0, 1.5, (3, 4, 2))}
        planes, frames = [0.0, 40.0], 2
    display = make_display(**options)
    targets = [Target(RNG.random((24, 32)), z) for z in planes]
    weights = foveal_weights((20, 20)) if kind == "spatial" else None
    options = HologramOptions(loss=kind, weights=weights, grid=grid, frames=frames)
    model = HologramModel(display, targets, options, dtype=np.complex128)
    at, change = random_field(frames, (12, 16)), random_field(frames, (12, 16))
    h = 1e-5
    numeric = (model.evaluate(at + h * change).loss - model.evaluate(at - h * change).loss) / (2 * h)
    analytic = 2 * np.real(np.vdot(model.evaluate(at).gradient, change))
    assert analytic == pytest.approx(numeric, rel=1e-6)


def test_seen_image_agrees_with_plain_numpy_on_both_grids():
    display = make_display((16, 20), 2, dc=DcTerm(0.2, 1.0), mask_fill=1.0)
    slm = np.exp(1j * RNG.uniform(0, 6, (2, 16, 20)))
    target = Target(RNG.random(display.mask.shape), 30.0)
    for grid, padding, tolerance in (("dissertation", 1, 1e-9), ("alias-free", 2, 5e-3)):
        model = HologramModel(display, [target], grid=grid, frames=2, dtype=np.complex128)
        plain = low_pass(intensity(slm, display, z_mm=30.0, padding=padding), display.slm_shape)
        ours = np.fft.ifftshift(model.seen(slm))
        lags = np.fft.rfft2(ours) / ours.size, np.fft.rfft2(plain) / plain.size
        n = 8
        scale = abs(lags[1][0, 0])
        assert np.abs(lags[0][:n, :n] - lags[1][:n, :n]).max() < tolerance * scale


def test_judge_does_not_depend_on_its_padding_but_the_dissertations_grid_aliases():
    display = make_display((16, 20), 2)
    slm = np.exp(1j * RNG.uniform(0, 6, (1, 16, 20)))
    once, twice, thrice = (seen_image(slm, display, padding=p) for p in (1, 2, 3))
    np.testing.assert_allclose(twice, thrice, rtol=1e-9, atol=1e-9)
    assert np.abs(once - twice).std() > 0.05 * twice.std()


def test_model_psnr_is_the_judges():
    display = make_display((24, 24), 2)
    slm = np.exp(1j * RNG.uniform(0, 6, (1, 24, 24)))
    target = Target(RNG.random(display.mask.shape))
    model = HologramModel(display, [target])
    assert model.evaluate(slm).seen_psnr_db == pytest.approx(judge(slm, display, target).psnr_db, abs=0.1)


def test_shifting_the_mask_by_whole_slm_pixels_is_shifting_the_slm():
    k = 3
    display = make_display((12, 16), k)
    shifted = make_display((12, 16), k, displacement=np.broadcast_to([k * 2.0, -k * 1.0], (2, 2, 2)).copy())
    slm = np.zeros((1, 12, 16), complex)
    slm[0, 4:8, 4:9] = random_field(1, (4, 5))[0]
    target = [Target(RNG.random((36, 48)))]
    moved = np.roll(slm, (-2, 1), axis=(1, 2))
    seen = (12 - 2) * (16 - 1) / (12 * 16)  # the part of the mask that still sees the SLM
    np.testing.assert_allclose(
        HologramModel(shifted, target, dtype=np.complex128).seen(slm) * seen,
        HologramModel(display, target, dtype=np.complex128).seen(moved),
        atol=1e-10,
    )


def test_half_a_pixel_of_displacement_mixes_neighbours_by_area():
    k = 2
    display = make_display((8, 8), k, displacement=np.broadcast_to([0.0, 0.5], (2, 2, 2)).copy())
    slm = np.zeros((1, 8, 8), complex)
    slm[0, 4, 4] = 1.0
    model = HologramModel(display, [Target(np.ones((16, 16)))], dtype=np.complex128)
    # SLM pixel 4 covers mask pixels 8 and 9; seen half a pixel further, cell 7 has half of it, 8 all, 9 half.
    covered = np.zeros((16, 16))
    covered[8:10, 7], covered[8:10, 8], covered[8:10, 9] = 0.5, 1.0, 0.5
    field = covered * display.mask.field()
    # Mean light of random phases: every other column is mixed from two, half of the last one sees nothing.
    power = (8 * 1.0 + 7 * 0.5 + 0.25) / 16
    plain = np.abs(np.fft.fft2(field, model.band.shape)) ** 2 / field.size / power
    np.testing.assert_allclose(model.intensity(slm), np.fft.fftshift(plain), atol=1e-12)


def test_results_do_not_depend_on_the_number_of_threads():
    display = make_display((80, 64), 2, displacement=RNG.normal(0, 1.0, (3, 3, 2)))
    slm = random_field(1, (80, 64)).astype(np.complex64)
    model = HologramModel(display, [Target(RNG.random((160, 128)))])
    before = get_threads()
    try:
        results = []
        for threads in (1, 3):
            set_threads(threads)
            results.append(model.evaluate(slm))
    finally:
        set_threads(before)
    assert results[0].loss == results[1].loss
    np.testing.assert_array_equal(results[0].gradient, results[1].gradient)


@pytest.mark.parametrize("loss", ["frequency", "spatial"])
def test_work_arrays_are_allocated_once_and_counted(loss):
    import tracemalloc

    display = make_display((90, 160), 2)
    slm = np.exp(1j * RNG.uniform(0, 6, (1, 90, 160))).astype(np.complex64)
    target = [Target(RNG.random((180, 320)))]
    model = HologramModel(display, target, loss=loss)
    model.evaluate(slm)
    tracemalloc.start()
    model.evaluate(slm)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.15 * model.nbytes


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Display((10, 10), random_mask((25, 25))), "whole number"),
        (lambda: Display((10, 10), random_mask((20, 30))), "same along both"),
        (lambda: Target(np.zeros((10, 10))), "black"),
        (lambda: Target(np.full((10, 10), np.nan)), "finite"),
        (lambda: HologramOptions(weights=np.ones((8, 8))), "Weights need a loss that takes them"),
        (lambda: make_display().defocus(1e5), "too far"),
        (lambda: DcTerm(1.0), "0 to 1"),
        (lambda: HologramModel(make_display(), []), "at least one target"),
    ],
)
def test_impossible_requests_are_refused_in_words(make, words):
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.parametrize("n", [20, 21])
def test_a_fovea_in_the_middle_lies_around_the_axis(n: int) -> None:
    weights = foveal_weights((n, n)), painted_weights((n, n), [(0.5, 0.5, 0.3, 1.0)])
    for asked in (weights_on(one, (30, 30)) for one in weights):
        assert np.ptp(asked) > 0.8
        across = asked[0, 1:]  # in FFT order: the axis first
        np.testing.assert_allclose(across, across[::-1], atol=1e-12)


def test_painted_weights_are_the_brush_where_it_went_and_background_elsewhere():
    strokes = [(0.25, 0.5, 0.1, 1.0), (0.75, 0.5, 0.1, 0.5), (0.75, 0.5, 0.04, 0.0)]
    weights = painted_weights((64, 96), strokes, background=0.2)
    assert weights[16, 48] == 1.0
    assert weights[48, 48] == pytest.approx(0.0)
    assert weights[48, 53] == pytest.approx(0.5)
    assert weights[32, 4] == 0.2
    assert weights.min() >= 0
    with pytest.raises(InputError, match="0 to 1"):
        painted_weights((8, 8), [(0.5, 0.5, 0.1, 2.0)])
    with pytest.raises(InputError, match="radius"):
        painted_weights((8, 8), [(0.5, 0.5, 0.0, 1.0)])
