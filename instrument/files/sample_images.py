"""Pictures to try things on: some ship inside Matplotlib's wheel, others are drawn here.

All are grey, square, float64 in 0 to 1, and are taken as intensities.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from recon.arrays import Float64Array


@dataclass(frozen=True, slots=True)
class Sample:
    """A sample picture: where it comes from, and how to get it."""

    source: str
    load: Callable[[], Float64Array]


def load_sample(name: str, shape: tuple[int, int]) -> Float64Array:
    """Return a sample picture resampled to a shape (stretched: the field of view is square)."""
    image = SAMPLES[name].load()
    shrinks = shape[0] <= image.shape[0] and shape[1] <= image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (shape[1], shape[0]), interpolation=how).clip(0, 1), np.float64)


def _matplotlib_file(name: str) -> Path:
    import matplotlib

    path = Path(matplotlib.get_data_path()) / "sample_data" / name
    if not path.exists():
        raise FileError(path, "is not there: this installation of Matplotlib lacks its sample data.")
    return path


def _portrait() -> Float64Array:
    image = cv2.imread(str(_matplotlib_file("grace_hopper.jpg")), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image[:512, :].astype(np.float64) / 255


def portrait_in_colour(side: int) -> npt.NDArray[np.uint8]:
    """Return the portrait in colour, coded for a screen, (side, side, 3)."""
    image = cv2.imread(str(_matplotlib_file("grace_hopper.jpg")))
    assert image is not None
    small = cv2.resize(image[:512, :], (side, side), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])


def _relief() -> Float64Array:
    """Elevation, lit from the north-west."""
    with np.load(_matplotlib_file("jacksboro_fault_dem.npz")) as file:
        elevation: Float64Array = file["elevation"].astype(np.float64)[:344, :344]
    y, x = np.gradient(elevation, 90.0)
    return np.asarray(np.clip(0.5 + 1.2 * (x - y), 0, 1), np.float64)


def _head() -> Float64Array:
    """Magnetic resonance slice."""
    with gzip.open(_matplotlib_file("s1045.ima.gz")) as file:
        pixels = np.frombuffer(file.read(), np.uint16).reshape(256, 256)
    return np.asarray(pixels / float(pixels.max()), np.float64)


def dead_leaves(seed: int, contrast: float) -> Float64Array:
    """Dead leaves: overlapping discs of all sizes, whose statistics are like a photograph's."""
    n = 512
    rng = np.random.default_rng(seed)
    image = np.full((n, n), -1.0)
    y, x = np.mgrid[:n, :n]
    while (image < 0).any():
        radius = min(n / 3, 4 + 4 * rng.pareto(2))
        cy, cx = rng.uniform(-radius, n + radius, 2)
        top, left = max(0, int(cy - radius)), max(0, int(cx - radius))
        box = np.s_[top : max(top, int(cy + radius) + 2), left : max(left, int(cx + radius) + 2)]
        hit = ((y[box] - cy) ** 2 + (x[box] - cx) ** 2 < radius**2) & (image[box] < 0)
        image[box][hit] = 0.5 + contrast * (rng.beta(2, 2) - 0.5)
    return image


def _clouds() -> Float64Array:
    """Noise with the 1/f spectrum of photographs."""
    n = 512
    f = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :])
    f[0, 0] = np.inf
    rng = np.random.default_rng(4)
    spectrum = (rng.normal(size=f.shape) + 1j * rng.normal(size=f.shape)) / f
    image = np.fft.irfft2(spectrum, (n, n))
    return np.asarray(np.clip(0.5 + image / (5 * image.std()), 0, 1), np.float64)


SAMPLES: Mapping[str, Sample] = {
    "portrait": Sample("Matplotlib's sample data, grace_hopper.jpg (public domain)", _portrait),
    "relief": Sample("Matplotlib's sample data, jacksboro_fault_dem.npz, shaded", _relief),
    "head": Sample("Matplotlib's sample data, s1045.ima.gz (MRI slice)", _head),
    "leaves": Sample("drawn here: dead-leaves model, full contrast", lambda: dead_leaves(1, 1.0)),
    "soft leaves": Sample("drawn here: dead-leaves model, 70 % contrast", lambda: dead_leaves(2, 0.7)),
    "clouds": Sample("drawn here: 1/f noise", _clouds),
}

DEFAULT_SAMPLES = ("portrait", "relief", "leaves")
"""Full-range pictures with the statistics of photographs. The others are much harder (the head, mostly black
and white) or much easier (low contrast) for a holographic display than photographs are."""
