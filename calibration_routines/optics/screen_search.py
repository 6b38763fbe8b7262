"""Find where the camera sees a screen: bars tell which part of it, bright squares each place."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import cv2
import numpy as np

from calibration_routines.display.display_io import require_slm
from calibration_routines.optics.screen_pictures import LEAST_MARKS, Levels, ScreenMap, bars, field_along
from calibration_routines.procedure import Listener
from calibration_routines.psf.exposure import ExposureOutcome, TooDarkError, auto_expose, hot_pixels
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import compare
from instrument.bench.bench import Bench
from instrument.files.errors import duration
from instrument.reconstruction.mosaic import in_colours
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.camera.registration import register

FINDING = "finding the screen"
_BARS = (9, 16)  # rows, columns
_MARKS = 5  # along each side of the part that is seen
_MARKS_WITHIN = 0.8  # of it
_MARK = 1 / 20  # of its height is a mark's side
SEARCH = sum(_BARS) + 1 + _MARKS**2 + 2
"""Photographs that it takes, besides those that find an exposure: of bars and black again, of the marks, and
of that in the middle first and last."""
_MOVED_PX = 0.5  # pixels of the camera by which that mark may lie elsewhere
_SURE = 3.0  # standard deviations of its place that this must be
_DIMMEST = 0.05  # of full scale
_OTHER_LIGHT = 0.2  # of the brightest bar's light, by which black may change
_FOUND_PX = 300  # rows of the images that marks are found on


class ScreenView:
    """Shows levels and photographs them, black taken off, colours averaged; nothing is kept."""

    def __init__(self, bench: Bench, control: RunControl) -> None:
        self.slm = require_slm(bench)
        self._bench, self._control = bench, control
        self._black: Float32Array | None = None

    def expose(self, levels: Levels, target: float) -> float:
        """Find the exposure at which levels are bright and nothing saturates, and photograph black with it.

        Raises TooDarkError, CalibrationError when there is none.
        """
        camera, black = self._bench.camera, np.zeros(self.slm.shape, np.uint8)
        for _ in range(2):  # hot pixels show at about the exposure that will be used
            before_ms = camera.exposure_ms
            self.slm.display(black)
            dark = camera.snap()
            self.slm.display(levels)
            found = auto_expose(camera, target=target, hot=hot_pixels(dark.image, dark.full_scale))
            self._control.check()
            if found.outcome is ExposureOutcome.REACHED or found.exposure_ms <= 2 * before_ms:
                break
        if found.outcome is ExposureOutcome.TOO_DARK and found.trace[-1].level < _DIMMEST:
            raise TooDarkError(
                f"{found.message} The screen hardly lights the camera: make it brighter, bring it nearer, or "
                "turn it to the camera."
            )
        if found.outcome in (ExposureOutcome.TOO_BRIGHT, ExposureOutcome.UNSTEADY):
            raise CalibrationError(found.message)
        self._black = None
        self._black = self.light(black)
        return found.exposure_ms

    def light(self, levels: Levels) -> Float32Array:
        """Show levels and return what comes of them, (height, width), counts."""
        self._control.check()
        self.slm.display(levels)
        taken = self._bench.snap()
        image = in_colours(np.asarray(taken.image, np.float32), taken.metadata.pixel_format)
        grey = image.mean(axis=-1, dtype=np.float32) if image.ndim == 3 else image
        # A pixel that turned hot stays where it is: registered, it would hold the picture in its place.
        seen = np.asarray(cv2.medianBlur(np.ascontiguousarray(grey), 3), np.float32)
        return seen if self._black is None else seen - self._black

    def require_darkness(self, light: float) -> None:
        """Raise CalibrationError where black is no longer as dark as it was, by a picture's mean light."""
        other = float(self.light(np.zeros(self.slm.shape, np.uint8)).mean()) / max(light, 1e-9)
        if abs(other) > _OTHER_LIGHT:
            raise CalibrationError(
                f"While the screen was looked for, other light changed by {abs(other):.0%} of a bar's: "
                "keep daylight, lamps and other screens out, and let this one warm up."
            )


@contextlib.contextmanager
def search_not_kept() -> Iterator[None]:
    """Say of what breaks off a search that it begins anew, and what it took: none of its frames is kept."""
    began = time.monotonic()
    try:
        yield
    except CalibrationError:
        raise
    except BaseException as error:
        took = duration(time.monotonic() - began)
        error.add_note(
            f"Of the search for the screen nothing is kept ({took} so far): next time its {SEARCH} "
            "photographs are taken anew. Frames of the pictures after it are kept."
        )
        raise


def find_screen(bench: Bench, control: RunControl, listener: Listener) -> ScreenMap:
    """Find where the camera sees which place of the screen, by bars and bright squares.

    Raises CalibrationError when the screen is too dark, or too few squares are recognised.
    """
    screen = ScreenView(bench, control)
    height, width = shape = screen.slm.shape
    listener.step(FINDING)
    screen.expose(np.full(shape, 255, np.uint8), 0.5)
    total, done = SEARCH, 0
    seen = []
    for axis, count in enumerate(_BARS):
        light = []
        for levels in bars(shape, count, axis):
            light.append(float(screen.light(levels).mean()))
            listener.share(done := done + 1, total)
        seen.append(field_along(np.array(light), shape[axis]))
    screen.require_darkness(max(light))
    listener.share(done := done + 1, total)
    (top, bottom), (left, right) = seen
    side = max(2, round(_MARK * (bottom - top)))
    spread = np.linspace(-_MARKS_WITHIN / 2, _MARKS_WITHIN / 2, _MARKS)
    rows = (top + bottom) / 2 + spread * (bottom - top)
    columns = (left + right) / 2 + spread * (right - left)
    corners = [(round(r - side / 2), round(c - side / 2)) for r in rows for c in columns]
    corners = [(min(max(r, 0), height - side), min(max(c, 0), width - side)) for r, c in corners]

    def mark(corner: tuple[int, int]) -> Levels:
        levels = np.zeros(shape, np.uint8)
        levels[corner[0] : corner[0] + side, corner[1] : corner[1] + side] = 255
        return levels

    middle = len(corners) // 2
    screen.expose(mark(corners[middle]), 0.7)
    factor = max(1, bench.camera.frame_shape[0] // _FOUND_PX)
    first = screen.light(mark(corners[middle]))
    listener.share(done := done + 1, total)
    photographs = []
    for corner in corners:
        photographs.append(block_mean(screen.light(mark(corner)), factor))
        listener.share(done := done + 1, total)
    _require_rest(first, screen.light(mark(corners[middle])))
    listener.share(done + 1, total)
    places, shifts = [], []
    for corner, photograph in zip(corners, photographs, strict=True):
        found = register(photograph, photographs[middle])
        if found.reliable:
            places.append((corner[0] + (side - 1) / 2, corner[1] + (side - 1) / 2))
            shifts.append((factor * found.rows, factor * found.columns))
    axis_at = factor * _centroid(photographs[middle]) + (factor - 1) / 2
    found_map = ScreenMap.of_marks(np.array(places), np.array(shifts).reshape(-1, 2) + axis_at)
    if found_map is None:
        raise CalibrationError(
            f"Of {len(corners)} bright squares on the screen {len(places)} were recognised by their pattern, "
            f"and fewer than {LEAST_MARKS} agree on where the screen is: darken the room, face the screen to "
            "the camera, and check that nothing moves."
        )
    return found_map


def _require_rest(first: Float32Array, last: Float32Array) -> None:
    """Raise CalibrationError where the same mark lies elsewhere in the end: all marks are off then."""
    change = compare(last, first)
    moved_px = change.shift_px
    if not np.isfinite(moved_px):
        raise CalibrationError(
            "While the screen was looked for, one bright square was not found again where it had been: other "
            "light came, or something moved. Keep daylight, lamps and other screens out, clamp what can move."
        )
    if moved_px > max(_MOVED_PX, _SURE * change.place_noise):
        raise CalibrationError(
            f"While the screen was looked for, its picture moved by {moved_px:.1f} pixels: it creeps or "
            "shakes. Clamp screen, diffuser and camera, let them warm up, take the table off what vibrates."
        )


def _centroid(photograph: Float32Array) -> Float64Array:
    """Return the (row, column) about which a pattern lies: what is brighter than a tenth of its brightest."""
    bright = np.maximum(photograph - 0.1 * np.quantile(photograph, 0.999), 0)
    rows, columns = (np.arange(n) for n in bright.shape)
    total = max(float(bright.sum()), 1e-12)
    return np.array([(bright.sum(axis=1) * rows).sum(), (bright.sum(axis=0) * columns).sum()]) / total
