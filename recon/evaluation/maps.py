"""All stability maps: a row each, and how one is run, every cell once, the coarse ones first."""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from recon.errors import InputError
from recon.evaluation.lenslets import DISTANCE, PITCH_UM
from recon.evaluation.map_trials import (
    FLASHES,
    HOLOGRAMS,
    OVER_TIME,
    STEPS,
    misplaced,
    neighbours,
    over_time,
    penalties,
    precision,
)
from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import (
    LEFT_OUT,
    PIXELS,
    SUBTRACTED,
    Options,
    of_another_colour,
    run_scene,
    spec_at,
)
from recon.evaluation.trial import own_methods
from recon.verdict.cases import OF_VOLUMES
from recon.verdict.map import Cell, Size, Stress, StressMap, Trial, cell_of

# Scenes ---------------------------------------------------------------------------------------------
PICTURE = SceneSpec("sparse-picture")
DENSE = SceneSpec("dense-picture", density=0.3)
POINTS = SceneSpec("beads", depths=1, layers=(0.5, 0.5))
BEADS = SceneSpec("beads", depths=4, density=0.4, z_near=3.0, z_far=5.0)
SPACED = replace(PICTURE, z_near=1.0, z_far=1.0, photons=10_000.0)

BEADS_AT_1, LEAVES_AT_1 = 30, 45
"""How many there are at density 1, see :mod:`recon.evaluation.content`."""
MEAN_INVERSE, INVERSE_RANGE = (1 / 12 + 1 / 4) / 2, 1 / 4 - 1 / 12
"""Inverse depths of the default scenes, relative to the distance from diffuser to sensor."""


def _spacing(points: float, size: Size) -> str:
    extent_um = SPACED.grid_field * PIXELS[size] * PITCH_UM * SPACED.z_near
    return f"{points:g}" if points < 2 else f"{points:g}\n{extent_um / (points - 1):.0f} um apart"


def _width(sigma_deg: float, size: Size) -> str:
    distance_um = SPACED.z_near * DISTANCE * PIXELS[size] * PITCH_UM
    return f"{sigma_deg:g}\n{distance_um * np.tan(np.deg2rad(sigma_deg)):.0f} um"


# Stresses: key, what, unit, full values, quick values, logarithmic ----------------------------------
_LIGHT = ("photons", "light at the brightest pixel", "electrons")
ELECTRONS = Stress(*_LIGHT, (10, 30, 100, 300, 1000, 3000, 30_000), (10, 100, 1000, 10_000), True)
LIGHT_OF_VIDEO = Stress(*_LIGHT, (10, 30, 100, 300, 1000), (30, 300), True)
READ_NOISE = Stress("read_noise_e", "read noise", "electrons", (1, 3, 10, 30, 100), (1, 10, 100), True)
ERASED = Stress("erased", "erased pixels", "share", (0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95), (0, 0.4, 0.8, 0.95))
SATURATED = Stress(
    "saturation",
    "full scale",
    "of the brightest pixel",
    (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1),
    (0.2, 0.4, 0.6, 1),
)
BACKGROUND = Stress(
    "background",
    "smooth background",
    "of the scene's mean",
    (0.03, 0.1, 0.3, 1, 3, 10, 30),
    (0.1, 1, 10, 30),
    True,
)
DEPTHS = Stress("depths", "depth planes over the same range", "planes", (2, 4, 8, 12), (2, 8), True)
FARTHEST = Stress(
    "z_far",
    "farthest plane (nearest: 3)",
    "distances from diffuser to sensor",
    (4, 5, 7, 10, 15),
    (4, 6, 9, 15),
    True,
)
SIZE_ERROR = Stress(
    "size_error", "depth error: PSF too large by", "%", (0.5, 1, 2, 3, 5, 8), (1, 3, 5, 8), True
)
ROTATION = Stress("drift_deg", "rotation", "degrees", (0.3, 1, 3, 5, 8, 12), (1, 3, 5, 8), True)
FINE_ROTATION = Stress("drift_deg", "rotation", "degrees", (0.1, 0.3, 0.6, 1, 2, 4), (0.1, 0.5, 2), True)
SWELLING = Stress(
    "drift_scale", "swelling", "relative", (0.003, 0.01, 0.03, 0.1, 0.2), (0.01, 0.03, 0.1, 0.2), True
)
FINE_SWELLING = Stress(
    "drift_scale", "swelling", "relative", (0.001, 0.003, 0.01, 0.03), (0.001, 0.005, 0.02), True
)
SHIFT = Stress("drift_px", "shift", "pixels", (0.1, 0.3, 0.6, 1, 2, 4), (0.3, 1, 4), True)
COLOUR = Stress("colour", "deflection at another colour", "% more", (0.3, 1, 3, 5, 10, 20), (1, 5, 20), True)
POINTS_A_SIDE = Stress(
    "grid", "calibration points along a side", "points", (1, 2, 3, 5, 7), (1, 3, 5), named=_spacing
)
FALL_OFF = Stress(
    "fall_off_deg",
    "angular response, sigma",
    "degrees; um in the scene",
    (6, 9, 13, 20, 40),
    (9, 13, 40),
    named=_width,
)
VOXELS = Stress(
    "lit",
    "voxels that are not dark",
    "share",
    (0.0003, 0.001, 0.003, 0.01, 0.03),
    (0.0003, 0.001, 0.003, 0.01),
    True,
)
PLANES = Stress("depths", "voxels per pixel (depth planes)", "planes", (1, 2, 4, 8), (1, 2, 8), True)
LEAVES = Stress("leaves", "edges: shapes in the picture", "shapes", (4, 10, 25, 60, 150), (4, 20, 100), True)
PER_PIXEL = Stress(
    "per_pixel", "unknowns per measured pixel", "by erasing", (1, 1.5, 2.5, 5, 10), (1, 2, 4), True
)
SEPARATION = Stress(
    "separation", "separation of neighbours", "pixels", (1, 1.5, 2, 2.5, 3, 4, 5, 6), (1.5, 2.5, 4, 6)
)
SOURCES = Stress("sources", "points in a row", "points", (2, 3, 4, 6, 8, 12, 16), (2, 4, 8), True)
ITERATIONS = Stress("iterations", "iterations", "", (30, 100, 300, 1000), (30, 100), True)
SIDE = Stress("pixels", "size of the picture", "pixels", (32, 64, 128, 256), (32, 64), True)
PENALTY = Stress("penalty", "penalty or step", "of the default", (0.1, 0.3, 1, 3, 10), (0.1, 1, 10), True)
WEIGHT = Stress("weight", "weight of the prior", "of the default", (0.1, 0.3, 1, 3, 10), (0.1, 1, 10), True)
MOTION = Stress("motion", "motion", "pixels a frame", (0, 0.03, 0.1, 0.3, 1, 3), (0, 0.3, 3))
ACTIVE = Stress(
    "active", "points that flash in a frame", "share", (0.01, 0.03, 0.1, 0.3, 0.5), (0.03, 0.5), True
)
_OF_MASK = ("mask pixels", (0, 0.1, 0.25, 0.5, 1, 2), (0, 0.25, 1))
MASK_SHIFT = Stress("shift_x", "shift of the mask", *_OF_MASK)
ROLL = Stress("roll", "rotation: shift at the edge", *_OF_MASK)
DEFOCUS = Stress("z_um", "mask too far by", "um", (0, 5, 12, 25, 50, 100), (0, 25, 100))
DISTORTION = Stress("cubic", "distortion: shift at the corners", *_OF_MASK)

# Rows -----------------------------------------------------------------------------------------------
_TV_L1 = ("admm tv" + OF_VOLUMES, "admm l1" + OF_VOLUMES)
_L1_TV = _TV_L1[::-1]
NOT_SUBTRACTED = Options(subtract_background=False)
Changes = Callable[[float, float, int], Mapping[str, Any]]
"""``changes(x, y, pixels)`` of a scene's numbers at a place of a map."""


def _of_scene(
    title: str,
    question: str,
    what: tuple[SceneSpec, Stress, Stress],
    methods: tuple[str, ...],
    options: Options | None = None,
    changes: Changes | None = None,
) -> StressMap:
    """Return a map of a scene; its axes are fields of a ``SceneSpec``, or change some."""
    (base, x, y), chosen = what, options or Options()

    def trial(method: str, at_x: float, at_y: float, seed: int, size: Size) -> Trial:
        changed = changes(at_x, at_y, PIXELS[size]) if changes else {x.key: at_x, y.key: at_y}
        return run_scene(spec_at(base, size, seed, **changed), method, chosen, size)

    return StressMap("", title, question, x, y, methods, trial, base=f"{base} {chosen}")


def _of_video(what: str, title: str, question: str, x: Stress) -> StressMap:
    trial, name, error = partial(over_time, what), f"over-time-{what}", "NRMSE, change in %"
    return StressMap(name, title, question, x, LIGHT_OF_VIDEO, tuple(OVER_TIME), trial, error, FLASHES)


def _of_mask(kind: str, title: str, question: str, axes: tuple[Stress, Stress]) -> StressMap:
    trial, name = partial(misplaced, kind), f"mask-{kind}"
    return StressMap(name, title, question, *axes, tuple(HOLOGRAMS), trial, "PSNR (dB)")


def _too_large(x: float, y: float, _pixels: int) -> Mapping[str, Any]:
    # The PSF's size goes as 1 + d / z; the scene's place in depth is what makes it too large.
    place = 0.5 - x / 100 * (1 + MEAN_INVERSE) / INVERSE_RANGE
    return {"photons": y, "layers": (place, place)}


def _lit_voxels(x: float, y: float, pixels: int) -> Mapping[str, Any]:
    layers = (0.5, 0.5) if y == 1 else (0.0, 1.0)
    return {"depths": int(y), "layers": layers, "density": max(x * int(y) * pixels**2, 1) / BEADS_AT_1}


def _edges(x: float, y: float, _pixels: int) -> Mapping[str, Any]:
    return {"density": x / LEAVES_AT_1, "erased": 1 - 1 / y}


_OF_SCENES: dict[str, StressMap] = {
    "light": _of_scene(
        "Light and read noise: strokes on black",
        "How much light does a picture on a dark ground need, and how much read noise does it stand?",
        (PICTURE, ELECTRONS, READ_NOISE),
        ("admm tv", "admm l1", "admm-sensor tv", "fista tv", "wiener"),
    ),
    "light-dense": _of_scene(
        "Light and read noise: a full picture",
        "The same for a picture that fills the field: every pixel carries light from everywhere.",
        (DENSE, ELECTRONS, READ_NOISE),
        ("admm tv", "wiener"),
    ),
    "light-points": _of_scene(
        "Light and read noise: points",
        "How much light do thirty points need?",
        (POINTS, ELECTRONS, READ_NOISE),
        ("admm l1", "admm tv", "wiener"),
    ),
    "erasures": _of_scene(
        "Erased pixels and light",
        "What share of the pixels may be missing, with how much light?",
        (PICTURE, ERASED, ELECTRONS),
        ("admm tv", "admm l1"),
    ),
    "saturation": _of_scene(
        "Saturated pixels and light",
        "How far may a picture be overexposed, when saturated pixels are used as they are, or left out?",
        (PICTURE, SATURATED, ELECTRONS),
        ("admm tv", "admm tv" + LEFT_OUT),
    ),
    "background": _of_scene(
        "Background and light",
        "How much smooth stray light does a picture stand, when nobody subtracts it, or when it is known?",
        (PICTURE, BACKGROUND, ELECTRONS),
        ("admm tv", "admm l1", "wiener", "admm tv" + SUBTRACTED),
        NOT_SUBTRACTED,
    ),
    "background-points": _of_scene(
        "Background and light: points",
        "How much smooth stray light do thirty points stand that nobody subtracts?",
        (POINTS, BACKGROUND, ELECTRONS),
        ("admm l1", "admm tv", "wiener"),
        NOT_SUBTRACTED,
    ),
    "light-volume": _of_scene(
        "Light and number of depths: points in a volume",
        "How much light do twelve points in a volume need, and into how many depths may it be divided?",
        (BEADS, ELECTRONS, DEPTHS),
        _L1_TV,
    ),
    "light-dense-volume": _of_scene(
        "Light and number of depths: sheets, blobs and threads",
        "The same for a volume that is full of things.",
        (SceneSpec("dense-volume", depths=2), ELECTRONS, DEPTHS),
        _TV_L1,
    ),
    "depth-range": _of_scene(
        "Range of depths and light",
        "How far behind the nearest points may others lie? Light falls with the square of the distance.",
        (BEADS, FARTHEST, ELECTRONS),
        _L1_TV,
    ),
    "drift-volume": _of_scene(
        "Drift of the diffuser before a volume: rotation and swelling",
        "How far may the diffuser turn and swell before points in a volume are lost?",
        (BEADS, FINE_ROTATION, FINE_SWELLING),
        _L1_TV,
    ),
    "background-volume": _of_scene(
        "Background and light: a volume",
        "How much smooth stray light does a volume stand that nobody subtracts or estimates?",
        (BEADS, BACKGROUND, ELECTRONS),
        _L1_TV,
        NOT_SUBTRACTED,
    ),
    "density-voxels": _of_scene(
        "Density of a volume of points against voxels per pixel",
        "How full may a volume be, and over how many depths?",
        (SceneSpec("beads", z_near=3.0, z_far=5.0), VOXELS, PLANES),
        _L1_TV,
        changes=_lit_voxels,
    ),
    "density-edges": _of_scene(
        "Density of edges against unknowns per pixel",
        "How busy may a picture be when there are fewer pixels than unknowns?",
        (SceneSpec("dense-picture", photons=30_000.0), LEAVES, PER_PIXEL),
        ("admm tv",),
        changes=_edges,
    ),
    "depth-error": _of_scene(
        "Depth error of the PSF and light",
        "How wrong may the depth be for which the PSF was measured?",
        (SceneSpec("beads", depths=1), SIZE_ERROR, ELECTRONS),
        ("admm l1", "admm tv"),
        changes=_too_large,
    ),
    "drift": _of_scene(
        "Drift of the diffuser: rotation and swelling",
        "How far may the diffuser turn and swell before a new calibration is due?",
        (PICTURE, ROTATION, SWELLING),
        ("admm tv", "admm l1", "wiener"),
    ),
    "shift": _of_scene(
        "Drift of the diffuser: shift and rotation",
        "A shifted diffuser shifts the picture: how far until it is at the wrong place?",
        (PICTURE, SHIFT, ROTATION),
        ("admm tv",),
    ),
    "colour": StressMap(
        "",
        "PSF of another colour, and light",
        "How different may the colour be in which the PSF was measured?",
        COLOUR,
        ELECTRONS,
        ("admm tv, smooth diffuser", "admm tv, random lenslets"),
        partial(of_another_colour, PICTURE),
    ),
    "spacing": _of_scene(
        "Spacing of calibration points and width of the angular response",
        "How many points over the field does a sensor need whose response falls off with the angle?",
        (SPACED, POINTS_A_SIDE, FALL_OFF),
        ("admm tv",),
    ),
}
"""Maps whose methods are a solver and a prior, which any scene can be reconstructed by."""

_OTHERS = (
    StressMap(
        "neighbours",
        "Separation and number of points, and their local condition number",
        "How close may points be, and how many of them? The numbers are local condition numbers.",
        SEPARATION,
        SOURCES,
        ("least squares, smooth diffuser",),
        neighbours,
        error="local condition number",
    ),
    StressMap(
        "precision",
        "float32 against float64: size and iterations",
        "Is single precision enough for large pictures and long runs?",
        ITERATIONS,
        SIDE,
        ("admm tv", "fista tv"),
        precision,
        error="difference",
    ),
    StressMap(
        "parameters",
        "Penalties and steps, and the prior's weight",
        "What happens when a solver's penalty or step, or the prior's weight, is wrong?"
        f" After {STEPS} iterations.",
        PENALTY,
        WEIGHT,
        ("admm tv", "admm-sensor tv", "fista tv", *_TV_L1),
        partial(penalties, PICTURE),
    ),
    _of_video(
        "motion",
        "Priors over time: motion and light",
        "How fast may points of a video move before a prior over time does more harm than good?",
        MOTION,
    ),
    _of_video(
        "activity",
        "Priors over time: activity and light",
        "How many of the points may change from frame to frame?",
        ACTIVE,
    ),
    _of_mask(
        "moved",
        "Misaligned mask of a holographic display: shift and rotation",
        "How exactly must the mask lie where the hologram believes it?",
        (MASK_SHIFT, ROLL),
    ),
    _of_mask(
        "defocus",
        "Misaligned mask of a holographic display: defocus and distortion",
        "How exactly must the mask's distance and the relay's distortion be known?",
        (DEFOCUS, DISTORTION),
    ),
)

MAPS: dict[str, StressMap] = {
    **{name: replace(stress, name=name) for name, stress in _OF_SCENES.items()},
    **{stress.name: stress for stress in _OTHERS},
}


# Running one ----------------------------------------------------------------------------------------
def map_named(name: str) -> StressMap:
    """Return a map by its name, with the methods that others' packages, or this program, have registered."""
    if name not in MAPS:
        near = difflib.get_close_matches(name, MAPS, 1)
        meant = f" Did you mean {near[0]!r}?" if near else ""
        raise InputError(f"There is no map {name!r}. Maps: {', '.join(MAPS)}.{meant}")
    stress = MAPS[name]
    first = stress.methods[0]
    if name not in _OF_SCENES or "," in first:
        return stress
    return replace(stress, methods=(*stress.methods, *own_methods(volume=first.endswith(OF_VOLUMES))))


def cells_of(stress: StressMap, size: Size, methods: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return every cell ``(method, ix, iy)`` of a map, the coarse ones first."""
    n_x, n_y = len(stress.x.at(size)), len(stress.y.at(size))
    order = sorted(
        ((ix, iy) for iy in range(n_y) for ix in range(n_x)), key=lambda c: (c[0] % 2 + c[1] % 2, c[1], c[0])
    )
    return [(m, ix, iy) for ix, iy in order for m in stress.methods if m in methods]


def run_map(
    stress: StressMap,
    size: Size = "full",
    *,
    methods: Sequence[str] | None = None,
    known: Sequence[Cell] = (),
    seed: int = 0,
) -> Iterator[Cell]:
    """Yield the cells of a map that are not known yet, as they are made.

    Parameters
    ----------
    size : "quick" or "full"
    methods : sequence of str, optional
        Of the map's; default all.
    known : sequence of Cell
        Left out.
    seed : int
        Another seed, other scenes and noise.
    """
    done = {(c.method, c.ix, c.iy) for c in known}
    x, y = stress.x.at(size), stress.y.at(size)
    for method, ix, iy in cells_of(stress, size, stress.methods if methods is None else methods):
        if (method, ix, iy) in done:
            continue
        began = time.perf_counter()
        trial = stress.trial(method, x[ix], y[iy], seed, size)
        yield cell_of(method, ix, iy, trial, time.perf_counter() - began)
