"""A learned display: its model's gradient, what is found again of known errors, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import DcTerm, Display, HologramModel, Target, compute_hologram, random_mask
from recon.holography.learn import Look, learn_display
from recon.holography.learned import Learned

SHAPE, K = (24, 32), 2
PLAIN = Display(
    SHAPE,
    random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=3),
    dc=DcTerm(0.1, 0.6),
    mask_fill=1.0,
    displacement=np.zeros((13, 23, 2)),
)
Y, X = np.mgrid[:64, :64]
TARGET = Target(np.where((Y - 25) ** 2 + (X - 36) ** 2 < 250, 1.0, 0.3), white=1.0)


def wrong(crosstalk_px: float = 0.2, phase: float = 0.3) -> Display:
    """Return a display with all kinds of errors."""
    nothing = Learned.nothing(PLAIN)
    level = np.linspace(0, 1, len(nothing.response))
    response = 0.9 * (1 - 0.2 * np.sin(np.pi * level) ** 2) * np.exp(0.3j * level)
    rng = np.random.default_rng(5)
    learned = Learned(
        np.stack([response.real, response.imag], axis=-1),
        np.array([0.35, 0.1]),
        np.array([crosstalk_px, 0.8 * crosstalk_px]),
        0.1 * rng.normal(size=nothing.amplitude.size),
        phase * rng.normal(size=nothing.phase.size),
        np.array([[0.0, -0.2, 0, 0], [0.05, -0.15, 0, 0]]),
        0.93,
    )
    nodes = np.zeros((13, 23, 2))
    nodes[..., 0] = 0.3 * np.linspace(-1, 1, 23)
    return replace(PLAIN, displacement=nodes).taught(learned)


def looks_of(display: Display, count: int, noise: float = 0.01) -> list[Look]:
    rng = np.random.default_rng(1)
    model = HologramModel(display, [TARGET])
    looks = []
    for _ in range(count):
        slm = np.exp(1j * rng.uniform(0, 2 * np.pi, SHAPE)).astype(np.complex64)
        lags = model.lags(slm[None])
        level = noise * np.sqrt(np.mean(np.abs(lags[1:]) ** 2))
        looks.append(Look(slm, 3.0 * (lags + level * (rng.normal(size=(2, *lags.shape)).T @ [1, 1j]).T)))
    return looks


@pytest.mark.parametrize("crosstalk_px", [0.0, 0.2])
def test_the_gradient_is_that_of_differences(crosstalk_px):
    model = HologramModel(wrong(crosstalk_px), [TARGET], dtype=np.complex128, frames=2)
    phases = np.random.default_rng(2).uniform(0.1, 6.0, (2, *SHAPE))
    gradient = 2 * (model.evaluate(np.exp(1j * phases)).gradient * np.exp(-1j * phases)).imag
    for at in ((0, 0, 0), (0, 11, 17), (1, 23, 31), (1, 5, 9)):
        losses = []
        for step in (1e-5, -1e-5):
            moved = phases.copy()
            moved[at] += step
            losses.append(model.evaluate(np.exp(1j * moved)).loss)
        assert gradient[at] == pytest.approx((losses[0] - losses[1]) / 2e-5, rel=2e-3, abs=1e-9)


def test_errors_are_found_again_and_holograms_are_better_for_it():
    true = wrong()
    lesson = learn_display(PLAIN, looks_of(true, 7))
    assert lesson.helps
    assert lesson.before > 0.5
    assert lesson.after < 0.06
    assert lesson.display.learned is not None
    assert lesson.display.learned.crosstalk_px == pytest.approx([0.2, 0.16], abs=0.03)
    shown = []
    eye = HologramModel(true, [TARGET])
    for display in (PLAIN, lesson.display):
        found = compute_hologram(HologramModel(display, [TARGET]), iterations=60)
        shown.append(eye.evaluate(found.slm).seen_psnr_db)
    assert shown[1] > shown[0] + 3


def test_a_display_that_is_as_described_loses_nothing_and_another_mask_is_refused():
    lesson = learn_display(PLAIN, looks_of(PLAIN, 5, noise=0.05))
    assert not lesson.helps
    assert lesson.display is PLAIN
    other = replace(PLAIN, mask=random_mask(PLAIN.mask.shape, seed=8))
    with pytest.raises(InputError, match="not this display's"):
        learn_display(PLAIN, looks_of(other, 5))
    with pytest.raises(InputError, match="At least 5 photographs"):
        learn_display(PLAIN, looks_of(PLAIN, 4))
