"""What live pictures say of noise, of light that is not there, and of a calibration that does not fit."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from recon import Calibration
from recon.base.metrics import psnr
from recon.streams.fit import NOT_JUDGED, CalibrationWatch
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import DARK, NOISE_ONLY, UNLIT, UNLIT_SO_FAR
from recon.streams.stillness import SceneState, has_light
from tests.recon.live.streams import AMPLE_MS, NOISE, SHAPE, iterated, live, photograph, spots_psf


def test_a_frame_of_noise_is_called_so_and_one_with_light_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    reconstructor = live(budget_ms=AMPLE_MS, coarsest=2)
    dark = [np.round(20 + rng.normal(0, 2, SHAPE)).astype(np.uint16) for _ in range(8)]
    for frame in dark[:4]:
        picture = reconstructor.feed(frame)
        assert picture.doubt == NOISE_ONLY
        assert picture.quality.startswith(NOISE_ONLY)
    refined = reconstructor.refine()
    assert refined is not None
    assert refined.doubt == NOISE_ONLY
    # Light on: what was settled on noise is settled anew, and the picture is that of a fresh start.
    assert not reconstructor.feed(photograph(0, 1)).doubt
    assert reconstructor._coming is not None
    reconstructor._coming.wait()
    assert not reconstructor.feed(photograph(0, 1)).doubt
    for _ in range(60):
        picture = reconstructor.refine() or picture
    fresh = live(budget_ms=AMPLE_MS, coarsest=2)
    reference = iterated(fresh, photograph(0, 1))
    for _ in range(60):
        reference = fresh.refine() or reference
    assert psnr(picture.image, reference.image) > 40
    for frame in dark[4:]:
        assert reconstructor.feed(frame).doubt == NOISE_ONLY
    reconstructor._fit._doubt = "Found when something was lit"
    black = reconstructor.feed(dark[4], lit=False)
    assert black.quality == black.doubt == DARK
    assert black.image.shape == refined.image.shape
    assert not black.image.any()
    assert reconstructor.refine() is None, "there is nothing to go on with"
    untold = reconstructor.feed(photograph(0, 1), lit=False)
    assert untold.quality == untold.doubt == UNLIT_SO_FAR, (
        "what was found of frames in another light is not said"
    )
    assert not untold.image.any()
    reconstructor._fit._not_before = 0.0  # at once
    reconstructor.feed(photograph(0, 1), lit=False)
    reconstructor._fit.wait()
    assert reconstructor.feed(photograph(0, 1), lit=False).doubt == "", "a lamp that nobody told of is seen"
    monkeypatch.setattr(CalibrationWatch, "doubt", "Any PSF would explain it as well")
    unlit = reconstructor.feed(photograph(0, 2), lit=False)  # a sensor's own pattern, say
    assert unlit.quality == unlit.doubt == UNLIT
    assert not unlit.image.any()
    assert reconstructor.feed(photograph(0, 3)).image.any(), "what is lit is shown with its doubt"


@pytest.mark.parametrize("side", [16, 24])
def test_small_frames_of_noise_are_told_from_small_frames_with_light(side: int) -> None:
    noise = np.random.default_rng(0).normal(0, 2, (side, side)).astype(np.float32)
    lit = noise + np.where(np.arange(side) < side // 2, 20, 0).astype(np.float32)
    assert not has_light(noise, np.array([2.0]))
    assert has_light(lit, np.array([2.0]))


def test_erased_pixels_are_no_light() -> None:
    erasures = np.zeros(SHAPE, bool)
    erasures[20:40, 30:60] = True
    reconstructor = live(background=None, erasures=erasures)
    dark = np.random.default_rng(0).normal(20, 2, SHAPE)
    assert reconstructor.feed(dark.astype(np.float32)).doubt == NOISE_ONLY


@pytest.mark.parametrize(
    ("psf", "says"),
    [(spots_psf(), ""), (spots_psf()[:, ::-1], "calibration"), (spots_psf()[::-1], "calibration")],
)
def test_a_calibration_that_does_not_fit_is_said_of_every_picture(psf: np.ndarray, says: str) -> None:
    reconstructor = LiveReconstructor(
        np.ascontiguousarray(psf), background=20.0, budget_ms=AMPLE_MS, noise=NOISE, coarsest=1
    )
    reconstructor.feed(photograph(0, 0))
    assert reconstructor._fit._running is None, "the first pictures are not held up by it"
    reconstructor._fit._not_before = 0.0  # at once
    unjudged = reconstructor.feed(photograph(0, 1))
    assert not unjudged.doubt
    assert unjudged.quality.startswith(unjudged.awaited)
    assert unjudged.awaited.startswith(NOT_JUDGED)
    reconstructor._fit.wait()
    picture = reconstructor.feed(photograph(0, 2))
    assert not picture.awaited, "the verdict took its place"
    assert says in picture.doubt
    assert bool(says) == bool(picture.doubt)
    assert not says or re.match("(The|This|What|It|A) [a-z]", picture.doubt), picture.doubt


def test_what_the_calibration_is_checked_by_and_what_is_advised_is_said_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Any] = []

    class Looked:
        doubt = ""

        def __init__(self, calibration: Calibration | None = None) -> None:
            self.calibration, self.advice, self.seen = calibration, "", []
            self.awaited = ""
            made.append(self)

        def see(self, posed: Any, binning: int, scene: SceneState, frames: int) -> None:
            self.seen.append((binning, scene, frames, posed()))

    monkeypatch.setattr("recon.streams.live.CalibrationWatch", Looked)
    psf_alone = live()
    assert made.pop().calibration is None
    psf_alone.restart()
    assert made.pop().calibration is None
    calibration = Calibration(spots_psf()[None, None], np.array([[0.0, 0.0, 1000.0]]))
    reconstructor = LiveReconstructor(
        calibration, background=20.0, noise=NOISE, budget_ms=AMPLE_MS, coarsest=1
    )
    frames = [photograph(0, n) for n in range(3)]
    for frame in frames[:2]:
        reconstructor.feed(frame)
    (watch,) = made
    assert watch.calibration is calibration
    assert [seen[:3] for seen in watch.seen] == [(1, SceneState.NEW, 1), (1, SceneState.STILL, 2)]
    of_the_mean = reconstructor._level.whole.with_data(  # type: ignore[union-attr]
        np.mean(frames[:2], axis=0, dtype=np.float32) - 20
    )
    np.testing.assert_allclose(watch.seen[1][3].data, of_the_mean.data, rtol=1e-4, atol=1e-4)
    before = reconstructor.warnings
    watch.advice = "a lens cap"
    for frame in frames:
        reconstructor.feed(frame)
    assert reconstructor.warnings == (*before, "a lens cap")
    reconstructor.restart()
    assert made[1].calibration is calibration
    assert reconstructor.warnings == before


def test_what_was_settled_on_noise_is_made_anew_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    make = LiveReconstructor._make

    def counted(self: LiveReconstructor, *given: Any) -> None:
        made.append(given)
        make(self, *given)

    monkeypatch.setattr(LiveReconstructor, "_make", counted)
    reconstructor = live(budget_ms=AMPLE_MS)
    rng = np.random.default_rng(0)
    dark = [np.round(20 + rng.normal(0, 2, SHAPE)).astype(np.uint16) for _ in range(2)]
    for n, frame in enumerate([*dark, *[photograph(0, seed) for seed in range(4)]]):
        reconstructor.feed(frame)
        if reconstructor._coming is not None:
            reconstructor._coming.wait()
        assert len(made) == (n >= 2)
    reconstructor._settled = True
    assert reconstructor.refine() is None
