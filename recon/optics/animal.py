"""A small animal that moves, flashes, bleaches, and has blood in a vessel: what it is at any time.

No optics here, and all of it drawn from a seed. The whole animal sways sideways as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Float64Array
from recon.optics.scene import Beads, Scene

CELLS, TISSUE, PLANES = 200, 100, 24
"""Cells that may flash, spots of tissue that never do, planes that both lie in."""
ACTIVE = 0.5
"""Share of the cells that flash at all."""
RISE_S, DECAY_S, RATE_HZ = 0.08, 0.7, 0.12
"""Of the transients (Chen 2013, GCaMP6f at body temperature of fish: slower), and how often one begins."""
PERIOD_S = 60.0
"""After which the same transients come again."""
BLEACH_S = 90.0
"""In which light falls to 1 / e."""
BLOOD_EVERY = 0.09
"""Mean distance of glowing blood cells, in lengths of the animal."""
PULSE_HZ, PULSE = 2.0, 0.4
"""The heart: its rate, and the share of the blood's speed that it adds and takes."""
SPEED = 0.08
"""Of the blood, lengths of the animal a second."""
SWAY = 0.003
"""How far the animal sways to either side, in its lengths, in two rhythms."""


@dataclass(frozen=True)
class Animal:
    """An animal about the axis; lengths in micrometres.

    Attributes
    ----------
    cells_um, tissue_um : ndarray, (n, 3)
    rest, glow : ndarray, (n,)
        Light of the cells at rest, mean about 1, and of the spots of tissue, mean about 0.5.
    onsets_s, sizes : tuple of ndarray
        Of each cell: when its transients begin, and their dF/F.
    vessel_um : ndarray, (n, 3)
        Places along the vessel, evenly apart.
    blood_um : ndarray
        Where along the vessel glowing blood cells are at time 0.
    diameter_um, length_um : float
        Of a cell, and of the animal along x.
    """

    cells_um: Float64Array
    rest: Float64Array
    onsets_s: tuple[Float64Array, ...]
    sizes: tuple[Float64Array, ...]
    tissue_um: Float64Array
    glow: Float64Array
    vessel_um: Float64Array
    blood_um: Float64Array
    diameter_um: float
    length_um: float

    @property
    def extent_um(self) -> tuple[tuple[float, float], ...]:
        """Least and largest x, y and z of anything in it."""
        everything = np.concatenate([self.cells_um, self.tissue_um, self.vessel_um])
        low, high = everything.min(axis=0), everything.max(axis=0)
        return tuple((float(a), float(b)) for a, b in zip(low, high, strict=True))

    @property
    def vessel_length_um(self) -> float:
        """Along the vessel."""
        return float(np.sum(np.linalg.norm(np.diff(self.vessel_um, axis=0), axis=1)))

    def change(self, time_s: npt.ArrayLike) -> Float64Array:
        """Return dF/F of all cells, (n_cells, n_times), without bleaching."""
        times = np.atleast_1d(np.asarray(time_s, float))
        course = np.zeros((len(self.cells_um), len(times)))
        peak = (DECAY_S / (DECAY_S + RISE_S)) * (RISE_S / (DECAY_S + RISE_S)) ** (RISE_S / DECAY_S)
        for cell, (onsets, sizes) in enumerate(zip(self.onsets_s, self.sizes, strict=True)):
            for onset, size in zip(onsets, sizes, strict=True):
                since = np.mod(times - onset, PERIOD_S)
                shape = (1 - np.exp(-since / RISE_S)) * np.exp(-since / DECAY_S)
                course[cell] += size * shape / peak
        return course

    def faded(self, time_s: npt.ArrayLike) -> Float64Array:
        """Return how much of the light bleaching has left, (n_times,)."""
        return np.exp(-np.atleast_1d(np.asarray(time_s, float)) / BLEACH_S)

    def sway_um(self, time_s: npt.ArrayLike) -> Float64Array:
        """Return where the animal is, ``(x, y)`` from its mean place, (n_times, 2)."""
        times = np.atleast_1d(np.asarray(time_s, float))
        far = SWAY * self.length_um
        along = far * np.sin(2 * np.pi * times / 11.0)
        across = 0.6 * far * np.sin(2 * np.pi * times / 7.0 + 1.0)
        return np.column_stack([along, across])

    def flowed_um(self, time_s: npt.ArrayLike) -> Float64Array:
        """Return how far the blood has come since time 0, (n_times,)."""
        times = np.atleast_1d(np.asarray(time_s, float))
        turn = 2 * np.pi * PULSE_HZ
        pulsing = PULSE * (1 - np.cos(turn * times)) / turn
        return SPEED * self.length_um * (times + pulsing)

    def blood(self, time_s: float) -> Float64Array:
        """Return how much light is at each place of the vessel, (n_vessel,)."""
        step = self.vessel_length_um / (len(self.vessel_um) - 1)
        around = len(self.vessel_um) * step
        at = np.mod(self.blood_um + float(self.flowed_um(time_s)[0]), around) / step
        light = np.zeros(len(self.vessel_um) + 1)
        low = np.floor(at).astype(int)
        np.add.at(light, low, 1 - (at - low))
        np.add.at(light, np.minimum(low + 1, len(light) - 1), at - low)
        light[0] += light[-1]
        return light[:-1]

    def scene(self, power: float) -> Scene:
        """Return the animal at rest without its blood, as beads of so much light where its light is 1."""
        places = np.concatenate([self.cells_um, self.tissue_um])
        powers = power * np.repeat(np.concatenate([self.rest, self.glow])[:, None], 3, axis=1)
        return Scene("animal", beads=(Beads(places, powers, self.diameter_um),))


def draw_animal(z_um: float, height_um: float, seed: int = 0) -> Animal:
    """Draw an animal for a field of so many micrometres in height at a distance.

    It is a quarter longer than the field is high, half as wide, and a twenty-fifth of its distance thick.
    Cells keep a diameter from one another.
    """
    rng = np.random.default_rng([seed, 1948])
    length, width, thickness = 1.25 * height_um, 0.5 * height_um, 0.04 * z_um
    diameter = 0.01 * height_um
    planes = z_um + thickness * (np.arange(PLANES) - (PLANES - 1) / 2) / PLANES
    way = _vessel(length, width, z_um)
    places: list[Float64Array] = []
    tries = 0
    while len(places) < CELLS + TISSUE:
        x, y = rng.uniform(-0.5, 0.5, 2) * (length, width)
        tries += 1
        inside = (2 * x / length) ** 2 + (2 * y / width) ** 2 < 1
        clear = np.min(np.hypot(way[:, 0] - x, way[:, 1] - y)) > 1.5 * diameter
        apart = diameter if tries < 50_000 else 0.0
        if inside and clear and all(np.hypot(x - p[0], y - p[1]) > apart for p in places):
            places.append(np.array([x, y, rng.choice(planes)]))
    cells = rng.permutation(len(places)) < CELLS
    where = np.array(places)
    onsets, sizes = [], []
    for _ in range(CELLS):
        count = max(rng.poisson(RATE_HZ * PERIOD_S), 1) if rng.random() < ACTIVE else 0
        onsets.append(np.sort(rng.uniform(0, PERIOD_S, count)))
        sizes.append(rng.uniform(0.4, 1.6) * rng.uniform(0.6, 1.0, count))
    vessel = float(np.sum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    return Animal(
        cells_um=where[cells],
        rest=rng.uniform(0.6, 1.4, CELLS),
        onsets_s=tuple(onsets),
        sizes=tuple(sizes),
        tissue_um=where[~cells],
        glow=rng.gamma(2.0, 0.25, TISSUE),
        vessel_um=way,
        blood_um=rng.uniform(0, vessel, max(round(vessel / (BLOOD_EVERY * length)), 3)),
        diameter_um=diameter,
        length_um=length,
    )


def _vessel(length_um: float, width_um: float, z_um: float) -> Float64Array:
    """Return the vessel: a shallow wave along the animal, places about half a cell apart."""
    x = np.linspace(-0.45, 0.45, 4000) * length_um
    y = 0.12 * width_um * np.sin(2 * np.pi * x / length_um)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    count = round(along[-1] / (0.004 * length_um)) + 1
    even = np.linspace(0, along[-1], count)
    return np.column_stack([np.interp(even, along, x), np.interp(even, along, y), np.full(count, z_um)])
