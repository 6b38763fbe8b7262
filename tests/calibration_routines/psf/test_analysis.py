"""Frames in, PSFs out: dark current, hot pixels, exposures, colour, saturation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration_routines.psf.analysis import DarkModel, PlaneFrames, analyse_sweep, binned, replace_hot
from recon.arrays import Float64Array
from recon.types import Geometry

FULL = 4095
SHAPE = (144, 192)
GEOMETRY = Geometry(pixel_pitch_um=13.0, diffuser_distance_mm=8.9)
RANDOM = np.random.default_rng(3)
OFFSET = 100.0 + RANDOM.normal(0.0, 3.0, SHAPE)
DARK_RATE = RANDOM.uniform(0.0, 2.0, SHAPE)  # counts per millisecond
DARK_RATE[10, 20] = 1e4
DARK_RATE[70, 80] = 1e4


def light_at(z_um: float) -> Float64Array:
    """Counts per millisecond of a textured shadow that scales with 1 + d/z and dims with 1/z^2."""
    magnification = 1 + 8900.0 / z_um
    rows, columns = ((np.arange(n) + 0.5 - n / 2) / magnification for n in SHAPE)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    texture = 1.0 + 0.9 * np.sin(0.7 * x + 0.4 * y)
    return texture * (np.abs(y) < 40) * (np.abs(x) < 55) * 15.0 * (100e3 / z_um) ** 2


def frames(light: Float64Array, exposure_ms: float, n: int = 4) -> npt.NDArray[np.uint16]:
    expected = OFFSET + (DARK_RATE + light) * exposure_ms
    noisy = expected + RANDOM.normal(size=(n, *SHAPE)) * np.sqrt(0.1 * light * exposure_ms + 1.0)
    return np.clip(np.round(noisy), 0, FULL).astype(np.uint16)


def dark_model(n: int = 8) -> DarkModel:
    zero = np.zeros(SHAPE)
    return DarkModel((50.0, 200.0), (frames(zero, 50.0, n), frames(zero, 200.0, n)), FULL)


def plane(z_um: float, exposure_ms: float, n: int = 4) -> PlaneFrames:
    return PlaneFrames((0.0, 0.0, z_um), exposure_ms, frames(light_at(z_um), exposure_ms, n), FULL)


def test_pixels_as_warm_as_hot_ones_have_not_turned_hot() -> None:
    random, full_scale = np.random.default_rng(5), 65535
    expected = np.full((300, 400), 500.0)
    warm, turned = expected.reshape(-1)[:2000], (slice(150, 160), slice(0, 30))
    warm += 0.01 * full_scale  # by what makes a pixel hot: noise tells, from frame to frame
    expected[turned][:, :5] += 0.006 * full_scale  # warm ones turn, too
    early = random.normal(expected, 30.0, (4, *expected.shape))
    expected[turned] += 0.1 * full_scale
    late = random.normal(expected, 30.0, (4, *expected.shape))
    dark = DarkModel((100.0,), (np.concatenate([early, late]).astype(np.uint16),), full_scale, (4,))
    assert dark.late_hot == 300
    assert dark.hot[turned].all()
    assert dark.hot.reshape(-1)[:2000].mean() > 0.5


def test_psfs_are_the_light_alone_in_counts_of_one_exposure() -> None:
    depths = [(100e3, 60.0), (140e3, 120.0), (200e3, 200.0)]
    result = analyse_sweep([plane(z, e) for z, e in depths], dark_model(), GEOMETRY)
    assert result.psfs.shape == (3, 1, *SHAPE)
    assert result.psfs.dtype == np.float32
    assert result.psfs.min() >= 0
    assert result.reference_exposure_ms == 60.0
    for psf, (z, _) in zip(result.psfs[:, 0], depths, strict=True):
        expected = 60.0 * light_at(z)
        assert np.abs(psf - expected).mean() < 0.03 * expected.max()
        assert psf[10, 20] < 20.0  # hot pixels are replaced
        assert psf[70, 80] == pytest.approx(expected[70, 80], rel=0.5)
    assert all(not q.findings for q in result.quality)
    rest = np.abs(result.background[0] - (OFFSET + 60.0 * DARK_RATE))
    assert np.median(rest) < 2.0


def test_saturated_pixels_are_counted_and_hot_ones_are_not() -> None:
    bright = plane(100e3, 60.0)
    saturated = bright.frames.copy()
    saturated[1, 60:62, 90:93] = FULL  # in one frame of four: still a saturated PSF
    result = analyse_sweep([PlaneFrames(bright.source_um, 60.0, saturated, FULL)], dark_model(), GEOMETRY)
    assert result.quality[0].saturated_pixels == 6
    assert result.quality[0].retake
    assert analyse_sweep([bright], dark_model(), GEOMETRY).quality[0].saturated_pixels == 0


def test_binning_and_stray_light() -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    stray = 4.0 + 2.0 * np.cos(np.pi * (x + 0.5) / SHAPE[1]) + 0.0 * y
    spots = np.zeros(SHAPE)
    spots[20:130:16, 20:180:16] = 40.0
    raw = PlaneFrames((0.0, 0.0, 100e3), 60.0, frames(spots + stray, 60.0), FULL)
    result = analyse_sweep([raw], dark_model(), GEOMETRY, dct_order=4, binning=2)
    assert result.psfs.shape == (1, 1, SHAPE[0] // 2, SHAPE[1] // 2)
    assert result.psfs[0, 0, 10, 10] == pytest.approx(60.0 * 40.0 / 4, rel=0.1)
    assert np.median(result.psfs) < 15.0
    assert binned(GEOMETRY, 2).pixel_pitch_um == 26.0


def test_a_single_plane_of_a_single_frame_is_a_calibration_too() -> None:
    result = analyse_sweep([plane(100e3, 60.0, n=1)], dark_model(1), GEOMETRY)
    assert len(result.psfs) == 1
    assert np.isfinite(result.quality[0].snr)


def test_colour_frames_become_channels() -> None:
    grey = plane(100e3, 60.0)
    colour = np.stack([grey.frames] * 3, axis=-1)
    zero = np.zeros(SHAPE)
    dark = DarkModel((60.0,), (np.stack([frames(zero, 60.0, 8)] * 3, axis=-1),), FULL)
    result = analyse_sweep([PlaneFrames(grey.source_um, 60.0, colour, FULL)], dark, GEOMETRY)
    assert result.psfs.shape == (1, 3, *SHAPE)
    assert np.array_equal(result.psfs[:, 0], result.psfs[:, 2])


def test_hot_pixels_take_their_neighbours_median() -> None:
    image = np.full((5, 5), 7.0, np.float32)
    hot = np.zeros((5, 5), bool)
    image[2, 2], hot[2, 2] = 900.0, True
    assert replace_hot(image, hot)[2, 2] == 7.0


def test_frames_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one point"):
        analyse_sweep([], dark_model(), GEOMETRY)
    small = PlaneFrames((0.0, 0.0, 1e5), 60.0, np.zeros((2, 10, 10), np.uint16), FULL)
    with pytest.raises(ValueError, match=r"z = 100 mm are \(10, 10\), the dark frames \(144, 192\)"):
        analyse_sweep([small], dark_model(), GEOMETRY)
    with pytest.raises(ValueError, match="one or two exposures"):
        DarkModel((), (), FULL)


def test_frames_tell_their_noise_in_electrons() -> None:
    depths = [(100e3, 60.0), (140e3, 120.0), (200e3, 200.0)]
    for binning in (1, 2):
        noise = analyse_sweep([plane(z, e) for z, e in depths], dark_model(), GEOMETRY, binning=binning).noise
        assert noise is not None
        assert noise.counts_per_electron == pytest.approx(0.1, rel=0.05)
        # Variances of 1, and of 1/12 by whole counts.
        assert noise.read_e == pytest.approx(binning * np.hypot(1.0, 12**-0.5) / 0.1, rel=0.05)
        brightest = float(np.median([e * light_at(z).max() for z, e in depths]))
        assert noise.electrons == pytest.approx(binning**2 * brightest / 0.1, rel=0.15)
    alone = [PlaneFrames((0.0, 0.0, 100e3), 60.0, frames(light_at(100e3), 60.0, 1), FULL)]
    assert analyse_sweep(alone, dark_model(), GEOMETRY).noise is None
    assert analyse_sweep([plane(100e3, 60.0)], dark_model(1), GEOMETRY).noise is None
