"""Frames that scatter: noise, flicker, motion and other light are told apart and taken out where possible."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from calibration_routines.psf.stage_fit import judge_drift
from calibration_routines.scatter import Scatter, compare, pooled, scatter_of, steadied
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array, Float64Array

RNG = np.random.default_rng(4)
PATTERN = ndimage.gaussian_filter(np.maximum(RNG.normal(size=(80, 100)), 0), 0.9)
PATTERN[:20] = PATTERN[:, :20] = 0
PATTERN *= 200 / PATTERN.max()
Z_UM = 94e3


Frames = Float32Array


@pytest.fixture(autouse=True)
def _draws_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever tests ran before in this process."""
    monkeypatch.setitem(globals(), "RNG", np.random.default_rng(5))


def frames(flicker: float = 0.0, motion_px: float = 0.0, ambient: float = 0.0, n: int = 4) -> Frames:
    """Return frames of the pattern with noise as of photons."""
    taken = []
    for _ in range(n):
        light = ndimage.shift(PATTERN, RNG.normal(0, motion_px, 2)) * (1 + flicker * RNG.normal())
        light = np.maximum(light, 0) + abs(RNG.normal(0, ambient))
        taken.append(light + RNG.normal(size=light.shape) * np.sqrt(0.2 * light + 2))
    return np.array(taken, np.float32)


@pytest.mark.parametrize(
    ("faults", "named"),
    [
        ({}, []),
        ({"flicker": 0.2}, ["the light flickers"]),
        ({"motion_px": 0.6}, ["the picture shakes"]),
        ({"ambient": 8.0}, ["other light came"]),
        ({"flicker": 0.1, "motion_px": 2.0}, ["the light flickers", "the picture shakes"]),
    ],
)
def test_each_fault_is_named_alone_with_its_size(faults: dict[str, float], named: list[str]) -> None:
    found = pooled([scatter_of(frames(**faults))[0] for _ in range(6)])
    assert [" ".join(words.split()[:3]) for words in found.findings()] == named
    assert found.flicker == pytest.approx(faults.get("flicker", 0.0), rel=0.5, abs=0.01)
    assert found.motion_px == pytest.approx(2**0.5 * faults.get("motion_px", 0.0), rel=0.5, abs=0.03)


@pytest.mark.parametrize(("width_px", "named"), [(0.8, True), (1.0, True), (2.0, False), (4.0, False)])
def test_shaking_is_named_by_how_fine_the_structure_is_that_it_blurs(width_px: float, named: bool) -> None:
    rng = np.random.default_rng(8)
    beads = np.zeros((120, 140))
    beads[tuple(rng.integers(12, 108, (2, 60)))] = rng.uniform(0.3, 1.0, 60)
    light = ndimage.gaussian_filter(beads, width_px)
    light *= 2000 / light.max()
    taken = [ndimage.shift(light, rng.normal(0, 0.2, 2)) for _ in range(6)]
    seen = np.array([rng.normal(one, np.sqrt(0.2 * np.maximum(one, 0) + 2)) for one in taken], np.float32)
    found = scatter_of(seen)[0]
    assert found.motion_px == pytest.approx(0.28, rel=0.5)
    assert found.sharp_px == pytest.approx(min(width_px, 2.0), rel=0.2)
    assert bool(found.findings()) == named
    assert found.on_pixels(2).moved >= found.moved  # finer than usual is what is finer on the camera's pixels


def test_shaken_frames_are_put_onto_one_another_and_flickering_ones_made_alike() -> None:
    steady = steadied(frames(flicker=0.1, motion_px=0.8, n=6))
    plain = frames(motion_px=0.8, n=6).mean(axis=0)
    assert _unlike(steady.mean) < 0.5 * _unlike(plain)
    levels = steady.frames.mean(axis=(1, 2))
    assert levels.std() < 0.03 * levels.mean()  # 10 % before; 0.2 to 2.1 % in 24 draws


def test_a_dim_frame_counts_by_its_light_as_it_was_brightened_with_its_noise() -> None:
    rng = np.random.default_rng(7)
    levels = np.array([1.0, 1.1, 0.08, 0.9])[:, None, None]
    taken = (levels * PATTERN + rng.normal(size=(4, *PATTERN.shape)) * 1.5).astype(np.float32)
    assert _unlike(steadied(taken).mean) < 1.1 * _unlike(taken.mean(axis=0))


def _unlike(image: Frames) -> float:
    """Relative difference to the pattern, once this is brought to the image's place and brightness."""
    change = compare(image.astype(np.float32), PATTERN.astype(np.float32))
    there = change.brightness * ndimage.shift(PATTERN, (change.rows, change.columns))
    return float(np.linalg.norm(image - there) / np.linalg.norm(there))


def test_a_lamp_that_flickers_is_not_said_to_drift_nor_is_its_flicker_taken_out_of_the_psfs() -> None:
    levels = 1 + 0.1 * np.array([0.0, 1.2, -0.4, 0.9, -1.0])
    visits = [(level * PATTERN).astype(np.float32) for level in levels]
    how = visits, range(5), 4, [0.0, 1.0, 2.0, 3.0, 4.0]
    shaky, plain = judge_drift(*how, Scatter(4, flicker=0.2)), judge_drift(*how)
    assert plain.findings
    assert not shaky.findings
    at = [shaky.brightness_at(t) for t in how[3]]
    assert np.diff(at, 2) == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.ptp(at) < 0.15 < np.ptp(levels)


@pytest.mark.parametrize(("contrast", "told"), [(0.1, True), (0.03, True), (0.01, False)])
def test_structure_that_grain_hides_gets_its_place_or_none(contrast: float, told: bool) -> None:
    """Weak and smooth, both images noisy, nothing moved: they were up to 3.5 pixels apart."""
    rng = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(rng.standard_normal((160, 240)), 6)
    light = 1000 * (1 + contrast * smooth / smooth.std())
    for _ in range(6):
        one, other = (light + rng.normal(0, 30, (2, *light.shape))).astype(np.float32)
        change = compare(one, other)
        assert change.shift_px < 0.3 if told else change.shift_px == np.inf
        assert change.brightness == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("way", [(0.0, 0.3), (0.2, 0.7), (0.8, 0.8), (0.6, 3.25)])
def test_a_picture_that_only_moved_is_as_bright_as_it_was_and_no_other_light_came(
    way: tuple[float, float],
) -> None:
    """By moving one image alone, or not at all, up to 2.3 % of the light had become other light."""
    fine = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    pitch_um = 13.0 * Z_UM / fine.distance_um

    def light(down: float, right: float) -> Float64Array:
        psf = np.array(fine.psf((-right * pitch_um, -down * pitch_um, Z_UM), (0.0, 1.0, 0.0)))
        return psf / psf.sum()

    rng = np.random.default_rng(3)
    one, other = light(0.0, 0.0), light(*way)
    bright = 4 * 3000 / one.max()
    seen = [(rng.poisson(bright * each) / 4).astype(np.float32) for each in (one, other)]
    change = compare(seen[1], seen[0])
    assert (change.rows, change.columns) == pytest.approx(way, abs=0.04)
    assert change.brightness == pytest.approx(1, abs=0.005)
    assert change.ambient == pytest.approx(0, abs=0.005)


@pytest.mark.parametrize("came", [0.0, 0.05])
@pytest.mark.parametrize("way", [(0, 0), (0, -1), (3, 4), (12, 15), (-12, 15)])
def test_other_light_is_a_part_of_the_whole_picture_however_far_its_pattern_moved(
    way: tuple[int, int], came: float
) -> None:
    """Its rims are dark, and what was left between them was brighter: 5 % were read as 2.1 %."""
    middle = PATTERN.copy()
    middle[60:] = middle[:, 80:] = 0
    seen = 1.1 * np.roll(middle, way, (0, 1)) + came * middle.mean()
    change = compare(seen.astype(np.float32), middle.astype(np.float32))
    assert (change.rows, change.columns) == pytest.approx(way, abs=0.02)
    assert change.brightness == pytest.approx(1.1, abs=0.005)
    assert change.ambient == pytest.approx(came, abs=0.003)
