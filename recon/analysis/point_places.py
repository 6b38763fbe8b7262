"""Points of light in a volume: where they are in the scene, between voxels.

A camera without a lens divides directions, not space (Kuo 2020, sec. 4.4): light of a point between two
planes lies on both, along its ray through the diffuser. So the centre of its light is taken along that ray:
its direction, and the mean of ``1 / z``, in which patterns grow evenly (Eq. 4.7). Looked for along the axis
instead, dim ends of its light are missed, and what is missed in depth moves the centre sideways.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from recon.analysis.whole_steps import in_whole_steps
from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base.declare import option
from recon.camera.grid import Grid, plane_of
from recon.errors import InputError

Plane = Float32Array
Whole = npt.NDArray[np.intp]
Voxel = tuple[int, int, int]

REACH = 2
"""Planes and pixels from its brightest voxel that a point's light is taken from, along its ray and across."""
BESIDE = (REACH + 0.5) * 2**0.5 + (REACH**2 + 2 * (REACH + 0.5) ** 2) ** 0.5
"""Pixels between rays of two points, where one may be nearer to a voxel of the other's window."""
CELL = 8
"""Rows and columns of a plane that points are kept by while others near them are looked for."""
MOST = 10_000
"""Points: where there are more, they are texture."""
OFF_PLANES, OFF_PX = 0.1, 0.1
"""Standard deviation of a point's place in planes and in pixels, at least: what points in photographs were
off in volumes by l1 and by total variation (``benchmarks/bead_places.py``)."""
WIDE = 0.5
"""Voxels that light of one point between two has about its centre at most; wider, it is known less well."""


@dataclass(frozen=True, slots=True)
class PointOptions:
    """Which points are told."""

    least: float = option(
        0.1,
        help="Brightest voxel of a point (fitted: its light), relative to the brightest of all, from which "
        "it is told.",
        above=0,
        most=1,
        label="Dimmest",
    )


@dataclass(frozen=True, slots=True)
class PointPlaces:
    """Points of a volume, the brightest first.

    Attributes
    ----------
    places_um : ndarray, float64, (n, 3)
        ``(x, y, z)`` in the scene; NaN where a volume does not know where its voxels lie.
    deviations_um : ndarray, float64, (n, 3)
        Standard deviations of these; of x and y with what z is off along an oblique ray.
    voxels : ndarray, float64, (n, 3)
        ``(plane, row, column)``, counted from 0: whole numbers are the middle of voxels.
    light : ndarray, float64, (n,)
        Sum of the voxels that a point was found from, of all channels.
    at_end : ndarray, bool, (n,)
        Brightest in the first or the last plane: such a point may lie beyond it. Where fitted: beyond it.
    misfit : float or None
        Of points fitted to the photograph (:func:`recon.reconstruction.point_errors.fitted_places`): what
        they leave of it, root mean square in units of its noise. None: they are of the volume alone.
    unexplained : float or None
        What they leave of it beyond its noise, relative to what is seen of them, root mean square.
    """

    places_um: Float64Array
    deviations_um: Float64Array
    voxels: Float64Array
    light: Float64Array
    at_end: BoolArray
    misfit: float | None = None
    unexplained: float | None = None

    def __len__(self) -> int:
        return len(self.light)

    def of_at_least(self, least: float) -> PointPlaces:
        """Return the points of so much light at least, relative to the brightest."""
        return self._first(int(np.count_nonzero(self.light >= least * self.light.max(initial=0))))

    def _first(self, count: int) -> PointPlaces:
        names = ("places_um", "deviations_um", "voxels", "light", "at_end")
        return replace(self, **{name: getattr(self, name)[:count] for name in names})


def point_places(
    volume: Array | Callable[[int], Array],
    grid: Grid,
    options: PointOptions | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> PointPlaces:
    """Find points of light in a volume.

    Parameters
    ----------
    volume : ndarray, (n_z, height, width[, n_channels]), or callable
        Or what returns a plane of it by its number. A reconstruction's own grid, or a metric one.
    grid : Grid
        Of the volume. Of a metric one with voxels finer than the planes and pixels it was made of, voxels are
        summed to these (:attr:`Grid.made_of_um`): one point is told once, and no better known than before.
    options : PointOptions, optional
    on_progress : callable, optional
        Called with the share done.

    Returns
    -------
    PointPlaces
        Places, micrometres, and light, the brightest first, each with its deviation.

    Raises InputError when there is one plane, one is not in front of the diffuser, two are at the same depth,
    or there are more points than are told apart.
    """
    if grid.shape[0] < 2:
        raise InputError("Points in depth are found in volumes of two planes or more; this has one.")
    if (behind := np.flatnonzero(grid.z_um <= 0)).size:
        raise InputError(
            f"Plane {behind[0]} is at {grid.z_um[behind[0]]:g} um; depths are counted from the diffuser and "
            "are above 0: no ray through it goes to planes in it or behind it. Leave them out."
        )
    order = np.argsort(grid.z_um, kind="stable")
    if (same := np.flatnonzero(np.diff(1 / grid.z_um[order]) == 0)).size:
        first, second = sorted(order[same[0] : same[0] + 2].tolist())
        raise InputError(
            f"Planes {first} and {second} are at the same depth, {grid.z_um[first]:g} um: a point has no "
            "place between them. Leave one out."
        )
    read = volume if callable(volume) else volume.__getitem__
    light, summed, factors = in_whole_steps(lambda z: _light(read(z)), grid)
    search = _Search(light, summed, on_progress or (lambda _share: None))
    brightest = search.brightest((options or PointOptions()).least)
    found = []
    for number, voxel in enumerate(brightest):
        found.append(search.point(voxel))
        search.on_progress(0.5 + (number + 1) / (2 * len(brightest)))
    order = np.argsort([-light for *_, light in found], kind="stable")
    places, off, voxels = (
        np.array([found[k][part] for k in order], np.float64).reshape(-1, 3) for part in range(3)
    )
    last = round(grid.shape[0] / factors[0]) - 1  # less than half a plane at the end is none
    ends = np.array([not 0 < brightest[k][0] < last for k in order], bool)
    voxels = voxels * factors + (factors - 1) / 2
    return PointPlaces(places, off, voxels, np.array([found[k][3] for k in order]), ends)


def _light(plane: Array) -> Plane:
    """Return a plane without its channels and what is below 0."""
    voxels = np.asarray(plane, np.float32)
    grey = voxels.sum(axis=2) if voxels.ndim == 3 else voxels
    return np.maximum(np.nan_to_num(grey, nan=0.0, posinf=0.0, neginf=0.0), 0)


class _Search:
    """Planes of light, and the points found in them so far."""

    def __init__(
        self, plane: Callable[[int], Plane], grid: Grid, on_progress: Callable[[float], object]
    ) -> None:
        self.plane = lru_cache(maxsize=2 * REACH + 2)(plane)
        self.grid, self.on_progress = grid, on_progress
        self.found: dict[Voxel, list[Voxel]] = {}
        self.known = bool(np.isfinite(grid.z_um).all() and np.isfinite(grid.pitch_um).all())
        self.steps_um = np.abs(np.gradient(grid.z_um)) if self.known else np.full(len(grid.z_um), np.nan)
        self.angles = grid.pitch_um / grid.z_um if self.known else np.ones(len(grid.z_um))

    def brightest(self, least: float) -> list[Voxel]:
        """Return the brightest voxel of every point, from the first plane to the last."""
        from scipy.ndimage import maximum_filter  # late: importing recon stays light

        count, top = self.grid.shape[0], 0.0
        lights, voxels = [np.zeros(0, np.float32)], [np.zeros((0, 3), np.int32)]
        for z in range(count):
            plane = self.plane(z)
            top = max(top, float(plane.max()))
            peaks = (plane == maximum_filter(plane, 2 * REACH + 1)) & (plane > 0) & (plane >= least * top)
            rows, columns = _plateaus(peaks)
            lights.append(plane[rows, columns])
            voxels.append(np.stack([np.full(len(rows), z), rows, columns], axis=1).astype(np.int32))
            self.on_progress((z + 1) / (2 * count))
        light, at = np.concatenate(lights), np.concatenate(voxels)
        light, at = light[light >= least * top], at[light >= least * top]
        order = np.lexsort((at[:, 2], at[:, 1], at[:, 0], light))[::-1]
        found: list[Voxel] = []
        for number in order:
            z, row, column = at[number].tolist()
            voxel = (z, row, column)
            if not any(self._is_beside(other, voxel) for other in self._near(voxel, REACH, REACH + 0.5)):
                self.found.setdefault(self._cell(*voxel), []).append(voxel)
                found.append(voxel)
            if len(found) > MOST:
                raise InputError(
                    f"There are more than {MOST} points as bright as {least:g} of the brightest: this is no "
                    "volume of single points. Ask for brighter ones."
                )
            self.on_progress(0.5)
        return sorted(found, key=lambda voxel: voxel[0])

    def _cell(self, z: int, row: float, column: float) -> Voxel:
        """Return the cell of a plane's rows and columns that points found in it are kept by."""
        return z, int(row // CELL), int(column // CELL)

    def _near(self, voxel: Voxel, planes: int, pixels: float) -> Iterator[Voxel]:
        """Give points found, in planes near a voxel, whose rays may be so near to its ray; some others.

        ``pixels`` are of any of these planes: where pixels look at wider angles, there are fewer of them.
        """
        nearest, farthest = max(voxel[0] - planes, 0), min(voxel[0] + planes, self.grid.shape[0] - 1)
        widest = self.angles[nearest : farthest + 1].max()
        for z in range(nearest, farthest + 1):
            row, column = self._on_ray(voxel, z)
            reach = pixels * widest / self.angles[z] + 1e-6
            # Pixels that look at very narrow angles are many; the points lie on their plane.
            height, width = self.grid.shape[1:]
            _, top, left = self._cell(z, max(row - reach, 0), max(column - reach, 0))
            _, bottom, right = self._cell(z, min(row + reach, height - 1), min(column + reach, width - 1))
            for down in range(top, bottom + 1):
                for across in range(left, right + 1):
                    yield from self.found.get((z, down, across), ())

    def _is_beside(self, point: Voxel, voxel: Voxel) -> bool:
        """Whether a voxel is as near to the ray through a point as its light may be."""
        row, column = self._on_ray(point, voxel[0])
        return max(abs(voxel[1] - row), abs(voxel[2] - column)) < REACH + 0.5

    def _on_ray(self, voxel: Voxel, z: int) -> tuple[float, float]:
        """Return row and column at which the ray through a voxel and the diffuser's middle meets a plane."""
        if not self.known or z == voxel[0]:
            return float(voxel[1]), float(voxel[2])
        x, y, depth = self.grid.place_um(*voxel)
        further = self.grid.z_um[z] / depth
        return self.grid.pixel_of(z, x * further, y * further)

    def point(self, voxel: Voxel) -> tuple[Float64Array, Float64Array, Float64Array, float]:
        """Return place, deviations, centre in voxels, and light, of the point that is brightest there."""
        light, at = self._light_of(voxel)
        total = float(light.sum())
        place, centre, beside = self._centre(light / total, at)
        wide = np.maximum(np.sqrt((light / total) @ beside**2) / WIDE, 1)
        off_plane, off_row, off_column = wide * (OFF_PLANES, OFF_PX, OFF_PX)
        off_z, pitch = off_plane * self.steps_um[voxel[0]], self.grid.pitch_um[voxel[0]]
        slopes = np.abs(place[:2] / place[2])
        across = np.hypot([off_column * pitch, off_row * pitch], slopes * off_z)
        return place, np.append(across, off_z), centre, total

    def _light_of(self, voxel: Voxel) -> tuple[Float64Array, Whole]:
        """Return light and (plane, row, column) of the voxels about a ray that are nearest to this point."""
        count, *size = self.grid.shape
        others = [other for other in self._near(voxel, 2 * REACH, BESIDE) if other != voxel]
        light, voxels = [], []
        for z in range(max(voxel[0] - REACH, 0), min(voxel[0] + REACH + 1, count)):
            down, across = (
                np.arange(max(round(at) - REACH, 0), min(round(at) + REACH + 1, n))
                for at, n in zip(self._on_ray(voxel, z), size, strict=True)
            )
            rows, columns = (each.ravel() for each in np.meshgrid(down, across, indexing="ij"))
            own = self._distance(voxel, z, rows, columns)
            nearest = np.ones(rows.size, bool)
            for other in others:
                nearest &= own <= self._distance(other, z, rows, columns)
            light.append(self.plane(z)[rows, columns][nearest])
            voxels.append(np.stack([np.full(rows.size, z), rows, columns], axis=1)[nearest])
        return np.concatenate(light).astype(np.float64), np.concatenate(voxels)

    def _distance(self, point: Voxel, z: int, rows: Whole, columns: Whole) -> Float64Array:
        """Return how far voxels of a plane are from a point, in planes and pixels from its ray, squared."""
        row, column = self._on_ray(point, z)
        return np.asarray((z - point[0]) ** 2 + (rows - row) ** 2 + (columns - column) ** 2)

    def _centre(self, share: Float64Array, at: Whole) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return the centre of light in the scene and in voxels, and each voxel's distance from it in voxels.

        ``share`` of the light has each voxel, (n,), of those ``at`` plane, row and column, (n, 3).
        """
        if not self.known:
            centre = share @ at
            return np.full(3, np.nan), centre, at - centre
        z_um = self.grid.z_um[at[:, 0]]
        x_um, y_um = np.array([self.grid.place_um(*one)[:2] for one in at]).T
        depth = float(share @ z_um) if self.grid.is_metric else float(1 / (share @ (1 / z_um)))
        place = np.array([share @ (x_um / z_um) * depth, share @ (y_um / z_um) * depth, depth])
        centre = voxels_of(place[None], self.grid)[0]
        rays = [self.grid.pixel_of(k, *place[:2] * self.grid.z_um[k] / depth) for k in at[:, 0]]
        beside = np.column_stack([at[:, 0] - centre[0], at[:, 1:] - np.array(rays)])
        return place, centre, beside


def voxels_of(places_um: Float64Array, grid: Grid) -> Float64Array:
    """Return ``(plane, row, column)`` of places in a grid, (n, 3): between planes on the ray through both.

    Beyond the outermost planes numbers go on: -0.2 is a fifth of a plane before the first.
    """
    voxels = np.empty((len(places_um), 3))
    for voxel, (x, y, z) in zip(voxels, places_um, strict=True):
        voxel[0] = plane_of(z, grid.z_um)
        nearest = min(max(round(voxel[0]), 0), len(grid.z_um) - 1)
        further = grid.z_um[nearest] / z
        voxel[1:] = grid.pixel_of(nearest, x * further, y * further)
    return voxels


def _plateaus(peaks: BoolArray) -> tuple[Whole, Whole]:
    """Return row and column of the voxel in the middle of each connected part; the last where two are."""
    from scipy.ndimage import label

    labels, count = label(peaks, np.ones((3, 3), int))
    rows, columns = np.nonzero(peaks)
    of = labels[rows, columns] - 1
    sizes = np.bincount(of, minlength=count)
    middles = (np.bincount(of, each, count) / sizes for each in (rows, columns))
    off = sum((each - middle[of]) ** 2 for each, middle in zip((rows, columns), middles, strict=True))
    order = np.lexsort((-np.arange(len(of)), off, of))
    chosen = order[np.searchsorted(of[order], np.arange(count))]
    return rows[chosen], columns[chosen]
