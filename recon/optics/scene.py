"""What stands in front of the camera: flat pictures and beads at continuous places, in three colour bands.

Brightness is relative: radiance 1 of a picture and power 1 of a bead are given their photons by whoever
renders the scene. Pictures lie parallel to the sensor, ``x`` along their columns and ``y`` down their rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.optics.fall_off import FallOff
from recon.optics.grid import FloatArray, resample_energy

Weights = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A glowing picture parallel to the sensor; each of its pixels is uniformly bright.

    Attributes
    ----------
    radiance : ndarray, float32, (height, width, 3)
        Red, green and blue, not negative.
    z_um : float
        Distance from the diffuser.
    size_um : tuple of float
        ``(height, width)`` of the picture.
    center_um : tuple of float
        ``(x, y)`` of its centre.
    """

    radiance: Float32Array
    z_um: float
    size_um: tuple[float, float]
    center_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.radiance.ndim != 3 or self.radiance.shape[2] != 3:
            raise ValueError(f"A layer's radiance is (height, width, 3), not {self.radiance.shape}.")
        if not self.z_um > 0 or not min(self.size_um) > 0:
            raise ValueError("A layer lies in front of the diffuser (z_um > 0) and has a size_um > 0.")

    @property
    def x_edges_um(self) -> FloatArray:
        """Borders of the columns, ``(width + 1,)``."""
        return _edges(self.center_um[0], self.size_um[1], self.radiance.shape[1])

    @property
    def y_edges_um(self) -> FloatArray:
        """Borders of the rows, ``(height + 1,)``."""
        return _edges(self.center_um[1], self.size_um[0], self.radiance.shape[0])

    def flux(
        self, weights: tuple[float, float, float], y_edges: FloatArray, x_edges: FloatArray
    ) -> Float32Array:
        """Radiance integrated over the cells of another grid in the layer's plane.

        Parameters
        ----------
        weights : tuple of float
            Of the three bands.
        y_edges, x_edges : ndarray, float64
            Ascending borders of the cells, micrometres.

        Returns
        -------
        ndarray, float32
            Radiance times area in square millimetres.
        """
        mixed = self.radiance @ np.asarray(weights, np.float32)
        mixed *= np.float32(self.size_um[0] * self.size_um[1] * 1e-6 / mixed.size)
        return resample_energy(mixed, self.y_edges_um, self.x_edges_um, y_edges, x_edges)


@dataclass(frozen=True, slots=True, eq=False)
class Beads:
    """Small glowing discs or spheres that send light equally in all directions.

    Attributes
    ----------
    positions_um : ndarray, float64, (n, 3)
        ``x, y, z``; every ``z`` positive.
    powers : ndarray, float64, (n, 3)
        Brightness in red, green and blue.
    diameter_um : float
        Of every bead.
    """

    positions_um: FloatArray
    powers: FloatArray
    diameter_um: float = 0.0

    def __post_init__(self) -> None:
        if self.positions_um.ndim != 2 or self.positions_um.shape[1] != 3:
            raise ValueError(f"Beads' positions are (n, 3), not {self.positions_um.shape}.")
        if self.powers.shape != self.positions_um.shape:
            raise ValueError(f"Beads' powers are {self.positions_um.shape}, not {self.powers.shape}.")
        if np.any(self.positions_um[:, 2] <= 0):
            raise ValueError("Beads lie in front of the diffuser: every z is positive.")


@dataclass(frozen=True, slots=True)
class TruthGrid:
    """A reconstruction's grid, on which a scene is shown free of any optics.

    Attributes
    ----------
    shape : tuple of int
        ``(height, width)``. Pixel ``(height // 2, width // 2)`` looks at the calibration source.
    pitch_um : float
        Pixel pitch on the sensor: pixel offset ``p`` looks at ``x = -p pitch z / d`` from there, so the
        picture stands upside down.
    distance_um : float
        From the diffuser to the sensor.
    source_um : tuple of float
        ``(x, y, z)`` of the source whose PSF the reconstruction uses.
    layer_scale, bead_scale : float
        Brightness of radiance 1 times a square millimetre, and of power 1.
    """

    shape: tuple[int, int]
    pitch_um: float
    distance_um: float
    source_um: tuple[float, float, float] = (0.0, 0.0, 1.0)
    layer_scale: float = 1.0
    bead_scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Layers and beads that glow together; nothing hides anything else."""

    name: str
    layers: tuple[Layer, ...] = ()
    beads: tuple[Beads, ...] = ()
    depths_um: tuple[float, float] = field(init=False)
    """Nearest and farthest distance of anything in it."""

    def __post_init__(self) -> None:
        depths = [layer.z_um for layer in self.layers]
        depths += [float(z) for beads in self.beads for z in beads.positions_um[:, 2]]
        if not depths:
            raise ValueError(f"Scene {self.name!r} is empty.")
        object.__setattr__(self, "depths_um", (min(depths), max(depths)))

    def true_image(
        self,
        grid: TruthGrid,
        weights: tuple[float, float, float],
        *,
        z_range_um: tuple[float, float] = (0.0, np.inf),
    ) -> FloatArray:
        """Return the scene on a reconstruction's grid, free of any optics.

        Parameters
        ----------
        grid : TruthGrid
        weights : tuple of float
            Of the three bands.
        z_range_um : tuple of float
            Only what lies in this range (lower bound included).

        Returns
        -------
        ndarray, float64, (height, width)
            Brightness in each pixel's cell: radiance times area, and power.
        """
        image = np.zeros(grid.shape)
        distance_um = grid.distance_um
        magnification = distance_um / grid.source_um[2]
        low, high = z_range_um
        height, width = grid.shape
        # Borders on the sensor, descending in the scene.
        y = _borders(height, grid.pitch_um, -magnification * grid.source_um[1])
        x = _borders(width, grid.pitch_um, -magnification * grid.source_um[0])
        for layer in self.layers:
            if low <= layer.z_um < high:
                to_scene = -layer.z_um / distance_um
                flux = layer.flux(weights, (y * to_scene)[::-1], (x * to_scene)[::-1])
                image += grid.layer_scale * flux[::-1, ::-1]
        for place, power, diameter in self.points():
            if low <= place[2] < high:
                _splat(
                    image, place, power @ np.asarray(weights) * grid.bead_scale, diameter, distance_um, y, x
                )
        return image

    @property
    def grey(self) -> bool:
        """Whether it has the same brightness in all bands everywhere."""
        parts = [layer.radiance for layer in self.layers] + [beads.powers for beads in self.beads]
        return all(bool((part == part[..., :1]).all()) for part in parts)

    def points(self) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Position (3,), powers (3,) and diameter of every bead."""
        for beads in self.beads:
            for place, power in zip(beads.positions_um, beads.powers, strict=True):
                yield place, power, beads.diameter_um


def _edges(center: float, size: float, count: int) -> FloatArray:
    return np.asarray(center + np.linspace(-size / 2, size / 2, count + 1))


def _borders(count: int, pitch: float, shift: float) -> FloatArray:
    """Borders of pixels whose number ``count // 2`` is centred at ``shift``."""
    return np.asarray((np.arange(count + 1) - count // 2 - 0.5) * pitch + shift, np.float64)


def _splat(
    image: FloatArray,
    place: FloatArray,
    power: float,
    diameter_um: float,
    distance_um: float,
    y_edges: FloatArray,
    x_edges: FloatArray,
) -> None:
    """Add a bead to the cells that its disc covers (by a fine grid of points inside it)."""
    rings = np.linspace(-1, 1, 11)
    inside = np.array([(v, u) for v in rings for u in rings if u * u + v * v <= 1.0])
    inside = inside * diameter_um / 2 if diameter_um > 0 else np.zeros((1, 2))
    magnification = distance_um / place[2]
    rows = np.searchsorted(y_edges, -(place[1] + inside[:, 0]) * magnification, side="right") - 1
    columns = np.searchsorted(x_edges, -(place[0] + inside[:, 1]) * magnification, side="right") - 1
    kept = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    np.add.at(image, (rows[kept], columns[kept]), power / len(inside))


def true_scene(
    scene: Scene,
    grid: TruthGrid,
    *,
    z_um: Sequence[float] | None,
    light: Weights,
    sensitivity: Weights | None,
    fall_off: FallOff | None,
) -> Float32Array:
    """Sample a scene on a reconstruction's grid, for each depth plane and colour.

    Parameters
    ----------
    scene : Scene
    grid : TruthGrid
    z_um : sequence of float, optional
        Depth planes; everything goes to the plane nearest in ``1 / z``.
    light : tuple of float
        The scene's light in red, green and blue.
    sensitivity : tuple of float, optional
        A monochrome sensor's; left out, the bands stay apart.
    fall_off : FallOff, optional
        Weigh every direction by what aperture and pixels collect from there, relative to the axis.

    Returns
    -------
    ndarray, float32
        The grid's shape, with the depth planes as first axis and the bands as last one where asked for.
    """
    if sensitivity is None:
        mixes = [(light[0], 0.0, 0.0), (0.0, light[1], 0.0), (0.0, 0.0, light[2])]
    else:
        total = sum(sensitivity)
        red, green, blue = (part * s / total for part, s in zip(light, sensitivity, strict=True))
        mixes = [(red, green, blue)]
    tan_y = _tangents(grid.shape[0], grid.pitch_um / grid.distance_um)[:, None]
    tan_x = _tangents(grid.shape[1], grid.pitch_um / grid.distance_um)
    cos = 1 / np.sqrt(1 + tan_y**2 + tan_x**2)
    seen = np.ones(grid.shape) if fall_off is None else fall_off(tan_y, tan_x) * cos**3
    planes = []
    for near, far in _ranges(z_um):
        channels = []
        for mix in mixes:
            layers = scene.true_image(replace(grid, bead_scale=0.0), mix, z_range_um=(near, far))
            beads = scene.true_image(replace(grid, layer_scale=0.0), mix, z_range_um=(near, far))
            # A surface sends less light sideways, a bead does not.
            channels.append(seen * (layers * (cos if fall_off is not None else 1.0) + beads))
        planes.append(channels[0] if sensitivity is not None else np.stack(channels, axis=-1))
    return np.asarray(planes[0] if z_um is None else np.stack(planes), np.float32)


def _tangents(count: int, step: float) -> Float64Array:
    return np.asarray((np.arange(count) - count // 2) * step, np.float64)


def _ranges(z_um: Sequence[float] | None) -> list[tuple[float, float]]:
    """Range of depths that belongs to each plane: borders half way in ``1 / z``."""
    if z_um is None:
        return [(0.0, np.inf)]
    order = np.argsort(z_um)
    depths = np.asarray(z_um, np.float64)[order]
    if np.any(depths <= 0) or np.any(np.diff(depths) == 0):
        raise ValueError(f"Depth planes are positive and different, not {list(z_um)}.")
    middles = 2 / (1 / depths[1:] + 1 / depths[:-1])
    lows, highs = np.concatenate([[0.0], middles]), np.concatenate([middles, [np.inf]])
    ranges = [(0.0, np.inf)] * len(depths)
    for position, plane in enumerate(order):
        ranges[plane] = (float(lows[position]), float(highs[position]))
    return ranges


def picture(image: npt.ArrayLike, z_um: float, width_um: float, *, name: str = "picture") -> Scene:
    """Show a picture on a screen parallel to the sensor.

    Parameters
    ----------
    image : array_like
        ``(height, width)`` grey or ``(height, width, 3)`` colour, linear brightness, not negative.
    """
    radiance = np.asarray(image, np.float32)
    if radiance.ndim == 2:
        radiance = np.repeat(radiance[:, :, None], 3, axis=2)
    size_um = (width_um * radiance.shape[0] / radiance.shape[1], width_um)
    return Scene(name, layers=(Layer(np.ascontiguousarray(radiance), z_um, size_um),))


def bead_volume(
    count: int,
    extent_um: tuple[float, float],
    z_range_um: tuple[float, float],
    *,
    diameter_um: float = 15.0,
    seed: int = 0,
) -> Scene:
    """Scatter beads in a volume, evenly over the angle of view and in ``1 / z``.

    Parameters
    ----------
    extent_um : tuple of float
        Width and height of the field at the nearest depth; it widens in proportion to depth.
    z_range_um : tuple of float
        Nearest and farthest depth.
    """
    rng = np.random.default_rng(seed)
    near, far = z_range_um
    z = 1 / rng.uniform(1 / far, 1 / near, count)
    across = (rng.random((count, 2)) - 0.5) * np.asarray(extent_um) * (z / near)[:, None]
    powers = np.repeat(rng.uniform(0.4, 1.0, (count, 1)), 3, axis=1)
    return Scene("beads", beads=(Beads(np.column_stack([across, z]), powers, diameter_um),))


def bar_target(pixels: int = 512) -> Float32Array:
    """Draw groups of three horizontal and three vertical bars, each group finer than the one before.

    Returns
    -------
    ndarray, float32, (pixels, pixels)
        1 on the bars, 0 elsewhere. Bars from 1/20 down to 1/170 of the side.
    """
    image = np.zeros((pixels, pixels), np.float32)
    x, y, row_height = 0.05, 0.05, 0.0
    for bar in 0.05 * 2.0 ** (-np.arange(19) / 6):
        length, gap = 5 * bar, bar
        if x + 2 * length + gap > 0.97:
            x, y, row_height = 0.05, y + row_height + 0.03, 0.0
        for k in range(3):
            _fill(image, x + 2 * k * bar, x + (2 * k + 1) * bar, y, y + length)
            left = x + length + gap
            _fill(image, left, left + length, y + 2 * k * bar, y + (2 * k + 1) * bar)
        row_height = max(row_height, length)
        x += 2 * length + 3 * gap
    return image


_STRIPS = 32
"""Of a tilted target: so narrow that the step between two is below the camera's axial resolution."""


def tilted_target(image: npt.ArrayLike, z_um: float, width_um: float, tilt_deg: float) -> Scene:
    """Tilt a flat grey target about its vertical axis, as a staircase of strips parallel to the sensor.

    Parameters
    ----------
    image : array_like, (height, width)
    z_um : float
        Distance of the target's middle.
    width_um : float
        Width of the target in its own plane.
    tilt_deg : float
        Positive: the right side (larger x) is farther away.
    """
    grey = np.asarray(image, np.float32)
    columns = grey.shape[1]
    tilt = np.deg2rad(tilt_deg)
    pitch = width_um / columns
    height_um = pitch * grey.shape[0]
    borders = np.linspace(0, columns, min(_STRIPS, columns) + 1).round().astype(int)
    layers = []
    for first, last in itertools.pairwise(borders.tolist()):
        along = ((first + last) / 2 - columns / 2) * pitch
        radiance = np.repeat(grey[:, first:last, None], 3, axis=2)
        width = (last - first) * pitch * np.cos(tilt)
        place = (float(along * np.cos(tilt)), 0.0)
        layers.append(Layer(radiance, float(z_um + along * np.sin(tilt)), (height_um, float(width)), place))
    return Scene("tilted bar target", layers=tuple(layers))


def _fill(image: Float32Array, left: float, right: float, top: float, bottom: float) -> None:
    side = image.shape[0]
    rows = slice(round(top * side), round(bottom * side))
    image[rows, round(left * side) : round(right * side)] = 1
