"""How much live pictures hold: which pixels are binned and which planes left out where time is short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.streams.pace import HELPED

SENSOR_WORK = 9.0
"""What a volume's picture takes on the sensor alone, in planes: 8, 4, 3 and 2 planes took 70, 55, 49 and 45
processor milliseconds (two iterations of total variation, 135 x 240 pixels, one thread)."""


Depths_um = Float64Array


@dataclass(frozen=True, slots=True)
class Detail:
    """Pixels and planes of a live picture."""

    binning: int
    planes: tuple[int, ...] = (0,)
    """Of the calibration's depths, in its order from 0."""
    coarseness: float = 1.0
    """Its square is what its work is less by than that of all pixels and planes: binned 2 x 2 it is 2."""

    def words(self, z_um: Depths_um) -> str:
        """Return pixels and depths in words; ``z_um`` (n_z,) are those of the calibration."""
        pixels = f"binned {self.binning} x {self.binning}"
        return pixels if len(self.planes) == len(z_um) else f"{pixels}, {self.depths(z_um)}"

    def depths(self, z_um: Depths_um) -> str:
        """Return which planes it has, in words: ``"4 of 8 depths (10, 11.14, 12.86, 14 mm)"``."""
        count = f"{len(z_um)} depths"
        if len(self.planes) == len(z_um):
            return count
        known = np.isfinite(z_um).all()
        named = [f"{z_um[k] / 1e3:.4g}" if known else str(k) for k in self.planes]
        listed = named if len(named) <= 6 else [*named[:2], "...", named[-1]]
        return f"{len(self.planes)} of {count} ({', '.join(listed)}{' mm' if known else ''})"


def ladder(central: Float32Array, binnings: Sequence[int], plane: int | None) -> dict[float, Detail]:
    """Return what pictures may hold, by coarseness, from all to least.

    Pixels and planes cost different time and lose different things, so that neither goes first as a rule.
    Each combination is judged by the share of a point's photograph, whatever its depth, that it still holds:
    of the contrast of its PSF what is left of it on binned pixels (a quarter of the work for 2 x 2), times
    what the nearest plane's PSF explains of it where its own is left out (:data:`SENSOR_WORK` stays, so half
    of 8 planes saves a quarter of the work, half of 64 two fifths). A combination is offered where none that
    costs as little holds as much. Planes so near one another that the sensor hardly tells them apart go
    before pixels; those that are well apart stay until pixels are coarse.

    Parameters
    ----------
    central : ndarray, float32, (n_z, n_channels, height, width)
        Each depth's PSF.
    binnings : sequence of int, ascending
    plane : int, optional
        A depth that is always kept: the one shown.
    """
    n_planes = len(central)
    every_plane = tuple(range(n_planes))
    whole = [Detail(binning, every_plane, float(binning)) for binning in binnings]
    if n_planes < 3:
        return {detail.coarseness: detail for detail in whole}
    held = {detail: _held_by_pixels(central[n_planes // 2], detail.binning) for detail in whole}
    every = 2
    while every < n_planes:
        planes = _spread(n_planes, -(-n_planes // every), plane)
        explained = _held_by_planes(central, planes)
        work = (SENSOR_WORK + len(planes)) / (SENSOR_WORK + n_planes)
        for detail in whole:
            fewer = Detail(detail.binning, planes, detail.binning / work**0.5)
            held[fewer] = explained * held[detail]
        every *= 2
    best, worthwhile = -1.0, []
    for detail in sorted(held, key=lambda d: -d.coarseness):
        if held[detail] > best:
            best = held[detail]
            worthwhile.append(detail)
    steps = whole[:1]
    for detail in reversed(worthwhile):
        if (steps[-1].coarseness / detail.coarseness) ** 2 <= HELPED:
            steps.append(detail)
    return {detail.coarseness: detail for detail in steps}


def _spread(n_planes: int, count: int, plane: int | None) -> tuple[int, ...]:
    """Return so many planes from the first to the last, ``plane`` in the place of its nearest between."""
    kept = np.linspace(0, n_planes - 1, count).round().astype(int).tolist()
    if plane is None or plane in kept:
        return tuple(kept)
    between = kept[1:-1]
    if between:
        between.remove(min(between, key=lambda k: abs(k - plane)))
    return tuple(sorted({kept[0], *between, plane, kept[-1]}))


def _held_by_pixels(psf: Float32Array, binning: int) -> float:
    """Return the share of a PSF's contrast (n_channels, height, width) that is left on binned pixels."""
    return float(np.var(block_mean(psf, binning, about_axis=True)) / np.var(psf))


def _held_by_planes(central: Float32Array, planes: Sequence[int]) -> float:
    """Return the share of the PSFs' contrast that those of the nearest of ``planes`` explain."""
    flat = central.reshape(len(central), -1)
    means, deviations = flat.mean(axis=1), flat.std(axis=1)
    shares = []
    for k, own in enumerate(flat):
        near = min(planes, key=lambda j: abs(j - k))
        common = float(own @ flat[near]) / own.size - float(means[k] * means[near])
        shares.append(max(common / float(deviations[k] * deviations[near]), 0.0) ** 2)
    return float(np.mean(shares))
