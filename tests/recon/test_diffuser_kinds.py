"""Which diffuser stands noise best (Kuo 2020, Figs. 6.2 and 6.3): random microlenses, by much."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon import Calibration, reconstruct

SIZE = 64


def random_microlenses(rng):
    image = np.zeros((SIZE, SIZE))
    image[tuple(rng.integers(14, 50, (2, 30)))] = 1
    return gaussian_filter(image, 0.7)


def regular_microlenses(_):
    image = np.zeros((SIZE, SIZE))
    image[14:50:7, 14:50:7] = 1
    return gaussian_filter(image, 0.7)


def smooth_diffuser(rng):
    """Caustic lines over much light between them."""
    height = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 3)
    image = np.exp(-((height / height.std()) ** 2) * 3) + 0.3
    window = np.zeros((SIZE, SIZE))
    window[14:50, 14:50] = 1
    return gaussian_filter(image * window, 0.7)


def error(diffuser, photons):
    """Error of the picture of 20 points that send ``photons`` each; mean of three scenes."""
    errors = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        psf = diffuser(np.random.default_rng(7))
        psf /= psf.sum()
        truth = np.zeros((SIZE, SIZE))
        truth[tuple(rng.integers(22, 42, (2, 20)))] += photons
        clean = sum(
            light * np.roll(psf, (i - SIZE // 2, j - SIZE // 2), (0, 1))
            for (i, j), light in np.ndenumerate(truth)
            if light
        )
        data = rng.poisson(clean).astype(float)
        calibration = Calibration(psf[None, None].astype(np.float32), np.full((1, 3), np.nan))
        found = reconstruct(
            data,
            calibration,
            prior="l1",
            noise=float(np.sqrt(data.mean()) + 1e-3),
            estimate_background=False,
            judged=False,
        ).volume[0]
        # A point that is found a pixel off is found.
        a, b = gaussian_filter(found, 1), gaussian_filter(truth, 1)
        errors.append(np.linalg.norm(a - b) / np.linalg.norm(b))
    return float(np.mean(errors))


@pytest.mark.parametrize("photons", [30, 300, 10_000])
def test_random_microlenses_stand_noise_best(photons):
    random, regular, smooth = (
        error(d, photons) for d in (random_microlenses, regular_microlenses, smooth_diffuser)
    )
    assert random < 0.9 * regular
    assert random < 0.9 * smooth


def test_more_photons_tell_more():
    assert error(random_microlenses, 10_000) < 0.7 * error(random_microlenses, 30)
