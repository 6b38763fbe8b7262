"""Judge every PSF of a sweep while it is taken, and take it again at once where that can help.

The watch sees each photograph as the runner stores it. When a point's last frame is there, the PSF is judged
on a binned copy: saturation, signal to noise, clipped support, and its place against the neighbour's at the
same depth (or the reference), which the stage says. Each visit to the reference tells whether the source
drifts. What is found goes out as events, e.g. to a window. The sweep's last judgement, which sees all points
together, comes after the last frame (:mod:`calibration_routines.psf.sweep`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from calibration_routines.psf.analysis import (
    Counts,
    DarkModel,
    PlaneFrames,
    channels_first,
    measure_point,
    plane_light,
    replace_hot,
)
from calibration_routines.psf.psf_quality import (
    MAX_CLIPPED,
    MAX_STEP_PX,
    PsfQuality,
    judge_next,
    with_finding,
)
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.stage_fit import (
    MAX_GAIN_ERROR,
    MAX_ROTATION_MRAD,
    find_pattern,
    judge_visit,
    nominal_px_per_um,
)
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import DARK, REFERENCE
from calibration_routines.scatter import NO_CHANGE, TOLERATED, Change, Steadied, compare, reduction
from instrument.bench.photograph import Snapshot
from instrument.plan import Step
from recon.arrays import BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.types import Geometry

Float = Float32Array

_SATURATED_DIMMING = 0.7  # a PSF that saturated is taken again with this part of its exposure
_SLACK = MAX_GAIN_ERROR + 1e-3 * MAX_ROTATION_MRAD  # of a shift: what a wrong d or a turned camera may do


@dataclass(frozen=True, slots=True)
class PointTaken:
    """A PSF has been taken and judged."""

    number: int
    total: int
    """Which point of the sweep, from 1, and how many there are."""
    take: int
    """1, and more for what was taken again."""
    quality: PsfQuality
    """So far: lengths in pixels of the PSFs; the whole sweep may tell more when it is over."""
    exposure_ms: float
    retaking: bool
    """Whether it is taken again at once."""
    image: Float
    """(height, width): the PSF without its dark frame, counts, colours averaged, binned to half a
    megapixel at most."""


@dataclass(frozen=True, slots=True)
class SourceVisit:
    """The source has been at the reference point again."""

    number: int
    """From 1, the first, which the others are held against."""
    before_point: int
    """Points of the sweep that had been taken before."""
    brightness: float
    """Light received, relative to the first visit."""
    shift_px: float
    """Distance of the pattern from its place at the first visit, pixels of the camera."""
    findings: tuple[str, ...]
    """What changed since the visit before; empty when the source stayed what it was."""


SweepEvent = PointTaken | SourceVisit
OnEvent = Callable[[SweepEvent], None]
TakeAgain = Callable[[Position, float], list[Snapshot]]
"""Takes a point's frames again, given its place and exposure."""


class SweepWatch:
    """Sees a sweep's photographs one by one and judges its points; ``geometry``: of the camera's pixels.

    What is seen goes to ``on_event``, in the thread that executes; without ``take_again`` points that need it
    are only reported.
    """

    def __init__(
        self,
        sweep: PointSweep,
        geometry: Geometry,
    ) -> None:
        self._sweep, self._geometry = sweep, geometry
        self.on_event: OnEvent | None = None
        self.take_again: TakeAgain | None = None
        self._numbers = {point: number for number, point in enumerate(sweep.points_um, start=1)}
        self._central = sweep.central
        self._reference = sweep.reference_point
        self._parts: dict[int, list[Snapshot]] = {}
        self._dark_frames: dict[float, list[Counts]] = {}
        self._dark: DarkModel | None = None
        self._anchor: tuple[Position, Float] | None = None  # the newest good pattern
        self._planes: list[PsfQuality] = []  # good central PSFs, one a depth
        self._first_visit: tuple[Position, Float] | None = None
        self._first_light = np.empty((0, 0), np.float32)  # of all its pixels
        self._alone: list[tuple[Position, BoolArray]] = []  # what stood alone at the newest places
        self._late_hot: BoolArray | None = None
        self._visits: list[SourceVisit] = []
        self._change: Change = NO_CHANGE  # of the newest visit against the first
        self._points_done = 0

    def see(self, step: Step, snapshot: Snapshot) -> bool:
        """Take in a photograph (:data:`~instrument.runs.runner.FrameWatch`); True when the bench was used."""
        if step.label == DARK:
            frames = self._dark_frames.setdefault(snapshot.metadata.exposure_ms, [])
            frames.append(_counts(snapshot))
            return False
        self._parts.setdefault(step.part, []).append(snapshot)
        if len(self._parts[step.part]) < self._sweep.average:
            return False
        taken = self._parts.pop(step.part)
        if step.label == REFERENCE:
            self._visit(taken)
            return False
        point = self._sweep.points_um[0] if step.source_um is None else step.source_um
        self._points_done += 1
        return self._point(point, taken)

    # Points ----------------------------------------------------------------------------------------------
    def _point(self, point: Position, taken: list[Snapshot]) -> bool:
        """Judge a point, and take it again as often as the sweep allows; True when the bench was used."""
        take = 1
        while True:
            plane = self._plane(point, taken)
            steady = self._light(plane)
            image = _reduced(steady.mean)
            quality = self._judged(plane, steady, image)
            again = quality.retake and self.take_again is not None and take <= self._sweep.retakes
            number, total = self._numbers[point], len(self._numbers)
            self._report(PointTaken(number, total, take, quality, plane.exposure_ms, again, image))
            if not again or self.take_again is None:
                break
            taken = self.take_again(point, plane.exposure_ms * retake_dimming(quality))
            take += 1
        if not quality.retake and quality.signal > 0:
            self._anchor = point, image
            if point in self._central:
                self._planes.append(quality)
        return take > 1

    def _plane(self, point: Position, taken: list[Snapshot]) -> PlaneFrames:
        return PlaneFrames(
            source_um=point,
            exposure_ms=taken[0].metadata.exposure_ms,
            frames=_stacked([_counts(snapshot) for snapshot in taken]),
            full_scale=taken[0].full_scale,
            off_axis=point not in self._central,
        )

    def _light(self, plane: PlaneFrames) -> Steadied:
        """Return a point's light without pixels that turned hot, of which later dark frames tell.

        They stay where they are while light goes elsewhere, and would be taken for other light and for a
        pattern that is cut: what stands alone here and in the newest picture of another place is such a one.
        """
        dark = self._dark_model(plane.full_scale)
        steady = plane_light(plane, dark)
        lone = dark.lone(steady.mean)
        self._alone = [one for one in self._alone if one[0] != plane.source_um][-1:]
        for _, before in self._alone:
            both = lone & before
            self._late_hot = both if self._late_hot is None else self._late_hot | both
        self._alone.append((plane.source_um, lone))
        if self._late_hot is None or not self._late_hot.any():
            return steady
        return replace(
            steady, frames=np.stack([replace_hot(frame, self._late_hot) for frame in steady.frames])
        )

    def _judged(self, plane: PlaneFrames, steady: Steadied, image: Float) -> PsfQuality:
        """Judge a point; what saturates counts unless it did without light, however lone it is.

        Pixels that turned hot just now make a pattern look cut: without what stands alone it is not, and no
        sharp light is needed to tell that.
        """
        frame_shape = plane.frames.shape[1:3]
        factor = max(1, frame_shape[0] // image.shape[0])
        binning = max(1, self._sweep.binning)
        dark = self._dark_model(plane.full_scale)
        found = measure_point(plane, image[np.newaxis], steady, dark, binning)
        if found.clipped > MAX_CLIPPED and not plane.off_axis:
            wide = _reduced(replace_hot(steady.mean, dark.lone(steady.mean)))
            without = measure_point(plane, wide[np.newaxis], steady, dark, binning)
            found = without if len(without.findings) < len(found.findings) else found
        found = replace(
            found,
            centroid_px=(found.centroid_px[0] * factor / binning, found.centroid_px[1] * factor / binning),
            radius_px=found.radius_px * factor / binning,
        )
        if plane.source_um in self._central:
            d_mm = self._geometry.diffuser_distance_mm
            found = judge_next(self._planes, found, None if d_mm is None else 1e3 * d_mm)
        return self._against_stage(found, image, factor, binning)

    def _against_stage(self, found: PsfQuality, image: Float, factor: int, binning: int) -> PsfQuality:
        """Hold the pattern's step from the newest good one at this depth against the stage's."""
        known = [one for one in (self._anchor, self._first_visit) if one is not None]
        anchor = next((one for one in known if one[0][2] == found.z_um), None)
        nominal = nominal_px_per_um(self._geometry, found.z_um)
        if anchor is None or nominal is None or not found.signal > 0:
            return found
        step_um = np.array([found.y_um - anchor[0][1], found.x_um - anchor[0][0]])
        registered = find_pattern(image, anchor[1], step_um, nominal, factor)
        if registered is None or not registered.reliable:
            return found  # too different from its neighbour; the whole sweep will tell
        expected = -step_um * nominal
        measured = factor * np.array([registered.rows, registered.columns])
        off_px = float(np.hypot(*(measured - expected)))
        allowed = MAX_STEP_PX * binning + _SLACK * float(np.hypot(*expected))
        found = replace(found, step_px=max(found.step_px, off_px / binning))
        if off_px > allowed:
            found = with_finding(
                found,
                f"the pattern lies {off_px / binning:.1f} pixels from where the stage says, seen from the "
                f"point before it (up to {allowed / binning:.1f} expected): the stage or the source slipped. "
                "Take it again.",
                retake=True,
            )
        return found

    # The source ------------------------------------------------------------------------------------------
    def _visit(self, taken: list[Snapshot]) -> None:
        assert self._reference is not None
        plane = self._plane(self._reference, taken)
        steady = self._light(plane)
        if self._first_visit is None:
            image = _reduced(steady.mean)
            seen = self._judged(plane, steady, image)
            self._planes += [] if seen.retake else [seen]
            self._first_visit, self._first_light = (self._reference, image), steady.mean
            self._change, visit = NO_CHANGE, SourceVisit(1, self._points_done, 1.0, 0.0, ())
        else:
            before = self._visits[-1]
            first = self._first_light
            hot = self._turned(steady.mean, first, plane.full_scale)
            image, other = (_reduced(replace_hot(light, hot)) for light in (steady.mean, first))
            found = compare(image, other)
            factor = max(1, taken[0].image.shape[0] // image.shape[0])
            change = replace(found, rows=factor * found.rows, columns=factor * found.columns)
            points = before.before_point, self._points_done
            findings = judge_visit((self._change, change), points, steady.scatter)
            self._change = change
            visit = SourceVisit(
                before.number + 1, self._points_done, change.brightness, change.shift_px, findings
            )
        self._visits.append(visit)
        self._report(visit)

    def _turned(self, now: Float, first: Float, full_scale: int) -> BoolArray:
        """Return the pixels that turned hot, or are no longer, since the first visit, at the same place.

        Those that stand alone in one of two pictures of the same pattern. One that moved has left its own
        sharp spots: where what is no longer alone was more than little of the light, they are left.
        """
        known = np.zeros(now.shape, bool) if self._late_hot is None else self._late_hot
        dark = self._dark_model(full_scale)
        alone, was = dark.lone(now), dark.lone(first)
        if float(first[was & ~alone].sum()) > TOLERATED * float(first.sum()):
            return known
        return known | (alone ^ was)

    def _report(self, event: SweepEvent) -> None:
        if self.on_event is not None:
            self.on_event(event)

    def _dark_model(self, full_scale: int) -> DarkModel:
        if self._dark is None:
            stacks = [_stacked(frames) for frames in self._dark_frames.values()]
            self._dark = DarkModel(list(self._dark_frames), stacks, full_scale)
            self._dark_frames = {}
        return self._dark


def retake_dimming(quality: PsfQuality) -> float:
    """Return which part of its exposure a PSF that is taken again gets: less where it saturated."""
    return _SATURATED_DIMMING if quality.saturated_pixels else 1.0


def _reduced(light: Float) -> Float:
    """Return a point's light, (height, width), binned as for registration."""
    grey: Float = channels_first(light).mean(axis=0)
    return block_mean(grey, reduction(grey))


def _counts(snapshot: Snapshot) -> Counts:
    if snapshot.image.dtype == np.float32:
        raise TypeError("A sweep stores single frames, not means: averaging comes with the analysis.")
    return cast(Counts, snapshot.image)


def _stacked(frames: Sequence[Counts]) -> Counts:
    return cast(Counts, np.stack(frames))
