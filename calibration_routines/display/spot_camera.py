"""The bench as what says how bright spots are, each a hypothesis about the mask's place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from calibration_routines.display.display_io import DisplayBench, find_camera, random_brightness
from recon.arrays import Array
from recon.holography import Display
from recon.holography.camera_map import CameraMap
from recon.holography.learn import Look
from recon.holography.pose import Pose
from recon.holography.sections import Sections
from recon.holography.spots import Spot, SpotMaker, spread_spots
from recon.holography.target import make_band


@dataclass(frozen=True, slots=True)
class SpotLook:
    """One picture of spots: each a hypothesis, and how bright it turned out."""

    frame: Array
    """Float64, (height, width): camera counts a millisecond, background subtracted."""
    rows: Array
    columns: Array
    """Float64, (n,): where the spots are looked for, camera pixels."""
    spots: tuple[Spot, ...]
    """Places in the field of view, and the poses they were computed for."""
    brightness: Array
    """Float64, (n,): in units of an ideal spot; for sections' spots all of their light, in arbitrary
    units."""
    of_whole_slm: bool
    """Whether each spot is made by the whole SLM, not by a section of it."""


class SpotCamera:
    """The bench as something that says how bright spots are.

    Brightness is in units of the mean intensity over the field of view, at a spot's peak, the mask pixels'
    envelope taken off; noise is that of an amplitude, from the speckle around the spots.

    Parameters
    ----------
    before_frame : callable, optional
        Called before every photograph; raises to end the work.
    on_look : callable, optional
        Called with every picture of spots.
    """

    camera: CameraMap
    mean_per_ms: float

    def __init__(
        self,
        io: DisplayBench,
        display: Display,
        *,
        before_frame: Callable[[], object] = lambda: None,
        on_look: Callable[[SpotLook], object] = lambda _: None,
    ) -> None:
        self.io = io
        self.display = display
        self.maker = SpotMaker(display)
        self._before_frame = before_frame
        self._on_look = on_look
        self._seed = 0
        self._brightness_known = False
        self.looks: list[Look] = []
        """Pictures of sections' spots, all of their light."""
        self._band = make_band(display.slm_shape, display.factor, "alias-free")
        self._across = io.across_px(display)

    def register(self) -> None:
        """Find the camera by the mask's speckle; needed before the first measurement and after a rotation.

        The first time a frame of random phases tells how bright the mean intensity is.

        Raises InputError when the speckle is not recognised.
        """
        self._before_frame()
        turned = self.camera.turn_rad if self._brightness_known else None
        self.camera, blank_per_ms = find_camera(self.io, self.display, turned)
        if not self._brightness_known:
            self._before_frame()
            self.mean_per_ms = random_brightness(self.io, self.display, self.camera, blank_per_ms)
            self._brightness_known = True

    def ideal(self, count: int) -> float:
        """Brightness of a right spot among ``count``, the known DC term taken off."""
        return self.maker.ideal(count) * (1 - self.display.dc.power)

    def measure(self, poses: Sequence[Pose], *, shifts_only: bool = False) -> tuple[Array, float]:
        """Show one spot for each pose in one picture; returns brightness and noise.

        ``shifts_only`` is for many spots whose poses differ in shift and depth alone.
        """
        self._seed += 1
        spots = self._spots(poses)
        make = self.maker.shift_pattern if shifts_only else self.maker.pattern
        return self._single(make(spots, seed=self._seed).slm, spots, 1 if shifts_only else 2)

    def measure_with_phases(self, pose: Pose, phases: Sequence[Array]) -> tuple[Array, float]:
        """Show one spot for each phase map (radians, the SLM's shape), which its field is lessened by."""
        self._seed += 1
        spots = self._spots([pose] * len(phases))
        rng = np.random.default_rng(self._seed)
        total = np.zeros(self.display.slm_shape, complex)
        for spot, phase in zip(spots, phases, strict=True):
            total += self.maker.field(spot) * np.exp(1j * (rng.uniform(0, 2 * np.pi) - phase))
        # The peak alone: an aberration spreads a spot, but leaves its light in the neighbourhood.
        return self._single(np.exp(1j * np.angle(total)), spots, 0)

    def measure_sections(self, pose: Pose, sections: Sections, shifts: Array) -> tuple[Array, float]:
        """Show spots made by one section of the SLM each, for further local shifts beyond a pose.

        Parameters
        ----------
        shifts : ndarray, (sections, hypotheses, 2)
            ``(y, x)``, mask pixels.

        Returns
        -------
        ndarray, (sections, hypotheses)
            Amplitudes: square roots of all of a spot's light.
        float
            Standard deviation of an amplitude, from the speckle around the spots.
        """
        self._seed += 1
        per_section, display = shifts.shape[1], self.display
        places = spread_spots(shifts.shape[0] * per_section, display.mask.shape, seed=self._seed)
        spots = [
            Spot(*place, pose.with_(shift_x=pose.shift_x + dx, shift_y=pose.shift_y + dy), section)
            for place, (dy, dx), section in zip(
                places,
                shifts.reshape(-1, 2),
                [part for part in sections.slices() for _ in range(per_section)],
                strict=True,
            )
        ]
        # A section's spot is as much wider as the section is smaller than the SLM: read its main lobe.
        lobes = [self._across / n * d for n, d in zip(display.mask.shape, sections.division, strict=True)]
        window = (ceil(0.8 * lobes[0]), ceil(0.8 * lobes[1]))
        slm = self.maker.pattern(spots, seed=self._seed).slm
        ideal = self.maker.ideal(len(spots)) / len(sections)
        light, around, frame = self._look(slm, spots, window, ideal, lobes)
        area = (2 * window[0] + 1) * (2 * window[1] + 1) / self._spot_area()
        if self.sees_all:
            self.looks.append(Look(slm, self.camera.lags(frame, self._band)))
        strength = max(float(np.median(light)), around)
        noise = np.sqrt(0.5 * around * (1 + 0.5 * area * around / strength))
        return np.sqrt(np.maximum(light, 0)).reshape(shifts.shape[:2]), float(noise)

    def _spots(self, poses: Sequence[Pose]) -> list[Spot]:
        places = spread_spots(len(poses), self.display.mask.shape, seed=self._seed)
        return [Spot(row, column, pose) for (row, column), pose in zip(places, poses, strict=True)]

    def _single(self, slm: Array, spots: Sequence[Spot], window: int) -> tuple[Array, float]:
        """Read spots made by the whole SLM; returns brightness and the noise of an amplitude."""
        ideal = self.maker.ideal(len(spots))
        found, around, _ = self._look(slm, spots, (window, window), ideal, self.lobes_px)
        return found, float(np.sqrt(around / 2))

    def _look(
        self,
        slm: Array,
        spots: Sequence[Spot],
        window: tuple[int, int],
        ideal: float,
        lobes: Sequence[float],
    ) -> tuple[Array, float, Array]:
        """Show a pattern and read its spots; returns their brightness, that of the speckle around them, all.

        ``window`` reaches so many camera pixels each way, ``ideal`` is the brightness of a right spot,
        ``lobes`` are a spot's half widths in camera pixels.
        """
        shape = self.display.mask.shape
        self._before_frame()
        self.io.show(slm)
        # An ideal spot's brightest pixel would reach two thirds of full scale.
        peak = ideal * self._spot_area() * self._captured((0, 0), lobes)
        frame = self.io.photograph(0.66 * self.io.full_scale / (max(peak, 30.0) * self.mean_per_ms))
        y = np.array([spot.row / shape[0] for spot in spots])
        x = np.array([spot.column / shape[1] for spot in spots])
        rows, columns = self.camera.pixels(y, x)
        found, around = _read_spots(frame / self.mean_per_ms, rows, columns, window)
        # From camera pixels to the brightness at the peak: a spot's area is one bin of the mask's spectrum.
        captured = self._captured(window, lobes)
        brightness = found / (self._spot_area() * captured * (np.sinc(y) * np.sinc(x)) ** 2)
        whole = all(spot.section is None for spot in spots)
        self._on_look(SpotLook(frame, rows, columns, tuple(spots), brightness / ideal, whole))
        return brightness, float(np.median(around)), frame

    @property
    def sees_all(self) -> bool:
        """Whether the camera's pixels are fine enough for what an eye resolves."""
        return 2 * self._band.cutoff <= self._across

    @property
    def lobes_px(self) -> list[float]:
        """Half widths of a spot of the whole SLM along rows and columns, camera pixels."""
        return [self._across / n for n in self.display.mask.shape]

    def _spot_area(self) -> float:
        """Camera pixels in the area of a spot."""
        height, width = self.display.mask.shape
        return (self._across / height) * (self._across / width)

    def _captured(self, window: tuple[int, int], lobes: Sequence[float]) -> float:
        """Part of a spot's light inside the window that is read."""
        share = 1.0
        for half, lobe in zip(window, lobes, strict=True):
            reach = (half + 0.5) / lobe
            x = np.linspace(-reach, reach, 2001)
            share *= float((np.sinc(x) ** 2).mean() * 2 * reach)
        return share


def _read_spots(frame: Array, rows: Array, columns: Array, window: tuple[int, int]) -> tuple[Array, Array]:
    """Sum each spot's window above the ring around it; returns sums and the rings' mean."""
    from scipy.ndimage import map_coordinates

    clear = [max(half, 2) + 2 for half in window]
    y, x = np.meshgrid(*(np.arange(-n - 2, n + 3) for n in clear), indexing="ij")
    places = [rows[:, None, None] + y, columns[:, None, None] + x]
    patches = map_coordinates(frame, places, order=1, mode="nearest")
    inside = (abs(y) <= window[0]) & (abs(x) <= window[1])
    ring = (abs(y) >= clear[0]) | (abs(x) >= clear[1])
    around = patches[:, ring].mean(axis=1)
    return patches[:, inside].sum(axis=1) - around * int(inside.sum()), around
