"""Frames of spots that move, and live reconstructors of them."""

from __future__ import annotations

import numpy as np

from recon import NoiseModel
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LivePicture
from recon.streams.pace import Spent

SHAPE = (64, 96)

AMPLE_MS = 5000.0
"""A budget that no machine exhausts: iterations go on until the picture has settled."""

NOISE = NoiseModel(read_noise=2.0, counts_per_electron=0.05)


def spots_psf(shape: tuple[int, int] = SHAPE, count: int = 40) -> np.ndarray:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    psf = np.zeros(shape)
    for cy, cx in rng.uniform((8, 8), (shape[0] - 8, shape[1] - 8), (count, 2)):
        psf += np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 1.3**2))
    return (psf / psf.sum()).astype(np.float32)


def photograph(column: float, seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """A frame of discs, spot by spot at continuous places (no FFT, no grid), with photon and read noise."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    centres = rng.uniform((8, 8), (shape[0] - 8, shape[1] - 8), (40, 2)) - np.array(shape) // 2
    image = np.zeros(shape)
    for dy, dx, light in ((-6.3, -9.1, 1.0), (7.2, 4.4, 0.6), (0.4, 14.7, 0.8)):
        for cy, cx in centres + np.array(shape) // 2:
            image += light * np.exp(-((y - cy - dy) ** 2 + (x - cx - dx - column) ** 2) / (2 * 2.2**2))
    noisy = np.random.default_rng(seed)
    counts = noisy.poisson(image * 8000) * NOISE.counts_per_electron + noisy.normal(0, 2, shape)
    return np.clip(np.round(counts + 20), 0, 4095).astype(np.uint16)


def live(**settings: object) -> LiveReconstructor:
    settings = {"background": 20.0, "budget_ms": 25.0, "noise": NOISE, "coarsest": 1, **settings}
    return LiveReconstructor(spots_psf(), **settings)  # type: ignore[arg-type]


def iterated(reconstructor: LiveReconstructor, frame: np.ndarray) -> LivePicture:
    """Feed a first frame and wait until its picture is iterated."""
    assert reconstructor.feed(frame).method == "wiener"
    picture = reconstructor.refine()
    assert picture is not None
    return picture


def taking(reconstructor: LiveReconstructor, fixed_ms: float, step_ms: float) -> None:
    """Have the reconstructor believe that pictures take so long."""
    fixed, step = (Spent(ms, ms) for ms in (fixed_ms, step_ms))
    for _ in range(7):
        reconstructor._pace.note(fixed, step, 1)
