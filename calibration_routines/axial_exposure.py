"""Find the exposures of a sweep before it starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration_routines.auto_exposure import AutoExposure, ExposureOutcome, auto_expose, hot_pixels
from calibration_routines.errors import CalibrationError
from calibration_routines.sweep_plan import Sweep, axis_point, depths_um
from instrument.bench import Bench

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


def expose_sweep(bench: Bench, sweep: Sweep) -> SweepExposures:
    """Find the exposure of every point: asked on the axis at up to three depths, interpolated between them.

    Light through the aperture falls off as a power of distance, so exposure against z is nearly a straight
    line in logarithms. Off the axis less light arrives, and nothing saturates. Ends with the light off.

    Raises
    ------
    CalibrationError
        When a PSF saturates at the shortest exposure, stays too dark at the longest, or flickers.
    """
    depths = depths_um(sweep)
    asked = sorted({depths[0], depths[len(depths) // 2], depths[-1]})
    found: list[tuple[float, AutoExposure]] = []
    try:
        bench.scene_off()
        for z_um in asked:
            if not sweep.by_hand:
                bench.place_source(*axis_point(sweep, z_um))
            found.append((z_um, expose_source(bench, target=sweep.target)))
    finally:
        bench.source_off()
    exposures = np.exp(
        np.interp(
            np.log([z_um for _, _, z_um in sweep.points_um]),
            np.log(asked),
            np.log([result.exposure_ms for _, result in found]),
        )
    )
    return SweepExposures(tuple(float(e) for e in exposures), tuple(found))


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
    if too_dark or result.outcome in (ExposureOutcome.TOO_BRIGHT, ExposureOutcome.UNSTEADY):
        raise CalibrationError(result.message)
    return result
