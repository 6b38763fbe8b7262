"""Active illumination: a linear map, the ordinary camera for a pattern of ones, better pictures with many."""

from __future__ import annotations

import numpy as np
import pytest

from recon import InputError, Measurement, Problem, reconstruct
from recon.base.metrics import psnr
from recon.camera.base import estimate_norm
from recon.camera.convolution import Convolution
from recon.camera.factors import PatternedCamera
from recon.reconstruction.result import window_of
from tests.mocks.plain_camera import cast

SHAPE = (24, 30)


def camera_of(lit: np.ndarray, dtype: type) -> PatternedCamera:
    """One PSF, lit by patterns."""
    window, _ = window_of("sensor", SHAPE, SHAPE)
    return PatternedCamera(Convolution(psf()[None, None], SHAPE, dtype=dtype), lit, window)


def psf() -> np.ndarray:
    return (np.random.default_rng(0).random(SHAPE) ** 10).astype(np.float32)


def patterns(count: int) -> np.ndarray:
    """Bright bands that add up to one."""
    x = np.arange(SHAPE[1]) / SHAPE[1] * count - np.arange(count)[:, None] - 0.5
    bands = np.exp(-(x**2) / 0.3)
    bands /= bands.sum(axis=0)
    return np.repeat(bands[:, None], SHAPE[0], axis=1)


def scene() -> np.ndarray:
    light = np.random.default_rng(1).random(SHAPE) * 0.2 + 0.2
    light[6:12, 5:9], light[14:18, 15:26] = 1.0, 0.7
    return light


def test_adjoint_norm_and_the_plain_sum() -> None:
    rng = np.random.default_rng(2)
    camera = camera_of(patterns(3), np.float64)
    x, y = rng.standard_normal(camera.domain_shape), rng.standard_normal(camera.range_shape)
    assert np.vdot(camera.forward(x), y) == pytest.approx(np.vdot(x, camera.adjoint(y)), rel=1e-10)
    assert estimate_norm(camera) <= camera.norm_bound * (1 + 1e-9)
    brighter = camera_of(3 * patterns(3), np.float64)
    assert brighter.norm_bound == pytest.approx(3 * camera.norm_bound)
    inside = np.zeros(camera.domain_shape)
    inside[0, 0][camera.window] = scene()
    expected = [cast(scene() * pattern, psf()) for pattern in patterns(3)]
    np.testing.assert_allclose(camera.forward(inside), expected, rtol=1e-5)


def test_one_pattern_of_ones_is_the_ordinary_camera() -> None:
    ones = np.ones((1, *SHAPE))
    x = np.random.default_rng(3).random(Convolution(psf()[None], SHAPE).domain_shape, np.float32)
    plain = Convolution(psf()[None], SHAPE).forward(x)
    np.testing.assert_allclose(camera_of(ones, np.float32).forward(x[:, None]), plain, rtol=1e-4)
    measured = cast(scene(), psf())
    settings = {"iterations": 150, "tau": 1e-3, "noise": 1.0, "prior": "tv-haar"}
    together = reconstruct(Measurement(measured[None], patterns=ones), psf(), **settings)
    alone = reconstruct(measured, psf(), solver="fista", tolerance=0, **settings)
    assert psnr(together.image, alone.image) > 30


def test_more_patterns_of_the_same_light_give_a_better_picture() -> None:
    rng = np.random.default_rng(4)
    found = []
    for count in (1, 6):
        lit = patterns(count)
        clean = np.stack([cast(scene() * pattern, psf()) for pattern in lit])
        counts = rng.poisson(clean * 2000 / clean.sum(axis=0).max()) / 2000 * clean.sum(axis=0).max()
        picture = reconstruct(Measurement(counts, patterns=lit), psf(), iterations=200).image
        gain = float(np.vdot(picture, scene()) / np.vdot(picture, picture))
        found.append(float(psnr(gain * picture, scene())))
    assert found[1] > found[0] + 1


@pytest.mark.parametrize(
    ("frames", "lit", "says"),
    [
        (np.ones(SHAPE), np.ones(SHAPE), "Patterns are"),
        (np.ones((2, *SHAPE)), np.ones((3, *SHAPE)), "One pattern a frame"),
        (np.ones((1, 5, 5)), np.ones((1, 5, 5)), "24 x 30 pixels"),
        (np.ones((1, *SHAPE)), -np.ones((1, *SHAPE)), "negative"),
        (np.ones((1, *SHAPE)), 1j * np.ones((1, *SHAPE)), "^The patterns must hold real numbers"),
        (np.full((1, *SHAPE), np.nan), np.ones((1, *SHAPE)), "finite"),
    ],
)
def test_what_does_not_fit_is_refused(frames: np.ndarray, lit: np.ndarray, says: str) -> None:
    with pytest.raises(InputError, match=says):
        reconstruct(Measurement(frames, patterns=lit), psf())


def test_patterned_light_is_a_camera_and_goes_with_what_other_cameras_go_with() -> None:
    lit = patterns(3)
    frames = np.stack([cast(scene() * pattern, psf()) for pattern in lit]) + 50.0
    plain = reconstruct(Measurement(frames, background=50.0, patterns=lit), psf(), iterations=60)
    assert plain.solver == "fista"
    problem = Problem.of(Measurement(frames, background=50.0, patterns=lit), psf())
    assert problem.reason.startswith("patterned light")  # nobody asked for its model
    assert plain.image.shape == SHAPE
    assert plain.verdict is None
    assert any("Not judged" in text for text in plain.warnings)
    exact = reconstruct(
        Measurement(frames, background=50.0, patterns=lit), psf(), iterations=60, precision="float64"
    )
    assert psnr(exact.image, plain.image) > 30
    hazy = reconstruct(Measurement(frames, patterns=lit), psf(), iterations=60, estimate_background=True)
    assert hazy.background is not None
    assert hazy.background.mean() > 40
    with pytest.raises(InputError, match="one light"):
        reconstruct(Measurement(frames, patterns=lit), psf(), solver="admm")
    problem = Problem.of(Measurement(frames, patterns=lit), psf())
    assert (problem.n_channels, problem.n_planes, len(problem.data)) == (1, 1, 3)


def test_colours_are_seen_under_the_same_patterns() -> None:
    lit, tint = patterns(3), np.array([1.0, 0.5, 0.2])
    plain = np.stack([cast(scene() * pattern, psf()) for pattern in lit])
    mirrored = np.stack([cast(scene()[:, ::-1] * pattern, psf()) for pattern in lit])
    frames = np.stack([plain, mirrored, plain], axis=-1) * tint
    told = {"noise": 1e-3, "patterns": lit}
    found = reconstruct(Measurement(frames, **told), psf(), iterations=150)
    assert found.image.shape == (*SHAPE, 3)
    for colour, truth in enumerate((scene(), scene()[:, ::-1], scene())):
        picture = found.image[..., colour]
        gain = float(np.vdot(picture, truth) / np.vdot(picture, picture))
        assert 1 / gain == pytest.approx(tint[colour], rel=0.1)
        assert psnr(gain * picture, truth) > 17
    # What a mosaic leaves out of each colour is left out of each of its frames; a background is one a frame.
    row, column = np.indices(SHAPE)
    erased = np.stack([(row % 2) + (column % 2) != colour for colour in range(3)], axis=-1)
    erased = np.broadcast_to(erased, frames.shape)
    settings = {"iterations": 60, "tolerance": 0.0, "tau": 1e-2, "estimate_background": True}
    part = reconstruct(
        Measurement(np.where(erased, 99.0, frames), erasures=erased, **told), psf(), **settings
    )
    assert part.background is not None
    assert part.background.shape == frames.shape
    known = Measurement(frames[..., 0], erasures=erased[..., 0], **told)
    alone = reconstruct(known, psf(), **settings)
    assert alone.background is not None
    assert alone.background.shape == plain.shape
    assert psnr(part.image[..., 0], alone.image) > 50  # the brightest colour, so that weights are the same
