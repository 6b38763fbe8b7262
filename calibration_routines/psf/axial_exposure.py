"""Find the exposures of a sweep before it starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration_routines.errors import CalibrationError, TooDarkError
from calibration_routines.psf.auto_exposure import AutoExposure, ExposureOutcome, auto_expose, hot_pixels
from calibration_routines.psf.sweep_plan import Position, Sweep, axis_point, depths_um
from instrument.bench.bench import Bench
from instrument.runs.run_control import RunControl

_MOST_BOOST = 10.0  # exposure off the axis over that on it: beyond, a wrong guess would cost too much time
_CAUTION = 0.7  # of the logarithm: farther out than was asked, a brighter spot may lie on the sensor
_BESIDE = (2 / 3, 1 / 3, 1 / 6)
"""Of the field's radius: where the exposure off the axis is asked; farther in while the pattern misses the
sensor."""
_DIMMEST_USABLE = 0.05  # of full scale: below this a PSF drowns in read noise


@dataclass(frozen=True, slots=True)
class SweepExposures:
    """The exposure of every point of a sweep and how it was found."""

    exposures_ms: tuple[float, ...]
    found: tuple[tuple[float, AutoExposure], ...]
    """``(z_um, auto-exposure)`` where the camera was asked; planes between are interpolated."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Where the light did not suffice for the target, in words."""
        return tuple(
            f"z = {z_um / 1e3:g} mm: {exposure.message}"
            for z_um, exposure in self.found
            if not exposure.usable
        )


def expose_sweep(bench: Bench, sweep: Sweep, *, control: RunControl | None = None) -> SweepExposures:
    """Find the exposure of every point: asked at up to three depths, interpolated between them.

    Light through the aperture falls off as a power of distance, so exposure against z is nearly a straight
    line in logarithms. Where a depth has points off the axis, one of them about two thirds out is asked as
    well: the logarithm of a Gaussian response goes with the square of the tangent. Ends with the light off.

    Raises
    ------
    CalibrationError
        When a PSF saturates at the shortest exposure, stays too dark at the longest, or flickers.
    EndedEarlyError
        When it was ended through ``control``.
    """
    depths = depths_um(sweep)
    asked = sorted({depths[0], depths[len(depths) // 2], depths[-1]})
    found: list[tuple[float, AutoExposure]] = []
    slopes: list[float] = []
    try:
        bench.scene_off()
        for z_um in asked:
            if control is not None:
                control.check()
            axis = axis_point(sweep, z_um)
            if not sweep.by_hand:
                bench.place_source(*axis)
            found.append((z_um, expose_source(bench, target=sweep.target)))
            slopes.append(_slope(bench, sweep, axis, found[-1][1].exposure_ms, control))
    finally:
        bench.source_off()
    longest = bench.camera.exposure_limits_ms[1]
    exposures = []
    for point in sweep.points_um:
        axis = axis_point(sweep, point[2])
        on_axis = np.interp(np.log(point[2]), np.log(asked), np.log([one.exposure_ms for _, one in found]))
        slope = float(np.interp(np.log(point[2]), np.log(asked), slopes))
        boost = min(_CAUTION * slope * _tangent_squared(point, axis), np.log(_MOST_BOOST))
        exposures.append(min(float(np.exp(on_axis + boost)), longest))
    return SweepExposures(tuple(exposures), tuple(found))


def _slope(
    bench: Bench, sweep: Sweep, axis: Position, on_axis_ms: float, control: RunControl | None
) -> float:
    """Return how the logarithm of the exposure grows with the squared tangent; 0 where no place tells."""
    for beside in _beside(sweep, axis):
        if control is not None:
            control.check()
        bench.place_source(*beside)
        try:
            dimmer = expose_source(bench, target=sweep.target)
        except TooDarkError:
            continue  # lit on the axis, so the source works: from here its light misses the sensor
        more = np.log(dimmer.exposure_ms / on_axis_ms)
        return max(0.0, float(more)) / _tangent_squared(beside, axis)
    return 0.0


def _beside(sweep: Sweep, axis: Position) -> list[Position]:
    """Return points of the axis point's depth, about two thirds out first; none where it is alone."""
    others = [p for p in sweep.points_um if p[2] == axis[2] and p != axis]
    farthest = max((_tangent_squared(p, axis) for p in others), default=0.0)

    def nearest(part: float) -> Position:
        return min(others, key=lambda p: abs(_tangent_squared(p, axis) - part**2 * farthest))

    return list(dict.fromkeys(nearest(part) for part in _BESIDE)) if others else []


def _tangent_squared(point: Position, axis: Position) -> float:
    return ((point[0] - axis[0]) ** 2 + (point[1] - axis[1]) ** 2) / point[2] ** 2


def expose_source(bench: Bench, *, target: float = 0.7) -> AutoExposure:
    """Auto-expose the point source where it stands; hot pixels are known from a dark frame. Leaves it lit.

    Raises
    ------
    CalibrationError
        When no usable exposure exists; the text says why and what to do.
    """
    camera = bench.camera
    for _ in range(3):
        dark_exposure_ms = camera.exposure_ms
        bench.source_off()
        dark = camera.snap()
        bench.source_on()
        result = auto_expose(camera, target=target, hot=hot_pixels(dark.image, dark.full_scale))
        if result.outcome is ExposureOutcome.REACHED or result.exposure_ms <= 2 * dark_exposure_ms:
            break  # else pixels may be hot that were not at the dark frame's shorter exposure: look again
    too_dark = result.outcome is ExposureOutcome.TOO_DARK and result.trace[-1].level < _DIMMEST_USABLE
    if too_dark:
        raise TooDarkError(result.message)
    if result.outcome in (ExposureOutcome.TOO_BRIGHT, ExposureOutcome.UNSTEADY):
        raise CalibrationError(result.message)
    return result
