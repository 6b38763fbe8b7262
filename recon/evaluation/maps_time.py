"""Maps of priors over time: where a video's frames help one another, and where they hurt."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.evaluation.lenslets import LensletCamera, build_camera
from recon.evaluation.scene_trial import PIXELS
from recon.streams.joint import OverTimeName, solve_together
from recon.streams.video import stream_problem
from recon.verdict.failure import Failure, bounded, relative_error
from recon.verdict.map import Axis, Size, StressMap, Trial

Array = npt.NDArray[Any]

LIGHT = Axis(
    "photons",
    "light at the brightest pixel",
    "electrons",
    (10, 30, 100, 300, 1000),
    (30, 300),
    logarithmic=True,
)
MOTION = Axis("motion", "motion", "pixels a frame", (0, 0.03, 0.1, 0.3, 1, 3), (0, 0.3, 3))
ACTIVE = Axis(
    "active",
    "points that flash in a frame",
    "share",
    (0.01, 0.03, 0.1, 0.3, 0.5),
    (0.03, 0.5),
    logarithmic=True,
)
METHODS: dict[str, OverTimeName] = {"temporal tv": "tv", "low rank + sparse": "lowrank"}
FRAMES: dict[Size, int] = {"quick": 8, "full": 16}
ITERATIONS: dict[Size, int] = {"quick": 30, "full": 60}
POINTS = 14
READ_NOISE_E = 2.0
FLASH = 1.0
"""What a flash adds, relative to a point's light at rest."""
SHARE_ACTIVE = 0.1
"""Share of points that flash in a frame where motion is the stress."""
BASE = f"{POINTS} points, {FRAMES['full']} frames, flashes of {FLASH} in {SHARE_ACTIVE}"


@dataclass(frozen=True)
class Video:
    """Frames of points that drift and flash.

    Attributes
    ----------
    psf : ndarray, (height, width)
    frames : ndarray, float32, (n_frames, height, width)
        Photo-electrons.
    truth : ndarray, (n_frames, height, width)
        The points' light, blurred by one pixel.
    """

    psf: Array
    frames: Array
    truth: Array


@lru_cache(maxsize=2)
def video_of(pixels: int, n_frames: int, motion_px: float, active: float, photons: float, seed: int) -> Video:
    """Cast a video, point by point at continuous places: no grid, no convolution."""
    rng = np.random.default_rng([seed, 12])
    camera = build_camera(pixels, seed=1 + seed)
    places = rng.uniform(-0.35, 0.35, (POINTS, 2)) * pixels
    flashes = rng.random((POINTS, n_frames)) < active
    light = rng.uniform(0.5, 1.5, (POINTS, 1)) * (1 + FLASH * flashes)
    way = motion_px * (np.arange(n_frames) - (n_frames - 1) / 2)
    seen = [places + np.array([0.0, w]) for w in way]
    clean = np.stack([_cast(camera, at, light[:, t]) for t, at in enumerate(seen)])
    counts = rng.poisson(clean * (photons / clean.max())) + rng.normal(0, READ_NOISE_E, clean.shape)
    truth = np.stack([_picture(pixels, at, light[:, t]) for t, at in enumerate(seen)])
    return Video(_cast(camera, np.zeros((1, 2)), np.ones(1)), counts.astype(np.float32), truth)


def _cast(camera: LensletCamera, places: Array, light: Array) -> Array:
    scale = camera.pitch_um * camera.focus_um / camera.distance_um
    depth = np.full(len(places), camera.focus_um)
    return camera.light(np.column_stack([-places[:, 1] * scale, -places[:, 0] * scale, depth, light]))


def _picture(pixels: int, places: Array, light: Array) -> Array:
    """Return points as a picture, each shared by its four nearest pixels, blurred by one pixel."""
    from scipy.ndimage import gaussian_filter

    image = np.zeros((pixels, pixels))
    for place, value in zip(places + pixels // 2, light, strict=True):
        corner = np.floor(place).astype(int)
        for offset in np.ndindex(2, 2):
            y, x = corner + offset
            if 0 <= y < pixels and 0 <= x < pixels:
                image[y, x] += value * float(np.prod(1 - np.abs(place - (y, x))))
    return np.asarray(gaussian_filter(image, 1.0))


@lru_cache(maxsize=2)
def _alone(key: tuple[int, int, float, float, float, int], iterations: int) -> float:
    """Return the error of frames that know nothing of one another, by the same solver."""
    return _error(video_of(*key), "tv", 0.0, iterations)


def _error(video: Video, name: OverTimeName, weight: float, iterations: int) -> float:
    from scipy.ndimage import gaussian_filter

    problem = stream_problem(video.frames[0], video.psf)
    pictures = solve_together(problem, video.frames, name, weight=weight, iterations=iterations)
    assert pictures is not None  # nothing ends it before
    return relative_error(gaussian_filter(pictures, (0, 1, 1)), video.truth)


def _trial(what: str, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    motion_px, active = (x, SHARE_ACTIVE) if what == "motion" else (0.0, x)
    key = (PIXELS[size], FRAMES[size], motion_px, active, y, seed)
    ratio = _error(video_of(*key), METHODS[method], 1.0, ITERATIONS[size]) / _alone(key, ITERATIONS[size])
    return Trial(100 * (ratio - 1), {Failure.ALONE: bounded(ratio)})


MAPS = (
    StressMap(
        "over-time-motion",
        "Priors over time: motion and light",
        "How fast may points of a video move before a prior over time does more harm than good?",
        MOTION,
        LIGHT,
        tuple(METHODS),
        partial(_trial, "motion"),
        error="NRMSE, change in %",
        base=BASE,
    ),
    StressMap(
        "over-time-activity",
        "Priors over time: activity and light",
        "How many of the points may change from frame to frame?",
        ACTIVE,
        LIGHT,
        tuple(METHODS),
        partial(_trial, "activity"),
        error="NRMSE, change in %",
        base=BASE,
    ),
)
