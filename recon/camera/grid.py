"""Where the voxels of a reconstruction lie, and volumes brought from there to voxels of equal size.

A camera without a lens divides directions, not space: voxels of one plane are as wide as that plane is far
away (Kuo 2020, sec. 4.4). :func:`metric_grid` and :func:`metric_planes` make volumes of them that can be
measured, turned and shown without a thought of that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.errors import InputError

if TYPE_CHECKING:
    from scipy import sparse

Plane = Float32Array

FAR_UM = 1e9
"""What stands for infinity, a kilometre: light from there is parallel to d / z, 1e-5 for a centimetre."""

SAME = 1e-3
"""Sizes that differ by less than this part of the smallest are taken for equal."""


def depth_in_words(z_um: float) -> str:
    """Say a distance from the diffuser: in millimetres, or that it is infinity."""
    return "infinity" if z_um >= FAR_UM else f"{z_um / 1e3:g} mm"


LEAN = 2.0
"""Logarithm of how much more one end of a plane's light may be raised than the other: enough for steps of
which one is 1.7 times the next."""
HALF = 0.5 - SAME
"""Of evenly spaced planes half a step beyond the last one fills no voxel."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the voxels of a reconstruction lie: every depth has its own lateral pitch (Kuo 2020, sec. 4.4).

    Attributes
    ----------
    shape : (int, int, int)
        ``(n_z, height, width)``.
    centre : (int, int)
        ``(row, column)`` of the pixel on the axis.
    z_um : ndarray, (n_z,)
        Depth of each plane in front of the diffuser; NaN where not known.
    pitch_um : ndarray, (n_z,)
        Lateral pitch of each plane, ``sensor pitch * z / d`` (Eq. 3.1); NaN where not known.
    sensor_pitch_um : float or None
        Pixel pitch of the sensor: one pixel is what shifts the PSF by one sensor pixel.
    axis_um : ndarray, (n_z, 2), or None
        ``(x, y)`` that the pixel on the axis looks at, plane by plane: where the source of its PSF was. None:
        0 throughout.
    upright : bool
        Whether rows and columns go with y and x. On the sensor's grid they go against them: the picture
        stands upside down (:mod:`recon.types`).
    made_of_um : (float, float), or None
        Step and pitch of the middle plane of what a metric grid was made of: finer voxels tell no more.
    """

    shape: tuple[int, int, int]
    centre: tuple[int, int]
    z_um: Float64Array
    pitch_um: Float64Array
    sensor_pitch_um: float | None = None
    axis_um: Float64Array | None = None
    upright: bool = False
    made_of_um: tuple[float, float] | None = None

    @property
    def spacing_um(self) -> Float64Array:
        """Distance from each plane to the next, positive; the last one's is that of the plane before it."""
        if len(self.z_um) < 2:
            return np.full(len(self.z_um), np.nan)
        steps = np.abs(np.diff(self.z_um))
        return np.append(steps, steps[-1])

    @property
    def pixel_mrad(self) -> float:
        """Angle between what neighbouring pixels near the axis look at, in every plane; NaN if not known."""
        return float(1e3 * self.pitch_um[0] / self.z_um[0])

    def direction_deg(self, row: float, column: float) -> tuple[float, float]:
        """Return the angles ``(x, y)`` from the axis at which a pixel looks; NaN where they are not known.

        A picture of what is far away has places on the sky: ``tan(angle) = offset * pitch / d``.
        """
        x, y, z = self.place_um(0, row, column)
        return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arctan2(y, z)))

    @property
    def is_metric(self) -> bool:
        """Whether all voxels have one size."""
        sizes = np.stack([self.pitch_um, self.spacing_um])
        return bool(np.isfinite(sizes).all() and (np.ptp(sizes, axis=1) <= SAME * sizes.min(axis=1)).all())

    def place_um(self, z: int, row: float, column: float) -> tuple[float, float, float]:
        """Return ``(x, y, z)`` of a voxel in the scene; NaN where it is not known."""
        sign = 1 if self.upright else -1
        x, y = (0.0, 0.0) if self.axis_um is None else self.axis_um[z]
        pitch = sign * self.pitch_um[z]
        return (
            float(x + (column - self.centre[1]) * pitch),
            float(y + (row - self.centre[0]) * pitch),
            float(self.z_um[z]),
        )

    def pixel_of(self, z: int, x_um: float, y_um: float) -> tuple[float, float]:
        """Return ``(row, column)`` in plane ``z`` of a place: the inverse of :meth:`place_um`."""
        x, y = (0.0, 0.0) if self.axis_um is None else self.axis_um[z]
        pitch = (1 if self.upright else -1) * self.pitch_um[z]
        return float(self.centre[0] + (y_um - y) / pitch), float(self.centre[1] + (x_um - x) / pitch)

    def spanned_by(self, places_um: Float64Array) -> tuple[float, float, float, float] | None:
        """Return top, left, bottom and right of the pixels that places (n, 3) span; None where not known.

        Each place counts in the plane nearest to it.
        """
        if not (np.isfinite(places_um).all() and np.isfinite(self.pitch_um).all()):
            return None
        planes = np.abs(self.z_um - places_um[:, 2:]).argmin(axis=1)
        seen = np.array([self.pixel_of(int(k), x, y) for k, (x, y, _) in zip(planes, places_um, strict=True)])
        (top, left), (bottom, right) = seen.min(axis=0).tolist(), seen.max(axis=0).tolist()
        return top, left, bottom, right

    def axis_weights(self) -> Float64Array:
        """Weights (n_z, 3) of the z, y and x differences for total variation in space instead of in voxels.

        A step between neighbours counts by the area of the face between their voxels; the x face of a plane
        is ``pitch * spacing``, the z face ``pitch^2``, so relative to x a z difference weighs ``pitch /
        spacing``. One throughout where the geometry is not known; nothing along z where there is one plane.
        """
        weights = np.ones((len(self.z_um), 3))
        if len(self.z_um) == 1:
            weights[:, 0] = 0.0
            return weights
        ratio = self.pitch_um / self.spacing_um
        if np.isfinite(ratio).all():
            weights[:, 0] = ratio
        return weights


def metric_grid(grid: Grid, voxel_um: float | None = None) -> Grid:
    """Return a grid of equal voxels that holds all planes of another, upright.

    Parameters
    ----------
    grid : Grid
    voxel_um : float, optional
        Edge of a cube. Default: as wide as the middle plane's pixels, as deep as the step beside it, or as
        half the volume where that is less: of few planes the farthest step may be most of it.

    Raises InputError where depths or pitches are not known, there is one plane, planes share a depth, or a
    voxel is larger than the volume.
    """
    n_z, height, width = grid.shape
    if n_z < 2:
        raise InputError("A picture has one plane, whose pixels are of equal size already.")
    if not (np.isfinite(grid.z_um).all() and np.isfinite(grid.pitch_um).all()):
        raise InputError(
            "The depths of the planes or their pixels' sizes are not known, so voxels cannot be brought to "
            "equal micrometres. Reconstruct with a calibration that says the depths, the pixel pitch and "
            "the distance from diffuser to sensor."
        )
    order = np.argsort(grid.z_um)
    z = grid.z_um[order]
    steps = np.diff(z)
    if (steps <= 0).any():
        raise InputError(f"Two planes lie at the same depth, {z[int(np.argmin(steps))]:g} um.")
    if voxel_um is not None and not 0 < voxel_um < np.inf:
        raise InputError(f"A voxel's edge is above 0 um, not {voxel_um:g}.")
    middle = min(n_z // 2, n_z - 2)
    made_of_um = float(steps[middle]), float(grid.pitch_um[order][n_z // 2])
    near = _nearer(z)
    span = float(z[-1] - z[0] + near + steps[-1] / 2)
    deep, across = (min(made_of_um[0], span / 2), made_of_um[1]) if voxel_um is None else (voxel_um, voxel_um)
    # A voxel lies on the nearest plane, none of the planes outside, and half a step beyond the outermost is
    # filled: by voxels that reach into it, each by its part there; none has its middle behind the diffuser.
    last = (z[-1] - z[0]) / deep
    above = max(0, min(int(near / deep + HALF), int(z[0] / deep - HALF)))
    below = max(int(np.ceil(last - SAME)), int(last + steps[-1] / 2 / deep + HALF))
    places = z[0] + np.arange(-above, below + 1) * deep
    count = len(places)
    sides = []
    for axis, n in ((1, height), (0, width)):  # of axis_um and of rows and columns
        middles, centre = _axis(grid)[:, axis], grid.centre[1 - axis]
        behind, before = centre + 0.5, n - centre - 0.5  # pixels on either side of the axis
        if grid.upright:
            behind, before = before, behind
        low = float((middles - before * grid.pitch_um).min())
        high = float((middles + behind * grid.pitch_um).max())
        start = int(np.ceil(low / across - 1e-6))
        sides.append((start, int(np.floor(high / across + 1e-6)) - start + 1))
    (top, rows), (left, columns) = sides
    if 2 * deep > span or rows < 1 or columns < 1:
        raise InputError(
            f"Voxels of {across:g} um are too large: two must fit into the volume's depth of {span:.4g} um, "
            "and one across. Give a smaller edge."
        )
    return Grid(
        (count, rows, columns),
        (-top, -left),
        places,
        np.full(count, across),
        grid.sensor_pitch_um,
        None,
        True,
        grid.made_of_um or made_of_um,
    )


def metric_planes(plane: Callable[[int], Plane], grid: Grid, metric: Grid) -> Callable[[int], Plane]:
    """Bring a volume to a metric grid: return what makes its planes.

    Values are light a voxel: what all voxels of a bead add up to stays, and so does the centre of its light;
    across, where voxels are no whole part of a pixel, the light to a few per cent. Between planes the mean
    goes along the rays through the diffuser, pixel by pixel. Where no pixel looks there is 0. Smaller voxels
    than pixels are interpolated linearly; larger ones are triangular means.

    Parameters
    ----------
    plane : callable
        ``plane(z)`` returns (height, width) or (height, width, n_channels).
    grid : Grid
        Of the volume.
    metric : Grid
        As :func:`metric_grid` returns it.

    Returns
    -------
    callable
        ``made(z)`` returns (metric height, metric width[, n_channels]), float32; 0 is the nearest.
    """
    order = np.argsort(grid.z_um)
    nodes, pitches = grid.z_um[order], grid.pitch_um[order]
    axis = _axis(grid)[order]
    across = float(metric.pitch_um[0])
    kept = lru_cache(maxsize=4)(plane)  # neighbours in the result come from the same planes
    shares = _shares(nodes, metric.z_um, float(metric.spacing_um[0]))

    def made(number: int) -> Plane:
        z = metric.z_um[number]
        inside = float(np.clip(z, nodes[0], nodes[-1]))
        pitch = float(np.interp(z, nodes, pitches)) * z / inside  # rays go on beyond the outermost planes
        mixed: Any = 0
        for k in np.flatnonzero(shares[number]):
            mixed = mixed + np.float32(shares[number, k]) * kept(int(order[k]))
        x, y = (float(np.interp(z, nodes, axis[:, i])) for i in (0, 1))
        rows, columns = (
            _seen_by(n, centre, grid.upright, (places - off) / pitch, across / pitch)
            for n, centre, off, places in zip(
                grid.shape[1:], grid.centre, (y, x), _places(metric), strict=True
            )
        )
        channels = mixed[..., None] if mixed.ndim == 2 else mixed
        moved = [(columns @ (rows @ channels[..., c]).T).T for c in range(channels.shape[2])]
        result = np.stack(moved, axis=-1) * np.float32((across / pitch) ** 2)
        return np.ascontiguousarray(result[..., 0] if mixed.ndim == 2 else result)

    return made


def metric_volume(
    volume: Float32Array, grid: Grid, voxel_um: float | None = None
) -> tuple[Float32Array, Grid]:
    """Return a volume (n_z, height, width[, n_channels]) on voxels of equal size, and their grid.

    Parameters and errors as :func:`metric_grid`, values as :func:`metric_planes`.
    """
    metric = metric_grid(grid, voxel_um)
    made = metric_planes(volume.__getitem__, grid, metric)
    return np.stack([made(z) for z in range(metric.shape[0])]), metric


def _axis(grid: Grid) -> Float64Array:
    return np.zeros((len(grid.z_um), 2)) if grid.axis_um is None else np.asarray(grid.axis_um, np.float64)


def _places(metric: Grid) -> tuple[Float64Array, Float64Array]:
    """Return y of the rows and x of the columns of a metric grid."""
    rows, columns = (
        (np.arange(n) - c) * metric.pitch_um[0] for n, c in zip(metric.shape[1:], metric.centre, strict=True)
    )
    return rows, columns


def _nearer(nodes: Float64Array) -> float:
    """Return how far the volume goes on before its nearest plane: half a step, or to the diffuser."""
    return float(min((nodes[1] - nodes[0]) / 2, nodes[0]))


def _shares(nodes: Float64Array, places: Float64Array, step: float) -> Float64Array:
    """Return which share of each plane's light goes to each place, (n_places, n_nodes).

    Light a micrometre is interpolated; then each plane's shares are tilted, exponentially in depth, so that
    they add up to one and their centre is the plane's. Without that a bead of a plane whose steps differ on
    both sides would be deeper than it is, and its light, which lies along an oblique ray, beside it.
    """
    first, last = nodes[0] - _nearer(nodes), nodes[-1] + (nodes[-1] - nodes[-2]) / 2
    # Of a voxel at either end the part counts that is in the volume.
    inside = np.minimum(places + step / 2, last) - np.maximum(places - step / 2, first)
    shares: Float64Array = _between(nodes, places, step) * np.clip(inside, 0, step)[:, None]
    # Of a plane on one side of all that has a share of it: the two places beside it, by their distances.
    beside = np.stack([np.interp(nodes, places, unit) for unit in np.eye(len(places))])
    for k, node in enumerate(nodes):
        of = np.flatnonzero(shares[:, k])
        off = (places[of] - node) / step
        if off.size and off[0] < -SAME and off[-1] > SAME:
            shares[of, k] = _centred(shares[of, k], off)
        else:
            shares[:, k] = beside[:, k]
    return shares


def _centred(shares: Float64Array, off: Float64Array) -> Float64Array:
    """Return shares times ``exp(a + b off)``: positive, their sum 1 and, by Newton, their mean ``off`` 0.

    As far as :data:`LEAN` lets them: steps that differ by more would leave what is even in bands.
    """
    tilt, most = 0.0, LEAN / float(off[-1] - off[0])
    tilted: Float64Array = shares
    for _ in range(50):
        tilted = shares * np.exp(tilt * off)
        tilted /= tilted.sum()
        mean = float(tilted @ off)
        new = float(np.clip(tilt - mean / max(float(tilted @ (off - mean) ** 2), 1e-9), -most, most))
        if abs(new - tilt) < 1e-9 * most:
            break
        tilt = new
    return tilted


def _between(nodes: Float64Array, places: Float64Array, step: float) -> Float64Array:
    """Weights (n_places, n_nodes) of linear interpolation; of its triangular mean where the steps are larger.

    Constant beyond the ends.
    """
    least = float(np.diff(nodes).min())
    parts = np.zeros(1)
    if step > (1 + SAME) * least:
        n = 2 * int(np.ceil(step / least))
        parts = np.arange(1 - n, n) / n
    shares = 1 - np.abs(parts)
    unit = np.eye(len(nodes))
    total = np.zeros((len(places), len(nodes)))
    for part, share in zip(parts, shares / shares.sum(), strict=True):
        total += share * np.stack([np.interp(places + part * step, nodes, row) for row in unit], axis=1)
    return total


def _seen_by(n: int, centre: int, upright: bool, offsets: Float64Array, step: float) -> sparse.csr_array:
    """Return the matrix (n_places, n) that takes pixels to places.

    ``offsets`` are the places from the axis and ``step`` that from one to the next, both in pixels.
    """
    from scipy import sparse  # late: importing recon stays light

    at = centre + (offsets if upright else -offsets)
    reach = max(1.0, step)
    near = np.floor(at)[:, None].astype(int) + np.arange(-int(np.ceil(reach)), int(np.ceil(reach)) + 2)
    weights = np.maximum(1 - np.abs(at[:, None] - near) / reach, 0)
    weights /= weights.sum(axis=1, keepdims=True)
    used = (weights > 0) & (near >= 0) & (near < n)
    rows = np.broadcast_to(np.arange(len(at))[:, None], near.shape)
    return sparse.csr_array((weights[used].astype(np.float32), (rows[used], near[used])), shape=(len(at), n))


def plane_of(z_um: float, planes_um: Float64Array) -> float:
    """Return the number of the plane at a depth, between two or more and beyond them evenly in ``1 / z``."""
    order = np.argsort(1 / planes_um)
    near = 1 / planes_um[order]
    first = int(np.clip(np.searchsorted(near, 1 / z_um) - 1, 0, len(near) - 2))
    share = (1 / z_um - near[first]) / (near[first + 1] - near[first])
    return float((1 - share) * order[first] + share * order[first + 1])
