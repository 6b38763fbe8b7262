"""Golden cases of single solvers and operators, step by step: small, in float64, so that nothing hides.

A result that has settled does not tell a preconditioner, a penalty or a first guess from another: they cost
iterations and no result. So each solver is held to its way: what every iteration told, where the object was
at the end, and the size of what a checkpoint keeps. Operators are held to what they make of random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import numpy as np

from recon.arrays import BoolArray, Float64Array
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval, Erasures, interpolate_bayer
from recon.camera.grid import Grid, metric_volume
from recon.camera.points import (
    FieldFunctions,
    PointImages,
    Points,
    cleaned,
    overlooked,
    points_on_grid,
    refine,
)
from recon.camera.transformed import Transformation, transformed
from recon.camera.two_part import two_part
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution, low_rank
from recon.priors import L1, Box, HaarTotalVariation, NonNegativity, Prior, TotalVariation
from recon.solvers import Admm, Fista, SensorAdmm, StoppingRules
from recon.solvers.admm import Penalties
from recon.solvers.base import Solver
from recon.solvers.operator_admm import OperatorAdmm
from recon.solvers.splitting import SensorData, Tuning
from recon.solvers.tv_admm_volume import LeanTotalVariation, volume_solver
from recon.solvers.volume_admm import VolumeAdmm
from recon.solvers.wiener_filter import WienerFilter, cross_validated, wiener
from recon.types import Calibration, Geometry

Result = dict[str, Any]
SENSOR, N_Z, PLANES = (24, 21), 4, 6
RNG = np.random.default_rng(21)
"""Drawn from in the order of this file: what is added comes last."""
PICTURE = Convolution(RNG.random((2, 9, 8)) ** 4, SENSOR, dtype=np.float64)
VOLUME = Convolution(RNG.random((N_Z, 1, 9, 8)) ** 4, SENSOR, dtype=np.float64)
DEEP = Convolution(RNG.random((PLANES, 1, 9, 8)) ** 4, SENSOR, dtype=np.float64)
VALID = RNG.random((2, *SENSOR)) > 0.15
ONE = VALID[0]
NOISE = RNG.standard_normal((2, 2, *SENSOR))
ON_GRID = np.array([(y, x) for y in (-6.0, 0.5, 6.0) for x in (-5.0, 5.0)])
SCATTERED = ON_GRID + 3 * RNG.random(ON_GRID.shape)
PSFS = RNG.random((2, len(ON_GRID), 1, 9, 8)) ** 4 * np.linspace(1, 2, len(ON_GRID))[:, None, None, None]
START = RNG.random((1, N_Z, 40, 40))
PICTURE_START = START[:, 0, : PICTURE.grid_shape[0], : PICTURE.grid_shape[1]]

TV = TotalVariation(0.02, tolerance=1e-6) + NonNegativity()
SPARSE = L1(0.05) + NonNegativity()
OTHER = TotalVariation(0.03, axis_weights=(1.0, 0.5), wrap=(False, False), max_inner=15)
"""Known by its prox only to solvers that sweep over wrapped differences of equal weight."""
BY_DEPTH = np.stack([np.linspace(0.3, 0.9, N_Z), np.ones(N_Z), np.linspace(1, 2, N_Z)], axis=1)
LATERAL = TotalVariation(0.02, axis_weights=(0.5, 1, 2), wrap=(False,) * 3) + NonNegativity()


def masked(valid: BoolArray = VALID) -> Any:
    """Return the picture's camera with erased pixels."""
    return Erasures(valid, PICTURE.range_shape, np.float64) @ PICTURE


def lit(camera: Any, number: int = 0) -> Float64Array:
    """Return noisy data of a scene of two bright blocks, in one plane; the second is the first, moved."""
    scene = np.zeros(camera.domain_shape)
    if scene.ndim == 3:
        scene[:, 6 + number : 14 + number, 7:19] = 1
    else:
        scene[:, 1, 6 + number : 14 + number, 7:19] = 1
    scene[..., 20:23, 20:22] *= 3
    clean = camera.forward(scene)
    return np.asarray(clean + 0.05 * NOISE[number, : len(clean)])


def data_of(camera: Any, background: BackgroundRemoval | None = None, number: int = 0) -> SensorData:
    """Return a volume's data, some pixels erased."""
    return SensorData(lit(camera, number), ONE, background)


def smooth(restraint: float, valid: Any = None, channels: int = 1) -> BackgroundRemoval:
    """Return the removal of a smooth background."""
    return BackgroundRemoval((channels, *SENSOR), (3, 4), valid, np.float64, restraint)


def way(
    solver: Solver, iterations: int = 14, then: Callable[[Solver], object] | None = None, rest: int = 5
) -> Result:
    """Go so many iterations, do something to the solver, go on; tell all of it."""
    records = [solver.advance() for _ in range(iterations)]
    if then is not None:
        then(solver)
        records += [solver.advance() for _ in range(rest)]
    told = np.array([astuple(record) for record in records], float)
    names = ("objective", "data", "primal", "dual", "change")
    result: Result = {name: told[:, 2 + i] for i, name in enumerate(names)}
    for name, value in solver.checkpoint().items():
        result[f"kept {name}"] = float(np.linalg.norm(np.ravel(value)))
    return result | {"image": np.array(solver.solution)}


def followed(data: Any) -> Callable[[Any], None]:
    """Return what a video does between two frames: the object moves, other data come."""

    def then(solver: Any) -> None:
        solver.move(0.6, -1.3)
        solver.set_data(data)

    return then


def restrained(background: BackgroundRemoval, solver: SensorAdmm) -> None:
    """Go on with less of a background, then begin anew."""
    background.restrain(0.02)
    followed(lit(PICTURE, 1))(solver)
    solver.advance()
    solver.restart(lit(PICTURE, 1))


def of_sensor(
    restraint: float | None = None, prior: Prior = TV, iterations: int = 14, **options: Any
) -> Result:
    """Follow the exact-data ADMM of pictures."""
    background = None if restraint is None else smooth(restraint, channels=2)
    camera = masked() if restraint is None else PICTURE
    solver = SensorAdmm(camera, lit(camera), prior, background=background, **options)
    then = followed(lit(camera, 1)) if background is None else lambda s: restrained(background, s)
    return way(solver, iterations, then)


def anew(prior: Prior) -> Result:
    """Follow the exact-data ADMM of a prior known by its prox from a picture on, and anew from zero."""
    solver = SensorAdmm(PICTURE, lit(PICTURE), prior, initial=PICTURE_START, data_steps=2)
    return way(solver, 7, lambda s: s.restart(lit(PICTURE, 1)))  # type: ignore[attr-defined]


def of_volume(
    kind: Any, prior: Prior, *, restraint: float | None = None, iterations: int = 14, **options: Any
):
    """Follow a volume's solver, through a change of the data."""
    backgrounds = [None if restraint is None else smooth(r, ONE) for r in (restraint, 0.01)]
    solver = kind(VOLUME, data_of(VOLUME, backgrounds[0]), prior, **options)
    return way(solver, iterations, followed(data_of(VOLUME, backgrounds[1], 1)))


def of_empty_planes(prior: Prior) -> Result:
    """Follow a sparse volume of which planes are left out, and brought back by other data, to its end."""
    solver = volume_solver(DEEP, data_of(DEEP), prior)
    run = solver.run(StoppingRules(iterations=200, tolerance=3e-3))
    result = {"planes": str(solver.empty.planes), "worst": solver.empty.worst, "iterations": len(run.history)}
    solver.set_data(SensorData(DEEP.forward(np.ones(DEEP.domain_shape)), ONE))
    return way(solver, 30) | result


def varying(model: Any, points: Float64Array = ON_GRID, **options: Any) -> Any:
    """Return a camera whose PSF varies over the field."""
    fields = [FieldOfPsfs(psfs, points) for psfs in PSFS]
    return model(fields, SENSOR, dtype=np.float64, **options)


def of_any(model: Any, prior: Prior, **options: Any) -> Result:
    """Follow the ADMM of cameras that are no convolution."""
    central = Convolution(PSFS[:, 2], SENSOR, dtype=np.float64)
    camera = varying(model, grid_shape=central.grid_shape)
    solver = OperatorAdmm(camera, central, data_of(camera, smooth(0.3, ONE)), prior, **options)
    return way(solver, 8, followed(data_of(camera, smooth(0.3, ONE), 1)))


def in_one_step(enough: int = 60) -> Result:
    """Deconvolve by Wiener's filter, its regularisation given and not."""
    valid = VALID.copy()
    valid[:, 3:15, 5:16] = False  # no valid pixel is near
    camera = masked(valid)
    found = wiener(camera, lit(camera))
    return {
        "image": found.solution,
        "tau": float(found.tau or 0),
        "some": cross_validated(PICTURE, lit(PICTURE), enough),
        "given": WienerFilter(PICTURE, 0.3)(lit(PICTURE)),
    }


STEPS: dict[str, Callable[[], Result]] = {
    "admm": lambda: way(Admm(masked(), lit(masked()), TV), 40),
    "admm-isotropic": lambda: way(
        Admm(
            PICTURE,
            lit(PICTURE),
            TotalVariation(0.02, isotropic=True) + L1(0.01) + NonNegativity(),
            initial=PICTURE_START,
            penalties=Penalties(0.2, 0.7, 0.4),
        )
    ),
    "admm-sparse": lambda: way(Admm(masked(), lit(masked()), SPARSE)),
    "admm-other": lambda: way(Admm(PICTURE, lit(PICTURE), OTHER + Box(0, 2)), 18),
    "sensor": lambda: of_sensor(iterations=50),
    "sensor-background": lambda: of_sensor(0.3),
    "sensor-sparse": lambda: of_sensor(None, SPARSE, data_steps=2),
    "sensor-other": lambda: of_sensor(None, OTHER + L1(0.01) + Box(0, 2), iterations=26, data_steps=3),
    "sensor-anew": lambda: anew(OTHER + TV),
    "fista": lambda: way(Fista(masked(), lit(masked()), TV), 30),
    "fista-isotropic": lambda: way(
        Fista(PICTURE, lit(PICTURE), TotalVariation(0.2, isotropic=True) + Box(0, 2), restart="function"), 30
    ),
    "fista-haar": lambda: way(
        Fista(PICTURE, lit(PICTURE), HaarTotalVariation(0.1) + L1(0.01), restart="none")
    ),
    "ista": lambda: way(Fista(VOLUME, lit(VOLUME), SPARSE, accelerate=False, step=1e-3)),
    "wiener": in_one_step,
    "volume-tv": lambda: of_volume(
        LeanTotalVariation, TotalVariation.of_volume(0.02, BY_DEPTH) + NonNegativity()
    ),
    "volume-tv-background": lambda: of_volume(
        LeanTotalVariation,
        TotalVariation.of_volume(0.02, isotropic=True) + NonNegativity(),
        restraint=0.2,
        iterations=34,
        initial=START[..., : VOLUME.grid_shape[0], : VOLUME.grid_shape[1]],
    ),
    "volume-any": lambda: of_volume(
        VolumeAdmm,
        TotalVariation.of_volume(0.02, BY_DEPTH) + L1(0.01) + Box(0, 2),
        restraint=0.2,
        tuning=Tuning(relaxation=1.5, kappa=0.5),
    ),
    "volume-any-isotropic": lambda: of_volume(
        VolumeAdmm,
        TotalVariation.of_volume(0.02, isotropic=True) + OTHER + Box(0, 2),
        tuning=Tuning(first=2.0),
        iterations=70,
    ),
    "volume-sparse": lambda: of_volume(volume_solver, SPARSE, restraint=0.05),
    "volume-signed": lambda: of_volume(
        volume_solver, L1(0.05), initial=START[..., : VOLUME.grid_shape[0], : VOLUME.grid_shape[1]]
    ),
    "volume-box": lambda: of_volume(volume_solver, L1(0.05) + Box(0, 2), tuning=Tuning(balance=False)),
    "volume-other": lambda: of_volume(volume_solver, OTHER),
    "volume-empty": lambda: of_empty_planes(L1(80.0) + NonNegativity()),
    "local": lambda: of_any(local_convolution, LATERAL, shown=(slice(4, 20), slice(3, 18))),
    "local-sparse": lambda: of_any(local_convolution, SPARSE),
    "lowrank": lambda: of_any(low_rank, LATERAL + OTHER, tuning=Tuning(kappa=0.5)),
}
"""Of solvers."""


def applied(camera: Any) -> Result:
    """Return what an operator and its adjoint make of random numbers, and what it tells of itself."""
    rng = np.random.default_rng(1)
    result: Result = {
        "forward": camera.forward(rng.random(camera.domain_shape)),
        "adjoint": camera.adjoint(rng.random(camera.range_shape)),
        "norm": float(camera.norm_bound),
    }
    for name in ("nbytes", "fft_pixels"):
        if hasattr(camera, name):
            result[name] = int(getattr(camera, name))
    return result


def supported(model: Any, points: Any = ON_GRID, **options: Any) -> Result:
    """Apply a varying camera whose object may have light in a part of the field only."""
    field = tuple(s + p - 1 for s, p in zip(SENSOR, (9, 8), strict=True))
    support = np.zeros((len(PSFS), *field), bool)
    support[0, 3:20, 2:17] = support[0, 10:26, 12:15] = True
    return applied(varying(model, points, support=support, grid_shape=(36, 36), **options))


def beside() -> Result:
    """Apply varying cameras whose PSFs are dark at their edges: part of the field casts nothing."""
    dark = np.zeros((1, len(ON_GRID), 1, 19, 18))
    dark[..., 8:11, 7:12] = PSFS[:1, ..., 2:5, 1:6]
    points = 2 * ON_GRID
    result: Result = {}
    for name, psfs in (("dark edges", dark), ("nothing", np.zeros_like(dark))):
        camera = local_convolution([FieldOfPsfs(psfs[0], points)], SENSOR, dtype=np.float64)
        result |= {f"{name}: {what}": value for what, value in applied(camera).items()}
    return result


def backgrounds() -> Result:
    """Take smooth backgrounds out, and fit them."""
    rng = np.random.default_rng(2)
    image = rng.random((2, *SENSOR)) - 0.5 + np.linspace(-1, 2, SENSOR[1])
    some, whole = smooth(0.5, VALID, 2), smooth(0.0, None, 2)
    return {
        "left": np.stack([some.forward(image), whole.forward(image)]),
        "fitted": np.stack([some.background(image), whole.background(image)]),
        "not negative": np.stack([some.non_negative(image), whole.non_negative(image)]),
        "colours": interpolate_bayer(rng.random((7, 9)), "GRBG"),
    }


def beads() -> Result:
    """Find and fit points of light through PSFs that vary over the field."""
    rng = np.random.default_rng(3)
    places = np.array(
        [(-6.3, 4.2), (5.6, -7.1), (0.4, 0.3), (7.2, 8.4), (-8.0, -6.0), (3.0, 9.7), (-2.5, -11.2)]
    )
    functions = FieldFunctions(1, places)
    psfs = np.zeros((functions.count, 11, 12), np.float32)
    y, x = np.mgrid[:11, :12]
    for row, column in rng.uniform(2, 9, (6, 2)):
        psfs[0] += np.exp(-((y - row) ** 2 + (x - column) ** 2)).astype(np.float32)
    psfs[1:] = 0.1 * psfs[0] * rng.standard_normal((functions.count - 1, 11, 12))
    camera = PointImages(psfs, functions, (40, 37))
    points = Points(places, np.array([3.0, 5.0, 4.0, 2.0, 6.0, 0.4, 3.5]))
    image = camera.image(points) + rng.normal(0, 0.02, (40, 37)).astype(np.float32)
    first = Points(places[:5] + rng.uniform(-1.2, 1.2, (5, 2)), points.light[:5] * 1.2)
    fitted, left = refine(camera, image, first)
    found = overlooked(camera, left, fitted, 0.02)
    twice = Points(np.concatenate([places, places[:2] + 0.3]), np.append(points.light, [1.0, 2.0]))
    kept, patch = cleaned(camera, twice, 0.02), camera.patch(np.array([17.4, -15.3]), slopes=True)
    blobs = np.zeros((30, 32))
    for row, column, light in rng.uniform((4, 4, 1), (26, 28, 6), (9, 3)):
        blobs += light * np.exp(-((np.arange(30)[:, None] - row) ** 2 + (np.arange(32) - column) ** 2))
    grid = points_on_grid(blobs, (15, 16))
    return {
        "image": image, "left": left, "patch": patch[0], "window": str(patch[1]),
        "fitted": np.column_stack([fitted.places, fitted.light]),
        "found": np.column_stack([found.places, found.light]),
        "kept": np.column_stack([kept.places, kept.light]),
        "blobs": np.column_stack([grid.places, grid.light]),
    }  # fmt: skip


def in_space() -> Result:
    """Bring volumes to voxels of equal size, larger and smaller ones, off the axis and upright."""
    rng = np.random.default_rng(4)
    volume = rng.random((5, 12, 14)).astype(np.float32)
    z_um, pitch_um = np.array([7100.0, 7060.0, 7030.0, 7010.0, 6980.0]), np.linspace(18, 12, 5)
    grid = Grid((5, 12, 14), (6, 7), z_um, pitch_um, 10.0)
    off = Grid((5, 12, 14), (5, 8), z_um, pitch_um, 10.0, rng.uniform(-9, 9, (5, 2)), True)
    result: Result = {}
    for name, own, voxel_um in (("plain", grid, None), ("fine", off, 11.0), ("coarse", grid, 50.0)):
        made, metric = metric_volume(volume, own, voxel_um)
        result |= {
            f"{name}": made,
            f"{name} z": metric.z_um,
            f"{name} at": str((metric.shape, metric.centre)),
        }
        corner = metric.place_um(0, 0.0, 0.0)
        result[f"{name} corner"] = np.array([*corner, *metric.pixel_of(0, *corner[:2])])
    places = np.array([(30.0, -20.0, 7090.0), (-10.0, 25.0, 7000.0)])
    result["spanned"] = np.array([grid.spanned_by(places), off.spanned_by(places)])
    result["weights"], result["deg"] = (
        off.axis_weights(),
        np.array([off.direction_deg(1, 2), [off.pixel_mrad, 0]]),
    )
    return result


def responding() -> Result:
    """Make PSFs over the field from those on the axis and an angular response."""
    rng = np.random.default_rng(5)
    positions = np.array([(3.0, -5.0, 4e4), (0.0, 2.0, 9e4)])
    calibration = Calibration(rng.random((2, 1, 14, 16), np.float32), positions, geometry=Geometry(10.0, 5.0))
    made = two_part(calibration, lambda y, x: np.exp(-900 * (y**2 + 2 * x**2)))
    moved = transformed(rng.random((2, 14, 16)), Transformation(1.3, -0.7, 0.8, 12.0, mirrored=True))
    return {"psfs": made.psfs, "places": made.source_positions_um, "moved": moved}


OPERATORS: dict[str, Callable[[], Result]] = {
    "picture": lambda: applied(masked()),
    "volume": lambda: applied(VOLUME) | {"power": VOLUME.power([0, 2])},
    "local": lambda: applied(varying(local_convolution)),
    "local-part": lambda: supported(local_convolution),
    "local-scattered": lambda: supported(local_convolution, SCATTERED),
    "lowrank": lambda: applied(varying(low_rank)),
    "lowrank-part": lambda: supported(low_rank, SCATTERED, rank=3),
    "beside": beside,
    "backgrounds": backgrounds,
    "beads": beads,
    "in-space": in_space,
    "responding": responding,
}
"""Of operators, and of what is made for them."""
