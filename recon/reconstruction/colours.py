"""Whether colour channels are one picture in several tints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.noise import estimate_deviation
from recon.errors import InputError
from recon.reconstruction.choice import Decision
from recon.reconstruction.options import Overrides
from recon.types import Calibration

CHANNEL_NOISE = 1.1
"""Misfit, in units of the noise, up to which colour channels are taken to be proportional."""
CHANNEL_PSF = 0.05
"""The same of their PSFs, relative to them."""

LEAST_COMMON, LEAST_COMMON_SHARE = 64, 0.05
"""Pixels, and share of all, that must tell all colours for channels to be compared and merged."""


@dataclass(frozen=True)
class Colours:
    """Colour channels that are proportional to one another, in the data and in the PSFs.

    Attributes
    ----------
    scene, psf : ndarray, float64, (n_channels,)
        Relative brightness of every channel.
    weights : ndarray, float64, (n_channels,)
        How to add channels up, so that the sum has the least noise and the brightness of channel mean.
    misfit : float
        What this misses of the data, in units of the noise.
    psf_misfit : float
        The same of the PSFs, relative to them.
    """

    scene: Float64Array
    psf: Float64Array
    weights: Float64Array
    misfit: float
    psf_misfit: float

    def merged(self, channels: Array, gains: Float64Array) -> Float32Array:
        """Return one image of channels (..., n_channels, height, width) that are ``gains`` times it."""
        weights = self.weights / float(self.weights @ gains)
        return np.asarray(np.tensordot(weights, channels, axes=([0], [-3])), np.float32)

    def spread(self, image: Array) -> Float32Array:
        """Return an object of all channels, channels last."""
        return np.asarray(np.asarray(image)[..., None] * (self.scene / self.psf), np.float32)


def colours(data: Array, noise: Array, valid: Array, psfs: Array) -> Colours | None:
    """Fit channels that are proportional to one another; None where there is one channel.

    Parameters
    ----------
    data : ndarray, (n_channels, height, width)
        Counts.
    noise : ndarray, (n_channels,)
        Its deviation.
    valid : ndarray of bool, as ``data``
    psfs : ndarray, (n_sources, 1 or n_channels, height, width)
    """
    if len(data) == 1:
        return None
    mask = valid.all(axis=0)
    flat = data[:, mask].astype(np.float64) / noise[:, None]
    scene, misfit = _proportional(flat)
    scene = scene * noise
    if psfs.shape[1] == 1:
        psf, psf_misfit = np.ones(len(data)), 0.0
    else:
        light = np.moveaxis(psfs, 1, 0).reshape(psfs.shape[1], -1).astype(np.float64)
        psf, rest = _proportional(light)
        spread = float(np.sqrt(np.mean((psf[:, None] * (psf @ light / (psf @ psf))) ** 2)))
        # Noise of the photographs of the source is no difference between them.
        shot = float(np.mean([estimate_deviation(p) for p in psfs[0]]))
        psf_misfit = float(np.sqrt(max(rest**2 - shot**2, 0.0))) / max(spread, 1e-30)
    weights = scene / noise.astype(np.float64) ** 2
    weights = weights / float(weights @ scene)
    return Colours(scene / scene.mean(), psf / psf.mean(), weights * scene.mean(), misfit, psf_misfit)


def _proportional(rows: Float64Array) -> tuple[Float64Array, float]:
    """Best factors of one pattern, and the root mean square that they leave, per degree of freedom."""
    values, vectors = np.linalg.eigh(rows @ rows.T)
    factors = vectors[:, -1] * np.sign(vectors[:, -1].sum())
    left = max(float(values[:-1].sum()), 0.0)
    return factors, float(np.sqrt(left / (rows.shape[1] * (len(rows) - 1))))


def merged(
    data: Array, valid: Array, calibration: Calibration, tint: Colours
) -> tuple[Array, Array, Calibration]:
    """Return data, valid pixels and calibration of one channel in the place of several."""
    psfs = calibration.psfs
    if psfs.shape[1] > 1:
        psfs = tint.merged(psfs, tint.psf)[:, None]
    return (
        tint.merged(data, tint.scene)[None],
        np.asarray(valid.all(axis=0))[None],
        replace(calibration, psfs=psfs),
    )


def channels_of(
    data: Array, deviation: Array, valid: Array, psfs: Array, overrides: Overrides
) -> tuple[Decision, Colours | None]:
    """Decide whether colour channels are reconstructed as one; also return how they are proportional."""
    n = len(data)
    if n == 1:
        return Decision("channels", "one", "the photograph has one channel", open=False), None
    common = int(np.count_nonzero(valid.all(axis=0)))
    if common < max(LEAST_COMMON, LEAST_COMMON_SHARE * valid[0].size):
        why = f"only {common} of {valid[0].size} pixels tell all colours, as with a colour mosaic"
        if overrides.channels == "merged":
            raise InputError(f"Channels cannot be merged: {why}. Leave channels=merged out.")
        return Decision("channels", f"all {n}", why, overruled=overrides.channels is not None), None
    tint = colours(data, deviation, valid, psfs)
    assert tint is not None
    numbers = {"misfit": tint.misfit, "psf_misfit": tint.psf_misfit}
    alike = tint.misfit <= CHANNEL_NOISE and tint.psf_misfit <= CHANNEL_PSF
    asked = overrides.channels is not None
    merge = overrides.channels == "merged" if asked else alike
    why = (
        f"channels proportional to one another miss the data by {tint.misfit:.2f} of its noise and the PSFs "
        f"by {tint.psf_misfit:.1%} (up to {CHANNEL_NOISE:g} and {CHANNEL_PSF:.0%} pass for alike)"
    )
    if merge:
        return Decision("channels", "merged", why, up=f"all {n}", overruled=asked, numbers=numbers), tint
    return Decision("channels", f"all {n}", why, down="merged", overruled=asked, numbers=numbers), tint
