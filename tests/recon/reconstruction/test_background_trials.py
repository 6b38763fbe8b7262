"""A trial of a background, and a channel on few pixels: what is asked of which solver, in which units."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon.base.blocks import block_mean
from recon.reconstruction import background as module
from recon.reconstruction.background import (
    ITERATIONS,
    LIT_PICTURE,
    PLAIN_ITERATIONS,
    POINTS,
    VOLUME,
    Taken,
    Trial,
    _tried,
    trial_of,
)
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.mending import restored_light
from recon.reconstruction.mending.restored_light import _left2, _small
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.types import Calibration

RNG = np.random.default_rng(3)
VALID = RNG.random((6, 8)) > 0.2


@dataclass(frozen=True)
class Coarse:
    """What is held of a problem on few pixels."""

    noise: np.ndarray
    smooth: bool = False
    is_plain: bool = True


def tried(
    monkeypatch: pytest.MonkeyPatch,
    *,
    levels: tuple[float, float] = (2.0, 0.5),
    expects: bool = False,
    planes: int = 1,
    prior: str = "tv",
    is_plain: bool = True,
    whole: bool = True,
    errors: tuple[float, float] = (3.0, 2.0),
) -> tuple[Trial, list[dict[str, Any]]]:
    """Return the trial of a problem of data 4 (in its noise of 2), and what its two passes were asked.

    ``levels``: of the background, and its least.
    """
    problem: Any = SimpleNamespace(
        valid=VALID[None],
        data=np.where(VALID, 4.0, 99.0)[None],
        noise=np.array([2.0]),
        window=(slice(1, 5), slice(2, 7)),
        n_planes=planes,
        prior_name=prior,
    )
    passes: list[dict[str, Any]] = []

    def pilot(coarse: Coarse, iterations: int, **asked: Any) -> SimpleNamespace:
        passes.append({"smooth": coarse.smooth, "iterations": iterations, **asked})
        most, least = levels
        image = np.where(VALID, most, 77.0)
        image[tuple(np.argwhere(VALID)[0])] = least
        solution = np.full((1, planes, 6, 8), 9.0)
        solution[0, :, 1:5, 2:7] = 0.0
        solution[0, :, 1:2, 2:7], solution[0, :, 2:3, 2:7] = 3.0, 0.3
        return SimpleNamespace(
            background=image[None], solution=solution, left="lit" if coarse.smooth else "plain", weight=0.25
        )

    told = {"lit": errors[1], "plain": errors[0]}
    monkeypatch.setattr(
        module, "held_out", lambda _: (Coarse(np.array([0.5]), is_plain=is_plain), told.__getitem__)
    )
    monkeypatch.setattr(module, "pilot", pilot)
    monkeypatch.setattr(module, "expects_background", lambda _: expects)
    return _tried(problem, whole=whole), passes


def test_a_trial_tells_light_and_darkness_of_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the noise of few pixels, 0.5 beside 2: data of 4 are 16 there."""
    found, passes = tried(monkeypatch, levels=(2.0, 2.0))
    assert found.light == pytest.approx(2 / 16)
    assert found.dark == pytest.approx(0.75), "of the scene opposite to the sensor"
    assert (found.without, found.lit) == (3, 2)
    assert (found.taken, found.picture, found.least, found.dim) == (POINTS, True, 0, False)
    assert passes == [
        {"smooth": True, "iterations": ITERATIONS, "solver": "admm"},
        {"smooth": False, "iterations": PLAIN_ITERATIONS, "weight": 0.25, "solver": "admm", "enough": None},
    ]
    _, passes = tried(monkeypatch, is_plain=False)
    assert passes[1]["iterations"] == ITERATIONS


@pytest.mark.parametrize(
    ("planes", "prior", "expects", "taken"),
    [
        (1, "tv", True, LIT_PICTURE),
        (1, "tv", False, POINTS),
        (2, "tv", True, VOLUME),
        (2, "l1", False, POINTS),
        (1, "l1", False, POINTS),
    ],
)
def test_what_is_reconstructed_says_what_a_trial_proves(
    planes: int, prior: str, expects: bool, taken: Taken, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = tried(monkeypatch, planes=planes, prior=prior, expects=expects)
    assert (found.taken, found.picture) == (taken, planes == 1)


def test_only_an_expected_background_is_held_to_be_light_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    assert tried(monkeypatch, levels=(2.0, -4.0), expects=True)[0].least == pytest.approx(-4 / 16)
    assert tried(monkeypatch, levels=(2.0, 4.0), expects=True)[0].least == 0
    assert tried(monkeypatch, levels=(2.0, -4.0))[0].least == 0
    assert tried(monkeypatch, levels=(2.0, -4.0), expects=True, planes=2)[0].least == 0


def test_the_pass_without_a_background_ends_where_half_of_what_is_asked_is_not_to_be_had(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for without, ends in ((2.0, True), (2.05, True), (2.1, False), (3.5, False)):  # two units
        trial, passes = tried(monkeypatch, whole=False, levels=(0.2, 0.2), errors=(without, 1.5))
        assert passes[1]["enough"]("plain") == ends == (not trial.asks(0.5))


@pytest.mark.parametrize(
    ("without", "lit2", "asks"), [(2.0, 3.65, False), (2.0, 3.55, True), (0.5, 0.22, True)]
)
def test_a_background_that_is_light_is_asked_for_where_the_mean_square_error_falls_by_a_tenth(
    without: float, lit2: float, *, asks: bool
) -> None:
    assert Trial(without, lit2**0.5, 0.1, 0.0, VOLUME).asks() is asks


@pytest.mark.parametrize("n_channels", [1, 2])
def test_channels_are_judged_together_and_then_tried_to_the_end(
    n_channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def one(channel: float, *, whole: bool) -> Trial:
        asked.append(whole)
        return Trial(
            channel, channel / 2, 0.1 * channel, 0.2 * channel, LIT_PICTURE, least=-channel, picture=True
        )

    monkeypatch.setattr(module, "_tried", one)
    channels: Any = [1.0, 7.0][:n_channels]
    found = trial_of(channels)
    assert asked == [n_channels > 1] * n_channels
    rms, mean = (1.0, 1.0) if n_channels == 1 else (5.0, 4.0)
    assert (found.without, found.lit) == (pytest.approx(rms), pytest.approx(rms / 2))
    assert (found.light, found.dark, found.least) == pytest.approx((0.1 * mean, 0.2 * mean, -mean))
    assert (found.taken, found.picture) == (LIT_PICTURE, True)
    asked.clear()
    trial_of(channels, whole=True)
    assert asked == [True] * n_channels


@pytest.mark.parametrize(("of_psf", "channels"), [(1, 3), (2, 2), (3, 3)])
def test_a_channel_on_few_pixels_has_its_own_counts_and_psf(of_psf: int, channels: int) -> None:
    image = np.array([1, 5, 9]) + np.array([0.1, 0.2, 0.4]) * RNG.normal(size=(40, 48, 3))
    image = image[..., :channels].astype(np.float32)
    psfs = RNG.random((1, of_psf, 40, 48)).astype(np.float32) ** 8
    calibration = Calibration(psfs, np.full((1, 3), np.nan), background=np.ones((of_psf, 40, 48), np.float32))
    erased = np.zeros((40, 48), bool)
    erased[4:6, 6:8] = True
    measurement = Measurement(image, background=0.0, erasures=erased)
    problem = Problem.of(measurement, calibration, ReconstructionOptions())
    small = _small(problem, 1, 2)
    assert small.data.shape == (1, 20, 24)
    seen = small.valid[0]
    assert list(np.argwhere(~seen)[0]) == [2, 3]
    assert np.count_nonzero(~seen) == 1
    counts = small.data[0] * small.noise[0]
    np.testing.assert_allclose(counts[seen], block_mean(image[..., 1], 2)[seen], rtol=1e-4)
    expected = block_mean(psfs[0, min(1, of_psf - 1)], 2)
    found = small.calibration.psfs
    assert found.shape == (1, 1, 20, 24)
    np.testing.assert_allclose(found[0, 0] / found.sum(), expected / expected.sum(), rtol=1e-4)
    assert small.calibration.background is None
    assert (small.options.model, small.options.estimate_background) == ("convolution", False)


def test_erased_pixels_are_nothing_with_an_offset_and_are_not_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[np.ndarray] = []

    def pilot(channel: Coarse, _iterations: int) -> SimpleNamespace:
        given.append(channel.data)  # type: ignore[attr-defined]
        return SimpleNamespace(left=np.where(VALID, 3.0, 99.0)[None])

    @dataclass(frozen=True)
    class Channel:
        data: np.ndarray
        valid: np.ndarray

    monkeypatch.setattr(restored_light, "pilot", pilot)
    channel: Any = Channel(np.full((1, 6, 8), 2.0, np.float32), VALID[None])
    assert _left2(channel, 1.5) == pytest.approx(9)
    np.testing.assert_array_equal(given[0][0], np.where(VALID, 3.5, 0))
