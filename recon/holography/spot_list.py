"""Holograms of spots at any places, in one plane or several: weighted Gerchberg-Saxton.

The field at each spot is a plain sum over the SLM, not a sample of an FFT, so that spots lie exactly where
they were asked for, through a mask or without one. Spots of one row share half of that sum: an array costs
little more than one of its columns.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float64Array
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.optimise import Hologram, HologramRecord, HologramStop
from recon.holography.options import HologramOptions
from recon.holography.panel import Panel

EVEN = 0.002
"""Deviation of the spots' brightness, relative, at which the search ends."""
LEARNS = 0.5
"""Part of the iterations in which the spots' phases are free; then they are held while weights go on
(Kim 2019), which is what makes them even to a part in a thousand."""

MOST_OFF = 0.25
"""Wavelengths by which a near spot's wave may differ from a round one at the edge of its light."""


@dataclass(frozen=True)
class SpotList:
    """Where light is wanted, and how much.

    Attributes
    ----------
    places : ndarray, float64, (n, 2)
        ``(y, x)`` in fractions of the field (of what a near picture fills), (0, 0) its top left corner;
        0.5, 0.5 is the axis, where light is that the SLM does not modulate.
    intensity : ndarray, float64, (n,)
        As it is seen, any scale, above 0.
    z_mm : ndarray, float64, (n,)
        Behind the focal plane.
    """

    places: Float64Array
    intensity: Float64Array
    z_mm: Float64Array

    def __post_init__(self) -> None:
        n = len(self.places)
        if not n or self.places.shape != (n, 2) or self.intensity.shape != (n,) or self.z_mm.shape != (n,):
            raise InputError(
                "Spots need a place (y, x), an intensity and a depth each, and at least one spot."
            )
        found = np.column_stack([self.places, self.intensity, self.z_mm])
        if not np.isfinite(found).all():
            raise InputError("Spots need finite places, intensities and depths.")
        if self.places.min() < 0 or self.places.max() > 1:
            raise InputError("Spots lie in 0 to 1 of the field, (0, 0) its top left corner.")
        if self.intensity.min() <= 0:
            raise InputError("A spot's intensity is above 0: leave out what shall be dark.")
        if len(np.unique(found[:, [0, 1, 3]], axis=0)) < n:
            raise InputError("Two spots have the same place.")

    def __len__(self) -> int:
        return len(self.places)


def spot_array(rows: int, columns: int, *, z_mm: float = 0.0) -> SpotList:
    """Return an even array about the axis, 0.6 of the field wide and high."""
    if rows < 1 or columns < 1:
        raise InputError(f"A spot array has rows and columns, not {rows} x {columns}.")
    y, x = (0.5 + 0.6 * (np.arange(n) - (n - 1) / 2) / max(n - 1, 1) for n in (rows, columns))
    places = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    return SpotList(places, np.ones(len(places)), np.full(len(places), float(z_mm)))


@dataclass(frozen=True, slots=True)
class SpotScores:
    """How spots came out.

    Attributes
    ----------
    relative : ndarray, float64, (n,)
        Intensity of each over what was asked for, mean 1.
    efficiency : float
        Part of the light on the SLM that is in all spots together, each a resolution cell of the aperture.
    """

    relative: Float64Array
    efficiency: float

    @property
    def deviation(self) -> float:
        """Standard deviation over mean."""
        return float(self.relative.std())


class SpotField:
    """Takes SLM fields to the light at spots, and back.

    Parameters
    ----------
    display : Display
        Its mask, displacement and DC term are part of it, and what was learned of it.
    spots : SpotList
    """

    def __init__(self, display: Display, spots: SpotList) -> None:
        from recon.holography import _kernels  # late: numba takes half a second to import

        self._kernels = _kernels
        self.display, self.spots = display, spots
        learned = display.learned
        self._panel = None if learned is None else Panel(display, np.complex64)
        depth = 1.0 if learned is None else learned.mask_depth
        self._table = display.mask.response(display.wavelength_nm / depth).astype(np.complex64)
        nodes = display.displacement
        self._nodes = None if nodes is None else np.ascontiguousarray(nodes, np.float32)
        self._field = np.zeros(display.mask.shape, np.complex64)
        nu = spots.places - 0.5
        self._planes = []
        for z_mm in np.unique(spots.z_mm):
            self._require_round(float(z_mm))
            here = np.flatnonzero(spots.z_mm == z_mm)
            rows, row_of = np.unique(nu[here, 0], return_inverse=True)
            down = self._waves(rows, 0, float(z_mm))
            groups = [here[row_of == n] for n in range(len(rows))]
            across = [self._waves(nu[group, 1], 1, float(z_mm)) for group in groups]
            self._planes.append((self._defocus(float(z_mm)), down, groups, across))
        fill = 0.0 if display.near else display.mask_fill
        self.envelope = np.prod(np.sinc(fill * nu) ** 2, axis=1)
        """Intensity of the mask pixels' diffraction and the vignetting at each spot, (n,)."""
        if learned is not None:
            self.envelope *= np.prod(learned.shading_at(nu[:, 0], nu[:, 1]), axis=0)

    def _defocus(self, z_mm: float) -> tuple[Array, Array]:
        """Return what a plane out of focus adds behind the mask; near, every spot's wave has its own."""
        if self.display.near:
            height, width = self.display.mask.shape
            return np.ones(height, np.complex64), np.ones(width, np.complex64)
        hy, hx = self.display.defocus(z_mm)
        return hy.astype(np.complex64), hx.astype(np.complex64)

    def _require_round(self, z_mm: float) -> None:
        """Refuse near spots whose waves, products of a column and a row, are far from round (0172)."""
        display = self.display
        if not display.near:
            return
        assert display.distance_mm is not None
        away_mm, pitch_mm = display.distance_mm + z_mm, display.mask_pitch_um * 1e-3
        off = away_mm * (display.wavelength_nm * 1e-6) ** 3 / (64 * pitch_mm**4)
        if off > MOST_OFF:
            raise InputError(
                f"Spots {away_mm:.4g} mm behind mask pixels of {display.mask_pitch_um:g} um would be "
                f"computed {off:.2g} wavelengths wrong at the edge of their light (at most {MOST_OFF:g}): "
                "give a picture of the spots as the target."
            )

    def _waves(self, nu: Array, axis: int, z_mm: float) -> npt.NDArray[np.complex64]:
        """Return what of the mask's rows or columns arrives at places in the field, (places, cells)."""
        display, cells = self.display, self.display.mask.shape[axis]
        if not display.near:
            return _wave(nu, cells)
        assert display.distance_mm is not None
        display.require_plane(z_mm)
        away_mm = display.distance_mm + z_mm
        pitch_mm, wavelength_mm = display.mask_pitch_um * 1e-3, display.wavelength_nm * 1e-6
        aside = nu[:, None] * display.picture_mm - (np.arange(cells) - (cells - 1) / 2) * pitch_mm
        way = np.hypot(aside, away_mm) - away_mm
        order = pitch_mm * aside / (wavelength_mm * np.hypot(aside, away_mm))
        shape = np.sinc(display.mask_fill * order) if display.mask_fill else abs(order) <= 0.5
        wave = np.exp(2j * np.pi / wavelength_mm * way) * shape
        # So that a spot's brightness is the light in it, however few pixels reach it.
        wave /= np.sqrt(np.mean(abs(order) < 1, axis=1, keepdims=True))
        return np.asarray(wave, np.complex64)

    def at_spots(self, slm: Array) -> npt.NDArray[np.complex64]:
        """Return the field at each spot, complex64 (n,), of an SLM field (height, width); 1 for all light."""
        display = self.display
        if self._panel is None:
            pattern = np.ascontiguousarray(display.dc.modulated * slm + display.dc.amplitude, np.complex64)
        else:
            pattern = self._panel.field(np.asarray(slm, np.complex64)[None])[0]
        found = np.empty(len(self.spots), np.complex64)
        for defocus, down, groups, across in self._planes:
            self._fill(pattern, defocus)
            lines = down @ self._field
            for line, group, wave in zip(lines, groups, across, strict=True):
                found[group] = wave @ line
        return np.asarray(found / self._field.size, np.complex64)

    def back(self, coefficients: Array) -> npt.NDArray[np.complex64]:
        """Return the adjoint: the SLM field, complex64 (height, width), that adds up at the spots."""
        panel = self._panel
        out = np.zeros(self.display.slm_shape if panel is None else panel.shape, np.complex64)
        for defocus, down, groups, across in self._planes:
            lines = np.stack([coefficients[g] @ w.conj() for g, w in zip(groups, across, strict=True)])
            np.matmul(down.conj().T, lines.astype(np.complex64), out=self._field)
            self._gather(out, defocus)
        return np.asarray(out if panel is None else panel.collected(out), np.complex64)

    @property
    def _factor(self) -> int:
        return self.display.factor if self._panel is None else self._panel.factor

    def _fill(self, pattern: Array, defocus: tuple[Array, Array]) -> None:
        mask, k, rows = self.display.mask.levels, self._factor, self._field.shape[0]
        hy, hx = defocus
        if self._nodes is None:
            self._kernels.fill(self._field.view(np.float32), pattern, mask, self._table, hy, hx, k, 0, rows)
        else:
            self._kernels.fill_displaced(
                self._field, pattern, mask, self._table, hy, hx, self._nodes, k, 0, rows
            )

    def _gather(self, out: Array, defocus: tuple[Array, Array]) -> None:
        mask, k = self.display.mask.levels, self._factor
        hy, hx = defocus
        if self._nodes is None:
            self._kernels.gather(out, self._field.view(np.float32), mask, self._table, hy, hx, k, 0, len(out))
        else:
            rows = self._field.shape[0]
            self._kernels.gather_displaced(
                out, self._field, mask, self._table, hy, hx, self._nodes, k, 0, rows
            )

    def score(self, slm: Array) -> SpotScores:
        """Return how the spots of SLM frames, complex (n_frames, height, width), come out."""
        light = np.mean([np.abs(self.at_spots(frame)) ** 2 for frame in slm], axis=0) * self.envelope
        relative = light / self.spots.intensity
        return SpotScores(np.asarray(relative / relative.mean(), np.float64), float(light.sum()))


def _wave(nu: Array, cells: int) -> npt.NDArray[np.complex64]:
    return np.exp(-2j * np.pi * np.outer(nu, np.arange(cells) - (cells - 1) / 2)).astype(np.complex64)


def compute_spots(
    display: Display,
    spots: SpotList,
    options: HologramOptions | None = None,
    *,
    initial: Array | None = None,
    callback: Callable[[HologramRecord, Array], object] | None = None,
    cancel: threading.Event | None = None,
) -> tuple[Hologram, SpotScores]:
    """Compute SLM phases that show spots, as even as asked for.

    Weighted Gerchberg-Saxton: the phase of a weighted sum of the spots' waves, weights that grow where a spot
    is too dim. The phases are on the SLM's levels (256, or as the options say) all the way, so that rounding
    is made up for too, and the DC light at each spot counts.

    Parameters
    ----------
    display : Display
    spots : SpotList
    options : HologramOptions
        Its frames, seed, phase levels, iterations and time; ``envelope="ignore"`` leaves the mask pixels'
        envelope out, else spots are as bright as asked for where they are seen.
    initial : ndarray, complex, (n_frames, height, width), optional
        Warm start: the spots' phases are taken from it and kept, so that little else changes.
    callback : callable, optional
        ``callback(record, slm)`` after each iteration; the record's loss is the spots' deviation.
    cancel : threading.Event, optional

    Raises InputError for a complex SLM, which this method does not use, and a warm start of another shape.
    """
    options = options or HologramOptions()
    if options.complex_slm:
        raise InputError("Spots are computed for a phase SLM.")
    field = SpotField(options.display_of(display), spots)
    step = 2 * np.pi / (options.phase_levels or 256)
    rng = np.random.default_rng(options.seed)
    wanted = np.sqrt(spots.intensity / field.envelope)
    weights = wanted / wanted.mean()
    # Rounded at random: an array's phases repeat over the SLM, and so would errors of rounding.
    dither = rng.random((options.frames, *display.slm_shape), np.float32)
    phases: Array = rng.uniform(0, 2 * np.pi, (options.frames, len(spots)))
    if initial is not None:
        if np.shape(initial) != dither.shape:
            raise InputError(
                f"A warm start is {dither.shape} here (frames, height, width), not {np.shape(initial)}."
            )
        phases = np.stack([np.angle(field.at_spots(frame)) for frame in initial])
    history: list[HologramRecord] = []
    best: tuple[float, Array] | None = None
    began, aside = time.perf_counter(), 0.0
    reason = HologramStop.ITERATIONS
    for number in range(options.iterations + 1):
        back = np.stack([field.back(weights * np.exp(1j * phase)) for phase in phases])
        slm = np.exp(1j * step * np.floor(np.angle(back) / step + dither)).astype(np.complex64)
        seen = np.stack([field.at_spots(frame) for frame in slm])
        brightness = np.sqrt(np.mean(np.abs(seen) ** 2, axis=0)) / wanted
        deviation = float(brightness.std() / brightness.mean())
        even = float((brightness**2).std() / (brightness**2).mean())
        if best is None or even < best[0]:
            best = even, slm
        seconds = time.perf_counter() - began - aside
        history.append(HologramRecord(number, seconds, even, -20 * np.log10(max(deviation, 1e-6))))
        if callback is not None:
            paused = time.perf_counter()
            callback(history[-1], slm)
            aside += time.perf_counter() - paused
        if even <= EVEN:
            reason = HologramStop.EVEN
        elif cancel is not None and cancel.is_set():
            reason = HologramStop.CANCELLED
        elif options.time_s is not None and seconds >= options.time_s:
            reason = HologramStop.TIME
        else:
            weights = weights * np.sqrt(np.clip(brightness.mean() / np.maximum(brightness, 1e-9), 0.1, 10))
            weights /= weights.mean()
            if initial is None and number < LEARNS * options.iterations:
                phases = np.angle(seen)
            continue
        break
    assert best is not None
    found = Hologram(best[1], tuple(history), reason, history[-1].seconds)
    return found, field.score(found.slm)


def brighter_where_dim(spots: SpotList, measured: Array, gain: float = 0.8) -> SpotList:
    """Return spots asked to be brighter where a camera saw less than was asked for (and darker where more).

    ``measured`` are the spots' intensities over those of ``spots``' own request, any scale, (n,).
    """
    ratio = np.maximum(np.asarray(measured, float) / np.mean(measured), 0.05)
    return replace(spots, intensity=spots.intensity * ratio**-gain)
