"""Metrics against known values and an independent formula."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.metrics import nrmse, psnr, scale_to, ssim


def test_known_values():
    truth = np.zeros((20, 20))
    truth[5:10] = 2.0
    image = truth + 0.2
    assert psnr(image, truth) == pytest.approx(20.0)
    assert psnr(image, truth, data_range=20) == pytest.approx(40.0)
    assert psnr(truth, truth) == np.inf
    assert nrmse(image, truth) == pytest.approx(0.2 / np.sqrt(np.mean(truth**2)))
    assert nrmse(0 * truth, truth) == 1
    assert ssim(truth, truth) == pytest.approx(1)


def test_scale_is_fitted_only_on_request():
    truth = np.random.default_rng(0).random((16, 16, 3))
    assert psnr(7 * truth, truth) < 0
    assert psnr(7 * truth, truth, fit_scale=True) > 250
    assert nrmse(7 * truth, truth, fit_scale=True) < 1e-12
    assert ssim(7 * truth, truth, fit_scale=True) == pytest.approx(1)
    assert scale_to(7 * truth, truth) == pytest.approx(1 / 7)
    assert scale_to(0 * truth, truth) == 0


def test_ssim_equals_the_direct_sum():
    rng = np.random.default_rng(1)
    a, b = rng.random((14, 13)), rng.random((14, 13))
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = (0.01 * b.max()) ** 2, (0.03 * b.max()) ** 2
    values = []
    for i in range(4):
        for j in range(3):
            p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
            cov = (window * (p - mp) * (q - mq)).sum()
            similarity = (2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
            values.append(similarity)
    assert ssim(a, b) == pytest.approx(np.mean(values))


def test_refuses_what_cannot_be_judged():
    with pytest.raises(ValueError, match=r"\(4, 5\) and \(5, 4\)"):
        psnr(np.ones((4, 5)), np.ones((5, 4)))
    with pytest.raises(ValueError, match="at least 11 x 11"):
        ssim(np.ones((10, 20)), np.ones((10, 20)))
    with pytest.raises(ValueError, match="above 0"):
        psnr(np.ones((4, 5)), np.zeros((4, 5)))
    with pytest.raises(ValueError, match="not defined"):
        nrmse(np.ones((4, 5)), np.zeros((4, 5)))
