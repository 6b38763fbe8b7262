"""Photograph random patterns once each, and one of them again and again: what moved and changed meanwhile.

A display is learned from its photographs alone, so that a picture that shakes, creeps, grows or becomes
another one is learned with them, unless something that is shown again tells. The first pattern is the
reference: it is visited before the others, after every few of them, and in the end, some frames each time.
The frames of a visit tell what flickers and shakes (:mod:`calibration_routines.scatter`), the visits what
creeps, what grows, and whether mask and SLM are where they were against one another.

* Brightness does no harm: each photograph's own is free when a display is learned.
* Place: what goes on from visit to visit is put back, by a straight line between two of them. What shakes is
  not known of a single photograph, and is said.
* Size, and a pattern whose picture is another one, cannot be put back: a finding, or there is no result.
* What frames of a visit have each of its own is noise, or a mask that shakes: nothing parts the two. It is no
  other picture, and is noted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import (
    NO_CHANGE,
    TOLERATED,
    Change,
    Scatter,
    compare,
    growth,
    pooled,
    reduction,
    steadied,
)
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.camera.registration import moved
from recon.holography.camera_map import CameraMap
from recon.holography.learn import Look
from recon.holography.target import Band, make_band

Float = Float32Array
Complexes = npt.NDArray[np.complex128]

REFERENCE_EVERY = 4
"""About so many patterns between two visits to the reference."""
VISIT_FRAMES = 3
"""Frames of a visit."""
CREPT_PX = 0.1
"""Way from the first visit that is put back and said, pixels of the camera."""
STEP_PX = 2.0
"""Way between two visits beyond which a straight line is not to be relied on."""
GROWN = 5e-4
"""Change of size that is a finding: half a pixel at the border of a field of two thousand."""
OTHER = 0.3
"""Part of the reference's contrast that is another one's, beyond which nothing is learned."""
_LOST = (
    "The pattern that was shown again did not give its picture again: mask, SLM, lens or camera moved "
    "meanwhile, or the light went. Clamp what moves, align the mask, lengthen the exposure where they are "
    "noisy, and photograph again."
)
_SURE = 3.0  # standard deviations of a visit's place, as its frames shake


@dataclass(frozen=True, slots=True)
class Visit:
    """The reference's picture against that of the first visit."""

    change: Change
    growth: float = 0.0
    """Share by which it is larger."""
    other: float = 0.0
    """Part of its contrast, squared, that is not the first visit's, wherever it lies: another picture."""
    other_error: float = 0.0
    """Of ``other``: standard deviation by noise."""
    noise: float = 0.0
    """Part of a frame's contrast, squared, that the other frames of the visit do not have."""

    def is_other(self, bound: float) -> bool:
        """Whether more than such a part is another picture's, and noise does not explain it."""
        return self.other > bound + _SURE * self.other_error


@dataclass(frozen=True, slots=True)
class PatternSeries:
    """Photographs of known patterns, and what one of them tells of the bench meanwhile."""

    looks: tuple[Look, ...]
    frames: int
    """That it took."""
    visits: tuple[Visit, ...]
    scatter: Scatter
    """Of the frames of a visit."""

    @property
    def crept_px(self) -> float:
        """How far from its first place the picture was seen at most, pixels; 0 where shaking explains it."""
        far = max(visit.change.shift_px for visit in self.visits)
        return far if far > max(CREPT_PX, self._place_px) else 0.0

    @property
    def _place_px(self) -> float:
        return _SURE * float(np.sqrt(2)) * self.scatter.place_error_px

    @property
    def grown(self) -> float:
        """The largest change of size against the first visit."""
        return max((visit.growth for visit in self.visits), key=abs)

    @property
    def other(self) -> float:
        """The largest part of the reference's contrast that became another one's."""
        return max(visit.other for visit in self.visits)

    @property
    def noise(self) -> float:
        """Part of one frame's contrast, squared, that frames of the same visit do not share, on average."""
        return float(np.mean([visit.noise for visit in self.visits]))

    @property
    def findings(self) -> tuple[str, ...]:
        """What was not put back and changes what is learned, in words."""
        found = list(replace(self.scatter, frames=1, flicker=0.0, ambient=0.0).findings("photograph"))
        ways = [_place(b) - _place(a) for a, b in pairwise(self.visits)]
        step = max((float(np.hypot(*way)) for way in ways), default=0.0)
        if step > STEP_PX + self._place_px:
            found.append(
                f"the picture moved by {step:.1f} pixels between two visits to the same pattern (up to "
                f"{STEP_PX:g} is put back): clamp camera, lens and mask, let them warm up, and photograph "
                "again."
            )
        if abs(self.grown) > GROWN:
            found.append(
                f"the picture of the same pattern became {abs(self.grown):.2%} "
                f"{'larger' if self.grown > 0 else 'smaller'}: camera or lens moved along the axis. Clamp "
                "them, and photograph again."
            )
        if any(visit.is_other(TOLERATED) for visit in self.visits):
            found.append(
                f"the same pattern's picture became another one, by {self.other:.1%} of its contrast: the "
                "mask moved against the SLM, or what the SLM does changed. Clamp the mask, let the SLM warm "
                "up, align the mask, and photograph again."
            )
        return tuple(found)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was put back, or does no harm, in words."""
        told = []
        if self.crept_px:
            told.append(
                f"the picture moved meanwhile, up to {self.crept_px:.2f} pixels from its first place: "
                "photographs were put back by a pattern that was shown again and again"
            )
        changes = [visit.change for visit in self.visits]
        levels = [change.brightness for change in changes]
        drift = max(levels) - min(levels)
        drifts = drift > TOLERATED + _SURE * max(change.brightness_noise for change in changes)
        if drifts or self.scatter.flicker > TOLERATED:
            told.append(
                f"the light drifts by {drift:.1%} and flickers by {self.scatter.flicker:.1%} from frame to "
                "frame: taken out, as each photograph's brightness is free"
            )
        if self.noise > TOLERATED:
            told.append(
                f"{self.noise:.1%} of a photograph's contrast is not in the next one of the same pattern: "
                "noise, or a mask that shakes against the SLM; a longer exposure tells which"
            )
        return tuple(told)


def visited_before(count: int) -> list[int]:
    """Return before which of so many patterns, counted from 0, the reference is visited; the last: after."""
    intervals = max(1, round((count - 1) / REFERENCE_EVERY))
    return sorted({round(float(at)) for at in np.linspace(1, count, intervals + 1)})


def series_frames(count: int) -> int:
    """Return how many frames a series of so many patterns takes."""
    return count - 1 + VISIT_FRAMES * len(visited_before(count))


def photograph_series(seen: HologramCamera, count: int, *, seed: int = 0) -> PatternSeries:
    """Show random phases and photograph each once, but the first again and again.

    Raises CalibrationError where the first one's picture is not found again, or is quite another one.
    """
    io, shape = seen.io, seen.display.slm_shape
    rng = np.random.default_rng(seed)
    patterns = [np.exp(1j * rng.uniform(0, 2 * np.pi, shape)).astype(np.complex64) for _ in range(count)]
    band = make_band(shape, seen.display.factor, "alias-free")
    exposure_ms, first_frame, at = io.exposure_ms(seen.mean_per_ms), io.frames, visited_before(count)
    reference: Float | None = None
    first: Complexes | None = None
    looks: list[Look] = []
    visits: list[Visit] = []
    scatters: list[Scatter] = []
    for number in range(1, count + 1):
        if number in at:
            io.show(patterns[0])
            frames = np.array([io.photograph(exposure_ms) for _ in range(VISIT_FRAMES)], np.float32)
            steady = steadied(frames)
            scatters.append(steady.scatter)
            look = Look(patterns[0], seen.camera.lags(steady.mean, band))
            each = [Look(patterns[0], seen.camera.lags(frame, band)) for frame in steady.frames]
            change, grown = NO_CHANGE, 0.0
            if reference is None:
                reference = steady.mean
                looks.append(look)
            else:
                change = compare(steady.mean, reference)
                if not np.isfinite(change.shift_px):
                    raise CalibrationError(_LOST)
                grown = _growth(steady.mean, reference, change)
                each = list(put_back(each, [(change.rows, change.columns)] * len(each), seen.camera, band))
            lags = _counted(each, band)
            first = lags if first is None else first
            visits.append(_visit(change, grown, lags, first))
        if number < count:
            io.show(patterns[number])
            looks.append(Look(patterns[number], seen.camera.lags(io.photograph(exposure_ms), band)))
    series = PatternSeries(tuple(looks), io.frames - first_frame, tuple(visits), pooled(scatters))
    if any(visit.is_other(OTHER) for visit in series.visits):
        raise CalibrationError(_LOST)
    if series.crept_px:
        series = replace(series, looks=put_back(looks, _places(visits, at, count), seen.camera, band))
    return series


def put_back(
    looks: Sequence[Look], places_px: Sequence[Sequence[float]] | Float64Array, camera: CameraMap, band: Band
) -> tuple[Look, ...]:
    """Return photographs moved back over the field, by (rows, columns) of camera pixels each, (n, 2)."""
    inverse = np.linalg.inv(camera.gradient(0.0, 0.0))
    y, x = band.lags()
    back = []
    for look, place in zip(looks, places_px, strict=True):
        down, across = inverse @ np.asarray(place)
        back.append(replace(look, lags=look.lags * np.exp(2j * np.pi * ((y * down)[:, None] + x * across))))
    return tuple(back)


def _place(visit: Visit) -> Float64Array:
    return np.array([visit.change.rows, visit.change.columns])


def _places(visits: Sequence[Visit], at: Sequence[int], count: int) -> Float64Array:
    """Return where each photograph lies from the first, (n, 2), by when it was shown."""
    shown = [(number, n) for n, number in enumerate(at)] + [(number, count) for number in range(1, count)]
    order = [visit for _, visit in sorted(shown)]  # a visit comes before the pattern of its number
    visited = [order.index(n) for n in range(len(at))]
    photographed = [0, *(n for n, visit in enumerate(order) if visit == count)]
    ways = np.array([_place(visit) for visit in visits]).T
    return np.array([np.interp(photographed, visited, way) for way in ways]).T


def _growth(mean: Float, reference: Float, change: Change) -> float:
    factor = reduction(reference)
    seen, other = block_mean(mean, factor), block_mean(reference, factor)
    return growth(moved(seen, -change.rows / factor, -change.columns / factor), other)


def _counted(looks: Sequence[Look], band: Band) -> Complexes:
    """Return the coefficients that an eye resolves, the mean's apart, (n_looks, n)."""
    y, x = band.lags()
    radius = np.hypot(y[:, None], x)
    return np.array([look.lags[(radius > 0) & (radius <= band.cutoff)] for look in looks])


def _visit(change: Change, grown: float, lags: Complexes, first: Complexes) -> Visit:
    """Return what is known of a visit: from the coefficients of its frames and of the first's, (n_frames, n).

    A power is that which frames share: noise, which they do not, is no other picture. Brightness, too, is by
    that: a fit of one noisy image to another takes it for less.
    """
    (seen, shared), (_, reference) = _powers(lags), _powers(first)
    if not shared > 0 or not reference > 0:
        raise CalibrationError(_LOST)
    n_frames, n = lags.shape
    alike = float(np.vdot(first.mean(axis=0), lags.mean(axis=0)).real)
    other = 0.0 if lags is first else max(0.0, 1 - alike * abs(alike) / (shared * reference))
    in_mean = max(0.0, seen / shared - 1) / n_frames
    error = in_mean * float(np.sqrt((2 + 2 * n_frames / (n_frames - 1)) / n))
    level, level_error = float(np.sqrt(shared / reference)), float(np.sqrt(in_mean / n))
    change = replace(change, brightness=level, brightness_noise=level_error)
    return Visit(change, grown, other, error, max(0.0, 1 - shared / seen))


def _powers(lags: Complexes) -> tuple[float, float]:
    """Return a frame's power, and the part of it that it shares with each of the others, (n_frames, n)."""
    together, each = float(np.sum(np.abs(lags.sum(axis=0)) ** 2)), float(np.sum(np.abs(lags) ** 2))
    n = len(lags)
    return each / n, (together - each) / (n * (n - 1))
