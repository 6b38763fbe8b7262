"""Resolution by reconstructions: two points across, two along, 16 in a square (Kuo 2020, sec. 4.4, Fig. 4.4).

Images of single points at continuous places are summed, noise is added, and the sum is reconstructed with
tau = 0. Points count as resolved when the reconstruction dips by 20 % between every two neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.gram import WindowProblem
from recon.base import fft
from recon.base.declare import option
from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

DIP = 0.2
"""Dip between two points that counts as resolved (the Rayleigh criterion's)."""
TRIALS = 3
"""Noise draws and sub-pixel positions that all must be resolved."""
PROMISED, NEARER, AT_NEARER = 0.9, 0.8, 0.3
"""Share of the pairs that are told apart at the stated distance, and at ``NEARER`` of it at the most."""
ROUNDS, DRAWS = 3, 8
"""Rounds of two points, later ones about what earlier ones found; pairs of other distances in each."""

PointImage = Callable[[float, float], Array]
"""Image (height, width) of one point ``columns`` sensor pixels off the axis at a place ``s`` on the depth
axis, in planes (0 is the first): ``image(columns, s)``."""
PLANES = 17
"""Planes of the window in depth, half an axial step (inner product 0.8) apart: the spacing of Sec. 4.4."""
HALF_WINDOW = (4, 24)
"""Rows and columns that the window reaches from the axis, voxels."""
_PARTS = 2  # of a plane, at which points' PSFs are made: between two of them 0.3 % of the light is blurred
FARTHEST = 12.0
"""Pixels, or planes, between two points at most."""


USUAL_ELECTRONS, USUAL_READ_E = 10_000.0, 2.0
"""Of a photograph whose noise nobody knows."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the test images."""

    electrons: float = USUAL_ELECTRONS
    """At the brightest pixel."""
    read_e: float = USUAL_READ_E
    """Read noise, electrons."""

    def expose(self, light: Array, rng: np.random.Generator) -> Floats:
        """Return one exposure of an image, in the image's units."""
        scale = self.electrons / float(light.max())
        charge = rng.poisson(np.maximum(light, 0) * scale) + rng.normal(0.0, self.read_e, light.shape)
        return np.asarray(charge / scale)


@dataclass(frozen=True, slots=True)
class AskedNoise:
    """Noise of the test images: what is not given is that of the calibration's frames, where they tell it."""

    electrons: float | None = option(
        None,
        help="Electrons at the brightest pixel of the tests' images.",
        default_words="as the frames tell, else 10000",
        least=1,
        group="Point tests",
    )
    read_e: float | None = option(
        None,
        help="Read noise of the tests' images, electrons.",
        default_words="as the frames tell, else 2",
        least=0,
        flags=("--read-noise",),
        metavar="E",
        label="Read noise (electrons)",
        group="Point tests",
    )

    def of(self, quality: Mapping[str, Any]) -> tuple[Noise, str]:
        """Return the noise for a calibration of this quality, and where it comes from in words."""
        kept = quality.get("noise")
        measured: Mapping[str, Any] = kept if isinstance(kept, Mapping) else {}

        def known(name: str, given: float | None, usual: float) -> tuple[float, str]:
            if given is not None:
                return given, "given"
            seen = measured.get(name)
            if isinstance(seen, int | float) and np.isfinite(seen) and seen >= 0:
                return float(seen), "measured in its frames"
            return usual, "assumed"

        electrons, source = known("electrons", self.electrons, USUAL_ELECTRONS)
        read_e, read_source = known("read_e", self.read_e, USUAL_READ_E)
        words = source if source == read_source else f"{source}; the read noise {read_source}"
        return Noise(max(electrons, 1.0), read_e), words


@dataclass(frozen=True, slots=True)
class TriedPair:
    """A pair of points in a reconstruction."""

    px: float
    axis: int
    """0: along y, 1: along x."""
    told: bool
    place: float = 0.0
    """Of its first point along the axis: 0 in the middle of a pixel, up to 1 in the next one's."""


@dataclass(frozen=True, slots=True)
class Reached:
    """What the default reconstruction reaches, with the noise of the tests."""

    across_px: tuple[float | None, float | None]
    """Distance along y and along x at which 90 % of the pairs are told apart, and at 0.8 of it at most 30 %
    (:mod:`recon.analysis.told_apart`); at the least the smallest one tried; None: at none tried."""
    focus_um: tuple[float, float] | None
    """Nearest and farthest depth (possibly infinite) at which pairs half as far again apart are told apart in
    a picture focused at the depth analysed; None where no distance was found along an axis, or the sensor
    has no room for two pairs."""
    pairs: tuple[TriedPair, ...]
    method: str
    """Solver and prior."""
    part: float
    """Part of the sensor's pixels that was used."""
    shares: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None)
    """Along y and along x: the share of the pairs told apart at the stated distance, and at 0.8 of it."""


@dataclass(frozen=True, slots=True)
class InVolumes:
    """What default volumes reach, with the noise of the tests."""

    along_per_um: float | None
    """Difference in 1/z of two points along the axis of which 90 % are told apart, and at 0.8 of it at most
    30 %; None: at none tried."""
    sixteen_factor: float | None
    """By how much the optics' two distances had to grow for 4 x 4 points in x and z; None: more than there is
    room for."""
    planes: int
    """Of the largest volume, half an axial step apart."""
    part: float
    """Part of the sensor's pixels that was used."""


@dataclass(frozen=True, slots=True)
class PointTrial:
    """One image of points, reconstructed."""

    separation_px: float
    separation_planes: float
    """``separation_px`` and ``separation_planes``: between neighbours."""
    dip: float
    """The smallest dip between any two neighbours, of all draws."""
    map: Floats
    """(n_z, width): the reconstruction of the last draw, summed over rows."""

    @property
    def resolved(self) -> bool:
        """Whether every two neighbours are told apart."""
        return self.dip >= DIP


@dataclass(frozen=True, slots=True)
class PointGrid:
    """Points side by side: how many, and how far from their neighbours, in pixels and planes."""

    columns: int
    planes: int = 1
    separation_px: float = 0.0
    separation_planes: float = 0.0


def try_points(
    problem: WindowProblem,
    image: PointImage,
    grid: PointGrid,
    noise: Noise,
    *,
    seed: int = 0,
    trials: int = TRIALS,
) -> PointTrial:
    """Reconstruct a grid of points; see :class:`PointTrial`. The first draw not resolved is the last."""
    rng = np.random.default_rng(seed)
    dips: list[float] = []
    while len(dips) < trials and min(dips, default=DIP) >= DIP:
        # Where the grid's points lie between voxels differs from draw to draw.
        phase_x, phase_z = rng.uniform(-0.5, 0.5, 2)
        x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * grid.separation_px + phase_x
        z = (problem.n_z - 1) / 2 + (np.arange(grid.planes) - (grid.planes - 1) / 2) * grid.separation_planes
        z = z + (phase_z if problem.n_z > 1 else 0.0)
        if max(abs(x)) > problem.half[1] - 1 or z[0] < 0 or z[-1] > problem.n_z - 1:
            raise InputError(
                f"{grid.columns} x {grid.planes} points {grid.separation_px:.3g} px and "
                f"{grid.separation_planes:.3g} planes apart do not fit the window."
            )
        if isinstance(image, _Shifted):
            light = image.of(x, z)
        else:
            light = np.sum([image(float(c), float(s)) for s in z for c in x], axis=0)
        seen = problem.solve(noise.expose(light, rng)).sum(axis=1)
        places = np.stack(np.meshgrid(z, x + problem.half[1], indexing="ij"), axis=-1)
        dips.append(smallest_dip(seen, places))
    return PointTrial(grid.separation_px, grid.separation_planes, min(dips), seen)


def smallest_dip(seen: Floats, places: Floats) -> float:
    """Return the smallest dip between neighbours of a grid of points.

    Parameters
    ----------
    seen : ndarray, (n_z, width)
    places : ndarray, (n_planes, n_columns, 2)
        Where the points are, ``(plane, column)``.

    Returns
    -------
    float
        ``1 - valley / lower peak``; each peak is the largest value nearer to its point than a third of the
        spacing, the valley the least on the line between two peaks. 0 where a peak is missing.
    """
    n_planes, n_columns = places.shape[:2]
    step_z = float(places[1, 0, 0] - places[0, 0, 0]) if n_planes > 1 else 2.0
    step_x = float(places[0, 1, 1] - places[0, 0, 1]) if n_columns > 1 else 2.0
    reach = max(step_z / 3, 0.5), max(step_x / 3, 0.5)
    peaks = np.array([[_peak(seen, place, *reach) for place in row] for row in places])
    return min(
        _dip(seen, peaks[j, i], peaks[other])
        for j, i in np.ndindex(n_planes, n_columns)
        for other in ((j + 1, i), (j, i + 1))
        if other[0] < n_planes and other[1] < n_columns
    )


def smallest_told(
    try_one: Callable[[float, int], PointTrial], least: float, most: float = FARTHEST
) -> tuple[list[PointTrial], float | None]:
    """Try points at separations, or multiples of them, from ``least`` to ``most``, each with its own seed.

    Returns
    -------
    list of PointTrial
        All that were made, the last one at the separation found.
    float or None
        The separation at which nine in ten of them are resolved, and at 0.8 of it at most three in ten.
    """
    trials: list[PointTrial] = []
    tried: list[TriedPair] = []
    about, wide, found = least * np.sqrt(3.0), np.sqrt(3.0), None
    rng = np.random.default_rng(0)
    for _ in range(ROUNDS):
        for share in (np.arange(DRAWS) + rng.uniform(0, 1, DRAWS)) / DRAWS:
            apart = min(float(about * wide ** (2 * share - 1)), most)
            trials.append(try_one(apart, len(tried)))
            tried.append(TriedPair(apart, 0, trials[-1].resolved))
        found, _ = stated_px(tried)
        about, wide = (found, 1.3) if found is not None else (1.5 * about, wide)
    if found is not None:
        trials.append(try_one(found, 0))
    return trials, found


def stated_px(tried: Sequence[TriedPair]) -> tuple[float | None, float | None]:
    """Return the distance stated by a logistic curve in the logarithm of the distance, along y and x.

    The middle of the distances at which it has :data:`PROMISED`, and at ``NEARER`` of which
    :data:`AT_NEARER` at most; the nearest with the first where none has both. Both axes share its slope.
    Never below the smallest distance tried; None where no pair of an axis was told apart, or none beyond.
    """
    from scipy.optimize import minimize  # late: importing recon stays light

    logs = np.log([one.px for one in tried])
    axes = np.array([one.axis for one in tried])
    told = np.array([one.told for one in tried])
    if not told.any():
        return None, None
    centre = float(logs.mean())

    def misfit(p: Floats) -> float:
        z = np.exp(p[0]) * (logs - centre - p[1 + axes])
        # A slope of ten to forty in log distance is usual; pairs told apart by luck do not flatten it.
        return float(
            np.logaddexp(0.0, np.where(told, -z, z)).sum() + 0.5 * ((p[0] - np.log(20.0)) / 0.5) ** 2
        )

    slope, *middles = minimize(misfit, np.array([np.log(20.0), 0.0, 0.0]), method="Nelder-Mead").x
    nearest, farthest = (np.log(share / (1 - share)) / np.exp(slope) for share in (PROMISED, AT_NEARER))
    beyond = (nearest + max(farthest - np.log(NEARER), nearest)) / 2
    stated = [float(np.exp(centre + middle + beyond)) for middle in middles]
    least, most = min(one.px for one in tried), max(one.px for one in tried)
    y, x = (max(px, least) if px <= most and axis in axes else None for axis, px in enumerate(stated))
    return y, x


def _peak(seen: Floats, place: Floats, reach_z: float, reach_x: float) -> tuple[int, int]:
    (z, x), (n_z, width) = place, seen.shape
    rows = slice(max(int(np.ceil(z - reach_z)), 0), min(int(np.floor(z + reach_z)), n_z - 1) + 1)
    columns = slice(max(int(np.ceil(x - reach_x)), 0), min(int(np.floor(x + reach_x)), width - 1) + 1)
    part = seen[rows, columns]
    row, column = np.unravel_index(int(np.argmax(part)), part.shape)
    return int(row) + rows.start, int(column) + columns.start


def _dip(seen: Floats, first: npt.NDArray[np.int_], second: npt.NDArray[np.int_]) -> float:
    steps = int(np.abs(second - first).max())
    lower = min(float(seen[tuple(first)]), float(seen[tuple(second)]))
    if steps < 2 or lower <= 0:
        return 0.0
    line = [np.rint(first + (second - first) * k / steps).astype(int) for k in range(1, steps)]
    return 1.0 - min(float(seen[tuple(p)]) for p in line) / lower


# The tests of a calibration -------------------------------------------------------------------------
@dataclass(frozen=True)
class PointTests:
    """What was resolved."""

    lateral_px: float | None
    """Two points across: smallest resolved separation on the sensor; None where none tried was resolved."""
    axial_per_um: float | None
    """Two points along the axis: difference in 1/z."""
    sixteen_factor: float | None
    """By how much both separations had to grow for 4 x 4 points in x and z: the dissertation's 1.7."""
    lateral: tuple[PointTrial, ...]
    axial: tuple[PointTrial, ...]
    sixteen: tuple[PointTrial, ...]
    """``lateral``, ``axial`` and ``sixteen``: every trial made."""
    notes: tuple[str, ...]


def planes_about(z_um: float, step_per_um: float, count: int = PLANES) -> Floats:
    """Return ``1 / z`` of planes half an axial step apart about a depth, the nearest first."""
    return np.asarray(1 / z_um - step_per_um / 2 * (np.arange(count) - count // 2), np.float64)


def point_tests(
    psf_at: Callable[[float], Array],
    z_um: float,
    *,
    lateral_px: float,
    step_per_um: float,
    noise: Noise | None = None,
    image: Callable[[float, float], Array] | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> PointTests:
    """Run the point tests about a depth.

    Parameters
    ----------
    psf_at : callable
        ``psf_at(z_um)``: the PSF (height, width) of a point on the axis.
    z_um : float
        Depth of the middle of the tests.
    lateral_px, step_per_um : float
        Predicted resolution (inner product 0.8): where the search starts, and the planes' spacing.
    noise : Noise, optional
    image : callable, optional
        ``image(columns, z_um)``: one point's image (height, width), ``columns`` pixels off the axis on the
        sensor, measured or from other optics. Default: ``psf_at``, shifted between pixels.
    on_progress : callable, optional
        Called with the share done.
    """
    noise = noise or Noise()
    on_progress = on_progress or (lambda _share: None)
    inverse = planes_about(z_um, step_per_um)
    notes: list[str] = []
    with_depth = bool(np.isfinite(step_per_um) and inverse[-1] > 0)
    if not with_depth:
        inverse = np.array([1 / z_um])
        notes.append(
            f"At {z_um / 1e3:.3g} mm the axial window would reach beyond infinity: points were tested across "
            "the axis only. Choose a nearer depth for tests along it."
        )
    planes = np.stack([psf_at(float(1 / v)) for v in inverse])
    middle = len(planes) // 2
    points: list[PointImage] = []
    for of in (inverse, inverse[middle : middle + 1]):
        shifted = _Shifted(psf_at, of, planes.shape[1:])
        points.append(shifted if image is None else shifted.seen_by(image))
    point, in_plane = points
    on_progress(0.1)
    across = WindowProblem(planes[middle][None], HALF_WINDOW)
    lateral, px = smallest_told(
        lambda apart, seed: try_points(
            across, in_plane, PointGrid(2, separation_px=apart), noise, seed=seed, trials=1
        ),
        max(0.7 * lateral_px, 1.2),
    )
    if px is None:
        notes.append("No two points across the axis were resolved at any separation tried.")
    on_progress(0.3)
    if not with_depth:
        return PointTests(px, None, None, tuple(lateral), (), (), tuple(notes))
    along = WindowProblem(planes, (4, 4))
    axial, apart_planes = smallest_told(
        lambda apart, seed: try_points(
            along, point, PointGrid(1, 2, separation_planes=apart), noise, seed=seed, trials=1
        ),
        1.2,
    )
    if apart_planes is None:
        notes.append("No two points along the axis were resolved at any separation tried.")
    on_progress(0.5)
    sixteen: list[PointTrial] = []
    factor = None
    if px is not None and apart_planes is not None:
        square, draw = WindowProblem(planes, HALF_WINDOW), count(1)

        def sixteen_points(by: float, seed: int) -> PointTrial:
            on_progress(0.5 + 0.5 * next(draw) / (ROUNDS * DRAWS + 1))
            grid = PointGrid(4, 4, by * px, by * apart_planes)
            return try_points(square, point, grid, noise, seed=seed, trials=1)

        room = min((square.n_z - 2) / (3 * apart_planes), (2 * square.half[1] - 3) / (3 * px))
        if room > 1:
            sixteen, factor = smallest_told(sixteen_points, 1.0, room)
        if factor is None:
            notes.append(
                "16 points were not resolved at nine in ten places at any separation that fits the window."
            )
    return PointTests(
        px,
        None if apart_planes is None else apart_planes * step_per_um / 2,
        factor,
        tuple(lateral),
        tuple(axial),
        tuple(sixteen),
        tuple(notes),
    )


class _Shifted:
    """Images (height, width) of points: PSFs between planes, shifted between pixels by a linear phase."""

    def __init__(self, psf_at: Callable[[float], Array], inverse: Floats, shape: tuple[int, ...]) -> None:
        self._psf_at, self._inverse, self._light = psf_at, inverse, shape
        self._spectra: dict[int, Array] = {}
        # Room on both sides for the shift, which otherwise would wrap around.
        self._shape = fft.fast_shape((shape[0], shape[1] + 4 * HALF_WINDOW[1]))

    def depth_um(self, s: float) -> float:
        """Return the depth of a place between planes, evenly in 1/z."""
        return float(1 / np.interp(s, np.arange(len(self._inverse)), self._inverse))

    def seen_by(self, image: Callable[[float, float], Array]) -> PointImage:
        """Return points between the planes by images of points at depths."""
        return lambda columns, s: image(columns, self.depth_um(s))

    def __call__(self, columns: float, s: float) -> Array:
        return self.of(np.array([columns]), np.array([s]))

    def of(self, columns: Array, places: Array) -> Array:
        """Return the light of a point at each of ``columns`` in each of ``places``: one transform."""
        total = np.zeros((self._shape[0], self._shape[1] // 2 + 1), np.complex64)
        for s in places:
            part = int(_PARTS * s)
            share = np.float32(_PARTS * s - part if len(self._inverse) > 1 else 0.0)
            total += (1 - share) * self._spectrum(part)
            if share > 0:
                total += share * self._spectrum(part + 1)
        frequency = np.fft.rfftfreq(self._shape[1])
        total *= np.exp(-2j * np.pi * np.multiply.outer(columns, frequency)).sum(axis=0).astype(np.complex64)
        height, width = self._light
        light: Array = fft.irfft(total, self._shape[1])[:height, :width]
        return light

    def _spectrum(self, part: int) -> Array:
        """Return the PSF's at this part of a plane: between two of them the light hardly changes."""
        if part not in self._spectra:
            padded = np.zeros(self._shape, np.float32)
            padded[: self._light[0], : self._light[1]] = self._psf_at(self.depth_um(part / _PARTS))
            self._spectra[part] = fft.rfft(padded)
        return self._spectra[part]
