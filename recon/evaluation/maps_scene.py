"""Maps of what the scene asks for: its density against the measured pixels, and points close together."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from recon.analysis.condition import condition_number, gram_matrix, group
from recon.analysis.points import Noise, PointGrid, try_points
from recon.analysis.window import WindowProblem
from recon.evaluation.lenslets import LensletCamera, build_camera
from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import PIXELS, Options, run_scene, spec_at
from recon.verdict.failure import DIP, Failure, bounded
from recon.verdict.map import Axis, Size, StressMap, Trial

VOXELS = Axis(
    "lit",
    "voxels that are not dark",
    "share",
    (0.0003, 0.001, 0.003, 0.01, 0.03),
    (0.0003, 0.001, 0.003, 0.01),
    True,
)
DEPTHS = Axis("depths", "voxels per pixel (depth planes)", "planes", (1, 2, 4, 8), (1, 2, 8), True)
LEAVES = Axis("leaves", "edges: shapes in the picture", "shapes", (4, 10, 25, 60, 150), (4, 20, 100), True)
PER_PIXEL = Axis(
    "per_pixel", "unknowns per measured pixel", "by erasing", (1, 1.5, 2.5, 5, 10), (1, 2, 4), True
)
SEPARATION = Axis(
    "separation", "separation of neighbours", "pixels", (1, 1.5, 2, 2.5, 3, 4, 5, 6), (1.5, 2.5, 4, 6)
)
SOURCES = Axis("sources", "points in a row", "points", (2, 3, 4, 6, 8, 12, 16), (2, 4, 8), True)

BEADS_AT_1 = 30
LEAVES_AT_1 = 45
"""How many there are at density 1, see :mod:`recon.evaluation.content`."""


def _lit_voxels(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    depths = int(y)
    beads = max(x * depths * PIXELS[size] ** 2, 1)
    flat = depths == 1
    base = SceneSpec("beads", depths=depths, z_near=3.0, z_far=5.0, layers=(0.5, 0.5) if flat else (0.0, 1.0))
    spec = spec_at(base, size, seed, density=beads / BEADS_AT_1)
    return run_scene(spec, method, Options(), size)


def _edges(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    base = SceneSpec("dense-picture", photons=30_000.0)
    spec = spec_at(base, size, seed, density=x / LEAVES_AT_1, erased=1 - 1 / y)
    return run_scene(spec, method, Options(), size)


CAMERA_PX = 96
CAMERA_DEPTH = 6.0
"""Depth of the points relative to the distance from diffuser to sensor."""


@lru_cache(maxsize=2)
def _camera(seed: int) -> LensletCamera:
    return build_camera(CAMERA_PX, optics="smooth", seed=seed, focus=CAMERA_DEPTH)


def point_image(camera: LensletCamera, columns: float) -> npt.NDArray[np.float32]:
    """Return the image of a point ``columns`` pixels from the axis at the tests' depth."""
    z_um = CAMERA_DEPTH * camera.distance_um
    return camera.light([[-columns * camera.pitch_um * z_um / camera.distance_um, 0.0, z_um, 1.0]])


def _neighbours(_method: str, x: float, y: float, seed: int, _size: Size) -> Trial:
    camera, count = _camera(seed), int(y)
    problem = WindowProblem(point_image(camera, 0.0)[None], (2, 3 + int(np.ceil(count * x / 2)) + 2))
    trial = try_points(
        problem,
        lambda columns, _s: point_image(camera, columns),
        PointGrid(count, separation_px=x),
        Noise(10_000.0, 2.0),
        seed=seed,
        trials=2,
    )
    return Trial(local_condition(camera, count, x), {Failure.DIP: bounded(DIP / max(trial.dip, 1e-3))})


def local_condition(camera: LensletCamera, count: int, separation_px: float) -> float:
    """Return the condition number of points in a row at any separation (Kuo 2020, Fig. 4.5)."""
    places = (np.arange(count) - (count - 1) / 2) * separation_px
    images = np.stack([point_image(camera, float(p)).ravel() for p in places]).astype(np.float64)
    return condition_number(images @ images.T)


def on_pixels(camera: LensletCamera, count: int, separation_px: int) -> float:
    """Return the same for whole pixels from one PSF, as :mod:`recon.analysis.condition` does."""
    psf = point_image(camera, 0.0)[None]
    return condition_number(gram_matrix(psf, group("x", count, separation_px)))


MAPS = (
    StressMap(
        "density-voxels",
        "Density of a volume of points against voxels per pixel",
        "How full may a volume be, and over how many depths?",
        VOXELS,
        DEPTHS,
        ("volume l1", "volume tv"),
        _lit_voxels,
    ),
    StressMap(
        "density-edges",
        "Density of edges against unknowns per pixel",
        "How busy may a picture be when there are fewer pixels than unknowns?",
        LEAVES,
        PER_PIXEL,
        ("admm tv",),
        _edges,
    ),
    StressMap(
        "neighbours",
        "Separation and number of points, and their local condition number",
        "How close may points be, and how many of them? The numbers are local condition numbers.",
        SEPARATION,
        SOURCES,
        ("least squares, smooth diffuser",),
        _neighbours,
        error="local condition number",
    ),
)
