"""Photographs of random patterns, and what one of them tells that is shown again and again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import zoom

from calibration_routines.display import display_learning
from calibration_routines.display.display_learning import LearningProcedure
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.pattern_series import (
    VISIT_FRAMES,
    PatternSeries,
    Visit,
    photograph_series,
    series_frames,
    visited_before,
)
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import NO_CHANGE, STEADY, Scatter
from calibration_routines.times import first_guess
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from recon.arrays import Array
from recon.holography import Display, random_mask
from recon.holography.camera_map import CameraMap
from recon.holography.learn import Lesson, learning_work
from tests.calibration_routines.display.test_mask_alignment import small

SHAPE, K, ACROSS, RIM = (24, 32), 2, 160, 8
MASK = np.exp(1j * np.pi * np.random.default_rng(3).integers(0, 2, (SHAPE[0] * K, SHAPE[1] * K)))
DISPLAY = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=3), mask_fill=1.0)
COUNT = 9


class Io:
    """Shows the mask's far field; what is wrong with it goes by how many patterns were shown."""

    def __init__(
        self, wrong: Callable[[int, Array], Array], mask: Callable[[int], Array], noise: float
    ) -> None:
        self.frames, self._shown, self._wrong, self._mask, self._of_noise = 0, 0, wrong, mask, noise
        self._slm: Array = np.ones(SHAPE)
        self._noise = np.random.default_rng(8)

    def exposure_ms(self, _: float) -> float:
        return 10.0

    def show(self, slm: Array) -> None:
        self._slm = slm
        self._shown += 1

    def photograph(self, _: float) -> Array:
        field = np.kron(self._slm, np.ones((K, K))) * self._mask(self._shown)
        light = np.abs(np.fft.fftshift(np.fft.fft2(field, (ACROSS, ACROSS)))) ** 2
        light = np.pad(self._wrong(self._shown, light / light.mean()), RIM, mode="wrap")
        self.frames += 1
        return light + self._of_noise * self._noise.standard_normal(light.shape)


def moved_by(light: Array, rows: float, columns: float) -> Array:
    y, x = np.fft.fftfreq(ACROSS), np.fft.rfftfreq(ACROSS)
    ramp = np.exp(-2j * np.pi * (rows * y[:, None] + columns * x))
    return np.fft.irfft2(np.fft.rfft2(light) * ramp, light.shape)


def series(
    wrong: Callable[[int, Array], Array] = lambda _, light: light,
    mask: Callable[[int], Array] = lambda _: MASK,
    noise: float = 0.01,
    count: int = COUNT,
) -> PatternSeries:
    camera = CameraMap((ACROSS + 2 * RIM,) * 2, ACROSS, np.zeros((10, 2)))
    seen = SimpleNamespace(io=Io(wrong, mask, noise), display=DISPLAY, camera=camera, mean_per_ms=1.0)
    return photograph_series(seen, count)  # type: ignore[arg-type]


def apart(one: PatternSeries, other: PatternSeries) -> float:
    """Return by which part photographs differ at most, brightness and mean apart."""
    parts = []
    for look, known in zip(one.looks, other.looks, strict=True):
        a, b = look.lags.copy(), known.lags.copy()
        a[0, 0] = b[0, 0] = 0
        a *= np.vdot(a, b).real / np.vdot(a, a).real
        parts.append(float(np.linalg.norm(a - b) / np.linalg.norm(b)))
    return max(parts)


def test_the_first_pattern_is_visited_before_the_others_between_them_and_in_the_end() -> None:
    assert visited_before(5) == [1, 5]
    assert visited_before(9) == [1, 5, 9]
    assert visited_before(13) == [1, 5, 9, 13]
    still = series()
    assert still.frames == series_frames(COUNT) == COUNT - 1 + 3 * VISIT_FRAMES
    assert len(still.looks) == COUNT
    assert (still.findings, still.notes, still.crept_px) == ((), (), 0.0)
    assert still.other < 1e-3
    assert still.scatter.averages == 3


def test_a_picture_that_creeps_is_put_back_and_that_is_said() -> None:
    still = series()
    crept = series(lambda shown, light: moved_by(light, 0.1 * shown, -0.05 * shown))
    assert crept.crept_px == pytest.approx((COUNT + 1) * np.hypot(0.1, 0.05), rel=0.05)
    assert "put back" in " ".join(crept.notes)
    assert crept.findings == ()
    assert apart(crept, still) < 0.1


def test_what_shakes_is_a_finding_and_flicker_is_none() -> None:
    rng = np.random.default_rng(2)
    shaken = series(lambda _, light: moved_by(light, *rng.normal(0, 0.5, 2)))
    (words,) = shaken.findings
    assert "shakes by 0." in words
    assert "one frame each" in words
    flickering = series(lambda _, light: light * (1 + 0.2 * rng.standard_normal()))
    assert flickering.findings == ()
    assert "flickers by 2" in " ".join(flickering.notes)


def test_a_picture_that_grows_is_a_finding() -> None:
    def grown(shown: int, light: Array) -> Array:
        if shown < 8:
            return light
        large = zoom(light, 1.0125, order=3)
        edge = (len(large) - ACROSS) // 2
        return np.asarray(large[edge : edge + ACROSS, edge : edge + ACROSS])

    assert "larger: camera or lens moved" in " ".join(series(grown).findings)


def test_a_mask_that_moves_against_the_slm_is_a_finding_or_the_end() -> None:
    aside = np.roll(MASK, 1, axis=1)
    with pytest.raises(CalibrationError, match="did not give its picture again"):
        series(mask=lambda shown: MASK if shown < 8 else aside)
    a_little = series(mask=lambda shown: MASK if shown < 8 else MASK + 0.25 * aside)
    assert "became another one" in " ".join(a_little.findings)


@pytest.mark.parametrize("noise", [0.8, 2.0])
def test_noise_is_no_other_picture_and_hides_none(noise: float) -> None:
    grainy = series(noise=noise)
    assert grainy.findings == ()
    words = " ".join(grainy.notes)
    assert "of a photograph's contrast is not in the next one of the same pattern: noise" in words
    assert "drifts" not in words
    aside = np.roll(MASK, 1, axis=1)
    other = series(mask=lambda shown: MASK if shown < 8 else MASK + 0.25 * aside, noise=noise)
    still = series(mask=lambda shown: MASK if shown < 8 else MASK + 0.25 * aside)
    assert "became another one" in " ".join(other.findings)
    assert other.other == pytest.approx(still.other, abs=0.01 if noise < 1 else 0.08)


def test_one_pattern_is_visited_once_and_nothing_is_found() -> None:
    assert visited_before(1) == [1]
    alone = series(count=1)
    assert (alone.frames, len(alone.looks)) == (series_frames(1), 1)
    assert (alone.findings, alone.notes) == ((), ())


def test_the_time_of_photographing_and_learning_is_told_before() -> None:
    """On a real bench a first guess; on a simulated one what learning takes is told by its size."""
    with Bench(parse_config(small(), None)).open() as bench:
        outlook = LearningProcedure().outlook(bench)
        assert bench.slm is not None
        waiting_ms = 26 * bench.camera.exposure_ms + 16 * bench.slm.settle_ms
    assert [step for step, _ in outlook.work] == ["photographing random patterns", "learning"]
    assert 1e3 * outlook.beside_s == pytest.approx(waiting_ms)
    (words,) = first_guess(SimpleNamespace(simulated_kinds=()), outlook)  # type: ignore[arg-type]
    assert words.startswith("In all, by a first guess: about ")
    assert learning_work(720 * 1280, 2) == pytest.approx(28000)
    assert learning_work(720 * 1280, 10) == pytest.approx(28000)  # ten are fitted two a round
    assert learning_work(720 * 1280, 30) == pytest.approx(3 * 28000)
    assert learning_work(216 * 384, 8) == pytest.approx(790, rel=0.1)


def test_what_is_learned_of_a_picture_that_shook_is_doubtful_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def learned(name: str, scatter: Scatter) -> tuple[bool, Path, str]:
        photographed = PatternSeries((), 9, (Visit(NO_CHANGE), Visit(NO_CHANGE)), scatter)
        monkeypatch.setattr(display_learning, "photograph_series", lambda *_: photographed)
        with Bench(parse_config(small(), None)).open() as bench:
            done = LearningProcedure(out=tmp_path / name).carry_out(bench, tmp_path)
        assert done.calibration is not None
        return done.good, done.calibration, " ".join(done.verdict)

    def registered(io: Any, display: Display) -> Any:
        return SimpleNamespace(io=io, display=display, camera=SimpleNamespace(residual_px=0.1))

    monkeypatch.setattr(HologramCamera, "registered", registered)
    monkeypatch.setattr(
        display_learning,
        "learn_display",
        lambda display, *_, **__: Lesson(display, 0.5, 0.5, (), False),
    )
    good, file, words = learned("a.json", STEADY)
    assert (good, file.name, "Quality" in words) == (True, "a.json", False)
    good, file, words = learned("b.json", Scatter(3, motion_px=0.9))
    assert (good, file.name) == (False, "doubtful_b.json")
    assert "Quality: the picture shakes by 0.90 pixels" in words
    assert not (tmp_path / "b.json").exists()
    assert "shakes" in json.loads(file.read_text())["findings"][0]
