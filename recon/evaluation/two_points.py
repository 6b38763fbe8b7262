"""Two points told apart by the default reconstruction: the resolution that a calibration's pictures reach.

The tests of :mod:`recon.analysis.point_tests` solve for points alone, in a window, without a prior. Here
pairs of points of equal light stand in a picture, each pair at another distance and other places between
pixels, far from the others, with the noise that one pair alone would have; the whole is reconstructed as
pictures are by default. A pair is told apart where the picture dips by 20 % between its points. What was told
apart gives the share at each distance, over all places between pixels (:mod:`recon.analysis.told_apart`), and
that the stated distance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from recon.analysis.correlation import lit_extent
from recon.analysis.middle import Middle
from recon.analysis.point_noise import Noise
from recon.analysis.points import DIP, smallest_dip
from recon.analysis.stated_distance import NEARER, Reached, TriedPair
from recon.analysis.told_apart import Told, stated_apart
from recon.arrays import Array, Float64Array
from recon.base import fft
from recon.camera.depth_mixture import central_psfs
from recon.camera.refocus_field import at_depth
from recon.reconstruction.reconstruct import reconstruct
from recon.types import Calibration

PICTURES, PAIRS = 5, 24
"""Pictures that are reconstructed, and pairs in each, half of them along each axis.

Where there is no room for so many, up to :data:`MOST_PICTURES`. Nearer together they cost resolution,
of which a pair alone knows nothing: with 22 in cells of 20 pixels the stated distance is 3 % more.
"""
MOST_PICTURES = 30
_RANGE = 3.0  # of the first distances, largest over smallest
_BELOW = 1.12  # the stated distance over the middle of an axis' later ones: there the share rises
_ON = np.array((0.754878, 0.569840))  # of a pixel, to the next pair: places between pixels come evenly
_MORE = 1.6  # times as many pairs, before the next ones' distances are chosen anew
_ABOUT = 1.2  # of these, to both sides
_CELL_PX = 30  # for a pair, at least; more where its points lie farther apart
_FIELD = 0.25  # of the sensor to both sides of its middle, where pairs stand
_CERTAIN = 0.22  # of it, whatever of the pattern falls beyond its edges: 25 cells of the middle
_BESIDE = 2  # rows to both sides of a pair's line that the picture is summed over
_WIDER = 1.5  # times the stated distance: pairs that tell the depth of field
_DEPTHS = 8  # tried to each side of the focus, to _FARTHEST times the optics' step
_FARTHEST = 3.0


@dataclass(frozen=True, slots=True)
class _Pair:
    px: float
    axis: int
    first: Float64Array
    """``(row, column)`` of the first point, pixels from the middle ``n // 2``; the second one is ``px``
    farther along the axis."""

    @property
    def place(self) -> float:
        """Of the first point between two pixels, along the axis."""
        return float(self.first[self.axis] % 1)

    @property
    def points(self) -> Float64Array:
        """(2, 2): both places."""
        along: Float64Array = self.px * np.eye(2)[self.axis]
        return np.stack([self.first, self.first + along])

    def told_apart(self, picture: Array) -> bool:
        """Whether a picture (height, width) dips between the points."""
        seen, place = (picture, self.first) if self.axis == 1 else (picture.T, self.first[::-1])
        row, column = place + np.array(seen.shape) // 2
        line = seen[round(row) - _BESIDE : round(row) + _BESIDE + 1].sum(axis=0, dtype=np.float64)[None]
        return smallest_dip(line, np.array([[[0.0, column], [0.0, column + self.px]]])) >= DIP


class _Tests:
    """Pictures of pairs, as the calibration's camera would take them."""

    def __init__(self, middle: Middle, z_um: float, noise: Noise, seed: int) -> None:
        self.z_um, self.rng = z_um, np.random.default_rng(seed)
        # As people have pictures of this depth made, who name it: between calibrated ones of what is between.
        self.calibration, _ = at_depth(_on_axis(middle.calibration), z_um)
        self.psf = cache(middle.psf_at)
        self.noise = middle.noise(noise)
        self.method = ""
        # The default looks for stray light where no part of the sensor is dark, as the middle may be.
        self.background = False if middle.part < 1 else None

    def pairs(self, distances: Sequence[float], before: int = 0) -> list[_Pair]:
        """Return pairs in cells of their own, after others along each axis in turn; fewer without room."""
        places = self.rng.permutation(cells(self.psf(self.z_um), max(distances)))
        between = np.empty((len(distances), 2))
        for axis in (0, 1):
            mine = np.flatnonzero((before + np.arange(len(distances))) % 2 == axis)
            mine = mine[np.argsort(np.asarray(distances)[mine])]
            between[mine] = (self.rng.uniform(0, 1, 2) + _ON * np.arange(len(mine))[:, None]) % 1 - 0.5
        return [
            _Pair(px, (before + n) % 2, cell + between[n])
            for n, (px, cell) in enumerate(zip(distances, places, strict=False))
        ]

    def told_apart(self, pairs: Sequence[_Pair], light: Float64Array) -> list[bool]:
        """Photograph and reconstruct pairs that make this light, with the noise of one of them."""
        scale = self.noise.electrons * len(pairs) / float(light.sum()) * self._peak(pairs[0])
        mean = scale * np.maximum(light, 0.0) / len(pairs)
        charge = scale * light + self.rng.poisson(mean) - mean
        charge = charge + self.rng.normal(0.0, self.noise.read_e, light.shape)
        # What is chosen for the first picture holds for the others: a third of the time.
        made = reconstruct(
            charge / scale,
            self.calibration,
            z_um=self.z_um,
            estimate_background=self.background,
            judged=False,
        )
        self.method, self.background = f"{made.solver}, {made.prior}", made.background is not None
        return [pair.told_apart(made.image) for pair in pairs]

    def _peak(self, pair: _Pair) -> float:
        """Return the light of a pair's photograph over its brightest pixel."""
        alone = shifted(self.psf(self.z_um), pair.points - pair.first)
        return float(alone.sum() / alone.max())


def reached(
    calibration: Calibration,
    z_um: float,
    start_px: float,
    step_per_um: float,
    noise: Noise | None = None,
    *,
    seed: int = 0,
    on_progress: Callable[[float], object] | None = None,
) -> Reached:
    """Find the smallest distance at which the default reconstruction tells two points apart.

    Parameters
    ----------
    calibration : Calibration
    z_um : float
        Depth of points and picture; PSFs are refocused to it.
    start_px, step_per_um : float
        What the optics allow across and along, where the search begins.
    noise : Noise, optional
        Of one pair alone.
    on_progress : callable, optional
        Called with the share done.
    """
    middle = Middle.of(calibration, z_um, step_per_um)
    tests = _Tests(middle, z_um, noise or Noise(), seed)
    psf = tests.psf(z_um)
    low = max(start_px, 1.2)
    about, wide = np.full(2, low * np.sqrt(_RANGE)), np.sqrt(_RANGE)
    tried: list[TriedPair] = []
    fitted, last = 0, False
    for number in range(MOST_PICTURES):
        if last:
            break
        if on_progress is not None:
            on_progress(max(len(tried) / PAIRS / (PICTURES + 1), number / (MOST_PICTURES + 1)))
        share = (tests.rng.permutation(PAIRS // 2).repeat(2) + tests.rng.uniform(0, 1)) / (PAIRS / 2)
        axes = (len(tried) + np.arange(PAIRS)) % 2
        pairs = tests.pairs([float(v) for v in about[axes] * wide ** (2 * share - 1)], len(tried))
        light = shifted(psf, np.concatenate([pair.points for pair in pairs]))
        told = tests.told_apart(pairs, light)
        tried += [TriedPair(p.px, p.axis, t, p.place) for p, t in zip(pairs, told, strict=True)]
        last = len(tried) > (PICTURES - 1) * PAIRS or number == MOST_PICTURES - 1
        if not last and len(tried) < _MORE * fitted:
            continue
        fitted, laws = len(tried), stated_apart(tried)
        stated = [_within(law, tried) for law in laws]
        if found := [px for px in stated if px is not None]:
            about = np.array([px or float(np.mean(found)) for px in stated]) / _BELOW
            wide = _ABOUT
        elif not any(told):
            about = about * _RANGE / 2
    known = [px for px in stated if px is not None]
    focus = _focus_um(tests, _WIDER * max(known), step_per_um, middle.spread) if len(known) == 2 else None
    y, x = (
        None if px is None or law is None else (law.share(px), law.share(NEARER * px))
        for px, law in zip(stated, laws, strict=True)
    )
    return Reached((stated[0], stated[1]), focus, tuple(tried), tests.method, middle.part, (y, x))


def _on_axis(calibration: Calibration) -> Calibration:
    """Return the PSFs on the axis alone, which make the pairs' light: a varying camera takes minutes."""
    depths, psfs = central_psfs(calibration)
    if len(depths) == len(calibration.psfs):
        return calibration
    places = np.array([(0.0, 0.0, z) for z in depths])
    return replace(calibration, psfs=psfs, source_positions_um=places, background=None, quality={})


def _within(law: Told | None, tried: Sequence[TriedPair]) -> float | None:
    """Return the stated distance, of what was tried: none beyond it, at least the smallest."""
    distances = [one.px for one in tried]
    if law is None or law.stated_px > max(distances):
        return None
    return max(law.stated_px, min(distances))


def _focus_um(
    tests: _Tests, px: float, step_per_um: float, spread: float = 1.0
) -> tuple[float, float] | None:
    """Return the nearest and farthest depth from whose points pairs are told apart in the picture.

    Where a part of the sensor stands for the whole, depths are ``spread`` times as far off; what they would
    be beyond infinity is not told apart. None where there is no room for two pairs.
    """
    focus = 1 / tests.z_um
    steps = step_per_um * _FARTHEST * np.arange(1, _DEPTHS + 1) / _DEPTHS
    sides = [
        [focus + sign * float(step) for step in steps if sign > 0 or spread * step < focus]
        for sign in (1, -1)
    ]
    told: list[list[bool]] = [[], []]
    while True:
        asked = [
            (side, sides[side][n])
            for n, side in product(range(_DEPTHS), (0, 1))
            if all(told[side]) and len(told[side]) <= n < len(sides[side])
        ]
        if not asked:
            break
        pairs = tests.pairs([px] * 2 * len(asked))
        asked = asked[: len(pairs) // 2]
        if not asked:
            return None
        light = np.zeros(tests.calibration.psfs.shape[-2:])
        for n, (_, place) in enumerate(asked):
            here = np.concatenate([pair.points for pair in pairs[2 * n : 2 * n + 2]])
            light += shifted(tests.psf(float(1 / (focus + spread * (place - focus)))), here)
        each = tests.told_apart(pairs[: 2 * len(asked)], light)
        for n, (side, _) in enumerate(asked):
            told[side].append(each[2 * n] and each[2 * n + 1])
    counts = [[*one, False].index(False) for one in told]
    near, far = (
        sides[side][count - 1] if count else (focus if sides[side] else 0.0)
        for side, count in enumerate(counts)
    )
    if counts[1] == len(sides[1]) == int((steps < focus).sum()) < _DEPTHS:
        far = 0.0
    return 1 / near, (1 / far if far > 0 else float("inf"))


def cells(psf: Array, px: float, least_px: float = _CELL_PX) -> Float64Array:
    """Return the middles of the cells that pairs stand in, (n, 2): where all of the pattern is seen.

    At least within :data:`_CERTAIN` of the sensor, where its pattern leaves no rim.
    """
    cell = max(least_px, 5 * px)
    sides = []
    for size, (first, last) in zip(psf.shape, lit_extent(psf), strict=True):
        half = max(min(first, size - 1 - last, _FIELD * size), _CERTAIN * size)
        steps = int(half // cell)
        sides.append(cell * np.arange(-steps, steps + 1))
    return np.array(list(product(*sides)))


def shifted(psf: Array, points: Float64Array) -> Float64Array:
    """Return the sum of a PSF (height, width) shifted to points (n, 2) between pixels, by linear phases."""
    room = 2 * int(np.ceil(np.abs(points).max()) + 2)
    shape = fft.fast_shape([n + room for n in psf.shape])
    padded = np.zeros(shape)
    padded[: psf.shape[0], : psf.shape[1]] = psf
    down, right = np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1])
    rows = np.exp(-2j * np.pi * down[:, None] * points[:, 0])
    columns = np.exp(-2j * np.pi * points[:, 1, None] * right)
    moved = fft.irfft(np.ascontiguousarray(fft.rfft(padded) * (rows @ columns)), shape[1])
    return np.asarray(moved[: psf.shape[0], : psf.shape[1]])
