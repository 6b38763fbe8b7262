"""Maps of a calibration that no longer fits: depth, movement, colour, and points too far apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.evaluation.lenslets import DISTANCE, PITCH_UM
from recon.evaluation.maps_light import ELECTRONS, PICTURE, scene_map
from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import PIXELS, Options, judge, run_scene, scene_of, solve, spec_at
from recon.verdict.map import Axis, Size, StressMap, Trial

SIZE_ERROR = Axis(
    "size_error", "depth error: PSF too large by", "%", (0.5, 1, 2, 3, 5, 8), (1, 3, 5, 8), logarithmic=True
)
ROTATION = Axis("drift_deg", "rotation", "degrees", (0.3, 1, 3, 5, 8, 12), (1, 3, 5, 8), logarithmic=True)
SCALE = Axis(
    "drift_scale", "swelling", "relative", (0.003, 0.01, 0.03, 0.1, 0.2), (0.01, 0.03, 0.1, 0.2), True
)
SHIFT = Axis("drift_px", "shift", "pixels", (0.1, 0.3, 0.6, 1, 2, 4), (0.3, 1, 4), logarithmic=True)
COLOUR = Axis(
    "colour", "deflection at another colour", "% more", (0.3, 1, 3, 5, 10, 20), (1, 5, 20), logarithmic=True
)
SPACED = replace(PICTURE, z_near=1.0, z_far=1.0, photons=10_000.0)


def _spacing(points: float, size: Size) -> str:
    spec = replace(SPACED, size=PIXELS[size])
    extent_um = spec.grid_field * PIXELS[size] * PITCH_UM * spec.z_near
    return f"{points:g}" if points < 2 else f"{points:g}\n{extent_um / (points - 1):.0f} um apart"


def _width(sigma_deg: float, size: Size) -> str:
    distance_um = SPACED.z_near * DISTANCE * PIXELS[size] * PITCH_UM
    return f"{sigma_deg:g}\n{distance_um * np.tan(np.deg2rad(sigma_deg)):.0f} um"


POINTS_A_SIDE = Axis(
    "grid", "calibration points along a side", "points", (1, 2, 3, 5, 7), (1, 3, 5), named=_spacing
)
FALL_OFF = Axis(
    "fall_off_deg",
    "angular response, sigma",
    "degrees; um in the scene",
    (6, 9, 13, 20, 40),
    (9, 13, 40),
    named=_width,
)

MEAN_INVERSE, INVERSE_RANGE = (1 / 12 + 1 / 4) / 2, 1 / 4 - 1 / 12
"""Inverse depths of the default scenes, relative to the distance from diffuser to sensor."""


def _depth(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    # The PSF's size goes as 1 + d / z; the scene's place in depth is what makes it too large.
    place = 0.5 - x / 100 * (1 + MEAN_INVERSE) / INVERSE_RANGE
    base = SceneSpec("beads", depths=1, layers=(place, place))
    return run_scene(spec_at(base, size, seed, photons=y), method, Options(), size)


def _colour(method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    name, _, optics = method.partition(", ")
    spec = spec_at(replace(PICTURE, optics=optics.split()[0]), size, seed, photons=y)  # type: ignore[arg-type]
    scene = scene_of(spec)
    rng = np.random.default_rng([seed, 5])
    camera = replace(scene.camera, dispersion=x / 100)
    light = camera.light(scene.points, 2)
    counts = rng.poisson(light * (y / float(light.max()))) + rng.normal(0, spec.read_noise_e, light.shape)
    other = replace(scene, measurement=counts.astype(np.float32), camera=camera)
    return judge(other, solve(other, name, Options(), None))


MAPS = (
    StressMap(
        "depth-error",
        "Depth error of the PSF and light",
        "How wrong may the depth be for which the PSF was measured?",
        SIZE_ERROR,
        ELECTRONS,
        ("admm l1", "admm tv"),
        _depth,
    ),
    scene_map(
        "drift",
        "Drift of the diffuser: rotation and swelling",
        "How far may the diffuser turn and swell before a new calibration is due?",
        PICTURE,
        ROTATION,
        SCALE,
        ("admm tv", "admm l1", "wiener"),
    ),
    scene_map(
        "shift",
        "Drift of the diffuser: shift and rotation",
        "A shifted diffuser shifts the picture: how far until it is at the wrong place?",
        PICTURE,
        SHIFT,
        ROTATION,
        ("admm tv",),
    ),
    StressMap(
        "colour",
        "PSF of another colour, and light",
        "How different may the colour be in which the PSF was measured?",
        COLOUR,
        ELECTRONS,
        ("admm tv, smooth diffuser", "admm tv, random lenslets"),
        _colour,
    ),
    scene_map(
        "spacing",
        "Spacing of calibration points and width of the angular response",
        "How many points over the field does a sensor need whose response falls off with the angle?",
        SPACED,
        POINTS_A_SIDE,
        FALL_OFF,
        ("admm tv",),
    ),
)
