"""From a few numbers to a measurement, the calibration a user would have, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from recon.arrays import BoolArray, Float32Array, Float64Array
from recon.base.noise import NoiseModel
from recon.errors import InputError
from recon.evaluation import content
from recon.evaluation.lenslets import SPOT_PX, LensletCamera, Optics, build_camera
from recon.evaluation.measured_camera import MeasuredCamera, measured_camera, smooth_light
from recon.evaluation.measured_sets import MEASURED, MeasuredSet
from recon.types import Calibration, Geometry

Family = Literal[
    "dense-picture",
    "sparse-picture",
    "beads",
    "dense-volume",
    "microscope",
    "text",
    "filaments",
    "gradient",
    "texture",
    "lights",
]
FAMILIES: tuple[Family, ...] = get_args(Family)
Camera = LensletCamera | MeasuredCamera


@dataclass(frozen=True)
class SceneSpec:
    """A test scene in numbers. ``make_scene(spec)`` gives the same arrays at any time."""

    family: Family
    """One of :data:`FAMILIES`."""
    size: int | tuple[int, int] = 64
    """Pixels of the sensor."""
    seed: int = 0
    """Of scene, diffuser and noise."""
    density: float = 1.0
    """Leaves, strokes, blobs or beads, relative to the family's default."""
    field: float = 0.9
    """Extent of a picture relative to the sensor's: above 1 light comes from beyond it."""
    depths: int = 1
    """Calibrated planes, evenly spaced in 1/z from ``z_far`` to ``z_near``; 1 for pictures."""
    z_near: float = 4.0
    z_far: float = 12.0
    """``z_near`` and ``z_far``: depths relative to the distance of diffuser and sensor. Pictures stand at
    their harmonic mean."""
    layers: tuple[float, float] = (0.0, 1.0)
    """Range of the depth that holds anything, from 0 (``z_far``) to 1 (``z_near``)."""
    optics: Optics | MeasuredSet = "random"
    """``"random"`` or ``"regular"`` lenslets, a ``"smooth"`` diffuser, or the measured PSFs of ``"hand"`` or
    ``"usaf"``: a picture stands at one of their depths, which the seed draws."""
    fall_off_deg: float = np.inf
    aberration: float = 0.0
    dispersion: float = 0.0
    spot_px: float = SPOT_PX
    """``fall_off_deg``, ``aberration``, ``dispersion`` and ``spot_px``: as
    :class:`~recon.evaluation.lenslets.LensletCamera`; with measured PSFs, as
    :class:`~recon.evaluation.measured_camera.MeasuredCamera`, which has no spots."""
    channels: int = 1
    """1 or 3."""
    colourful: bool = False
    """Whether the three channels of the scene differ."""
    photons: float = 4000.0
    """Photo-electrons at the brightest pixel."""
    read_noise_e: float = 2.0
    background: float = 0.0
    """Smooth stray light, relative to the mean of the scene's; with measured PSFs as it lies on that set's
    photograph."""
    saturation: float | None = None
    """Counts at which pixels saturate, relative to the brightest one without noise."""
    erased: float = 0.0
    """Share of the pixels that is not read."""
    grid: int = 1
    """Calibration points along each side of the field: 1 is the axis alone."""
    grid_field: float = 0.9
    """Extent of the calibration grid relative to the field that is opposite to the sensor."""
    calibration_photons: float = 2e4
    """Photo-electrons at the brightest pixel of a PSF on the axis at the nearest depth (read noise as in the
    measurement), averages included. PSFs at other places are taken with the same exposure."""
    drift_px: float = 0.0
    drift_scale: float = 0.0
    drift_deg: float = 0.0
    """``drift_px``, ``drift_scale`` and ``drift_deg``: how the diffuser moved after the calibration: shift
    along both axes, relative scale, rotation."""
    depth_error: float = 0.0
    """By how much the calibration's depths are wrong, relatively."""

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise InputError(f"The family {self.family!r} is not known. Choose one of {', '.join(FAMILIES)}.")
        if min(self.shape) < 16:
            raise InputError(f"A scene needs a sensor of 16 x 16 pixels or more, not {self.shape}.")
        if not 0 < self.z_near <= self.z_far:
            raise InputError(f"z_near and z_far are 0 < near <= far, not {self.z_near} and {self.z_far}.")
        if not 0 <= self.erased < 1:
            raise InputError(f"erased is a share from 0 to below 1, not {self.erased}.")
        if self.channels not in (1, 3):
            raise InputError(f"channels is 1 or 3, not {self.channels}.")
        if self.depths < 1 or self.grid < 1 or not self.photons > 0:
            raise InputError("depths and grid are 1 or more, and photons more than 0.")

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` of the sensor."""
        return (self.size, self.size) if isinstance(self.size, int) else self.size

    @property
    def is_picture(self) -> bool:
        """Whether the scene lies in one plane."""
        return self.family in content.PICTURES


_DEFAULTS: dict[Family, dict[str, Any]] = {
    "dense-picture": {},
    "sparse-picture": {},
    "beads": {"depths": 8},
    "dense-volume": {"depths": 8},
    "microscope": {"depths": 8, "fall_off_deg": 14.0, "background": 0.5, "grid": 5, "photons": 2000.0},
}


def spec_of(family: Family, **changes: Any) -> SceneSpec:
    """Return a family's default scene with some numbers changed."""
    known = {f.name for f in fields(SceneSpec)}
    if unknown := sorted(set(changes) - known):
        raise InputError(f"A scene has no {', '.join(unknown)}; it has {', '.join(sorted(known))}.")
    return SceneSpec(family, **{**_DEFAULTS.get(family, {}), **changes})


@dataclass(frozen=True)
class TestScene:
    """A measurement with all that is known about it."""

    __test__ = False  # not a pytest class, whatever its name

    spec: SceneSpec
    measurement: Float32Array
    """(height, width) or (height, width, 3): counts, one a photo-electron; 0 where erased."""
    calibration: Calibration
    """With noise, at ``depths`` times ``grid`` squared places."""
    truth: Float32Array
    """(height, width) or (n_z, height, width) with the calibration's depths, and channels last where there
    are some: in units in which ``measurement = sum PSF * truth`` with the PSFs as calibrated."""
    erasures: BoolArray | None
    """(height, width): true where a pixel was not read."""
    noise: NoiseModel
    """The sensor's."""
    background: Float32Array
    """as ``measurement``: the true stray light, counts."""
    camera: Camera
    """As it was when the measurement was taken."""
    points: Float64Array
    """(n, 4): ``x, y, z`` in micrometres and power."""

    @property
    def z_um(self) -> Float64Array:
        """Depths of the calibrated planes, the nearest first."""
        return np.unique(self.calibration.source_positions_um[:, 2])


def make_scene(spec: SceneSpec | Family, **changes: Any) -> TestScene:
    """Render a scene: a spec, or a family's default with some numbers changed.

    Raises InputError when a number is not known or impossible.

    Returns
    -------
    TestScene
        The same for the same numbers, whatever else was rendered.
    """
    spec = replace(spec, **changes) if isinstance(spec, SceneSpec) else spec_of(spec, **changes)
    seeds = np.random.SeedSequence(spec.seed).spawn(4)
    scene_rng, noise_rng, calibration_rng = (np.random.default_rng(s) for s in seeds[:3])
    calibrated_camera = _camera(spec, int(seeds[3].generate_state(1)[0]))
    camera = calibrated_camera.moved((spec.drift_px, spec.drift_px), 1 + spec.drift_scale, spec.drift_deg)
    places = _places(spec, scene_rng)
    tints = _tints(spec, places, scene_rng)
    points = _points(spec, places, camera)
    clean = np.stack(
        [
            camera.light(np.column_stack([points[:, :3], points[:, 3] * tint]), c)
            for c, tint in _channels(spec, tints)
        ]
    )
    exposure = spec.photons / float(clean.max())
    background = _stray_light(spec, scene_rng) * float(clean.mean()) * exposure
    counts = noise_rng.poisson(clean * exposure + background).astype(np.float64)
    counts += noise_rng.normal(0, spec.read_noise_e, counts.shape)
    if spec.saturation is not None:
        counts = np.minimum(counts, spec.saturation * spec.photons)
    erasures = noise_rng.random(spec.shape) < spec.erased if spec.erased else None
    if erasures is not None:
        counts[:, erasures] = 0
    calibration, unit = _calibrate(spec, calibrated_camera, calibration_rng)
    truth = np.stack([_on_grid(spec, places, tint) for _, tint in _channels(spec, tints)], axis=-1) * (
        exposure / unit
    )
    return TestScene(
        spec,
        _flat(np.moveaxis(counts, 0, -1)),
        calibration,
        _flat(truth),
        erasures,
        NoiseModel(spec.read_noise_e, 1.0),
        _flat(np.moveaxis(np.broadcast_to(background, clean.shape), 0, -1)),
        camera,
        points,
    )


# Pieces ------------------------------------------------------------------------------------------------
def _camera(spec: SceneSpec, seed: int) -> Camera:
    """Return the camera as it is calibrated."""
    imperfections = {
        "aberration": spec.aberration,
        "fall_off_deg": spec.fall_off_deg,
        "dispersion": spec.dispersion,
    }
    if spec.optics in MEASURED:
        plane = np.random.default_rng(seed).random() if spec.is_picture or spec.depths == 1 else None
        depths = (spec.z_near, spec.z_far)
        return measured_camera(spec.shape, spec.optics, depths, plane=plane, **imperfections)
    focus = 2 / (1 / spec.z_near + 1 / spec.z_far)
    return build_camera(
        spec.shape,
        optics=cast(Optics, spec.optics),
        seed=seed,
        focus=focus,
        spot_px=spec.spot_px,
        **imperfections,
    )


def _places(spec: SceneSpec, rng: np.random.Generator) -> Float64Array:
    """Rows, columns (picture pixels from the axis), places in depth and brightness, (n, 4)."""
    side = max(spec.shape)
    if spec.is_picture:
        count = round(spec.field * side) * content.SUBSAMPLES
        image = content.PICTURES[spec.family](rng, count, spec.density)
        along = (np.arange(count) - (count - 1) / 2) / content.SUBSAMPLES
        rows, columns = np.meshgrid(along, along, indexing="ij")
        places = np.column_stack(
            [rows.ravel(), columns.ravel(), np.full(rows.size, 0.5), image.ravel() / content.SUBSAMPLES**2]
        )
        return places[places[:, 3] > 0]
    extent = spec.field / 0.9 * side
    if spec.family == "beads":
        places = content.beads(rng, extent, max(round(30 * spec.density), 1))
    else:
        draw_3d = content.dense_volume if spec.family == "dense-volume" else content.tissue
        places = draw_3d(rng, extent, spec.density)
    low, high = spec.layers
    places[:, 2] = low + (high - low) * places[:, 2]
    return places


def _tints(spec: SceneSpec, places: Float64Array, rng: np.random.Generator) -> Float64Array:
    """Brightness of every point in every channel, relative to its own, (n, channels)."""
    if spec.channels == 1 or not spec.colourful:
        return np.ones((len(places), spec.channels))
    # Patches of colour: every place takes that of the nearest of some random seeds.
    seeds = rng.uniform(-0.5, 0.5, (9, 2)) * max(spec.shape)
    colours = rng.uniform(0.15, 1, (9, 3))
    nearest = np.argmin(((places[:, None, :2] - seeds) ** 2).sum(axis=2), axis=1)
    return np.asarray(colours[nearest])


def _channels(spec: SceneSpec, tints: Float64Array) -> list[tuple[int, Float64Array]]:
    """Return the camera's colours, each with every point's tint in it."""
    return [(1, tints[:, 0])] if spec.channels == 1 else [(c, tints[:, c]) for c in range(3)]


def _points(spec: SceneSpec, places: Float64Array, camera: Camera) -> Float64Array:
    """``x, y, z`` and power of every point, (n, 4)."""
    z = _depth_um(spec, places[:, 2], camera.distance_um)
    to_scene = -camera.pitch_um * z / camera.distance_um
    return np.column_stack([places[:, 1] * to_scene, places[:, 0] * to_scene, z, places[:, 3]])


def _depth_um(spec: SceneSpec, place: npt.ArrayLike, distance_um: float) -> Float64Array:
    """Depth of a place between far (0) and near (1), even in 1/z."""
    inverse = 1 / spec.z_far + np.asarray(place) * (1 / spec.z_near - 1 / spec.z_far)
    return distance_um / inverse


def _plane_places(spec: SceneSpec) -> Float64Array:
    """Places of the calibrated planes, the nearest first."""
    return np.linspace(1.0, 0.0, spec.depths) if spec.depths > 1 else np.array([0.5])


def _stray_light(spec: SceneSpec, rng: np.random.Generator) -> Float64Array:
    """Smooth light of mean ``spec.background``: a slope and a broad hill, or as a photograph has it."""
    if spec.optics in MEASURED:
        light = smooth_light(spec.optics, spec.shape)
        return np.asarray(spec.background * light / light.mean())
    y, x = (np.linspace(-1, 1, n) for n in spec.shape)
    slope, place = rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.5, 0.5, 2)
    hill = np.exp(-((y[:, None] - place[0]) ** 2 + (x - place[1]) ** 2) / 1.5)
    light = 0.5 + slope[0] * y[:, None] + slope[1] * x + hill
    return np.asarray(spec.background * light / light.mean())


def _calibrate(spec: SceneSpec, camera: Camera, rng: np.random.Generator) -> tuple[Calibration, float]:
    """Photograph a point source at every depth and place; also return the counts of a unit power.

    One exposure serves all, set by a point on the axis at the nearest depth, whether the grid holds it or
    not: neither the number of calibration points nor the response's fall-off changes what the axis gets.
    """
    height, width = spec.shape
    across = np.linspace(-0.5, 0.5, spec.grid) * spec.grid_field if spec.grid > 1 else np.zeros(1)
    true_z = _depth_um(spec, _plane_places(spec), camera.distance_um)
    colours = _channels(spec, np.ones((1, 3)))
    on_axis = np.stack([camera.light([[0.0, 0.0, true_z[0], 1.0]], c) for c, _ in colours])
    unit = spec.calibration_photons / float(on_axis.max())
    psfs, positions = [], []
    for z in true_z:
        to_scene = -camera.pitch_um * z / camera.distance_um
        for row in across * height:
            for column in across * width:
                source = (column * to_scene, row * to_scene, z)
                light = np.stack([camera.light([[*source, 1.0]], c) for c, _ in colours])
                counts = rng.poisson(light * unit) + rng.normal(0, spec.read_noise_e, light.shape)
                psfs.append(np.maximum(counts, 0).astype(np.float32))
                positions.append((source[0], source[1], z * (1 + spec.depth_error)))
    calibration = Calibration(
        np.stack(psfs),
        np.array(positions),
        geometry=Geometry(
            pixel_pitch_um=camera.pitch_um,
            diffuser_distance_mm=camera.distance_um / 1e3,
            aperture_mm=tuple(float(n) * camera.pitch_um * 0.66 / 1e3 for n in spec.shape),  # type: ignore[arg-type]
        ),
        provenance={"simulated": True, "scene": spec.family, "seed": spec.seed},
    )
    return calibration, unit


def _on_grid(spec: SceneSpec, places: Float64Array, tint: Float64Array) -> Float64Array:
    """Brightness of every pixel or voxel.

    In a volume every point's light is shared by its eight nearest voxels; a picture's points lie so densely
    that each goes to the pixel it falls into.
    """
    height, width = spec.shape
    row, column = places[:, 0] + height // 2, places[:, 1] + width // 2
    light = places[:, 3] * tint
    if spec.is_picture:
        image = np.zeros((height, width))
        _drop(image, np.floor(np.column_stack([row, column]) + 0.5).astype(int), light)
        return image
    depth = np.clip(1 - places[:, 2], 0, 1) * (spec.depths - 1)
    return shared((spec.depths, height, width), np.column_stack([depth, row, column]), light)


def shared(shape: tuple[int, ...], places: Float64Array, light: Float64Array) -> Float64Array:
    """Return points (n, n_axes) on a grid, each shared by its nearest cells, two along each axis."""
    grid = np.zeros(shape)
    corner = np.floor(places).astype(int)
    part = places - corner
    for far in np.ndindex((2,) * len(shape)):
        _drop(grid, corner + far, light * np.prod(np.where(far, part, 1 - part), axis=1))
    return grid


def _drop(grid: Float64Array, cells: npt.NDArray[np.int_], light: Float64Array) -> None:
    """Add light to cells, (n, n_axes); what falls outside is lost."""
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    np.add.at(grid, tuple(cells[inside].T), light[inside])


def _flat(array: Float64Array) -> Float32Array:
    """Channels last, left out where there is one."""
    return np.ascontiguousarray(array[..., 0] if array.shape[-1] == 1 else array, np.float32)
