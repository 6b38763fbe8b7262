"""Holograms of mirrors that send light or not: exact gradients, two states, what may not be asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import (
    Display,
    HologramModel,
    HologramOptions,
    HologramStop,
    Target,
    compute_hologram,
    judge,
    random_mask,
)
from recon.holography.display import no_mask
from recon.holography.learn import nothing_learned
from recon.holography.scores import seen_image
from recon.holography.target import FIRST_ORDER, Window
from recon.holography.variables import Mirrors, coded

SHAPE = (48, 64)
BARE = Display(SHAPE, no_mask(SHAPE))
MASKED = Display(SHAPE, random_mask((96, 128)))


def target(shape: tuple[int, int] = (96, 128)) -> Target:
    """A disc and a slope in the first order's window, on a display's own grid."""
    y, x = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j]
    image = np.where((y - 0.25) ** 2 + (x - 0.75) ** 2 < 0.015, 1.0, 0.2 + 0.5 * y)
    part = FIRST_ORDER.part(shape)
    field = np.zeros(shape)
    field[part] = image[part]
    return Target(field, white=1.0, window=FIRST_ORDER)


def test_the_gradient_is_its_finite_difference() -> None:
    options = HologramOptions(mirrors="optimised", frames=2)
    variable = Mirrors(HologramModel(MASKED, [target()], options, dtype=np.complex128))
    rng = np.random.default_rng(0)
    x = rng.uniform(0, np.pi, 2 * SHAPE[0] * SHAPE[1])
    gradient = variable.evaluate(x)[1]
    way = rng.normal(size=x.size)
    ends = [variable.evaluate(x + sign * 1e-4 * way)[0].loss for sign in (1, -1)]
    assert (ends[0] - ends[1]) / 2e-4 == pytest.approx(float(gradient @ way), rel=1e-5)


@pytest.mark.parametrize("display", [BARE, MASKED], ids=["bare", "masked"])
def test_mirrors_show_a_picture_in_two_states(display: Display) -> None:
    wanted = target(display.mask.shape)
    found = compute_hologram(HologramModel(display, [wanted], HologramOptions(mirrors="optimised")))
    assert set(np.unique(found.slm)) == {0, 1}
    optimised = judge(found.slm, display, wanted).psnr_db
    assert optimised > 22
    far = np.fft.fftshift(seen_image(found.slm, display))
    assert far.sum() < 0.6 * far.size  # half of the light, or less
    if display is MASKED:
        return
    for method, gain in (("lee", 3), ("off-axis", 3)):
        options = HologramOptions(mirrors=method)
        found = compute_hologram(HologramModel(display, [wanted], options))
        assert set(np.unique(found.slm)) == {0, 1}
        assert 10 < judge(found.slm, display, wanted).psnr_db < optimised - gain
        warm = compute_hologram(HologramModel(display, [wanted], options), initial=found.slm, iterations=1)
        assert warm.history[0].loss < 0.2 * found.history[0].loss


@pytest.mark.parametrize(("mirrors", "levels"), [("optimised", None), ("off-axis", None), (None, 4)])
def test_the_quality_asked_for_is_that_of_what_is_shown(mirrors: str | None, levels: int | None) -> None:
    wanted = target(BARE.mask.shape) if mirrors else Target(target(BARE.mask.shape).image + 0.2)
    options = HologramOptions(mirrors=mirrors, phase_levels=levels, iterations=40)
    model = HologramModel(BARE, [wanted], options)
    whole = compute_hologram(model)
    asked = whole.history[-1].psnr_db - 1.5
    found = compute_hologram(model, psnr_db=asked)
    assert found.stop_reason is HologramStop.QUALITY
    assert found.history[-1].psnr_db >= asked
    assert found.history[-1].iteration < whole.history[-1].iteration
    beyond = compute_hologram(model, psnr_db=whole.history[-1].psnr_db + 0.5)  # less than unrounded, or coded
    assert beyond.stop_reason is not HologramStop.QUALITY
    np.testing.assert_array_equal(beyond.slm, whole.slm)


def test_the_first_order_of_fringes_is_the_field_over_pi() -> None:
    y, x = np.mgrid[:512, :512] * (2 * np.pi / 512)
    amplitude = 0.3 + 0.6 * np.sin(x / 2)
    orders = np.fft.fft2(coded(amplitude * np.exp(1j * (80 * x + 71 * y + np.sin(y))))) / 512**2
    wanted = np.fft.fft2(amplitude * np.exp(1j * (80 * x + 71 * y + np.sin(y)))) / 512**2 / np.pi
    near = np.s_[66:77, 75:86]
    assert np.abs(orders[near] - wanted[near]).max() < 0.02 * np.abs(wanted).max()


@pytest.mark.parametrize(
    ("options", "display", "words"),
    [
        ({"mirrors": "lee"}, MASKED, "without one"),
        ({"mirrors": "optimised", "light": 0.2}, BARE, "at most 0.101"),
        ({"mirrors": "optimised", "complex_slm": True}, BARE, "leave --complex"),
        ({"mirrors": "optimised", "method": "one-step"}, BARE, "lbfgs"),
        ({"mirrors": "optimised", "loss": "none"}, BARE, "'frequency' and 'spatial'"),
        ({"mirrors": "optimised"}, BARE.taught(nothing_learned(BARE)), "of a phase SLM"),
    ],
)
def test_what_mirrors_cannot_do_is_refused(options, display: Display, words: str) -> None:
    with pytest.raises(InputError, match=words):
        compute_hologram(HologramModel(display, [target()], HologramOptions(**options)))


def test_planes_count_in_the_same_window() -> None:
    other = replace(target(), window=Window(0, 0, 1, 1))
    with pytest.raises(InputError, match="same part"):
        HologramModel(BARE, [target(), other])
