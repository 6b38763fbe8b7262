"""A film of the simulated animal beside the truth: cells' courses, regions found, the blood's speed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.reconstruction.activity import Activity
from recon.arrays import BoolArray, Float32Array, Float64Array
from recon.optics.animal import Animal
from recon.streams.activity import PERCENTILE, baseline, change, fading, floor_of

CLEAR_DIAMETERS = 3.0
"""A cell stands clear that has nothing else that glows within so many of its diameters across."""
NEAR_PX = 2.0
"""A region is a cell's whose place lies so near."""
FOLLOWED = 0.9
"""Correlation of dF/F with the truth from which a cell is followed."""
ROI_UM = 12.0
"""Standard deviation of the weights with which a cell's surroundings count: about the cell's diameter."""


@dataclass(frozen=True)
class Truth:
    """The animal as a film of it should show it.

    Attributes
    ----------
    cells_px, tissue_px, vessel_px : ndarray, (n, 2)
        Rows and columns on the reconstruction's pixels.
    change : ndarray, (n_cells, n_frames)
        dF/F.
    clear : ndarray of bool, (n_cells,)
        Which cells stand clear.
    speed_um_s : ndarray, (n_frames,)
        Of the blood.
    vessel_step_um : float
        Between places of the vessel.
    roi_px : float
        ``ROI_UM`` on the reconstruction's pixels.
    """

    cells_px: Float64Array
    tissue_px: Float64Array
    vessel_px: Float64Array
    change: Float64Array
    clear: BoolArray
    speed_um_s: Float64Array
    vessel_step_um: float
    roi_px: float


@dataclass(frozen=True)
class Judged:
    """How well a film tells what was there.

    Attributes
    ----------
    traces : ndarray, (n_cells, n_frames)
        dF/F at each cell's true place.
    correlation : ndarray, (n_cells,)
        With the truth; NaN for cells that do not flash.
    followed_clear : float
        Share of the clear cells that flash whose correlation is at least ``FOLLOWED``.
    clear_active, active : int
        How many flash, of the clear ones and of all.
    found, on_tissue, elsewhere : int
        Regions at a cell that flashes; at a cell that does not, or at static tissue; where nothing is.
    cells_found : int
        Cells that flash and have a region.
    speed_um_s : ndarray, (n_frames - 1,)
        Of the blood, from the kymograph.
    median_um_s, true_median_um_s : float
    kymograph : ndarray, (n_frames, n_places)
    """

    traces: Float64Array
    correlation: Float64Array
    followed_clear: float
    clear_active: int
    active: int
    found: int
    on_tissue: int
    elsewhere: int
    cells_found: int
    speed_um_s: Float64Array
    median_um_s: float
    true_median_um_s: float
    kymograph: Float64Array

    def figures(self) -> dict[str, Any]:
        """Return the numbers, JSON-compatible."""
        known = self.correlation[np.isfinite(self.correlation)]
        return {
            "active_cells": self.active,
            "clear_active_cells": self.clear_active,
            "followed_share_of_clear": round(self.followed_clear, 3),
            "median_correlation": round(float(np.median(known)), 3) if known.size else None,
            "regions_at_active_cells": self.found,
            "active_cells_with_a_region": self.cells_found,
            "regions_on_what_is_static": self.on_tissue,
            "regions_elsewhere": self.elsewhere,
            "blood_um_s": round(self.median_um_s, 1),
            "true_blood_um_s": round(self.true_median_um_s, 1),
        }


def truth_of(
    animal: Animal, times_s: Float64Array, centre: tuple[int, int], pixel_um: float, distance_um: float
) -> Truth:
    """Return what a film shall show.

    Parameters
    ----------
    times_s : ndarray, (n_frames,)
        Of the middle of each frame, since the animal was first seen.
    centre : (int, int)
        Pixel on the axis.
    pixel_um, distance_um : float
        Pixel pitch on the sensor, as reconstructed, and the diffuser's distance from it.
    """

    def seen(places: Float64Array) -> Float64Array:
        sensor = -places[:, :2] * (distance_um / places[:, 2:]) / pixel_um
        return np.column_stack([centre[0] + sensor[:, 1], centre[1] + sensor[:, 0]])

    cells = animal.cells_um[:, :2]
    apart = np.hypot(*(cells[:, None] - cells[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    others = np.concatenate([animal.tissue_um[:, :2], animal.vessel_um[:, :2]])
    beside = np.hypot(*(cells[:, None] - others[None]).transpose(2, 0, 1))
    nearest = np.minimum(apart.min(axis=1), beside.min(axis=1))
    step_s = 1e-3
    flowed = animal.flowed_um(times_s + step_s) - animal.flowed_um(times_s - step_s)
    return Truth(
        cells_px=seen(animal.cells_um),
        tissue_px=seen(animal.tissue_um),
        vessel_px=seen(animal.vessel_um),
        change=animal.change(times_s),
        clear=nearest > CLEAR_DIAMETERS * animal.diameter_um,
        speed_um_s=flowed / (2 * step_s),
        vessel_step_um=animal.vessel_length_um / (len(animal.vessel_um) - 1),
        roi_px=ROI_UM / (pixel_um * float(animal.cells_um[:, 2].mean()) / distance_um),
    )


def judge(activity: Activity, truth: Truth, period_s: float, window: int) -> Judged:
    """Judge a film and what was found in it.

    Parameters
    ----------
    period_s : float
        From frame to frame.
    window : int
        Frames of the sliding baseline.
    """
    frames = activity.frames
    fade = fading(frames)
    floor = floor_of(frames)
    traces = np.zeros(truth.change.shape)
    for trace, place in zip(traces, truth.cells_px, strict=True):
        light = _around(frames, place, truth.roi_px)[:, None, None]
        trace[:] = change(light, baseline(light, window, PERCENTILE, fade), floor)[:, 0, 0]
    active = truth.change.max(axis=1) > 0.1
    correlation = np.full(len(active), np.nan)
    for cell in np.flatnonzero(active):
        if traces[cell].std() > 0:
            correlation[cell] = np.corrcoef(traces[cell], truth.change[cell])[0, 1]
        else:
            correlation[cell] = 0.0
    chosen = active & truth.clear
    followed = float(np.mean(correlation[chosen] >= FOLLOWED)) if chosen.any() else float("nan")
    static = np.concatenate([truth.cells_px[~active], truth.tissue_px])
    centres = [region.centre for region in activity.regions]
    away = [np.hypot(*(truth.cells_px[active] - centre).T) for centre in centres]
    at_cell = [bool(distance.min() <= NEAR_PX) for distance in away]
    on_tissue = sum(
        bool(np.min(np.hypot(*(static - centre).T)) <= NEAR_PX)
        for centre, at in zip(centres, at_cell, strict=True)
        if not at
    )
    kymograph = _along(frames, truth.vessel_px)
    speed = _speed(kymograph, truth.vessel_step_um, period_s)
    return Judged(
        traces=traces,
        correlation=correlation,
        followed_clear=followed,
        clear_active=int(chosen.sum()),
        active=int(active.sum()),
        found=sum(at_cell),
        on_tissue=on_tissue,
        elsewhere=len(at_cell) - sum(at_cell) - on_tissue,
        cells_found=len({int(d.argmin()) for d, at in zip(away, at_cell, strict=True) if at}),
        speed_um_s=speed,
        median_um_s=float(np.median(speed)),
        true_median_um_s=float(np.median(truth.speed_um_s)),
        kymograph=kymograph,
    )


def _around(frames: Float32Array, place: Float64Array, roi_px: float) -> Float32Array:
    """Return the light about a place in each frame, weighted by a Gaussian."""
    row, column = np.round(place).astype(int)
    reach = int(3 * roi_px) + 1
    box = np.s_[:, max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    y, x = np.mgrid[box[1:]]
    weight = np.exp(-((y - place[0]) ** 2 + (x - place[1]) ** 2) / (2 * roi_px**2))
    light: Float32Array = np.tensordot(frames[box], (weight / weight.sum()).astype(np.float32), 2)
    return light


def _along(frames: Float32Array, places: Float64Array) -> Float64Array:
    """Return the light along a line in each frame, less what does not change there."""
    from scipy import ndimage

    light = np.stack([ndimage.map_coordinates(frame, places.T, order=1) for frame in frames])
    return np.asarray(light - light.mean(axis=0), np.float64)


def _speed(kymograph: Float64Array, step_um: float, period_s: float) -> Float64Array:
    """Return the speed between successive frames, (n_frames - 1,): the shift that lays one on the next.

    It is looked for among shifts of either sign by up to a twelfth of the line, by the correlation of what
    both frames have, and refined to a fraction of a place by the parabola through the largest.
    """
    n = kymograph.shape[1]
    far = max(n // 12, 3)
    lags = np.arange(-far, far + 1)
    speeds = np.zeros(len(kymograph) - 1)
    for t, (before, after) in enumerate(itertools.pairwise(kymograph)):
        both = [(before[max(-k, 0) : n - max(k, 0)], after[max(k, 0) : n - max(-k, 0)]) for k in lags]
        score = np.array([np.mean(a * b) / (np.std(a) * np.std(b) + 1e-30) for a, b in both])
        best = int(np.argmax(score))
        shift = float(lags[best])
        if 0 < best < len(lags) - 1:
            bend = score[best - 1] - 2 * score[best] + score[best + 1]
            shift += 0.5 * (score[best - 1] - score[best + 1]) / bend if bend < 0 else 0.0
        speeds[t] = shift * step_um / period_s
    return speeds
