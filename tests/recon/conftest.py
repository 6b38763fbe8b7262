"""A small lensless camera to test against, made without any of recon's own models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from recon.verdict.map import Stress

DrawnMap = Callable[[str, Sequence[float], str, Mapping[object, Sequence[float]]], str]

FINE = 3
"""The scene and the PSF are drawn on a grid this much finer than the sensor's."""


@dataclass(frozen=True)
class Shot:
    """A measurement with its PSF image and the true scene, all (height, width), on the sensor's grid."""

    measurement: np.ndarray
    psf: np.ndarray
    truth: np.ndarray
    noise: float


def caustic(height: int, width: int, seed: int) -> np.ndarray:
    """Rays through a smooth random height map, counted on a grid of ``height`` x ``width``."""
    rng = np.random.default_rng(seed)
    surface = gaussian_filter(rng.standard_normal((height, width)), height / 20, mode="wrap")
    slope_y, slope_x = np.gradient(surface / surface.std())
    rows, columns = np.mgrid[0:height:0.5, 0:width:0.5] + rng.random((2, 2 * height, 2 * width)) * 0.5
    i, j = rows.astype(int), columns.astype(int)
    inside = (abs(rows / height - 0.5) < 0.36) & (abs(columns / width - 0.5) < 0.36)
    throw = (height / 20) ** 2 / 2
    landed_y, landed_x = rows + throw * slope_y[i, j], columns + throw * slope_x[i, j]
    image, _, _ = np.histogram2d(
        landed_y[inside], landed_x[inside], bins=(height, width), range=((0, height), (0, width))
    )
    return gaussian_filter(image, 0.7)


def blocks(height: int, width: int, seed: int) -> np.ndarray:
    """Overlapping discs and rectangles of random size and brightness on black."""
    rng = np.random.default_rng(seed)
    scene = np.zeros((height, width))
    y, x = np.mgrid[:height, :width]
    for k in range(24):
        cy, cx = rng.uniform(0.15, 0.85, 2) * (height, width)
        a, b = rng.uniform(0.03, 0.2, 2) * height
        shape = (
            (abs(y - cy) < a) & (abs(x - cx) < b) if k % 2 else ((y - cy) / a) ** 2 + ((x - cx) / b) ** 2 < 1
        )
        scene[shape] = rng.random()
    return scene


def binned(image: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return image.reshape(height // FINE, FINE, width // FINE, FINE).mean(axis=(1, 3))


@pytest.fixture(scope="session")
def shoot() -> Callable[..., Shot]:
    """Photograph a scene: convolved on the fine grid at full size, cropped, binned, noise added."""

    def shoot(height: int = 65, width: int = 81, *, snr: float = 100.0, seed: int = 0) -> Shot:
        # Odd sizes: the fine grid's centre pixel then lies in the middle of the sensor's centre pixel.
        rng = np.random.default_rng(seed)
        psf = caustic(height * FINE, width * FINE, seed)
        scene = blocks(height * FINE, width * FINE, seed + 1)
        image = binned(fftconvolve(scene, psf, mode="same"))
        noise = image.mean() / snr
        return Shot(
            image + noise * rng.standard_normal(image.shape), binned(psf), binned(scene) * FINE**2, noise
        )

    return shoot


@pytest.fixture
def drawn_map(tmp_path: Path) -> DrawnMap:
    """Draw a map of severities when a test has failed: in text, and as a picture whose path is told.

    Called in an assertion's message, which is made only then.
    """

    def draw(x_name: str, x: Sequence[float], y_name: str, rows: Mapping[object, Sequence[float]]) -> str:
        from instrument.evaluation.figures import map_figure
        from instrument.files.figures import save_figure

        axes = (
            Stress(x_name, x_name, "", tuple(x), ()),
            Stress(y_name, y_name, "", tuple(range(len(rows))), ()),
        )
        grid = np.array(list(rows.values()), float)
        text = _as_text(*axes, grid)
        shown = {
            "title": f"{x_name} and {y_name}",
            "error": "severity",
            "x": {"label": x_name, "unit": "", "values": list(x)},
            "y": {"label": y_name, "unit": "", "values": [], "ticks": [str(name) for name in rows]},
            "methods": {"": {"severity": grid.tolist(), "error": grid.tolist()}},
        }
        picture = save_figure(map_figure(shown), tmp_path / "boundary.png")
        names = ", ".join(f"{k}: {name}" for k, name in enumerate(rows))
        return f"{text}\n{names}\nThe map: {picture}"

    return draw


def _as_text(x: Stress, y: Stress, severity: np.ndarray) -> str:
    """Draw a map in text: severities, failing ones marked with ``#``; the largest ``y`` on top."""
    lines = [f"{y.label} up, {x.label} to the right; # fails (severity >= 1)"]
    for value, row in reversed(list(zip(y.values, severity, strict=True))):
        lines.append(f"{value:>9.4g} | " + " ".join(f"{s:6.2f}{'#' if s >= 1 else ' '}" for s in row))
    lines.append(" " * 10 + "  " + " ".join(f"{v:>6.4g} " for v in x.values))
    return "\n".join(lines)
