"""The measured sets as scenes, each with what judges a picture of it: for ``measured.py``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.measured_blind import plain_admm
from benchmarks.measured_variants import alike
from recon import Calibration, reconstruct
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.blind.known_pictures import psf_from_pictures
from recon.blind.left_out import fare
from recon.evaluation.measured_sets import MeasuredSet, measured_pairs, measured_set


@dataclass(frozen=True)
class Scene:
    """A photograph, its calibration, and how good a picture of it is."""

    name: str
    photograph: Array
    calibration: Calibration | Array
    quality: Callable[[Array], float]
    """Of a picture or volume; more is better."""
    plain: Callable[[int, float], Array] | None = None
    """A plain ADMM's picture, from iterations and the weight of total variation."""


def load(name: MeasuredSet, binning: int) -> tuple[Calibration, Array]:
    """Return a set as a calibration of unknown depths, and its photograph, binned."""
    psfs, photograph = measured_set(name)
    height, width = (n // binning * binning for n in photograph.shape)
    psfs, photograph = (
        block_mean(a, binning) for a in (psfs[:, :height, :width], photograph[:height, :width])
    )
    return Calibration(psfs[:, None], np.full((len(psfs), 3), np.nan)), photograph


def ramp(volume: Array) -> float:
    """Return how linearly the brightest depth goes with x, weighed by its light: a correlation."""
    brightest = volume.max(axis=0)
    weight = (
        np.where(brightest > 0.3 * np.percentile(brightest, 99.9), brightest, 0).ravel().astype(np.float64)
    )
    depth, x = volume.argmax(axis=0).ravel(), np.tile(np.arange(volume.shape[2]), volume.shape[1])
    covariance = np.cov(np.stack([depth, x]), aweights=weight)
    return float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))


def hand(binning: int) -> Scene:
    """Return the hand, judged by dB to its converged picture after the best shift and gain."""
    calibration, photograph = load("hand", binning)
    psf = calibration.psfs[0, 0]
    truth = reconstruct(
        photograph, psf, solver="admm-sensor", iterations=400, tolerance=1e-5, judged=False
    ).image
    return Scene(
        f"hand, bin {binning}",
        photograph,
        calibration,
        lambda image: alike(image, truth)[0],
        lambda iterations, weight: plain_admm(photograph, psf, weight, iterations),
    )


def pairs(binning: int, chosen: Sequence[str]) -> list[Scene]:
    """Return pairs, each through the PSF that the other six give, judged by dB to what was shown."""
    names, photographs, pictures = measured_pairs()
    data, truths = (block_mean(images, binning, about_axis=True) for images in (photographs, pictures))
    truths = truths / truths.max()

    def of(number: int) -> Scene:
        others = np.arange(len(data)) != number
        solved = psf_from_pictures(data[others], truths[others])
        truth = np.moveaxis(truths[number] ** solved.gamma, 0, -1)

        def plain(iterations: int, weight: float) -> Array:
            channels = zip(data[number], solved.psf, strict=True)
            return np.stack([plain_admm(y, psf, weight, iterations) for y, psf in channels], axis=-1)

        photograph, psf = (np.ascontiguousarray(np.moveaxis(a, 0, -1)) for a in (data[number], solved.psf))
        return Scene(
            f"pair {names[number]}, bin {binning}",
            photograph,
            psf,
            lambda image: fare(image.reshape(truth.shape), truth)[0],
            plain,
        )

    return [of(names.index(name)) for name in chosen]


def usaf(binning: int) -> Scene:
    """Return the tilted target, judged by how linearly its depth falls over x."""
    calibration, photograph = load("usaf", binning)
    return Scene(f"USAF, bin {binning}", photograph, calibration, lambda volume: -ramp(volume))
