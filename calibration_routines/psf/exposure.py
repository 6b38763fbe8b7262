"""Auto-exposure for a point spread function: bright, and never saturated.

A PSF is the reference that every later photograph is explained with, so a saturated pixel in it is an error
that no reconstruction can undo. Two rules decide, and the stricter one wins:

* the :data:`PERCENTILE` of the frame, above the black level, is brought to ``target`` of full scale;
* the brightest pixel stays at or below :data:`CEILING` of full scale. Its margin to full scale covers the
  photon noise of the frames that follow. Known hot pixels (see :func:`hot_pixels`) are excepted: they
  saturate without any light and are erased from the reconstruction instead.

An exposure is returned as reached only after a frame taken with exactly that exposure kept both rules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from calibration_routines.purpose import CalibrationError
from drivers.camera import Camera
from drivers.frame import Frame
from drivers.led_array import LedPattern
from instrument.bench.bench import Bench
from recon.arrays import BoolArray

Counts = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
TARGET = 0.7
"""Fraction of full scale above black that :data:`PERCENTILE` is brought to."""
TOLERANCE = 0.1
"""Relative deviation from it that is accepted."""
PERCENTILE = 99.9
"""Of a frame's pixels."""
CEILING = 0.9
"""Largest fraction of full scale for the brightest pixel."""
MOST_FRAMES = 20
"""After which an unsteady source is given up."""
_DARK = 0.01  # of full scale: below this nothing lights the scene
_ALONE = 0.1  # of the brightest pixel's light: its neighbours have more where light made it bright
_DIMMEST_USABLE = 0.05  # of full scale: below this a PSF drowns in read noise


class TooDarkError(CalibrationError):
    """Hardly any light reaches the camera, even at its longest exposure."""


class ExposureOutcome(Enum):
    """How an auto-exposure ended."""

    REACHED = "reached"
    """The percentile is at its target and nothing saturates."""
    HELD_BY_BRIGHTEST_PIXEL = "held by the brightest pixel"
    """Nothing saturates, but the percentile stays below its target: a longer exposure would saturate."""
    TOO_DARK = "too dark"
    """The longest exposure that the camera allows leaves the percentile below its target."""
    NO_LIGHT = "found no light"
    """Nothing but a pixel that stands alone, a hot one, is bright: the exposure is as it was before."""
    TOO_BRIGHT = "too bright"
    """The shortest exposure that the camera allows still brings a pixel above the ceiling."""
    UNSTEADY = "unsteady"
    """The brightness changes between frames faster than the exposure can follow."""


@dataclass(frozen=True, slots=True)
class ExposureTrial:
    """One frame of an auto-exposure."""

    exposure_ms: float
    level: float
    """The percentile above black, as a fraction of full scale above black."""
    brightest: float
    """The brightest pixel that is not known as hot, likewise."""
    saturated_pixels: int
    """Pixels at full scale that are not known as hot."""


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """The result: the exposure now set, how it was found, and whether it is good."""

    exposure_ms: float
    outcome: ExposureOutcome
    trace: tuple[ExposureTrial, ...]
    target: float
    hot_pixels: int
    """Pixels excepted from both rules because a dark frame showed them as hot."""

    @property
    def usable(self) -> bool:
        """Whether no pixel saturates at ``exposure_ms`` and there is light in the frame to work with."""
        return self.outcome in (ExposureOutcome.REACHED, ExposureOutcome.HELD_BY_BRIGHTEST_PIXEL)

    @property
    def _flicker(self) -> float:
        """Standard deviation of light a millisecond over the frames that did not saturate, relative."""
        light = [trial.level / trial.exposure_ms for trial in self.trace if not trial.saturated_pixels]
        return float(np.std(light) / np.mean(light)) if light else float("nan")

    @property
    def message(self) -> str:
        """What happened and what to do about it, one or two sentences."""
        last = self.trace[-1]
        frames = "1 frame" if len(self.trace) == 1 else f"{len(self.trace)} frames"
        found = (
            f"{last.exposure_ms:.4g} ms after {frames}: "
            f"{PERCENTILE:g}th percentile at {last.level:.0%} of full scale (target {self.target:.0%}), "
            f"brightest pixel at {last.brightest:.0%}"
        )
        advice = {
            ExposureOutcome.REACHED: "",
            ExposureOutcome.HELD_BY_BRIGHTEST_PIXEL: (
                f" The brightest pixel's ceiling of {CEILING:.0%} sets the exposure."
            ),
            ExposureOutcome.TOO_DARK: (
                " This is the camera's longest exposure: raise the source's brightness or the gain, "
                "or bring the source nearer."
            ),
            ExposureOutcome.NO_LIGHT: (
                " That pixel stands alone: it is hot, and nothing else is bright. Light the scene or the "
                "point source; the exposure is as it was before."
            ),
            ExposureOutcome.TOO_BRIGHT: (
                f" This is the camera's shortest exposure, and {last.saturated_pixels} pixels saturate: "
                "dim the source or lower the gain."
            ),
            ExposureOutcome.UNSTEADY: (
                f" No exposure held from one frame to the next: the light flickers by {self._flicker:.0%}. "
                "Check the source's driver (pulsed supply, loose contact), stray light, and whether the "
                "camera's exposure steps are fine enough."
            ),
        }[self.outcome]
        return f"Auto-exposure {self.outcome.value}: {found}.{advice}"


def hot_pixels(dark: Counts, full_scale: int) -> BoolArray:
    """Find the pixels that are bright without light.

    A pixel is hot when it stands above the dark frame's median by more than 8 standard deviations of its
    noise (estimated robustly from the median absolute deviation) and by more than 1 % of full scale, the
    largest count the camera can report. ``dark``, (height, width) or (height, width, 3), was taken with about
    the exposure that will be used, as dark current grows with it. Returns a mask of its shape.
    """
    median = float(np.median(dark))
    sigma = 1.4826 * float(np.median(np.abs(dark.astype(np.float32) - median)))
    return dark > median + max(8.0 * sigma, 0.01 * full_scale)


def auto_expose(
    camera: Camera,
    *,
    target: float = TARGET,
    hot: BoolArray | None = None,
) -> AutoExposure:
    """Set the camera's exposure for a PSF: bright, as ``target`` says, and nothing saturated.

    The response of a sensor is linear, so one unsaturated frame with signal predicts the exposure and a
    second one confirms it. A saturated frame says only "shorter": the exposure is halved, then quartered,
    and so on, until nothing saturates. The camera is left at the exposure returned: the one it had where only
    a hot pixel that is not known is bright.

    Parameters
    ----------
    camera : Camera
        Open, with the source on; the exposure it has is begun with.
    target : float
        Wanted fraction of full scale above black, for :data:`PERCENTILE` of the frame's pixels.
    hot : ndarray of bool, optional
        Known hot pixels, in the shape of a frame; excepted from all rules.

    Returns
    -------
    AutoExposure
        ``usable`` says whether a PSF can be taken; ``message`` says why not, and what to do.

    Raises ValueError when the target makes no sense or ``hot`` does not fit the frames.
    """
    if not 0.0 < target <= CEILING:
        raise ValueError(f"The target is above 0 and at most {CEILING:g} of full scale, not {target:g}.")
    shortest, longest = camera.exposure_limits_ms
    exposure = before = camera.set_exposure_ms(float(np.clip(camera.exposure_ms, shortest, longest)))
    known_dark, known_saturated = 0.0, float("inf")  # bracket: longest without, shortest with saturation
    saturated_in_a_row = 0
    trace: list[ExposureTrial] = []

    def result(outcome: ExposureOutcome) -> AutoExposure:
        n_hot = 0 if hot is None else int(np.count_nonzero(hot))
        return AutoExposure(exposure, outcome, tuple(trace), target, n_hot)

    while True:
        frame = camera.snap()
        trial = measure_exposure(frame, exposure, hot)
        trace.append(trial)
        if trial.saturated_pixels or trial.brightest > CEILING:
            if exposure <= shortest * (1 + 1e-6):
                return result(ExposureOutcome.TOO_BRIGHT)
        elif abs(trial.level - target) <= TOLERANCE * target:
            return result(ExposureOutcome.REACHED)
        elif trial.level < target and trial.brightest >= CEILING * (1 - TOLERANCE):
            if hot is None and trial.level < _DARK and _stands_alone(frame):
                exposure = camera.set_exposure_ms(before)
                return result(ExposureOutcome.NO_LIGHT)
            return result(ExposureOutcome.HELD_BY_BRIGHTEST_PIXEL)
        elif trial.level < target and exposure >= longest * (1 - 1e-6):
            return result(ExposureOutcome.TOO_DARK)
        if len(trace) >= MOST_FRAMES:
            return result(ExposureOutcome.UNSTEADY)

        if trial.saturated_pixels:
            saturated_in_a_row += 1
            known_saturated = min(known_saturated, exposure)
            wanted = exposure * 0.5**saturated_in_a_row
            if known_dark < exposure:
                wanted = max(wanted, float(np.sqrt(known_dark * exposure)))
        else:
            saturated_in_a_row = 0
            known_dark = max(known_dark, exposure)
            wanted = exposure * _linear_step(trial, target)
            if wanted >= known_saturated:
                wanted = 0.5 * (exposure + known_saturated)
        exposure = camera.set_exposure_ms(float(np.clip(wanted, shortest, longest)))


def measure_exposure(frame: Frame, exposure_ms: float, hot: BoolArray | None = None) -> ExposureTrial:
    """Judge a frame: its :data:`PERCENTILE`, brightest pixel and saturated pixels, hot ones excepted.

    Raises ValueError when ``hot`` does not have the frame's shape.
    """
    counts = frame.image
    if hot is not None:
        if hot.shape != counts.shape:
            raise ValueError(f"The hot-pixel mask is {hot.shape}, but the frame is {counts.shape}.")
        counts = counts[~hot]
    histogram = np.bincount(counts.ravel(), minlength=frame.full_scale + 1)
    cumulative = np.cumsum(histogram)
    level = int(np.searchsorted(cumulative, PERCENTILE / 100.0 * cumulative[-1]))
    brightest = int(np.flatnonzero(histogram)[-1])
    black = frame.metadata.black_level
    span = frame.full_scale - black
    return ExposureTrial(
        exposure_ms=exposure_ms,
        level=(level - black) / span,
        brightest=(brightest - black) / span,
        saturated_pixels=int(histogram[frame.full_scale :].sum()),
    )


def _stands_alone(frame: Frame) -> bool:
    """Whether the brightest pixel's neighbours, two to each side, are dark: light falls on several."""
    grey = frame.image if frame.image.ndim == 2 else frame.image.max(axis=2)
    row, column = np.unravel_index(int(grey.argmax()), grey.shape)
    around = grey[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
    black = frame.metadata.black_level
    second = float(np.sort(around, axis=None)[-2])
    return second - black < _ALONE * (float(grey[row, column]) - black)


def _linear_step(trial: ExposureTrial, target: float) -> float:
    """Return the factor on the exposure that a linear sensor needs to keep both rules."""
    if trial.brightest < 0.05:  # so near to black that offsets and read noise decide: go up, but not blindly
        return min(8.0, 0.5 * CEILING / max(trial.brightest, 1e-3))
    # aim at the middle of the accepted range below the ceiling, so that noise does not undo the step
    highest = CEILING * (1 - 0.5 * TOLERANCE) / trial.brightest
    return highest if trial.level < 0.01 else min(target / trial.level, highest)


# Lights on the bench -----------------------------------------------------------------------------------
def expose_light(
    bench: Bench,
    light_on: Callable[[], object],
    *,
    target: float = TARGET,
    dimmest: float = 0.0,
    looks: int = 3,
) -> AutoExposure:
    """Auto-expose a light on the bench, all else dark, and leave it lit; a dark frame shows hot pixels.

    ``light_on`` lights it, ``target`` is as in :func:`auto_expose`, ``dimmest`` the level, as a fraction of
    full scale, that the longest exposure must reach. There are up to ``looks`` dark frames: another one where
    the exposure became much longer than that of the last.

    Raises TooDarkError when the longest exposure does not reach ``dimmest``; CalibrationError when the light
    saturates at the shortest exposure, or flickers; the text says what to do.
    """
    camera = bench.camera
    for _ in range(looks):
        dark_exposure_ms = camera.exposure_ms
        bench.scene_off()
        bench.source_off()
        dark = camera.snap()
        light_on()
        found = auto_expose(camera, target=target, hot=hot_pixels(dark.image, dark.full_scale))
        if found.outcome is ExposureOutcome.REACHED or found.exposure_ms <= 2 * dark_exposure_ms:
            break
    if found.outcome is ExposureOutcome.TOO_DARK and found.trace[-1].level < dimmest:
        raise TooDarkError(found.message)
    if found.outcome in (ExposureOutcome.TOO_BRIGHT, ExposureOutcome.UNSTEADY):
        raise CalibrationError(found.message)
    return found


def expose_patterns(bench: Bench, patterns: Sequence[LedPattern]) -> float:
    """Find one exposure in ms for all patterns, so that the brightest is exposed as a PSF is; ends dark.

    All LEDs together are exposed, then each pattern is photographed once at that: it is dimmer, however dim,
    and the sensor linear.

    Raises CalibrationError without an LED array; else errors as :func:`expose_light`.
    """
    leds, camera = bench.led_array, bench.camera
    if leds is None:
        raise CalibrationError("Patterned light needs an LED array, and this bench has none.")
    levels: dict[int, tuple[int, int, int]] = {}
    for index, rgb in (level for pattern in patterns for level in pattern.levels):
        red, green, blue = (max(pair) for pair in zip(rgb, levels.get(index, (0, 0, 0)), strict=True))
        levels[index] = red, green, blue
    together = LedPattern("all patterns", tuple(levels.items()))
    try:
        found = expose_light(bench, lambda: leds.set_pattern(together), dimmest=_DARK, looks=1)
        leds.off()
        dark = camera.snap()
        hot = hot_pixels(dark.image, dark.full_scale)
        factors = []
        for pattern in patterns:
            leds.set_pattern(pattern)
            trial = measure_exposure(camera.snap(), found.exposure_ms, hot)
            factors.append(_linear_step(trial, TARGET))
    finally:
        leds.off()
    shortest, longest = camera.exposure_limits_ms
    return float(np.clip(found.exposure_ms * min(factors), shortest, longest))


def expose_source(bench: Bench, *, target: float = TARGET) -> AutoExposure:
    """Auto-expose the point source where it stands, and leave it lit; errors as :func:`expose_light`."""
    return expose_light(bench, bench.source_on, target=target, dimmest=_DIMMEST_USABLE)


def expose_scene(bench: Bench, *, target: float = TARGET) -> AutoExposure:
    """Auto-expose the lit scene as a PSF is, and darken it; errors as :func:`expose_light`.

    A scene too dark for ``target`` gets the longest exposure.
    """
    try:
        return expose_light(bench, bench.scene_on, target=target, looks=1)
    finally:
        bench.scene_off()
