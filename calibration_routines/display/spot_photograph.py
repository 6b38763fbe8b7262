"""Photograph spots: find them on the camera, measure how bright each is, make them even by what was seen.

Without a mask there is no speckle to register the camera by, so single spots are shown at known places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench, find_camera, random_brightness
from instrument.display.hologram import CaptureOptions
from instrument.files.images import write_image
from recon.arrays import Array, BoolArray, Float64Array
from recon.errors import InputError
from recon.holography import Display, HologramOptions, SpotList, compute_spots
from recon.holography.camera_map import CameraMap, polynomial_map
from recon.holography.spot_list import SpotField, brighter_where_dim

_SIDE, _REACH = 4, 0.36
"""Single spots along each axis that the camera is registered by, and how far from the axis they lie."""
_CLEAR = 12.0
"""A spot stands out of the frame's deviation by so much."""
_FULL = 0.6
"""Part of the camera's full scale that the brightest pixel is exposed to."""


@dataclass(frozen=True, slots=True)
class PhotographedSpots:
    """What the camera saw of spots.

    Attributes
    ----------
    slm : ndarray, complex64, (n_frames, height, width)
        The pattern given, or the most even one.
    frame : ndarray, float64, (height, width)
        Counts a millisecond of it.
    relative : ndarray, float64, (n,)
        Brightness of each spot over what was asked for, mean 1.
    deviations : tuple of float
        Standard deviation over mean, round by round; the first is of the pattern given.
    camera_residual_px : float
    ended_by : BaseException or None
        What ended it before its last round (Ctrl-C, a signal): to be raised once the best is written.
    """

    slm: npt.NDArray[np.complex64]
    frame: Float64Array
    relative: Float64Array
    deviations: tuple[float, ...]
    camera_residual_px: float
    ended_by: BaseException | None = None


def photograph_spots(
    io: DisplayBench,
    slm: Array,
    display: Display,
    spots: SpotList,
    options: CaptureOptions,
    computed: HologramOptions,
    progress: Callable[[int, float], object] | None = None,
) -> PhotographedSpots:
    """Photograph spots, and for ``options.refine`` rounds ask for more where the camera saw too little.

    ``slm`` is complex (n_frames, height, width), ``computed`` how it was computed; ``progress(round,
    deviation)``. The most even pattern by photograph is kept; Ctrl-C or a signal during a round
    ends it with that.

    Raises InputError when the camera does not see the spots, or some are in focus elsewhere; DeviceError when
    a device fails.
    """
    if deep := int(np.count_nonzero(spots.z_mm)):
        raise InputError(
            f"{deep} of {len(spots)} spots are in focus before or behind the focal plane, where the camera "
            "does not look: it would call them dim. Show them without a photograph."
        )
    camera, _ = registered_camera(io, display)
    seen = _Spots(io, display, spots, camera, options.average)
    frame, relative = seen.measure(slm)
    best = PhotographedSpots(np.asarray(slm, np.complex64), frame, relative, (), camera.residual_px)
    deviations, asked, now = [float(relative.std())], spots, np.asarray(slm, np.complex64)
    ended_by: BaseException | None = None
    try:
        for number in range(1, options.refine + 1):
            asked = brighter_where_dim(asked, relative)
            now = compute_spots(display, asked, computed, initial=now)[0].slm
            frame, relative = seen.measure(now)
            deviations.append(float(relative.std()))
            if deviations[-1] < best.relative.std():
                best = PhotographedSpots(now, frame, relative, (), camera.residual_px)
            if progress is not None:
                progress(number, deviations[-1])
    except (KeyboardInterrupt, SystemExit) as interruption:
        ended_by = interruption
    return replace(best, deviations=tuple(deviations), ended_by=ended_by)


def registered_camera(io: DisplayBench, display: Display) -> tuple[CameraMap, float]:
    """Find the camera, by the mask's speckle or else by spots, and how bright the mean intensity is.

    Returns that in counts a millisecond. Raises InputError when it does not see them.
    """
    if len(np.unique(display.mask.levels)) > 1:
        return find_camera(io, display)
    camera = register_by_spots(io, display)
    return camera, random_brightness(io, display, camera)


def register_by_spots(io: DisplayBench, display: Display) -> CameraMap:
    """Find the camera's map from single spots at known places, one a frame.

    Raises InputError when they are not seen where the lens and the pitches say, within a tenth of the field.
    """
    at = 0.5 + _REACH * np.linspace(-1, 1, _SIDE)
    places = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    one = np.ones(1)
    frames = []
    for place in places:
        wave = SpotField(display, SpotList(place[None], one, 0 * one)).back(one)
        io.show(np.exp(1j * np.angle(wave)))
        frames.append(_exposed(io, 1))
    rest = np.median(frames, axis=0)
    across = io.across_px(display)
    shape = (rest.shape[0], rest.shape[1])
    nominal = CameraMap(shape, across, np.zeros((10, 2)))
    shifts, clear = [], []
    for frame, (y, x) in zip(frames, places - 0.5, strict=True):
        alone = np.maximum(frame - rest, 0)
        alone *= _about(alone.shape, nominal.pixels(y, x), 0.15 * across)  # mirrors have a twin opposite
        row, column = np.unravel_index(int(np.argmax(alone)), alone.shape)
        top, left = max(int(row) - 4, 0), max(int(column) - 4, 0)
        box = alone[top : top + 9, left : left + 9]
        rows, columns = np.indices(box.shape)
        found = top + (box * rows).sum() / box.sum(), left + (box * columns).sum() / box.sum()
        shift = np.subtract(found, [float(v) for v in nominal.pixels(y, x)])
        clear.append(float(alone.max()) > _CLEAR * float(alone.std()) and np.hypot(*shift) < 0.1 * across)
        shifts.append(shift)
    good = np.array(clear)
    if good.sum() < len(places) - 2:
        raise InputError(
            f"The camera saw {int(good.sum())} of {len(places)} single spots where lens and pitches say. "
            "Check that the laser shines, the focal length, the SLM's pitch and how the camera is turned."
        )
    return polynomial_map(nominal, places[good] - 0.5, np.array(shifts)[good])


def _about(shape: tuple[int, ...], place: tuple[Array, Array], reach: float) -> BoolArray:
    """Return which pixels lie within a reach of a place."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    near: BoolArray = np.hypot(rows - float(place[0]), columns - float(place[1])) < reach
    return near


def _exposed(io: DisplayBench, average: int) -> Float64Array:
    """Return counts a millisecond, exposed so that the brightest pixel is well inside the camera's range."""
    low, high = io.bench.camera.exposure_limits_ms
    exposure_ms = float(np.clip(io.bench.camera.exposure_ms, low, high))
    for _ in range(8):
        frame = io.photograph(exposure_ms)
        part = float(frame.max()) * io.bench.camera.exposure_ms / io.full_scale
        if (
            0.3 < part < 0.85
            or (part <= 0.3 and exposure_ms >= high)
            or (part >= 0.85 and exposure_ms <= low)
        ):
            break
        wanted = exposure_ms * (0.1 if part >= 0.85 else min(_FULL / max(part, 1e-3), 30.0))
        exposure_ms = float(np.clip(wanted, low, high))
    frames = [frame, *(io.photograph(exposure_ms) for _ in range(average - 1))]
    return np.asarray(np.mean(frames, axis=0), np.float64)


@dataclass(frozen=True, slots=True)
class _Spots:
    io: DisplayBench
    display: Display
    spots: SpotList
    camera: CameraMap
    average: int

    def measure(self, slm: Array) -> tuple[Float64Array, Float64Array]:
        """Return the frames' sum, and each spot's brightness over what was asked for, mean 1."""
        total = np.zeros(self.io.bench.camera.image_shape)
        for field in slm:
            self.io.show(field)
            total += _exposed(self.io, self.average)
        y, x = (self.spots.places - 0.5).T
        rows, columns = self.camera.pixels(y, x)
        reach = ceil(1.2 * self.camera.pixels_across / self.display.factor / min(self.display.slm_shape))
        light = np.array([self._sum(total, r, c, reach) for r, c in zip(rows, columns, strict=True)])
        if light.min() <= 0:
            raise InputError(f"The camera does not see {int((light <= 0).sum())} of {len(light)} spots.")
        relative = light / self.spots.intensity
        return total, np.asarray(relative / relative.mean(), np.float64)

    @staticmethod
    def _sum(image: Array, row: float, column: float, reach: int) -> float:
        """Add up the light around a place, pixels on the border by the part that is inside."""
        height, width = image.shape
        weights = [
            np.clip(reach + 1 - np.abs(np.arange(n) - at), 0, 1) for n, at in ((height, row), (width, column))
        ]
        inside = [np.flatnonzero(w) for w in weights]
        if not all(len(n) for n in inside):
            return 0.0
        part = image[np.ix_(*inside)]
        return float(weights[0][inside[0]] @ part @ weights[1][inside[1]])


def write_spots_seen(path: Path, found: PhotographedSpots, *, simulated: bool) -> None:
    """Write the camera's picture, its brightest pixel white, and what was measured beside it."""
    pixels = np.clip(np.rint(found.frame / found.frame.max() * 255), 0, 255).astype(np.uint8)
    facts = {
        "simulated": simulated,
        "deviations": list(found.deviations),
        "relative": [round(float(v), 5) for v in found.relative],
        "camera_residual_px": found.camera_residual_px,
    }
    write_image(path, pixels, facts)
